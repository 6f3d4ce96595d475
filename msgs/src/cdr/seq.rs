// SPDX-License-Identifier: MIT OR Apache-2.0

use core::fmt;
use core::marker::PhantomData;

use crate::cdr::{Endian, Fault, Reader, View};

/// A sequence or array in a body whose elements differ in length, or are padded: strings, messages with strings. It is
/// validated; its elements are decoded during iteration.
pub struct Seq<'a, F> {
    body: &'a [u8],
    /// Where the first element starts, in bytes from the start of the body.
    start: usize,
    len: usize,
    _form: PhantomData<fn() -> F>,
}

impl<'a, F: View> Seq<'a, F> {
    /// Validates `len` elements.
    #[doc(hidden)]
    pub fn check(reader: &mut Reader<'a>, len: usize) -> Result<Self, Fault> {
        reader.expect(len, F::MIN_SIZE)?;
        let (body, start) = (reader.body(), reader.position());
        for index in 0..len {
            F::view_value(reader).map_err(|fault| reader.at_index(fault, index))?;
        }
        Ok(Self { body, start, len, _form: PhantomData })
    }

    /// The number of elements.
    pub fn len(self) -> usize {
        self.len
    }

    /// Whether there are none.
    pub fn is_empty(self) -> bool {
        self.len == 0
    }

    /// The element `index`, counted from 0.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall. Linear in `index`: the elements before it are skipped.
    pub fn get(self, index: usize) -> Option<F::Ref<'a>> {
        self.iter().nth(index)
    }

    /// The elements in order.
    pub fn iter(self) -> Iter<'a, F> {
        let mut reader = Reader::new(self.body, Endian::Little);
        reader.skip_to(self.start);
        Iter { reader, left: self.len, _form: PhantomData }
    }
}

impl<F> Clone for Seq<'_, F> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<F> Copy for Seq<'_, F> {}

impl<'a, F: View> IntoIterator for Seq<'a, F> {
    type Item = F::Ref<'a>;
    type IntoIter = Iter<'a, F>;

    fn into_iter(self) -> Iter<'a, F> {
        self.iter()
    }
}

impl<'a, F: View<Ref<'a>: fmt::Debug>> fmt::Debug for Seq<'a, F> {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.debug_list().entries(self.iter()).finish()
    }
}

/// The elements of a [`Seq`]. They were validated; if a misbehaving publisher has changed them since, there are fewer.
pub struct Iter<'a, F> {
    reader: Reader<'a>,
    left: usize,
    _form: PhantomData<fn() -> F>,
}

impl<'a, F: View> Iterator for Iter<'a, F> {
    type Item = F::Ref<'a>;

    /// # Real-time
    /// Wait-free; no allocation; no syscall. As checking the element.
    fn next(&mut self) -> Option<F::Ref<'a>> {
        self.left = self.left.checked_sub(1)?;
        F::view_value(&mut self.reader).inspect_err(|_| self.left = 0).ok()
    }

    fn size_hint(&self) -> (usize, Option<usize>) {
        (0, Some(self.left))
    }
}

impl<F> fmt::Debug for Iter<'_, F> {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.debug_struct("Iter").field("left", &self.left).finish_non_exhaustive()
    }
}
