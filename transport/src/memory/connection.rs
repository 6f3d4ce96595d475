// SPDX-License-Identifier: MIT OR Apache-2.0
//! The connection of one publisher and one subscription: a block of shared memory with two queues of iceoryx2, the two halves of its
//! zero-copy connection.
//!
//! The publisher submits the offsets of its samples; a full queue returns the oldest offset to it. The subscription returns the
//! samples that it has read. Beside the queues are some words that each side writes for the other.
//!
//! The block lies in the publisher's part of its participant's file. The queues refer to their memory by offsets relative to
//! their own position, so the block may be at different addresses in different processes.

use crate::memory::header::Gid;
use crate::sync;
use iceoryx2_bb_elementary::bump_allocator::BumpAllocator;
use iceoryx2_bb_elementary_traits::relocatable_container::RelocatableContainer;
use iceoryx2_bb_lock_free::spsc::index_queue::RelocatableIndexQueue;
use iceoryx2_bb_lock_free::spsc::safely_overflowing_index_queue::RelocatableSafelyOverflowingIndexQueue;
use std::io;
use std::ptr::NonNull;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use tautline_rt::full_fence;
use tautline_rt::shm::Mapping;

const MAGIC: u64 = u64::from_le_bytes(*b"tautcon1");

/// How far the subscription has come with a connection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub(crate) enum ReaderState {
    /// The subscription's participant has not found the connection yet.
    Unknown = 0,
    /// The subscription takes from the connection, or has mapped the memory that it needs for this.
    Attached = 1,
    /// The subscription no longer uses the connection or any sample that came through it.
    Closed = 2,
}

/// The block, without the memory of its queues. Cache lines: what is fixed, the publisher's words, the subscription's, and each queue.
#[repr(C, align(64))]
pub(crate) struct Block {
    magic: AtomicU64,
    subscription: [AtomicU64; 2],
    /// The position of the queues' memory in its part of the file, and its length, once all of it has been
    /// claimed.
    claimed_queues: [AtomicU64; 2],
    pub(crate) out: Out,
    pub(crate) back: Back,
    submitted: RelocatableSafelyOverflowingIndexQueue,
    returned: Returned,
}

/// On a cache line of its own: a publisher that takes samples back disturbs no subscription that polls for the next one.
#[repr(C, align(64))]
struct Returned(RelocatableIndexQueue);

/// Written by the publisher.
#[repr(C, align(64))]
pub(crate) struct Out {
    /// The number of the first sample that is for this subscription; 0 before there is one.
    pub(crate) start: AtomicU64,
    /// The number of the last sample that was submitted.
    pub(crate) sent: AtomicU64,
    /// When the publisher last showed that it is alive.
    pub(crate) alive_ns: AtomicU64,
    served: AtomicU32,
    /// Samples that made way for newer ones before they were taken.
    pub(crate) overwritten: AtomicU64,
}

/// Whether the publisher waits for room in the queue, and wants to be rung.
#[derive(Default)]
#[repr(transparent)]
pub(crate) struct RoomRequest(sync::AtomicU32);

impl RoomRequest {
    /// Requests a ring for the publisher, which found the queue full, and calls `is_full` again. If it is still full, the subscription
    /// has not taken yet, and sees the request after its next take.
    ///
    /// # Real-time
    /// Wait-free; no syscall.
    pub(crate) fn request(&self, is_full: impl FnOnce() -> bool) -> bool {
        self.0.store(1, Ordering::Relaxed);
        // Pairs with the fence in `take`: one side sees what the other has written before.
        full_fence();
        is_full()
    }

    /// Takes the request: whether the subscription, which calls this after each take, is to ring the publisher. True once per request.
    ///
    /// # Real-time
    /// Wait-free; no syscall.
    pub(crate) fn take(&self) -> bool {
        full_fence();
        self.0.load(Ordering::Relaxed) != 0 && self.0.swap(0, Ordering::Relaxed) != 0
    }
}

impl Out {
    /// Records that the thread that publishes has the connection: what it publishes from now on arrives.
    pub(crate) fn serve(&self) {
        // Release: pairs with the Acquire in `is_served`.
        self.served.store(1, Ordering::Release);
    }

