// SPDX-License-Identifier: MIT OR Apache-2.0
//! A process's statistics in a file that other processes read without affecting the writers.

use std::io;
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex, PoisonError};

use tautline_rt::{ForeignWords, Words, WordsFile, page_words};

use super::block::{BLOCK_WORDS, CallbackSnapshot, get_text, kind, put_text, state, word};
use super::histogram::HistogramSnapshot;

const MAGIC: u64 = u64::from_le_bytes(*b"tautstat");
/// The version of the layout here and in `block.rs`.
const VERSION: u64 = 10;
const HEADER_WORDS: usize = 864;

/// Indices of the header's words.
mod header {
    use std::ops::Range;

    pub const MAGIC: usize = 0;
    pub const VERSION: usize = 1;
    pub const PLACES: usize = 3;
    pub const PID: usize = 4;
    pub const REALTIME: usize = 5;
    /// 0: none.
    pub const SAMPLER_PRIORITY: usize = 6;
    pub const SYSTEM_HASH: usize = 7;
    pub const STEAL_TICKS: usize = 8;
    /// 0: not checked; 1: admitted; 2: admitted by force, with the reason.
    pub const ADMITTED: usize = 9;
    // Orders to the process, written by other processes.
    /// A new number for each order; 0: none yet.
    pub const ORDER: usize = 10;
    /// The hash of the system file's text for this order.
    pub const ORDER_HASH: usize = 11;
    /// 1: check whether it can be done; 2: do it.
    pub const ORDER_KIND: usize = 12;
    // The answer of the process.
    /// The number of the answered order.
    pub const ANSWER: usize = 13;
    /// 0: done; 1: refused.
    pub const ANSWER_KIND: usize = 14;
    pub const TAKES_ORDERS: usize = 15;
    pub const PROGRAM: Range<usize> = 16..48;
    pub const HOST: Range<usize> = 48..80;
    pub const SYSTEM_PATH: Range<usize> = 80..640;
    pub const STANDS_IN: Range<usize> = 640..672;
    pub const FORCED: Range<usize> = 672..736;
    pub const ANSWER_TEXT: Range<usize> = 736..864;
}

/// The information that a process shares about itself.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct ProcessInfo {
    /// Its process id.
    pub pid: u32,
    /// The name of its program.
    pub program: String,
    /// Its host in the system file; empty without a system file.
    pub host: String,
    /// Whether its threads have their real-time policies.
    pub realtime: bool,
    /// Priority of its sampler.
    pub sampler_priority: Option<u8>,
    /// The system file that its settings come from; empty if there is none.
    pub system_path: PathBuf,
    /// A hash of that file's content.
    pub system_hash: u64,
    /// `steal` of /proc/stat when it started: processor time that the hypervisor gave to others, in ticks of 10 ms.
    pub steal_ticks: u64,
    /// The node of the system file that it replays from a bag; empty: none.
    pub stands_in: String,
    /// Whether it was checked against the running processes.
    pub admitted: Admitted,
    /// Whether it can adopt a changed text of its system file while it runs; set by
    /// [`StatisticsFile::orders`].
    pub takes_orders: bool,
}

/// Whether a process's load was checked against that of other processes when it started.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub enum Admitted {
    /// It was not checked.
    #[default]
    Unchecked,
    /// All deadlines are met with it.
    Checked,
    /// It started although some deadlines are not met: the first of them. A text longer than 504 bytes is
    /// truncated.
    Forced(String),
}

/// A file in /dev/shm in which an executor keeps the statistics of its callbacks: see
/// [`Executor::with_statistics`](crate::Executor::with_statistics). It is locked as long as this object exists, and then
/// removed.
///
/// Callbacks write into it like into any memory; readers map it read-only and wake no thread.
#[derive(Debug)]
pub struct StatisticsFile {
    places: Arc<Places>,
}

#[derive(Debug)]
struct Places {
    file: WordsFile,
    header: Words,
    /// Released entries.
    free: Mutex<Vec<usize>>,
}

/// A callback's entry in the file; dropping it releases the entry.
#[derive(Debug)]
pub(crate) struct StatsSlot {
    index: usize,
    places: Arc<Places>,
}

