// SPDX-License-Identifier: MIT OR Apache-2.0
//! Execution times by input size, for callbacks that state it. Recording is in `hot.rs`.

use std::sync::Arc;
use std::sync::atomic::AtomicU64;

use tautline_rt::Words;

/// The maximum number of size classes.
pub(crate) const CLASSES: usize = 32;
/// The number of a class's longest execution times that are kept, for the estimate of longer ones.
pub(crate) const LONGEST: usize = 64;
/// The words of one class: its jobs, the least and the greatest size, the maximum and its size, the longest execution times. A reader that
/// reads in this order sees sizes and a maximum that cover all jobs counted.
pub(crate) const CLASS_WORDS: usize = 5 + LONGEST;
pub(crate) const INPUT_WORDS: usize = CLASSES * CLASS_WORDS;

/// A class is an eighth of its sizes wide: each power of two is cut into eight, and below 16 each size has its own.
const SUB_BITS: u32 = 3;

/// The lowest and the highest size of a size's class.
pub(crate) const fn class_of(size: u64) -> (u64, u64) {
    let shift = if size == 0 { 0 } else { size.ilog2().saturating_sub(SUB_BITS) };
    let low = size >> shift << shift;
    (low, low | ((1 << shift) - 1))
}

/// Jobs whose inputs had about the same size: see [`job::set_input_size`](crate::job::set_input_size).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SizeClass {
    /// Number of jobs.
    pub jobs: u64,
    /// The smallest size.
    pub least: u64,
    /// The greatest size.
    pub greatest: u64,
    /// The longest execution time.
    pub max_ns: u64,
    /// The input size of that job.
    pub size_of_max: u64,
    /// The longest execution times, in ascending order, at most 64.
    pub longest_ns: Vec<u64>,
}

/// Where a callback's classes are written: by one thread at a time, read by any.
///
/// A class has its row from its first job on. Once all rows are taken, a job goes to the row whose sizes are nearest, which then spans
/// more of them.
#[derive(Debug)]
pub(crate) struct Inputs {
    words: Arc<Words>,
    /// Their first index in `words`.
    at: usize,
}

impl Inputs {
    /// The inputs that begin `at` words into a block.
    pub fn within(words: Arc<Words>, at: usize) -> Inputs {
        Inputs { words, at }
    }

    pub fn rows(&self) -> &[[AtomicU64; CLASS_WORDS]] {
        self.words.get(self.at..self.at + INPUT_WORDS).unwrap_or(&[]).as_chunks().0
    }

    /// Reads words that another process may have written; the result is in ascending order of sizes.
    pub fn of_words(words: &[u64]) -> Vec<SizeClass> {
        let class = |row: &[u64; CLASS_WORDS]| {
            let [jobs, least, greatest, max_ns, size_of_max, longest @ ..] = *row;
            if jobs == 0 || least > greatest {
                return None;
            }
            // Empty places are 0. The time of a job that is being recorded may be visible before the job is counted.
            let mut longest_ns: Vec<u64> =
                longest.into_iter().filter(|ns| (1..=max_ns).contains(ns)).collect();
            longest_ns.sort_unstable();
            let surplus = longest_ns.len().saturating_sub(usize::try_from(jobs).unwrap_or(usize::MAX));
            longest_ns.drain(..surplus);
            let size_of_max = size_of_max.clamp(least, greatest);
            Some(SizeClass { jobs, least, greatest, max_ns, size_of_max, longest_ns })
        };
        let mut classes: Vec<SizeClass> = words.as_chunks().0.iter().filter_map(class).collect();
        classes.sort_by_key(|class| (class.least, class.greatest));
        classes
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::Ordering;

    fn inputs() -> Inputs {
        Inputs::within(Arc::new(Words::private(INPUT_WORDS)), 0)
    }

    fn read(inputs: &Inputs) -> Vec<SizeClass> {
        let words: Vec<u64> =
            inputs.rows().as_flattened().iter().map(|word| word.load(Ordering::Acquire)).collect();
        Inputs::of_words(&words)
    }

    #[test]
    fn classes_join_without_gap_and_are_an_eighth_wide() {
        let (mut size, mut classes) = (0, 0);
        loop {
            let (low, high) = class_of(size);
            assert_eq!(
                (low, class_of(high), class_of(low + (high - low) / 2)),
                (size, (low, high), (low, high))
            );
            assert!(high - low <= low / 8, "{low} to {high}");
            classes += 1;
            let Some(next) = high.checked_add(1) else { break };
            size = next;
        }
        assert_eq!((class_of(15), class_of(16), classes), ((15, 15), (16, 17), 8 + 61 * 8));
    }

    #[test]
    fn jobs_are_kept_by_class_with_the_longest_of_each() {
        let inputs = inputs();
        assert!(read(&inputs).is_empty());
        (1..=100).for_each(|ns| inputs.record(1_024, ns));
        for (size, ns) in [(1_151, 7), (1_030, 101), (1_152, 300), (0, 0), (0, 5)] {
            inputs.record(size, ns);
        }
        let class = |jobs, [least, size_of_max, greatest]: [u64; 3], max_ns, longest_ns| SizeClass {
            jobs,
            least,
            greatest,
            max_ns,
            size_of_max,
            longest_ns,
        };
        let expected = [
            class(2, [0, 0, 0], 5, vec![5]),
            class(102, [1_024, 1_030, 1_151], 101, (38..=101).collect()),
            class(1, [1_152; 3], 300, vec![300]),
        ];
        assert_eq!(read(&inputs), expected);
    }

    #[test]
    fn more_classes_than_rows_share_the_nearest() {
        let inputs = inputs();
        (0..CLASSES as u64).for_each(|n| inputs.record(1_000_000 << n, n));
        for (size, ns) in [(u64::MAX, 90), (900_000, 80), (3 << 20, 70)] {
            inputs.record(size, ns);
        }
        let classes = read(&inputs);
        let spans = |index: usize| {
            (classes[index].jobs, classes[index].least, classes[index].greatest, classes[index].max_ns)
        };
        assert_eq!(classes.len(), CLASSES);
        assert_eq!(spans(0), (2, 900_000, 1_000_000, 80));
        assert_eq!(spans(2), (2, 3 << 20, 4_000_000, 70));
        assert_eq!(spans(CLASSES - 1), (2, 1_000_000 << 31, u64::MAX, 90));
        assert!(classes.is_sorted_by(|one, next| one.greatest < next.least));
    }

    #[test]
    fn any_words_are_classes() {
        for words in [vec![], vec![u64::MAX; 7], vec![u64::MAX; INPUT_WORDS + 3]] {
            let classes = Inputs::of_words(&words);
            assert_eq!(classes.len(), words.len() / CLASS_WORDS);
        }
        let mut words = vec![9; CLASS_WORDS];
        words[..4].copy_from_slice(&[2, 30, 20, 9]);
        assert!(Inputs::of_words(&words).is_empty(), "the least size is above the greatest");
        words[..4].copy_from_slice(&[2, 20, 30, 8]);
        let class = &Inputs::of_words(&words)[0];
        assert!(class.longest_ns.is_empty(), "longer than the longest");
        assert_eq!(class.size_of_max, 20, "9 was none of the sizes");
        words[3] = 9;
        assert_eq!(Inputs::of_words(&words)[0].longest_ns, [9, 9], "more than there were jobs");
    }
}
