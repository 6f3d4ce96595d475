// SPDX-License-Identifier: MIT OR Apache-2.0
//! The C layout of a plain message, and why other messages are not plain.

use std::fmt;

/// The C layout of a plain message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Plain {
    /// The size of the struct in bytes, trailing padding included.
    pub size: usize,
    /// Its alignment in bytes.
    pub align: usize,
    /// Where its last primitive ends: the length of its CDR in bytes.
    pub cdr_size: usize,
    /// The alignment of its first primitive in bytes.
    pub first_align: usize,
}

/// Why a message is not plain. Fields of nested messages are written `pose.position`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum NotPlain {
    /// A string or sequence.
    Variable {
        /// The field.
        field: String,
    },
    /// A field lies elsewhere in C than in CDR, because a nested message is padded or aligned in one but not the other.
    Misplaced {
        /// The field.
        field: String,
        /// Its offset in C, in bytes.
        in_c: usize,
        /// Its offset in CDR, in bytes.
        in_cdr: usize,
    },
    /// The elements of an array lie at other distances in C than in CDR.
    Array {
        /// The field.
        field: String,
    },
}

impl fmt::Display for NotPlain {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Variable { field } => write!(formatter, "`{field}` has no fixed size"),
            Self::Misplaced { field, in_c, in_cdr } => {
                write!(formatter, "`{field}` is at byte {in_c} in C but at byte {in_cdr} in CDR")
            }
            Self::Array { field } => {
                write!(formatter, "the elements of `{field}` are padded in C but not in CDR")
            }
        }
    }
}

impl NotPlain {
    /// The same fault, of a field of a field.
    pub(super) fn inside(self, outer: &str) -> Self {
        let path = |field| format!("{outer}.{field}");
        match self {
            Self::Variable { field } => Self::Variable { field: path(field) },
            Self::Misplaced { field, in_c, in_cdr } => Self::Misplaced { field: path(field), in_c, in_cdr },
            Self::Array { field } => Self::Array { field: path(field) },
        }
    }
}