impl ProcessInfo {
    /// Information about this process, without a system file.
    pub fn of_this() -> ProcessInfo {
        let program = std::env::current_exe().ok();
        let program = program.as_deref().and_then(Path::file_name).unwrap_or_default();
        ProcessInfo {
            pid: std::process::id(),
            program: program.to_string_lossy().into_owned(),
            steal_ticks: tautline_rt::host::steal_ticks(None),
            ..ProcessInfo::default()
        }
    }
}

impl StatisticsFile {
    /// Creates a file whose name begins with `prefix`, and removes such files of killed processes.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// The system's error, with the path.
    pub fn create(prefix: &str, about: &ProcessInfo) -> io::Result<StatisticsFile> {
        for left in ForeignStatistics::list(prefix)? {
            left.remove_if_orphaned();
        }
        let file = WordsFile::create(prefix)?;
        let header = file.map(0, HEADER_WORDS)?;
        let number = |index: usize, value: u64| header[index].store(value, Ordering::Relaxed);
        number(header::VERSION, VERSION);
        number(header::PID, about.pid.into());
        number(header::REALTIME, about.realtime.into());
        number(header::SAMPLER_PRIORITY, about.sampler_priority.map_or(0, u64::from));
        number(header::SYSTEM_HASH, about.system_hash);
        number(header::STEAL_TICKS, about.steal_ticks);
        put_text(&header[header::PROGRAM], &about.program);
        put_text(&header[header::HOST], &about.host);
        put_text(&header[header::STANDS_IN], &about.stands_in);
        put_text(&header[header::SYSTEM_PATH], &about.system_path.to_string_lossy());
        put_admitted(&header, &about.admitted);
        // Release: pairs with the Acquire in `ForeignWords::read`; all other words are visible when the magic is.
        header[header::MAGIC].store(MAGIC, Ordering::Release);
        Ok(StatisticsFile { places: Arc::new(Places { file, header, free: Mutex::default() }) })
    }

    /// The prefix of the names of a domain's files.
    pub fn prefix(domain: u32) -> String {
        format!("{}/stats_", tautline_rt::domain::shared_folder(domain))
    }

    /// Its path.
    pub fn path(&self) -> &Path {
        self.places.file.path()
    }

    /// Records the result of the admission of the process's load.
    ///
    /// # Real-time
    /// Setup only.
    pub fn set_admitted(&self, admitted: &Admitted) {
        put_admitted(&self.places.header, admitted);
    }

    /// The orders of other processes to this process; it accepts them from now on.
    pub fn orders(&self) -> Orders {
        self.places.header[header::TAKES_ORDERS].store(1, Ordering::Relaxed);
        Orders { places: Arc::clone(&self.places) }
    }

    /// A place for the statistics of one more callback: all zeros.
    pub(super) fn claim(&self) -> io::Result<(Words, StatsSlot)> {
        let places = &self.places;
        let mut free = places.free.lock().unwrap_or_else(PoisonError::into_inner);
        let count = &places.header[header::PLACES];
        let next = count.load(Ordering::Relaxed);
        let index = free.last().copied().unwrap_or(next as usize);
        let words = places.file.map(place(index, page_words()), BLOCK_WORDS)?;
        match free.pop() {
            // The former callback's values are still there.
            Some(_) => words.iter().for_each(|word| word.store(0, Ordering::Relaxed)),
            // Release: pairs with the Acquire in `ForeignWords::read`; the file has grown by then.
            None => count.store(next + 1, Ordering::Release),
        }
        Ok((words, StatsSlot { index, places: Arc::clone(places) }))
    }
}

/// Orders from other processes, through this process's statistics file: to adopt the present text of its
/// system file.
#[derive(Debug)]
pub struct Orders {
    places: Arc<Places>,
}

/// One order.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Order {
    number: u64,
    /// The hash of the requested text.
    pub system_hash: u64,
    /// Whether to apply it, not only to check it.
    pub is_final: bool,
}

impl Orders {
    /// The unanswered order, if there is one. Its content is untrusted.
    pub fn next(&self) -> Option<Order> {
        let header = &self.places.header;
        // Acquire: pairs with the order in which `ForeignStatistics::order` writes, the number last.
        let number = header[header::ORDER].load(Ordering::Acquire);
        let system_hash = header[header::ORDER_HASH].load(Ordering::Relaxed);
        let is_final = header[header::ORDER_KIND].load(Ordering::Relaxed) == 2;
        let is_new = number != 0 && number != header[header::ANSWER].load(Ordering::Relaxed);
        is_new.then_some(Order { number, system_hash, is_final })
    }

