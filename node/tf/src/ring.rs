// SPDX-License-Identifier: MIT OR Apache-2.0
//! The samples of one frame: a ring in the order in which they were set, and a list in the order of their stamps.
//!
//! Samples are numbered in the order in which they are set; number n lies at n modulo the ring's length. Each sample
//! also names the sample with the next older stamp. `newest` is the only word besides the slots that readers share:
//!
//! ```text
//!  number    7      8      9      10     11          newest = 10
//!  stamp     70  <- 80  <-,90     100    85          11 came late: written first, then linked between 9 and 8
//!             \________/   \_____/^ \____^
//!  newest_ns 70     80     90     100    100         never falls: binary search
//! ```
//!
//! To find the samples around a stamp, a reader searches by number for the first sample that was the newest when it was
//! set and is later than the stamp, and follows the list from there, only past late samples. Nothing that readers can
//! see moves, so they never retry. If a number is missing, the sample and all older samples have left the ring.

use crate::slot::{Kind, Sample, Slot};
use crate::sync::{AtomicU64, Ordering};
use crate::transform::Transform;

/// Maximum of attempts of a read that whole rings of new samples, or a `clear`, interrupt.
pub(crate) const TRIES: usize = 3;

/// The transform of a frame in its parent at one time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Edge {
    pub(crate) parent: u32,
    pub(crate) transform: Transform,
    /// `None` for static transforms.
    pub(crate) stamp_ns: Option<i64>,
}

/// Why there is no edge.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Miss {
    /// The stamp is not between the oldest and the newest.
    Extrapolation { oldest_ns: i64, newest_ns: i64 },
    /// The writer has set whole rings of samples while this one was read.
    Overtaken,
}

/// The writer's state of a frame.
#[derive(Clone, Copy, Default)]
pub(crate) struct FrameHead {
    next: u64,
    run: Option<Run>,
}

#[derive(Clone, Copy)]
struct Run {
    kind: Kind,
    first: u64,
    newest: u64,
    newest_ns: i64,
    parent: u32,
    /// The newest stamp that has left the ring: samples that are not later are no longer accepted.
    gone_ns: Option<i64>,
}

/// A sample that the writer sets.
pub(crate) struct New {
    pub(crate) stamp_ns: i64,
    pub(crate) parent: u32,
    pub(crate) kind: Kind,
    pub(crate) transform: Transform,
}

/// How a sample was stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct StoreResult {
    /// Its stamp is not the newest.
    pub(crate) late: bool,
    /// The frame has a parent that it did not have before, or is of the other kind.
    pub(crate) moved: bool,
}

/// Why a sample was not stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Refused {
    /// Only samples later than this stamp are kept.
    Old {
        above_ns: i64,
    },
    Repeated,
}

#[derive(Clone, Copy)]
pub(crate) struct Ring<'m> {
    /// Number + 1 of the newest sample; zero: none.
    pub(crate) newest: &'m AtomicU64,
    /// The number of slots is a power of two, at least two.
    pub(crate) slots: &'m [Slot],
}

