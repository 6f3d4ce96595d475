// SPDX-License-Identifier: MIT OR Apache-2.0
//! Reading in place: what a getter returns for each form.

use crate::cdr::{Bound, Bounded, DecodeError, DecodeFault, Endian, Fault, Form, Reader, WStr, WString};
use crate::{Body, Message, Plain};

/// A form that is read in place: a number by value; text, sequences of numbers and messages of one layout as references
/// into the body; everything else as views that decode on access.
///
/// The body is little-endian and starts at a multiple of 8 bytes: see [`Body`](crate::Body).
pub trait View: Form {
    /// What reads one value.
    type Ref<'a>: Copy + Send + Sync;
    /// What reads a sequence of them.
    type List<'a>: Copy + Send + Sync;
    /// What reads an array of them.
    type Array<'a, const N: usize>: Copy + Send + Sync;

    /// Checks a value.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall. See [`Message::view`](crate::Message::view).
    ///
    /// # Errors
    /// [`Fault`] if the bytes are not a value.
    fn view_value<'a>(reader: &mut Reader<'a>) -> Result<Self::Ref<'a>, Fault>;

    /// As [`view_value`](Self::view_value), for `len` values one after the other.
    ///
    /// # Errors
    /// As there.
    fn view_list<'a>(reader: &mut Reader<'a>, len: usize) -> Result<Self::List<'a>, Fault>;

    /// As [`view_list`](Self::view_list), for a number of values known beforehand.
    ///
    /// # Errors
    /// As there.
    fn view_array<'a, const N: usize>(reader: &mut Reader<'a>) -> Result<Self::Array<'a, N>, Fault>;

    /// The value that a view reads.
    fn own(view: Self::Ref<'_>) -> Self::Value;

    /// As [`own`](Self::own), for a sequence.
    fn own_list(view: Self::List<'_>) -> Vec<Self::Value>;

    /// As [`own`](Self::own), for an array.
    fn own_array<const N: usize>(view: Self::Array<'_, N>) -> [Self::Value; N]
    where
        Self::Value: Default;
}

/// A form that is read in place and whose length can be bounded.
pub trait BoundView: View + Bound {
    /// As [`View::view_value`], for at most `bound` elements or characters.
    ///
    /// # Errors
    /// As there; [`DecodeFault::Bound`] if it is longer.
    fn view_bounded<'a>(reader: &mut Reader<'a>, bound: usize) -> Result<Self::Ref<'a>, Fault>;
}

/// Lists of forms whose values differ in length, or are padded: read one by one.
#[doc(hidden)]
#[macro_export]
macro_rules! viewed_one_by_one {
    () => {
        type List<'a> = $crate::cdr::Seq<'a, Self>;
        type Array<'a, const LEN: usize> = $crate::cdr::Seq<'a, Self>;

        #[inline]
        fn view_list<'a>(
            reader: &mut $crate::cdr::Reader<'a>,
            len: usize,
        ) -> $crate::cdr::Decoded<Self::List<'a>> {
            $crate::cdr::Seq::check(reader, len)
        }

        #[inline]
        fn view_array<'a, const LEN: usize>(
            reader: &mut $crate::cdr::Reader<'a>,
        ) -> $crate::cdr::Decoded<Self::Array<'a, LEN>> {
            $crate::cdr::Seq::check(reader, LEN)
        }

        fn own_list(view: $crate::cdr::Seq<'_, Self>) -> ::std::vec::Vec<Self::Value> {
            view.iter().map(Self::own).collect()
        }

        fn own_array<const LEN: usize>(view: $crate::cdr::Seq<'_, Self>) -> [Self::Value; LEN]
        where
            Self::Value: ::core::default::Default,
        {
            let mut values = view.iter();
            ::core::array::from_fn(|_| values.next().map(Self::own).unwrap_or_default())
        }
    };
}

macro_rules! numbers {
    ($($type:ty)*) => {$(
        impl View for $type {
            type Ref<'a> = Self;
            crate::dense_struct!(@lists);

            #[inline]
            fn view_value<'a>(reader: &mut Reader<'a>) -> Result<Self, Fault> {
                <Self as Form>::read(reader)
            }

            #[inline]
            fn view_list<'a>(reader: &mut Reader<'a>, len: usize) -> Result<&'a [Self], Fault> {
                if len == 0 && size_of::<Self>() == 8 {
                    reader.add_slack();
                }
                slice(reader, len)
            }

            #[inline]
            fn view_array<'a, const N: usize>(reader: &mut Reader<'a>) -> Result<&'a [Self; N], Fault> {
                array(reader, slice)
            }

            #[inline]
            fn own(view: Self) -> Self {
                view
            }
        }
    )*};
}

