// SPDX-License-Identifier: MIT OR Apache-2.0
//! The memory of a buffer, and the paths in its tree.

use crate::counters::AtomicBufferCounters;
use crate::limits::Limits;
use crate::names::{FrameId, FrameName, Names};
use crate::ring::{Edge, FrameHead, Miss, Ring, TRIES};
use crate::slot::Slot;
use crate::sync::{AtomicU64, Ordering};
use crate::transform::Transform;
use crate::waiters::Waiters;

/// Maximum number of transforms from a frame to the root of its tree.
pub const MAX_DEPTH: usize = 64;

pub(crate) struct TransformTree {
    pub(crate) limits: Limits,
    pub(crate) cache_ns: i64,
    pub(crate) names: Names,
    newest: Box<[AtomicU64]>,
    slots: Box<[Slot]>,
    /// Calls of `clear` that have cleared all rings.
    epoch: AtomicU64,
    pub(crate) counts: AtomicBufferCounters,
    pub(crate) waiters: Waiters,
}

/// The time at which the tree is read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum When {
    Newest,
    At(i64),
}

/// The transform that takes coordinates in the source to coordinates in the target.
#[derive(Clone, Copy)]
pub(crate) struct Path {
    pub(crate) transform: Transform,
    /// The time for which it holds; `None`: for every time.
    pub(crate) stamp_ns: Option<i64>,
}

/// Why there is no path.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum PathError {
    Connectivity,
    Extrapolation { frame: FrameId, asked_ns: i64, oldest_ns: i64, newest_ns: i64 },
    Cycle { frame: FrameId },
    TooDeep,
    Overtaken,
}

/// A frame on the way from the source to its root.
#[derive(Clone, Copy)]
struct Stop {
    frame: u32,
    /// From the source to here.
    path: Path,
}

impl Limits {
    /// The memory of a buffer with these limits, exactly: 27 MB by default, nearly all of it samples of 104 bytes.
    pub fn bytes(&self) -> usize {
        let of_frame = size_of::<AtomicU64>() + self.ring() * size_of::<Slot>() + size_of::<FrameHead>();
        // The two words are the Arc's.
        self.frames * of_frame
            + Names::bytes(self.frames)
            + Waiters::bytes(self.waiters)
            + size_of::<TransformTree>()
            + 2 * size_of::<usize>()
    }
}

impl TransformTree {
    pub(crate) fn new(limits: Limits) -> TransformTree {
        let (frames, slots) = (limits.frames, limits.frames * limits.ring());
        TransformTree {
            limits,
            cache_ns: limits.cache_ns(),
            names: Names::new(frames),
            newest: (0..frames).map(|_| AtomicU64::new(0)).collect(),
            slots: (0..slots).map(|_| Slot::new()).collect(),
            epoch: AtomicU64::new(0),
            counts: AtomicBufferCounters::default(),
            waiters: Waiters::new(limits.waiters),
        }
    }

    pub(crate) fn name(&self, frame: FrameId) -> Option<FrameName> {
        self.names.get(frame).filter(|_| (frame.0 as usize) < self.names.len())
    }

