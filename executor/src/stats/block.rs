// SPDX-License-Identifier: MIT OR Apache-2.0
//! The memory of one callback's statistics: words of this process, or of a file that other processes read.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use tautline_rt::{Policy, ThreadInfo, Words};

use super::histogram::{HISTOGRAM_WORDS, Histogram, HistogramSnapshot};
use super::inputs::{INPUT_WORDS, Inputs, SizeClass};
use super::moments::{MOMENT_WORDS, Moment, Moments};

/// The head: counters and settings, then the name. Two histograms, the moments and the classes of input sizes follow.
pub(crate) const HEAD_WORDS: usize = 64;
const MOMENTS_AT: usize = HEAD_WORDS + 2 * HISTOGRAM_WORDS;
const INPUTS_AT: usize = MOMENTS_AT + MOMENT_WORDS;
pub(crate) const BLOCK_WORDS: usize = INPUTS_AT + INPUT_WORDS;
const NAME_WORDS: usize = 32;

/// Indices of the head's words. A head of zeros is a callback that has done nothing.
pub(crate) mod word {
    pub const STATE: usize = 0;
    /// See [`kind`](super::kind).
    pub const KIND: usize = 1;
    pub const TID: usize = 2;
    /// 0: time-sharing.
    pub const PRIORITY: usize = 3;
    /// Plus one; 0: more than one core.
    pub const CORE: usize = 4;
    pub const MEASURES_EXECUTION: usize = 5;
    pub const PERIOD: usize = 6;
    pub const DEADLINE: usize = 7;
    pub const BUDGET: usize = 8;
    pub const BOUND: usize = 9;
    pub const ACCOUNTS: usize = 10;
    /// The processor time of a reservation in each of its periods; 0: none.
    pub const RESERVED: usize = 11;
    pub const RESERVED_PERIOD: usize = 12;
    // Written by the callback's thread from here on.
    pub const RELEASES: usize = 16;
    pub const COMPLETIONS: usize = 17;
    pub const OVERRUNS: usize = 18;
    pub const DEADLINE_MISSES: usize = 19;
    pub const FIRST_RELEASE: usize = 20;
    pub const LAST_RELEASE: usize = 21;
    /// Plus one; 0: fewer than two releases.
    pub const LEAST_DISTANCE: usize = 22;
    pub const LOST: usize = 23;
    pub const MAX_QUEUE: usize = 24;
    pub const DEPTH: usize = 25;
    pub const DEMOTIONS: usize = 26;
    /// Plus one, as [`LEAST_DISTANCE`].
    pub const GREATEST_DISTANCE: usize = 27;
    pub const NAME: usize = 32;
}

/// Values of [`word::KIND`].
pub(crate) mod kind {
    pub const CALLBACK: u64 = 0;
    pub const GROUP: u64 = 1;
    pub const SAMPLER: u64 = 2;
    /// The overhead of another library's executor.
    pub const EXECUTOR: u64 = 3;
    /// As [`EXECUTOR`], with callbacks that do nothing.
    pub const EXECUTOR_ALONE: u64 = 4;
    /// A callback of which only the publications are observed.
    pub const PUBLICATIONS: u64 = 5;
}

/// Values of [`word::STATE`].
pub(crate) mod state {
    // 0: never used.
    pub const RUNNING: u64 = 1;
    pub const ENDED: u64 = 2;
}

pub(crate) const fn encode_distance(ns: u64) -> u64 {
    ns.saturating_add(1)
}

/// The words of one callback.
#[derive(Debug)]
pub(crate) struct Block {
    words: Arc<Words>,
    pub response: Histogram,
    pub execution: Histogram,
    pub moments: Moments,
    pub inputs: Inputs,
}

impl Drop for Block {
    fn drop(&mut self) {
        self.set_state(state::ENDED);
    }
}

impl Block {
    pub fn private() -> Block {
        Block::new(Words::private(BLOCK_WORDS))
    }

    pub fn new(words: Words) -> Block {
        let words = Arc::new(words);
        let response = Histogram::within(Arc::clone(&words), HEAD_WORDS);
        let execution = Histogram::within(Arc::clone(&words), HEAD_WORDS + HISTOGRAM_WORDS);
        let moments = Moments::within(Arc::clone(&words), MOMENTS_AT);
        let inputs = Inputs::within(Arc::clone(&words), INPUTS_AT);
        Block { words, response, execution, moments, inputs }
    }

    pub fn head(&self) -> Option<&[AtomicU64; HEAD_WORDS]> {
        self.words.first_chunk()
    }

    pub fn set(&self, index: usize, value: u64) {
        if let Some(word) = self.words.get(index) {
            word.store(value, Ordering::Relaxed);
        }
    }

