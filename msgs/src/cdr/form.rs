// SPDX-License-Identifier: MIT OR Apache-2.0
//! How a field is written. Most types are their own form; `WString` and `Bounded` distinguish definitions for which
//! Rust has only one type.

use core::marker::PhantomData;

use crate::cdr::{DecodeFault, EncodeError, EncodeFault, Endian, Fault, Reader, Writer};

/// How values of one type are written and read: for a `uint8[<=4]` it is `Bounded<Vec<u8>, 4>`, with the value
/// `Vec<u8>`.
#[diagnostic::on_unimplemented(
    message = "`{Self}` has no CDR form",
    note = "generate messages from their definitions, or use `#[derive(Message)]` for plain ones"
)]
pub trait Form: Sized {
    /// The Rust type of the value.
    type Value;

    /// The least length of a value in bytes, padding not counted. At least 1.
    const MIN_SIZE: usize;

    /// Where a value ends that is written at `at`, both in bytes from the start of the body.
    fn end(value: &Self::Value, at: usize) -> usize;

    /// Writes a value.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall. Linear in the length.
    ///
    /// # Errors
    /// [`EncodeError`] if it is longer than its bound or than the buffer.
    fn write(value: &Self::Value, writer: &mut Writer<'_>) -> Result<(), EncodeError>;

    /// Reads a value.
    ///
    /// # Errors
    /// [`Fault`] if the bytes are not a value.
    fn read(reader: &mut Reader<'_>) -> Result<Self::Value, Fault>;

    /// As [`end`](Self::end), for values one after the other.
    #[inline]
    fn end_all(values: &[Self::Value], at: usize) -> usize {
        values.iter().fold(at, |at, value| Self::end(value, at))
    }

    /// As [`write`](Self::write), for values one after the other.
    ///
    /// # Errors
    /// As there.
    #[inline]
    fn write_all(values: &[Self::Value], writer: &mut Writer<'_>) -> Result<(), EncodeError> {
        values.iter().try_for_each(|value| Self::write(value, writer))
    }

    /// As [`read`](Self::read), for `len` values one after the other. What it allocates at once is at most twice as
    /// large as what is left of the body.
    ///
    /// # Errors
    /// As there.
    fn read_vec(reader: &mut Reader<'_>, len: usize) -> Result<Vec<Self::Value>, Fault> {
        read_one_by_one::<Self>(reader, len)
    }

    /// As [`read_vec`](Self::read_vec), for a number of values known beforehand.
    ///
    /// # Errors
    /// As there.
    fn read_array<const N: usize>(reader: &mut Reader<'_>) -> Result<[Self::Value; N], Fault> {
        let end = DecodeFault::End { needed: N, left: reader.left() };
        Self::read_vec(reader, N)?.try_into().map_err(|_| reader.fault(end))
    }
}

#[doc(hidden)]
pub fn read_one_by_one<F: Form>(reader: &mut Reader<'_>, len: usize) -> Result<Vec<F::Value>, Fault> {
    reader.expect(len, F::MIN_SIZE)?;
    let size = size_of::<F::Value>().max(1);
    // The claimed length fits into what is left, and is allocated at once, unless values are much longer in memory than in CDR.
    let at_once = if size <= 2 * F::MIN_SIZE { len } else { len.min(reader.left() / size) };
    let mut values = Vec::with_capacity(at_once);
    for index in 0..len {
        values.push(F::read(reader).map_err(|fault| reader.at_index(fault, index))?);
    }
    Ok(values)
}

/// A form whose values have a length that can be bounded.
pub trait Bound: Form {
    /// The length that the bound limits: elements, or characters.
    fn count(value: &Self::Value) -> usize;

    /// As [`Form::read`], for at most `bound` elements or characters.
    ///
    /// # Errors
    /// As there; [`DecodeFault::Bound`] if it is longer.
    fn read_bounded(reader: &mut Reader<'_>, bound: usize) -> Result<Self::Value, Fault>;
}

/// The form of a `wstring`, whose value is a `String`.
#[derive(Debug)]
pub enum WString {}

/// The form of a string or sequence that is at most `N` characters or elements long.
#[derive(Debug)]
pub struct Bounded<F, const N: usize>(PhantomData<F>);

impl<F: Bound, const N: usize> Form for Bounded<F, N> {
    type Value = F::Value;
    const MIN_SIZE: usize = F::MIN_SIZE;

    #[inline]
    fn end(value: &F::Value, at: usize) -> usize {
        F::end(value, at)
    }

    #[inline]
    fn write(value: &F::Value, writer: &mut Writer<'_>) -> Result<(), EncodeError> {
        match F::count(value) {
            len if len > N => Err(EncodeError::new(EncodeFault::Bound { len, bound: N })),
            _ => F::write(value, writer),
        }
    }

    #[inline]
    fn read(reader: &mut Reader<'_>) -> Result<F::Value, Fault> {
        F::read_bounded(reader, N)
    }
}

impl<F: Form, const N: usize> Form for [F; N] {
    type Value = [F::Value; N];
    const MIN_SIZE: usize = N.saturating_mul(F::MIN_SIZE);

    #[inline]
    fn end(value: &[F::Value; N], at: usize) -> usize {
        F::end_all(value, at)
    }

    #[inline]
    fn write(value: &[F::Value; N], writer: &mut Writer<'_>) -> Result<(), EncodeError> {
        F::write_all(value, writer)
    }

    #[inline]
    fn read(reader: &mut Reader<'_>) -> Result<[F::Value; N], Fault> {
        F::read_array(reader)
    }
}

impl<F: Form> Form for Vec<F> {
    type Value = Vec<F::Value>;
    const MIN_SIZE: usize = 4;

    #[inline]
    fn end(value: &Self::Value, at: usize) -> usize {
        F::end_all(value, u32::end(&0, at))
    }

    #[inline]
    fn write(value: &Self::Value, writer: &mut Writer<'_>) -> Result<(), EncodeError> {
        writer.length(value.len())?;
        F::write_all(value, writer)
    }

    #[inline]
    fn read(reader: &mut Reader<'_>) -> Result<Self::Value, Fault> {
        Self::read_bounded(reader, usize::MAX)
    }
}

impl<F: Form> Bound for Vec<F> {
    #[inline]
    fn count(value: &Self::Value) -> usize {
        value.len()
    }

    fn read_bounded(reader: &mut Reader<'_>, bound: usize) -> Result<Self::Value, Fault> {
        match reader.length()? {
            len if len > bound => Err(reader.over_bound(len, bound)),
            len => F::read_vec(reader, len),
        }
    }
}

impl Form for String {
    type Value = Self;
    const MIN_SIZE: usize = 4;

    #[inline]
    fn end(value: &Self, at: usize) -> usize {
        u32::end(&0, at) + value.len() + 1
    }

    #[inline]
    fn write(value: &Self, writer: &mut Writer<'_>) -> Result<(), EncodeError> {
        writer.string(value)
    }

    #[inline]
    fn read(reader: &mut Reader<'_>) -> Result<Self, Fault> {
        Self::read_bounded(reader, usize::MAX)
    }
}

impl Bound for String {
    fn count(value: &Self) -> usize {
        value.chars().count()
    }

    fn read_bounded(reader: &mut Reader<'_>, bound: usize) -> Result<Self, Fault> {
        Ok(text(reader, bound)?.to_owned())
    }
}

impl Form for WString {
    type Value = String;
    const MIN_SIZE: usize = 4;

    fn end(value: &String, at: usize) -> usize {
        u32::end(&0, at) + 4 * value.encode_utf16().count()
    }

    fn write(value: &String, writer: &mut Writer<'_>) -> Result<(), EncodeError> {
        writer.length(value.encode_utf16().count())?;
        value.encode_utf16().try_for_each(|unit| writer.put(4, &u32::from(unit).to_le_bytes()))
    }

    fn read(reader: &mut Reader<'_>) -> Result<String, Fault> {
        Self::read_bounded(reader, usize::MAX)
    }
}

impl Bound for WString {
    fn count(value: &String) -> usize {
        value.chars().count()
    }

    fn read_bounded(reader: &mut Reader<'_>, bound: usize) -> Result<String, Fault> {
        let len = reader.length()?;
        let start = reader.position();
        let bytes = reader.take(1, len.saturating_mul(4))?;
        reader.add_slack();
        let mut all_units = true;
        let units = bytes.chunks_exact(4).map(|unit| {
            let unit = unit.try_into().unwrap_or_default();
            let unit = match reader.endian() {
                Endian::Little => u32::from_le_bytes(unit),
                Endian::Big => u32::from_be_bytes(unit),
            };
            all_units &= u16::try_from(unit).is_ok();
            unit as u16
        });
        let text: Result<String, _> = char::decode_utf16(units).collect();
        let text = text.ok().filter(|_| all_units).ok_or(Fault::new(start, DecodeFault::Unicode))?;
        check(&text, bound, start)?;
        Ok(text)
    }
}

/// A string of at most `bound` characters.
#[inline(always)] // 5 % of a message of short strings
pub(crate) fn text<'a>(reader: &mut Reader<'a>, bound: usize) -> Result<&'a str, Fault> {
    let len = reader.length()?;
    let start = reader.position();
    let text = match reader.take(1, len)?.split_last() {
        Some((0, text)) => text,
        // Some writers give an empty string no zero byte.
        None => &[],
        Some(_) => return Err(reader.fault(DecodeFault::Terminator)),
    };
    let text = core::str::from_utf8(text)
        .map_err(|error| Fault::new(start + error.valid_up_to(), DecodeFault::Unicode))?;
    check(text, bound, start)?;
    Ok(text)
}

/// A text has no fewer bytes than characters, so those of a short text need not be counted.
fn check(text: &str, bound: usize, start: usize) -> Result<(), Fault> {
    if text.len() > bound && text.chars().count() > bound {
        let len = text.chars().count();
        return Err(Fault::new(start, DecodeFault::Bound { len, bound }));
    }
    Ok(())
}
