// SPDX-License-Identifier: MIT OR Apache-2.0
//! The writing side of the buffer.

use std::sync::Arc;

use crate::counters::count;
use crate::error::SetError;
use crate::names::{FrameId, FrameName};
use crate::ring::{FrameHead, New, Refused};
use crate::slot::Kind;
use crate::transform::Transform;
use crate::tree::TransformTree;

/// tf2's: how far the squared length of a rotation may be off 1.
const ROTATION_TOLERANCE: f64 = 10e-3;

/// The pose of frame `child` in frame `parent` at a time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TransformStamped<'n> {
    /// `header.frame_id`. A leading slash is removed.
    pub parent: &'n str,
    /// `child_frame_id`. A leading slash is removed.
    pub child: &'n str,
    /// `header.stamp`, in nanoseconds.
    pub stamp_ns: i64,
    /// Takes coordinates in `child` to coordinates in `parent`.
    pub transform: Transform,
}

/// Sets the transforms of its [`Buffer`](crate::Buffer). Each buffer has one writer.
pub struct Writer {
    tree: Arc<TransformTree>,
    heads: Box<[FrameHead]>,
}

impl Writer {
    pub(crate) fn new(tree: Arc<TransformTree>) -> Writer {
        let heads = vec![FrameHead::default(); tree.limits.frames].into_boxed_slice();
        Writer { tree, heads }
    }

    /// Stores a transform, and wakes the futures that wait for it. If a frame's transform is of another kind than
    /// before, its previous samples are removed, as in tf2. A frame may get a new parent, which is valid from this
    /// stamp on. Lookups detect whether the tree then has a cycle.
    ///
    /// A sample with a stamp earlier than the newest of its frame is inserted in order of stamps. It still counts as
    /// the sample set last: the ring removes the sample that was set first, together with all older samples.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall but the wakes. Two names are looked up and one sample is written. For a late
    /// sample there is first a search of log2(samples) + 4 slots, and of the late samples around its stamp, at most all.
    /// Then each of [`Limits::waiters`](crate::Limits::waiters) is checked, if any future waits.
    ///
    /// # Errors
    /// Invalid, old or repeated transforms are refused, and frames beyond
    /// [`Limits::frames`](crate::Limits::frames).
    pub fn set(&mut self, transform: &TransformStamped<'_>, kind: Kind) -> Result<(), SetError> {
        let set =
            self.check(transform).and_then(|(parent, child)| self.place(transform, kind, parent, child));
        let counts = &self.tree.counts;
        count(match set {
            Ok(()) => &counts.set,
            Err(SetError::Old { .. }) => &counts.old,
            Err(SetError::Repeated { .. }) => &counts.repeated,
            Err(SetError::FramesFull { .. }) => &counts.frames_full,
            Err(_) => &counts.invalid,
        });
        set
    }

    fn check(&self, stamped: &TransformStamped<'_>) -> Result<(FrameName, FrameName), SetError> {
        let name = |name| FrameName::parse(name).map_err(|name| SetError::InvalidName { name });
        let (parent, child) = (name(stamped.parent)?, name(stamped.child)?);
        if parent == child {
            return Err(SetError::SelfTransform { frame: child });
        }
        if !stamped.transform.is_finite() {
            return Err(SetError::NotFinite { child });
        }
        let squared_length = stamped.transform.rotation_squared();
        if (squared_length - 1.0).abs() >= ROTATION_TOLERANCE {
            return Err(SetError::Denormalized { child, squared_length });
        }
        Ok((parent, child))
    }

    fn place(
        &mut self,
        stamped: &TransformStamped<'_>,
        kind: Kind,
        parent: FrameName,
        child: FrameName,
    ) -> Result<(), SetError> {
        let (tree, stamp_ns) = (&*self.tree, stamped.stamp_ns);
        let full = |frame| SetError::FramesFull { frame, frames: tree.limits.frames };
        let ids = (tree.names.find(&parent), tree.names.find(&child));
        if tree.names.spare() < usize::from(ids.0.is_none()) + usize::from(ids.1.is_none()) {
            return Err(full(if ids.1.is_none() { child } else { parent }));
        }
        let id = |id: Option<FrameId>, name| id.or_else(|| tree.names.insert(&name)).ok_or(full(name));
        let (parent, frame) = (id(ids.0, parent)?, id(ids.1, child)?);
        let (Some(ring), Some(head)) = (tree.ring(frame), self.heads.get_mut(frame.0 as usize)) else {
            return Err(full(child));
        };
        let transform = stamped.transform.normalized();
        let taken = ring
            .set(head, &New { stamp_ns, parent: parent.0, kind, transform }, tree.cache_ns)
            .map_err(|refused| match refused {
                Refused::Old { above_ns } => SetError::Old { child, stamp_ns, above_ns },
                Refused::Repeated => SetError::Repeated { child, stamp_ns },
            })?;
        if taken.late {
            count(&tree.counts.out_of_order);
        }
        // A sample that is late, or moves its frame, may complete a path on which another sample was missing.
        tree.waiters.notify(frame, stamp_ns, taken.late || taken.moved);
        Ok(())
    }

    /// Removes all samples except those of static transforms, like tf2's `clear`: for simulated time that is set back.
    /// Names remain. A lookup at the same time finds either the state before or nothing, never some frames from before
    /// and some from after.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall. One store for each frame.
    pub fn clear(&mut self) {
        let known = self.tree.names.len();
        self.tree.clear(&mut self.heads[..known]);
        count(&self.tree.counts.cleared);
    }
}