    pub(crate) fn is_served(&self) -> bool {
        self.served.load(Ordering::Acquire) != 0
    }
}

/// Written by the subscription, except for the request for room.
#[repr(C, align(64))]
pub(crate) struct Back {
    /// The number of the last sample that was taken.
    pub(crate) taken: AtomicU64,
    state: AtomicU32,
    /// How often the publisher's segments of samples had changed when the subscription mapped them.
    pub(crate) mapped: AtomicU32,
    pub(crate) room: RoomRequest,
}

impl Back {
    pub(crate) fn state(&self) -> ReaderState {
        // Acquire: pairs with the Release in `set_state`; what the subscription did before is over.
        match self.state.load(Ordering::Acquire) {
            1 => ReaderState::Attached,
            2 => ReaderState::Closed,
            _ => ReaderState::Unknown,
        }
    }

    /// Whether the subscription has not mapped yet all segments of the publisher, which have changed `grown` times.
    pub(crate) fn is_behind(&self, grown: u32) -> bool {
        match self.state() {
            ReaderState::Unknown => true,
            ReaderState::Attached => self.mapped.load(Ordering::Acquire) != grown,
            ReaderState::Closed => false,
        }
    }

    pub(crate) fn set_state(&self, state: ReaderState) {
        self.state.store(state as u32, Ordering::Release);
    }
}

/// What determines the lengths of a connection's queues.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Shape {
    pub(crate) depth: usize,
    pub(crate) held: usize,
    /// Samples that the publisher may have loaned: it sends them without a check for returned samples.
    pub(crate) loans: usize,
    pub(crate) is_observer: bool,
}

/// How many samples a publisher sends until it looks for those that the subscription has returned. Each look fetches a cache line from the
/// subscription's core.
pub(crate) const UNLOOKED: usize = 8;

pub(crate) const BLOCK_BYTES: usize = size_of::<Block>();
const WORD_BYTES: usize = size_of::<u64>();

impl Shape {
    /// Room for all samples that the subscription may take and return, queued and newly sent, before the publisher [looks](UNLOOKED).
    pub(crate) fn returned_len(self) -> usize {
        self.depth + self.held + self.loans + UNLOOKED
    }

    fn submitted_bytes(self) -> usize {
        // As the queue computes it, without what it adds for memory that is not aligned.
        (self.depth + 1) * WORD_BYTES
    }

    pub(crate) fn queues_bytes(self) -> usize {
        self.submitted_bytes() + self.returned_len() * WORD_BYTES
    }

    /// The parts of the queues' memory that are touched while the first `samples` samples go through: offset and length.
    pub(crate) fn touched(self, samples: usize) -> [(usize, usize); 2] {
        let submitted = samples.min(self.depth + 1) * WORD_BYTES;
        let returned = samples.min(self.returned_len()) * WORD_BYTES;
        [(0, submitted), (self.submitted_bytes(), returned)]
    }
}

/// The handle that one end has of a connection.
pub(crate) struct Connection {
    block: NonNull<Block>,
    map: Arc<Mapping>,
}

// SAFETY: the block is shared memory of atomics and of queues that are Sync; the unsafe functions state which thread uses which
// end of the queues.
unsafe impl Send for Connection {}
// SAFETY: as above.
unsafe impl Sync for Connection {}

