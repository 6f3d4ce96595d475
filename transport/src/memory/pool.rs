// SPDX-License-Identifier: MIT OR Apache-2.0
//! A publisher's samples: their positions, which of them are free, and who uses the others.
//!
//! Samples of one size lie in a segment, which is part of the participant's file; a publisher gets more segments when more or larger
//! samples are needed. Each sample has a reference count: its loan, each subscription that it was sent to, and the history of a
//! publisher that keeps samples for late joiners each hold a reference. A sample without a reference is free. The publishing thread
//! adds samples that it frees to its [list](FreeList); it finds those that setup code frees by their count, when its list is empty.

use crate::memory::free_list::FreeList;
use crate::memory::header::{HEADER_BYTES, SampleHeader};
use crate::memory::ranges::Range;
use crate::memory::references::References;
#[cfg(all(test, not(taut_loom)))]
use crate::memory::sizes::SAMPLE_ALIGNMENT;
use iceoryx2_cal::shm_allocator::{PointerOffset, SegmentId};
use std::ptr::NonNull;
use std::sync::Arc;
use tautline_rt::fetch_to_write;
use tautline_rt::shm::Mapping;

/// Maximum number of segments of a publisher: [`PointerOffset`] can distinguish them, and they fit into a publisher's head.
pub(crate) const SEGMENTS: usize = 64;
/// Maximum number of samples of a segment: a [word](Segment::word) can distinguish them.
pub(crate) const MAX_SAMPLES: usize = 1 << INDEX_BITS;
const INDEX_BITS: u32 = 24;

/// A segment of a publisher of this process.
pub(crate) struct Segment {
    id: u8,
    pub(crate) range: Range,
    pub(crate) map: Arc<Mapping>,
    sample_bytes: usize,
    samples: usize,
    /// The number of the publisher's samples before the first one of this segment.
    first: usize,
    references: Box<[References]>,
}

/// The position of a sample, as it is passed through a queue. From another process, it is untrusted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct ChunkOffset {
    pub(crate) segment: usize,
    pub(crate) offset_bytes: usize,
}

impl ChunkOffset {
    pub(crate) fn to_word(self) -> u64 {
        let segment = SegmentId::new(self.segment as u8);
        PointerOffset::from_offset_and_segment_id(self.offset_bytes, segment).as_value()
    }

    pub(crate) fn from_word(word: u64) -> Self {
        let offset = PointerOffset::from_value(word);
        ChunkOffset { segment: usize::from(offset.segment_id().value()), offset_bytes: offset.offset() }
    }
}

impl Segment {
    /// The segment `id`, in fresh memory of `samples` samples.
    ///
    /// # Panics
    /// If the mapping is too short.
    pub(crate) fn new(
        id: usize,
        range: Range,
        map: Arc<Mapping>,
        sample_bytes: usize,
        samples: usize,
        first: usize,
    ) -> Self {
        assert!(
            samples * sample_bytes <= map.len_bytes() && samples <= MAX_SAMPLES,
            "a segment fits its memory"
        );
        let references = (0..samples).map(|_| References::none()).collect();
        Segment { id: id as u8, range, map, sample_bytes, samples, first, references }
    }

    pub(crate) fn id(&self) -> usize {
        usize::from(self.id)
    }

    pub(crate) fn sample_bytes(&self) -> usize {
        self.sample_bytes
    }

    /// How many samples the publisher has up to the last of this segment.
    pub(crate) fn end(&self) -> usize {
        self.first + self.samples
    }

    /// The number of a sample among all of the publisher.
    pub(crate) fn number(&self, index: usize) -> usize {
        self.first + index
    }

    /// The word for a sample in a [`FreeList`].
    fn word(&self, index: usize) -> u32 {
        u32::from(self.id) << INDEX_BITS | index as u32
    }

    /// Adds a reference to a sample that has at least one.
    ///
    /// # Real-time
    /// Wait-free; no syscall.
    pub(crate) fn add(&self, index: usize) {
        if let Some(references) = self.references.get(index) {
            references.add();
        }
    }

    /// Adds a reference to a sample unless it is free, for a caller that has none. Returns whether it was added.
    pub(crate) fn pin(&self, index: usize) -> bool {
        self.references.get(index).is_some_and(References::pin)
    }

