// SPDX-License-Identifier: MIT OR Apache-2.0
//! What is written is read again; what is cut off or changed is a bag without what was there, or an error.

use rand::RngExt;
use rustix::process::{Resource, Rlimit, setrlimit};
use std::collections::BTreeMap;
use std::fs;
use std::num::NonZeroU32;
use std::ops::Range;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use tautline_bag::{
    BagError, Compression, Definition, Event, FileReader, FileSummary, Finished, Hooks, Options, Ordered,
    Stamp, Storage, Topic, Writer, convert, files_of, index_of, recover,
};

fn topic(name: &str) -> Topic {
    Topic {
        name: name.to_owned(),
        type_name: "std_msgs/msg/String".to_owned(),
        type_hash: format!("RIHS01_{}", "0".repeat(64)),
        definition: Some(Definition::ros2msg("string data\n")),
        qos: "- history: keep_last\n  depth: 10\n".to_owned(),
        ..Topic::default()
    }
}

fn stamp(n: u64) -> Stamp {
    Stamp { sequence: n as u32, log_ns: 1_000_000_000 + n * 1_000_000, publish_ns: n }
}

/// Words that can be told apart, of any length.
fn body(n: u64) -> Vec<u8> {
    let len = 8 + (n * n) as usize % 300;
    let mut body = vec![n as u8; len];
    body[..8].copy_from_slice(&n.to_le_bytes());
    body
}

fn write(folder: &Path, options: Options, messages: u64) -> Finished {
    let session = BTreeMap::from([("host".to_owned(), "here".to_owned())]);
    let mut writer = Writer::create(folder, options, session).unwrap();
    let topics = ["/even", "/odd"].map(|name| writer.add_topic(topic(name)).unwrap());
    for n in 0..messages {
        writer.write(topics[n as usize % 2], stamp(n), &body(n)).unwrap();
    }
    writer.finish(BTreeMap::from([("lost".to_owned(), "0".to_owned())])).unwrap()
}

/// The numbers of the messages of a file, whose bytes are compared; and what is in it.
fn read(path: &Path) -> (Vec<u64>, FileSummary, usize) {
    let mut reader = FileReader::open(path).unwrap();
    let mut numbers = Vec::new();
    let read = reader.read(&mut |event| {
        if let Event::Message(message) = event {
            let n = u64::from_le_bytes(message.cdr[..8].try_into().unwrap());
            assert_eq!((message.cdr, message.stamp), (&*body(n), stamp(n)));
            assert_eq!(**message.topic, topic(["/even", "/odd"][n as usize % 2]));
            numbers.push(n);
        }
        Ok::<_, BagError>(())
    });
    read.unwrap();
    (numbers, reader.summary(), reader.damage().0.len())
}

fn all(folder: &Path) -> Vec<u64> {
    files_of(folder).unwrap().iter().flat_map(|file| read(file).0).collect()
}

#[test]
fn what_is_written_is_read() {
    let folder = tempfile::tempdir().unwrap();
    for compression in [Compression::None, Compression::Zstd, Compression::Lz4] {
        let bag = folder.path().join(format!("{compression:?}"));
        let finished = write(&bag, Options { compression, ..Options::default() }, 1000);
        assert_eq!((finished.files.len(), finished.removed), (1, 0));
        let (numbers, summary, damage) = read(&finished.files[0].path);
        assert_eq!((numbers, damage), ((0..1000).collect(), 0));
        assert_eq!((summary.messages, summary.compression), (1000, compression));
        assert_eq!((summary.start_ns, summary.end_ns), (stamp(0).log_ns, stamp(999).log_ns));
        assert_eq!(summary.topics.values().map(|(_, count)| *count).collect::<Vec<_>>(), [500, 500]);
        assert_eq!(summary.bytes, fs::metadata(&summary.path).unwrap().len());
        let (indexed, metadata) = index_of(&summary.path).unwrap().unwrap();
        assert_eq!(indexed, summary);
        let names: Vec<_> = metadata.iter().map(|(name, _)| &**name).collect();
        assert_eq!(names, ["tautline:session", "tautline:recording"]);
        assert_eq!(metadata[1].1["lost"], "0");
        let yaml = fs::read_to_string(bag.join("metadata.yaml")).unwrap();
        assert!(yaml.contains("message_count: 1000") && yaml.contains("        name: \"/odd\""), "{yaml}");
        assert!(matches!(
            Writer::create(&bag, Options::default(), BTreeMap::new()),
            Err(BagError::Exists(_))
        ));
    }
}