numbers!(bool i8 u8 i16 u16 i32 u32 i64 u64 f32 f64);

/// Numbers one after the other, in place.
#[inline]
pub(crate) fn slice<'a, T: Plain>(reader: &mut Reader<'a>, len: usize) -> Result<&'a [T], Fault> {
    let start = reader.position().next_multiple_of(T::FIRST_ALIGN);
    values(reader, len).map_err(|fault| match fault.fault {
        DecodeFault::Value { .. } => {
            // Reading the value as an owned one gives the fault.
            reader.skip_to(fault.offset);
            let index = fault.offset.saturating_sub(start) / size_of::<T>();
            let fault = T::read(reader).err().unwrap_or(fault);
            reader.at_index(fault, index)
        }
        _ => fault,
    })
}

/// A message in place.
#[doc(hidden)]
#[inline]
pub fn one<'a, T: Plain>(reader: &mut Reader<'a>) -> Result<&'a T, Fault> {
    let start = reader.position();
    match values(reader, 1) {
        Ok([value, ..]) => Ok(value),
        Ok([]) => Err(reader.fault(DecodeFault::End { needed: size_of::<T>(), left: 0 })),
        Err(fault) => {
            reader.skip_to(start);
            Err(first_fault::<T>(reader).unwrap_or(fault))
        }
    }
}

/// Messages one after the other, in place.
#[doc(hidden)]
#[inline]
pub fn list<'a, T: Plain>(reader: &mut Reader<'a>, len: usize) -> Result<&'a [T], Fault> {
    let start = reader.position();
    values(reader, len).map_err(|fault| explain::<T>(reader, start, len, fault))
}

/// An array of numbers or messages in place; `read` reads any number of them.
#[doc(hidden)]
#[inline]
pub fn array<'a, T, const N: usize>(
    reader: &mut Reader<'a>,
    read: impl FnOnce(&mut Reader<'a>, usize) -> Result<&'a [T], Fault>,
) -> Result<&'a [T; N], Fault> {
    let start = reader.position();
    read(reader, N)?
        .first_chunk()
        .ok_or_else(|| Fault::new(start, DecodeFault::End { needed: N, left: reader.left() }))
}

/// Whether a value may be put on the stack, just to find out what is wrong with it.
pub(crate) const fn fits_stack<T>() -> bool {
    size_of::<T>() <= 4096
}

/// What is wrong with messages that cannot be read in place: reading them as owned ones gives the field.
#[cold]
fn explain<T: Plain>(reader: &mut Reader<'_>, start: usize, len: usize, fault: Fault) -> Fault {
    reader.skip_to(start);
    if let Err(fault) = reader.expect(len, T::MIN_SIZE) {
        return fault;
    }
    if fits_stack::<T>() {
        for index in 0..len {
            if let Some(fault) = first_fault::<T>(reader) {
                return reader.at_index(fault, index);
            }
        }
    }
    fault
}

/// What is wrong with a message, read as an owned one; `None` as well if it is too large for that. Not inlined: reading in
/// place needs no stack for the message.
#[cold]
fn first_fault<T: Plain>(reader: &mut Reader<'_>) -> Option<Fault> {
    #[inline(never)]
    fn read<T: Plain>(reader: &mut Reader<'_>) -> Option<Fault> {
        T::read(reader).err()
    }
    if fits_stack::<T>() { read::<T>(reader) } else { None }
}

