// SPDX-License-Identifier: MIT OR Apache-2.0
//! Words that are atomics of a mapping or, in models, loom's (`--cfg taut_loom`), and the fence that orders them.

use std::sync::atomic::Ordering;

#[cfg(taut_loom)]
pub(crate) use loom::sync::atomic::fence;
#[cfg(not(taut_loom))]
pub(crate) use std::sync::atomic::fence;

pub(crate) trait Word {
    fn load(&self, order: Ordering) -> u64;

    fn store(&self, value: u64, order: Ordering);
}

macro_rules! word {
    ($atomic:ty) => {
        impl Word for $atomic {
            fn load(&self, order: Ordering) -> u64 {
                self.load(order)
            }

            fn store(&self, value: u64, order: Ordering) {
                self.store(value, order);
            }
        }
    };
}

word!(std::sync::atomic::AtomicU64);
#[cfg(taut_loom)]
word!(loom::sync::atomic::AtomicU64);
