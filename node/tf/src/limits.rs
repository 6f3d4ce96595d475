// SPDX-License-Identifier: MIT OR Apache-2.0
//! The limits of a buffer. They determine all of its memory.

use std::time::Duration;

/// The limits of a [`Buffer`](crate::Buffer). Its memory is allocated when it is created, and never later.
///
/// ```
/// # use tautline_tf::Limits;
/// let small = Limits { frames: 32, samples: 256, ..Limits::default() };
/// assert!(small.bytes() < 1_000_000);
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// Maximum number of frames, including roots. From 2 to 2^24. Frames are never removed.
    pub frames: usize,
    /// Number of samples kept per frame. From 2 to 2^24, rounded up to a power of two. With a `cache_time` of 10 s, 1000
    /// samples are enough for a broadcaster at 100 Hz.
    pub samples: usize,
    /// Samples older than a frame's newest sample by more than this are ignored. As in tf2, 10 s by default.
    pub cache_time: Duration,
    /// Maximum of waiting futures of [`Buffer::wait_for`](crate::Buffer::wait_for). At most 2^24.
    pub waiters: usize,
}

/// A limit is out of its range.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("Limits::{limit} is {is}: use a value from {least} to {most}")]
pub struct LimitsError {
    /// The field of [`Limits`].
    pub limit: &'static str,
    /// Its value.
    pub is: usize,
    /// The minimum.
    pub least: usize,
    /// The maximum.
    pub most: usize,
}

const MOST: usize = 1 << 24;

impl Default for Limits {
    fn default() -> Limits {
        Limits { frames: 256, samples: 1000, cache_time: Duration::from_secs(10), waiters: 64 }
    }
}

impl Limits {
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
