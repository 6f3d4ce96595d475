// SPDX-License-Identifier: MIT OR Apache-2.0
//! Which parts of a memory region are free. Works with offsets only, not with memory.

use std::collections::BTreeMap;

/// A part of a file or of another stretch, in bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) struct Range {
    pub(crate) offset: u64,
    pub(crate) len: u64,
}

impl Range {
    pub(crate) fn end(self) -> u64 {
        self.offset + self.len
    }
}

/// A first-fit allocator of parts, which joins adjacent free parts.
#[derive(Debug)]
pub(crate) struct Ranges {
    /// The lengths of free parts by their offsets; no two of them are adjacent.
    free: BTreeMap<u64, u64>,
    granularity: u64,
}

impl Ranges {
    /// All of `whole` is free. Parts are multiples of `granularity`, as are the ends of `whole`.
    pub(crate) fn new(whole: Range, granularity: u64) -> Self {
        let mut ranges = Ranges { free: BTreeMap::new(), granularity };
        ranges.give_back(whole);
        ranges
    }

    /// A part of at least `len` bytes. `None`: no such part is free.
    pub(crate) fn take(&mut self, len: u64) -> Option<Range> {
        let len = len.max(1).checked_next_multiple_of(self.granularity)?;
        let (&offset, &free) = self.free.iter().find(|(_, free)| **free >= len)?;
        Some(self.cut(offset, free, Range { offset, len }))
    }

    /// As [`take`](Self::take), but takes the end of the last free part that is long enough.
    pub(crate) fn take_last(&mut self, len: u64) -> Option<Range> {
        let len = len.max(1).checked_next_multiple_of(self.granularity)?;
        let (&offset, &free) = self.free.iter().rev().find(|(_, free)| **free >= len)?;
        Some(self.cut(offset, free, Range { offset: offset + free - len, len }))
    }

    /// Takes a part out of a free one.
    fn cut(&mut self, offset: u64, free: u64, part: Range) -> Range {
        self.free.remove(&offset);
        self.give_back(Range { offset, len: part.offset - offset });
        self.give_back(Range { offset: part.end(), len: offset + free - part.end() });
        part
    }

    /// Frees a part that was taken.
    pub(crate) fn give_back(&mut self, range: Range) {
        if range.len == 0 {
            return;
        }
        let Range { mut offset, mut len } = range;
        if let Some((&before, &its_len)) = self.free.range(..offset).next_back()
            && before + its_len == offset
        {
            self.free.remove(&before);
            (offset, len) = (before, its_len + len);
        }
        if let Some(its_len) = self.free.remove(&(offset + len)) {
            len += its_len;
        }
        self.free.insert(offset, len);
    }

    #[cfg(all(test, not(taut_loom)))]
    fn free_bytes(&self) -> u64 {
        self.free.values().sum()
    }
}

#[cfg(all(test, not(taut_loom)))]
mod tests {
    use super::*;
    use rand::RngExt;

    #[test]
    fn the_first_that_fits_and_neighbours_become_one() {
        let mut ranges = Ranges::new(Range { offset: 4096, len: 10 * 4096 }, 4096);
        let parts: Vec<_> = (0..10).map(|_| ranges.take(1).unwrap()).collect();
        assert!(ranges.take(1).is_none() && ranges.take(u64::MAX).is_none());
        assert_eq!(parts[3], Range { offset: 4 * 4096, len: 4096 });
        [parts[3], parts[5], parts[4]].into_iter().for_each(|part| ranges.give_back(part));
        assert_eq!(ranges.take(3 * 4096), Some(Range { offset: 4 * 4096, len: 3 * 4096 }));
        ranges.give_back(parts[8]);
        assert_eq!(ranges.take(4096), Some(parts[8]));
        [parts[1], parts[7], parts[8]].into_iter().for_each(|part| ranges.give_back(part));
        assert_eq!(ranges.take_last(4096), Some(parts[8]));
        assert_eq!(ranges.take_last(4096), Some(parts[7]));
    }

    #[test]
    fn no_two_parts_overlap() {
        let mut random = tautline_seed::random();
        let whole = Range { offset: 64, len: 1 << 16 };
        let mut ranges = Ranges::new(whole, 64);
        let mut taken: Vec<Range> = Vec::new();
        for _ in 0..20_000 {
            if random.random_bool(0.5) {
                let len = random.random_range(0..3000);
                let part = if random.random_bool(0.5) { ranges.take(len) } else { ranges.take_last(len) };
                if let Some(part) = part {
                    assert!(part.len >= len && part.offset.is_multiple_of(64));
                    assert!(part.offset >= whole.offset && part.end() <= whole.end());
                    assert!(
                        taken.iter().all(|other| part.end() <= other.offset || other.end() <= part.offset)
                    );
                    taken.push(part);
                }
            } else if !taken.is_empty() {
                ranges.give_back(taken.swap_remove(random.random_range(0..taken.len())));
            }
            let used: u64 = taken.iter().map(|part| part.len).sum();
            assert_eq!(ranges.free_bytes() + used, whole.len);
        }
        taken.into_iter().for_each(|part| ranges.give_back(part));
        assert_eq!(ranges.free, BTreeMap::from([(whole.offset, whole.len)]), "one part again");
    }
}
