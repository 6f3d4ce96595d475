// SPDX-License-Identifier: MIT OR Apache-2.0
//! The latest moments of a callback that need an explanation: when its core was taken from it, when it was late.

use std::sync::Arc;
use std::sync::atomic::AtomicU64;

use tautline_rt::Words;

/// The number of moments that are kept.
pub(crate) const CAPACITY: usize = if cfg!(taut_loom) { 2 } else { 128 };
/// The words of one moment: its begin, its end, and its length with its kind.
pub(crate) const ENTRY_WORDS: usize = 3;
/// The number of moments written, the entries, the number of moments begun: a reader that reads in this order sees which entries were
/// overwritten meanwhile.
pub(crate) const MOMENT_WORDS: usize = 2 + CAPACITY * ENTRY_WORDS;

/// Something that took time on a callback's core.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Moment {
    /// Its kind.
    pub kind: MomentKind,
    /// It lies after this time, in `CLOCK_MONOTONIC` ns.
    pub from_ns: u64,
    /// And before this time.
    pub to_ns: u64,
    /// Its length; less than the time between the two times if its exact position is not known.
    pub length_ns: u64,
}

/// Kinds of a [`Moment`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MomentKind {
    /// A job took longer than [`CallbackOptions::bound`](crate::CallbackOptions::bound): from its release to its end.
    Late,
    /// The core was taken from a job while it ran, by the hypervisor or by interrupts: some time between its begin and its end.
    Taken,
    /// A timer for which the sampler slept was served late: the time from its due time until the sampler ran, less the time that the
    /// sampler then waited for the core.
    WokenLate,
    /// A job used more processor time than its [budget](crate::CallbackOptions::budget): the excess, at some time between its release
    /// and its end, or before that, since the previous job.
    Overran,
    /// The sampler served events: the processor time that it used for them.
    Served,
    /// A [`Late`](Self::Late) job did not have the core: from its release, or from the end of the previous job on its thread, to its start,
    /// while its thread was not woken or other threads ran; and while other threads preempted it. Or the sampler was ready to run, and did
    /// not run.
    Waited,
}

impl MomentKind {
    const ALL: [MomentKind; 6] = [
        MomentKind::Late,
        MomentKind::Taken,
        MomentKind::WokenLate,
        MomentKind::Overran,
        MomentKind::Served,
        MomentKind::Waited,
    ];
    const BITS: u32 = 3;
}

/// Where a callback's moments are written: by one thread at a time, read by any.
#[derive(Debug)]
pub(crate) struct Moments {
    words: Arc<Words>,
    /// Their first index in `words`.
    at: usize,
}

impl Moments {
    /// The moments that begin `at` words into a block.
    pub fn within(words: Arc<Words>, at: usize) -> Moments {
        Moments { words, at }
    }

    pub fn words(&self) -> &[AtomicU64] {
        self.words.get(self.at..self.at + MOMENT_WORDS).unwrap_or(&[])
    }

    /// Reads words that another process may have written: returns the latest complete moments, the oldest first, and the number
    /// of older ones.
    pub fn of_words(words: &[u64]) -> (Vec<Moment>, u64) {
        let [written, entries @ .., begun] = words else { return (Vec::new(), 0) };
        let mut moments = Vec::new();
        let oldest = written.saturating_sub(CAPACITY as u64).max(begun.saturating_sub(CAPACITY as u64));
        for number in oldest..*written {
            let at = (number % CAPACITY as u64) as usize * ENTRY_WORDS;
            let Some(&[from_ns, to_ns, length]) = entries.get(at..at + ENTRY_WORDS) else { break };
            let kind = (length & ((1 << MomentKind::BITS) - 1)) as usize;
            let Some(kind) = MomentKind::ALL.get(kind).copied() else { continue };
            let length_ns = length >> MomentKind::BITS;
            if from_ns <= to_ns && length_ns <= to_ns - from_ns {
                moments.push(Moment { kind, from_ns, to_ns, length_ns });
            }
        }
        let older = written.saturating_sub(moments.len() as u64);
        (moments, older)
    }
}

/// The third word of an entry.
pub(crate) const fn encode(kind: MomentKind, length_ns: u64) -> u64 {
    // A length of 146 years is as good as a longer one.
    let most = u64::MAX >> MomentKind::BITS;
    let length_ns = if length_ns < most { length_ns } else { most };
    (length_ns << MomentKind::BITS) | kind as u64
}

#[cfg(all(test, not(taut_loom)))]
mod tests {
    use super::*;
    use std::sync::atomic::{AtomicBool, Ordering};