    pub fn get(&self, index: usize) -> u64 {
        self.words.get(index).map_or(0, |word| word.load(Ordering::Relaxed))
    }

    pub fn set_name(&self, name: &str) {
        put_text(&self.words[word::NAME..word::NAME + NAME_WORDS], name);
    }

    pub fn set_policy(&self, policy: Policy) {
        self.set(word::PRIORITY, policy.realtime_priority().map_or(0, u64::from));
        let (runtime_ns, period_ns) = match policy {
            Policy::Deadline { runtime_ns, period_ns } => (runtime_ns, period_ns),
            _ => (0, 0),
        };
        self.set(word::RESERVED, runtime_ns);
        self.set(word::RESERVED_PERIOD, period_ns);
    }

    pub fn set_thread(&self, thread: &ThreadInfo) {
        self.set_policy(thread.policy);
        let mut cores = thread.cores.iter();
        let core = cores.next().filter(|_| cores.next().is_none());
        self.set(word::CORE, core.map_or(0, |core| core as u64 + 1));
        // Written last, and before the others in the file: a reader of the id also reads the thread's other properties. Release: pairs
        // with the Acquire of readers of the file.
        self.words[word::TID].store(u64::from(thread.tid), Ordering::Release);
    }

    /// Marks the words as valid. Call it after everything else was set.
    pub fn set_state(&self, state: u64) {
        // Release: pairs with the Acquire of readers of the file.
        self.words[word::STATE].store(state, Ordering::Release);
    }

    pub fn snapshot(&self) -> CallbackSnapshot {
        let words: Vec<u64> = self.words.iter().map(|word| word.load(Ordering::Acquire)).collect();
        CallbackSnapshot::of_words(&words)
    }
}

/// A snapshot of a callback's statistics.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct CallbackSnapshot {
    /// Its name; only the first 248 bytes of a longer name.
    pub name: String,
    /// Whether this is a whole group: the jobs of all its members together.
    pub is_group: bool,
    /// Whether only its publications are observed, such as those of a ROS timer: each counts as a job that is released when it is sent.
    pub is_by_publications: bool,
    /// Whether its future has ended.
    pub ended: bool,
    /// Its thread's id in the kernel; 0 before it is known: then priority and core are unknown, too, or those that are intended.
    pub tid: u32,
    /// The real-time priority that the kernel confirmed; `None` for time-sharing.
    pub priority: Option<u8>,
    /// The reservation that the kernel confirmed, if it is one. The thread itself may be in a namespace where its id is another's.
    pub reservation: Option<Policy>,
    /// The one core it may run on; `None` if there are several.
    pub core: Option<usize>,
    /// Whether execution times are measured.
    pub measures_execution: bool,
    /// Its period.
    pub period_ns: Option<u64>,
    /// The deadline that misses are counted against.
    pub deadline_ns: Option<u64>,
    /// The budget that overruns are counted against.
    pub budget_ns: Option<u64>,
    /// The response time beyond which a job is recorded among the [`moments`](Self::moments).
    pub bound_ns: Option<u64>,
    /// Whether time taken from its core is recorded among the [`moments`](Self::moments).
    pub accounts_core_time: bool,
    /// Jobs started.
    pub releases: u64,
    /// Jobs finished.
    pub completions: u64,
    /// Jobs that used more processor time than the budget.
    pub overruns: u64,
    /// Jobs that were demoted or suspended: those that used more than an enforced budget, and those that waited for them.
    pub demotions: u64,
    /// Jobs that ended later than the deadline.
    pub deadline_misses: u64,
    /// When the first job was released, in `CLOCK_MONOTONIC` ns.
    pub first_release_ns: u64,
    /// The latest release.
    pub last_release_ns: u64,
    /// The shortest time between two consecutive releases; `None` for fewer than two.
    pub least_distance_ns: Option<u64>,
    /// The longest one.
    pub greatest_distance_ns: Option<u64>,
    /// Messages overwritten before they were taken; for a timer, releases that were not taken.
    pub lost: u64,
    /// Maximum number of messages queued at once.
    pub max_queue: u64,
    /// The depth of its deepest queue; 0 if it has none.
    pub depth: u64,
    /// Times from a job's release to its end.
    pub response: HistogramSnapshot,
    /// CPU times of jobs.
    pub execution: HistogramSnapshot,
    /// Jobs that took longer than the bound, time that they waited or used beyond their budget, and time taken from the callback's core:
    /// the latest 128, the oldest first.
    pub moments: Vec<Moment>,
    /// The number of older moments.
    pub older_moments: u64,
    /// Execution times by the size of the input, in ascending order of sizes: at most 32 classes; none if the callback states no sizes.
    pub inputs: Vec<SizeClass>,
}

