// SPDX-License-Identifier: MIT OR Apache-2.0
//! The messages of a whole bag in the order of their reception, whatever order its files have them in.

use crate::reader::{Damage, Event, Extent, FileReader, files_of};
use crate::{BagError, PUBLISHER, Stamp, Topic};
use std::cmp::Reverse;
use std::collections::{BTreeSet, BinaryHeap, HashMap};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// The number of files that stay open; of the others one is open at a time.
const MOST_OPEN: usize = 256;
/// The maximum memory for messages that wait for their turn, because the times of chunks overlap.
const MOST_WAITING: usize = 2 << 30;

/// A message and its topic, an index into [`Ordered::topics`].
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct OwnedMessage {
    /// Which topic.
    pub topic: usize,
    /// Its number and times.
    pub stamp: Stamp,
    /// With the four bytes of encapsulation.
    pub cdr: Vec<u8>,
}

/// Reads a bag. A chunk is read when its first message is due, so what is in memory at once are chunks whose times overlap.
///
/// Damaged parts are skipped; [`damage`](Self::damage) lists them. If a chunk has messages that are earlier than its header states, they
/// come when the chunk is read.
pub struct Ordered {
    files: Vec<PathBuf>,
    /// The extents of all files, the latest first.
    extents: Vec<(usize, Extent)>,
    /// The number of extents that are still to be read.
    left: usize,
    /// The open files. They stay open, because opening a file scans it.
    open: Vec<Option<Open>>,
    topics: Vec<Arc<Topic>>,
    /// By the topic and its publisher.
    numbers: HashMap<(Topic, Option<String>), usize>,
    waiting: BinaryHeap<Waiting>,
    waiting_bytes: usize,
    most_waiting: usize,
    count: u64,
    damage: BTreeSet<(PathBuf, u64, String)>,
    damages: u64,
}

/// Messages by their times, and by the order in which they were read.
type Waiting = Reverse<(u64, u64, OwnedMessage)>;

struct Open {
    reader: FileReader,
    /// The topic of a channel, by its address, which no other topic gets while the `Arc` is here.
    numbers: HashMap<usize, (Arc<Topic>, usize)>,
}

impl Ordered {
    /// Finds where messages are, without reading them; a file without an index is read. `tell` is called with each file before that.
    ///
    /// # Errors
    /// There is no bag; a file cannot be read.
    pub fn open(path: &Path, tell: &mut dyn FnMut(&Path)) -> Result<Self, BagError> {
        let files = files_of(path)?;
        let (extents, topics, numbers) = (Vec::new(), Vec::new(), HashMap::new());
        let mut bag = Ordered {
            files,
            extents,
            left: 0,
            open: Vec::new(),
            topics,
            numbers,
            waiting: BinaryHeap::new(),
            waiting_bytes: 0,
            most_waiting: MOST_WAITING,
            count: 0,
            damage: BTreeSet::new(),
            damages: 0,
        };
        for file in 0..bag.files.len() {
            tell(&bag.files[file]);
            let (reader, extents) = bag.opened(file)?;
            for topic in reader.topics() {
                bag.number(topic);
            }
            bag.extents.extend(extents.into_iter().map(|extent| (file, extent)));
            bag.note(file, &reader);
            bag.damages += reader.damage().1;
            let is_kept = file < MOST_OPEN;
            bag.open.push(is_kept.then(|| Open { reader, numbers: HashMap::new() }));
        }
        // Stable: of two extents that begin at the same time, the one in front is read first.
        bag.extents.reverse();
        bag.extents.sort_by_key(|(_, extent)| Reverse(extent.start_ns));
        bag.left = bag.extents.len();
        Ok(bag)
    }

    /// The bag's topics; a name has one for each definition of a type and each [publisher](crate::PUBLISHER). A damaged file may add topics
    /// while it is read.
    pub fn topics(&self) -> &[Arc<Topic>] {
        &self.topics
    }

    /// The earliest and the latest time of reception that the files state; `None` without messages.
    pub fn span_ns(&self) -> Option<(u64, u64)> {
        let extents = || self.extents.iter().map(|(_, extent)| extent);
        // A chunk without messages has the time 0.
        let is_timed = extents().any(|extent| extent.end_ns > 0);
        let extents = extents().filter(|extent| !is_timed || extent.end_ns > 0);
        let start = extents.clone().map(|extent| extent.start_ns).min();
        start.zip(extents.map(|extent| extent.end_ns).max())
    }

    /// Starts again from the beginning; chunks whose messages are all before `from_ns` are left out.
    pub fn rewind(&mut self, from_ns: u64) {
        self.waiting.clear();
        self.waiting_bytes = 0;
        // Extents are sorted by their beginning, the latest first: those behind the last one that ends late enough are not needed.
        let used = self.extents.iter().rposition(|(_, extent)| extent.end_ns >= from_ns);
        self.left = used.map_or(0, |last| last + 1);
    }

