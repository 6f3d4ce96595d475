// SPDX-License-Identifier: MIT OR Apache-2.0

/// Why there is no message, or no such value in it.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum MessageError {
    /// The bytes do not start with an encapsulation header that can be read.
    #[error(
        "`{type_name}`: the bytes start with {found}, not with the header 00 00 or 00 01 of plain CDR: its publisher uses another encoding, or left the header out"
    )]
    Encapsulation {
        /// The type.
        type_name: String,
        /// The first bytes.
        found: String,
    },
    /// The bytes are no value of the type.
    #[error("`{type_name}`: at byte {offset} of the body{field}: {fault}", field = in_field(", field", path))]
    Decode {
        /// The type.
        type_name: String,
        /// The field, such as `poses[3].position.x`; empty for the message itself.
        path: String,
        /// Where in the body, in bytes, the encapsulation header not counted.
        offset: usize,
        /// What is wrong.
        fault: DecodeFault,
    },
    /// There is no such field or element.
    #[error("`{type_name}` has no `{path}`: {reason}")]
    Path {
        /// The type.
        type_name: String,
        /// The path.
        path: String,
        /// What is wrong with it.
        reason: String,
    },
    /// A value cannot be that of a field.
    #[error("`{type_name}`{field} {reason}", field = in_field(": field", path))]
    Value {
        /// The type.
        type_name: String,
        /// The field.
        path: String,
        /// What is wrong.
        reason: String,
    },
    /// JSON or YAML is not a value of the type.
    #[error("this is not a `{type_name}`: {reason}")]
    Text {
        /// The type.
        type_name: String,
        /// What the parser says, with the place.
        reason: String,
    },
}

/// Nothing if it is the message itself.
fn in_field(before: &str, path: &str) -> String {
    if path.is_empty() { String::new() } else { format!("{before} `{path}`") }
}

/// Why bytes are not a value.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum DecodeFault {
    /// The bytes end too early.
    #[error("{needed} bytes are needed but {left} are left: the message is cut off, or of another type")]
    End {
        /// The bytes that are needed.
        needed: usize,
        /// The bytes that are left.
        left: usize,
    },
    /// A sequence or string is longer than its bound.
    #[error("its length is {len} but at most {bound} are allowed: its publisher uses another definition")]
    Bound {
        /// The length found.
        len: usize,
        /// The greatest length allowed.
        bound: u32,
    },
    /// A string is not UTF-8, or a `wstring` not UTF-16.
    #[error("its text is not valid Unicode: its publisher wrote other bytes into a string")]
    Unicode,
    /// A string does not end with a zero byte.
    #[error("the string does not end with a zero byte: the message is of another type")]
    Terminator,
    /// A `bool` is neither 0 nor 1.
    #[error("{value} is not a bool: the message is of another type")]
    Bool {
        /// The number found.
        value: u8,
    },
    /// More bytes follow the last field than alignment explains.
    #[error(
        "{len} bytes follow the last field, where at most {most} can be padding: the message is of another type"
    )]
    Trailing {
        /// How many.
        len: usize,
        /// How many may, given the empty sequences and the `wstring`s in the message.
        most: usize,
    },
}