impl CallbackSnapshot {
    /// Reads words that another process may have written; accepts any content.
    pub(crate) fn of_words(words: &[u64]) -> CallbackSnapshot {
        let word = |index: usize| words.get(index).copied().unwrap_or(0);
        let some = |value: u64| (value != 0).then_some(value);
        let histogram =
            |at: usize| HistogramSnapshot::of_words(words.get(at..at + HISTOGRAM_WORDS).unwrap_or(&[]));
        let (moments, older_moments) =
            Moments::of_words(words.get(MOMENTS_AT..MOMENTS_AT + MOMENT_WORDS).unwrap_or(&[]));
        CallbackSnapshot {
            name: get_text(words.get(word::NAME..word::NAME + NAME_WORDS).unwrap_or(&[])),
            is_group: word(word::KIND) == kind::GROUP,
            is_by_publications: word(word::KIND) == kind::PUBLICATIONS,
            ended: word(word::STATE) == state::ENDED,
            tid: u32::try_from(word(word::TID)).unwrap_or(0),
            priority: u8::try_from(word(word::PRIORITY)).ok().filter(|priority| *priority != 0),
            reservation: some(word(word::RESERVED))
                .map(|runtime_ns| Policy::Deadline { runtime_ns, period_ns: word(word::RESERVED_PERIOD) }),
            core: some(word(word::CORE)).and_then(|core| usize::try_from(core - 1).ok()),
            measures_execution: word(word::MEASURES_EXECUTION) != 0,
            period_ns: some(word(word::PERIOD)),
            deadline_ns: some(word(word::DEADLINE)),
            budget_ns: some(word(word::BUDGET)),
            bound_ns: some(word(word::BOUND)),
            accounts_core_time: word(word::ACCOUNTS) != 0,
            releases: word(word::RELEASES),
            completions: word(word::COMPLETIONS),
            overruns: word(word::OVERRUNS),
            demotions: word(word::DEMOTIONS),
            deadline_misses: word(word::DEADLINE_MISSES),
            first_release_ns: word(word::FIRST_RELEASE),
            last_release_ns: word(word::LAST_RELEASE),
            least_distance_ns: some(word(word::LEAST_DISTANCE)).map(|distance| distance - 1),
            greatest_distance_ns: some(word(word::GREATEST_DISTANCE)).map(|distance| distance - 1),
            lost: word(word::LOST),
            max_queue: word(word::MAX_QUEUE),
            depth: word(word::DEPTH),
            response: histogram(HEAD_WORDS),
            execution: histogram(HEAD_WORDS + HISTOGRAM_WORDS),
            moments,
            older_moments,
            inputs: Inputs::of_words(words.get(INPUTS_AT..INPUTS_AT + INPUT_WORDS).unwrap_or(&[])),
        }
    }
}

/// Writes a text, or as much of it as fits: its length in bytes, then the bytes.
pub(crate) fn put_text(words: &[AtomicU64], text: &str) {
    let Some((length, rest)) = words.split_first() else { return };
    let mut end = text.len().min(rest.len() * 8);
    while !text.is_char_boundary(end) {
        end -= 1;
    }
    let text = &text[..end];
    for (word, bytes) in rest.iter().zip(text.as_bytes().chunks(8)) {
        let mut whole = [0; 8];
        whole[..bytes.len()].copy_from_slice(bytes);
        word.store(u64::from_le_bytes(whole), Ordering::Relaxed);
    }
    length.store(text.len() as u64, Ordering::Relaxed);
}

/// Reads a text that [`put_text`] wrote; of other words the result is any text.
pub(crate) fn get_text(words: &[u64]) -> String {
    let Some((length, rest)) = words.split_first() else { return String::new() };
    let mut bytes: Vec<u8> = rest.iter().flat_map(|word| word.to_le_bytes()).collect();
    bytes.truncate(usize::try_from(*length).unwrap_or(0));
    String::from_utf8_lossy(&bytes).into_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_are_cut_between_characters() {
        for (text, read) in [("", ""), ("cb", "cb"), ("1234567ä", "1234567"), ("123456ä9", "123456ä")] {
            let words = Words::private(2);
            put_text(&words, text);
            let words: Vec<u64> = words.iter().map(|word| word.load(Ordering::Relaxed)).collect();
            assert_eq!(get_text(&words), read);
        }
        assert_eq!(get_text(&[u64::MAX, u64::MAX]), "\u{fffd}".repeat(8));
        assert_eq!(get_text(&[]), "");
    }

    #[test]
    fn any_words_are_a_snapshot() {
        for words in [vec![], vec![u64::MAX; HEAD_WORDS + 5], vec![u64::MAX; BLOCK_WORDS]] {
            let snapshot = CallbackSnapshot::of_words(&words);
            let _ =
                (snapshot.response.p(0.5), snapshot.execution.mean(), snapshot.response.buckets().count());
        }
    }
}
