// SPDX-License-Identifier: MIT OR Apache-2.0

use core::fmt;

/// What is wrong with a message, and in which of its fields. Holds no heap memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FieldError<F> {
    /// The innermost message, `package/msg/Name`; empty if the value is not a message, or if the message is not known.
    pub type_name: &'static str,
    /// Its field; empty for the message itself.
    pub field: &'static str,
    /// What is wrong.
    pub fault: F,
}

/// Why a value has no CDR, or no room for it.
pub type EncodeError = FieldError<EncodeFault>;

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
    /// The memory starts at an address at which numbers cannot be written in place.
    #[error("the memory does not start at a multiple of {align} bytes: align it")]
    Alignment {
        /// In bytes.
        align: usize,
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

/// Why bytes are not a message of a type. Holds no heap memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DecodeError {
    /// The message that the bytes were read as, `package/msg/Name`.
    pub type_name: &'static str,
    /// The field, from the message inwards; empty for the message itself.
    pub path: FieldPath,
    /// Where in the body of the whole message, in bytes, the encapsulation header not counted.
    pub offset: usize,
    /// What is wrong.
    pub fault: DecodeFault,
}

/// What is wrong at one place, before it is known in which field of which message that is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Fault {
    pub(crate) offset: usize,
    pub(crate) fault: DecodeFault,
}

impl Fault {
    /// `offset` is in bytes from the start of the body.
    #[cold]
    pub(crate) fn new(offset: usize, fault: DecodeFault) -> Self {
        Self { offset, fault }
    }
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
    #[error("{value} is not a bool: the message is of another type")]
    Bool {
        /// The number found.
        value: u8,
    },
    /// A number that no value of an enum or `char` has.
    #[error("{value} is not a `{type_name}`: the message is of another type")]
    Value {
        /// The number found.
        value: i64,
        /// `char`, or the enum's name.
        type_name: &'static &'static str,
    },
    /// The numbers are big-endian, which only [`Message::decode`](crate::Message::decode) understands.
    #[error("the message is big-endian, which cannot be read in place: decode it into an owned message")]
    BigEndian,
    /// The bytes start at an address at which they cannot be read in place.
    #[error(
        "the body does not start at a multiple of {align} bytes: copy it to one that does, or decode it into an owned message"
    )]
    Alignment {
        /// In bytes.
        align: usize,
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

impl<F> FieldError<F> {
    #[cold]
    pub(crate) fn new(fault: F) -> Self {
        Self { type_name: "", field: "", fault }
    }

    /// Adds where it happened, unless an inner message has done so already.
    #[cold]
    #[doc(hidden)]
    #[must_use = "it returns the changed error"]
    pub fn within(mut self, type_name: &'static str, field: &'static str) -> Self {
        if self.type_name.is_empty() {
            (self.type_name, self.field) = (type_name, plain(field));
        }
        self
    }
}

/// How many fields of a [`FieldPath`] are kept.
const MAX_FIELDS: usize = 5;

/// The path to a field: `fields[3].name`. Holds no heap memory; if there are more than five fields, the outermost
/// are left out.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct FieldPath {
    /// The innermost first. Thin pointers, so that the error is not larger than what it is returned with.
    names: [Option<&'static &'static str>; MAX_FIELDS],
    indices: [u32; MAX_FIELDS],
    /// The element in the field that is entered next.
    index: u32,
    len: u8,
}

const NO_INDEX: u32 = u32::MAX;

impl FieldPath {
    /// The empty path: the message itself.
    pub const EMPTY: Self =
        Self { names: [None; MAX_FIELDS], indices: [NO_INDEX; MAX_FIELDS], index: NO_INDEX, len: 0 };

    /// Whether it is empty and so means the message itself.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Prepends a field to the path.
    #[cold]
    pub(crate) fn enter_field(&mut self, name: &'static &'static str) {
        let place = usize::from(self.len);
        if let (Some(last_name), Some(last_index)) = (self.names.get_mut(place), self.indices.get_mut(place))
        {
            (*last_name, *last_index) = (Some(name), self.index);
        }
        self.index = NO_INDEX;
        self.len = self.len.saturating_add(1);
    }

    /// Sets the element of the field that is entered next.
    #[cold]
    pub(crate) fn enter_index(&mut self, index: usize) {
        self.index = u32::try_from(index).unwrap_or(NO_INDEX - 1);
    }
}

impl fmt::Display for FieldPath {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut dot = "";
        if usize::from(self.len) > MAX_FIELDS {
            formatter.write_str("..")?;
            dot = ".";
        }
        for (name, index) in self.names.iter().zip(self.indices).rev() {
            let Some(name) = name else { continue };
            write!(formatter, "{dot}{}", plain(name))?;
            if index != NO_INDEX {
                write!(formatter, "[{index}]")?;
            }
            dot = ".";
        }
        Ok(())
    }
}

impl fmt::Debug for FieldPath {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "\"{self}\"")
    }
}

/// A field's name as the definition has it: a keyword of Rust is `r#type` or, generated, `type_`. No name in ROS ends with `_`.
fn plain(field: &'static str) -> &'static str {
    let field = field.strip_prefix("r#").unwrap_or(field);
    field.strip_suffix('_').unwrap_or(field)
}

impl<F: fmt::Display> fmt::Display for FieldError<F> {
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
        let Self { type_name, path, offset, fault } = self;
        if path.is_empty() {
            write!(formatter, "`{type_name}`: at byte {offset} of the body: {fault}")
        } else {
            write!(formatter, "`{type_name}`: at byte {offset} of the body, field `{path}`: {fault}")
        }
    }
}

impl<F: core::error::Error + 'static> core::error::Error for FieldError<F> {
    fn source(&self) -> Option<&(dyn core::error::Error + 'static)> {
        Some(&self.fault)
    }
}

impl core::error::Error for DecodeError {
    fn source(&self) -> Option<&(dyn core::error::Error + 'static)> {
        Some(&self.fault)
    }
}