    /// Releases a reference. Returns whether it was the last one, with which the sample is free. For setup code, and for samples of a
    /// size that is not loaned any more. The publishing thread calls [`Pool::release`].
    ///
    /// # Real-time
    /// Wait-free; no syscall.
    pub(crate) fn release(&self, index: usize) -> bool {
        self.references.get(index).is_some_and(References::release)
    }

    /// Whether all of its samples are free.
    pub(crate) fn is_unused(&self) -> bool {
        self.references.iter().all(References::is_none)
    }

    pub(crate) fn offset(&self, index: usize) -> ChunkOffset {
        ChunkOffset { segment: self.id(), offset_bytes: index * self.sample_bytes }
    }

    pub(crate) fn header(&self, index: usize) -> NonNull<SampleHeader> {
        // SAFETY: indices are less than `samples`, for which the mapping has room.
        unsafe { self.map.start().byte_add(index * self.sample_bytes).cast() }
    }

    /// The payload of a sample: the bytes after its header.
    pub(crate) fn payload(&self, index: usize) -> NonNull<[u8]> {
        // SAFETY: as in `header`; a sample is longer than its header.
        let start = unsafe { self.header(index).cast::<u8>().byte_add(HEADER_BYTES) };
        NonNull::slice_from_raw_parts(start, self.sample_bytes - HEADER_BYTES)
    }
}

/// All segments of a publisher, by their ids. The publishing thread's pool has the list of free samples, that of setup code has none.
#[derive(Default)]
pub(crate) struct Pool {
    segments: Vec<Option<Arc<Segment>>>,
    /// The id of the next segment.
    next: usize,
    free: Option<FreeList>,
    /// The size of the samples that are loaned.
    pub(crate) sample_bytes: usize,
}

impl Pool {
    pub(crate) fn add(&mut self, segment: Arc<Segment>) {
        let id = segment.id();
        if self.segments.len() <= id {
            self.segments.resize(id + 1, None);
        }
        self.segments[id] = Some(segment);
        self.next = (id + 1) % SEGMENTS;
    }

    pub(crate) fn remove(&mut self, id: usize) {
        if let Some(segment) = self.segments.get_mut(id) {
            *segment = None;
        }
    }

    /// An id that no segment has, and that was unused for as long as possible: a subscription that has not noticed yet that a segment
    /// was removed would look there for the samples of the new segment with its id.
    pub(crate) fn next_id(&self) -> Option<usize> {
        let mut ids = (self.next..SEGMENTS).chain(0..self.next);
        ids.find(|id| self.segments.get(*id).is_none_or(Option::is_none))
    }

    pub(crate) fn segments(&self) -> impl Iterator<Item = &Arc<Segment>> {
        self.segments.iter().flatten()
    }

    /// How many samples it has of this size.
    pub(crate) fn samples(&self, sample_bytes: usize) -> usize {
        let of_size = self.segments().filter(|segment| segment.sample_bytes == sample_bytes);
        of_size.map(|segment| segment.samples).sum()
    }

    /// More than the number of any sample.
    pub(crate) fn end(&self) -> usize {
        self.segments().map(|segment| segment.end()).max().unwrap_or(0)
    }

    /// The segment and the index of a sample that came back through a queue. `None`: it is not one of this publisher's.
    ///
    /// # Real-time
    /// Wait-free; no syscall.
    pub(crate) fn find(&self, word: u64) -> Option<(&Segment, usize)> {
        let ChunkOffset { segment, offset_bytes } = ChunkOffset::from_word(word);
        let segment = self.segments.get(segment)?.as_deref()?;
        let index = offset_bytes / segment.sample_bytes;
        (index < segment.samples).then_some((segment, index))
    }

    /// A pool of the same segments for the publishing thread, which loans samples of this size, and uses `in_turn` free ones in turn.
    pub(crate) fn for_publishing(&self, sample_bytes: usize, in_turn: usize) -> Self {
        let free = Some(FreeList::new(self.samples(sample_bytes), in_turn));
        Pool { segments: self.segments.clone(), next: self.next, free, sample_bytes }
    }

    /// Lists the free samples of the size that is loaned, if the list is empty.
    ///
    /// # Real-time
    /// Wait-free, O(samples); no allocation; no syscall.
    pub(crate) fn list_free(&self) {
        let Some(free) = self.free.as_ref().filter(|free| free.is_empty()) else { return };
        for segment in self.segments().filter(|segment| segment.sample_bytes == self.sample_bytes) {
            let is_free = |index: &usize| segment.references.get(*index).is_some_and(References::is_none);
            (0..segment.samples).rev().filter(is_free).for_each(|index| free.add(segment.word(index)));
        }
    }

