// SPDX-License-Identifier: MIT OR Apache-2.0
//! A file of text in /dev/shm that its owner replaces as a whole while others read it.
//!
//! The first words say which of two texts is valid. The owner writes the other one and then says so; the valid one stays
//! untouched until the next change but one. So a reader gets a whole text even if the owner was stopped or killed while
//! it wrote, and begins anew only if the owner made two changes while it read.
//!
//! | word | holds |
//! |---|---|
//! | 0 | [`MAGIC`] |
//! | 1 | the generation: how many texts were written; the valid one is at the slot of its lowest bit |
//! | 2, 3 | slot 0: where it begins, in words, and how long its text is, in bytes |
//! | 4, 5 | slot 1 |

use std::io;
use std::sync::atomic::{Ordering, fence};
use tautline_rt::{ForeignMap, ForeignWords, Words, WordsFile, page_words};

const MAGIC: u64 = u64::from_le_bytes(*b"tautnod1");
const HEAD_WORDS: usize = 6;
const GENERATION: usize = 1;
/// Longest text that is written and read: the graph of a gateway whose peers declare all they may, with the longest names.
const MAX_BYTES: usize = 32 << 20;
/// A reader that is disturbed so often gives up until the next change. It takes two changes during the microseconds of one
/// look to disturb it.
const ATTEMPTS: usize = 10_000;

/// The owner's side. The file is removed at its end.
pub(super) struct TextFile {
    head: Words,
    slots: [Option<Slot>; 2],
    /// Where the next slot can begin.
    end_words: usize,
    generation: u64,
    file: WordsFile,
}

struct Slot {
    at_words: usize,
    words: Words,
}

impl TextFile {
    pub(super) fn create(prefix: &str) -> io::Result<Self> {
        let file = WordsFile::create(prefix)?;
        let head = file.map(0, HEAD_WORDS)?;
        head[0].store(MAGIC, Ordering::Relaxed);
        Ok(TextFile { head, slots: [None, None], end_words: page_words(), generation: 0, file })
    }

    /// Replaces the text. If it fails the former one stays.
    pub(super) fn write(&mut self, text: &[u8]) -> io::Result<()> {
        if text.len() > MAX_BYTES {
            let path = self.file.path().display();
            return Err(io::Error::other(format!("{path}: {} bytes, the limit is {MAX_BYTES}", text.len())));
        }
        let next = self.generation + 1;
        let index = (next & 1) as usize;
        let needed = text.len().div_ceil(8);
        if self.slots[index].as_ref().is_none_or(|slot| slot.words.len() < needed) {
            // Doubled at least, so that what former slots leave unused is less than what is used.
            let len = needed.next_power_of_two().max(page_words());
            let slot = Slot { at_words: self.end_words, words: self.file.map(self.end_words, len)? };
            self.end_words += len;
            self.slots[index] = Some(slot);
        }
        let Some(slot) = &self.slots[index] else { return Ok(()) };
        // Pairs with the reader's Acquire loads: who reads a word written below, of the text before the last, also reads
        // the last generation, at least, and begins anew.
        fence(Ordering::Release);
        self.head[2 + 2 * index].store(slot.at_words as u64, Ordering::Relaxed);
        self.head[3 + 2 * index].store(text.len() as u64, Ordering::Relaxed);
        for (word, bytes) in slot.words.iter().zip(text.chunks(8)) {
            let mut padded = [0; 8];
            padded[..bytes.len()].copy_from_slice(bytes);
            word.store(u64::from_le_bytes(padded), Ordering::Relaxed);
        }
        // Release: pairs with the reader's Acquire of the generation; who reads it reads this text.
        self.head[GENERATION].store(next, Ordering::Release);
        self.generation = next;
        Ok(())
    }
}

/// The valid text of another process's file; `None` if it is none, or changes too fast.
pub(super) fn read(file: &ForeignWords) -> Option<Vec<u8>> {
    let mut map = file.map(0, file.size_words().ok()?).ok()?;
    for _ in 0..ATTEMPTS {
        if map.load(0)? != MAGIC {
            return None;
        }
        // The generation before what it says is valid.
        let generation = map.load(GENERATION)?;
        let slot = 2 + 2 * (generation & 1) as usize;
        let (at, len) = (map.load(slot)?, map.load(slot + 1)?);
        let text = read_text(&map, at, len);
        if map.load(GENERATION)? != generation {
            continue;
        }
        let size_words = file.size_words().ok()?;
        if text.is_none() && size_words > map.len() {
            // It grew for this text.
            map = file.map(0, size_words).ok()?;
            continue;
        }
        return text.filter(|_| generation != 0);
    }
    None
}

