// SPDX-License-Identifier: MIT OR Apache-2.0

use core::fmt;

use crate::cdr::{Carver, EncodeError, Fill, Piece, WriteError, WriteFault};

/// The memory for a sequence or array whose elements differ in length: strings, messages with strings.
pub struct Elements<'a, 's, F: Fill> {
    /// Empty once writing has begun.
    region: &'a mut [u8],
    /// Where the region starts, in bytes from the start of the body.
    at: usize,
    sizes: &'s [F::Sizes<'s>],
    len: usize,
    begun: bool,
    set: bool,
}

impl<'a, 's, F: Fill> Elements<'a, 's, F> {
    /// Takes the region of `len` elements; elements without sizes have only empty strings and sequences.
    #[doc(hidden)]
    pub fn carve(
        sizes: &'s [F::Sizes<'s>],
        len: usize,
        carver: &mut Carver<'a>,
    ) -> Result<Self, EncodeError> {
        let at = carver.position();
        let region = carver.take(1, Self::end(sizes, len, at) - at)?;
        Ok(Self { region, at, sizes, len, begun: false, set: len == 0 })
    }

    /// Where `len` elements end.
    #[doc(hidden)]
    pub fn end(sizes: &[F::Sizes<'s>], len: usize, at: usize) -> usize {
        (0..len).fold(at, |at, index| F::sized_end(sizes.get(index).copied().unwrap_or_default(), at))
    }

    /// The number of elements.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Lets `write` set each element in turn, and checks that each was set. May be called once, and before `default_rest`.
    ///
    /// # Errors
    /// Of `write`; [`WriteFault::Unset`] with the field that was not set; a length over its bound; [`WriteFault::Again`].
    pub fn each(
        &mut self,
        mut write: impl FnMut(usize, &mut F::Writer<'a, 's>) -> Result<(), WriteError>,
    ) -> Result<(), WriteError> {
        if core::mem::replace(&mut self.begun, true) && self.len != 0 {
            return Err(WriteError::new(WriteFault::Again));
        }
        let mut carver = Carver::new(core::mem::take(&mut self.region), self.at);
        for index in 0..self.len {
            let mut writer = F::carve(self.sizes.get(index).copied().unwrap_or_default(), &mut carver)?;
            write(index, &mut writer)?;
            writer.check()?;
        }
        self.set = true;
        Ok(())
    }
}

impl<'s, F: Fill, V: AsRef<[F::Value]>> Piece<V> for Elements<'_, 's, F> {
    fn check(&self) -> Result<(), WriteError> {
        if self.set { Ok(()) } else { Err(WriteError::new(WriteFault::Unset)) }
    }

    fn default_rest(&mut self, values: Option<&V>) {
        let values = values.map(AsRef::as_ref).filter(|values| values.len() == self.len);
        // Text of a stated length has no default: then this fails, and `check` reports it. It also fails if the elements were set before.
        let _ = self.each(|index, element| {
            element.default_rest(values.and_then(|values| values.get(index)));
            Ok(())
        });
    }
}

impl<F: Fill> fmt::Debug for Elements<'_, '_, F> {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter
            .debug_struct("Elements")
            .field("len", &self.len)
            .field("set", &self.set)
            .finish_non_exhaustive()
    }
}
