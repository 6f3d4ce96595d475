// SPDX-License-Identifier: MIT OR Apache-2.0
//! A processor budget for the threads that carry messages: they keep real-time priority only while they use little time.
//!
//! They run above the callbacks, so that messages have arrived when a callback starts. A flood, intended or hostile, would then
//! starve the callbacks. So the threads' processor time is summed up: once it exceeds the budget in a window, they run as
//! SCHED_OTHER until several windows in a row show less demand. Demand includes the time that they wait for a processor, because
//! a SCHED_OTHER thread may use little only because it gets little. So a callback loses at most the budget of one window plus the
//! time until the next check, once per flood; recurring floods cause this ever more rarely. A thread that starts while policies
//! change may inherit the old policy, and keeps it until the next [renewal](RENEWAL_LOOKS), 400 ms later at most.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;
use tautline_rt::clock::process_cpu_ns;
use tautline_rt::{JoinHandle, Policy, Realtime, RtError, ThreadBuilder, ThreadTime};

/// Processor time that the threads of a gateway or bridge may use at real-time priority.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Budget {
    /// In percent of one core; may exceed 100.
    pub percent: u32,
}

impl Default for Budget {
    /// A quarter of one core.
    fn default() -> Self {
        Budget { percent: 25 }
    }
}

const WINDOW: Duration = Duration::from_millis(40);
const LOOKS_PER_WINDOW: u32 = 8;
/// Number of checks after which the threads are listed again, and new ones get their policy: every 400 ms.
const RENEWAL_LOOKS: u32 = LOOKS_PER_WINDOW * 10;

/// Calm windows in a row before the priority is restored.
const CALM_WINDOWS: u32 = 5;
/// Maximum of calm windows: their number doubles when a flood returns within this many windows (10 s).
const MOST_CALM_WINDOWS: u32 = 250;

/// The decision after a check.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Verdict {
    Keep,
    Demote,
    Promote,
}

/// Decides from sums of processor time; sets no policies.
struct Meter {
    budget_ns: u64,
    looks: u32,
    at_start: ThreadTime,
    /// The processor time of the whole process at the start of the window.
    process_ns: u64,
    is_demoted: bool,
    /// Windows since the priority was restored.
    since_promotion: u32,
    /// While demoted: calm windows in a row, and how many are needed.
    calm: u32,
    asked: u32,
}

impl Meter {
    fn new(budget: Budget, spent: ThreadTime, process_ns: u64) -> Self {
        let budget_ns = WINDOW.as_nanos() as u64 * u64::from(budget.percent) / 100;
        Meter {
            budget_ns,
            looks: 0,
            at_start: spent,
            process_ns,
            is_demoted: false,
            since_promotion: u32::MAX,
            calm: 0,
            asked: CALM_WINDOWS,
        }
    }

    /// `process_ns` is the processor time of the whole process since its start, `spent` reads that of the watched threads. Because reading
    /// takes long, `spent` is called only at the end of a window, and when the process could have exceeded the budget.
    fn check(&mut self, process_ns: u64, spent: impl FnOnce() -> ThreadTime) -> Verdict {
        self.looks += 1;
        let may_be_over = self.is_demoted || process_ns.saturating_sub(self.process_ns) > self.budget_ns;
        if self.looks < LOOKS_PER_WINDOW && !may_be_over {
            return Verdict::Keep;
        }
        let spent = spent();
        let ThreadTime { used_ns, waited_ns } = spent.minus(self.at_start);
        let is_end = self.looks >= LOOKS_PER_WINDOW;
        let is_over = match self.is_demoted {
            false => used_ns > self.budget_ns,
            true => used_ns.saturating_add(waited_ns) > self.budget_ns,
        };
        if is_end || is_over {
            // The next window starts here.
            (self.looks, self.at_start, self.process_ns) = (0, spent, process_ns);
        }
        match (self.is_demoted, is_over) {
            (false, true) => {
                let is_back = self.since_promotion < MOST_CALM_WINDOWS;
                self.asked = if is_back { (self.asked * 2).min(MOST_CALM_WINDOWS) } else { CALM_WINDOWS };
                (self.is_demoted, self.calm) = (true, 0);
                Verdict::Demote
            }
            (false, false) => {
                self.since_promotion = self.since_promotion.saturating_add(u32::from(is_end));
                Verdict::Keep
            }
            (true, true) => {
                self.calm = 0;
                Verdict::Keep
            }
            (true, false) => {
                self.calm += u32::from(is_end);
                if self.calm < self.asked {
                    return Verdict::Keep;
                }
                (self.is_demoted, self.since_promotion) = (false, 0);
                Verdict::Promote
            }
        }
    }
}

/// The budget thread; dropping this ends it.
pub struct Guard {
    stop: Arc<AtomicBool>,
    demotions: Arc<AtomicU64>,
    thread: Option<JoinHandle<()>>,
}

