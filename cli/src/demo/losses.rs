// SPDX-License-Identifier: MIT OR Apache-2.0
//! The causes that kept jobs from the demo's core: the host, the middleware, and other threads, which are real-time threads, kernel
//! threads, and ordinary ones in the share that Linux keeps for them.
//!
//! A waiting job waits for threads of the demo with higher priority, whose times are known, or for other threads. The part of a wait that
//! exceeds the known times is therefore due to other threads.

use super::application::Collected;
use super::protocol::{Job, Measured};
use crate::moment::{Kind, Moment};
use tautline_analysis::taken::{Seen, Taken, TakenTimes};

/// For each topic, highest priority first: the times that may have kept its jobs from the core. `sampler_first`: the subscriber's sampler
/// is above its callbacks, so it does not wait for them.
pub fn losses(publisher: &Collected, subscriber: &Measured, sampler_first: bool) -> Vec<TakenTimes> {
    // Waits are handled separately: the jobs of topics contain theirs.
    let taken = |moments: &[Moment]| {
        let taken = moments.iter().filter_map(Moment::taken);
        taken.filter(|piece| piece.seen != Seen::Waited).collect::<Vec<_>>()
    };
    let by_worker = publisher.by_callbacks.concat();
    let worker = taken(&by_worker);
    // No thread of the demo is above the publisher's sampler, so every wait of it when it was due is due to other threads.
    let served = taken(&publisher.by_sampler).into_iter().map(|piece| match piece.seen {
        Seen::WokenLate => Taken { length_ns: piece.to_ns - piece.from_ns, ..piece },
        _ => piece,
    });
    let (late, served): (Vec<Taken>, Vec<Taken>) = served.partition(|piece| piece.seen == Seen::WokenLate);
    let mut waited = waits(&by_worker, &late, served.iter().copied());
    if sampler_first {
        let above = served.iter().chain(&worker).chain(&waited).copied().collect::<Vec<_>>();
        waited.extend(waits(&subscriber.seen.by_sampler, &[], above));
    }
    let served = late.into_iter().chain(served);
    let samplers = served.chain(taken(&subscriber.seen.by_sampler));
    let middleware: Vec<Taken> = worker.into_iter().chain(samplers).chain(waited).collect();
    let topics: Vec<_> = subscriber.seen.by_callbacks.iter().map(|moments| taken(moments)).collect();
    let used = |pieces: &[Taken]| {
        pieces.iter().filter(|piece| piece.seen == Seen::Overran).copied().collect::<Vec<_>>()
    };
    // Time that was taken from running callbacks is contained in the times of their jobs.
    let ran = middleware.iter().filter(|piece| piece.seen != Seen::WokenLate).copied();
    let ran = ran.chain(topics.iter().flat_map(|pieces| used(pieces)));
    let jobs: Vec<_> = subscriber.topics.iter().map(|topic| topic.jobs.as_slice()).collect();
    let others = had_by_others(&jobs, ran);
    let of_topic = |index: usize| {
        // Time that the host took counts whichever thread ran; time that a lower topic used did not delay a higher one.
        let host = topics.iter().flatten().filter(|piece| piece.seen == Seen::Running).copied();
        let used = topics[..=index].iter().flat_map(|pieces| used(pieces));
        let waited = others[..=index].iter().flatten().copied();
        TakenTimes::new(middleware.iter().copied().chain(host).chain(used).chain(waited))
    };
    (0..topics.len()).map(of_topic).collect()
}

/// The time that other threads had while a thread waited. The thread waits only for `known`, and is woken when `late` is over.
fn waits(moments: &[Moment], late: &[Taken], known: impl IntoIterator<Item = Taken>) -> Vec<Taken> {
    let mut woken_ns: Vec<u64> = late.iter().map(|piece| piece.to_ns).collect();
    woken_ns.sort_unstable();
    let jobs = moments.iter().filter(|moment| moment.kind == Kind::Waited).map(|wait| {
        let before = woken_ns.partition_point(|woken_ns| *woken_ns <= wait.to_ns);
        let last_ns = before.checked_sub(1).map_or(0, |last| woken_ns[last]);
        let ready_ns = last_ns.max(wait.from_ns);
        let waited_ns = wait.length_ns.saturating_sub(ready_ns - wait.from_ns);
        Job { release_ns: wait.from_ns, ready_ns, begin_ns: ready_ns, end_ns: wait.to_ns, waited_ns }
    });
    had_by_others(&[&jobs.collect::<Vec<_>>()], known).concat()
}

