// SPDX-License-Identifier: MIT OR Apache-2.0

use core::any::type_name;

use crate::cdr::{
    DecodeError, DecodeFault, EncodeError, Endian, FieldPath, Form, Reader, SLACK, Writer, fits_stack,
};
use crate::{Body, Invalid, Message, Shape};

/// A type of fixed size whose C layout is its XCDR1 little-endian layout: a reference to the bytes is a reference to
/// the value.
///
/// In XCDR1 a primitive is aligned to its own size (at most 8), counted from the start of the body; structs and arrays
/// add no alignment of their own, and nothing follows the last primitive. C differs in two places: it aligns a nested
/// struct to its largest field, and it pads a nested struct at its end. Derived types are checked for both at compile
/// time. An enum is written as the integer of its `repr`, a `char` as `uint32`.
///
/// # Safety
/// Implement it with `#[derive(Message)]`. By hand, all of this must hold:
///
/// - Placed at a multiple of 8, every primitive of the type lies where XCDR1 places it, and
///   `align_of::<Self>() <= 8`.
/// - `CDR_SIZE` is where the last primitive ends: `size_of::<Self>()` without the trailing padding.
/// - `FIRST_ALIGN` is the alignment of the first primitive.
/// - `CONTENT_SIZE` is the sum of the sizes of all its primitives; the difference to `size_of::<Self>()` is
///   padding.
/// - If [`validate`](Plain::validate) returns `Ok` for at least `CDR_SIZE` bytes, these are a valid `Self`; with
///   `ALWAYS_VALID`, all initialised bytes are.
/// - **Zeroed bytes are a valid `Self`**, so that a loan of fresh shared memory can be handed out as `&mut Self`
///   without touching it. (References, `NonZero` integers and enums without a variant 0 are therefore excluded.)
#[diagnostic::on_unimplemented(
    message = "`{Self}` is not a plain type: its bytes in memory are not its CDR",
    label = "not a plain type",
    note = "plain are u8..u64, i8..i64, f32, f64, bool, char, arrays of these, and structs and enums with `#[derive(Message)]`",
    note = "text of limited length can be a `[u8; N]` with a length field"
)]
pub unsafe trait Plain: Form<Value = Self> + Copy + Send + Sync + 'static {
    /// Bytes from the start of the value to the end of its last primitive.
    ///
    /// `CDR_SIZE <= size_of::<Self>() <= CDR_SIZE.next_multiple_of(8)`: a body stored in a buffer rounded up to
    /// 8 bytes can be referenced.
    const CDR_SIZE: usize;

    /// The alignment of the first primitive in bytes: 1, 2, 4 or 8.
    const FIRST_ALIGN: usize;

    /// Whether any initialised bytes are a valid value, so that there is nothing to validate.
    const ALWAYS_VALID: bool;

    /// Bytes of all its primitives: [`CDR_SIZE`](Plain::CDR_SIZE) without the padding between them.
    const CONTENT_SIZE: usize;

    /// The structure of the type.
    #[doc(hidden)]
    const SHAPE: Shape;

    /// Whether any number of values can lie one after the other in a body, wherever the first one does: there is no
    /// padding before, within or after it.
    #[doc(hidden)]
    const DENSE: bool = Self::CONTENT_SIZE == size_of::<Self>() && Self::FIRST_ALIGN == align_of::<Self>();

    /// Checks that `bytes` hold a valid value: each `bool` is 0 or 1, each `char` a Unicode scalar value, each enum
    /// one of its variants. Bytes past `CDR_SIZE` are not looked at; alignment does not matter.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall. Constant for [`ALWAYS_VALID`](Plain::ALWAYS_VALID) types, otherwise linear
    /// in the number of fields and array elements that can be invalid.
    ///
    /// # Errors
    /// [`Invalid::Length`] if a field that is looked at lies past the end (numbers are not looked at: the caller has
    /// checked the length), [`Invalid::Value`] for the first invalid field.
    fn validate(bytes: &[u8]) -> Result<(), Invalid>;

    /// Writes the primitives to the start of `out`, which holds at least `CDR_SIZE` bytes; leaves padding as it is.
    /// Call [`write_cdr`] instead.
    #[doc(hidden)]
    fn write_fields(&self, out: &mut [u8]);

    /// Zeroes the padding between the primitives of the value in `memory`, which Rust leaves unspecified when a value is
    /// assigned: what is sent must hold no rest of other data.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall. Nothing to do if [`CONTENT_SIZE`](Plain::CONTENT_SIZE) is
    /// [`CDR_SIZE`](Plain::CDR_SIZE).
    fn clear_padding(memory: &mut [u8]);
}

