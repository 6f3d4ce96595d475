// SPDX-License-Identifier: MIT OR Apache-2.0
//! Types of services: ROS's type support, and the definitions that validate requests and responses.

use crate::outgoing::ENCAPSULATION;
use crate::rcl::{RclError, RosStruct, SerializedMessage, ServiceSupport, TypeSupportError};
use std::collections::HashMap;
use std::sync::Arc;
use tautline_schema::{DynamicMessage, Endian, Packages, Schema, SchemaError};
use tautline_transport::ServiceType;

/// A type that both sides can carry. Clones share it.
#[derive(Clone)]
pub(super) struct BridgedService {
    pub(super) support: ServiceSupport,
    name: Arc<str>,
    hash: Arc<str>,
    pub(super) request: Arc<Schema>,
    pub(super) response: Arc<Schema>,
}

/// Why a service is not bridged.
#[derive(Debug, thiserror::Error)]
pub(super) enum NotBridged {
    #[error(transparent)]
    Support(#[from] TypeSupportError),
    #[error("its definition is not installed: install the package's .srv or .action files: {0}")]
    Definition(#[from] SchemaError),
    #[error(
        "the definition of {name} in the sourced ROS 2 ({installed}) differs from Tautline's nodes ({stated}): \
         source the ROS 2 that they were built with, or rebuild them"
    )]
    Hash { name: String, installed: String, stated: String },
}

/// Why a request or response is not forwarded.
#[derive(Debug, thiserror::Error)]
pub(super) enum NotCarried {
    #[error("not a message of its type")]
    Invalid,
    #[error("{}", .0.reason)]
    Rcl(#[from] RclError),
}

/// Finds types and caches them.
pub(super) struct ServiceTypes {
    packages: Packages,
    found: HashMap<String, BridgedService>,
}

impl ServiceTypes {
    pub(super) fn new() -> Self {
        ServiceTypes { packages: Packages::from_env(), found: HashMap::new() }
    }

    /// The type `name`, if its hash matches `stated`.
    pub(super) fn find(&mut self, name: &str, stated: Option<&str>) -> Result<BridgedService, NotBridged> {
        let found = match self.found.get(name) {
            Some(found) => found.clone(),
            None => {
                let found = self.load(name)?;
                self.found.insert(name.to_owned(), found.clone());
                found
            }
        };
        let differs = |installed: &str| NotBridged::Hash {
            name: name.to_owned(),
            installed: installed.to_owned(),
            stated: stated.unwrap_or_default().to_owned(),
        };
        if stated.is_some_and(|stated| stated != &*found.hash) {
            Err(differs(&found.hash))
        } else {
            Ok(found)
        }
    }

    fn load(&mut self, name: &str) -> Result<BridgedService, NotBridged> {
        let support = ServiceSupport::load(name)?;
        let schema = self.packages.schema(&name.parse()?)?;
        let hash = schema.hash().to_string();
        if let Some(library) = support.hash().filter(|library| *library != hash) {
            let (name, installed) = (name.to_owned(), library.to_owned());
            return Err(NotBridged::Hash { name, installed, stated: hash });
        }
        let part = |part: &str| -> Result<Arc<Schema>, NotBridged> {
            Ok(Arc::new(schema.of_part(&format!("{name}_{part}").parse()?)?))
        };
        let (request, response) = (part("Request")?, part("Response")?);
        Ok(BridgedService { support, name: name.into(), hash: hash.into(), request, response })
    }
}

impl BridgedService {
    /// The type as a service in Tautline states it.
    pub(super) fn service_type(&self) -> ServiceType {
        ServiceType::new(&self.name, Some(&self.hash))
    }
}

/// The struct as a body, without bytes after the last field.
pub(super) fn to_body<'b>(
    from: &RosStruct,
    schema: &Schema,
    buffer: &'b mut SerializedMessage,
) -> Result<&'b [u8], NotCarried> {
    from.serialize(buffer)?;
    let bytes = buffer.bytes();
    let body = match bytes {
        [0, 1, _, _, body @ ..] => body,
        _ => return Err(NotCarried::Invalid),
    };
    let trailing = DynamicMessage::validate(schema, body, Endian::Little).map_err(|_| NotCarried::Invalid)?;
    Ok(body.get(..body.len().saturating_sub(trailing)).unwrap_or_default())
}

/// The struct of a body from shared memory, which is untrusted.
pub(super) fn from_body(
    body: &[u8],
    schema: &Schema,
    to: &mut RosStruct,
    buffer: &mut SerializedMessage,
) -> Result<(), NotCarried> {
    DynamicMessage::validate(schema, body, Endian::Little).map_err(|_| NotCarried::Invalid)?;
    buffer.assign(&ENCAPSULATION, body)?;
    Ok(to.deserialize(buffer)?)
}
