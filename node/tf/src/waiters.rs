// SPDX-License-Identifier: MIT OR Apache-2.0
//! The entries of futures that wait for a transform, allocated with the buffer.
//!
//! A waiter first writes into its entry what it waits for, and then looks up once more; the writer first sets a
//! transform, and then checks the entries. With a sequentially consistent fence between the two steps on each side, at
//! least one of them sees the other.
//!
//! ```text
//!  FREE --claim--> ANY  <--> FRAME + n (a sample of frame n, at the time asked for or later)
//!   ^---- drop, or ready ---------'
//! ```

use crate::names::FrameId;
use crate::sync::{AtomicI64, AtomicU64, AtomicUsize, AtomicWaker, Ordering, fence};

pub(crate) const FREE: u64 = 0;
/// Any set may complete the path.
pub(crate) const ANY: u64 = 1;
pub(crate) const FRAME: u64 = 2;

pub(crate) struct Waiter {
    pub(crate) interest: AtomicU64,
    from_ns: AtomicI64,
    pub(crate) waker: AtomicWaker,
}

pub(crate) struct Waiters {
    pub(crate) places: Box<[Waiter]>,
    pub(crate) taken: AtomicUsize,
}

impl Waiters {
    pub(crate) fn new(waiters: usize) -> Waiters {
        let waiter = |_| Waiter {
            interest: AtomicU64::new(FREE),
            from_ns: AtomicI64::new(0),
            waker: AtomicWaker::new(),
        };
        Waiters { places: (0..waiters).map(waiter).collect(), taken: AtomicUsize::new(0) }
    }

    pub(crate) fn bytes(waiters: usize) -> usize {
        waiters * size_of::<Waiter>()
    }

    /// Wakes the futures that wait for a sample of `frame`, which was set; all futures, if `everyone`.
    pub(crate) fn notify(&self, frame: FrameId, stamp_ns: i64, everyone: bool) {
        // Pairs with the fence in `WaitFor::register`.
        fence(Ordering::SeqCst);
        if self.taken.load(Ordering::Relaxed) == 0 {
            return;
        }
        for waiter in &self.places {
            // Acquire: pairs with the Release in `WaitFor::register`; its waker is there.
            let interest = waiter.interest.load(Ordering::Acquire);
            let its =
                interest == FRAME + u64::from(frame.0) && stamp_ns >= waiter.from_ns.load(Ordering::Relaxed);
            if interest == ANY || its || (everyone && interest != FREE) {
                waiter.waker.wake();
            }
        }
    }

    /// Claims a place for a future that waits for a stamp, or for any.
    pub(crate) fn claim(&self, stamp_ns: Option<i64>) -> Option<usize> {
        let free = |waiter: &Waiter| {
            waiter.interest.compare_exchange(FREE, ANY, Ordering::Acquire, Ordering::Relaxed).is_ok()
        };
        let place = self.places.iter().position(free)?;
        self.places[place].from_ns.store(stamp_ns.unwrap_or(i64::MIN), Ordering::Relaxed);
        self.taken.fetch_add(1, Ordering::Relaxed);
        Some(place)
    }
}