/// The value that `bytes` hold, in place.
///
/// `bytes` is at least `size_of::<T>()` long, trailing padding included, and starts at a multiple of
/// `align_of::<T>()`. Bytes beyond are ignored.
///
/// # Real-time
/// Wait-free; no allocation; no syscall. Constant for [`Plain::ALWAYS_VALID`] types, otherwise as [`Plain::validate`].
///
/// # Errors
/// [`Invalid`] if the bytes are too few, misaligned, or no valid `T`.
#[inline]
pub fn from_bytes<T: Plain>(bytes: &[u8]) -> Result<&T, Invalid> {
    const { assert!(align_of::<T>() <= 8 && T::CDR_SIZE <= size_of::<T>()) }
    if bytes.len() < size_of::<T>() {
        return Err(Invalid::Length {
            type_name: type_name::<T>(),
            needed: size_of::<T>(),
            len: bytes.len(),
        });
    }
    let value = bytes.as_ptr().cast::<T>();
    if !value.is_aligned() {
        return Err(Invalid::Alignment { type_name: type_name::<T>(), align: align_of::<T>() });
    }
    if !T::ALWAYS_VALID {
        T::validate(bytes)?;
    }
    // SAFETY: in bounds, aligned and initialised as just checked and by `&[u8]`; a valid `T` by the contract of
    // `Plain`; the result borrows `bytes`, and `T: Plain` has no way to change it through `&T`.
    Ok(unsafe { &*value })
}

/// Writes the CDR body of `value` to the start of `out` and returns its length, [`Plain::CDR_SIZE`].
///
/// Copies field by field and zeroes the padding between fields: reading a struct as bytes would read its padding,
/// which is not initialised. On the hot path write into the loan instead.
///
/// # Real-time
/// Wait-free; no allocation; no syscall. Linear in the number of primitives.
///
/// # Errors
/// [`Invalid::Length`] if `out` is shorter than `CDR_SIZE`; nothing is written then.
pub fn write_cdr<T: Plain>(value: &T, out: &mut [u8]) -> Result<usize, Invalid> {
    let len = out.len();
    let Some(body) = out.get_mut(..T::CDR_SIZE) else {
        return Err(Invalid::Length { type_name: type_name::<T>(), needed: T::CDR_SIZE, len });
    };
    body.fill(0);
    value.write_fields(body);
    Ok(T::CDR_SIZE)
}

/// Writes values without padding as they lie in memory. `None` for other types, which are written field by field.
#[doc(hidden)]
#[inline]
pub fn write_dense<T: Plain>(values: &[T], writer: &mut Writer<'_>) -> Option<Result<(), EncodeError>> {
    if !T::DENSE {
        return None;
    }
    if values.is_empty() {
        return Some(Ok(()));
    }
    // SAFETY: the bytes of initialised values without padding, for as long as they are borrowed.
    let bytes = unsafe { core::slice::from_raw_parts(values.as_ptr().cast::<u8>(), size_of_val(values)) };
    Some(writer.put(T::FIRST_ALIGN, bytes))
}

