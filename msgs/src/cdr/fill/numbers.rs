// SPDX-License-Identifier: MIT OR Apache-2.0
//! Numbers and messages of one layout: `&mut T` into the body.

use crate::Plain;
use crate::cdr::{Carver, EncodeError, EncodeFault, Piece, WriteError, WriteFault};

/// The memory for a number, or for a message whose memory is its CDR.
#[derive(Debug)]
pub struct Field<'a, T> {
    place: &'a mut T,
    set: bool,
}

impl<T: Plain> Field<'_, T> {
    /// Writes it.
    #[inline]
    pub fn set(&mut self, value: T) {
        *self.place = value;
        self.set = true;
    }

    /// The value, to be written in place; it then counts as set. It holds zeros or an earlier message.
    #[inline]
    pub fn value_mut(&mut self) -> &mut T {
        self.set = true;
        self.place
    }
}

impl<T: Plain + Default> Piece<T> for Field<'_, T> {
    #[inline]
    fn check(&self) -> Result<(), WriteError> {
        if self.set { Ok(()) } else { Err(WriteError::new(WriteFault::Unset)) }
    }

    #[inline]
    fn default_rest(&mut self, value: Option<&T>) {
        if !self.set {
            self.set(value.copied().unwrap_or_default());
        }
    }
}

/// The memory for a sequence or array of numbers, or of messages whose memory is their CDR.
#[derive(Debug)]
pub struct Slice<'a, T> {
    place: &'a mut [T],
    set: bool,
}

impl<T: Plain> Slice<'_, T> {
    /// The elements, to be written in place; they then count as set. They hold the previous content of the
    /// memory.
    #[inline]
    pub fn slice_mut(&mut self) -> &mut [T] {
        self.set = true;
        self.place
    }

    /// Copies `values` in.
    ///
    /// # Errors
    /// [`WriteFault::Length`] if they are not as many as was stated.
    #[inline]
    pub fn copy_from(&mut self, values: &[T]) -> Result<(), WriteError> {
        if values.len() != self.place.len() {
            let (len, stated) = (values.len(), self.place.len());
            return Err(WriteError::new(WriteFault::Length { len, stated }));
        }
        self.slice_mut().copy_from_slice(values);
        Ok(())
    }

    /// The number of elements.
    pub fn len(&self) -> usize {
        self.place.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.place.is_empty()
    }
}

impl<T: Plain + Default, V: AsRef<[T]>> Piece<V> for Slice<'_, T> {
    #[inline]
    fn check(&self) -> Result<(), WriteError> {
        if self.set || self.place.is_empty() { Ok(()) } else { Err(WriteError::new(WriteFault::Unset)) }
    }

    #[inline]
    fn default_rest(&mut self, values: Option<&V>) {
        if self.set {
            return;
        }
        match values.map(AsRef::as_ref) {
            Some(values) if values.len() == self.place.len() => self.slice_mut().copy_from_slice(values),
            _ => self.slice_mut().fill(T::default()),
        }
    }
}

/// The memory for one value.
#[inline]
pub fn field<'a, T: Plain>(carver: &mut Carver<'a>) -> Result<Field<'a, T>, EncodeError> {
    match place(1, carver)? {
        [place] => Ok(Field { place, set: false }),
        _ => Err(EncodeError::new(EncodeFault::Room { needed: 1, len: 0 })),
    }
}

/// The memory for `len` values.
#[inline]
pub fn values<'a, T: Plain>(len: usize, carver: &mut Carver<'a>) -> Result<Slice<'a, T>, EncodeError> {
    Ok(Slice { place: place(len, carver)?, set: false })
}

/// Where `len` values end that start at `at`.
#[inline]
pub fn end<T: Plain>(len: usize, at: usize) -> usize {
    match len {
        0 => at,
        _ => super::aligned(at, T::FIRST_ALIGN).saturating_add(len.saturating_mul(size_of::<T>())),
    }
}

#[inline]
fn place<'a, T: Plain>(len: usize, carver: &mut Carver<'a>) -> Result<&'a mut [T], EncodeError> {
    const { assert!(T::DENSE, "what has padding is written field by field") }
    if len == 0 {
        return Ok(&mut []);
    }
    let bytes = carver.take(T::FIRST_ALIGN, len.saturating_mul(size_of::<T>()))?;
    if !T::ALWAYS_VALID {
        // Zeros are a valid `T`; what the memory held before may not be.
        bytes.fill(0);
    }
    // The pointer is taken last: no other use of `bytes` may come between it and the reference that is made of it.
    let values = bytes.as_mut_ptr().cast::<T>();
    if !values.is_aligned() {
        return Err(EncodeError::new(EncodeFault::Alignment { align: align_of::<T>() }));
    }
    // SAFETY: `len` elements are within `bytes`, aligned and initialised, and valid since any bytes or zeros are; they
    // are borrowed as exclusively and as long as `bytes`. `T` has no padding, so writing it leaves every byte initialised.
    Ok(unsafe { core::slice::from_raw_parts_mut(values, len) })
}

macro_rules! numbers {
    ($($type:ident)*) => {$(
        $crate::dense_struct!(@fill $type);
    )*};
}

numbers!(bool i8 u8 i16 u16 i32 u32 i64 u64 f32 f64);
