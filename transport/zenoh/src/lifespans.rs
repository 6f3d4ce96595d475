// SPDX-License-Identifier: MIT OR Apache-2.0
//! The lifespans of publishers on other hosts, for those who take their samples.

use std::collections::HashMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{PoisonError, RwLock};
use tautline_transport::Gid;

/// In nanoseconds, of those that have one: few, if any. Asked for every sample, changed when publishers come and go.
#[derive(Debug, Default)]
pub(crate) struct Lifespans {
    /// Whether there are any. Written under the lock, in the order in which the map changes.
    any: AtomicBool,
    of: RwLock<HashMap<Gid, u64>>,
}

impl Lifespans {
    /// Publisher `gid` has this one, or none any more.
    pub(crate) fn set(&self, gid: Gid, lifespan_ns: Option<u64>) {
        let mut of = self.of.write().unwrap_or_else(PoisonError::into_inner);
        match lifespan_ns {
            Some(lifespan_ns) => of.insert(gid, lifespan_ns),
            None => of.remove(&gid),
        };
        self.any.store(!of.is_empty(), Ordering::Relaxed);
    }

    /// What was set last; without a lock while nobody has one.
    ///
    /// Relaxed is enough: the flag guards no data, for the map has its lock. A read of false comes before the store of true of every
    /// `set` that adds the first lifespan, in the one order of the flag's values; had that `set` happened before the read, it would
    /// have been seen, as with every atomic.
    pub(crate) fn get(&self, gid: &Gid) -> Option<u64> {
        if !self.any.load(Ordering::Relaxed) {
            return None;
        }
        self.of.read().unwrap_or_else(PoisonError::into_inner).get(gid).copied()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lifespans_are_known_while_their_publishers_are() {
        let (a, b, none) = (Gid([1; 16]), Gid([2; 16]), Gid([3; 16]));
        let lifespans = Lifespans::default();
        let known = || [a, b, none].map(|gid| lifespans.get(&gid));
        assert_eq!(known(), [None; 3]);
        lifespans.set(none, None);
        lifespans.set(a, Some(1));
        lifespans.set(b, Some(2));
        assert_eq!(known(), [Some(1), Some(2), None]);
        lifespans.set(a, None);
        assert_eq!(known(), [None, Some(2), None]);
        lifespans.set(b, None);
        assert_eq!(known(), [None; 3]);
    }

    #[test]
    fn the_map_is_not_asked_while_nobody_has_one() {
        let (lifespans, gid) = (Lifespans::default(), Gid([1; 16]));
        // Without the flag, which no `set` does: who looked would find it.
        lifespans.of.write().unwrap().insert(gid, 1);
        assert_eq!(lifespans.get(&gid), None);
        lifespans.set(gid, Some(2));
        assert_eq!(lifespans.get(&gid), Some(2));
        lifespans.set(gid, None);
        lifespans.of.write().unwrap().insert(gid, 1);
        assert_eq!(lifespans.get(&gid), None);
    }
}
