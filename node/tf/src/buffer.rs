// SPDX-License-Identifier: MIT OR Apache-2.0
//! The reading side of the buffer.

use std::fmt::Write;
use std::sync::Arc;

use crate::counters::BufferCounters;
use crate::error::{LookupError, NamedFrame, Seconds};
use crate::limits::{Limits, LimitsError};
use crate::names::{FrameId, FrameName};
use crate::slot::Kind;
use crate::transform::Transform;
use crate::tree::{Path, PathError, TransformTree};
use crate::writer::Writer;
use sealed::Resolve;

/// Looks up transforms between frames. Clones refer to the same buffer; any number of threads may use it.
#[derive(Clone)]
pub struct Buffer {
    pub(crate) tree: Arc<TransformTree>,
}

/// For which time a transform is looked up.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Time {
    /// The latest time for which all frames on the path have samples: tf2's `TimePointZero`.
    Latest,
    /// A stamp, in nanoseconds.
    At(i64),
}

impl Time {
    pub(crate) fn stamp_ns(self) -> Option<i64> {
        match self {
            Time::Latest => None,
            Time::At(stamp_ns) => Some(stamp_ns),
        }
    }
}

/// A transform and the time for which it is valid.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Stamped {
    /// The time: as requested, or the latest common time. `None`: the latest was requested, and all transforms are
    /// static.
    pub stamp_ns: Option<i64>,
    /// Takes coordinates in the source frame to coordinates in the target frame.
    pub transform: Transform,
}

/// Information about a frame.
#[derive(Debug, Clone, PartialEq)]
pub struct FrameInfo {
    /// Its name.
    pub name: FrameName,
    /// The newest parent, and the kind of the frame's samples. `None` for roots.
    pub parent: Option<(FrameName, Kind)>,
    /// Oldest and newest stamp; for a static transform, its stamp.
    pub stamps_ns: Option<(i64, i64)>,
    /// The number of samples.
    pub samples: usize,
    /// Average number of samples per second from the oldest to the newest; zero if there is only one.
    pub rate_hz: f64,
}

/// A frame, by name or by number. A name is hashed at each lookup; a leading slash is removed.
pub trait Frame: sealed::Resolve {}

impl Frame for &str {}
impl Frame for FrameName {}
impl Frame for FrameId {}

pub(crate) mod sealed {
    use super::{Buffer, FrameId, FrameName, LookupError};

    pub trait Resolve {
        fn find(&self, buffer: &Buffer) -> Result<FrameId, LookupError>;
        fn name(&self, buffer: &Buffer) -> Result<FrameName, LookupError>;
    }
}

impl Resolve for &str {
    fn find(&self, buffer: &Buffer) -> Result<FrameId, LookupError> {
        self.name(buffer)?.find(buffer)
    }

    fn name(&self, _: &Buffer) -> Result<FrameName, LookupError> {
        FrameName::parse(self).map_err(|name| LookupError::InvalidArgument { name })
    }
}

impl Resolve for FrameName {
    fn find(&self, buffer: &Buffer) -> Result<FrameId, LookupError> {
        buffer.tree.names.find(self).ok_or(LookupError::Lookup { frame: *self })
    }

    fn name(&self, _: &Buffer) -> Result<FrameName, LookupError> {
        Ok(*self)
    }
}

impl Resolve for FrameId {
    fn find(&self, buffer: &Buffer) -> Result<FrameId, LookupError> {
        self.name(buffer).map(|_| *self)
    }

    fn name(&self, buffer: &Buffer) -> Result<FrameName, LookupError> {
        buffer.tree.name(*self).ok_or(LookupError::Lookup { frame: FrameName::FOREIGN })
    }
}

impl Buffer {
    /// Creates a buffer, and the writer that sets its transforms.
    ///
    /// # Real-time
    /// Setup only: allocates, and touches, [`Limits::bytes`].
    ///
    /// # Errors
    /// If a limit is out of its range.
    pub fn new(limits: Limits) -> Result<(Writer, Buffer), LimitsError> {
        limits.check()?;
        let tree = Arc::new(TransformTree::new(limits));
        Ok((Writer::new(tree.clone()), Buffer { tree }))
    }

    /// The number of a frame that a transform has named.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall. Compares one or two names; in the worst case all.
    pub fn frame(&self, name: &str) -> Option<FrameId> {
        Resolve::find(&name, self).ok()
    }

    /// The name of a frame of this buffer.
    pub fn name(&self, frame: FrameId) -> Option<FrameName> {
        self.tree.name(frame)
    }

    /// The transform that takes coordinates in `source` to coordinates in `target`.
    ///
    /// Between two samples it is interpolated; it is never extrapolated. Each transform on the path was in the buffer at
    /// some moment during the lookup, and a lookup never combines transforms from before and after a [`Writer::clear`].
    /// If the tree changes meanwhile, the path may use the old position of one frame and the new position of another:
    /// request a time at which the tree did not change.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall. At most 2 × [`MAX_DEPTH`](crate::MAX_DEPTH) frames, each of which costs
    /// log2(samples) + 4 slots, plus the slots of late samples around the time. Twice that if the transform does not
    /// exist, three times for [`Time::Latest`], and all of it up to three times if there is a `clear` meanwhile.
    ///
    /// # Errors
    /// See [`LookupError`].
    pub fn lookup(&self, target: impl Frame, source: impl Frame, time: Time) -> Result<Stamped, LookupError> {
        let (target, source) = (target.find(self)?, source.find(self)?);
        self.find(target, source, time).map_err(|error| self.explain(target, source, error))
    }