/// For each topic, highest priority first, the time that other threads had while its jobs waited. It is computed from the jobs, and from the
/// times that the demo's threads used and lost besides. The interval of a job contains everything that ran instead of it.
fn had_by_others(topics: &[&[Job]], besides: impl IntoIterator<Item = Taken>) -> Vec<Vec<Taken>> {
    let mut known: Vec<Taken> = besides.into_iter().collect();
    let mut others = Vec::new();
    for (index, jobs) in topics.iter().enumerate() {
        known.sort_unstable_by_key(|piece| piece.from_ns);
        let lengths = known.iter().map(|piece| piece.to_ns.saturating_sub(piece.from_ns));
        let longest_ns = lengths.max().unwrap_or(0);
        let (mut of_topic, mut of_others) = (Vec::with_capacity(jobs.len()), Vec::new());
        for job in *jobs {
            let in_place = |piece: &Taken| {
                // An interval that began before the job may lie in it as far as possible; one that ends after the job did not run instead of it.
                let within_ns = piece.to_ns.saturating_sub(piece.from_ns.max(job.ready_ns));
                if piece.to_ns <= job.end_ns { piece.length_ns.min(within_ns) } else { 0 }
            };
            let first =
                known.partition_point(|piece| piece.from_ns.saturating_add(longest_ns) < job.ready_ns);
            let begun = known[first..].iter().take_while(|piece| piece.from_ns < job.end_ns);
            let known_ns: u64 = begun.map(in_place).sum();
            // A job of a lower topic that ran instead of this one is a defect, and not the time of another thread.
            let inverted = topics[index + 1..].iter().any(|below| {
                let next = below.partition_point(|below| below.begin_ns <= job.ready_ns);
                below.get(next).is_some_and(|below| below.begin_ns < job.end_ns)
            });
            let other_ns = if inverted { 0 } else { job.waited_ns.saturating_sub(known_ns) };
            let piece =
                |length_ns| Taken { from_ns: job.ready_ns, to_ns: job.end_ns, length_ns, seen: Seen::Waited };
            if other_ns > 0 {
                of_others.push(piece(other_ns));
            }
            // A lower job waited both for the job's own time and for the time that others took from it.
            of_topic.push(piece((job.end_ns - job.ready_ns).saturating_sub(job.waited_ns) + other_ns));
        }
        known.extend(of_topic);
        others.push(of_others);
    }
    others
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::demo::protocol::TopicMeasured;

    fn job(begin_ns: u64, end_ns: u64, waited_ns: u64) -> Job {
        Job { release_ns: begin_ns, ready_ns: begin_ns, begin_ns, end_ns, waited_ns }
    }

    fn found(topics: &[&[Job]], besides: &[Taken]) -> Vec<Vec<(u64, u64, u64)>> {
        let triple = |piece: &Taken| (piece.from_ns, piece.to_ns, piece.length_ns);
        let others = had_by_others(topics, besides.iter().copied());
        others.iter().map(|pieces| pieces.iter().map(triple).collect()).collect()
    }

    #[test]
    fn what_was_waited_for_nobody_of_the_demo_is_others() {
        // The sampler for 5 from 100 on; then the upper one, of which somebody had 10; the lower one waits for all of that.
        let sampler = Taken { from_ns: 100, to_ns: 105, length_ns: 5, seen: Seen::Overran };
        let upper = [job(105, 135, 10), job(300, 320, 0)];
        let lower = [job(50, 190, 5 + 30 + 7)];
        assert_eq!(found(&[&upper, &lower], &[sampler]), [vec![(105, 135, 10)], vec![(50, 190, 7)]]);
        // An interval that ends after the job did not run instead of it.
        let later = Taken { from_ns: 130, to_ns: 140, length_ns: 10, seen: Seen::Overran };
        assert_eq!(found(&[&upper], &[later])[0], [(105, 135, 10)]);
    }

    #[test]
    fn what_was_waited_before_a_job_began_is_others_too() {
        // Both are ready at 100; the upper one has it from 110 on, until 150, and the lower one from 157.
        let upper = [Job { begin_ns: 110, ..job(100, 150, 10) }];
        let lower = [Job { begin_ns: 157, ..job(100, 190, 57) }];
        assert_eq!(found(&[&upper, &lower], &[]), [vec![(100, 150, 10)], vec![(100, 190, 7)]]);
        // Ready when the upper one was half through: of that it has seen 20 at most.
        let lower = [Job { begin_ns: 157, ..job(130, 190, 27) }];
        assert_eq!(found(&[&upper, &lower], &[])[1], [(130, 190, 7)]);
    }

    #[test]
    fn a_topic_that_runs_in_place_of_one_above_is_no_other() {
        let (upper, lower) = ([job(100, 150, 30)], [job(110, 140, 0)]);
        assert_eq!(found(&[&upper, &lower], &[]), [vec![], vec![]]);
    }

    #[test]
    fn who_was_woken_late_waits_from_then_on() {
        // Due at 100, the sampler was served at 106 and used 2; the worker had the core from 115 to 118. The next one waited only for the sampler.
        let late =
            |from_ns, to_ns| Taken { from_ns, to_ns, length_ns: to_ns - from_ns, seen: Seen::WokenLate };
        let served = |from_ns, to_ns| Taken { seen: Seen::Overran, ..late(from_ns, to_ns) };
        let noted = [moment(Kind::Waited, 100, 118, 15), moment(Kind::Waited, 200, 209, 2)];
        let known = [served(106, 108), served(200, 202)];
        let pieces = waits(&noted, &[late(100, 106)], known);
        assert_eq!(pieces, [Taken { seen: Seen::Waited, length_ns: 15 - 6 - 2, ..late(106, 118) }]);
        assert_eq!(waits(&[moment(Kind::Late, 100, 118, 18)], &[], []), []);
    }

    fn moment(kind: Kind, from_ns: u64, to_ns: u64, length_ns: u64) -> Moment {
        Moment { kind, from_ns, to_ns, length_ns }
    }

    #[test]
    fn a_topic_loses_to_what_is_above_it_and_to_the_host() {
        // The publisher's sampler was due at 90, ready at 96, and ran at 100.
        let publisher = Collected {
            by_callbacks: vec![vec![moment(Kind::Overran, 90, 104, 3)]],
            by_sampler: vec![moment(Kind::WokenLate, 90, 100, 6), moment(Kind::Served, 99, 101, 2)],
            ..Collected::default()
        };
        let upper = vec![moment(Kind::Overran, 90, 136, 4), moment(Kind::Taken, 105, 135, 1)];
        let lower = vec![moment(Kind::Overran, 40, 191, 9), moment(Kind::Late, 0, 900, 900)];
        let topic = |jobs| TopicMeasured { jobs, ..TopicMeasured::default() };
        let wait = moment(Kind::Waited, 300, 340, 40);
        let subscriber = Measured {
            topics: vec![topic(vec![job(105, 135, 0)]), topic(vec![job(50, 190, 3 + 2 + 30 + 4 + 7)])],
            seen: Collected {
                by_callbacks: vec![upper, lower],
                by_sampler: vec![wait],
                ..Collected::default()
            },
            ..Measured::default()
        };
        let all = losses(&publisher, &subscriber, false);
        let of = |index: usize, seen| all[index].seen(&[seen]).total_ns();
        // Late by what it waited, too; of a job below only what the host took counts for one above.
        assert_eq!(
            [Seen::WokenLate, Seen::Running, Seen::Overran, Seen::Waited].map(|seen| of(0, seen)),
            [10, 1, 9, 0]
        );
        // Who waited saw 7 of the 10.
        assert_eq!(
            [Seen::WokenLate, Seen::Running, Seen::Overran, Seen::Waited].map(|seen| of(1, seen)),
            [3, 1, 18, 7]
        );
        // What a sampler above all topics waited has kept them from being woken.
        let waited_ns =
            losses(&publisher, &subscriber, true).into_iter().map(|all| all.seen(&[Seen::Waited]).total_ns());
        assert_eq!(waited_ns.collect::<Vec<_>>(), [40, 7 + 40]);
    }
}
