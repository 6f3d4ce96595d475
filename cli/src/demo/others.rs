// SPDX-License-Identifier: MIT OR Apache-2.0
//! What threads that are not the demo's had of its core: other real-time threads, kernel threads, and ordinary ones in the share that
//! Linux keeps for them.
//!
//! A job that waits, waits for threads of the demo above it, whose times are known, or for others. What it waited beyond the former is
//! therefore theirs.

use tautline_analysis::taken::{Seen, Taken};

use super::protocol::Job;

/// From the jobs of each topic, highest priority first, and from what the demo's threads used and lost besides: in a job's interval
/// lies all of what ran in place of it.
pub fn had_the_core(topics: &[&[Job]], besides: impl IntoIterator<Item = Taken>) -> Vec<Taken> {
    let mut known: Vec<Taken> = besides.into_iter().collect();
    let mut others = Vec::new();
    for jobs in topics {
        known.sort_unstable_by_key(|piece| piece.from_ns);
        let mut of_topic = Vec::with_capacity(jobs.len());
        for job in *jobs {
            let first = known.partition_point(|piece| piece.from_ns < job.begin_ns);
            let begun = known[first..].iter().take_while(|piece| piece.from_ns < job.end_ns);
            let known_ns: u64 =
                begun.filter(|piece| piece.to_ns <= job.end_ns).map(|piece| piece.length_ns).sum();
            let piece = |length_ns| Taken {
                from_ns: job.begin_ns,
                to_ns: job.end_ns,
                length_ns,
                seen: Seen::Running,
            };
            let other = piece(job.waited_ns.saturating_sub(known_ns));
            // What it had itself, and what others had of it: a job below has waited for both.
            let own_ns = (job.end_ns - job.begin_ns).saturating_sub(job.waited_ns);
            of_topic.push(piece(own_ns + other.length_ns));
            others.extend((other.length_ns > 0).then_some(other));
        }
        known.extend(of_topic);
    }
    others
}

#[cfg(test)]
mod tests {
    use super::*;

    fn job(begin_ns: u64, end_ns: u64, waited_ns: u64) -> Job {
        Job { release_ns: begin_ns, begin_ns, end_ns, waited_ns }
    }

    #[test]
    fn what_was_waited_for_nobody_of_the_demo_is_others() {
        // The sampler for 5 from 100 on; then the upper one, of which somebody had 10; the lower one waits for all of that.
        let sampler = Taken { from_ns: 100, to_ns: 105, length_ns: 5, seen: Seen::Overran };
        let upper = [job(105, 135, 10), job(300, 320, 0)];
        let lower = [job(50, 190, 5 + 30 + 7)];
        let others = had_the_core(&[&upper, &lower], [sampler]);
        let found: Vec<_> =
            others.iter().map(|piece| (piece.from_ns, piece.to_ns, piece.length_ns)).collect();
        assert_eq!(found, [(105, 135, 10), (50, 190, 7)]);
    }
}