impl Ring<'_> {
    fn slot(&self, number: u64) -> &Slot {
        &self.slots[number as usize & (self.slots.len() - 1)]
    }

    fn read(&self, number: u64) -> Option<Sample> {
        self.slot(number).read(number)
    }

    /// Stores a sample. Only the writer may call this; `head` is the frame's.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall. Writes one slot; if the stamp is not the newest, searches as `at` does.
    pub(crate) fn set(&self, head: &mut FrameHead, new: &New, cache_ns: i64) -> Result<StoreResult, Refused> {
        let number = head.next;
        let run = head.run.filter(|run| run.kind == new.kind);
        let mut next = run.unwrap_or(Run {
            kind: new.kind,
            first: number,
            newest: number,
            newest_ns: i64::MIN,
            parent: new.parent,
            gone_ns: None,
        });
        let mut newer = None;
        let mut older = None;
        if let Some(run) = run.filter(|_| new.kind == Kind::Dynamic) {
            let leaves = number.checked_sub(self.slots.len() as u64).filter(|leaves| *leaves >= run.first);
            next.gone_ns =
                run.gone_ns.max(leaves.and_then(|leaves| self.read(leaves)).map(|sample| sample.stamp_ns));
            older = Some(run.newest);
            if new.stamp_ns <= run.newest_ns {
                let (above, below) = self.between(&run, new.stamp_ns, cache_ns, next.gone_ns)?;
                (newer, older) = (Some(above), below);
            }
        }
        let late = newer.is_some();
        if !late {
            (next.newest, next.newest_ns, next.parent) = (number, new.stamp_ns, new.parent);
        }
        self.slot(number).write(&Sample {
            number,
            older,
            stamp_ns: new.stamp_ns,
            newest_ns: next.newest_ns,
            first: next.first,
            parent: new.parent,
            kind: new.kind,
            transform: new.transform,
        });
        match newer {
            Some(newer) => self.slot(newer).link(number),
            // Release: pairs with the Acquire in `newest`.
            None => self.newest.store(number + 1, Ordering::Release),
        }
        *head = FrameHead { next: number + 1, run: Some(next) };
        Ok(StoreResult { late, moved: run.is_none_or(|run| run.parent != new.parent) })
    }

    /// The samples between which a late sample belongs.
    fn between(
        &self,
        run: &Run,
        stamp_ns: i64,
        cache_ns: i64,
        gone_ns: Option<i64>,
    ) -> Result<(u64, Option<u64>), Refused> {
        if stamp_ns == run.newest_ns {
            return Err(Refused::Repeated);
        }
        let kept_ns = run.newest_ns.saturating_sub(cache_ns);
        let above_ns =
            gone_ns.map_or(kept_ns.saturating_sub(1), |gone_ns| gone_ns.max(kept_ns.saturating_sub(1)));
        if stamp_ns <= above_ns {
            return Err(Refused::Old { above_ns });
        }
        // All samples later than `gone_ns` are in the ring, and only this thread overwrites them.
        let enclosing = self.read(run.newest).and_then(|newest| self.enclosing(&newest, stamp_ns));
        match enclosing {
            Some((_, Some(older))) if older.stamp_ns == stamp_ns => Err(Refused::Repeated),
            Some((newer, older)) => Ok((newer.number, older.map(|older| older.number))),
            None => Err(Refused::Old { above_ns }),
        }
    }

    /// Removes all samples, unless they are static. Only the writer may call this.
    pub(crate) fn clear(&self, head: &mut FrameHead) {
        if head.run.is_some_and(|run| run.kind == Kind::Dynamic) {
            head.run = None;
            self.newest.store(0, Ordering::Release);
        }
    }

    pub(crate) fn newest(&self) -> Result<Option<Sample>, Miss> {
        for _ in 0..TRIES {
            // Acquire: pairs with the Release in `set`.
            let Some(number) = self.newest.load(Ordering::Acquire).checked_sub(1) else { return Ok(None) };
            if let Some(newest) = self.read(number) {
                return Ok(Some(newest));
            }
        }
        Err(Miss::Overtaken)
    }

    /// The transform at a stamp: `None` if none was set.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall. Reads log2(samples) + 4 slots, and those of the samples between two others
    /// that came late, which are at most all. Twice that to say what there is if the stamp is too old or too new.
    pub(crate) fn at(&self, stamp_ns: i64, cache_ns: i64) -> Result<Option<Edge>, Miss> {
        let Some(newest) = self.newest()? else { return Ok(None) };
        if newest.kind == Kind::Static || newest.stamp_ns == stamp_ns {
            return Ok(Some(newest.edge()));
        }
        let kept_ns = newest.stamp_ns.saturating_sub(cache_ns);
        if stamp_ns < newest.stamp_ns
            && let Some((newer, Some(older))) = self.enclosing(&newest, stamp_ns)
            && older.stamp_ns >= kept_ns
        {
            return Ok(Some(older.until(&newer, stamp_ns)));
        }
        Err(Miss::Extrapolation { oldest_ns: self.oldest_ns(&newest, kept_ns), newest_ns: newest.stamp_ns })
    }

    /// The two samples that enclose a stamp below `newest`'s: the first is later than the stamp, the second is not. `None` if the
    /// first one has left the ring.
    fn enclosing(&self, newest: &Sample, stamp_ns: i64) -> Option<(Sample, Option<Sample>)> {
        let mut newer = self.read(self.first_above(newest, stamp_ns))?;
        if newer.stamp_ns != newer.newest_ns {
            // The sample came late: the sample that was the newest then is later than the stamp, too, and has left the ring.
            return None;
        }
        // The bound ends the read of a list that gets longer meanwhile.
        for _ in 0..self.slots.len() {
            match newer.older.and_then(|older| self.read(older)) {
                Some(older) if older.stamp_ns > stamp_ns => newer = older,
                older => return Some((newer, older)),
            }
        }
        None
    }

    /// Number of the first sample in the ring at which `newest_ns` was above a stamp.
    fn first_above(&self, newest: &Sample, stamp_ns: i64) -> u64 {
        let ring = self.slots.len() as u64;
        let (mut low, mut high) = (newest.first.max((newest.number + 1).saturating_sub(ring)), newest.number);
        while low < high {
            let middle = low + (high - low) / 2;
            match self.slot(middle).newest_ns(middle) {
                Some(newest_ns) if newest_ns > stamp_ns => high = middle,
                // Not later than the stamp, or no longer in the ring, and neither are the samples before it.
                _ => low = middle + 1,
            }
        }
        high
    }

    /// The oldest stamp in the ring that is not below `kept_ns`.
    fn oldest_ns(&self, newest: &Sample, kept_ns: i64) -> i64 {
        let mut start = self.read(self.first_above(newest, kept_ns.saturating_sub(1)));
        if let Some(late) = start.filter(|start| start.stamp_ns != start.newest_ns) {
            start = self.read(self.first_above(newest, late.newest_ns));
        }
        let mut oldest_ns = newest.stamp_ns;
        let mut next = start;
        for _ in 0..self.slots.len() {
            let Some(sample) = next.filter(|sample| sample.stamp_ns >= kept_ns) else { break };
            oldest_ns = sample.stamp_ns;
            next = sample.older.and_then(|older| self.read(older));
        }
        oldest_ns
    }

    /// The oldest and the newest stamp, and the number of samples.
    pub(crate) fn span(&self, cache_ns: i64) -> Option<(i64, i64, usize)> {
        let newest = self.newest().ok()??;
        let kept_ns = newest.stamp_ns.saturating_sub(cache_ns);
        let next = |sample: &Sample| {
            sample.older.and_then(|older| self.read(older)).filter(|older| older.stamp_ns >= kept_ns)
        };
        let samples = std::iter::successors(Some(newest), next).take(self.slots.len());
        let (oldest_ns, count) =
            samples.fold((newest.stamp_ns, 0), |(_, count), sample| (sample.stamp_ns, count + 1));
        Some((oldest_ns, newest.stamp_ns, count))
    }
}

impl Sample {
    pub(crate) fn edge(&self) -> Edge {
        let stamp_ns = (self.kind == Kind::Dynamic).then_some(self.stamp_ns);
        Edge { parent: self.parent, transform: self.transform, stamp_ns }
    }

    /// The edge at a stamp from this sample's to before that of the next newer one. Nothing is interpolated from one
    /// parent to another: as in tf2, the older one holds until then.
    fn until(&self, newer: &Sample, stamp_ns: i64) -> Edge {
        let Edge { parent, mut transform, .. } = self.edge();
        if stamp_ns != self.stamp_ns && self.parent == newer.parent {
            // In i128, as stamps may be as far apart as they can.
            let after = |from_ns: i64, to_ns: i64| (i128::from(to_ns) - i128::from(from_ns)) as f64;
            let ratio = after(self.stamp_ns, stamp_ns) / after(self.stamp_ns, newer.stamp_ns);
            transform = transform.interpolate(&newer.transform, ratio);
        }
        Edge { parent, transform, stamp_ns: Some(stamp_ns) }
    }
}
