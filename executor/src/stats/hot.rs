// SPDX-License-Identifier: MIT OR Apache-2.0
//! The hot path: recording a job.
#![deny(clippy::disallowed_methods, clippy::disallowed_types, clippy::disallowed_macros)]
#![deny(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing)]

use std::sync::atomic::{AtomicU64, Ordering};

use super::block::{self, word};
use super::callback::{CallbackStats, Job, QueueState};
use super::histogram::{Histogram, bucket_of};
use super::inputs::{Inputs, class_of};
use super::moments::{self, Moment, MomentKind, Moments};
use crate::options::{DeadlineMiss, Overrun, Watch};
use crate::sync::{Word, fence};

impl Histogram {
    /// Records one value. Only one thread may record; otherwise values are lost.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    pub fn record(&self, ns: u64) {
        let [buckets @ .., sum, max] = self.words() else { return };
        if ns > max.load(Ordering::Relaxed) {
            max.store(ns, Ordering::Relaxed);
        }
        add(sum, ns);
        if let Some(bucket) = buckets.get(bucket_of(ns)) {
            // Release: a reader that sees the count also sees the maximum.
            bucket.store(bucket.load(Ordering::Relaxed) + 1, Ordering::Release);
        }
    }
}

impl Moments {
    /// Stores a moment in place of the oldest one. Only one thread may write.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    pub fn note(&self, moment: &Moment) {
        note(self.words(), moment);
    }
}

/// See [`Moments::note`].
pub(super) fn note(words: &[impl Word], moment: &Moment) {
    let [written, entries @ .., begun] = words else { return };
    let number = written.load(Ordering::Relaxed);
    begun.store(number + 1, Ordering::Relaxed);
    // A reader that sees a word of the entry sees that it was begun: pairs with the Acquire of the reader.
    fence(Ordering::Release);
    let at = (number % moments::CAPACITY as u64) as usize * moments::ENTRY_WORDS;
    let length = moments::encode(moment.kind, moment.length_ns);
    for (index, value) in [moment.from_ns, moment.to_ns, length].into_iter().enumerate() {
        if let Some(word) = entries.get(at + index) {
            word.store(value, Ordering::Relaxed);
        }
    }
    // Release: the entry is complete when the count is visible.
    written.store(number + 1, Ordering::Release);
}

impl Inputs {
    /// Records a job with an input of this size. Only one thread may record.
    ///
    /// # Real-time
    /// Wait-free: 32 rows and 64 execution times at most; no allocation; no syscall.
    pub fn record(&self, size: u64, ns: u64) {
        let load = |word: &AtomicU64| word.load(Ordering::Relaxed);
        let (low, high) = class_of(size);
        let mut nearest = None;
        for row in self.rows() {
            let [jobs, least, greatest, ..] = row;
            // The distance is 0 to a row with sizes of this class, and to a free row.
            let distance = match load(jobs) {
                0 => 0,
                _ => load(least).saturating_sub(high).max(low.saturating_sub(load(greatest))),
            };
            if nearest.is_none_or(|(least, _)| distance < least) {
                nearest = Some((distance, row));
            }
            if distance == 0 {
                break;
            }
        }
        let Some((_, [jobs, least, greatest, max, size_of_max, longest @ ..])) = nearest else { return };
        let before = load(jobs);
        if before == 0 || size < load(least) {
            least.store(size, Ordering::Relaxed);
        }
        if size > load(greatest) {
            greatest.store(size, Ordering::Relaxed);
        }
        if before == 0 || ns > load(max) {
            max.store(ns, Ordering::Relaxed);
            size_of_max.store(size, Ordering::Relaxed);
        }
        if let Some(shortest) = longest.iter().min_by_key(|word| load(word)).filter(|word| ns > load(word)) {
            shortest.store(ns, Ordering::Relaxed);
        }
        // Release: a reader that sees the count sees sizes and a maximum that cover the job.
        jobs.store(before.wrapping_add(1), Ordering::Release);
    }
}

impl CallbackStats {
    pub(crate) fn note(&self, moment: &Moment) {
        if let Some(block) = self.block.get() {
            block.moments.note(moment);
        }
    }

    /// Whether a job with this response time is later than its bound.
    pub(crate) fn is_late(&self, response_ns: u64) -> bool {
        response_ns > self.limit_ns(CallbackStats::BOUND)
    }

    /// Returns a limit; `u64::MAX` if it is not set.
    fn limit_ns(&self, index: usize) -> u64 {
        match self.limits.get(index).map(|limit| limit.load(Ordering::Relaxed)) {
            Some(0) | None => u64::MAX,
            Some(ns) => ns,
        }
    }

    /// Records the start of a job.
    pub(crate) fn release(&self, release_ns: u64) {
        self.release_after(1, release_ns);
    }

