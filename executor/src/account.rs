// SPDX-License-Identifier: MIT OR Apache-2.0
//! Accounting for the time of threads' cores: see [`Executor::account_core_time`](crate::Executor::account_core_time).
#![deny(clippy::disallowed_methods, clippy::disallowed_types, clippy::disallowed_macros)]
#![deny(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing)]

use std::cell::Cell;
use std::sync::Arc;

use tautline_rt::{CoreMark, CoreTime, RtError, ThreadInfo};

use crate::stats::{CallbackStats, Moment, MomentKind};

/// Accounts for the time taken from a callback's core while its jobs run.
pub(crate) struct CoreTimeAccount {
    clock: CoreTime,
    /// Shorter times are not recorded.
    least_ns: u64,
    /// The mark at the start of the running job; of overlapping jobs, the first.
    begun: Cell<Option<CoreMark>>,
    /// Jobs that have started and not ended.
    running: Cell<u32>,
    /// When the previous job ended, or the thread started, and the processor time that the thread had used by then.
    ended: Cell<(u64, u64)>,
    /// As `ended`, at the last [pause](Self::pause) or at the end of the previous job, whichever was later.
    paused: Cell<(u64, u64)>,
}

impl CoreTimeAccount {
    pub fn new(clock: CoreTime, least_ns: u64) -> CoreTimeAccount {
        let account = CoreTimeAccount {
            ended: Cell::default(),
            paused: Cell::default(),
            begun: Cell::new(None),
            running: Cell::new(0),
            clock,
            least_ns,
        };
        account.pause();
        account.ended.set(account.paused.get());
        account
    }

    /// Records that the thread waits for its next job from now on.
    pub fn pause(&self) {
        let now = self.clock.mark();
        self.paused.set((now.to_ns, now.used_ns));
    }

    /// Records the start of a job.
    pub fn begin(&self) {
        if self.running.replace(self.running.get().saturating_add(1)) == 0 {
            self.begun.set(Some(self.clock.mark()));
        }
    }

    /// Records the end of a job that does not complete.
    pub fn abandon(&self) {
        self.running.set(self.running.get().saturating_sub(1));
        if self.running.get() == 0 {
            self.begun.take();
        }
    }

    /// Records the end of a job; of overlapping jobs, only the last end. The time taken from a job that has slept is unknown. `late`: the
    /// release and the end of a job that ended beyond its bound.
    pub fn end(&self, stats: &CallbackStats, slept: bool, late: Option<(u64, u64)>) {
        self.running.set(self.running.get().saturating_sub(1));
        if self.running.get() > 0 {
            return;
        }
        let now = self.clock.mark();
        let (ended_ns, before_ns) = self.ended.replace((now.to_ns, now.used_ns));
        let (paused_ns, used_ns) = self.paused.replace((now.to_ns, now.used_ns));
        let Some(begun) = self.begun.take().filter(|_| !slept) else { return };
        note_taken(stats, &begun, &now, self.least_ns);
        if let (Some((release_ns, to_ns)), Some(preempted_ns)) = (late, begun.waited_until(&now)) {
            // The wait starts at the release or at the end of the previous job; processor time that the thread itself used is no wait.
            let from_ns = release_ns.max(ended_ns).min(to_ns);
            let own_ns = used_ns.saturating_sub(before_ns).min(paused_ns.saturating_sub(from_ns));
            let own_ns = own_ns.saturating_add(begun.used_ns.saturating_sub(used_ns));
            let length_ns = begun.from_ns.saturating_sub(from_ns).saturating_sub(own_ns);
            let length_ns = length_ns.saturating_add(preempted_ns).min(to_ns - from_ns);
            if length_ns >= self.least_ns {
                stats.note(&Moment { kind: MomentKind::Waited, from_ns, to_ns, length_ns });
            }
        }
    }
}

/// The sampler's core-time statistics. The [moments](crate::CallbackSnapshot::moments) are: time taken from it, timers served 100 µs
/// late or more, time that it waited for the core, and time that it used to serve events, each if it is at least as long as set in
/// [`Executor::account_core_time`].
///
/// [`Executor::account_core_time`]: crate::Executor::account_core_time
#[derive(Debug)]
pub struct SamplerStatistics {
    stats: Arc<CallbackStats>,
    least_ns: u64,
}

impl SamplerStatistics {
    pub(crate) const fn new(stats: Arc<CallbackStats>, least_ns: u64) -> SamplerStatistics {
        SamplerStatistics { stats, least_ns }
    }

    /// The statistics: they have no jobs, only moments.
    pub fn stats(&self) -> &Arc<CallbackStats> {
        &self.stats
    }

