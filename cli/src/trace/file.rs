// SPDX-License-Identifier: MIT OR Apache-2.0
//! The recording's file: a magic word, then blocks of kind, length and content. Events are binary, all else is JSON.
//!
//! A recorder only appends to it, so that the file of a killed recorder can be read.

use super::recording::{Entry, Recording, TimedEvent};
use crate::verb::{Failure, Outcome};
use std::io::{self, Write};
use std::path::Path;
use tautline_trace::{Description, Event, ObjectId, ObjectKind, Record};

const MAGIC: &[u8; 8] = b"tauttr01";
const JSON: u32 = 1;
const EVENTS: u32 = 2;
/// The maximum length of a block; a greater length means a damaged file.
const MAX_BLOCK_BYTES: u32 = 1 << 28;
const EVENT_BYTES: usize = 40;

/// Appends to a recording.
pub struct Writer<W> {
    to: W,
}

impl<W: Write> Writer<W> {
    pub fn new(mut to: W) -> io::Result<Self> {
        to.write_all(MAGIC)?;
        Ok(Writer { to })
    }

    pub fn flush(&mut self) -> io::Result<()> {
        self.to.flush()
    }

    pub fn entry(&mut self, entry: &Entry) -> io::Result<()> {
        self.block(JSON, &serde_json::to_vec(entry)?)
    }

    pub fn record(&mut self, record: &Record<'_>) -> io::Result<()> {
        match *record {
            Record::Events { process, tid, events } => self.events(process, tid, events),
            _ => Entry::of(record).map_or(Ok(()), |entry| self.entry(&entry)),
        }
    }

    pub fn events(&mut self, process: u32, tid: u32, events: &[Event]) -> io::Result<()> {
        let mut content = Vec::with_capacity(8 + EVENT_BYTES * events.len());
        content.extend(process.to_le_bytes());
        content.extend(tid.to_le_bytes());
        content.extend(events.iter().flat_map(|event| event.words()).flat_map(u64::to_le_bytes));
        self.block(EVENTS, &content)
    }

    fn block(&mut self, kind: u32, content: &[u8]) -> io::Result<()> {
        let length = u32::try_from(content.len()).ok().filter(|length| *length <= MAX_BLOCK_BYTES);
        let length = length.ok_or_else(|| io::Error::other("a block of more than 256 MiB"))?;
        self.to.write_all(&kind.to_le_bytes())?;
        self.to.write_all(&length.to_le_bytes())?;
        self.to.write_all(content)
    }
}

/// Reads a recording. Unknown content is an error; an end in the middle of a block is a warning.
pub fn read(path: &Path) -> Outcome<Recording> {
    let bytes = std::fs::read(path).map_err(|error| Failure::unreadable(path, &error))?;
    parse(&bytes).map_err(|reason| {
        let path = path.display();
        Failure::unusable(format!("`{path}` is not a recording: {reason}; `taut trace record` makes them"))
    })
}

/// As [`read`], from memory.
pub fn parse(bytes: &[u8]) -> Result<Recording, String> {
    let mut rest = bytes.strip_prefix(MAGIC).ok_or_else(|| match bytes.starts_with(&MAGIC[..6]) {
        true => "it is of another version of Tautline: export it with the version that recorded it",
        false => "it does not begin as one",
    })?;
    let mut recording = Recording::default();
    let mut finished = false;
    while !rest.is_empty() {
        let at = bytes.len() - rest.len();
        let Some((kind, content, behind)) =
            split_block(rest).map_err(|what| format!("{what} at byte {at}"))?
        else {
            recording
                .warnings
                .push(format!("the recording breaks off at byte {at}: was its recorder killed?"));
            finished = true;
            break;
        };
        rest = behind;
        match kind {
            JSON => {
                let entry: Entry =
                    serde_json::from_slice(content).map_err(|error| format!("at byte {at}: {error}"))?;
                finished |= matches!(entry, Entry::Finished { .. });
                add(&mut recording, entry);
            }
            EVENTS => add_events(&mut recording, content).ok_or_else(|| format!("no events at byte {at}"))?,
            _ => return Err(format!("a block of the unknown kind {kind} at byte {at}")),
        }
    }
    if !finished {
        recording.warnings.push("the recording has no end: was its recorder killed?".to_owned());
    }
    recording.finish();
    Ok(recording)
}

/// The first block and the remaining bytes; `None` if the block is truncated.
#[allow(clippy::type_complexity, reason = "kind, content, rest")]
fn split_block(bytes: &[u8]) -> Result<Option<(u32, &[u8], &[u8])>, &'static str> {
    let Some((head, rest)) = bytes.split_at_checked(8) else { return Ok(None) };
    let word = |at: usize| head.get(at..at + 4).and_then(|word| word.try_into().ok()).map(u32::from_le_bytes);
    let (Some(kind), Some(length)) = (word(0), word(4)) else { return Ok(None) };
    if length > MAX_BLOCK_BYTES {
        return Err("a block of impossible length");
    }
    Ok(rest.split_at_checked(length as usize).map(|(content, behind)| (kind, content, behind)))
}