#[test]
fn files_are_split_and_the_oldest_goes() {
    let folder = tempfile::tempdir().unwrap();
    let bag = folder.path().join("by_time");
    let options = Options { split_ns: Some(100_000_000), ..Options::default() };
    let finished = write(&bag, options, 1000);
    assert_eq!(finished.files.iter().map(|file| file.messages).collect::<Vec<_>>(), [100; 10]);
    assert_eq!(
        files_of(&bag).unwrap(),
        finished.files.iter().map(|file| file.path.clone()).collect::<Vec<_>>()
    );
    assert_eq!(all(&bag), (0..1000).collect::<Vec<_>>());

    let bag = folder.path().join("by_size");
    let finished = write(&bag, Options { split_bytes: Some(50_000), ..Options::default() }, 1000);
    assert!(finished.files.len() > 3, "{finished:?}");
    for file in &finished.files[..finished.files.len() - 1] {
        assert!((50_000..70_000).contains(&file.bytes), "{file:?}");
    }
    assert_eq!(all(&bag), (0..1000).collect::<Vec<_>>());

    for keep in [1, 3] {
        let bag = folder.path().join(format!("ring_of_{keep}"));
        let finished = write(&bag, Options { keep_files: NonZeroU32::new(keep), ..options }, 1000);
        assert_eq!((finished.files.len() as u32, finished.removed), (keep, 10 - keep));
        assert_eq!(all(&bag), (1000 - u64::from(keep) * 100..1000).collect::<Vec<_>>());
        let yaml = fs::read_to_string(bag.join("metadata.yaml")).unwrap();
        assert!(yaml.contains(&format!("message_count: {}", keep * 100)), "{yaml}");
    }
}

/// Files that are moved away while it is written, for those who keep them, are not missed.
#[test]
fn a_file_that_somebody_moves_away_ends_no_recording() {
    let folder = tempfile::tempdir().unwrap();
    let bag = folder.path().join("bag");
    let (split_ns, keep_files) = (Some(100_000_000), NonZeroU32::new(2));
    let options = Options { split_ns, keep_files, ..Options::default() };
    let mut writer = Writer::create(&bag, options, BTreeMap::new()).unwrap();
    let id = writer.add_topic(topic("/even")).unwrap();
    for n in 0..1000 {
        writer.write(id, stamp(n), &body(n)).unwrap();
        if n == 250 {
            fs::rename(bag.join("bag_1.mcap"), folder.path().join("kept.mcap")).unwrap();
        }
    }
    let finished = writer.finish(BTreeMap::new()).unwrap();
    assert_eq!((finished.files.len(), finished.removed), (2, 7));
}

/// All messages in order; their numbers.
fn in_order(bag: &Path, from_ns: u64) -> Vec<u64> {
    let mut ordered = Ordered::open(bag, &mut |_| {}).unwrap();
    ordered.rewind(from_ns);
    let mut numbers = Vec::new();
    while let Some(message) = ordered.next_message().unwrap() {
        let n = u64::from_le_bytes(message.cdr[..8].try_into().unwrap());
        assert_eq!((&*message.cdr, message.stamp), (&*body(n), stamp(n)));
        assert_eq!(*ordered.topics()[message.topic], topic(["/even", "/odd"][n as usize % 2]));
        numbers.push(n);
    }
    assert_eq!(ordered.damage().count(), 0);
    numbers
}