impl Guard {
    /// Starts a thread `name` that watches the threads in `list`, each with its policy within the budget; `highest` is the
    /// highest of these policies. No two guards may list the same thread.
    ///
    /// # Errors
    /// [`RtError`]: a missing privilege.
    pub fn start(name: &str, budget: Budget, highest: Policy, list: ThreadLister) -> Result<Self, RtError> {
        let (stop, demotions) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicU64::new(0)));
        // Above the watched threads, or they could starve it.
        let above = match highest {
            Policy::Fifo(priority) | Policy::RoundRobin(priority) => Policy::Fifo((priority + 1).min(99)),
            other => other,
        };
        let builder = ThreadBuilder::new(name).policy(above).realtime(Realtime::Required);
        let thread = {
            let (stop, demotions) = (stop.clone(), demotions.clone());
            builder.spawn(move || move || watch(budget, list, &stop, &demotions))?
        };
        Ok(Guard { stop, demotions, thread: Some(thread) })
    }

    /// How often the budget was exceeded.
    pub fn demotions(&self) -> u64 {
        self.demotions.load(Ordering::Relaxed)
    }
}

impl Drop for Guard {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// Lists the watched threads, each with its policy within the budget.
pub type ThreadLister = Box<dyn Fn() -> Result<Vec<(u32, Policy)>, RtError> + Send>;

fn watch(budget: Budget, list: ThreadLister, stop: &AtomicBool, demotions: &AtomicU64) {
    let (ended, is_demoted) = (ThreadTime::default(), false);
    let mut threads = BudgetedThreads { list, threads: Vec::new(), ended, is_demoted };
    threads.renew();
    let process_ns = process_cpu_ns();
    let mut meter = Meter::new(budget, threads.spent(), process_ns);
    let mut looks = 0u32;
    while !stop.load(Ordering::Relaxed) {
        std::thread::sleep(WINDOW / LOOKS_PER_WINDOW);
        looks = looks.wrapping_add(1);
        if looks.is_multiple_of(RENEWAL_LOOKS) {
            threads.renew();
        }
        match meter.check(process_cpu_ns(), || threads.spent()) {
            Verdict::Keep => {}
            Verdict::Demote => {
                demotions.fetch_add(1, Ordering::Relaxed);
                threads.set(true);
            }
            Verdict::Promote => threads.set(false),
        }
    }
    threads.set(false);
}

/// The watched threads, and the time of those that have ended.
struct BudgetedThreads {
    list: ThreadLister,
    threads: Vec<(u32, Policy, ThreadTime)>,
    /// May be below zero: see [`renew`](Self::renew).
    ended: ThreadTime,
    is_demoted: bool,
}

impl BudgetedThreads {
    /// Lists the threads again. A new thread gets the present policy: it may have inherited the one before a change.
    fn renew(&mut self) {
        let Ok(now) = (self.list)() else { return };
        for (tid, _, spent) in &self.threads {
            if !now.iter().any(|(there, _)| there == tid) {
                self.ended = self.ended.plus(*spent);
            }
        }
        let mut threads = Vec::new();
        for (tid, policy) in now {
            let spent = ThreadTime::of(tid);
            let known = self.threads.iter().find(|(known, ..)| *known == tid).map(|(.., spent)| *spent);
            if known.is_none() {
                self.set_policy(tid, policy);
                // Keeps the sum unchanged: the thread's earlier time is subtracted from that of the ended threads.
                self.ended = self.ended.minus(spent.unwrap_or_default());
            }
            threads.push((tid, policy, spent.or(known).unwrap_or_default()));
        }
        self.threads = threads;
    }

    fn spent(&mut self) -> ThreadTime {
        for (tid, _, spent) in &mut self.threads {
            *spent = ThreadTime::of(*tid).unwrap_or(*spent);
        }
        self.threads.iter().fold(self.ended, |sum, (.., spent)| sum.plus(*spent))
    }

    fn set(&mut self, is_demoted: bool) {
        self.is_demoted = is_demoted;
        self.renew();
        self.threads.iter().for_each(|(tid, policy, _)| self.set_policy(*tid, *policy));
    }