impl Connection {
    /// Makes a connection in memory of this process's own file: the block is `block_at` bytes into `map`, the memory of its queues
    /// `queues_at` bytes, both multiples of 64. The queues' memory is not touched.
    ///
    /// # Errors
    /// The system refuses memory to make it in.
    ///
    /// # Safety
    /// Both parts lie within `map`, are long enough, and nobody else uses them. The memory is mapped for writing.
    pub(crate) unsafe fn create(
        map: &Arc<Mapping>,
        block_at: usize,
        queues_at: usize,
        subscription: Gid,
        shape: Shape,
    ) -> io::Result<Self> {
        // iceoryx2 writes zeros to all of a queue's memory. With many deep queues, most of which are never used, that would be
        // most of the memory. So the queues are made in private memory, at the same distance from their memory, and only they
        // themselves are copied: nobody reads an element of a queue to which nothing was written.
        let distance = queues_at as isize - block_at as isize;
        // SAFETY: as the caller promises.
        let block = unsafe { map.start().byte_add(block_at).cast::<Block>() };
        Template::with(distance, shape, |template| {
            // SAFETY: a Block is plain memory without a Drop, and nobody else uses the place.
            unsafe { std::ptr::copy_nonoverlapping(template.block().as_ptr(), block.as_ptr(), 1) };
        })?;
        let connection = Connection { block, map: map.clone() };
        let [low, high] = subscription.words();
        connection.block().subscription[0].store(low, Ordering::Relaxed);
        connection.block().subscription[1].store(high, Ordering::Relaxed);
        // Release: pairs with the Acquire in `open`.
        connection.block().magic.store(MAGIC, Ordering::Release);
        Ok(connection)
    }

    /// Opens the connection at a position of a publisher's memory; the block names its subscription. `None`: there is no connection.
    pub(crate) fn open(map: &Arc<Mapping>, block_at: usize) -> Option<Self> {
        let end = block_at.checked_add(BLOCK_BYTES)?;
        if end > map.len_bytes() || !block_at.is_multiple_of(align_of::<Block>()) {
            return None;
        }
        // SAFETY: within the mapping and aligned, as checked; any bytes are atomics, and the queues are looked at only if the words
        // say that they were made.
        let block = unsafe { map.start().byte_add(block_at).cast::<Block>() };
        let connection = Connection { block, map: map.clone() };
        (connection.block().magic.load(Ordering::Acquire) == MAGIC).then_some(connection)
    }

    /// Records that all memory of the queues, which lie `queues_at` bytes into the part of the file, has been claimed.
    pub(crate) fn note_claimed(&self, queues_at: usize, shape: Shape) {
        let [at, bytes] = &self.block().claimed_queues;
        bytes.store(shape.queues_bytes() as u64, Ordering::Relaxed);
        at.store(queues_at as u64, Ordering::Release);
    }

    /// Brings in the pages of the block and, if they have memory, of the queues, so that the subscription has no page faults.
    pub(crate) fn bring_in(&self) {
        let block_at = self.block.addr().get() - self.map.start().addr().get();
        // If this fails, taking causes page faults. The position of the queues comes from another process, and may be wrong.
        let _ = self.map.populate(block_at, BLOCK_BYTES, true);
        let [at, bytes] = &self.block().claimed_queues;
        let word = |word: u64| usize::try_from(word).unwrap_or(usize::MAX);
        let (at, bytes) = (word(at.load(Ordering::Acquire)), word(bytes.load(Ordering::Relaxed)));
        if at != 0 {
            let _ = self.map.populate(at, bytes, true);
        }
    }

    /// Invalidates the connection, so that it is not found any more.
    pub(crate) fn erase(&self) {
        self.block().magic.store(0, Ordering::Release);
    }

    pub(crate) fn block(&self) -> &Block {
        // SAFETY: mapped as long as `self`, aligned, and a Block was made there, or its words are only looked at.
        unsafe { self.block.as_ref() }
    }

    pub(crate) fn subscription(&self) -> Gid {
        let [low, high] = &self.block().subscription;
        Gid::from_words([low.load(Ordering::Relaxed), high.load(Ordering::Relaxed)])
    }

    /// Submits a sample. If the queue is full, the oldest one comes back.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    ///
    /// # Safety
    /// For the publisher's end, by one thread at a time.
    pub(crate) unsafe fn submit(&self, chunk: u64) -> Option<u64> {
        // SAFETY: as the caller promises; the queue was initialised when the connection was made.
        unsafe { self.block().submitted.push(chunk) }
    }

    /// Takes back a sample that the subscription has returned.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    ///
    /// # Safety
    /// For the publisher's end, by one thread at a time.
    pub(crate) unsafe fn take_back(&self) -> Option<u64> {
        // SAFETY: as above.
        unsafe { self.block().returned.0.pop() }
    }

