// SPDX-License-Identifier: MIT OR Apache-2.0
//! The definitions of the packages that `tautline-ros-msgs` has types of.

use std::collections::BTreeSet;

use tautline_schema::{Packages, SchemaError, TypeName};

include!(concat!(env!("OUT_DIR"), "/definitions.rs"));

/// The names of the packages.
pub fn packages() -> BTreeSet<&'static str> {
    DEFINITIONS.iter().filter_map(|(name, _)| name.split('/').next()).collect()
}

/// Adds the definitions of the packages for which `wanted` holds. They take precedence over definitions in folders,
/// because they belong to the types that exist already.
pub fn add(packages: &mut Packages, wanted: impl Fn(&str) -> bool) -> Result<(), SchemaError> {
    for (name, text) in DEFINITIONS {
        let name: TypeName = name.parse()?;
        if wanted(name.package()) {
            packages.add_text(&name, &format!("bundled {name}"), text)?;
        }
    }
    Ok(())
}
