// SPDX-License-Identifier: MIT OR Apache-2.0
//! Type definitions on this host: those stored by nodes that opened a topic, and those of a sourced ROS 2 (`AMENT_PREFIX_PATH`).
//! They are optional: a topic that states no hash gets that of a definition of the sourced ROS 2, and incoming messages are validated
//! against the definition.

use crate::wire::TypeId;
use std::collections::HashMap;
use std::sync::Arc;
use tautline_schema::{Packages, Schema, TypeHash, TypeName};
use tautline_transport::SchemaStore;

pub(crate) struct Types {
    store: SchemaStore,
    packages: Packages,
    /// Cached look-ups, by type names of local topics.
    found: HashMap<TypeName, Option<Arc<Schema>>>,
}

impl Types {
    pub(crate) fn new(store: SchemaStore, packages: Packages) -> Self {
        Types { store, packages, found: HashMap::new() }
    }

    /// The hash of the definition with this name.
    pub(crate) fn hash_of(&mut self, name: &TypeName) -> Option<TypeHash> {
        self.find(name).map(|schema| schema.hash())
    }

    /// The definition of this type, with the same name and hash.
    pub(crate) fn schema(&mut self, id: &TypeId) -> Option<Arc<Schema>> {
        let is_it = |schema: &Arc<Schema>| schema.hash() == id.hash;
        // The stored definition is untrusted. It is not cached, because it is read only when the gateway starts taking a topic.
        let kept = self.store.read(&id.hash.to_string()).ok().flatten();
        let kept = kept.and_then(|claimed| Schema::from_text(&id.name, &claimed.text).ok()).map(Arc::new);
        kept.filter(is_it).or_else(|| self.find(&id.name).filter(is_it))
    }

    fn find(&mut self, name: &TypeName) -> Option<Arc<Schema>> {
        if !self.found.contains_key(name) {
            let schema = self.packages.schema(name).ok().map(Arc::new);
            self.found.insert(name.clone(), schema);
        }
        self.found.get(name).cloned().flatten()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_type_is_its_name_and_its_hash() {
        let mut packages = Packages::new();
        let name: TypeName = "std_msgs/msg/String".parse().unwrap();
        packages.add_text(&name, "String.msg", "string data\n").unwrap();
        let store = tempfile::tempdir().unwrap();
        let mut types = Types::new(SchemaStore::at(store.path()), packages);
        let hash = types.hash_of(&name).unwrap();
        assert_eq!(
            hash.to_string(),
            "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
        );
        assert!(types.schema(&TypeId { name: name.clone(), hash }).is_some());
        let other = hash.to_string().replace("_df", "_00").parse().unwrap();
        assert!(types.schema(&TypeId { name, hash: other }).is_none());
        assert_eq!(types.hash_of(&"no/msg/Such".parse().unwrap()), None);

        // Stored by a node, without a package. A definition stored under a wrong hash is not used.
        let mut types = Types::new(SchemaStore::at(store.path()), Packages::new());
        let id = TypeId { name: "std_msgs/msg/String".parse().unwrap(), hash };
        assert!(types.schema(&id).is_none());
        SchemaStore::at(store.path()).keep(&other.to_string(), "string data\n").unwrap();
        assert!(types.schema(&TypeId { hash: other, ..id.clone() }).is_none());
        SchemaStore::at(store.path()).keep(&hash.to_string(), "string data\n").unwrap();
        assert!(types.schema(&id).is_some());
    }
}
