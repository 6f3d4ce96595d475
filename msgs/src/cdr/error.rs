// SPDX-License-Identifier: MIT OR Apache-2.0

use core::fmt;

/// Why a value has no CDR, or no room for it. Holds no heap memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct EncodeError {
    /// The innermost message, `package/msg/Name`; empty if the value is none.
    pub type_name: &'static str,
    /// Its field; empty for the message itself.
    pub field: &'static str,
    /// What is wrong.
    pub fault: EncodeFault,
}

/// Why a value cannot be encoded.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum EncodeFault {
    /// A sequence has more elements, or a string more characters, than the definition allows.
    #[error("its length is {len} but at most {bound} are allowed: shorten it")]
    Bound {
        /// The length.
        len: usize,
        /// The greatest length allowed.
        bound: usize,
    },
    /// A length does not fit into 32 bits.
    #[error("its length {len} does not fit into the 32 bits that CDR has for it: split it")]
    Length {
        /// The length.
        len: usize,
    },
    /// The buffer is too short.
    #[error("the buffer of {len} bytes ends before byte {needed}: make it as long as `cdr_len` says")]
    Room {
        /// The bytes needed up to the end of this field.
        needed: usize,
        /// The bytes there are.
        len: usize,
    },
}

/// Why bytes are not a value of a type. Holds no heap memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DecodeError {
    /// The innermost message that the bytes were read as, `package/msg/Name`.
    pub type_name: &'static str,
    /// Its field; empty for the message itself.
    pub field: &'static str,
    /// Where in the body of the whole message, in bytes, the encapsulation header not counted.
    pub offset: usize,
    /// What is wrong.
    pub fault: DecodeFault,
}

/// Why bytes are not a value.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum DecodeFault {
    /// The bytes do not start with an encapsulation header that can be read.
    #[error(
        "the header is {:02x} {:02x}, not 00 00 or 00 01 of plain CDR: its publisher uses another encoding, or left the header out", .kind[0], .kind[1]
    )]
    Encapsulation {
        /// The first two bytes; zeros beyond the end.
        kind: [u8; 2],
    },
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
        bound: usize,
    },
    /// A string is not UTF-8, or a `wstring` not UTF-16.
    #[error("its text is not valid Unicode: its publisher wrote other bytes into a string")]
    Unicode,
    /// A string does not end with a zero byte.
    #[error("the string does not end with a zero byte: the message is of another type")]
    Terminator,
    /// A `bool` is neither 0 nor 1.
    #[error("{value} is no bool: the message is of another type")]
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

impl EncodeError {
    #[cold]
    pub(crate) fn new(fault: EncodeFault) -> Self {
        Self { type_name: "", field: "", fault }
    }

    /// Says where it happened, unless a message further in did.
    #[cold]
    #[doc(hidden)]
    #[must_use]
    pub fn within(mut self, type_name: &'static str, field: &'static str) -> Self {
        if self.type_name.is_empty() {
            (self.type_name, self.field) = (type_name, plain(field));
        }
        self
    }
}

impl DecodeError {
    #[cold]
    pub(crate) fn new(offset: usize, fault: DecodeFault) -> Self {
        Self { type_name: "", field: "", offset, fault }
    }

    /// Says where it happened, unless a message further in did.
    #[cold]
    #[doc(hidden)]
    #[must_use]
    pub fn within(mut self, type_name: &'static str, field: &'static str) -> Self {
        if self.type_name.is_empty() {
            (self.type_name, self.field) = (type_name, plain(field));
        }
        self
    }
}

/// A field's name as the definition has it.
fn plain(field: &'static str) -> &'static str {
    field.strip_prefix("r#").unwrap_or(field)
}

impl fmt::Display for EncodeError {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { type_name, field, fault } = self;
        match *field {
            "" => write!(formatter, "`{type_name}`: {fault}"),
            _ => write!(formatter, "`{type_name}`: field `{field}`: {fault}"),
        }
    }
}

impl fmt::Display for DecodeError {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { type_name, field, offset, fault } = self;
        match *field {
            "" => write!(formatter, "`{type_name}`: at byte {offset} of the body: {fault}"),
            _ => write!(formatter, "`{type_name}`: at byte {offset} of the body, field `{field}`: {fault}"),
        }
    }
}

impl core::error::Error for EncodeError {
    fn source(&self) -> Option<&(dyn core::error::Error + 'static)> {
        Some(&self.fault)
    }
}

impl core::error::Error for DecodeError {
    fn source(&self) -> Option<&(dyn core::error::Error + 'static)> {
        Some(&self.fault)
    }
}