    /// Takes the oldest sample that was submitted.
    ///
    /// # Real-time
    /// Lock-free: the publisher may overwrite what is to be taken, and then the next one is; no allocation; no syscall.
    ///
    /// # Safety
    /// For the subscription's end, by one thread at a time.
    pub(crate) unsafe fn take(&self) -> Option<u64> {
        // SAFETY: as above.
        unsafe { self.block().submitted.pop() }
    }

    /// Returns a sample that was taken. False if there is no room, which the shape rules out.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    ///
    /// # Safety
    /// For the subscription's end, by one thread at a time.
    pub(crate) unsafe fn give_back(&self, chunk: u64) -> bool {
        // SAFETY: as above.
        unsafe { self.block().returned.0.push(chunk) }
    }

    /// How many samples are queued.
    ///
    /// # Real-time
    /// Lock-free: reads again if the publisher has just submitted one; no syscall.
    pub(crate) fn queued(&self) -> usize {
        self.block().submitted.len()
    }

    /// Whether nothing is queued at the moment of the call.
    pub(crate) fn is_empty(&self) -> bool {
        self.block().submitted.is_empty()
    }
}

/// A block with queues whose memory is at a certain distance, in private memory. It is mapped, because it may be long, and little of
/// it is used: the pages between take neither memory nor time.
struct Template {
    memory: Mapping,
    block_at: usize,
}

/// The last template, if it is not longer than [`KEPT_BYTES`]: many publishers in a row have queues of one shape. It is only try-locked,
/// so it delays neither a thread of higher priority nor a forked child.
static LAST: Mutex<Option<(isize, Shape, Template)>> = Mutex::new(None);
const KEPT_BYTES: usize = 64 << 10;

impl Template {
    /// Calls `copy` with queues of this shape whose memory begins `distance` bytes after the block.
    fn with(distance: isize, shape: Shape, copy: impl FnOnce(&Template)) -> io::Result<()> {
        let is_same = |(of, as_is, _): &mut (isize, Shape, Template)| (*of, *as_is) == (distance, shape);
        let known = LAST.try_lock().ok().and_then(|mut last| last.take_if(is_same));
        let template = match known {
            Some((_, _, template)) => template,
            None => Template::new(distance, shape)?,
        };
        copy(&template);
        if template.memory.len_bytes() <= KEPT_BYTES
            && let Ok(mut last) = LAST.try_lock()
        {
            *last = Some((distance, shape, template));
        }
        Ok(())
    }

    fn new(distance: isize, shape: Shape) -> io::Result<Self> {
        // The queues' memory may lie before the block.
        let (block_at, queues_at) =
            if distance < 0 { (distance.unsigned_abs(), 0) } else { (0, distance.unsigned_abs()) };
        // iceoryx2 asks for a little more than it uses.
        let spare = 4 * WORD_BYTES;
        let memory =
            Mapping::scratch((block_at + BLOCK_BYTES).max(queues_at + shape.queues_bytes() + spare))?;
        let template = Template { memory, block_at };
        // SAFETY: within the memory, which is as long as that.
        let queues = unsafe { template.memory.start().cast::<u8>().byte_add(queues_at) };
        let bump = BumpAllocator::new(queues, shape.queues_bytes() + spare);
        // SAFETY: the block is within the memory, which begins with a page, at a multiple of 64. The queues are initialised where they
        // stay, before anybody uses them.
        let made = unsafe {
            let block = template.block();
            block.write(Block {
                magic: AtomicU64::new(0),
                subscription: [AtomicU64::new(0), AtomicU64::new(0)],
                claimed_queues: [AtomicU64::new(0), AtomicU64::new(0)],
                out: Out {
                    start: AtomicU64::new(0),
                    sent: AtomicU64::new(0),
                    alive_ns: AtomicU64::new(0),
                    served: AtomicU32::new(0),
                    overwritten: AtomicU64::new(0),
                },
                back: Back {
                    taken: AtomicU64::new(0),
                    state: AtomicU32::new(0),
                    mapped: AtomicU32::new(0),
                    room: RoomRequest::default(),
                },
                submitted: RelocatableSafelyOverflowingIndexQueue::new_uninit(shape.depth),
                returned: Returned(RelocatableIndexQueue::new_uninit(shape.returned_len())),
            });
            let block = &mut *block.as_ptr();
            block.submitted.init(&bump).is_ok() && block.returned.0.init(&bump).is_ok()
        };
        assert!(
            made && bump.used_space() == shape.queues_bytes(),
            "iceoryx2's queues take the memory of their length"
        );
        Ok(template)
    }

