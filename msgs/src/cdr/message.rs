// SPDX-License-Identifier: MIT OR Apache-2.0

use crate::Message;
use crate::cdr::{DecodeError, DecodeFault, EncodeError, Form, Reader, Writer};

/// The encapsulation header that ROS 2 puts before a body: plain CDR, little-endian, no options.
pub const HEADER: [u8; 4] = [0, 1, 0, 0];

/// The order of the bytes of numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Endian {
    /// Least significant first: what ROS 2 writes on x86-64 and aarch64.
    Little,
    /// Most significant first.
    Big,
}

/// An owned message that is written as CDR and read from it. Generated code implements it.
pub trait Cdr: Message + Form<Value = Self> {
    /// The RIHS01 hash of the definition, `RIHS01_` and 64 digits.
    const TYPE_HASH: &'static str;

    /// The length of the body in bytes.
    ///
    /// # Real-time
    ///
    /// Wait-free; no allocation; no syscall. Linear in the number of strings and nested messages.
    #[inline]
    fn cdr_len(&self) -> usize {
        Self::end(self, 0)
    }

    /// Writes the little-endian body to the start of `out`, padding zeroed, and returns its length,
    /// [`cdr_len`](Self::cdr_len). What follows it in `out` stays as it is.
    ///
    /// # Real-time
    ///
    /// Wait-free; no allocation; no syscall. Linear in the length.
    ///
    /// # Errors
    ///
    /// [`EncodeError`] if a string or sequence is longer than its bound, or `out` too short; a part is written then.
    #[inline]
    fn encode(&self, out: &mut [u8]) -> Result<usize, EncodeError> {
        let mut writer = Writer::new(out);
        Self::write(self, &mut writer).map_err(|error| error.within(Self::TYPE_NAME, ""))?;
        Ok(writer.position())
    }

    /// Reads a body without header, as it lies in shared memory.
    ///
    /// Allocates strings and sequences, in proportion to the length of `body` whatever lengths it claims. Up to 8 bytes
    /// may follow the message, and 8 more for every empty sequence of 8-byte numbers and every `wstring`: ROS 2 appends
    /// these.
    ///
    /// # Errors
    ///
    /// [`DecodeError`] with field and byte for anything that the type cannot be.
    fn decode(body: &[u8], endian: Endian) -> Result<Self, DecodeError> {
        let mut reader = Reader::new(body, endian);
        let read = |reader: &mut Reader<'_>| {
            let message = Self::read(reader)?;
            reader.finish()?;
            Ok(message)
        };
        read(&mut reader).map_err(|error: DecodeError| error.within(Self::TYPE_NAME, ""))
    }

    /// The message as on the ROS 2 wire: [`HEADER`], then the body.
    ///
    /// # Errors
    ///
    /// [`EncodeError`] if a string or sequence is longer than its bound.
    fn to_cdr(&self) -> Result<Vec<u8>, EncodeError> {
        let mut bytes = vec![0; HEADER.len() + self.cdr_len()];
        let (header, body) = bytes.split_at_mut(HEADER.len());
        header.copy_from_slice(&HEADER);
        self.encode(body)?;
        Ok(bytes)
    }

    /// Reads what is on the ROS 2 wire and in bags: the encapsulation header of 4 bytes, then the body, of either byte
    /// order.
    ///
    /// # Errors
    ///
    /// [`DecodeFault::Encapsulation`] for a header that is not that of plain CDR, else as [`decode`](Self::decode).
    fn from_cdr(bytes: &[u8]) -> Result<Self, DecodeError> {
        match bytes {
            [0, 1, _, _, body @ ..] => Self::decode(body, Endian::Little),
            [0, 0, _, _, body @ ..] => Self::decode(body, Endian::Big),
            _ => {
                let byte = |index| bytes.get(index).copied().unwrap_or_default();
                let fault = DecodeFault::Encapsulation { kind: [byte(0), byte(1)] };
                Err(DecodeError::new(0, fault).within(Self::TYPE_NAME, ""))
            }
        }
    }
}
