// SPDX-License-Identifier: MIT OR Apache-2.0
//! How much a buffer holds. All of its memory follows from this.

use std::time::Duration;

use crate::tree::TransformTree;

/// What a [`Buffer`](crate::Buffer) holds. Its memory is allocated when it is made, and never after.
///
/// ```
/// # use tautline_tf::Limits;
/// let small = Limits { frames: 32, samples: 256, ..Limits::default() };
/// assert!(small.bytes() < 1_000_000);
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// Frames that may be named, roots among them. From 2 to 2^24. Frames are never removed.
    pub frames: usize,
    /// Samples that are kept of each frame. From 2 to 2^24, rounded up to a power of two. At `cache_time` of 10 s, 1000 of
    /// them hold a broadcaster of 100 Hz.
    pub samples: usize,
    /// Samples older than a frame's newest by more than this are as if they were not there. As in tf2, 10 s by default.
    pub cache_time: Duration,
    /// How many futures of [`Buffer::wait_for`](crate::Buffer::wait_for) may wait at a time. At most 2^24.
    pub waiters: usize,
}

/// A limit is out of its range.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("Limits::{limit} is {is}: take one from {least} to {most}")]
pub struct LimitsError {
    /// The field of [`Limits`].
    pub limit: &'static str,
    /// What it is.
    pub is: usize,
    /// The smallest that is possible.
    pub least: usize,
    /// The largest that is possible.
    pub most: usize,
}

const MOST: usize = 1 << 24;

impl Default for Limits {
    fn default() -> Limits {
        Limits { frames: 256, samples: 1000, cache_time: Duration::from_secs(10), waiters: 64 }
    }
}

impl Limits {
    /// The memory of a buffer with these limits, exactly: 27 MB by default, nearly all of it samples of 104 bytes.
    pub fn bytes(&self) -> usize {
        TransformTree::bytes(self)
    }

    pub(crate) fn ring(&self) -> usize {
        self.samples.next_power_of_two()
    }

    pub(crate) fn cache_ns(&self) -> i64 {
        i64::try_from(self.cache_time.as_nanos()).unwrap_or(i64::MAX)
    }

    pub(crate) fn check(&self) -> Result<(), LimitsError> {
        for (limit, is, least) in
            [("frames", self.frames, 2), ("samples", self.samples, 2), ("waiters", self.waiters, 0)]
        {
            if !(least..=MOST).contains(&is) {
                return Err(LimitsError { limit, is, least, most: MOST });
            }
        }
        Ok(())
    }
}