    /// Answers the order: with the reason why it cannot be done, or with success.
    pub fn answer(&self, order: &Order, answer: Result<(), String>) {
        let header = &self.places.header;
        let set = |index: usize, value: u64| header[index].store(value, Ordering::Relaxed);
        set(header::ANSWER_KIND, u64::from(answer.is_err()));
        put_text(&header[header::ANSWER_TEXT], answer.as_ref().err().map_or("", String::as_str));
        if answer.is_ok() && order.is_final {
            set(header::SYSTEM_HASH, order.system_hash);
        }
        // Release: pairs with the Acquire in `ForeignWords::read`.
        header[header::ANSWER].store(order.number, Ordering::Release);
    }
}

impl Drop for StatisticsFile {
    /// Removes the file; existing mappings keep the statistics.
    fn drop(&mut self) {
        self.places.file.retire();
    }
}

fn put_admitted(header: &Words, admitted: &Admitted) {
    let number = match admitted {
        Admitted::Unchecked => 0,
        Admitted::Checked => 1,
        Admitted::Forced(why) => {
            put_text(&header[header::FORCED], why);
            2
        }
    };
    // Release: pairs with the Acquire in `ForeignWords::read`; the text is visible when the number is.
    header[header::ADMITTED].store(number, Ordering::Release);
}

/// Where place `index` begins, in words.
fn place(index: usize, page_words: usize) -> usize {
    HEADER_WORDS.next_multiple_of(page_words) + index * BLOCK_WORDS.next_multiple_of(page_words)
}

impl Drop for StatsSlot {
    /// Releases the place. The callback's statistics can be read until another callback claims it.
    fn drop(&mut self) {
        self.places.free.lock().unwrap_or_else(PoisonError::into_inner).push(self.index);
    }
}

/// The statistics of this or another process.
#[derive(Debug)]
pub struct ForeignStatistics {
    file: ForeignWords,
}

/// A snapshot of the statistics of a process's callbacks.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct ProcessSnapshot {
    /// The process.
    pub process: ProcessInfo,
    /// Its callbacks, in no particular order.
    pub callbacks: Vec<CallbackSnapshot>,
    /// The statistics of its sampler's thread, if core time is accounted for: no jobs, only moments.
    pub sampler: Option<CallbackSnapshot>,
    /// Executors of other libraries whose overheads are measured.
    pub executors: Vec<ExecutorSnapshot>,
}

/// A snapshot of a [`ForeignExecutor`](crate::ForeignExecutor).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ExecutorSnapshot {
    /// The library's name.
    pub name: String,
    /// Whether its callbacks do nothing, so that everything is overhead.
    pub is_alone: bool,
    /// Processor time that it used for each callback.
    pub overhead: HistogramSnapshot,
    /// Processor time of the callbacks, as far as it is separate from the overhead.
    pub callbacks: HistogramSnapshot,
}

impl ForeignStatistics {
    /// The files of all processes whose names begin with `prefix`.
    ///
    /// # Errors
    /// If /dev/shm cannot be read.
    pub fn list(prefix: &str) -> io::Result<Vec<ForeignStatistics>> {
        Ok(ForeignWords::list(prefix)?.into_iter().map(|file| ForeignStatistics { file }).collect())
    }

    /// The file's path; it may have been removed.
    pub fn path(&self) -> &Path {
        self.file.path()
    }

    /// Whether the process is alive.
    pub fn is_running(&self) -> bool {
        self.file.is_owned()
    }

    /// Orders the process to adopt the present text of its system file, which has this hash, or only to check whether it could. The
    /// process reads the order when its participant is called (`tautline_transport::call_all`). `number` identifies the order, for
    /// example the time; never 0.
    ///
    /// # Errors
    /// The system's error, with the path.
    pub fn order(&self, number: u64, system_hash: u64, is_final: bool) -> io::Result<()> {
        use std::os::unix::fs::FileExt;
        let failed =
            |error: io::Error| io::Error::new(error.kind(), format!("{}: {error}", self.path().display()));
        let file = std::fs::OpenOptions::new().write(true).open(self.path()).map_err(failed)?;
        let kind = if is_final { 2 } else { 1 };
        let words = [(header::ORDER_HASH, system_hash), (header::ORDER_KIND, kind), (header::ORDER, number)];
        words
            .into_iter()
            .try_for_each(|(index, word)| file.write_all_at(&word.to_ne_bytes(), index as u64 * 8))
            .map_err(failed)
    }

