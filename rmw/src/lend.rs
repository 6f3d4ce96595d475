// SPDX-License-Identifier: MIT OR Apache-2.0
//! Serialized messages that are samples: ROS gets the bytes in shared memory, and an allocator whose `deallocate` gives the sample back.
//!
//! rcutils copies allocators, so the allocator of a lent message also gets requests for other memory, which it passes to the C library.
//! The address distinguishes the two: a serialized message in a sample begins 4 bytes before a multiple of 64, and memory of the C
//! library at a multiple of 16.

use crate::bindings::*;
use std::ffi::c_void;
use std::ptr::{fn_addr_eq, null_mut};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use tautline_transport::RawSample;

/// Shorter messages are copied: a copy takes less time than returning the sample.
const LEAST_BYTES: usize = 16 << 10;
/// How many messages of one subscription are lent at a time. Further ones are copied, so that a program that keeps messages, such as a
/// recorder, does not stop the publisher.
const MOST_LENT: usize = crate::types::HELD / 2;
/// How many messages are lent at a time in this process, at most.
const SLOTS: usize = 1024;
/// Number of slots that are searched for an address.
const PROBES: usize = 16;

static LENT: Table<Lent, SLOTS> = Table::new();
static IS_ALLOWED: AtomicBool = AtomicBool::new(true);

/// The allocator of lent messages.
const LENDER: rcutils_allocator_t = rcutils_allocator_t {
    allocate: Some(allocate),
    deallocate: Some(deallocate),
    reallocate: Some(reallocate),
    zero_allocate: Some(zero_allocate),
    state: null_mut(),
};

/// How many messages of a subscription are lent.
#[derive(Clone, Debug, Default)]
pub(crate) struct LentCount(Arc<AtomicUsize>);

struct Lent {
    sample: RawSample,
    _counted: Counted,
}

/// One of the messages that are lent.
struct Counted(Arc<AtomicUsize>);

impl LentCount {
    fn one_more(&self) -> Option<Counted> {
        let counted = Counted(self.0.clone());
        (self.0.fetch_add(1, Ordering::Relaxed) < MOST_LENT).then_some(counted)
    }
}

impl Drop for Counted {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::Relaxed);
    }
}

/// Sets whether messages are lent from now on. A program that writes into received messages needs copies.
pub(crate) fn allow(is_allowed: bool) {
    IS_ALLOWED.store(is_allowed, Ordering::Relaxed);
}

/// Makes `message` the sample itself, or gives the sample back if it is to be copied.
///
/// # Real-time
/// O(1); allocates nothing; frees what the message had.
///
/// # Safety
/// `message` is initialised.
pub(crate) unsafe fn lend(
    sample: RawSample,
    message: &mut rmw_serialized_message_t,
    count: &LentCount,
) -> Result<(), RawSample> {
    give_back(message);
    if !IS_ALLOWED.load(Ordering::Relaxed) {
        return Err(sample);
    }
    let is_usual = match (message.allocator.deallocate, system().deallocate) {
        (Some(own), Some(usual)) => fn_addr_eq(own, usual) || fn_addr_eq(own, deallocate as Deallocate),
        _ => false,
    };
    let bytes = match sample.serialized() {
        Some(bytes) if is_usual && bytes.len() >= LEAST_BYTES && is_in_sample(bytes.as_ptr()) => {
            (bytes.as_ptr().cast_mut(), bytes.len())
        }
        _ => return Err(sample),
    };
    let Some(counted) = count.one_more() else { return Err(sample) };
    LENT.insert(bytes.0.addr(), Lent { sample, _counted: counted }).map_err(|lent| lent.sample)?;
    // SAFETY: the caller's contract: the message's own memory, of either allocator.
    unsafe { deallocate(message.buffer.cast(), null_mut()) };
    *message = rmw_serialized_message_t {
        buffer: bytes.0,
        buffer_length: bytes.1,
        buffer_capacity: bytes.1,
        allocator: LENDER,
    };
    Ok(())
}

/// Empties a lent message, because a sample must not be written to.
pub(crate) fn give_back(message: &mut rmw_serialized_message_t) {
    if is_in_sample(message.buffer) && LENT.remove(message.buffer.addr()).is_some() {
        (message.buffer, message.buffer_length, message.buffer_capacity) = (null_mut(), 0, 0);
    }
}

/// Whether an address can only be that of a message in a sample, and not of memory of the C library.
fn is_in_sample<T>(address: *const T) -> bool {
    address.addr() % 16 == 12
}

type Deallocate = unsafe extern "C" fn(*mut c_void, *mut c_void);

/// The C library's allocator.
fn system() -> rcutils_allocator_t {
    // SAFETY: a constant, whose functions are all there.
    unsafe { rcutils_get_default_allocator() }
}

unsafe extern "C" fn allocate(bytes: usize, state: *mut c_void) -> *mut c_void {
    // SAFETY: of any size.
    system().allocate.map_or(null_mut(), |allocate| unsafe { allocate(bytes, state) })
}

