// SPDX-License-Identifier: MIT OR Apache-2.0
//! For tests: computes sizes that are not written by hand.

/// Gives lengths, and stores lists of them.
pub trait SizeSource<'s> {
    /// A length; `actual` is that of the value, if there is one.
    fn len(&mut self, actual: Option<usize>) -> usize;

    /// As [`len`](Self::len), for a list of which each element has sizes.
    fn count(&mut self, actual: Option<usize>) -> usize {
        self.len(actual)
    }

    /// Keeps a list.
    fn keep<T: Copy + 's>(&mut self, list: Vec<T>) -> &'s [T];
}

/// The lengths of the value; lists are never freed.
#[derive(Debug)]
pub struct Leaked;

impl SizeSource<'static> for Leaked {
    fn len(&mut self, actual: Option<usize>) -> usize {
        actual.unwrap_or_default()
    }

    fn keep<T: Copy>(&mut self, list: Vec<T>) -> &'static [T] {
        list.leak()
    }
}

/// The sizes of a list's elements, one by one.
#[doc(hidden)]
pub fn size_list<'s, V, T: Copy + 's, S: SizeSource<'s>>(
    source: &mut S,
    values: Option<&[V]>,
    mut one: impl FnMut(Option<&V>, &mut S) -> T,
) -> &'s [T] {
    let len = source.count(values.map(<[V]>::len));
    let list = (0..len).map(|index| one(values.and_then(|values| values.get(index)), source)).collect();
    source.keep(list)
}
