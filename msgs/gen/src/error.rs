// SPDX-License-Identifier: MIT OR Apache-2.0

use tautline_schema::SchemaError;

/// Why no code was generated.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "the message of a variant says what its fields are")]
pub enum GenerateError {
    /// A definition is missing or not valid.
    #[error(transparent)]
    Schema(#[from] SchemaError),
    /// A type has a field of a package that is neither generated nor known to be elsewhere.
    #[error(
        "`{type_name}` has field `{field}` of package {package}, which is not generated: add {package} to the packages, or say with `Options::external` where it is"
    )]
    Package { type_name: String, field: String, package: String },
    /// No folder has definitions of a package.
    #[error("package {package} has no definitions in {searched}: add the folder that has them")]
    Empty { package: String, searched: String },
}
