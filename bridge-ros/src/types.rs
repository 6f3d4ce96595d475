// SPDX-License-Identifier: MIT OR Apache-2.0
//! Types of topics: ROS's type support, and the definition that validates messages from ROS.

use crate::rcl::{MessageSupport, TypeSupportError};
use std::collections::HashMap;
use std::sync::Arc;
use tautline_schema::{Layout, Packages, Schema, Size, TypeName};
use tautline_transport::{SchemaStore, TopicType};

/// A type that both sides can carry.
#[derive(Clone)]
pub(crate) struct BridgedType {
    pub(crate) support: MessageSupport,
    pub(crate) schema: Arc<Schema>,
}

/// Why a type is not bridged.
#[derive(Debug, thiserror::Error)]
pub(crate) enum TypeError {
    #[error(transparent)]
    Support(#[from] TypeSupportError),
    #[error(
        "the definition of {name} is not installed: install the package's .msg files (share/<package>/msg in AMENT_PREFIX_PATH): {reason}"
    )]
    Definition { name: String, reason: String },
    #[error(
        "the definition of {name} in the sourced ROS 2 ({installed}) differs from the topic's ({stated}): \
         source the ROS 2 that the topic's nodes were built with, or rebuild them"
    )]
    Hash { name: String, installed: String, stated: String },
}

/// Finds types and caches them.
pub(crate) struct Types {
    store: SchemaStore,
    packages: Packages,
    found: HashMap<String, BridgedType>,
    services: HashMap<String, Option<String>>,
}

impl Types {
    pub(crate) fn new() -> Self {
        let (found, services) = Default::default();
        Types { store: SchemaStore::of_user(), packages: Packages::from_env(), found, services }
    }

    /// The type `name`, if its hash matches the topic's.
    pub(crate) fn find(&mut self, name: &str, stated: Option<&str>) -> Result<BridgedType, TypeError> {
        let found = match self.found.get(name) {
            Some(found) => found.clone(),
            None => {
                let support = MessageSupport::load(name)?;
                let schema = self.schema(name, &support)?;
                let found = BridgedType { support, schema };
                self.found.insert(name.to_owned(), found.clone());
                found
            }
        };
        let installed = found.schema.hash().to_string();
        match stated {
            Some(stated) if stated != installed => {
                Err(TypeError::Hash { name: name.into(), installed, stated: stated.into() })
            }
            _ => Ok(found),
        }
    }

    /// The hash of a service's type, if its definition is installed.
    pub(crate) fn service_hash(&mut self, name: &str) -> Option<String> {
        if let Some(known) = self.services.get(name) {
            return known.clone();
        }
        let schema = name.parse().ok().and_then(|name| self.packages.schema(&name).ok());
        let hash = schema.map(|schema| schema.hash().to_string());
        self.services.insert(name.to_owned(), hash.clone());
        hash
    }

    /// The definition whose hash is that of ROS's type support.
    fn schema(&mut self, name: &str, support: &MessageSupport) -> Result<Arc<Schema>, TypeError> {
        let refuse = |reason: String| TypeError::Definition { name: name.into(), reason };
        let type_name: TypeName = name.parse().map_err(|_| refuse("this is not a type name".into()))?;
        let is_it = |schema: &Schema| support.hash().is_none_or(|hash| schema.hash().to_string() == hash);
        let reason = match self.packages.schema(&type_name) {
            Ok(schema) if is_it(&schema) => return Ok(schema.into()),
            Ok(schema) => {
                format!("the installed one has the hash {}, not the type support library's", schema.hash())
            }
            Err(error) => error.to_string(),
        };
        // The stored definition is untrusted.
        let kept = support.hash().and_then(|hash| self.store.read(hash).ok().flatten());
        let kept = kept.and_then(|claimed| Schema::from_text(&type_name, &claimed.text).ok());
        kept.filter(is_it).map(Arc::new).ok_or_else(|| refuse(reason))
    }
}

impl BridgedType {
    /// The type as a topic in Tautline states it.
    pub(crate) fn topic_type(&self) -> TopicType {
        let topic_type = TopicType::new(self.schema.name().to_string())
            .with_hash(self.schema.hash().to_string())
            .with_definition(self.schema.to_text());
        match Layout::of(&self.schema).size {
            Size::Fixed(body_bytes) => topic_type.with_body_bytes(body_bytes),
            _ => topic_type,
        }
    }
}
