// SPDX-License-Identifier: MIT OR Apache-2.0
//! Errors, none of which allocates; they name the frames and the fix.

use std::fmt;
use std::sync::Arc;

use crate::names::{FrameId, FrameName};
use crate::tree::{MAX_DEPTH, TransformTree};

/// A frame of a buffer, from which its name can be read: for errors, which are then small and allocate nothing. It keeps the
/// buffer alive.
#[derive(Clone)]
pub struct NamedFrame {
    tree: Arc<TransformTree>,
    frame: FrameId,
}

impl NamedFrame {
    pub(crate) fn new(tree: &Arc<TransformTree>, frame: FrameId) -> NamedFrame {
        NamedFrame { tree: tree.clone(), frame }
    }

    /// Its name.
    #[must_use = "it only returns the name"]
    pub fn name(&self) -> FrameName {
        self.tree.name(self.frame).unwrap_or(FrameName::FOREIGN)
    }
}

impl PartialEq for NamedFrame {
    fn eq(&self, other: &NamedFrame) -> bool {
        self.name() == other.name()
    }
}

impl Eq for NamedFrame {}

impl fmt::Display for NamedFrame {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(&self.name(), f)
    }
}

impl fmt::Debug for NamedFrame {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Debug::fmt(&self.name(), f)
    }
}

/// Why there is no transform from `source` to `target`. The kinds are those of tf2, and the additional ones
/// of a bounded buffer.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[allow(missing_docs, reason = "the names of the fields say it")]
pub enum LookupError {
    /// It is not a valid frame name. tf2: `InvalidArgumentException`.
    #[error(
        "'{name}' is not a frame name: use one of 1 to {} bytes without a zero byte",
        FrameName::MAX_BYTES
    )]
    InvalidArgument {
        /// The name, truncated if it is too long.
        name: FrameName,
    },
    /// No transform was set with this name. tf2: `LookupException`.
    #[error(
        "frame '{frame}' does not exist: no transform has named it as parent or child. Check its spelling, or wait for it (Buffer::wait_for)"
    )]
    Lookup { frame: FrameName },
    /// Both frames exist, but in two trees. tf2: `ConnectivityException`.
    #[error(
        "no transform from '{source_frame}' to '{target}': they are not in one tree. See Buffer::frames for the parents, and who should broadcast the missing one"
    )]
    Connectivity { target: NamedFrame, source_frame: NamedFrame },
    /// A frame on the path has no samples around the requested time. tf2: `ExtrapolationException`.
    #[error("no transform from '{source_frame}' to '{target}' at {}: {}", Seconds(*.asked_ns), Span(.frame, *.asked_ns, *.oldest_ns, *.newest_ns))]
    Extrapolation {
        target: NamedFrame,
        source_frame: NamedFrame,
        /// The frame on the path.
        frame: NamedFrame,
        asked_ns: i64,
        oldest_ns: i64,
        newest_ns: i64,
    },
    /// A frame is its own ancestor.
    #[error(
        "no transform from '{source_frame}' to '{target}': the tree has a cycle through '{frame}'. Two broadcasters disagree about a frame's parent: see Buffer::frames"
    )]
    Cycle {
        target: NamedFrame,
        source_frame: NamedFrame,
        /// A frame of the cycle.
        frame: NamedFrame,
    },
    /// There are more than [`MAX_DEPTH`] transforms between a frame and its root.
    #[error(
        "no transform from '{source_frame}' to '{target}': more than {MAX_DEPTH} transforms to the root (MAX_DEPTH). Join fixed frames into one static transform"
    )]
    TooDeep { target: NamedFrame, source_frame: NamedFrame },
    /// Each of several lookups was interrupted by whole rings of new samples, or by a `clear`.
    #[error(
        "no transform from '{source_frame}' to '{target}': it was overwritten while being read. Raise Limits::samples or the reader's priority, or ask again"
    )]
    Overtaken { target: NamedFrame, source_frame: NamedFrame },
}

/// Why a wait ended without a transform.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum WaitError {
    /// The transform does not exist and can no longer be set.
    #[error(transparent)]
    Lookup(#[from] LookupError),
    /// The maximum number of futures is waiting.
    #[error("{waiters} futures wait for transforms already: raise Limits::waiters")]
    WaitersFull {
        /// The limit.
        waiters: usize,
    },
}

/// Why a transform was not accepted. Only a counter has changed.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[allow(missing_docs, reason = "the names of the fields say it")]
pub enum SetError {
    /// It is not a valid frame name (TF_NO_FRAME_ID, TF_NO_CHILD_FRAME_ID).
    #[error(
        "'{name}' is not a frame name: use one of 1 to {} bytes without a zero byte",
        FrameName::MAX_BYTES
    )]
    InvalidName {
        /// The name, truncated if it is too long.
        name: FrameName,
    },
    /// Parent and child are the same (TF_SELF_TRANSFORM).
    #[error("frame '{frame}' cannot be its own parent: name another parent or child")]
    SelfTransform { frame: FrameName },
    /// A number is infinite or NaN (TF_NAN_INPUT).
    #[error("the transform of '{child}' has a number that is not finite: check what computes it")]
    NotFinite { child: FrameName },
    /// The rotation's length is not 1 (TF_DENORMALIZED_QUATERNION).
    #[error(
        "the rotation of '{child}' has the squared length {squared_length}, which is off 1 by 0.01 or more: normalise it"
    )]
    Denormalized { child: FrameName, squared_length: f64 },
    /// It is older than the kept samples (TF_OLD_DATA).
    #[error("the transform of '{child}' at {} is too old: only samples after {} are kept. Send it sooner, or raise Limits::cache_time and Limits::samples; after time was set back, call Writer::clear", Seconds(*.stamp_ns), Seconds(*.above_ns))]
    Old {
        child: FrameName,
        stamp_ns: i64,
        /// Only later stamps than this one are accepted.
        above_ns: i64,
    },
    /// There is already a sample with this stamp (TF_REPEATED_DATA).
    #[error("there is a transform of '{child}' at {} already: the first one stays. Let one broadcaster send it, once per stamp", Seconds(*.stamp_ns))]
    Repeated { child: FrameName, stamp_ns: i64 },
    /// There is no room for another name.
    #[error("no room for frame '{frame}' beside {frames} others: raise Limits::frames")]
    FramesFull {
        frame: FrameName,
        /// The limit.
        frames: usize,
    },
}

/// Nanoseconds as seconds, exactly.
pub(crate) struct Seconds(pub(crate) i64);

impl fmt::Display for Seconds {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (sign, ns) = (if self.0 < 0 { "-" } else { "" }, self.0.unsigned_abs());
        write!(f, "{sign}{}.{:09} s", ns / 1_000_000_000, ns % 1_000_000_000)
    }
}

struct Span<'e>(&'e NamedFrame, i64, i64, i64);

impl fmt::Display for Span<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Span(frame, asked_ns, oldest_ns, newest_ns) = *self;
        let (when, fix) = if asked_ns > newest_ns {
            ("future", "Wait for it (Buffer::wait_for), or ask for Time::Latest")
        } else {
            ("past", "Raise Limits::cache_time and Limits::samples, or ask for a later time")
        };
        write!(f, "that is in the {when} of frame '{frame}', which has ")?;
        if oldest_ns == newest_ns {
            write!(f, "one sample at {}", Seconds(oldest_ns))?;
        } else {
            write!(f, "samples from {} to {}", Seconds(oldest_ns), Seconds(newest_ns))?;
        }
        write!(f, ". {fix}")
    }
}