fn add(recording: &mut Recording, entry: Entry) {
    match entry {
        Entry::Session { .. } => recording.session = Some(entry),
        Entry::Process { process, pid, name } => {
            let of = recording.process(process);
            (of.pid, of.name) = (pid, name);
        }
        Entry::Object { process, id, kind, parent, detail, gid, created_ns, name } => {
            // The object is of a later version; its events have no name.
            let Some(kind) = ObjectKind::from_name(&kind) else { return };
            let (id, parent) = (ObjectId(id), ObjectId(parent));
            let object = Description { id, kind, parent, detail, gid, created_ns, name };
            recording.process(process).objects.insert(id, object);
        }
        Entry::Thread { process, tid, name } => {
            recording.process(process).threads.insert(tid, name);
        }
        Entry::Lost { process, tid, events } => {
            increase(recording.process(process).lost.entry(tid).or_default(), events);
        }
        Entry::Unrecorded { process, events } => increase(&mut recording.process(process).unrecorded, events),
        Entry::Undescribed { process, objects } => {
            increase(&mut recording.process(process).undescribed, objects)
        }
        Entry::Ended { process } => recording.process(process).has_ended = true,
        Entry::Finished { .. } => {}
    }
}

/// Adds without overflow, because numbers in a file are untrusted.
fn increase(count: &mut u64, by: u64) {
    *count = count.saturating_add(by);
}

fn add_events(recording: &mut Recording, content: &[u8]) -> Option<()> {
    let (head, events) = content.split_at_checked(8)?;
    let process = u32::from_le_bytes(head.get(..4)?.try_into().ok()?);
    let tid = u32::from_le_bytes(head.get(4..)?.try_into().ok()?);
    let (events, rest) = events.as_chunks::<EVENT_BYTES>();
    if !rest.is_empty() {
        return None;
    }
    for bytes in events {
        let (words, _) = bytes.as_chunks::<8>();
        let words: Vec<u64> = words.iter().map(|word| u64::from_le_bytes(*word)).collect();
        let event = Event::from_words(words.try_into().ok()?)?;
        recording.events.push(TimedEvent { process, tid, event });
    }
    Some(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use tautline_trace::EventKind;

    fn sample() -> Vec<u8> {
        let mut writer = Writer::new(Vec::new()).unwrap();
        writer.record(&Record::Process { process: 0, pid: 12, name: "talker" }).unwrap();
        writer.record(&Record::Thread { process: 0, tid: 13, name: "main" }).unwrap();
        let event = Event { time_ns: 5, kind: EventKind::Publish, object: ObjectId(1), arguments: [1, 2, 3] };
        writer.record(&Record::Events { process: 0, tid: 13, events: &[event, event] }).unwrap();
        writer.record(&Record::Lost { process: 0, tid: 13, events: 4 }).unwrap();
        writer.entry(&Entry::Finished { monotonic_ns: 9 }).unwrap();
        writer.to
    }

    #[test]
    fn what_is_written_is_read() {
        let recording = parse(&sample()).unwrap();
        assert!(matches!(&recording.warnings[..], [lost] if lost.starts_with("4 events were overwritten")));
        assert_eq!(recording.events.len(), 2);
        assert_eq!(recording.events[1].event.arguments, [1, 2, 3]);
        assert_eq!(
            (recording.processes[&0].pid, recording.processes[&0].threads[&13].as_str()),
            (12, "main")
        );
        assert_eq!(recording.events_lost(), 4);
    }

    #[test]
    fn a_file_that_breaks_off_anywhere_is_read_up_to_there() {
        let whole = sample();
        for end in 8..whole.len() {
            let recording = parse(&whole[..end]).unwrap();
            let broken = recording.warnings.iter().filter(|warning| warning.contains("recorder killed"));
            assert_eq!(broken.count(), 1, "{end}: {:?}", recording.warnings);
        }
        assert!(parse(&whole[..7]).is_err());
        let other = [b"tauttr99", &whole[8..]].concat();
        assert!(parse(&other).unwrap_err().contains("of another version of Tautline"));
    }

    #[test]
    fn damage_is_an_error_or_a_smaller_recording_never_a_panic() {
        let whole = sample();
        for at in 0..whole.len() {
            for bit in 0..8 {
                let mut bytes = whole.clone();
                bytes[at] ^= 1 << bit;
                let _ = parse(&bytes);
            }
        }
    }
}