/// Values one after the other, in place. There is no padding between or within them, so that their memory is their CDR
/// wherever the first lies. The fault of an invalid value only has its start.
#[inline]
fn values<'a, T: Plain>(reader: &mut Reader<'a>, len: usize) -> Result<&'a [T], Fault> {
    const { assert!(T::DENSE, "elements with padding are read one by one") }
    if len == 0 {
        return Ok(&[]);
    }
    let bytes = reader.take(T::FIRST_ALIGN, len.saturating_mul(size_of::<T>()))?;
    let start = reader.position() - bytes.len();
    let values = bytes.as_ptr().cast::<T>();
    if !values.is_aligned() {
        return Err(Fault::new(start, DecodeFault::Alignment { align: align_of::<T>() }));
    }
    if !T::ALWAYS_VALID
        && let Some(index) =
            bytes.chunks_exact(size_of::<T>()).position(|element| T::validate(element).is_err())
    {
        let at = start + index * size_of::<T>();
        return Err(Fault::new(at, DecodeFault::Value { value: 0, type_name: &"value of this type" }));
    }
    // SAFETY: `len` elements are within `bytes`, aligned, initialised and valid as just checked; the result borrows what
    // `bytes` does.
    Ok(unsafe { core::slice::from_raw_parts(values, len) })
}

/// Checks a whole body.
///
/// # Errors
/// As [`Message::view`].
#[doc(hidden)]
#[inline]
pub fn view_message<T: Message + View>(body: Body<'_>) -> Result<T::Ref<'_>, DecodeError> {
    let mut reader = Reader::new(body.bytes(), Endian::Little);
    let checked = T::view_value(&mut reader).and_then(|view| reader.finish().map(|()| view));
    checked.map_err(|fault| reader.error(fault, T::TYPE_NAME))
}

impl<F: View> View for Vec<F> {
    type Ref<'a> = F::List<'a>;
    crate::viewed_one_by_one!();

    #[inline]
    fn view_value<'a>(reader: &mut Reader<'a>) -> Result<F::List<'a>, Fault> {
        Self::view_bounded(reader, usize::MAX)
    }

    fn own(view: F::List<'_>) -> Self::Value {
        F::own_list(view)
    }
}

impl<F: View> BoundView for Vec<F> {
    #[inline]
    fn view_bounded<'a>(reader: &mut Reader<'a>, bound: usize) -> Result<F::List<'a>, Fault> {
        match reader.length()? {
            len if len > bound => Err(reader.over_bound(len, bound)),
            len => F::view_list(reader, len),
        }
    }
}

impl<F: View<Value: Default>, const N: usize> View for [F; N] {
    type Ref<'a> = F::Array<'a, N>;
    crate::viewed_one_by_one!();

    #[inline]
    fn view_value<'a>(reader: &mut Reader<'a>) -> Result<F::Array<'a, N>, Fault> {
        F::view_array(reader)
    }

    fn own(view: F::Array<'_, N>) -> Self::Value {
        F::own_array(view)
    }
}

impl<F: BoundView, const N: usize> View for Bounded<F, N> {
    type Ref<'a> = F::Ref<'a>;
    crate::viewed_one_by_one!();

    #[inline]
    fn view_value<'a>(reader: &mut Reader<'a>) -> Result<F::Ref<'a>, Fault> {
        F::view_bounded(reader, N)
    }

    fn own(view: F::Ref<'_>) -> Self::Value {
        F::own(view)
    }
}

impl View for String {
    type Ref<'a> = &'a str;
    crate::viewed_one_by_one!();

    #[inline]
    fn view_value<'a>(reader: &mut Reader<'a>) -> Result<&'a str, Fault> {
        Self::view_bounded(reader, usize::MAX)
    }

    fn own(view: &str) -> Self {
        view.to_owned()
    }
}

impl BoundView for String {
    #[inline]
    fn view_bounded<'a>(reader: &mut Reader<'a>, bound: usize) -> Result<&'a str, Fault> {
        crate::cdr::form::text(reader, bound)
    }
}

impl View for WString {
    type Ref<'a> = WStr<'a>;
    crate::viewed_one_by_one!();

    #[inline]
    fn view_value<'a>(reader: &mut Reader<'a>) -> Result<WStr<'a>, Fault> {
        Self::view_bounded(reader, usize::MAX)
    }

    fn own(view: WStr<'_>) -> String {
        view.chars().collect()
    }
}

impl BoundView for WString {
    fn view_bounded<'a>(reader: &mut Reader<'a>, bound: usize) -> Result<WStr<'a>, Fault> {
        let len = reader.length()?;
        let start = reader.position();
        let text = WStr::new(slice(reader, len)?).ok_or(Fault::new(start, DecodeFault::Unicode))?;
        reader.add_slack();
        match text.chars().count() {
            len if len > bound => Err(Fault::new(start, DecodeFault::Bound { len, bound })),
            _ => Ok(text),
        }
    }
}