    /// Records the start of a job. The distance to the previous release is recorded only after `uneven` releases.
    pub(crate) fn release_after(&self, uneven: u64, release_ns: u64) {
        let Some(head) = self.head() else { return };
        let last = &head[word::LAST_RELEASE];
        let last_ns = last.load(Ordering::Relaxed);
        let releases = head[word::RELEASES].load(Ordering::Relaxed);
        if releases == 0 {
            head[word::FIRST_RELEASE].store(release_ns, Ordering::Relaxed);
        } else if releases >= uneven {
            // Two streams of one callback may hand out their items in another order than that of their releases.
            let distance = block::encode_distance(release_ns.abs_diff(last_ns));
            let least = &head[word::LEAST_DISTANCE];
            let least_so_far = least.load(Ordering::Relaxed);
            if least_so_far == 0 || distance < least_so_far {
                least.store(distance, Ordering::Relaxed);
            }
            let greatest = &head[word::GREATEST_DISTANCE];
            if distance > greatest.load(Ordering::Relaxed) {
                greatest.store(distance, Ordering::Relaxed);
            }
        }
        if releases == 0 || release_ns > last_ns {
            last.store(release_ns, Ordering::Relaxed);
        }
        add(&head[word::RELEASES], 1);
    }

    /// Records the end of a job; returns the limits that it violated.
    pub(crate) fn complete(&self, job: &Job) -> Violations {
        let Some(block) = self.block.get() else { return Violations::default() };
        let Some(head) = block.head() else { return Violations::default() };
        let (deadline_ns, budget_ns) =
            (self.limit_ns(CallbackStats::DEADLINE), self.limit_ns(CallbackStats::BUDGET));
        let mut violations =
            Violations { job: head[word::COMPLETIONS].load(Ordering::Relaxed) + 1, ..Violations::default() };
        if job.response_ns > deadline_ns {
            violations.late_for_ns = Some(deadline_ns);
            add(&head[word::DEADLINE_MISSES], 1);
        }
        block.response.record(job.response_ns);
        let (from_ns, to_ns) = (job.release_ns, job.release_ns.saturating_add(job.response_ns));
        // A job is charged what its thread has used since the job before, which may be more than since its release.
        let note = |kind, length_ns| {
            let from_ns = from_ns.min(to_ns.saturating_sub(length_ns));
            block.moments.note(&Moment { kind, from_ns, to_ns, length_ns });
        };
        if self.is_late(job.response_ns) {
            note(MomentKind::Late, job.response_ns);
        }
        if let Some(ns) = job.execution_ns {
            block.execution.record(ns);
            if let Some(size) = job.input_size {
                block.inputs.record(size, ns);
            }
            if ns > budget_ns {
                violations.over_ns = Some(budget_ns);
                note(MomentKind::Overran, ns - budget_ns);
                add(&head[word::OVERRUNS], 1);
            }
        }
        add(&head[word::COMPLETIONS], 1);
        violations
    }

    /// Records a job of which only the publication is observed. Its distance counts as in [`release_after`](Self::release_after).
    pub(crate) fn publish(&self, uneven: u64, now_ns: u64) {
        self.release_after(uneven, now_ns);
        if let Some(head) = self.head() {
            add(&head[word::COMPLETIONS], 1);
        }
    }

    pub(crate) fn demoted(&self) {
        if let Some(head) = self.head() {
            add(&head[word::DEMOTIONS], 1);
        }
    }

    /// Records the state of the queue that a subscription of this callback found.
    pub(crate) fn note_queue(&self, queue: QueueState) {
        let Some(head) = self.head() else { return };
        if queue.lost != 0 {
            add(&head[word::LOST], queue.lost);
        }
        for (index, value) in [(word::MAX_QUEUE, queue.max_queue), (word::DEPTH, queue.depth)] {
            if let Some(most) = head.get(index)
                && value > most.load(Ordering::Relaxed)
            {
                most.store(value, Ordering::Relaxed);
            }
        }
    }
}

/// The limits that a job violated.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct Violations {
    job: u64,
    /// The budget, if the job used more.
    over_ns: Option<u64>,
    /// The deadline, if the job ended later.
    late_for_ns: Option<u64>,
}

impl Watch {
    /// Calls the handlers for the violated limits; returns whether one was called.
    pub(crate) fn call_handlers(&self, violations: Violations, done: &Job) -> bool {
        let Job { release_ns, response_ns, execution_ns, .. } = *done;
        let job = violations.job;
        let mut told = false;
        if let (Some(handler), Some(budget_ns), Some(execution_ns)) =
            (&self.on_overrun, violations.over_ns, execution_ns)
        {
            handler.call(&Overrun { job, release_ns, execution_ns, budget_ns });
            told = true;
        }
        if let (Some(handler), Some(deadline_ns)) = (&self.on_deadline_miss, violations.late_for_ns) {
            handler.call(&DeadlineMiss { job, release_ns, response_ns, deadline_ns });
            told = true;
        }
        told
    }
}

/// For counters with one writer: cheaper than a read-modify-write.
fn add(counter: &AtomicU64, by: u64) {
    counter.store(counter.load(Ordering::Relaxed).wrapping_add(by), Ordering::Relaxed);
}