/// Reads a value of a type without padding for which any bytes are valid, as it lies in memory. `None` for other types,
/// which are read field by field, and if the bytes end too early: the fields then say where.
#[doc(hidden)]
#[inline]
pub fn read_dense<T: Plain>(reader: &mut Reader<'_>) -> Option<T> {
    if !T::DENSE || !T::ALWAYS_VALID || reader.endian() != Endian::Little {
        return None;
    }
    let bytes = try_take(reader, T::FIRST_ALIGN, size_of::<T>())?;
    // SAFETY: `bytes` are as long as a `T`, any initialised bytes are one, and `T: Copy`.
    Some(unsafe { bytes.as_ptr().cast::<T>().read_unaligned() })
}

/// As [`read_dense`], for `len` values.
#[doc(hidden)]
pub fn read_dense_vec<T: Plain>(reader: &mut Reader<'_>, len: usize) -> Option<Vec<T>> {
    if !T::DENSE || !T::ALWAYS_VALID || reader.endian() != Endian::Little || len == 0 {
        return None;
    }
    let bytes = try_take(reader, T::FIRST_ALIGN, len.checked_mul(size_of::<T>())?)?;
    let mut values = Vec::<T>::with_capacity(len);
    // SAFETY: `bytes` are as long as `len` values, so many fit into the new vector, and any initialised bytes are a `T`.
    unsafe {
        core::ptr::copy_nonoverlapping(bytes.as_ptr(), values.as_mut_ptr().cast(), bytes.len());
        values.set_len(len);
    }
    Some(values)
}

/// As [`Reader::take`]; if the bytes end too early, the reader stays where it was.
#[inline]
fn try_take<'a>(reader: &mut Reader<'a>, align: usize, len: usize) -> Option<&'a [u8]> {
    let start = reader.position();
    let bytes = reader.take(align, len).ok();
    if bytes.is_none() {
        reader.skip_to(start);
    }
    bytes
}

/// Where a value that starts at `at` ends; `None` for types with padding.
#[doc(hidden)]
#[inline]
pub const fn dense_end<T: Plain>(at: usize) -> Option<usize> {
    if T::DENSE { Some(at.next_multiple_of(T::FIRST_ALIGN) + size_of::<T>()) } else { None }
}

/// Checks a whole body of a plain type. If there is a fault, a second pass field by field finds its position.
///
/// # Errors
/// As [`Message::view`].
#[doc(hidden)]
#[inline]
pub fn view_plain<T: Plain + Message>(body: Body<'_>) -> Result<&T, DecodeError> {
    let len = body.bytes().len();
    match from_bytes(body.memory()) {
        Ok(value) if len >= T::CDR_SIZE && len <= T::CDR_SIZE + SLACK => Ok(value),
        _ => Err(explain::<T>(body)),
    }
}

/// What is wrong with a body. A small message says which field, because it is read as an owned one; a large one says at
/// which byte, since it may be larger than the stack.
#[cold]
fn explain<T: Plain + Message>(body: Body<'_>) -> DecodeError {
    let bytes = body.bytes();
    let error =
        |offset, fault| DecodeError { type_name: T::TYPE_NAME, path: FieldPath::EMPTY, offset, fault };
    if fits_stack::<T>()
        && let Some(error) = field_error::<T>(bytes)
    {
        return error;
    }
    if bytes.len() < T::CDR_SIZE {
        return error(0, DecodeFault::End { needed: T::CDR_SIZE, left: bytes.len() });
    }
    if bytes.len() > T::CDR_SIZE + SLACK {
        return error(T::CDR_SIZE, DecodeFault::Trailing { len: bytes.len() - T::CDR_SIZE, most: SLACK });
    }
    match T::validate(bytes) {
        Err(Invalid::Value { offset, value, .. }) => {
            error(offset, DecodeFault::Value { value, type_name: &"value of its field" })
        }
        // The message is whole, but its trailing padding is missing.
        _ => error(0, DecodeFault::End { needed: size_of::<T>(), left: body.memory().len() }),
    }
}

/// Not inlined: a value that does not fit must not get space on the caller's stack either.
#[inline(never)]
fn field_error<T: Message>(bytes: &[u8]) -> Option<DecodeError> {
    T::decode(bytes, Endian::Little).err()
}
