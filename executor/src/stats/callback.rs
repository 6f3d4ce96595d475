// SPDX-License-Identifier: MIT OR Apache-2.0
//! A callback's statistics: its settings and the values of the present.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{LazyLock, OnceLock};
use std::time::Duration;

use tautline_rt::{Policy, ThreadInfo};

use super::block::{Block, CallbackSnapshot, HEAD_WORDS, state, word};
use super::file::{StatisticsFile, StatsSlot};
use super::histogram::Histogram;
use crate::options::CallbackOptions;

#[derive(Debug, Clone, Copy)]
pub(crate) struct Job {
    pub release_ns: u64,
    pub response_ns: u64,
    /// `None` if execution times are not measured.
    pub execution_ns: Option<u64>,
    /// `None` if the callback does not state it.
    pub input_size: Option<u64>,
}

/// The state of a stream's queue at a take: see [`job::note_queue`](crate::job::note_queue).
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct QueueState {
    /// Messages lost since the last record.
    pub lost: u64,
    /// Maximum number of messages queued at once, so far.
    pub max_queue: u64,
    /// The queue's depth.
    pub depth: u64,
}

/// A callback's statistics: written by its thread, readable from any other thread while it runs. If the executor has a
/// [`StatisticsFile`], other processes can read them, too.
#[derive(Debug)]
pub struct CallbackStats {
    name: String,
    /// In ns, 0 for none.
    pub(super) limits: [AtomicU64; 3],
    /// Set when the callback is spawned.
    pub(super) block: OnceLock<Block>,
    /// The entry of the block in a file, if it has one: dropped after the block.
    slot: OnceLock<StatsSlot>,
}

/// The histogram that [`CallbackStats::response`] returns before the callback is spawned.
static NOTHING: LazyLock<Histogram> = LazyLock::new(Histogram::new);

impl CallbackStats {
    pub(super) const DEADLINE: usize = 0;
    pub(super) const BUDGET: usize = 1;
    pub(super) const BOUND: usize = 2;

    /// Empty statistics, without memory until `place` is called.
    pub(crate) fn new(name: impl Into<String>) -> CallbackStats {
        CallbackStats {
            name: name.into(),
            limits: Default::default(),
            block: OnceLock::new(),
            slot: OnceLock::new(),
        }
    }

    /// Allocates the memory of the statistics: jobs are counted from now on.
    pub(crate) fn place(&self, file: Option<&StatisticsFile>, kind: u64) -> std::io::Result<()> {
        let block = match file {
            Some(file) => {
                let (words, slot) = file.claim()?;
                // A callback is spawned once.
                let _ = self.slot.set(slot);
                Block::new(words)
            }
            None => Block::private(),
        };
        block.set_name(&self.name);
        block.set(word::KIND, kind);
        let limits =
            [(Self::DEADLINE, word::DEADLINE), (Self::BUDGET, word::BUDGET), (Self::BOUND, word::BOUND)];
        for (index, place) in limits {
            block.set(place, self.limits[index].load(Ordering::Relaxed));
        }
        block.set_state(state::RUNNING);
        let _ = self.block.set(block);
        Ok(())
    }

    /// Records the thread that the kernel confirmed, and the settings of the callback.
    pub(crate) fn describe(&self, thread: &ThreadInfo, period: Option<Duration>, measures_execution: bool) {
        self.describe_jobs(period, measures_execution);
        self.set_thread(thread);
    }

    /// Records the settings of the callback.
    pub(crate) fn describe_jobs(&self, period: Option<Duration>, measures_execution: bool) {
        if let Some(block) = self.block.get() {
            block.set(word::PERIOD, nanoseconds(period));
            block.set(word::MEASURES_EXECUTION, u64::from(measures_execution));
        }
    }

    /// Records the changed priority or reservation of the thread.
    pub(crate) fn describe_priority(&self, policy: Policy) {
        if let Some(block) = self.block.get() {
            block.set_policy(policy);
        }
    }

    /// Records that time taken from the core is accounted for from now on.
    pub(crate) fn describe_account(&self) {
        if let Some(block) = self.block.get() {
            block.set(word::ACCOUNTS, 1);
        }
    }

