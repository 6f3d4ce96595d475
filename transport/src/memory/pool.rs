// SPDX-License-Identifier: MIT OR Apache-2.0
//! A publisher's samples: their positions, which of them are free, and who uses the others.
//!
//! Samples of one size lie in a segment, which is part of the participant's file; a publisher gets more segments when more or larger
//! samples are needed. iceoryx2's lock-free pool allocator knows which samples are free. Each sample has a reference count: its
//! loan, each subscription that it was sent to, and the history of a publisher that keeps samples for late joiners each hold a
//! reference. When the last reference is released, the sample is free.

use crate::memory::header::{HEADER_BYTES, SampleHeader};
use crate::memory::ranges::Range;
use crate::memory::references::References;
use crate::memory::sizes::SAMPLE_ALIGNMENT;
use iceoryx2_bb_elementary::bump_allocator::BumpAllocator;
use iceoryx2_bb_elementary_traits::allocator::Allocate;
use iceoryx2_cal::shm_allocator::pool_allocator::{Config, PoolAllocator};
use iceoryx2_cal::shm_allocator::{PointerOffset, SegmentId, ShmAllocator};
use std::alloc::Layout;
use std::ptr::NonNull;
use std::sync::Arc;
use tautline_rt::shm::Mapping;

/// Segments of a publisher at most: what [`PointerOffset`] can tell apart, and fits into a publisher's head.
pub(crate) const SEGMENTS: usize = 64;
/// Samples of a segment at most: what iceoryx2's pool can count.
pub(crate) const MAX_SAMPLES: usize = (1 << 24) - 2;

/// A segment of this process's.
pub(crate) struct Segment {
    id: u8,
    pub(crate) range: Range,
    pub(crate) map: Arc<Mapping>,
    sample_bytes: usize,
    samples: usize,
    /// The number of the publisher's samples before the first one of this segment.
    first: usize,
    /// Boxed, because it contains offsets relative to its own position.
    free: Box<PoolAllocator>,
    _books: Box<[u64]>,
    references: Box<[References]>,
}

/// Where a sample lies, as it goes through a queue. From another process: a claim.
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
    /// If the mapping is too short, or iceoryx2's allocator refuses memory of the size that it asked for.
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
        let config = Config { bucket_layout: layout(sample_bytes) };
        let managed = NonNull::slice_from_raw_parts(map.start().cast::<u8>(), samples * sample_bytes);
        let books_bytes = PoolAllocator::management_size(managed.len(), &config);
        let mut books = vec![0_u64; books_bytes.div_ceil(8) + 1].into_boxed_slice();
        // SAFETY: the managed memory is mapped as long as `map`, which goes with the allocator.
        let mut free = Box::new(unsafe { PoolAllocator::new_uninit(SAMPLE_ALIGNMENT, managed, &config) });
        let start = NonNull::from(&mut *books).cast::<u8>();
        let bump = BumpAllocator::new(start, size_of_val(&*books));
        // SAFETY: once, and the allocator stays in its box as long as its books in theirs.
        let made = unsafe { free.init(&bump) };
        assert!(made.is_ok(), "iceoryx2's pool takes the memory that it asks for: {made:?}");
        let references = (0..samples).map(|_| References::none()).collect();
        Segment { id: id as u8, range, map, sample_bytes, samples, first, free, _books: books, references }
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

    /// Takes a free sample, with one reference.
    ///
    /// # Real-time
    /// Lock-free: another thread that gives a sample back meanwhile makes it try again; no allocation; no syscall.
    pub(crate) fn take(&self) -> Option<usize> {
        // SAFETY: initialised in `new`.
        let free = unsafe { self.free.assume_init() };
        let index = free.allocate(layout(self.sample_bytes)).ok()?.offset() / self.sample_bytes;
        self.references.get(index)?.begin();
        Some(index)
    }

    /// One more reference to a sample that has some.
    ///
    /// # Real-time
    /// Wait-free; no syscall.
    pub(crate) fn add(&self, index: usize) {
        if let Some(references) = self.references.get(index) {
            references.add();
        }
    }

    /// One more reference to a sample, if it has any: it is not free then. For who has none of its own.
    pub(crate) fn pin(&self, index: usize) -> bool {
        self.references.get(index).is_some_and(References::pin)
    }

    /// One reference less: with the last one the sample is free.
    ///
    /// # Real-time
    /// As [`take`](Self::take).
    pub(crate) fn release(&self, index: usize) {
        if self.references.get(index).is_some_and(References::release) {
            // SAFETY: it was allocated, and nobody refers to it any more.
            unsafe { self.free.deallocate_bucket(PointerOffset::new(index * self.sample_bytes)) };
        }
    }

    /// Whether all of its samples are free.
    pub(crate) fn is_unused(&self) -> bool {
        self.references.iter().all(References::is_none)
    }

    pub(crate) fn offset(&self, index: usize) -> ChunkOffset {
        ChunkOffset { segment: self.id(), offset_bytes: index * self.sample_bytes }
    }

    /// The header of a sample.
    pub(crate) fn header(&self, index: usize) -> NonNull<SampleHeader> {
        // SAFETY: indices come from the allocator; it manages that much of the mapping.
        unsafe { self.map.start().byte_add(index * self.sample_bytes).cast() }
    }

    /// The payload of a sample: the bytes after its header.
    pub(crate) fn payload(&self, index: usize) -> NonNull<[u8]> {
        // SAFETY: as in `header`; a sample is longer than its header.
        let start = unsafe { self.header(index).cast::<u8>().byte_add(HEADER_BYTES) };
        NonNull::slice_from_raw_parts(start, self.sample_bytes - HEADER_BYTES)
    }
}

