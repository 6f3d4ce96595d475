// SPDX-License-Identifier: MIT OR Apache-2.0

/// Why bytes are not a value of a [`Plain`](crate::Plain) type. Holds no heap memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[allow(missing_docs, reason = "the message of a variant says what its fields are")]
pub enum Invalid {
    /// There are fewer bytes than the type needs.
    #[error(
        "`{type_name}` needs {needed} bytes but there are {len}: publisher and reader disagree on the type"
    )]
    Length { type_name: &'static str, needed: usize, len: usize },
    /// The bytes start at an address that the type cannot have.
    #[error(
        "`{type_name}` must start at a multiple of {align} bytes: place message bodies at 8-byte aligned addresses"
    )]
    Alignment { type_name: &'static str, align: usize },
    /// A field holds a number that none of its type's values has.
    #[error(
        "byte {offset} of the body holds {value}, which is not a `{type_name}`: its publisher wrote another type"
    )]
    Value {
        offset: usize,
        value: i64,
        /// `bool`, `char` or the enum's name.
        type_name: &'static str,
    },
}

impl Invalid {
    /// The same fault in a value that starts `base` bytes into a larger one.
    #[doc(hidden)]
    #[must_use = "it returns the changed error"]
    pub fn at(self, base: usize) -> Self {
        match self {
            Self::Value { offset, value, type_name } => {
                Self::Value { offset: base + offset, value, type_name }
            }
            other => other,
        }
    }
}