    /// Starts the accounting for the current thread, which becomes the sampler; one thread at a time.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// The kernel does not provide the data.
    pub fn account(&self) -> Result<SamplerAccount, RtError> {
        self.stats.set_thread(&ThreadInfo::of_current("sampler")?);
        Ok(SamplerAccount {
            clock: CoreTime::new()?,
            least_ns: self.least_ns,
            stats: Arc::clone(&self.stats),
            asleep: Cell::new(None),
            awake: Cell::new(None),
        })
    }
}

/// Accounts for the time taken from the sampler's core, and the time that the sampler uses. It costs three system calls before
/// and after each sleep.
///
/// The sampler also sleeps until timers are due: time taken while no thread runs makes it wake late.
#[derive(Debug)]
pub struct SamplerAccount {
    clock: CoreTime,
    least_ns: u64,
    stats: Arc<CallbackStats>,
    asleep: Cell<Option<CoreMark>>,
    /// The mark since which the sampler is awake, and the processor time from which it is charged.
    awake: Cell<Option<(CoreMark, u64)>>,
}

impl SamplerAccount {
    /// A wake-up takes some time: a timer served less than this after its due time is not late.
    const WAKE_NS: u64 = 100_000;

    /// Call when the sampler is about to sleep.
    ///
    /// # Real-time
    /// Wait-free; no allocation; three system calls.
    pub fn sleeps(&self) {
        let now = self.clock.mark();
        self.asleep.set(Some(now));
        if let Some((awake, used_ns)) = self.awake.take() {
            note_taken(&self.stats, &awake, &now, self.least_ns);
            note_wait(&self.stats, &awake, &now, self.least_ns);
            let length_ns = now.used_ns.saturating_sub(used_ns);
            if length_ns >= self.least_ns {
                // The processor time of the wake-up itself was used just before `awake`.
                let from_ns = awake.from_ns.saturating_sub(awake.used_ns.saturating_sub(used_ns));
                self.stats.note(&Moment { kind: MomentKind::Served, from_ns, to_ns: now.to_ns, length_ns });
            }
        }
    }

    /// Call when the sampler has slept, until `due_ns` at the latest if that is set.
    ///
    /// # Real-time
    /// As [`sleeps`](Self::sleeps).
    pub fn woke(&self, due_ns: Option<u64>) {
        let now = self.clock.mark();
        let Some(asleep) = self.asleep.get() else { return };
        let has_slept = now.sleeps != asleep.sleeps;
        if has_slept {
            note_wait(&self.stats, &asleep, &now, self.least_ns);
        }
        // If a ring prevented the sleep, the sampler has been awake since `asleep`.
        let since = if has_slept { now } else { asleep };
        let mut used_ns = asleep.used_ns;
        if let Some(from_ns) = due_ns
            && let Some(length_ns) = asleep.woken_late_by(from_ns, &now)
            && now.from_ns.saturating_sub(from_ns) >= self.least_ns.max(Self::WAKE_NS)
        {
            let to_ns = now.from_ns;
            self.stats.note(&Moment { kind: MomentKind::WokenLate, from_ns, to_ns, length_ns });
            // The late wake-up includes the processor time of waking.
            used_ns = now.used_ns;
        }
        self.awake.set(Some((since, used_ns)));
    }
}

/// Records the time taken from the thread between two marks, if the thread did not sleep.
fn note_taken(stats: &CallbackStats, begun: &CoreMark, now: &CoreMark, least_ns: u64) {
    if let Some(length_ns) = begun.taken_until(now).filter(|ns| *ns >= least_ns) {
        let (from_ns, to_ns) = (begun.to_ns, now.from_ns);
        stats.note(&Moment { kind: MomentKind::Taken, from_ns, to_ns, length_ns });
    }
}

/// Records the time that the sampler waited for the core between two marks: at the end of the interval, if it slept first.
fn note_wait(stats: &CallbackStats, before: &CoreMark, now: &CoreMark, least_ns: u64) {
    if let Some(length_ns) = before.waited_until(now).filter(|ns| *ns >= least_ns) {
        let to_ns = now.from_ns;
        let from_ns =
            if now.sleeps == before.sleeps { before.to_ns } else { to_ns.saturating_sub(length_ns) };
        stats.note(&Moment { kind: MomentKind::Waited, from_ns, to_ns, length_ns });
    }
}

#[cfg(test)]
#[allow(clippy::disallowed_methods, clippy::unwrap_used, clippy::indexing_slicing, reason = "a test")]
mod tests {
    use super::*;
    use crate::{Executor, Realtime};
    use std::time::Duration;
    use tautline_rt::clock::{burn_cpu, monotonic_ns};

