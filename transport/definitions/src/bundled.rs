// SPDX-License-Identifier: MIT OR Apache-2.0
//! The definitions of the packages of `tautline-ros-msgs`, included in the program.

use std::collections::BTreeSet;
use std::sync::Arc;
use tautline_schema::{Definition, Packages, SchemaError, TypeName};

// Names (`std_msgs/msg/String`) and texts.
include!(concat!(env!("OUT_DIR"), "/definitions.rs"));

/// The definitions of ROS types that are included in this program.
///
/// ```
/// let mut bundled = tautline_definitions::Bundled::default();
/// assert!(tautline_definitions::Bundled::names().any(|name| name == "rcl_interfaces/msg/Log"));
/// let name = "rcl_interfaces/msg/Log".parse()?;
/// assert_eq!(bundled.definition(&name)?.unwrap().fields[0].name, "stamp");
/// # Ok::<(), tautline_schema::SchemaError>(())
/// ```
#[derive(Debug, Default)]
pub struct Bundled {
    packages: Packages,
    parsed: BTreeSet<String>,
}

impl Bundled {
    /// The names of all types, such as `std_msgs/msg/String`.
    pub fn names() -> impl Iterator<Item = &'static str> {
        DEFINITIONS.iter().map(|(name, _)| *name)
    }

    /// The definition of a type, or of a type derived from a service or action; `None` if it is not bundled.
    ///
    /// # Errors
    /// An invalid definition; a released version contains none.
    pub fn definition(&mut self, name: &TypeName) -> Result<Option<Arc<Definition>>, SchemaError> {
        if !self.parsed.contains(name.package()) {
            // All of the package: some are derived from others.
            for (other, text) in DEFINITIONS {
                let other: TypeName = other.parse()?;
                if other.package() == name.package() {
                    self.packages.add_text(&other, &format!("bundled {other}"), text)?;
                }
            }
            self.parsed.insert(name.package().to_owned());
        }
        self.packages.definition(name)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tautline_schema::Schema;

    #[test]
    fn every_bundled_definition_is_complete() {
        let mut bundled = Bundled::default();
        let bytes: usize = DEFINITIONS.iter().map(|(name, text)| name.len() + text.len()).sum();
        println!("{} definitions, {bytes} bytes", DEFINITIONS.len());
        for (name, _) in DEFINITIONS {
            Schema::resolve(&name.parse().unwrap(), &mut |name| bundled.definition(name)).unwrap();
        }
        let derived = "std_srvs/srv/SetBool_Request".parse().unwrap();
        assert!(bundled.definition(&derived).unwrap().is_some());
        assert!(bundled.definition(&"no_msgs/msg/None".parse().unwrap()).unwrap().is_none());
    }
}