    /// Takes a sample from the list, with one reference.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    pub(crate) fn take(&self) -> Option<(&Segment, usize)> {
        let word = self.free.as_ref()?.take()?;
        let segment = self.segments.get((word >> INDEX_BITS) as usize)?.as_deref()?;
        let index = word as usize & (MAX_SAMPLES - 1);
        segment.references.get(index)?.begin();
        Some((segment, index))
    }

    /// Prefetches the cache lines of the next sample that are written first, while its former reader does not use it any more and the
    /// publisher does something else.
    ///
    /// # Real-time
    /// Wait-free; no syscall.
    pub(crate) fn fetch_next(&self) {
        let Some(word) = self.free.as_ref().and_then(FreeList::next) else { return };
        let Some(Some(segment)) = self.segments.get((word >> INDEX_BITS) as usize) else { return };
        let header = segment.header(word as usize & (MAX_SAMPLES - 1)).cast::<u8>();
        fetch_to_write(header);
        // SAFETY: a sample is longer than its header.
        fetch_to_write(unsafe { header.byte_add(HEADER_BYTES) });
    }

    /// Releases a reference to a sample. With the last one the sample is free, and is listed if this is the publishing thread's pool.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    pub(crate) fn release(&self, segment: &Segment, index: usize) {
        if segment.release(index)
            && segment.sample_bytes == self.sample_bytes
            && let Some(free) = &self.free
        {
            free.give(segment.word(index));
        }
    }

    /// Releases a reference to the sample with this number.
    pub(crate) fn release_number(&self, number: usize) {
        let has_it = |segment: &&Arc<Segment>| (segment.first..segment.end()).contains(&number);
        if let Some(segment) = self.segments().find(has_it) {
            self.release(segment, number - segment.first);
        }
    }
}

/// A segment of a publisher's samples, mapped here.
#[derive(Clone)]
pub(crate) struct SegmentView {
    pub(crate) map: Arc<Mapping>,
    pub(crate) sample_bytes: usize,
    /// Its position in the publisher's file. Its id may be that of another segment later.
    pub(crate) place: u64,
}

pub(crate) type SegmentViews = Arc<[Option<SegmentView>]>;

#[cfg(all(test, not(taut_loom)))]
mod tests {
    use super::*;
    use tautline_rt::shm::OwnFile;

    fn segment(id: usize, sample_bytes: usize, samples: usize, first: usize) -> Segment {
        let len = (samples * sample_bytes).next_multiple_of(4096);
        let file = OwnFile::create("taut_pool_test_").unwrap();
        file.claim(0, len as u64).unwrap();
        let map = Arc::new(Mapping::new(&file, 0, len, true).unwrap());
        file.retire();
        Segment::new(id, Range { offset: 0, len: len as u64 }, map, sample_bytes, samples, first)
    }

    /// The publishing thread's, which loans samples as long as the first segment's.
    fn pool<const N: usize>(segments: [Segment; N], in_turn: usize) -> Pool {
        let (mut pool, sample_bytes) = (Pool::default(), segments[0].sample_bytes());
        segments.into_iter().for_each(|segment| pool.add(Arc::new(segment)));
        let pool = pool.for_publishing(sample_bytes, in_turn);
        pool.list_free();
        pool
    }

    #[test]
    fn a_sample_is_free_with_its_last_reference() {
        let pool = pool([segment(0, 128, 3, 0)], 3);
        let taken: Vec<_> = (0..3).map(|_| pool.take().unwrap()).collect();
        assert!(pool.take().is_none());
        let (segment, index) = taken[1];
        segment.add(index);
        pool.release(segment, index);
        assert!(pool.take().is_none(), "one is left");
        assert!(segment.pin(index));
        pool.release(segment, index);
        pool.release(segment, index);
        assert!(!segment.pin(index), "it is free");
        assert_eq!(pool.take().map(|(_, index)| index), Some(index));
        taken.into_iter().for_each(|(segment, index)| pool.release(segment, index));
        assert!(segment.is_unused());
    }

