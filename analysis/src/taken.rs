// SPDX-License-Identifier: MIT OR Apache-2.0
//! Time that something outside the analysis took from a core while it ran: a hypervisor, interrupts, firmware, a job that used more
//! than its wcet.
//!
//! No bound can include this time in advance. After the run there is a bound if it is known how much was taken, and when: a
//! [`Task`] that loses T in its busy window ends as if it had been blocked for T more, once. A response time beyond its
//! first bound is explained if it is within this second one, and a defect if it is not.

use crate::{AnalysisError, Overheads, Response, Task, response_time_per_task};

/// What was taken from a core between two instants.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Taken {
    /// The start of the interval in which it was taken, in ns of any clock.
    pub from_ns: u64,
    /// The end of this interval.
    pub to_ns: u64,
    /// The amount.
    pub length_ns: u64,
    /// How it was noticed.
    pub seen: Seen,
}

/// How it was noticed that a core was taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Seen {
    /// By the thread that ran: it neither ran nor waited. One thread runs at a time, so this way sees no time
    /// twice.
    Running,
    /// By a thread that a timer woke too late. Several threads may see the same time, and a thread that ran may have seen it,
    /// too.
    WokenLate,
    /// By a thread that waited for the core while it was used by threads that it is not known to wait for. A timer may have
    /// waited, too.
    Waited,
    /// By the thread that ran: time that its job used beyond what the analysis allows. This is not the time that the other ways see,
    /// which no thread used.
    Overran,
}

/// An observation of taken time, and its observer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sight {
    /// What was noticed.
    pub taken: Taken,
    /// The thread that noticed it: any number that no other thread has.
    pub thread: u64,
    /// The priority of that thread; `None`: unknown, or not a real-time priority.
    pub priority: Option<u8>,
}

/// All time that was taken from a core in a run; each nanosecond counts once.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct TakenTimes {
    /// Sorted by their start.
    pieces: Vec<Taken>,
    /// The longest interval of a piece.
    widest_ns: u64,
}

impl TakenTimes {
    /// Combines the observations of all threads of the core, in any order. If a timer may have seen the same time, too, the longer
    /// observation counts.
    pub fn new(seen: impl IntoIterator<Item = Taken>) -> TakenTimes {
        let (pieces, late): (Vec<Taken>, Vec<Taken>) = seen
            .into_iter()
            .filter(|piece| piece.length_ns > 0)
            .partition(|piece| piece.seen != Seen::WokenLate);
        let noticed = TakenTimes::of(pieces);
        let more = noticed.seen(&[Seen::Running, Seen::Waited]).excess_of(late);
        TakenTimes::of(noticed.pieces.into_iter().chain(more).collect())
    }

    /// As [`new`](Self::new), and also with the time that threads waited for the core beyond what the analysis allows. Waits below
    /// `priority` are left out: they delay no higher priority. What other threads saw of a wait is subtracted; waits that overlap count
    /// as one, the longest.
    pub fn with_waits(sights: &[Sight], priority: Option<u8>) -> TakenTimes {
        let counts = |sight: &&Sight| sight.taken.seen != Seen::Waited || sight.priority >= priority;
        let less = |sight: &Sight| {
            let Taken { from_ns, to_ns, length_ns, seen } = sight.taken;
            if seen != Seen::Waited {
                return sight.taken;
            }
            let within = |other: &Taken| {
                other.length_ns.min(other.to_ns.min(to_ns).saturating_sub(other.from_ns.max(from_ns)))
            };
            let others = sights.iter().filter(|other| other.thread != sight.thread);
            let others = others.filter(|other| matches!(other.taken.seen, Seen::Running | Seen::Overran));
            let others_ns: u64 = others.map(|other| within(&other.taken)).sum();
            Taken { length_ns: length_ns.saturating_sub(others_ns), ..sight.taken }
        };
        let (waits, rest): (Vec<Taken>, Vec<Taken>) =
            sights.iter().filter(counts).map(less).partition(|piece| piece.seen == Seen::Waited);
        let waits = TakenTimes::default().excess_of(waits);
        TakenTimes::new(rest.into_iter().chain(waits))
    }

