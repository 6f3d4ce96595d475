// SPDX-License-Identifier: MIT OR Apache-2.0
//! Writing in place: lengths first, then each field where it lies.
//!
//! [`fill`] divides a body among one *piece* per field; each is written through its own methods, in any order, and none
//! can be forgotten: a piece knows whether it was set.

mod carver;
mod elements;
pub(super) mod numbers;
#[cfg(feature = "sizes_of_values")]
mod sizes;
mod text;

use crate::cdr::{Bound, Bounded, EncodeError, EncodeFault, FieldError, Form};
use crate::{BODY_ALIGN, Message};
pub use carver::Carver;
pub use elements::Elements;
pub use numbers::{Field, Slice};
#[cfg(feature = "sizes_of_values")]
#[doc(hidden)]
pub use sizes::{Leaked, SizeSource, size_list};
pub use text::{Text, WText};

/// A form that is written in place.
pub trait Fill: Form {
    /// The lengths that must be known first: `usize` for strings, in bytes of UTF-8 (`wstring`: in units of UTF-16), and
    /// for sequences of numbers, in elements; a struct for messages; a slice of these for sequences of them; `()` if
    /// there is none.
    type Sizes<'s>: Copy + Default + Send + Sync + 's;
    /// The sizes of a sequence.
    type ListSizes<'s>: Copy + Default + Send + Sync + 's;
    /// The sizes of an array.
    type ArraySizes<'s>: Copy + Default + Send + Sync + 's;
    /// What writes one value.
    type Writer<'a, 's>: Piece<Self::Value>;
    /// What writes a sequence.
    type ListWriter<'a, 's>: Piece<Vec<Self::Value>>;
    /// What writes an array.
    type ArrayWriter<'a, 's, const N: usize>: Piece<[Self::Value; N]>;

    crate::sizes_of_values! {
        /// The sizes of a value, for tests: what they refer to is never freed.
        #[doc(hidden)]
        fn sizes_of(value: &Self::Value) -> Self::Sizes<'static> {
            Self::sizes_from(Some(value), &mut crate::cdr::Leaked)
        }

        /// The sizes that `source` gives, for tests.
        #[doc(hidden)]
        fn sizes_from<'s>(
            value: Option<&Self::Value>,
            source: &mut impl crate::cdr::SizeSource<'s>,
        ) -> Self::Sizes<'s>;

        /// As [`sizes_from`](Self::sizes_from), for a sequence.
        #[doc(hidden)]
        fn list_sizes_from<'s>(
            values: Option<&[Self::Value]>,
            source: &mut impl crate::cdr::SizeSource<'s>,
        ) -> Self::ListSizes<'s>;

        /// As [`sizes_from`](Self::sizes_from), for an array.
        #[doc(hidden)]
        fn array_sizes_from<'s>(
            values: Option<&[Self::Value]>,
            source: &mut impl crate::cdr::SizeSource<'s>,
        ) -> Self::ArraySizes<'s>;
    }

    /// Where a value of these lengths ends that starts at `at`, both in bytes from the start of the body.
    fn sized_end(sizes: Self::Sizes<'_>, at: usize) -> usize;

    /// As [`sized_end`](Self::sized_end), for a sequence, its own length not counted.
    fn sized_list_end(sizes: Self::ListSizes<'_>, at: usize) -> usize;

    /// As [`sized_end`](Self::sized_end), for an array of `len`.
    fn sized_array_end(sizes: Self::ArraySizes<'_>, len: usize, at: usize) -> usize;

    /// Takes the memory of a value and writes the lengths into it. (`'s: 's` makes the lifetime early-bound for every
    /// implementation, also where its sizes do not have it.)
    ///
    /// # Errors
    /// [`EncodeError`] if a length is greater than its bound or the memory too short.
    fn carve<'a, 's: 's>(
        sizes: Self::Sizes<'s>,
        carver: &mut Carver<'a>,
    ) -> Result<Self::Writer<'a, 's>, EncodeError>;

    /// As [`carve`](Self::carve), for a sequence of at most `bound`, its own length included.
    ///
    /// # Errors
    /// As there.
    fn carve_list<'a, 's: 's>(
        sizes: Self::ListSizes<'s>,
        bound: usize,
        carver: &mut Carver<'a>,
    ) -> Result<Self::ListWriter<'a, 's>, EncodeError>;

    /// As [`carve`](Self::carve), for an array.
    ///
    /// # Errors
    /// As there.
    fn carve_array<'a, 's: 's, const N: usize>(
        sizes: Self::ArraySizes<'s>,
        carver: &mut Carver<'a>,
    ) -> Result<Self::ArrayWriter<'a, 's, N>, EncodeError>;
}

/// The writer of a field, or of a message.
pub trait Piece<V> {
    /// Whether everything was set.
    ///
    /// # Errors
    /// [`WriteFault::Unset`] with the first field that was not.
    fn check(&self) -> Result<(), WriteError>;