#[test]
fn messages_come_in_the_order_of_their_reception() {
    let folder = tempfile::tempdir().unwrap();
    let bag = folder.path().join("bag");
    let options = Options { split_bytes: Some(20_000), ..Options::default() };
    let mut writer = Writer::create(&bag, options, BTreeMap::new()).unwrap();
    let topics = ["/even", "/odd"].map(|name| writer.add_topic(topic(name)).unwrap());
    // In blocks of 50 whose second half is written first, as of recorders that look at one topic after the other.
    for block in (0..1000).step_by(50) {
        for n in (block + 25..block + 50).chain(block..block + 25) {
            writer.write(topics[n as usize % 2], stamp(n), &body(n)).unwrap();
        }
        if block % 100 == 0 {
            writer.flush().unwrap();
        }
    }
    let files = writer.finish(BTreeMap::new()).unwrap().files;
    assert!(files.len() > 3);
    assert_eq!(in_order(&bag, 0), (0..1000).collect::<Vec<_>>());
    let (start_ns, end_ns) = Ordered::open(&bag, &mut |_| {}).unwrap().span_ns().unwrap();
    assert_eq!((start_ns, end_ns), (stamp(0).log_ns, stamp(999).log_ns));
    let later = in_order(&bag, stamp(500).log_ns);
    assert!(later.len() < 700 && later.ends_with(&(500..1000).collect::<Vec<_>>()), "{}", later.len());
    assert_eq!(in_order(&bag, stamp(1000).log_ns), []);
    // Without the index of one file, and without its end.
    let whole = fs::read(&files[0].path).unwrap();
    for cut in [20, whole.len() / 2] {
        fs::write(&files[0].path, &whole[..whole.len() - cut]).unwrap();
        let mut ordered = Ordered::open(&bag, &mut |_| {}).unwrap();
        assert_eq!(ordered.topics().len(), 2);
        let mut numbers = Vec::new();
        while let Some(message) = ordered.next_message().unwrap() {
            numbers.push(u64::from_le_bytes(message.cdr[..8].try_into().unwrap()));
        }
        assert!(numbers.is_sorted());
        assert_eq!((numbers.len() == 1000, ordered.damage().count()), (cut == 20, 1));
    }
}

/// Of one name and type, as when a definition was changed between two recordings.
#[test]
fn each_definition_of_a_type_is_a_topic() {
    let folder = tempfile::tempdir().unwrap();
    let bag = folder.path().join("bag");
    let mut writer = Writer::create(&bag, Options::default(), BTreeMap::new()).unwrap();
    for digit in ["0", "1"] {
        let type_hash = format!("RIHS01_{}", digit.repeat(64));
        let id = writer.add_topic(Topic { type_hash, ..topic("/even") }).unwrap();
        writer.write(id, stamp(0), &body(0)).unwrap();
    }
    writer.finish(BTreeMap::new()).unwrap();
    let mut ordered = Ordered::open(&bag, &mut |_| {}).unwrap();
    assert_eq!(ordered.topics().len(), 2);
    let topics = std::iter::from_fn(|| ordered.next_message().unwrap()).map(|message| message.topic);
    assert_eq!(topics.collect::<Vec<_>>(), [0, 1]);
}

/// A bag to which 200 messages were written, and flushed after every 20: its bytes and messages at first, and after each flush.
fn flushed(bag: &Path, compression: Compression) -> (Writer, Vec<(u64, u64)>) {
    let options = Options { compression, ..Options::default() };
    let mut writer = Writer::create(bag, options, BTreeMap::new()).unwrap();
    let topics = ["/even", "/odd"].map(|name| writer.add_topic(topic(name)).unwrap());
    let mut flushed = vec![(writer.bytes(), 0)];
    for n in 0..200 {
        writer.write(topics[n as usize % 2], stamp(n), &body(n)).unwrap();
        if n % 20 == 19 {
            writer.flush().unwrap();
            flushed.push((writer.bytes(), n + 1));
        }
    }
    (writer, flushed)
}