unsafe extern "C" fn zero_allocate(count: usize, bytes: usize, state: *mut c_void) -> *mut c_void {
    // SAFETY: of any size.
    system().zero_allocate.map_or(null_mut(), |allocate| unsafe { allocate(count, bytes, state) })
}

unsafe extern "C" fn deallocate(address: *mut c_void, state: *mut c_void) {
    if is_in_sample(address) {
        // A child that was forked meanwhile may not have the entry.
        drop(LENT.remove(address.addr()));
    } else if let Some(deallocate) = system().deallocate {
        // SAFETY: rcutils' contract: of this allocator, or, in `lend`, of the default one, which is the same.
        unsafe { deallocate(address, state) };
    }
}

unsafe extern "C" fn reallocate(address: *mut c_void, bytes: usize, state: *mut c_void) -> *mut c_void {
    if !is_in_sample(address) {
        // SAFETY: rcutils' contract: of this allocator, here the system's.
        return system()
            .reallocate
            .map_or(null_mut(), |reallocate| unsafe { reallocate(address, bytes, state) });
    }
    // SAFETY: of any size.
    let copy = unsafe { allocate(bytes, state) };
    if !copy.is_null()
        && let Some(lent) = LENT.remove(address.addr())
    {
        let old = lent.sample.serialized().unwrap_or_default();
        // SAFETY: new memory of that size.
        unsafe { copy.cast::<u8>().copy_from_nonoverlapping(old.as_ptr(), old.len().min(bytes)) };
    }
    copy
}

/// Values by address. No thread waits: a slot is claimed before its value is locked. In a child that was forked while another thread
/// used a slot, that slot stays taken.
struct Table<T, const N: usize>([Slot<T>; N]);

struct Slot<T> {
    /// [`FREE`], [`CLAIMED`], or the address.
    key: AtomicUsize,
    value: Mutex<Option<T>>,
}

const FREE: usize = 0;
/// The slot's value is being written or taken out.
const CLAIMED: usize = 1;

impl<T, const N: usize> Table<T, N> {
    const fn new() -> Self {
        Table([const { Slot { key: AtomicUsize::new(FREE), value: Mutex::new(None) } }; N])
    }

    fn slots(&self, key: usize) -> impl Iterator<Item = &Slot<T>> {
        // Samples are at multiples of 64, and large ones of more.
        let first = (key as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 32;
        (0..PROBES.min(N)).map(move |n| &self.0[(first as usize).wrapping_add(n) % N])
    }

    /// # Real-time
    /// Wait-free.
    ///
    /// # Errors
    /// The value, if there is no room.
    fn insert(&self, key: usize, value: T) -> Result<(), T> {
        let mut value = Some(value);
        let is_in =
            self.slots(key).any(|slot| slot.change(FREE, key, |place| *place = value.take()).is_some());
        value.filter(|_| !is_in).map_or(Ok(()), Err)
    }

    /// # Real-time
    /// Wait-free.
    fn remove(&self, key: usize) -> Option<T> {
        self.slots(key).find_map(|slot| slot.change(key, FREE, Option::take)).flatten()
    }
}

impl<T> Slot<T> {
    /// If its key is `from`: claims it, changes the value, and sets the key `to`.
    fn change<R>(&self, from: usize, to: usize, change: impl FnOnce(&mut Option<T>) -> R) -> Option<R> {
        self.key.compare_exchange(from, CLAIMED, Ordering::Acquire, Ordering::Relaxed).ok()?;
        let changed = change(&mut self.value.lock().unwrap_or_else(PoisonError::into_inner));
        self.key.store(to, Ordering::Release);
        Some(changed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_value_comes_back_once() {
        let table = Table::<Arc<usize>, 64>::new();
        let values: Vec<_> = (0..3).map(Arc::new).collect();
        std::thread::scope(|scope| {
            for (thread, value) in values.iter().enumerate() {
                let table = &table;
                scope.spawn(move || {
                    for round in 0..1000 {
                        let keys = (0..4).map(|n| 60 + 64 * (thread + 3 * (n + 4 * round)));
                        let inserted: Vec<_> =
                            keys.map(|key| (key, table.insert(key, value.clone()).is_ok())).collect();
                        for (key, is_in) in inserted {
                            assert_eq!(table.remove(key).map(|found| *found), is_in.then_some(thread));
                            assert!(table.remove(key).is_none());
                        }
                    }
                });
            }
        });
        assert!(values.iter().all(|value| Arc::strong_count(value) == 1));
    }

    #[test]
    fn a_full_table_takes_nothing() {
        let table = Table::<usize, 4>::new();
        assert!((1..=4).all(|n| table.insert(60 + 64 * n, n).is_ok()));
        assert_eq!(table.insert(60, 0), Err(0));
        assert_eq!(table.remove(60 + 64 * 3), Some(3));
        assert_eq!(table.insert(60, 0), Ok(()));
        assert_eq!(table.remove(60), Some(0));
    }
}