fn layout(sample_bytes: usize) -> Layout {
    Layout::from_size_align(sample_bytes, SAMPLE_ALIGNMENT).unwrap_or(Layout::new::<SampleHeader>())
}

/// All segments of a publisher, by their ids.
#[derive(Clone, Default)]
pub(crate) struct Pool {
    segments: Vec<Option<Arc<Segment>>>,
    /// The id of the next segment.
    next: usize,
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

    /// An id that no segment has, and that none had for long: a subscription that has not been told yet that a segment has gone
    /// would look there for the samples of the one that has its id.
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

    /// The segment and the index of a sample that came back through a queue. `None`: it is none of this publisher's.
    ///
    /// # Real-time
    /// Wait-free; no syscall.
    pub(crate) fn find(&self, word: u64) -> Option<(&Segment, usize)> {
        let ChunkOffset { segment, offset_bytes } = ChunkOffset::from_word(word);
        let segment = self.segments.get(segment)?.as_deref()?;
        let index = offset_bytes / segment.sample_bytes;
        (index < segment.samples).then_some((segment, index))
    }

    /// One reference less to the sample with this number.
    pub(crate) fn release_number(&self, number: usize) {
        let has_it = |segment: &&Arc<Segment>| (segment.first..segment.end()).contains(&number);
        if let Some(segment) = self.segments().find(has_it) {
            segment.release(number - segment.first);
        }
    }
}

/// A segment of a publisher's samples, mapped here.
#[derive(Clone)]
pub(crate) struct SegmentView {
    pub(crate) map: Arc<Mapping>,
    pub(crate) sample_bytes: usize,
    /// Where it lies in the publisher's file: its id may be another's later.
    pub(crate) place: u64,
}

/// By their ids.
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

    #[test]
    fn a_sample_is_free_with_its_last_reference() {
        let segment = segment(0, 128, 3, 0);
        let taken: Vec<_> = (0..3).map(|_| segment.take().unwrap()).collect();
        assert!(segment.take().is_none());
        segment.add(taken[1]);
        segment.release(taken[1]);
        assert!(segment.take().is_none(), "one is left");
        assert!(segment.pin(taken[1]));
        segment.release(taken[1]);
        segment.release(taken[1]);
        assert!(!segment.pin(taken[1]), "it is free");
        assert_eq!(segment.take(), Some(taken[1]));
        taken.into_iter().for_each(|index| segment.release(index));
        assert!(segment.is_unused());
    }

    #[test]
    fn samples_do_not_overlap_and_are_found_by_their_offsets() {
        let mut pool = Pool::default();
        pool.add(Arc::new(segment(0, 128, 40, 0)));
        pool.add(Arc::new(segment(1, 4096, 3, 40)));
        assert_eq!((pool.next_id(), pool.end(), pool.samples(4096)), (Some(2), 43, 3));
        let mut numbers = Vec::new();
        for segment in pool.segments() {
            while let Some(index) = segment.take() {
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
        let segment = &segment(0, 64 + 64, 8, 0);
        let (sender, receiver) = std::sync::mpsc::sync_channel::<usize>(4);
        std::thread::scope(|scope| {
            scope.spawn(move || receiver.iter().for_each(|index| segment.release(index)));
            for _ in 0..10_000 {
                let index = loop {
                    match segment.take() {
                        Some(index) => break index,
                        None => std::thread::yield_now(),
                    }
                };
                sender.send(index).unwrap();
            }
            drop(sender);
        });
        assert!(segment.is_unused());
    }
}