/// As a process leaves it that was killed: no end, no index, the last record torn at any byte.
#[test]
fn what_was_cut_off_anywhere_is_recovered() {
    let folder = tempfile::tempdir().unwrap();
    for compression in [Compression::None, Compression::Zstd, Compression::Lz4] {
        let bag = folder.path().join(format!("{compression:?}"));
        let (writer, flushed) = flushed(&bag, compression);
        let file = files_of(&bag).unwrap().remove(0);
        let whole = fs::read(&file).unwrap();
        drop(writer);
        for len in (8..whole.len()).step_by(173).chain([whole.len()]) {
            fs::write(&file, &whole[..len]).unwrap();
            let recovered = recover(&bag, &mut |_| {}).unwrap();
            let numbers = all(&bag);
            let certain = flushed.iter().filter(|(bytes, _)| *bytes <= len as u64).map(|(_, n)| *n).max();
            assert!(numbers.len() as u64 >= certain.unwrap_or(0), "{len}: {}", numbers.len());
            assert_eq!(numbers, (0..numbers.len() as u64).collect::<Vec<_>>(), "{len}");
            assert_eq!(recovered[0].summary.messages, numbers.len() as u64);
            assert!(!recovered[0].damage.is_empty(), "{len} of {}", whole.len());
            assert_eq!(fs::read(recovered[0].before.as_ref().unwrap()).unwrap(), whole[..len]);
            assert!(index_of(&file).unwrap().is_some());
            assert!(recover(&bag, &mut |_| {}).unwrap()[0].damage.is_empty(), "once is enough");
            let yaml = fs::read_to_string(bag.join("metadata.yaml")).unwrap();
            assert!(yaml.contains(&format!("  message_count: {}\n", numbers.len())), "{yaml}");
        }
    }
}

/// The last file of a recorder that was killed, or whose disk was full or lost its power, before the file's beginning was there.
#[test]
fn a_file_without_a_beginning_is_damage_and_costs_nothing_else() {
    let folder = tempfile::tempdir().unwrap();
    for (name, begin) in [("empty", &b""[..]), ("short", &b"\x89MCA"[..]), ("zeros", &[0; 5000][..])] {
        let bag = folder.path().join(name);
        write(&bag, Options::default(), 100);
        fs::remove_file(bag.join("metadata.yaml")).unwrap();
        fs::write(bag.join(format!("{name}_9.mcap")), begin).unwrap();
        assert_eq!(Ordered::open(&bag, &mut |_| {}).unwrap().damage().count(), 1);
        let (bags, new) = ([bag.clone()], folder.path().join(format!("{name}_new")));
        let converted = convert(&bags, &new, Storage::Mcap, Options::default(), Hooks::default()).unwrap();
        assert_eq!((converted.files[0].messages, converted.damage.len()), (100, 1));
        let recovered = recover(&bag, &mut |_| {}).unwrap();
        assert_eq!((recovered.len(), recovered[0].damage.len(), recovered[1].damage.len()), (2, 0, 1));
        assert!(recovered[1].damage[0].what.contains("its beginning was never written"), "{recovered:?}");
        assert_eq!(fs::read(recovered[1].before.as_ref().unwrap()).unwrap(), begin);
        assert_eq!(all(&bag), (0..100).collect::<Vec<_>>());
        assert!(recover(&bag, &mut |_| {}).unwrap().iter().all(|file| file.damage.is_empty()));
    }
}