    /// Records the thread that runs the callback, as the kernel reports it.
    pub(crate) fn set_thread(&self, thread: &ThreadInfo) {
        if let Some(block) = self.block.get() {
            block.set_thread(thread);
        }
    }

    /// The id of the thread that runs the callback; 0 before it is known.
    pub(crate) fn tid(&self) -> u32 {
        u32::try_from(self.word(word::TID)).unwrap_or(0)
    }

    /// Records that the callback's future has ended.
    pub(crate) fn end(&self) {
        if let Some(block) = self.block.get() {
            block.set_state(state::ENDED);
        }
    }

    pub(super) fn head(&self) -> Option<&[AtomicU64; HEAD_WORDS]> {
        self.block.get().and_then(Block::head)
    }

    fn word(&self, index: usize) -> u64 {
        self.block.get().map_or(0, |block| block.get(index))
    }

    /// The callback's name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Jobs started.
    pub fn releases(&self) -> u64 {
        self.word(word::RELEASES)
    }

    /// Jobs finished; not those that run, of which overlapping streams have one each, and those that were stopped before their end.
    pub fn completions(&self) -> u64 {
        self.word(word::COMPLETIONS)
    }

    /// Jobs that used more CPU time than the budget.
    pub fn overruns(&self) -> u64 {
        self.word(word::OVERRUNS)
    }

    /// Jobs that were demoted: see [`CallbackOptions::demote_on_overrun`](crate::CallbackOptions::demote_on_overrun).
    pub fn demotions(&self) -> u64 {
        self.word(word::DEMOTIONS)
    }

    /// Jobs whose response took longer than the deadline.
    pub fn deadline_misses(&self) -> u64 {
        self.word(word::DEADLINE_MISSES)
    }

    /// CPU time per job, including the executor's time before it (on a busy-polling thread: time from its start to its
    /// end); empty if [`CallbackOptions::execution_time`](crate::CallbackOptions) is off.
    pub fn execution(&self) -> &Histogram {
        self.block.get().map_or(&NOTHING, |block| &block.execution)
    }

    /// Time from a job's release to its end.
    pub fn response(&self) -> &Histogram {
        self.block.get().map_or(&NOTHING, |block| &block.response)
    }

    /// The deadline that misses are counted against.
    pub fn deadline(&self) -> Option<Duration> {
        self.limit(Self::DEADLINE)
    }

    /// The CPU time that overruns are counted against.
    pub fn budget(&self) -> Option<Duration> {
        self.limit(Self::BUDGET)
    }

    /// Changes the deadline, the budget and the bound to those of `options`.
    pub(crate) fn set_limits(&self, options: &CallbackOptions) {
        self.set_deadline(options.effective_deadline());
        self.set_budget(options.budget);
        self.set_bound(options.bound);
    }

    /// Changes the deadline, for jobs that end from now on. A deadline of zero means none.
    pub fn set_deadline(&self, deadline: Option<Duration>) {
        self.set_limit(Self::DEADLINE, word::DEADLINE, deadline);
    }

    /// Changes the budget, for jobs that end from now on. A budget of zero means none.
    pub fn set_budget(&self, budget: Option<Duration>) {
        self.set_limit(Self::BUDGET, word::BUDGET, budget);
    }

    /// Changes the response time beyond which a job is recorded among the [moments](CallbackSnapshot::moments), for jobs that end
    /// from now on. Zero means none.
    pub fn set_bound(&self, bound: Option<Duration>) {
        self.set_limit(Self::BOUND, word::BOUND, bound);
    }

    fn limit(&self, index: usize) -> Option<Duration> {
        match self.limits[index].load(Ordering::Relaxed) {
            0 => None,
            ns => Some(Duration::from_nanos(ns)),
        }
    }

    fn set_limit(&self, index: usize, place: usize, limit: Option<Duration>) {
        let ns = nanoseconds(limit);
        self.limits[index].store(ns, Ordering::Relaxed);
        if let Some(block) = self.block.get() {
            block.set(place, ns);
        }
    }
}

impl CallbackSnapshot {
    /// The present values, for evaluation or storage. `None` before the callback is spawned.
    ///
    /// # Real-time
    /// Not for the callback's thread: allocates.
    pub fn of(stats: &CallbackStats) -> Option<CallbackSnapshot> {
        stats.block.get().map(Block::snapshot)
    }
}