    /// Sets a thread's policy to its `own` one, or to SCHED_OTHER while demoted.
    fn set_policy(&self, tid: u32, own: Policy) {
        let policy = if self.is_demoted { Policy::Other { nice: 0 } } else { own };
        if let Err(error) = tautline_rt::set_policy_of(tid, policy)
            && !matches!(error, RtError::NoSuchThread { .. })
        {
            tracing::warn!("the priority of a thread is not changed: {error}");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tautline_rt::permission::{realtime_permitted, test_needs};

    const LOOK_NS: u64 = 5_000_000;

    /// A meter and the time spent so far.
    struct Trial(Meter, ThreadTime);

    impl Trial {
        fn new() -> Self {
            let start = ThreadTime { used_ns: 7, waited_ns: 9 };
            Trial(Meter::new(Budget { percent: 25 }, start, 5), start)
        }

        /// Verdicts other than `Keep` of `count` checks, with the percentages of time used and waited in each.
        fn looks(&mut self, count: u32, used: u64, waited: u64) -> Vec<(u32, Verdict)> {
            let mut verdicts = Vec::new();
            for look in 0..count {
                let share = |percent: u64| LOOK_NS * percent / 100;
                self.1 = self.1.plus(ThreadTime { used_ns: share(used), waited_ns: share(waited) });
                // Other threads of the process have used some, too.
                verdicts.push((look, self.0.check(self.1.used_ns + 40_000_000, || self.1)));
            }
            verdicts.retain(|(_, verdict)| *verdict != Verdict::Keep);
            verdicts
        }
    }

    /// A thread that computes or idles until `stop`, with its priority; `None` where it may have none.
    fn thread(name: &str, stop: &Arc<AtomicBool>, computes: bool) -> Option<(JoinHandle<()>, u32)> {
        test_needs(realtime_permitted(PRIORITY + 1))?;
        let builder = ThreadBuilder::new(name).policy(Policy::Fifo(PRIORITY)).realtime(Realtime::Required);
        let stop = stop.clone();
        let work = move || {
            while !stop.load(Ordering::Relaxed) {
                let until = std::time::Instant::now() + Duration::from_micros(500);
                while computes && std::time::Instant::now() < until {}
                std::thread::sleep(Duration::from_micros(500));
            }
        };
        let thread = builder.spawn(move || work).unwrap();
        let tid = thread.info().tid;
        Some((thread, tid))
    }

    const PRIORITY: u8 = 10;

    /// One that another thread starts during a change of policy is not in the list yet.
    #[test]
    fn a_thread_that_was_missed_is_demoted_later() {
        let stop = Arc::new(AtomicBool::new(false));
        let Some((busy, busy_tid)) = thread("busy", &stop, true) else { return };
        let Some((missed, missed_tid)) = thread("missed", &stop, false) else { return };
        let lists = AtomicU64::new(0);
        let list: ThreadLister = Box::new(move || {
            // At the start, and when the first one is demoted.
            let is_missed = lists.fetch_add(1, Ordering::Relaxed) < 2;
            let tids = if is_missed { vec![busy_tid] } else { vec![busy_tid, missed_tid] };
            Ok(tids.into_iter().map(|tid| (tid, Policy::Fifo(PRIORITY))).collect())
        });
        let guard = Guard::start("budget", Budget { percent: 5 }, Policy::Fifo(PRIORITY), list).unwrap();
        let is = |policy| [busy_tid, missed_tid].map(|tid| tautline_rt::policy_of(tid).unwrap() == policy);
        let until = std::time::Instant::now() + Duration::from_secs(10);
        while is(Policy::Other { nice: 0 }) != [true; 2] {
            assert!(std::time::Instant::now() < until, "{:?}", is(Policy::Other { nice: 0 }));
            std::thread::yield_now();
        }
        assert_eq!(guard.demotions(), 1);
        drop(guard);
        assert_eq!(is(Policy::Fifo(PRIORITY)), [true; 2], "its end gives it back");
        stop.store(true, Ordering::Relaxed);
        busy.join().unwrap();
        missed.join().unwrap();
    }

    #[test]
    fn over_the_budget_is_demoted_until_it_is_calm() {
        let mut trial = Trial::new();
        assert_eq!(trial.looks(100, 25, 0), [], "within the budget");
        assert_eq!(trial.looks(100, 20, 70), [], "at real-time priority only used time counts");
        // A flood exceeds the budget at the third check at the latest, even if the window began with less.
        let flood = trial.looks(3, 100, 0);
        assert!(matches!(flood[..], [(0..=2, Verdict::Demote)]), "{flood:?}");
        assert_eq!(trial.looks(100, 100, 0), [], "as long as it lasts");
        assert_eq!(trial.looks(1000, 5, 40), [], "little used time alone does not mean calm");
        let calm = trial.looks(100, 10, 5);
        let windows = LOOKS_PER_WINDOW * CALM_WINDOWS;
        assert!(
            matches!(calm[..], [(look, Verdict::Promote)] if (windows - LOOKS_PER_WINDOW..windows + LOOKS_PER_WINDOW).contains(&look)),
            "{calm:?}"
        );
    }

    #[test]
    fn a_flood_that_comes_and_goes_disturbs_ever_more_rarely() {
        let mut trial = Trial::new();
        let mut calm_looks = Vec::new();
        for _ in 0..8 {
            assert_eq!(trial.looks(3, 100, 0).len(), 1);
            let back = trial.looks(3000, 10, 0);
            calm_looks.push(back[0].0 / LOOKS_PER_WINDOW);
            assert_eq!(back.len(), 1);
            // As if it returned at once.
            trial.0.since_promotion = 0;
        }
        assert_eq!(calm_looks, [4, 9, 19, 39, 79, 159, 249, 249]);
        trial.looks(MOST_CALM_WINDOWS * LOOKS_PER_WINDOW, 10, 0);
        trial.looks(3, 100, 0);
        assert_eq!(trial.0.asked, CALM_WINDOWS, "forgotten");
    }
}