    fn moments() -> Moments {
        Moments::within(Arc::new(Words::private(MOMENT_WORDS)), 0)
    }

    fn moment(kind: MomentKind, at: u64) -> Moment {
        Moment { kind, from_ns: at, to_ns: 3 * at, length_ns: at }
    }

    fn read(moments: &Moments) -> (Vec<Moment>, u64) {
        let words: Vec<u64> = moments.words().iter().map(|word| word.load(Ordering::Acquire)).collect();
        Moments::of_words(&words)
    }

    #[test]
    fn the_latest_are_kept_and_the_others_counted() {
        let moments = moments();
        assert_eq!(read(&moments), (vec![], 0));
        let all: Vec<_> = (0..CAPACITY as u64 + 5)
            .map(|at| moment(MomentKind::ALL[at as usize % MomentKind::ALL.len()], at))
            .inspect(|moment| moments.note(moment))
            .collect();
        assert_eq!(read(&moments), (all[5..].to_vec(), 5));
        moments.note(&Moment { length_ns: u64::MAX, from_ns: 0, to_ns: u64::MAX, kind: MomentKind::Late });
        assert_eq!(read(&moments).0.last().unwrap().length_ns, u64::MAX >> MomentKind::BITS);
    }

    #[test]
    fn any_words_are_moments() {
        for words in [vec![], vec![u64::MAX], vec![u64::MAX; 7], vec![u64::MAX; MOMENT_WORDS]] {
            assert!(Moments::of_words(&words).0.is_empty());
        }
        let mut words = vec![0; MOMENT_WORDS];
        (words[0], words[1], words[2], words[3]) = (1, 50, 40, encode(MomentKind::Taken, 1));
        words[MOMENT_WORDS - 1] = 1;
        assert_eq!(Moments::of_words(&words), (vec![], 1), "it ends before it begins");
        (words[1], words[2], words[3]) = (10, 20, encode(MomentKind::Taken, 11));
        assert_eq!(Moments::of_words(&words), (vec![], 1), "longer than the time that it lies in");
    }

    /// Whoever reads while they are written sees whole ones, without a gap.
    #[test]
    fn a_reader_sees_whole_moments() {
        let (moments, over) = (moments(), AtomicBool::new(false));
        std::thread::scope(|scope| {
            scope.spawn(|| {
                for at in 0..if cfg!(miri) { 1_000 } else { 200_000 } {
                    moments.note(&moment(MomentKind::ALL[at as usize % MomentKind::ALL.len()], at));
                }
                over.store(true, Ordering::Release);
            });
            let mut most = 0;
            while !over.load(Ordering::Acquire) {
                let (seen, older) = read(&moments);
                for (index, found) in seen.iter().enumerate() {
                    let at = older + index as u64;
                    assert_eq!(*found, moment(MomentKind::ALL[at as usize % MomentKind::ALL.len()], at));
                }
                let count = older + seen.len() as u64;
                assert!(count >= most, "{count} after {most}");
                most = count;
            }
        });
        assert_eq!(read(&moments).0.len(), CAPACITY);
    }
}

#[cfg(all(test, taut_loom))]
mod loom_tests {
    use super::*;
    use crate::stats::hot::note;
    use loom::sync::Arc;
    use loom::sync::atomic::AtomicU64;
    use std::sync::atomic::Ordering;

    fn moment(number: u64) -> Moment {
        Moment { kind: MomentKind::Late, from_ns: number, to_ns: 2 * number, length_ns: number }
    }

    #[test]
    fn loom_a_reader_sees_whole_moments() {
        let mut model = loom::model::Builder::new();
        model.preemption_bound = Some(3);
        model.check(|| {
            let words = Arc::new([(); MOMENT_WORDS].map(|()| AtomicU64::new(0)));
            note(&words[..], &moment(1));
            let writer = {
                let words = words.clone();
                // The third takes the place of the first.
                loom::thread::spawn(move || {
                    [2, 3].into_iter().for_each(|number| note(&words[..], &moment(number)))
                })
            };
            // As a snapshot and other processes read them.
            let copy: Vec<u64> = words.iter().map(|word| word.load(Ordering::Acquire)).collect();
            let (seen, older) = Moments::of_words(&copy);
            for (index, found) in seen.iter().enumerate() {
                assert_eq!(*found, moment(older + index as u64 + 1));
            }
            assert!((1..=3).contains(&(older + seen.len() as u64)));
            writer.join().unwrap();
        });
    }
}