#[test]
fn a_description_that_cannot_be_read_is_kept_beside_the_new_one() {
    let folder = tempfile::tempdir().unwrap();
    let bag = folder.path().join("bag");
    write(&bag, Options::default(), 10);
    let read = |name: &str| fs::read_to_string(bag.join(name));
    let unreadable = "rosbag2_bagfile_information: [";
    fs::write(bag.join("metadata.yaml"), unreadable).unwrap();
    for _ in 0..2 {
        recover(&bag, &mut |_| {}).unwrap();
        assert_eq!(read("metadata.yaml.damaged").unwrap(), unreadable);
        assert!(read("metadata.yaml").unwrap().contains("  message_count: 10\n"));
        assert!(read("metadata.yaml.damaged.1").is_err());
    }
}

const CHUNK: u8 = 0x06;
const DATA_END: u8 = 0x0f;

/// The kind and the place of each record, up to the end of the data.
fn records(bytes: &[u8]) -> Vec<(u8, Range<usize>)> {
    let (mut at, mut records): (usize, Vec<(u8, Range<usize>)>) = (8, Vec::new());
    while records.last().is_none_or(|(kind, _)| *kind != DATA_END) {
        let next = at + 9 + u64::from_le_bytes(bytes[at + 1..at + 9].try_into().unwrap()) as usize;
        records.push((bytes[at], at..next));
        at = next;
    }
    records
}

fn chunks(bytes: &[u8]) -> Vec<Range<usize>> {
    records(bytes).into_iter().filter(|(kind, _)| *kind == CHUNK).map(|(_, chunk)| chunk).collect()
}

/// Changes a byte of each chunk of a file; how many there are.
fn damage_chunks(path: &Path) -> u64 {
    let mut bytes = fs::read(path).unwrap();
    let chunks = chunks(&bytes);
    chunks.iter().for_each(|chunk| bytes[chunk.end - 1] ^= 1);
    fs::write(path, bytes).unwrap();
    chunks.len() as u64
}

/// Though channels are in the first chunk alone: the summary repeats them.
#[test]
fn a_damaged_chunk_costs_no_message_of_another() {
    let folder = tempfile::tempdir().unwrap();
    let bag = folder.path().join("bag");
    let (writer, _) = flushed(&bag, Compression::None);
    let path = writer.finish(BTreeMap::new()).unwrap().files.remove(0).path;
    let mut bytes = fs::read(&path).unwrap();
    let first = chunks(&bytes).remove(0);
    bytes[first.end - 1] ^= 1;
    fs::write(&path, &bytes).unwrap();
    let recovered = recover(&bag, &mut |_| {}).unwrap().remove(0);
    assert_eq!((recovered.summary.messages, recovered.damage.len()), (180, 1), "{recovered:?}");
    assert_eq!(read(&path).0, (20..200).collect::<Vec<_>>());
}

#[test]
fn a_changed_byte_of_the_summary_or_of_the_times_of_a_chunk_is_damage() {
    let folder = tempfile::tempdir().unwrap();
    let path = write(&folder.path().join("bag"), Options::default(), 100).files.remove(0).path;
    let whole = fs::read(&path).unwrap();
    let damages = |at: usize| {
        let mut bytes = whole.clone();
        bytes[at] ^= 1;
        fs::write(&path, bytes).unwrap();
        let mut reader = FileReader::open(&path).unwrap();
        reader.read(&mut |_| Ok::<_, BagError>(())).unwrap();
        assert_eq!(reader.summary().messages, 100);
        reader.damage().1
    };
    for at in records(&whole).last().unwrap().1.end..whole.len() {
        assert_eq!(damages(at), 1, "{at} of {}", whole.len());
        assert!(index_of(&path).unwrap().is_none(), "{at} of {}", whole.len());
    }
    // The times of the first and the last message are at the beginning of a chunk.
    let times = chunks(&whole)[0].start + 9;
    assert_eq!([times, times + 8].map(damages), [1, 1]);
}