/// What is said of where it lies is a claim; what lies beyond the end of the file is no text.
fn read_text(map: &ForeignMap, at_words: u64, len_bytes: u64) -> Option<Vec<u8>> {
    let (at, len) = (usize::try_from(at_words).ok()?, usize::try_from(len_bytes).ok()?);
    let end = at.checked_add(len.div_ceil(8)).filter(|end| *end <= map.len())?;
    if len == 0 || len > MAX_BYTES {
        return None;
    }
    let words = (at..end).map_while(|index| map.load(index));
    let mut bytes: Vec<u8> = words.flat_map(u64::to_le_bytes).collect();
    bytes.truncate(len);
    Some(bytes)
}

#[cfg(all(test, not(taut_loom)))]
mod tests {
    use super::*;
    use std::sync::atomic::AtomicBool;

    fn prefix(name: &str) -> String {
        format!("taut_nodes_test_{}_{name}_", std::process::id())
    }

    fn foreign(prefix: &str) -> ForeignWords {
        ForeignWords::list(prefix).unwrap().pop().unwrap()
    }

    #[test]
    fn the_last_text_is_read_whatever_its_length() {
        let prefix = prefix("length");
        let mut file = TextFile::create(&prefix).unwrap();
        let peer = foreign(&prefix);
        assert_eq!(read(&peer), None);
        for len in [1, 8, 9, 5000, 3, 100_000, 40_000, 7] {
            let text: Vec<u8> = (0..len).map(|n| n as u8).collect();
            file.write(&text).unwrap();
            assert_eq!(read(&peer).unwrap(), text);
        }
        assert!(file.write(&vec![0; MAX_BYTES + 1]).is_err());
        assert_eq!(read(&peer).unwrap().len(), 7);
        drop(file);
        assert!(!peer.is_owned() && !peer.path().exists());
    }

    /// A text is one letter, as often as it says itself: one that is mixed of two is found.
    #[test]
    fn no_text_is_torn_while_it_is_written() {
        const TEXTS: u32 = 20_000;
        let prefix = prefix("torn");
        let mut file = TextFile::create(&prefix).unwrap();
        let text = |n: u32| vec![n as u8; 1 + (n as usize * 37) % 9000];
        file.write(&text(0)).unwrap();
        let (ended, first_read) = (AtomicBool::new(false), AtomicBool::new(false));
        let reads = std::thread::scope(|scope| {
            let reader = scope.spawn(|| {
                let peer = foreign(&prefix);
                let mut reads = 0;
                while !ended.load(Ordering::Acquire) || reads == 0 {
                    if let Some(read) = read(&peer) {
                        let whole = |n: u32| read.len() == 1 + (n as usize * 37) % 9000;
                        assert!(read.iter().all(|byte| *byte == read[0]), "torn");
                        assert!(
                            (0..TEXTS).filter(|n| *n as u8 == read[0]).any(whole),
                            "{} bytes",
                            read.len()
                        );
                        reads += 1;
                    }
                    first_read.store(true, Ordering::Release);
                }
                reads
            });
            while !first_read.load(Ordering::Acquire) {
                std::thread::yield_now();
            }
            (1..TEXTS).for_each(|n| file.write(&text(n)).unwrap());
            ended.store(true, Ordering::Release);
            reader.join().unwrap()
        });
        println!("{reads} whole texts were read during {TEXTS} changes");
        assert!(reads > 1);
    }

    #[test]
    fn a_writer_that_was_stopped_half_way_left_the_former_text() {
        let prefix = prefix("half");
        let mut file = TextFile::create(&prefix).unwrap();
        file.write(b"first").unwrap();
        file.write(b"second").unwrap();
        // What a third write does before it says that it is done.
        let slot = file.slots[1].as_ref().unwrap();
        slot.words[0].store(u64::MAX, Ordering::Relaxed);
        file.head[5].store(u64::MAX, Ordering::Relaxed);
        assert_eq!(read(&foreign(&prefix)).unwrap(), b"second");
    }

    #[test]
    fn lies_are_no_text() {
        let prefix = prefix("lies");
        let mut file = TextFile::create(&prefix).unwrap();
        file.write(b"text").unwrap();
        let peer = foreign(&prefix);
        for (word, lie) in [
            (0, 1),
            (GENERATION, 0),
            (4, u64::MAX),
            (4, 1 << 40),
            (5, 0),
            (5, u64::MAX),
            (5, MAX_BYTES as u64),
            (5, MAX_BYTES as u64 + 1),
        ] {
            let truth = file.head[word].swap(lie, Ordering::Relaxed);
            assert_eq!(read(&peer), None, "word {word} = {lie}");
            file.head[word].store(truth, Ordering::Relaxed);
        }
        assert_eq!(read(&peer).unwrap(), b"text");
    }
}