fn nanoseconds(time: Option<Duration>) -> u64 {
    time.map_or(0, tautline_rt::clock::nanoseconds)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::stats::{Moment, MomentKind, kind};

    fn job(response_ns: u64, execution_ns: Option<u64>) -> Job {
        Job { release_ns: 0, response_ns, execution_ns, input_size: None }
    }

    #[test]
    fn late_jobs_miss_and_long_ones_overrun() {
        let stats = CallbackStats::new("a");
        stats.set_deadline(Some(Duration::from_nanos(100)));
        stats.complete(&job(1, None));
        assert_eq!((stats.completions(), stats.response().snapshot().n()), (0, 0), "not spawned");
        stats.place(None, kind::CALLBACK).unwrap();
        for response_ns in [99, 100, 101] {
            stats.complete(&job(response_ns, Some(response_ns - 50)));
        }
        stats.set_deadline(None);
        stats.set_budget(Some(Duration::from_nanos(50)));
        stats.complete(&job(1_000_000, None));
        stats.complete(&job(1_000_000, Some(51)));
        assert_eq!((stats.completions(), stats.deadline_misses(), stats.overruns()), (5, 1, 1));
        assert_eq!((stats.response().snapshot().n(), stats.execution().snapshot().n()), (5, 4));
    }

    #[test]
    fn distances_between_releases() {
        let stats = CallbackStats::new("a");
        stats.place(None, kind::CALLBACK).unwrap();
        let seen = |stats: &CallbackStats| {
            let now = CallbackSnapshot::of(stats).unwrap();
            (now.releases, now.first_release_ns, now.last_release_ns, now.least_distance_ns)
        };
        stats.release(1_000);
        assert_eq!(seen(&stats), (1, 1_000, 1_000, None));
        [1_100, 1_190, 1_300].into_iter().for_each(|release_ns| stats.release(release_ns));
        assert_eq!(seen(&stats), (4, 1_000, 1_300, Some(90)));
        // Of another stream: released before, handed out after.
        stats.release(1_295);
        stats.release(1_300);
        assert_eq!(seen(&stats), (6, 1_000, 1_300, Some(0)));
    }

    #[test]
    fn jobs_beyond_the_bound_are_kept_with_their_instants() {
        let stats = CallbackStats::new("a");
        stats.set_bound(Some(Duration::from_nanos(100)));
        stats.place(None, kind::CALLBACK).unwrap();
        for response_ns in [100, 101, 7, 300] {
            stats.complete(&Job { release_ns: 5, ..job(response_ns, None) });
        }
        let now = CallbackSnapshot::of(&stats).unwrap();
        let late = |length_ns| Moment { kind: MomentKind::Late, from_ns: 5, to_ns: 5 + length_ns, length_ns };
        assert_eq!((now.moments, now.older_moments), (vec![late(101), late(300)], 0));
        assert_eq!((now.bound_ns, now.accounts_core_time), (Some(100), false));
    }

    #[test]
    fn an_excess_from_before_the_release_is_kept() {
        let stats = CallbackStats::new("a");
        stats.set_budget(Some(Duration::from_nanos(50)));
        stats.place(None, kind::CALLBACK).unwrap();
        stats.complete(&Job { release_ns: 1_000, ..job(10, Some(500)) });
        let overran = Moment { kind: MomentKind::Overran, from_ns: 560, to_ns: 1_010, length_ns: 450 };
        let now = CallbackSnapshot::of(&stats).unwrap();
        assert_eq!((now.moments, now.older_moments), (vec![overran], 0));
    }

    #[test]
    fn losses_add_up_and_the_fullest_queue_counts() {
        let stats = CallbackStats::new("a");
        stats.place(None, kind::CALLBACK).unwrap();
        for (lost, max_queue, depth) in [(2, 1, 4), (0, 3, 4), (1, 2, 8)] {
            stats.note_queue(QueueState { lost, max_queue, depth });
        }
        let now = CallbackSnapshot::of(&stats).unwrap();
        assert_eq!((now.lost, now.max_queue, now.depth), (3, 3, 8));
    }
}
