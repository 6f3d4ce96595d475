// SPDX-License-Identifier: MIT OR Apache-2.0

use core::marker::PhantomData;

use crate::cdr::{DecodeError, DecodeFault, EncodeError, Endian, FieldPath, Form, Reader, Writer};
use crate::{Body, Definition, Plain};

/// The encapsulation header that ROS 2 puts before a body: plain CDR, little-endian, no options.
pub const HEADER: [u8; 4] = [0, 1, 0, 0];

/// A type that can be the type of a topic: it has a ROS name, is read in place, and is converted to and from CDR.
///
/// Derived for plain types: `#[derive(Message)]` with `#[message(name = "demo_msgs/msg/Tick")]`. Types of any size are
/// generated from their definitions.
#[diagnostic::on_unimplemented(
    message = "`{Self}` is not a message",
    note = "give it `#[derive(Message, Clone, Copy)]`, `#[repr(C)]` and `#[message(name = \"my_msgs/msg/Name\")]`"
)]
pub trait Message: Form<Value = Self> + Send + Sync + 'static {
    /// The ROS 2 name, `package/msg/Name`.
    const TYPE_NAME: &'static str;

    /// The RIHS01 hash of the definition, `RIHS01_` and 64 digits; `None` if there is no definition.
    const TYPE_HASH: Option<&'static str>;

    /// The definition; `None` for types that are only written in Rust.
    const DEFINITION: Option<&'static Definition>;

    /// The length of every message's body in bytes, for [plain](crate::Plain) types; `None` for all others.
    const FIXED_LEN: Option<usize>;

    /// What reads a message in place: `&Self` for [plain](crate::Plain) types, else a struct of getters such as
    /// `ImageRef`.
    type View<'a>: Copy + Send + Sync;

    /// Checks a body and returns its view.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall. Constant for a plain type without `bool`, `char` and enum fields, otherwise
    /// linear in the number of fields, of characters, and of elements of a sequence that are not numbers.
    ///
    /// # Errors
    /// [`DecodeError`] with field and byte for anything that the type cannot be.
    fn view(body: Body<'_>) -> Result<Self::View<'_>, DecodeError>;

    /// The same view with a shorter lifetime.
    #[doc(hidden)]
    fn shorten<'short, 'long: 'short>(view: Self::View<'long>) -> Self::View<'short>;

    /// The message that a view reads, as an owned one: allocates its strings and sequences.
    fn owned(view: Self::View<'_>) -> Self;

    /// For types that are [plain](crate::Plain) too: the proof that [`view`](Self::view) is right about the memory. Only the
    /// derive and generated code have one.
    #[doc(hidden)]
    const PLAIN: Option<PlainView<Self>> = None;

    /// The structure of [plain](crate::Plain) types.
    #[doc(hidden)]
    const SHAPE: Option<&'static crate::Shape> = None;

    /// Zeroes the padding between the fields in `memory`, which holds a message that was written as a Rust value. Nothing
    /// to do for what is written field by field.
    #[doc(hidden)]
    #[inline]
    fn clear_gaps(memory: &mut [u8]) {
        let _ = memory;
    }

    /// The length of the body in bytes.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall. Linear in the number of strings and nested messages.
    #[inline]
    fn cdr_len(&self) -> usize {
        Self::end(self, 0)
    }

    /// Writes the little-endian body to the start of `out`, padding zeroed, and returns its length,
    /// [`cdr_len`](Self::cdr_len). What follows it in `out` stays as it is.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall. Linear in the length.
    ///
    /// # Errors
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
    /// [`DecodeError`] with field and byte for anything that the type cannot be.
    fn decode(body: &[u8], endian: Endian) -> Result<Self, DecodeError> {
        let mut reader = Reader::new(body, endian);
        let read = |reader: &mut Reader<'_>| {
            let message = Self::read(reader)?;
            reader.finish()?;
            Ok(message)
        };
        read(&mut reader).map_err(|fault| reader.error(fault, Self::TYPE_NAME))
    }

    /// The message as on the ROS 2 wire: [`HEADER`], then the body.
    ///
    /// # Errors
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
    /// [`DecodeFault::Encapsulation`] for a header that is not that of plain CDR, else as [`decode`](Self::decode).
    fn from_cdr(bytes: &[u8]) -> Result<Self, DecodeError> {
        let (endian, body) = split_header(bytes).map_err(|fault| whole::<Self>(fault))?;
        Self::decode(body, endian)
    }

    /// Reads what is on the ROS 2 wire in place. The body, which starts 4 bytes after the start of `bytes`, must be at a
    /// multiple of 8 bytes (so that `bytes` is not: a new `Vec` starts at one), and as long as the memory of a
    /// [plain](crate::Plain) type, of which the trailing padding may be missing on the wire.
    ///
    /// # Real-time
    /// As [`view`](Self::view).
    ///
    /// # Errors
    /// [`DecodeFault::BigEndian`], [`DecodeFault::Alignment`], [`DecodeFault::End`] also for missing trailing padding, else as
    /// [`from_cdr`](Self::from_cdr).
    fn view_cdr(bytes: &[u8]) -> Result<Self::View<'_>, DecodeError> {
        match split_header(bytes) {
            Ok((Endian::Little, body)) => {
                let body = Body::new(body, body.len()).map_err(whole::<Self>)?;
                Self::view(body)
            }
            Ok((Endian::Big, _)) => Err(whole::<Self>(DecodeFault::BigEndian)),
            Err(fault) => Err(whole::<Self>(fault)),
        }
    }
}

/// The proof that a body which `T::view` accepts lies in memory that starts with a valid `T`.
#[doc(hidden)]
pub struct PlainView<T>(PhantomData<fn(T) -> T>);

impl<T: Plain + Message> PlainView<T> {
    /// Creates the proof.
    ///
    /// # Safety
    /// [`Message::view`] of `T` is [`view_plain`](crate::view_plain).
    pub const unsafe fn new() -> Self {
        Self(PhantomData)
    }
}

/// The byte order and the body of what is on the wire.
///
/// # Errors
/// [`DecodeFault::Encapsulation`] if it does not start with the header of plain CDR.
pub fn split_header(bytes: &[u8]) -> Result<(Endian, &[u8]), DecodeFault> {
    match bytes {
        [0, 1, _, _, body @ ..] => Ok((Endian::Little, body)),
        [0, 0, _, _, body @ ..] => Ok((Endian::Big, body)),
        _ => {
            let byte = |index| bytes.get(index).copied().unwrap_or_default();
            Err(DecodeFault::Encapsulation { kind: [byte(0), byte(1)] })
        }
    }
}

/// A fault of a message as a whole.
#[cold]
fn whole<T: Message>(fault: DecodeFault) -> DecodeError {
    DecodeError { type_name: T::TYPE_NAME, path: FieldPath::EMPTY, offset: 0, fault }
}