    /// Sets what was not set yet: to `value`, or to the default of its type. A sequence of another length gets the
    /// defaults of its elements; text of another length stays unset.
    fn default_rest(&mut self, value: Option<&V>);
}

/// A form with a length that can be bounded.
pub trait BoundFill: Fill {
    /// As [`Fill::carve`], for at most `bound` elements or characters.
    ///
    /// # Errors
    /// As there.
    fn carve_bounded<'a, 's: 's>(
        sizes: Self::Sizes<'s>,
        bound: usize,
        carver: &mut Carver<'a>,
    ) -> Result<Self::Writer<'a, 's>, EncodeError>;
}

/// Why a message could not be written in place.
pub type WriteError = FieldError<WriteFault>;

/// What is wrong with a message that is written in place.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum WriteFault {
    /// A field was not written.
    #[error("it was not set: set it, or give the rest its defaults with `default_rest`")]
    Unset,
    /// A text or list does not have the length that was stated.
    #[error("its length is {len}, but {stated} was stated in the sizes: state the one it has")]
    Length {
        /// The length given.
        len: usize,
        /// The one stated before.
        stated: usize,
    },
    /// The elements of a list were written before, one by one or by `default_rest`.
    #[error("its elements were written before: set them once, and the rest with `default_rest` after them")]
    Again,
    /// What was written is not a value of the type: its writer was replaced by one of another memory.
    #[error("it was not written where it lies: set it through the writer that is passed in")]
    Elsewhere,
    /// The stated lengths are not allowed, or the memory is too short.
    #[error(transparent)]
    Encode(EncodeFault),
}

impl From<EncodeError> for WriteError {
    fn from(EncodeError { type_name, field, fault }: EncodeError) -> Self {
        Self { type_name, field, fault: WriteFault::Encode(fault) }
    }
}

/// The length in bytes of a body with these lengths.
///
/// # Real-time
/// Wait-free; no allocation; no syscall. Linear in the number of fields and of elements with sizes of their own.
pub fn sized_len<T: Fill>(sizes: T::Sizes<'_>) -> usize {
    T::sized_end(sizes, 0)
}

/// Writes a body in place: divides `memory` by the lengths `sizes`, lets `write` set the fields, and checks that each was
/// set. Returns the length of the body, [`sized_len`].
///
/// The parts of a sequence that were not written keep the previous content of `memory`.
///
/// # Real-time
/// Wait-free but for `write`; no allocation; no syscall. Linear in the number of fields.
///
/// # Errors
/// [`WriteError`]: a length over its bound, memory too short or not at a multiple of [`BODY_ALIGN`], an error of
/// `write`, a field that was not set.
pub fn fill<'s, T: Message + Fill>(
    sizes: T::Sizes<'s>,
    memory: &mut [u8],
    write: impl for<'a> FnOnce(&mut T::Writer<'a, 's>) -> Result<(), WriteError>,
) -> Result<usize, WriteError> {
    let here = |error: WriteError| error.within(T::TYPE_NAME, "");
    if memory.as_ptr().align_offset(BODY_ALIGN) != 0 {
        return Err(here(WriteError::new(WriteFault::Encode(EncodeFault::Alignment { align: BODY_ALIGN }))));
    }
    let mut carver = Carver::new(memory, 0);
    let mut writer = T::carve(sizes, &mut carver).map_err(|error| here(error.into()))?;
    write(&mut writer).map_err(here)?;
    writer.check().map_err(here)?;
    Ok(carver.position())
}

/// The next multiple of `align`. The sum of stated lengths may be any number: beyond `usize` it is `usize::MAX`, which no memory has.
#[inline]
fn aligned(at: usize, align: usize) -> usize {
    at.checked_next_multiple_of(align).unwrap_or(usize::MAX)
}

#[inline]
fn length_end(at: usize) -> usize {
    aligned(at, 4).saturating_add(4)
}