    /// Merges overlapping sights, which may be of the same time; returns what they have beyond the pieces of `self`.
    fn excess_of(&self, mut sights: Vec<Taken>) -> Vec<Taken> {
        // An empty sight must not merge two others.
        sights.retain(|piece| piece.length_ns > 0);
        sights.sort_unstable_by_key(|piece| (piece.from_ns, piece.to_ns));
        let overlap = |a: &Taken, b: &Taken| a.from_ns < b.to_ns && b.from_ns < a.to_ns;
        let mut merged: Vec<Taken> = Vec::new();
        for piece in sights {
            match merged.last_mut().filter(|last| overlap(last, &piece)) {
                Some(last) => {
                    last.to_ns = last.to_ns.max(piece.to_ns);
                    last.length_ns = last.length_ns.max(piece.length_ns);
                }
                None => merged.push(piece),
            }
        }
        let more = |piece: Taken| {
            let seen_ns: u64 = self.within(piece.from_ns, piece.to_ns).map(|seen| seen.length_ns).sum();
            let length_ns = piece.length_ns.checked_sub(seen_ns).filter(|rest| *rest > 0)?;
            Some(Taken { length_ns, ..piece })
        };
        merged.into_iter().filter_map(more).collect()
    }

    fn of(mut pieces: Vec<Taken>) -> TakenTimes {
        pieces.sort_unstable_by_key(|piece| (piece.from_ns, piece.to_ns));
        let widest_ns =
            pieces.iter().map(|piece| piece.to_ns.saturating_sub(piece.from_ns)).max().unwrap_or(0);
        TakenTimes { pieces, widest_ns }
    }

    /// The pieces, sorted by their start.
    pub fn pieces(&self) -> &[Taken] {
        &self.pieces
    }

    /// What was noticed in one of these ways.
    pub fn seen(&self, ways: &[Seen]) -> TakenTimes {
        TakenTimes::of(self.pieces.iter().filter(|piece| ways.contains(&piece.seen)).copied().collect())
    }

    /// All of it, in nanoseconds.
    pub fn total_ns(&self) -> u64 {
        self.pieces.iter().map(|piece| piece.length_ns).sum()
    }

    /// The longest piece, in nanoseconds.
    pub fn longest_ns(&self) -> u64 {
        self.pieces.iter().map(|piece| piece.length_ns).max().unwrap_or(0)
    }

    /// The most that may have been taken in the `window_ns` before `end_ns`. A piece counts as far as it may
    /// lie in this window.
    pub fn before(&self, end_ns: u64, window_ns: u64) -> u64 {
        let begin_ns = end_ns.saturating_sub(window_ns);
        let in_it = |piece: &Taken| {
            piece.length_ns.min(piece.to_ns.min(end_ns).saturating_sub(piece.from_ns.max(begin_ns)))
        };
        // A window loses no more than it is long.
        self.within(begin_ns, end_ns).map(in_it).sum::<u64>().min(window_ns)
    }

    /// The most that may have been taken in any window of this length.
    pub fn most_within(&self, window_ns: u64) -> u64 {
        // Of whole pieces: the window that loses most can be moved back until it is about to leave the piece that ends first.
        let begin_ns = |piece: &Taken| piece.to_ns.saturating_sub(1);
        let whole = |from_ns: u64| {
            self.within(from_ns, from_ns.saturating_add(window_ns)).map(|piece| piece.length_ns).sum::<u64>()
        };
        self.pieces.iter().map(|piece| whole(begin_ns(piece)).min(window_ns)).max().unwrap_or(0)
    }

    /// The pieces that may lie between two instants, at least in part.
    fn within(&self, from_ns: u64, to_ns: u64) -> impl Iterator<Item = &Taken> {
        let first =
            self.pieces.partition_point(|piece| piece.from_ns < from_ns.saturating_sub(self.widest_ns));
        let begun = self.pieces[first..].iter().take_while(move |piece| piece.from_ns < to_ns);
        begun.filter(move |piece| piece.to_ns > from_ns)
    }
}