    pub(crate) fn ring(&self, frame: FrameId) -> Option<Ring<'_>> {
        let (number, samples) = (frame.0 as usize, self.limits.ring());
        let newest = self.newest.get(number)?;
        Some(Ring { newest, slots: self.slots.get(number * samples..(number + 1) * samples)? })
    }

    /// Removes all samples except static ones. Only the writer may call this.
    pub(crate) fn clear(&self, heads: &mut [FrameHead]) {
        for (number, head) in (0..).zip(heads) {
            if let Some(ring) = self.ring(FrameId(number)) {
                ring.clear(head);
            }
        }
        // Release: pairs with the first Acquire in `in_one_epoch`. A reader that begins in the new epoch finds every ring empty; a
        // reader that began before it, and finds a sample that was set since, sees that the epoch has changed.
        let epoch = self.epoch.load(Ordering::Relaxed);
        self.epoch.store(epoch + 1, Ordering::Release);
    }

    /// Reads without a `clear` in between.
    pub(crate) fn in_one_epoch<R>(&self, read: impl Fn() -> Result<R, PathError>) -> Result<R, PathError> {
        for _ in 0..TRIES {
            // Acquire: pairs with the Release in `clear`.
            let epoch = self.epoch.load(Ordering::Acquire);
            let read = read();
            // After what was read, as rings and slots are read with Acquire, which pairs with the Releases of `set`.
            if self.epoch.load(Ordering::Relaxed) == epoch {
                return read;
            }
        }
        Err(PathError::Overtaken)
    }

    /// The path from `source` to `target` at a stamp, or at the latest common time of the frames on the way.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall. Reads every frame from the source to the root and from the target to the
    /// first of those, [`MAX_DEPTH`] of each at most, at the cost of `Ring::at`; for the latest common time also the
    /// newest sample of each.
    pub(crate) fn path(
        &self,
        target: FrameId,
        source: FrameId,
        stamp_ns: Option<i64>,
    ) -> Result<Path, PathError> {
        let Some(stamp_ns) = stamp_ns else {
            if target == source {
                let stamp_ns = self.edge(source, When::Newest)?.and_then(|edge| edge.stamp_ns);
                return Ok(Path { transform: Transform::IDENTITY, stamp_ns });
            }
            return self.latest(target, source);
        };
        let path = self.walk(target, source, When::At(stamp_ns))?;
        Ok(Path { stamp_ns: Some(stamp_ns), ..path })
    }

    fn latest(&self, target: FrameId, source: FrameId) -> Result<Path, PathError> {
        let mut tried = None;
        let mut path = Err(PathError::Overtaken);
        for _ in 0..TRIES {
            let newest = self.walk(target, source, When::Newest)?;
            let Some(common_ns) = newest.stamp_ns else { return Ok(newest) };
            // That time may have left the ring by now, if there is a later one.
            if tried == Some(common_ns) {
                break;
            }
            path = self.path(target, source, Some(common_ns));
            if !matches!(path, Err(PathError::Extrapolation { .. })) {
                break;
            }
            tried = Some(common_ns);
        }
        path
    }

    /// Walks the path from `source` to `target`. Its stamp is the oldest one of the transforms on it.
    fn walk(&self, target: FrameId, source: FrameId, when: When) -> Result<Path, PathError> {
        let start = Path { transform: Transform::IDENTITY, stamp_ns: None };
        if target == source {
            return Ok(start);
        }
        let mut stops = [Stop { frame: source.0, path: start }; MAX_DEPTH + 1];
        let mut len = 1;
        // The path above the first common frame is not needed: its error matters only if there is no common frame.
        let mut error = PathError::Connectivity;
        loop {
            let Stop { frame, path } = stops[len - 1];
            if frame == target.0 {
                return Ok(path);
            }
            let edge = match self.edge(FrameId(frame), when) {
                Ok(Some(edge)) => edge,
                Ok(None) => break,
                Err(miss) => {
                    error = miss;
                    break;
                }
            };
            if stops[..len].iter().any(|stop| stop.frame == edge.parent) {
                error = PathError::Cycle { frame: FrameId(edge.parent) };
                break;
            }
            let Some(stop) = stops.get_mut(len) else {
                error = PathError::TooDeep;
                break;
            };
            *stop = Stop { frame: edge.parent, path: path.up(&edge) };
            len += 1;
        }
        let (mut frame, mut from_target) = (target, start);
        // A cycle is distinguished from a path that is too long by a frame that occurs twice.
        let mut passed = [target.0; MAX_DEPTH];
        for depth in 0..=MAX_DEPTH {
            if let Some(common) = stops[..len].iter().find(|stop| stop.frame == frame.0) {
                return Ok(Path {
                    transform: from_target.transform.inverse() * common.path.transform,
                    stamp_ns: oldest(from_target.stamp_ns, common.path.stamp_ns),
                });
            }
            let Some(edge) = self.edge(frame, when)? else { return Err(error) };
            let Some(place) = passed.get_mut(depth) else { break };
            *place = frame.0;
            if passed[..=depth].contains(&edge.parent) {
                return Err(PathError::Cycle { frame: FrameId(edge.parent) });
            }
            from_target = from_target.up(&edge);
            frame = FrameId(edge.parent);
        }
        Err(PathError::TooDeep)
    }

    fn edge(&self, frame: FrameId, when: When) -> Result<Option<Edge>, PathError> {
        let Some(ring) = self.ring(frame) else { return Ok(None) };
        let edge = match when {
            When::Newest => ring.newest().map(|newest| newest.map(|newest| newest.edge())),
            When::At(stamp_ns) => ring.at(stamp_ns, self.cache_ns),
        };
        edge.map_err(|miss| match (miss, when) {
            (Miss::Extrapolation { oldest_ns, newest_ns }, When::At(asked_ns)) => {
                PathError::Extrapolation { frame, asked_ns, oldest_ns, newest_ns }
            }
            _ => PathError::Overtaken,
        })
    }
}

impl Path {
    fn up(&self, edge: &Edge) -> Path {
        Path { transform: edge.transform * self.transform, stamp_ns: oldest(edge.stamp_ns, self.stamp_ns) }
    }
}

/// The older one of two stamps, of those that exist.
fn oldest(one: Option<i64>, other: Option<i64>) -> Option<i64> {
    one.into_iter().chain(other).min()
}