    /// The next message; `None` at the end.
    ///
    /// # Errors
    /// A file cannot be read.
    pub fn next_message(&mut self) -> Result<Option<OwnedMessage>, BagError> {
        while let Some((file, extent)) = self.left.checked_sub(1).map(|last| self.extents[last]) {
            if self.waiting.peek().is_some_and(|Reverse((log_ns, ..))| *log_ns < extent.start_ns) {
                break;
            }
            self.left -= 1;
            self.take_in(file, extent)?;
            self.extents[self.left].1.is_read = true;
        }
        let next = self.waiting.pop().map(|Reverse((.., message))| message);
        self.waiting_bytes -= next.as_ref().map_or(0, memory);
        Ok(next)
    }

    /// The total number of damaged parts found so far, of which [`damage`](Self::damage) lists the first hundred of each file.
    pub fn damages(&self) -> u64 {
        self.damages
    }

    /// The damage found in the part read so far: the file, the position and the fault.
    pub fn damage(&self) -> impl Iterator<Item = (&Path, Damage)> {
        self.damage
            .iter()
            .map(|(path, offset, what)| (&**path, Damage { offset: *offset, what: what.clone() }))
    }

    fn take_in(&mut self, file: usize, extent: Extent) -> Result<(), BagError> {
        let mut open = match self.open[file].take() {
            Some(open) => open,
            None => {
                self.open[MOST_OPEN..].fill_with(|| None);
                Open { reader: self.opened(file)?.0, numbers: HashMap::new() }
            }
        };
        let Open { reader, numbers } = &mut open;
        let before = reader.damage().1;
        let read = reader.read_at(extent.position, extent.whole, &mut |event| {
            if let Event::Message(message) = event {
                let address = Arc::as_ptr(message.topic).addr();
                let known = numbers.get(&address).map(|(_, number)| *number);
                let topic = known.unwrap_or_else(|| {
                    let number = self.number(message.topic);
                    numbers.insert(address, (message.topic.clone(), number));
                    number
                });
                let (stamp, cdr) = (message.stamp, message.cdr.to_vec());
                let message = OwnedMessage { topic, stamp, cdr };
                self.waiting_bytes += memory(&message);
                self.waiting.push(Reverse((stamp.log_ns, self.count, message)));
                self.count += 1;
            }
            if self.waiting_bytes <= self.most_waiting {
                return Ok(());
            }
            let reason = format!(
                "more than {} MB of messages are of overlapping times: `taut bag merge` puts them in order",
                self.most_waiting >> 20
            );
            Err(BagError::Format { path: self.files[file].clone(), reason })
        });
        self.note(file, &open.reader);
        if !extent.is_read {
            self.damages += open.reader.damage().1 - before;
        }
        self.open[file] = Some(open);
        read
    }

    fn opened(&self, file: usize) -> Result<(FileReader, Vec<Extent>), BagError> {
        let mut reader = FileReader::open(&self.files[file])?;
        let extents = reader.extents()?;
        Ok((reader, extents))
    }

    fn number(&mut self, topic: &Arc<Topic>) -> usize {
        let key = (topic.bare(), topic.metadata.get(PUBLISHER).cloned());
        *self.numbers.entry(key).or_insert_with(|| {
            self.topics.push(topic.clone());
            self.topics.len() - 1
        })
    }

    fn note(&mut self, file: usize, reader: &FileReader) {
        for damage in reader.damage().0 {
            self.damage.insert((self.files[file].clone(), damage.offset, damage.what.clone()));
        }
    }
}

/// The memory that a message takes while it waits.
fn memory(message: &OwnedMessage) -> usize {
    message.cdr.len() + size_of::<Waiting>()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Options, Writer};
    use std::collections::BTreeMap;

    #[test]
    fn messages_without_bytes_take_memory() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("bag");
        let mut writer = Writer::create(&path, Options::default(), BTreeMap::new()).unwrap();
        let id = writer.add_topic(Topic { name: "/empty".to_owned(), ..Topic::default() }).unwrap();
        for log_ns in 1..=1000 {
            writer.write(id, Stamp { log_ns, ..Stamp::default() }, &[]).unwrap();
        }
        writer.finish(BTreeMap::new()).unwrap();
        for (most_waiting, is_too_much) in [(1000 * size_of::<Waiting>(), false), (10_000, true)] {
            let mut bag = Ordered::open(&path, &mut |_| {}).unwrap();
            bag.most_waiting = most_waiting;
            assert_eq!(matches!(bag.next_message(), Err(BagError::Format { .. })), is_too_much);
        }
    }
}