    #[test]
    fn samples_of_all_segments_are_used_in_the_order_in_which_they_were_freed() {
        let pool = pool([segment(0, 128, 2, 0), segment(1, 192, 2, 2), segment(2, 128, 3, 4)], 5);
        let mut taken: Vec<_> = std::iter::from_fn(|| pool.take()).collect();
        let numbers = |of: &[(&Segment, usize)]| of.iter().map(|(of, at)| of.number(*at)).collect::<Vec<_>>();
        assert_eq!(numbers(&taken), [4, 5, 6, 0, 1], "of the size that is loaned");
        taken.swap(0, 3);
        taken.swap(1, 4);
        for _ in 0..3 {
            taken.iter().for_each(|(segment, index)| pool.release(segment, *index));
            let again: Vec<_> = std::iter::from_fn(|| pool.take()).collect();
            assert_eq!(numbers(&again), numbers(&taken));
        }
    }

    #[test]
    fn what_setup_frees_is_found_when_no_other_is_free() {
        let pool = pool([segment(0, 128, 3, 0)], 3);
        let taken: Vec<_> = std::iter::from_fn(|| pool.take()).collect();
        let (segment, _) = taken[0];
        segment.release(taken[2].1);
        pool.release(segment, taken[1].1);
        assert_eq!(pool.take().map(|(_, index)| index), Some(taken[1].1));
        assert!(pool.take().is_none());
        for _ in 0..2 {
            pool.list_free();
        }
        assert_eq!(pool.take().map(|(_, index)| index), Some(taken[2].1));
        pool.list_free();
        assert!(pool.take().is_none(), "none is listed twice");
    }

    #[test]
    fn samples_do_not_overlap_and_are_found_by_their_offsets() {
        let mut pool = Pool::default();
        pool.add(Arc::new(segment(0, 128, 40, 0)));
        pool.add(Arc::new(segment(1, 4096, 3, 40)));
        assert_eq!((pool.next_id(), pool.end(), pool.samples(4096)), (Some(2), 43, 3));
        let mut numbers = Vec::new();
        for sample_bytes in [128, 4096] {
            let pool = pool.for_publishing(sample_bytes, 1);
            pool.list_free();
            while let Some((segment, index)) = pool.take() {
                let payload = segment.payload(index);
                assert_eq!(payload.len(), segment.sample_bytes() - HEADER_BYTES);
                assert!(payload.cast::<u8>().addr().get().is_multiple_of(SAMPLE_ALIGNMENT));
                // SAFETY: this sample is this test's.
                unsafe { payload.cast::<u8>().write(segment.number(index) as u8) };
                let (found, at) = pool.find(segment.offset(index).to_word()).unwrap();
                assert_eq!((found.id(), at), (segment.id(), index));
                numbers.push(segment.number(index));
            }
        }
        numbers.sort_unstable();
        assert_eq!(numbers, (0..43).collect::<Vec<_>>());
        for segment in pool.segments() {
            for index in 0..segment.samples {
                // SAFETY: as above.
                let content = unsafe { segment.payload(index).cast::<u8>().read() };
                assert_eq!(content, segment.number(index) as u8);
            }
        }
        pool.remove(0);
        assert_eq!(pool.next_id(), Some(2), "an id that was free for longer");
        pool.add(Arc::new(self::segment(SEGMENTS - 1, 128, 1, 43)));
        assert_eq!(pool.next_id(), Some(0));
        for lie in [0, 1, u64::MAX, ChunkOffset { segment: 1, offset_bytes: 3 * 4096 }.to_word()] {
            assert!(pool.find(lie).is_none_or(|(segment, index)| segment.id() == 1 && index < 3), "{lie:x}");
        }
    }

    #[test]
    fn given_back_by_other_threads() {
        let pool = pool([segment(0, 64 + 64, 8, 0)], 8);
        let (segment, _) = pool.find(ChunkOffset { segment: 0, offset_bytes: 0 }.to_word()).unwrap();
        let (sender, receiver) = std::sync::mpsc::sync_channel::<usize>(4);
        std::thread::scope(|scope| {
            scope.spawn(move || receiver.iter().for_each(|index| _ = segment.release(index)));
            for _ in 0..10_000 {
                let index = loop {
                    match pool.take() {
                        Some((_, index)) => break index,
                        None => std::thread::yield_now(),
                    }
                    pool.list_free();
                };
                sender.send(index).unwrap();
            }
            drop(sender);
        });
        assert!(segment.is_unused());
    }
}
