// SPDX-License-Identifier: MIT OR Apache-2.0
//! Counters of the writer.

use crate::sync::{AtomicU64, Ordering};

macro_rules! counters {
    ($($(#[$doc:meta])* $name:ident,)*) => {
        /// Counters since the buffer was created. Each counter is exact, but they are not read at the same
        /// moment.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
        pub struct BufferCounters {
            $($(#[$doc])* pub $name: u64,)*
        }

        #[derive(Default)]
        pub(crate) struct AtomicBufferCounters {
            $(pub(crate) $name: AtomicU64,)*
        }

        impl AtomicBufferCounters {
            pub(crate) fn read(&self) -> BufferCounters {
                BufferCounters { $($name: self.$name.load(Ordering::Relaxed),)* }
            }
        }
    };
}

counters! {
    /// Transforms that were accepted.
    set,
    /// Accepted transforms whose stamp was earlier than the newest of their frame.
    out_of_order,
    /// Refused: a name is empty or too long, parent and child are the same, a number is not finite, or a rotation does not
    /// have length 1.
    invalid,
    /// Refused: too old, or older than samples that have already left the ring (TF_OLD_DATA).
    old,
    /// Refused: there is already a sample with this stamp (TF_REPEATED_DATA).
    repeated,
    /// Refused: there is no room for another name.
    frames_full,
    /// Calls of [`Writer::clear`](crate::Writer::clear).
    cleared,
}

/// Increments a counter. Only the writer may call this.
pub(crate) fn count(counter: &AtomicU64) {
    counter.store(counter.load(Ordering::Relaxed) + 1, Ordering::Relaxed);
}
