// SPDX-License-Identifier: MIT OR Apache-2.0

use crate::cdr::{DecodeError, DecodeFault, Fault, FieldPath};

/// The order of the bytes of numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Endian {
    /// Least significant first: what ROS 2 writes on x86-64 and aarch64.
    Little,
    /// Most significant first.
    Big,
}

/// A body, which may hold anything, and how far it is read.
#[derive(Clone, Debug)]
pub struct Reader<'a> {
    body: &'a [u8],
    at: usize,
    endian: Endian,
    /// How many bytes may follow the last field.
    slack: usize,
    /// The path of a fault, completed while the error is returned.
    path: Option<FieldPath>,
}

/// The number of bytes that may follow a message, and once more for every empty sequence of 8-byte numbers and every
/// `wstring`: when ROS 2 computes the length of a message, it aligns elements that are not there and counts a zero at
/// the end of a `wstring`, and then sends that many bytes.
pub(crate) const SLACK: usize = 8;

impl<'a> Reader<'a> {
    /// Starts at the start of `body`.
    pub fn new(body: &'a [u8], endian: Endian) -> Self {
        Self { body, at: 0, endian, slack: SLACK, path: None }
    }

    /// How many bytes are read.
    pub fn position(&self) -> usize {
        self.at
    }

    /// All of the body.
    pub(crate) fn body(&self) -> &'a [u8] {
        self.body
    }

    /// Continues at `at`, in bytes from the start of the body.
    pub(crate) fn skip_to(&mut self, at: usize) {
        self.at = at;
    }

    /// How many bytes are left.
    pub fn left(&self) -> usize {
        self.body.len().saturating_sub(self.at)
    }

    /// The order of the bytes of numbers.
    pub fn endian(&self) -> Endian {
        self.endian
    }

    /// Skips to the next multiple of `align`, a power of two, and takes `len` bytes.
    ///
    /// # Errors
    /// [`DecodeFault::End`] if the body ends before.
    #[inline(always)] // 5 % of a message of short strings
    pub fn take(&mut self, align: usize, len: usize) -> Result<&'a [u8], Fault> {
        self.at = self.at.next_multiple_of(align);
        let end = self.at.saturating_add(len);
        match self.body.get(self.at..end) {
            Some(bytes) => {
                self.at = end;
                Ok(bytes)
            }
            None => Err(self.fault(DecodeFault::End { needed: len, left: self.left() })),
        }
    }

    /// Takes a length.
    ///
    /// # Errors
    /// As [`take`](Self::take).
    #[inline(always)] // 5 % of a message of short strings
    pub fn length(&mut self) -> Result<usize, Fault> {
        let bytes = self.take(4, 4)?;
        let bytes = bytes.try_into().unwrap_or_default();
        let len = match self.endian {
            Endian::Little => u32::from_le_bytes(bytes),
            Endian::Big => u32::from_be_bytes(bytes),
        };
        Ok(len as usize)
    }

    /// Checks that what is left can be `count` elements of at least `min_size` bytes each.
    ///
    /// # Errors
    /// [`DecodeFault::End`] otherwise.
    #[inline]
    pub fn expect(&self, count: usize, min_size: usize) -> Result<(), Fault> {
        let (needed, left) = (count.saturating_mul(min_size), self.left());
        if needed > left { Err(self.fault(DecodeFault::End { needed, left })) } else { Ok(()) }
    }

    /// Checks that no more bytes are left than ROS 2 may append.
    ///
    /// # Errors
    /// [`DecodeFault::Trailing`] otherwise.
    pub fn finish(&self) -> Result<(), Fault> {
        let (len, most) = (self.left(), self.slack);
        if len > most { Err(self.fault(DecodeFault::Trailing { len, most })) } else { Ok(()) }
    }

    /// Allows once more the bytes that ROS 2 may append: see `SLACK`.
    #[inline]
    pub(crate) fn add_slack(&mut self) {
        self.slack += SLACK;
    }

    #[cold]
    pub(crate) fn fault(&self, fault: DecodeFault) -> Fault {
        Fault::new(self.at, fault)
    }

    /// The fault that the length that was read last is over its bound.
    #[cold]
    pub(crate) fn over_bound(&self, len: usize, bound: usize) -> Fault {
        Fault::new(self.at.saturating_sub(4), DecodeFault::Bound { len, bound })
    }

    /// The fault that the number of `size` bytes that was read last is not a value of its type.
    #[cold]
    #[doc(hidden)]
    pub fn no_value(&self, value: i64, type_name: &'static &'static str, size: usize) -> Fault {
        Fault::new(self.at.saturating_sub(size), DecodeFault::Value { value, type_name })
    }

    /// Adds the field to the path of a fault while the error is returned.
    #[cold]
    #[doc(hidden)]
    pub fn in_field(&mut self, fault: Fault, name: &'static &'static str) -> Fault {
        self.path.get_or_insert(FieldPath::EMPTY).enter_field(name);
        fault
    }

    /// Adds the element to the path of a fault while the error is returned.
    #[cold]
    pub(crate) fn at_index(&mut self, fault: Fault, index: usize) -> Fault {
        self.path.get_or_insert(FieldPath::EMPTY).enter_index(index);
        fault
    }

    /// The fault with all that is known of its place.
    #[cold]
    pub(crate) fn error(&self, Fault { offset, fault }: Fault, type_name: &'static str) -> DecodeError {
        DecodeError { type_name, path: self.path.unwrap_or(FieldPath::EMPTY), offset, fault }
    }
}
