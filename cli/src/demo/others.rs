// SPDX-License-Identifier: MIT OR Apache-2.0
//! What other threads had of the demo's core: real-time threads, kernel threads, and ordinary ones in the share that Linux keeps for
//! them.
//!
//! A job that waits, waits for threads of the demo above it, whose times are known, or for others. What it waited beyond the former is
//! therefore theirs.

use tautline_analysis::taken::{Seen, Taken};

use super::protocol::Job;

/// Of each topic, what others had while its jobs waited: from the jobs of each, highest priority first, and from what the demo's threads
/// used and lost besides. In a job's interval lies all of what ran in place of it.
pub fn had_the_core(topics: &[&[Job]], besides: impl IntoIterator<Item = Taken>) -> Vec<Vec<Taken>> {
    let mut known: Vec<Taken> = besides.into_iter().collect();
    let mut others = Vec::new();
    for (index, jobs) in topics.iter().enumerate() {
        known.sort_unstable_by_key(|piece| piece.from_ns);
        let (mut of_topic, mut of_others) = (Vec::with_capacity(jobs.len()), Vec::new());
        for job in *jobs {
            let first = known.partition_point(|piece| piece.from_ns < job.begin_ns);
            let begun = known[first..].iter().take_while(|piece| piece.from_ns < job.end_ns);
            let known_ns: u64 =
                begun.filter(|piece| piece.to_ns <= job.end_ns).map(|piece| piece.length_ns).sum();
            // One of a topic below, which ran in place of this: a defect, and no other thread's time.
            let inverted = topics[index + 1..].iter().any(|below| {
                let next = below.partition_point(|below| below.begin_ns <= job.begin_ns);
                below.get(next).is_some_and(|below| below.begin_ns < job.end_ns)
            });
            let other_ns = if inverted { 0 } else { job.waited_ns.saturating_sub(known_ns) };
            let piece =
                |length_ns| Taken { from_ns: job.begin_ns, to_ns: job.end_ns, length_ns, seen: Seen::Waited };
            if other_ns > 0 {
                of_others.push(piece(other_ns));
            }
            // What it had itself, and what others had of it: a job below has waited for both.
            of_topic.push(piece((job.end_ns - job.begin_ns).saturating_sub(job.waited_ns) + other_ns));
        }
        known.extend(of_topic);
        others.push(of_others);
    }
    others
}

#[cfg(test)]
mod tests {
    use super::*;

    fn job(begin_ns: u64, end_ns: u64, waited_ns: u64) -> Job {
        Job { release_ns: begin_ns, begin_ns, end_ns, waited_ns }
    }

    fn found(topics: &[&[Job]], besides: &[Taken]) -> Vec<Vec<(u64, u64, u64)>> {
        let triple = |piece: &Taken| (piece.from_ns, piece.to_ns, piece.length_ns);
        let others = had_the_core(topics, besides.iter().copied());
        others.iter().map(|pieces| pieces.iter().map(triple).collect()).collect()
    }

    #[test]
    fn what_was_waited_for_nobody_of_the_demo_is_others() {
        // The sampler for 5 from 100 on; then the upper one, of which somebody had 10; the lower one waits for all of that.
        let sampler = Taken { from_ns: 100, to_ns: 105, length_ns: 5, seen: Seen::Overran };
        let upper = [job(105, 135, 10), job(300, 320, 0)];
        let lower = [job(50, 190, 5 + 30 + 7)];
        assert_eq!(found(&[&upper, &lower], &[sampler]), [vec![(105, 135, 10)], vec![(50, 190, 7)]]);
        // What ends after a job has not run in place of it.
        let later = Taken { from_ns: 130, to_ns: 140, length_ns: 10, seen: Seen::Overran };
        assert_eq!(found(&[&upper], &[later])[0], [(105, 135, 10)]);
    }

    #[test]
    fn a_topic_that_runs_in_place_of_one_above_is_no_other() {
        let (upper, lower) = ([job(100, 150, 30)], [job(110, 140, 0)]);
        assert_eq!(found(&[&upper, &lower], &[]), [vec![], vec![]]);
    }
}