/// The sizes and writers of lists of forms that are written one by one.
#[doc(hidden)]
#[macro_export]
macro_rules! one_by_one {
    () => {
        type ListSizes<'s> = &'s [Self::Sizes<'s>];
        type ArraySizes<'s> = &'s [Self::Sizes<'s>];
        type ListWriter<'a, 's> = $crate::cdr::Elements<'a, 's, Self>;
        type ArrayWriter<'a, 's, const LEN: usize> = $crate::cdr::Elements<'a, 's, Self>;

        $crate::sizes_of_values! {
            fn list_sizes_from<'s>(
                values: ::core::option::Option<&[Self::Value]>,
                source: &mut impl $crate::cdr::SizeSource<'s>,
            ) -> Self::ListSizes<'s> {
                $crate::cdr::size_list(source, values, Self::sizes_from)
            }
            fn array_sizes_from<'s>(
                values: ::core::option::Option<&[Self::Value]>,
                source: &mut impl $crate::cdr::SizeSource<'s>,
            ) -> Self::ArraySizes<'s> {
                $crate::cdr::size_list(source, values, Self::sizes_from)
            }
        }

        #[inline]
        fn sized_list_end(sizes: &[Self::Sizes<'_>], at: usize) -> usize {
            $crate::cdr::Elements::<Self>::end(sizes, sizes.len(), at)
        }

        #[inline]
        fn sized_array_end(sizes: &[Self::Sizes<'_>], len: usize, at: usize) -> usize {
            $crate::cdr::Elements::<Self>::end(sizes, len, at)
        }

        #[inline]
        fn carve_list<'a, 's: 's>(
            sizes: &'s [Self::Sizes<'s>],
            bound: usize,
            carver: &mut $crate::cdr::Carver<'a>,
        ) -> $crate::cdr::Encoded<$crate::cdr::Elements<'a, 's, Self>> {
            carver.length(sizes.len(), bound)?;
            $crate::cdr::Elements::carve(sizes, sizes.len(), carver)
        }

        #[inline]
        fn carve_array<'a, 's: 's, const LEN: usize>(
            sizes: &'s [Self::Sizes<'s>],
            carver: &mut $crate::cdr::Carver<'a>,
        ) -> $crate::cdr::Encoded<$crate::cdr::Elements<'a, 's, Self>> {
            $crate::cdr::Elements::carve(sizes, LEN, carver)
        }
    };
}

impl<F: Fill> Fill for Vec<F> {
    type Sizes<'s> = F::ListSizes<'s>;
    type Writer<'a, 's> = F::ListWriter<'a, 's>;
    crate::one_by_one!();

    crate::sizes_of_values! {
        fn sizes_from<'s>(
            value: Option<&Self::Value>,
            source: &mut impl crate::cdr::SizeSource<'s>,
        ) -> Self::Sizes<'s> {
            F::list_sizes_from(value.map(|value| &value[..]), source)
        }
    }

    #[inline]
    fn sized_end(sizes: F::ListSizes<'_>, at: usize) -> usize {
        F::sized_list_end(sizes, length_end(at))
    }

    #[inline]
    fn carve<'a, 's: 's>(
        sizes: F::ListSizes<'s>,
        carver: &mut Carver<'a>,
    ) -> Result<F::ListWriter<'a, 's>, EncodeError> {
        F::carve_list(sizes, usize::MAX, carver)
    }
}

impl<F: Fill> BoundFill for Vec<F> {
    #[inline]
    fn carve_bounded<'a, 's: 's>(
        sizes: F::ListSizes<'s>,
        bound: usize,
        carver: &mut Carver<'a>,
    ) -> Result<F::ListWriter<'a, 's>, EncodeError> {
        F::carve_list(sizes, bound, carver)
    }
}

impl<F: Fill, const N: usize> Fill for [F; N] {
    type Sizes<'s> = F::ArraySizes<'s>;
    type Writer<'a, 's> = F::ArrayWriter<'a, 's, N>;
    crate::one_by_one!();

    crate::sizes_of_values! {
        fn sizes_from<'s>(
            value: Option<&Self::Value>,
            source: &mut impl crate::cdr::SizeSource<'s>,
        ) -> Self::Sizes<'s> {
            F::array_sizes_from(value.map(|value| &value[..]), source)
        }
    }

    #[inline]
    fn sized_end(sizes: F::ArraySizes<'_>, at: usize) -> usize {
        F::sized_array_end(sizes, N, at)
    }

    #[inline]
    fn carve<'a, 's: 's>(
        sizes: F::ArraySizes<'s>,
        carver: &mut Carver<'a>,
    ) -> Result<F::ArrayWriter<'a, 's, N>, EncodeError> {
        F::carve_array(sizes, carver)
    }
}

impl<F: BoundFill + Bound, const N: usize> Fill for Bounded<F, N> {
    type Sizes<'s> = F::Sizes<'s>;
    type Writer<'a, 's> = F::Writer<'a, 's>;
    crate::one_by_one!();

    crate::sizes_of_values! {
        fn sizes_from<'s>(
            value: Option<&Self::Value>,
            source: &mut impl crate::cdr::SizeSource<'s>,
        ) -> Self::Sizes<'s> {
            F::sizes_from(value, source)
        }
    }

    #[inline]
    fn sized_end(sizes: F::Sizes<'_>, at: usize) -> usize {
        F::sized_end(sizes, at)
    }

    #[inline]
    fn carve<'a, 's: 's>(
        sizes: F::Sizes<'s>,
        carver: &mut Carver<'a>,
    ) -> Result<F::Writer<'a, 's>, EncodeError> {
        F::carve_bounded(sizes, N, carver)
    }
}