/// The response time of `tasks[index]` in a run in which a window of n nanoseconds lost at most `taken_within(n)` nanoseconds:
/// that of [`response_time_per_task`] with the blocking increased by the loss. Time taken before the release counts, too, as far
/// back as one period and the response time: a job that it delayed may delay this one.
///
/// ```
/// use std::time::Duration;
/// use tautline_analysis::taken::{Seen, Taken, TakenTimes, response_time_with};
/// use tautline_analysis::{Overheads, Task};
///
/// let ms = Duration::from_millis;
/// let tasks = [Task::new("fast", ms(10), ms(2), 2), Task::new("slow", ms(50), ms(5), 1)];
/// let piece = Taken { from_ns: 40_000_000, to_ns: 44_000_000, length_ns: 4_000_000, seen: Seen::Running };
/// let taken = TakenTimes::new([piece]);
/// let slow = response_time_with(&tasks, &Overheads::NONE, 1, |window_ns| taken.most_within(window_ns))?;
/// // 5 ms of its own, 4 ms taken, and the fast one twice.
/// assert_eq!(slow.response_ns, 13_000_000);
/// # Ok::<(), tautline_analysis::AnalysisError>(())
/// ```
///
/// # Errors
/// As [`response_time_per_task`], for this task: the taken time may leave too little of the core.
///
/// # Panics
/// If there is no such task.
pub fn response_time_with(
    tasks: &[Task],
    overheads: &Overheads,
    index: usize,
    taken_within: impl Fn(u64) -> u64,
) -> Result<Response, AnalysisError> {
    let mut tasks = tasks.to_vec();
    let own_ns = tasks[index].blocking_ns;
    let mut lost_ns = 0;
    loop {
        tasks[index].blocking_ns = own_ns.saturating_add(lost_ns);
        let response = response_time_per_task(&tasks, overheads).swap_remove(index)?;
        let window_ns = response.response_ns.saturating_add(response.period_ns);
        // The loss only grows, and no further than all that was taken.
        let more_ns = taken_within(window_ns);
        if more_ns <= lost_ns {
            return Ok(response);
        }
        lost_ns = more_ns;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng, rngs::StdRng};
    use std::time::Duration;

    fn piece(seen: Seen, from_ns: u64, to_ns: u64, length_ns: u64) -> Taken {
        Taken { from_ns, to_ns, length_ns, seen }
    }

    fn lengths(taken: &TakenTimes) -> Vec<(u64, u64)> {
        taken.pieces().iter().map(|piece| (piece.from_ns, piece.length_ns)).collect()
    }

    #[test]
    fn no_time_counts_twice() {
        use Seen::{Running, WokenLate};
        // One gap of 30 seen by the job that ran and by two timers; another one by a timer alone.
        let seen = [
            piece(WokenLate, 115, 130, 15),
            piece(Running, 90, 200, 30),
            piece(WokenLate, 110, 130, 20),
            piece(WokenLate, 400, 407, 7),
            piece(Running, 500, 500, 0),
        ];
        let taken = TakenTimes::new(seen);
        assert_eq!(lengths(&taken), [(90, 30), (400, 7)]);
        let total_ns = |way| taken.seen(&[way]).total_ns();
        assert_eq!((total_ns(Running), total_ns(WokenLate), taken.longest_ns()), (30, 7, 30));
        // The timer saw more than the job lost: the rest was while nobody ran.
        let taken = TakenTimes::new([piece(Running, 90, 200, 30), piece(WokenLate, 190, 240, 50)]);
        assert_eq!(lengths(&taken), [(90, 30), (190, 20)]);
        // Jobs that others preempt: each sees its own.
        let taken = TakenTimes::new([piece(Running, 90, 200, 30), piece(Running, 100, 150, 5)]);
        assert_eq!(taken.total_ns(), 35);
        // Who waited for others while the clock was not served saw the same.
        let taken = TakenTimes::new([piece(Seen::Waited, 90, 200, 30), piece(WokenLate, 110, 130, 20)]);
        assert_eq!((lengths(&taken), taken.seen(&[Seen::Waited]).total_ns()), (vec![(90, 30)], 30));
        // What a job used beyond its wcet is nothing that a timer could have seen, and comes on top.
        let taken = TakenTimes::new([piece(Seen::Overran, 90, 200, 30), piece(WokenLate, 110, 130, 20)]);
        assert_eq!(
            (lengths(&taken), taken.seen(&[Seen::Overran]).total_ns()),
            (vec![(90, 30), (110, 20)], 30)
        );
        assert_eq!(TakenTimes::new([]).most_within(u64::MAX), 0);
    }

    #[test]
    fn waits_of_several_threads_are_one() {
        use Seen::{Overran, Running, Waited, WokenLate};
        // Two threads waited at once, and a clock was late for 8 more than they; one that waited for nothing spans it and the next wait.
        let sight = |thread, priority, taken| Sight { taken, thread, priority: Some(priority) };
        let seen = [
            sight(1, 9, piece(Waited, 100, 160, 40)),
            sight(2, 8, piece(Waited, 110, 170, 50)),
            Sight { taken: piece(WokenLate, 150, 230, 58), thread: 0, priority: None },
            sight(3, 8, piece(Waited, 90, 420, 0)),
            sight(1, 9, piece(Waited, 400, 410, 10)),
            sight(4, 9, piece(Running, 500, 510, 3)),
            sight(4, 9, piece(Overran, 500, 510, 4)),
        ];
        let taken = TakenTimes::with_waits(&seen, Some(8));
        assert_eq!(lengths(&taken), [(100, 50), (150, 8), (400, 10), (500, 3), (500, 4)], "{taken:?}");
        // Those below are left out; what two others saw of a wait is not that wait's.
        let taken = TakenTimes::with_waits(&seen, Some(9));
        assert_eq!(lengths(&taken), [(100, 40), (150, 18), (400, 10), (500, 3), (500, 4)], "{taken:?}");
        let more = seen.into_iter().chain([sight(5, 9, piece(Waited, 495, 520, 12))]).collect::<Vec<_>>();
        let taken = TakenTimes::with_waits(&more, Some(9));
        assert_eq!(taken.seen(&[Waited]).total_ns(), 40 + 10 + 5, "{taken:?}");
        // What a thread saw itself is no part of its wait.
        let more = seen.into_iter().chain([sight(4, 9, piece(Waited, 495, 520, 12))]).collect::<Vec<_>>();
        assert_eq!(TakenTimes::with_waits(&more, Some(9)).seen(&[Waited]).total_ns(), 40 + 10 + 12);
    }

    #[test]
    fn windows_lose_what_may_lie_in_them() {
        let taken = TakenTimes::new([
            piece(Seen::Running, 100, 110, 10),
            piece(Seen::Running, 150, 170, 5),
            piece(Seen::WokenLate, 300, 340, 40),
        ]);
        assert_eq!([taken.before(100, 50), taken.before(101, 50), taken.before(160, 60)], [0, 1, 15]);
        assert_eq!([taken.before(153, 60), taken.before(110, 3), taken.before(200, 31)], [13, 3, 1]);
        assert_eq!(taken.before(1_000, 30), 0);
        assert_eq!(
            [1, 10, 42, 60, 240, u64::MAX].map(|window| taken.most_within(window)),
            [1, 10, 40, 40, 55, 55]
        );
        assert_eq!(taken.most_within(41), 40);
    }

    /// A schedule played step by step, with pieces taken at random: no response is beyond the bound of what was taken.
    #[test]
    fn bounds_hold_whatever_is_taken() {
        let mut rng = StdRng::seed_from_u64(0x7a6b);
        for round in 0..300 {
            let tasks: Vec<Task> = [(10, 1..3), (25, 2..6), (60, 5..15)]
                .into_iter()
                .enumerate()
                .map(|(i, (period, wcet))| {
                    let ns = Duration::from_nanos;
                    Task::new(format!("{i}"), ns(period), ns(rng.random_range(wcet)), 9 - i as u8)
                })
                .collect();
            let mut at = 0;
            let seen: Vec<Taken> = (0..rng.random_range(0..6))
                .map(|_| {
                    at += rng.random_range(5..120);
                    let length = rng.random_range(1..8);
                    at += length;
                    piece(Seen::Running, at - length, at, length)
                })
                .collect();
            let taken = TakenTimes::new(seen.clone());
            for (index, release, end) in simulate(&tasks, &seen, 600) {
                let bound =
                    response_time_with(&tasks, &Overheads::NONE, index, |window| taken.before(end, window));
                let Ok(bound) = bound else { continue };
                assert!(
                    end - release <= bound.response_ns,
                    "round {round}: task {index}, {release} to {end}: {bound:?} {seen:?}"
                );
                let most =
                    response_time_with(&tasks, &Overheads::NONE, index, |window| taken.most_within(window));
                assert!(most.is_err() || most.unwrap().response_ns >= bound.response_ns);
            }
        }
    }

    /// The jobs of all tasks, each with its task, its release and its end: one step is 1 ns.
    fn simulate(tasks: &[Task], taken: &[Taken], until_ns: u64) -> Vec<(usize, u64, u64)> {
        let mut queues: Vec<std::collections::VecDeque<(u64, u64)>> = vec![Default::default(); tasks.len()];
        let mut ended = Vec::new();
        for now in 0..until_ns {
            for (queue, task) in queues.iter_mut().zip(tasks) {
                if now % task.period_ns == 0 {
                    queue.push_back((now, task.wcet_ns));
                }
            }
            if taken.iter().any(|piece| (piece.from_ns..piece.to_ns).contains(&now)) {
                continue;
            }
            let Some((index, queue)) = queues.iter_mut().enumerate().find(|(_, queue)| !queue.is_empty())
            else {
                continue;
            };
            if let Some((release, left)) = queue.front_mut() {
                *left -= 1;
                if *left == 0 {
                    ended.push((index, *release, now + 1));
                    queue.pop_front();
                }
            }
        }
        ended
    }
}
