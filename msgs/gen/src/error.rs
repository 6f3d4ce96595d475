// SPDX-License-Identifier: MIT OR Apache-2.0

use tautline_schema::SchemaError;

/// Why no code was generated.
#[derive(Debug, thiserror::Error)]
pub enum GenerateError {
    /// A definition is missing or not valid.
    #[error(transparent)]
    Schema(#[from] SchemaError),
    /// A type has a field of a package that is neither generated nor known to be elsewhere.
    #[error(
        "`{type_name}` has field `{field}` of package {package}, which is not generated: add {package} to the packages, or say with `Options::external` where it is"
    )]
    Package {
        /// The type.
        type_name: String,
        /// Its field.
        field: String,
        /// The package of the field's type.
        package: String,
    },
    /// No folder has definitions of a package.
    #[error("package {package} has no definitions in {searched}: add the folder that has them")]
    Empty {
        /// The package.
        package: String,
        /// The folders.
        searched: String,
    },
}
