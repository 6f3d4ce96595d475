// SPDX-License-Identifier: MIT OR Apache-2.0

/// Why bytes are not a value of a [`Plain`](crate::Plain) type. Holds no heap memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Invalid {
    /// There are fewer bytes than the type needs.
    #[error(
        "`{type_name}` needs {needed} bytes but there are {len}: publisher and reader disagree on the type"
    )]
    Length {
        /// The Rust type.
        type_name: &'static str,
        /// The bytes it needs.
        needed: usize,
        /// The bytes there are.
        len: usize,
    },
    /// The bytes start at an address that the type cannot have.
    #[error(
        "`{type_name}` must start at a multiple of {align} bytes: place message bodies at 8-byte aligned addresses"
    )]
    Alignment {
        /// The Rust type.
        type_name: &'static str,
        /// The alignment it needs, in bytes.
        align: usize,
    },
    /// A field holds a number that none of its type's values has.
    #[error(
        "byte {offset} of the body holds {value}, which is not a `{type_name}`: its publisher wrote another type"
    )]
    Value {
        /// Where the field starts, in bytes from the start of the body.
        offset: usize,
        /// The number found there.
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