/// Though not all of it is listed, with an index and without, however often a bag is read.
#[test]
fn all_damage_is_counted() {
    let folder = tempfile::tempdir().unwrap();
    let bag = folder.path().join("bag");
    let mut writer = Writer::create(&bag, Options::default(), BTreeMap::new()).unwrap();
    let id = writer.add_topic(topic("/even")).unwrap();
    for n in 0..300 {
        writer.write(id, stamp(n), &body(n)).unwrap();
        writer.flush().unwrap();
    }
    let path = writer.finish(BTreeMap::new()).unwrap().files.remove(0).path;
    let chunks = damage_chunks(&path);
    assert!(chunks >= 300, "{chunks}");
    let whole = fs::read(&path).unwrap();
    for cut in [0, 20] {
        fs::write(&path, &whole[..whole.len() - cut]).unwrap();
        let damages = chunks + u64::from(cut > 0);
        let mut ordered = Ordered::open(&bag, &mut |_| {}).unwrap();
        for _ in 0..2 {
            ordered.rewind(0);
            assert!(ordered.next_message().unwrap().is_none());
            assert_eq!((ordered.damage().count(), ordered.damages()), (100, damages));
        }
        let (bags, new) = ([bag.clone()], folder.path().join(format!("new_{cut}")));
        let converted = convert(&bags, &new, Storage::Mcap, Options::default(), Hooks::default()).unwrap();
        assert_eq!((converted.damage.len(), converted.damages), (100, damages));
        let recovered = recover(&path, &mut |_| {}).unwrap().remove(0);
        assert_eq!((recovered.damage.len(), recovered.damages), (100, damages));
    }
}

/// As any other record.
#[test]
fn an_attachment_of_an_impossible_length_costs_only_itself() {
    let folder = tempfile::tempdir().unwrap();
    let path = write(&folder.path().join("bag"), Options::default(), 100).files.remove(0).path;
    let whole = fs::read(&path).unwrap();
    let (length, file) = (3_u64 << 30, fs::File::create(&path).unwrap());
    // The attachment itself is a hole, which takes no room.
    file.write_all_at(&whole[..8], 0).unwrap();
    file.write_all_at(&[&[9][..], &length.to_le_bytes()].concat(), 8).unwrap();
    file.write_all_at(&whole[8..], 8 + 9 + length).unwrap();
    drop(file);
    let recovered = recover(&path, &mut |_| {}).unwrap().remove(0);
    assert_eq!((recovered.summary.messages, recovered.damage.len()), (100, 1));
    assert!(recovered.damage[0].what.contains("is longer than any"), "{recovered:?}");
    assert_eq!(read(&path).0, (0..100).collect::<Vec<_>>());
}

/// Numbers below what is asked for.
fn random() -> impl FnMut(usize) -> usize {
    let mut random = tautline_seed::random();
    move |below| random.random_range(0..below)
}

/// Messages and chunks that are longer than all memory for what is on its way to the disk, and shorter ones; what was flushed is there.
#[test]
fn what_goes_to_the_disk_in_pieces_is_the_same() {
    let folder = tempfile::tempdir().unwrap();
    let mut random = random();
    for round in 0..9 {
        let compression = [Compression::None, Compression::Zstd, Compression::Lz4][round % 3];
        let memory_bytes = [None, Some(0), Some(1 + random(200_000))][round / 3];
        let bag = folder.path().join(format!("{round}"));
        let options = Options { compression, memory_bytes, ..Options::default() };
        let mut writer = Writer::create(&bag, options, BTreeMap::new()).unwrap();
        let long = writer.add_topic(topic("/long")).unwrap();
        let file = files_of(&bag).unwrap().remove(0);
        let mut written: Vec<Vec<u8>> = Vec::new();
        let all = |file: &Path| {
            let (mut all, mut reader) = (Vec::new(), FileReader::open(file).unwrap());
            let read = reader.read(&mut |event| {
                if let Event::Message(message) = event {
                    all.push(message.cdr.to_vec());
                }
                Ok::<_, BagError>(())
            });
            read.unwrap();
            (all, reader.damage().0.len())
        };
        for n in 0..100 {
            let mut cdr = vec![0; [10, 5000, 100_000, 300_000][random(4)].min(random(300_001))];
            cdr.iter_mut().step_by(1 + random(7)).for_each(|byte| *byte = random(256) as u8);
            writer.write(long, stamp(n), &cdr).unwrap();
            written.push(cdr);
            writer.set_behind(random(3) == 0);
            if random(20) == 0 {
                writer.flush().unwrap();
                // A file that has no end yet.
                assert_eq!(fs::metadata(&file).unwrap().len(), writer.bytes());
                assert!(all(&file).0 == written, "round {round}, {n} messages");
            }
        }
        writer.finish(BTreeMap::new()).unwrap();
        assert!(all(&file) == (written, 0), "round {round}");
        fs::remove_dir_all(&bag).unwrap();
    }
}