    /// The transform that takes coordinates in `source` at `source_time` to coordinates in `target` at `target_time`, if
    /// objects that are fixed in `fixed` do not move in between. Its stamp is that of `target_time`.
    ///
    /// # Real-time
    /// As two calls of [`lookup`](Self::lookup).
    ///
    /// # Errors
    /// See [`LookupError`]; it names `fixed` and the frame from or to which there is no path.
    pub fn lookup_full(
        &self,
        target: impl Frame,
        target_time: Time,
        source: impl Frame,
        source_time: Time,
        fixed: impl Frame,
    ) -> Result<Stamped, LookupError> {
        let (target, source, fixed) = (target.find(self)?, source.find(self)?, fixed.find(self)?);
        let way = |target, source, time: Time| {
            self.tree.path(target, source, time.stamp_ns()).map_err(|error| (target, source, error))
        };
        // The inner error is that of one of the two paths, the outer one that of the epoch.
        let paths = self.tree.in_one_epoch(|| {
            let both = || Ok((way(fixed, source, source_time)?, way(target, fixed, target_time)?));
            Ok(both())
        });
        match paths {
            Ok(Ok((first, second))) => {
                Ok(Stamped { stamp_ns: second.stamp_ns, transform: second.transform * first.transform })
            }
            Ok(Err((target, source, error))) => Err(self.explain(target, source, error)),
            Err(error) => Err(self.explain(target, source, error)),
        }
    }

    /// Whether [`lookup`](Self::lookup) would find a transform.
    ///
    /// # Real-time
    /// As `lookup`.
    pub fn can_transform(&self, target: impl Frame, source: impl Frame, time: Time) -> bool {
        match (target.find(self), source.find(self)) {
            (Ok(target), Ok(source)) => self.find(target, source, time).is_ok(),
            _ => false,
        }
    }

    /// Counters of transforms that were set and refused so far.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    pub fn counters(&self) -> BufferCounters {
        self.tree.counts.read()
    }

    /// The limits of the buffer.
    pub fn limits(&self) -> Limits {
        self.tree.limits
    }

    /// All frames, in the order in which they were first named.
    ///
    /// # Real-time
    /// Allocates, and reads all samples.
    pub fn frames(&self) -> Vec<FrameInfo> {
        let frames = (0..self.tree.names.len() as u32).map(FrameId);
        frames.filter_map(|frame| self.info(frame)).collect()
    }

    /// All frames that have a parent, as tf2's tools print them, without the broadcasters' names.
    ///
    /// # Real-time
    /// Allocates, and reads all samples.
    pub fn all_frames_as_yaml(&self) -> String {
        let mut yaml = String::new();
        for FrameInfo { name, parent, stamps_ns, rate_hz, .. } in self.frames() {
            if let (Some((parent, _)), Some((oldest_ns, newest_ns))) = (parent, stamps_ns) {
                let seconds = |ns| Seconds(ns).to_string().replace(" s", "");
                let (oldest, newest) = (seconds(oldest_ns), seconds(newest_ns));
                let length = seconds(newest_ns.saturating_sub(oldest_ns));
                // Writing to a String does not fail.
                let _ = write!(
                    yaml,
                    "{}:\n  parent: {}\n  rate: {rate_hz:.3}\n  most_recent_transform: {newest}\n  oldest_transform: {oldest}\n  buffer_length: {length}\n",
                    quoted(&name),
                    quoted(&parent),
                );
            }
        }
        yaml
    }

    fn info(&self, frame: FrameId) -> Option<FrameInfo> {
        let (tree, name) = (&self.tree, self.name(frame)?);
        let ring = tree.ring(frame)?;
        let mut info = FrameInfo { name, parent: None, stamps_ns: None, samples: 0, rate_hz: 0.0 };
        let Some(newest) = ring.newest().ok().flatten() else { return Some(info) };
        info.parent = self.name(FrameId(newest.parent)).map(|parent| (parent, newest.kind));
        let (oldest_ns, newest_ns, samples) = match newest.kind {
            Kind::Static => (newest.stamp_ns, newest.stamp_ns, 1),
            Kind::Dynamic => ring.span(tree.cache_ns).unwrap_or((newest.stamp_ns, newest.stamp_ns, 1)),
        };
        (info.stamps_ns, info.samples) = (Some((oldest_ns, newest_ns)), samples);
        if newest_ns > oldest_ns {
            info.rate_hz = (samples as f64 - 1.0) / (newest_ns.saturating_sub(oldest_ns) as f64 / 1e9);
        }
        Some(info)
    }

    pub(crate) fn find(&self, target: FrameId, source: FrameId, time: Time) -> Result<Stamped, PathError> {
        let path = self.tree.in_one_epoch(|| self.tree.path(target, source, time.stamp_ns()))?;
        let Path { transform, stamp_ns } = path;
        Ok(Stamped { stamp_ns, transform })
    }

    pub(crate) fn explain(&self, target: FrameId, source: FrameId, error: PathError) -> LookupError {
        let name = |frame| NamedFrame::new(&self.tree, frame);
        let (target, source_frame) = (name(target), name(source));
        match error {
            PathError::Connectivity => LookupError::Connectivity { target, source_frame },
            PathError::Extrapolation { frame, asked_ns, oldest_ns, newest_ns } => {
                let frame = name(frame);
                LookupError::Extrapolation { target, source_frame, frame, asked_ns, oldest_ns, newest_ns }
            }
            PathError::Cycle { frame } => LookupError::Cycle { target, source_frame, frame: name(frame) },
            PathError::TooDeep => LookupError::TooDeep { target, source_frame },
            PathError::Overtaken => LookupError::Overtaken { target, source_frame },
        }
    }
}

fn quoted(name: &FrameName) -> String {
    format!("'{}'", name.as_str().replace('\'', "''"))
}