    fn block(&self) -> NonNull<Block> {
        // SAFETY: within the memory.
        unsafe { self.memory.start().byte_add(self.block_at).cast() }
    }
}

#[cfg(all(test, not(taut_loom)))]
mod tests {
    use super::*;
    use tautline_rt::shm::OwnFile;

    const GID: Gid = Gid([3; 16]);
    const SHAPE: Shape = Shape { depth: 3, held: 2, loans: 2, is_observer: false };

    /// If this fails, a participant's file has another layout than before: raise its `VERSION`, and state here what it is now.
    #[test]
    fn another_layout_is_another_version() {
        use crate::memory::header::SampleHeader;
        use crate::memory::{control, file};
        use std::mem::offset_of;
        let magics =
            [control::MAGIC, MAGIC].map(|magic| String::from_utf8(magic.to_le_bytes().into()).unwrap());
        let lengths =
            [size_of::<file::ParticipantHeader>(), size_of::<control::PublisherHead>(), size_of::<Block>()];
        let header = [
            offset_of!(SampleHeader, expires_ns),
            offset_of!(SampleHeader, source_gid),
            offset_of!(SampleHeader, len_bytes),
            size_of::<SampleHeader>(),
        ];
        let expected =
            (5, ["tautpub1".to_owned(), "tautcon1".to_owned()], [120, 1216, 320], [16, 40, 56, 64]);
        assert_eq!((file::VERSION, magics, lengths, header), expected);
    }

    /// The same memory twice, as two processes see it.
    fn memory(len: usize) -> [Arc<Mapping>; 2] {
        let file = OwnFile::create("taut_connection_test_").unwrap();
        file.claim(0, len as u64).unwrap();
        let maps = [(); 2].map(|()| Arc::new(Mapping::new(&file, 0, len, true).unwrap()));
        file.retire();
        maps
    }

    fn both(block_at: usize, queues_at: usize) -> [Connection; 2] {
        let [here, there] = memory(1 << 16);
        // SAFETY: within the memory, which is this test's.
        let publisher = unsafe { Connection::create(&here, block_at, queues_at, GID, SHAPE) }.unwrap();
        [publisher, Connection::open(&there, block_at).unwrap()]
    }

    #[test]
    fn samples_go_and_come_back_and_the_oldest_is_overwritten() {
        for (block_at, queues_at) in [(0, BLOCK_BYTES), (4096, 0), (64, 4096)] {
            let [publisher, subscription] = both(block_at, queues_at);
            // SAFETY: one thread.
            unsafe {
                assert!(subscription.take().is_none() && subscription.is_empty());
                for n in 1..=3 {
                    assert_eq!(publisher.submit(n), None);
                }
                assert_eq!(publisher.submit(4), Some(1));
                assert_eq!((subscription.take(), subscription.take()), (Some(2), Some(3)));
                assert!(subscription.give_back(3) && subscription.give_back(2));
                assert_eq!([(); 3].map(|()| publisher.take_back()), [Some(3), Some(2), None]);
                // Many times round.
                for n in 5..100_u64 {
                    publisher.submit(n);
                    let taken = subscription.take().unwrap();
                    assert_eq!(taken, n - 1);
                    assert!(subscription.give_back(taken));
                    assert_eq!(publisher.take_back(), Some(taken));
                }
                assert_eq!(subscription.take(), Some(99));
            }
        }
    }