#[test]
fn a_changed_byte_costs_no_more_than_its_chunk() {
    let folder = tempfile::tempdir().unwrap();
    let mut random = random();
    for compression in [Compression::None, Compression::Zstd, Compression::Lz4] {
        let bag = folder.path().join(format!("{compression:?}"));
        let (writer, _) = flushed(&bag, compression);
        let file = writer.finish(BTreeMap::new()).unwrap().files.remove(0).path;
        let whole = fs::read(&file).unwrap();
        for _ in 0..300 {
            let mut bytes = whole.clone();
            for _ in 0..1 + random(3) {
                let at = 8 + random(bytes.len() - 8);
                bytes[at] ^= 1 << random(8);
            }
            fs::write(&file, &bytes).unwrap();
            // Whatever it is, it is an answer: lengths may be wrong, and with them all that follows.
            let _ = index_of(&file).unwrap();
            let mut reader = FileReader::open(&file).unwrap();
            reader.read(&mut |_| Ok::<_, BagError>(())).unwrap();
            recover(&file, &mut |_| {}).unwrap();
            let (mut again, before) = (FileReader::open(&file).unwrap(), reader.summary().messages);
            again.read(&mut |_| Ok::<_, BagError>(())).unwrap();
            assert_eq!((again.damage().1, again.summary().messages), (0, before));
        }
    }
}

#[test]
fn a_length_is_a_claim() {
    // What reserves three GiB because a file says so ends here.
    let limit = Rlimit { current: Some(1 << 31), maximum: Some(1 << 31) };
    setrlimit(Resource::As, limit).unwrap();
    let folder = tempfile::tempdir().unwrap();
    for compression in [Compression::None, Compression::Zstd, Compression::Lz4] {
        let bag = folder.path().join(format!("{compression:?}"));
        let file = write(&bag, Options { compression, ..Options::default() }, 4).files.remove(0).path;
        let whole = fs::read(&file).unwrap();
        for at in 8..whole.len() - 4 {
            let mut bytes = whole.clone();
            bytes[at..at + 4].copy_from_slice(&0xC000_0000_u32.to_le_bytes());
            fs::write(&file, &bytes).unwrap();
            let _ = index_of(&file).unwrap();
            let mut reader = FileReader::open(&file).unwrap();
            reader.read(&mut |_| Ok::<_, BagError>(())).unwrap();
        }
    }
}

#[test]
fn what_is_no_bag_is_said() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let refused = |path: &PathBuf| match files_of(path).and_then(|files| FileReader::open(&files[0])) {
        Err(error) => error.to_string(),
        Ok(_) => panic!("{} is none", path.display()),
    };
    assert!(refused(&path("none")).contains("cannot be read"));
    fs::write(path("text"), "no magic at all").unwrap();
    assert!(refused(&path("text")).contains("does not begin as an MCAP file"));
    fs::write(path("short"), b"\x89MC").unwrap();
    assert!(refused(&path("short")).contains("does not begin as an MCAP file"));
    fs::create_dir(path("empty")).unwrap();
    assert!(refused(&path("empty")).contains("there is no .mcap file in it"));
    assert!(index_of(&path("text")).unwrap().is_none());
}