    /// The process's answer to the order with this number; `None`: none yet.
    ///
    /// # Errors
    /// The system's error, with the path.
    pub fn answer(&self, number: u64) -> io::Result<Option<Result<(), String>>> {
        let words = self.file.read(0, HEADER_WORDS)?;
        if words[header::ANSWER] != number {
            return Ok(None);
        }
        // Read again after the number, so that the text is visible.
        let words = self.file.read(0, HEADER_WORDS)?;
        Ok(Some(match words[header::ANSWER_KIND] {
            0 => Ok(()),
            _ => Err(get_text(&words[header::ANSWER_TEXT])),
        }))
    }

    /// Removes the file if its process was killed; returns whether it did.
    pub fn remove_if_orphaned(&self) -> bool {
        self.file.remove_if_orphaned()
    }

    /// The statistics of the process's callbacks so far; if it has ended, the final ones. `None`: the process is still
    /// starting.
    ///
    /// # Errors
    /// The system's error, with the path; an error for a file of another version of Tautline.
    pub fn read(&self) -> io::Result<Option<ProcessSnapshot>> {
        if self.file.size_words()? < HEADER_WORDS {
            return Ok(None);
        }
        let words = self.file.read(0, HEADER_WORDS)?;
        if words[header::MAGIC] == 0 {
            return Ok(None);
        }
        if words[header::MAGIC] != MAGIC || words[header::VERSION] != VERSION {
            let error = format!(
                "{} has statistics of another version of Tautline: use the same one in all processes of a domain",
                self.path().display()
            );
            return Err(io::Error::other(error));
        }
        let process = ProcessInfo {
            pid: u32::try_from(words[header::PID]).unwrap_or(0),
            program: get_text(&words[header::PROGRAM]),
            host: get_text(&words[header::HOST]),
            realtime: words[header::REALTIME] != 0,
            sampler_priority: u8::try_from(words[header::SAMPLER_PRIORITY]).ok().filter(|p| *p != 0),
            system_path: PathBuf::from(get_text(&words[header::SYSTEM_PATH])),
            system_hash: words[header::SYSTEM_HASH],
            steal_ticks: words[header::STEAL_TICKS],
            stands_in: get_text(&words[header::STANDS_IN]),
            takes_orders: words[header::TAKES_ORDERS] != 0,
            admitted: match words[header::ADMITTED] {
                0 => Admitted::Unchecked,
                1 => Admitted::Checked,
                _ => Admitted::Forced(get_text(&words[header::FORCED])),
            },
        };
        // At most as many as fit into the file, whatever number it states.
        let size_words = self.file.size_words()?;
        let page_words = page_words();
        let there = (0..words[header::PLACES])
            .map(|index| place(index as usize, page_words))
            .take_while(|at| at.checked_add(BLOCK_WORDS).is_some_and(|end| end <= size_words));
        let (mut callbacks, mut sampler, mut executors) = (Vec::new(), None, Vec::new());
        for at in there {
            let words = self.file.read(at, BLOCK_WORDS)?;
            if ![state::RUNNING, state::ENDED].contains(&words[word::STATE]) {
                continue;
            }
            let snapshot = CallbackSnapshot::of_words(&words);
            match words[word::KIND] {
                kind::SAMPLER => sampler = Some(snapshot),
                kind @ (kind::EXECUTOR | kind::EXECUTOR_ALONE) => executors.push(ExecutorSnapshot {
                    name: snapshot.name,
                    is_alone: kind == kind::EXECUTOR_ALONE,
                    overhead: snapshot.execution,
                    callbacks: snapshot.response,
                }),
                _ => callbacks.push(snapshot),
            }
        }
        Ok(Some(ProcessSnapshot { process, callbacks, sampler, executors }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::CallbackStats;

    fn prefix(name: &str) -> String {
        format!("taut_executor_test_{}_{name}_", std::process::id())
    }

    fn about() -> ProcessInfo {
        ProcessInfo {
            pid: 7,
            program: "robot".into(),
            host: "left".into(),
            realtime: true,
            sampler_priority: Some(90),
            system_path: "/etc/system.toml".into(),
            system_hash: 42,
            steal_ticks: 3,
            stands_in: "camera".into(),
            admitted: Admitted::Forced("callback `scan` would be late".into()),
            takes_orders: false,
        }
    }

    fn names(prefix: &str) -> Vec<String> {
        let found = ForeignStatistics::list(prefix).unwrap();
        let [file] = found.as_slice() else { panic!("{found:?}") };
        let snapshot = file.read().unwrap().unwrap();
        assert_eq!(snapshot.process, about());
        snapshot.callbacks.into_iter().map(|callback| callback.name).collect()
    }

    #[test]
    fn places_are_claimed_read_given_back_and_used_again() {
        let prefix = prefix("places");
        let file = StatisticsFile::create(&prefix, &about()).unwrap();
        assert!(names(&prefix).is_empty());
        let new = |name: &str| {
            let stats = CallbackStats::new(name);
            stats.place(Some(&file), kind::CALLBACK).unwrap();
            stats
        };
        let (a, b) = (new("a"), new("b"));
        a.release(1);
        assert_eq!(names(&prefix), ["a", "b"]);
        drop(a);
        assert_eq!(names(&prefix), ["a", "b"], "until the place is another's");
        let c = new("c");
        assert_eq!(names(&prefix), ["c", "b"]);
        assert_eq!((b.releases(), c.releases()), (0, 0), "nothing of `a` is left");

        // The file goes before the last that writes to it.
        let found = ForeignStatistics::list(&prefix).unwrap();
        assert!(found[0].is_running() && !found[0].remove_if_orphaned());
        drop(file);
        b.release(1);
        assert!(!found[0].is_running() && ForeignStatistics::list(&prefix).unwrap().is_empty());
        assert_eq!(found[0].read().unwrap().unwrap().callbacks[1].releases, 1);
    }

    #[test]
    fn an_order_is_answered_once() {
        let prefix = prefix("orders");
        let file = StatisticsFile::create(&prefix, &about()).unwrap();
        let found = &ForeignStatistics::list(&prefix).unwrap()[0];
        assert!(!found.read().unwrap().unwrap().process.takes_orders);
        let orders = file.orders();
        assert!(found.read().unwrap().unwrap().process.takes_orders && orders.next().is_none());
        let hash = || found.read().unwrap().unwrap().process.system_hash;
        for (number, is_final, answer) in
            [(5, false, Ok(())), (6, true, Err("a core".to_owned())), (9, true, Ok(()))]
        {
            found.order(number, 77, is_final).unwrap();
            let order = orders.next().unwrap();
            assert_eq!(order, Order { number, system_hash: 77, is_final });
            assert_eq!(found.answer(number).unwrap(), None);
            assert_eq!(hash(), 42, "what it has until it has done it");
            orders.answer(&order, answer.clone());
            assert_eq!((found.answer(number).unwrap(), orders.next()), (Some(answer), None));
        }
        assert_eq!(hash(), 77);
    }

    #[test]
    fn files_that_are_no_statistics_are_refused() {
        let prefix = prefix("bad");
        let file = WordsFile::create(&prefix).unwrap();
        let read = || ForeignStatistics::list(&prefix).unwrap()[0].read();
        assert!(read().unwrap().is_none(), "not even a header yet");
        let words = file.map(0, HEADER_WORDS).unwrap();
        assert!(read().unwrap().is_none(), "not complete yet");
        words[header::MAGIC].store(1, Ordering::Relaxed);
        assert!(read().unwrap_err().to_string().contains("of another version of Tautline"));
        words[header::MAGIC].store(MAGIC, Ordering::Relaxed);
        words[header::VERSION].store(VERSION, Ordering::Relaxed);
        words[header::PLACES].store(u64::MAX, Ordering::Relaxed);
        assert!(read().unwrap().unwrap().callbacks.is_empty(), "more places than the file holds");
        let place = file.map(place(0, page_words()), BLOCK_WORDS).unwrap();
        place.iter().for_each(|word| word.store(u64::MAX, Ordering::Relaxed));
        place[word::STATE].store(state::RUNNING, Ordering::Relaxed);
        let callbacks = read().unwrap().unwrap().callbacks;
        assert_eq!((callbacks.len(), callbacks[0].inputs.len()), (1, 32), "any words are a callback");
        words[header::VERSION].store(VERSION - 1, Ordering::Relaxed);
        assert!(read().unwrap_err().to_string().contains("of another version of Tautline"));
    }
}