    #[test]
    fn the_sampler_waits_after_it_was_woken_or_while_it_serves() {
        let executor = Executor::new(Realtime::Off).account_core_time(Some(Duration::ZERO));
        let sampler = executor.sampler_statistics().unwrap().unwrap();
        let mark = |at_ns: u64, waited_ns: u64, sleeps: u64| CoreMark {
            from_ns: at_ns,
            to_ns: at_ns + 1,
            used_ns: 0,
            waited_ns,
            sleeps,
        };
        let note = |before: CoreMark, now: CoreMark| note_wait(sampler.stats(), &before, &now, 100);
        note(mark(1_000, 50, 3), mark(9_000, 149, 4));
        note(mark(1_000, 50, 3), mark(9_000, u64::MAX, 4));
        note(mark(1_000, 50, 3), mark(9_000, 450, 4));
        note(mark(1_000, 50, 3), mark(2_000, 450, 3));
        let seen = crate::CallbackSnapshot::of(sampler.stats()).unwrap().moments;
        let seen: Vec<_> = seen.iter().map(|of| (of.kind, of.from_ns, of.to_ns, of.length_ns)).collect();
        assert_eq!(seen, [(MomentKind::Waited, 8_600, 9_000, 400), (MomentKind::Waited, 1_001, 2_000, 400)]);
    }

    #[test]
    fn a_wait_is_noted_once_if_a_ring_came_before_the_sampler_slept() {
        let executor = Executor::new(Realtime::Off).account_core_time(Some(Duration::ZERO));
        let sampler = executor.sampler_statistics().unwrap().unwrap();
        let account = sampler.account().unwrap();
        account.sleeps();
        account.woke(None);
        account.sleeps();
        let moments = crate::CallbackSnapshot::of(sampler.stats()).unwrap().moments.into_iter();
        assert_eq!(moments.filter(|of| of.kind == MomentKind::Waited).count(), 1);
    }

    #[test]
    fn a_late_job_was_without_the_core_since_its_release_or_the_job_before() {
        const LEAST_NS: u64 = 2_000_000;
        let executor = Executor::new(Realtime::Off).account_core_time(Some(Duration::ZERO));
        let sampler = executor.sampler_statistics().unwrap().unwrap();
        let account = CoreTimeAccount::new(CoreTime::new().unwrap(), LEAST_NS);
        let job = |release_ns: u64, late: bool| {
            account.begin();
            let now_ns = monotonic_ns();
            account.end(sampler.stats(), false, late.then_some((release_ns, now_ns)));
            now_ns
        };
        let waits = || {
            let moments = crate::CallbackSnapshot::of(sampler.stats()).unwrap().moments.into_iter();
            moments.filter(|of| of.kind == MomentKind::Waited).collect::<Vec<_>>()
        };
        // What was released before the thread began has waited for that, and not for a core.
        let long_ago_ns = monotonic_ns().saturating_sub(3_600_000_000_000);
        job(long_ago_ns, true);
        assert!(waits().iter().all(|wait| wait.from_ns > long_ago_ns), "{:?}", waits());
        let (before, release_ns) = (waits().len(), monotonic_ns());
        std::thread::sleep(Duration::from_millis(6));
        job(release_ns, false);
        assert_eq!(waits().len(), before, "it was in time");
        let release_ns = monotonic_ns();
        std::thread::sleep(Duration::from_millis(6));
        let end_ns = job(release_ns, true);
        let wait = *waits().last().unwrap();
        assert_eq!((wait.from_ns, wait.to_ns), (release_ns, end_ns));
        // Less what it used since the job before, above.
        assert!((5_000_000..=end_ns - release_ns).contains(&wait.length_ns), "{wait:?}");
        // Released before that one ended, and begun at once then.
        let waited = waits().len();
        job(release_ns, true);
        assert!(waits()[waited..].iter().all(|wait| wait.from_ns >= end_ns), "{:?}", waits());
        // What the thread computes between its jobs is no wait, after a pause and before.
        for pauses in [None, Some(0), Some(1)] {
            burn_cpu(Duration::from_millis(20));
            let pause = |at| pauses.iter().filter(|pause| **pause == at).for_each(|_| account.pause());
            pause(0);
            let (release_ns, waited) = (monotonic_ns(), waits().len());
            burn_cpu(Duration::from_millis(10));
            pause(1);
            std::thread::sleep(Duration::from_millis(6));
            let most_ns = job(release_ns, true) - release_ns - 10_000_000;
            let found = &waits()[waited..];
            assert!(found.iter().all(|wait| wait.length_ns <= most_ns), "{found:?} {most_ns}");
            assert!(pauses.is_none() || found.iter().any(|wait| wait.length_ns >= 5_000_000), "{found:?}");
        }
    }
}
