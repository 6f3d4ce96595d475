// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the writer took and refused.

use crate::sync::{AtomicU64, Ordering};

macro_rules! counters {
    ($($(#[$doc:meta])* $name:ident,)*) => {
        /// What has been set since the buffer was made. Each is exact; they are not of one moment.
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
    /// Transforms that were taken.
    set,
    /// Of those, the ones whose stamp was below the newest of their frame.
    out_of_order,
    /// Refused: a name is empty, too long or the same as the other one, a number is not finite, a rotation is not of length 1.
    invalid,
    /// Refused: too old, or below what has left the ring (TF_OLD_DATA).
    old,
    /// Refused: there is one with this stamp (TF_REPEATED_DATA).
    repeated,
    /// Refused: there is no room for another name.
    frames_full,
    /// Calls of [`Writer::clear`](crate::Writer::clear).
    cleared,
}

/// Counts. Only the writer may.
pub(crate) fn count(counter: &AtomicU64) {
    counter.store(counter.load(Ordering::Relaxed) + 1, Ordering::Relaxed);
}