    #[test]
    fn all_that_can_be_out_can_be_returned() {
        let [publisher, subscription] = both(0, BLOCK_BYTES);
        // SAFETY: one thread.
        unsafe {
            for round in 0..2 {
                let held = [(); 2].map(|()| {
                    publisher.submit(7);
                    subscription.take().unwrap()
                });
                for n in 0..3 {
                    publisher.submit(n);
                }
                while let Some(taken) = subscription.take() {
                    assert!(subscription.give_back(taken));
                }
                // What was loaned before.
                for n in 3..5 {
                    publisher.submit(n);
                    let taken = subscription.take().unwrap();
                    assert!(subscription.give_back(taken));
                }
                held.into_iter().for_each(|held| assert!(subscription.give_back(held), "{round}"));
                while publisher.take_back().is_some() {}
            }
        }
    }

    #[test]
    fn only_what_is_used_of_the_queues_is_touched() {
        let shape = Shape { depth: 1000, held: 4, loans: 1, is_observer: false };
        let [here, there] =
            memory(BLOCK_BYTES.next_multiple_of(4096) + shape.queues_bytes().next_multiple_of(4096));
        let queues_at = BLOCK_BYTES.next_multiple_of(4096);
        let word = |at: usize| {
            // SAFETY: within the memory.
            unsafe { there.start().byte_add(queues_at + at).cast::<u64>().read() }
        };
        // Of whoever used the memory before.
        for at in (0..shape.queues_bytes()).step_by(8) {
            // SAFETY: as above.
            unsafe { here.start().byte_add(queues_at + at).cast::<u64>().write(u64::MAX) };
        }
        // SAFETY: within the memory, by one thread.
        unsafe {
            let publisher = Connection::create(&here, 0, queues_at, GID, shape).unwrap();
            let subscription = Connection::open(&there, 0).unwrap();
            for n in 0..10 {
                publisher.submit(n);
                assert_eq!(subscription.take(), Some(n));
                assert!(subscription.give_back(n));
            }
        }
        let touched: Vec<_> =
            (0..shape.queues_bytes()).step_by(8).filter(|at| word(*at) != u64::MAX).collect();
        let told: Vec<_> =
            shape.touched(10).into_iter().flat_map(|(at, len)| (at..at + len).step_by(8)).collect();
        assert_eq!(touched, told);
        assert_eq!(shape.touched(5000).map(|(_, len)| len).iter().sum::<usize>(), shape.queues_bytes());
    }

    #[test]
    fn what_is_no_connection_is_not_opened() {
        let [here, there] = memory(1 << 16);
        // SAFETY: within the memory, which is this test's.
        let publisher = unsafe { Connection::create(&here, 0, BLOCK_BYTES, GID, SHAPE) }.unwrap();
        assert_eq!(Connection::open(&there, 0).unwrap().subscription(), GID);
        for at in [64, 1 << 15, (1 << 16) - 64, 1 << 16, usize::MAX, 3] {
            assert!(Connection::open(&there, at).is_none(), "{at}");
        }
        publisher.erase();
        assert!(Connection::open(&there, 0).is_none());
    }
}

#[cfg(all(test, taut_loom))]
mod loom_tests {
    use super::*;
    use loom::sync::Arc;

    /// A queue of one sample, which is full, and the publisher's bell.
    #[derive(Default)]
    struct Model {
        taken: sync::AtomicU64,
        room: RoomRequest,
        is_rung: sync::AtomicU32,
    }

    #[test]
    fn loom_a_publisher_that_waits_for_room_is_rung() {
        loom::model(|| {
            let model = Arc::new(Model::default());
            let subscription = {
                let model = model.clone();
                loom::thread::spawn(move || {
                    for number in 1..=2 {
                        model.taken.store(number, Ordering::Release);
                        if model.room.take() {
                            model.is_rung.fetch_add(1, Ordering::Relaxed);
                        }
                    }
                })
            };
            // It has sent three: there is room for the next one when two were taken.
            let is_full = || model.taken.load(Ordering::Acquire) < 2;
            let mut is_waiting = is_full() && model.room.request(is_full);
            subscription.join().unwrap();
            let rung = model.is_rung.load(Ordering::Relaxed);
            assert!(rung <= 1, "once for each request");
            // Rung after the first take it looks, asks again, and finds room.
            is_waiting = is_waiting && (rung == 0 || is_full());
            assert!(!is_waiting, "nobody rings it any more");
        });
    }
}
