// SPDX-License-Identifier: MIT OR Apache-2.0
//! Bags of rosbag2 in its other storage and compressions: what is in them is in the new one; what is none leaves nothing.

use rand::RngExt;
use rusqlite::{Connection, params};
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use tautline_bag::{
    BagError, Compression, Converted, Definition, FileReader, Hooks, Options, Ordered, OwnedMessage, Stamp,
    Storage, Topic, Writer, convert, files_of, index_of,
};

const QOS: &str = "- history: keep_last\n  depth: 7\n  reliability: best_effort\n  durability: transient_local\n  deadline:\n    sec: 0\n    \
                   nsec: 5\n  lifespan:\n    sec: 9223372036\n    nsec: 854775807\n  liveliness: automatic\n  liveliness_lease_duration:\n    \
                   sec: 1\n    nsec: 0\n  avoid_ros_namespace_conventions: false\n";
/// As rosbag2 wrote it before.
const QOS_IN_NUMBERS: &str = "- history: 1\n  depth: 7\n  reliability: 2\n  durability: 1\n  deadline: {sec: 0, nsec: 5}\n  \
                              lifespan: {sec: 9223372036, nsec: 854775807}\n  liveliness: 1\n  liveliness_lease_duration: {sec: 1, nsec: 0}\n  \
                              avoid_ros_namespace_conventions: false\n";

fn topic(name: &str) -> Topic {
    Topic {
        name: name.to_owned(),
        type_name: "std_msgs/msg/String".to_owned(),
        type_hash: format!("RIHS01_{}", "0".repeat(64)),
        definition: Some(Definition::ros2msg("string data\n")),
        qos: QOS.to_owned(),
        ..Topic::default()
    }
}

fn cdr(n: u64) -> Vec<u8> {
    [vec![0, 1, 0, 0], n.to_le_bytes().to_vec(), vec![n as u8; (n * n) as usize % 3000]].concat()
}

fn write(folder: &Path, messages: u64, publish_ns: impl Fn(u64) -> u64) {
    let options = Options { split_bytes: Some(200_000), ..Options::default() };
    let mut writer = Writer::create(folder, options, BTreeMap::new()).unwrap();
    let ids = ["/even", "/odd"].map(|name| writer.add_topic(topic(name)).unwrap());
    for n in 0..messages {
        let log_ns = 1_000_000_000 + n / 2 * 1_000_000;
        let stamp = Stamp { sequence: 0, log_ns, publish_ns: publish_ns(log_ns) };
        writer.write(ids[n as usize % 2], stamp, &cdr(n)).unwrap();
    }
    writer.finish(BTreeMap::from([("lost".to_owned(), "3".to_owned())])).unwrap();
}

fn all(bag: &Path) -> (Vec<Topic>, Vec<OwnedMessage>) {
    let mut bag = Ordered::open(bag, &mut |_| {}).unwrap();
    let messages = std::iter::from_fn(|| bag.next_message().unwrap()).collect();
    assert_eq!(bag.damage().count(), 0);
    (bag.topics().iter().map(|topic| Topic::clone(topic)).collect(), messages)
}

fn hooks<'h>(define: impl FnMut(&Topic, Option<&[u8]>) -> Option<Definition> + 'h) -> Hooks<'h> {
    Hooks { define: Some(Box::new(define)), ..Hooks::default() }
}

fn to(bag: &Path, new: &Path, storage: Storage, compression: Compression) -> Result<Converted, BagError> {
    let hooks = hooks(|_, _| None);
    convert(&[bag.to_owned()], new, storage, Options { compression, ..Options::default() }, hooks)
}

fn to_mcap(bag: &Path, new: &Path) -> Result<Converted, BagError> {
    to(bag, new, Storage::Mcap, Compression::None)
}

/// Refused with these words, and nothing is left.
fn refused(bag: &Path, words: &str) {
    let new = bag.parent().unwrap().join("refused");
    let beside = || fs::read_dir(bag.parent().unwrap()).unwrap().count();
    let before = beside();
    let error = to_mcap(bag, &new).map(|_| ()).unwrap_err().to_string();
    assert!(error.contains(words), "{error}");
    assert_eq!(beside(), before, "{error}");
}

#[test]
fn there_and_back_is_the_same() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    write(&path("bag"), 1000, |log_ns| log_ns);
    let before = all(&path("bag"));
    for compression in [Compression::None, Compression::Zstd] {
        let db = path(&format!("db{compression:?}"));
        let converted = to(&path("bag"), &db, Storage::Sqlite3, compression).unwrap();
        assert_eq!(converted.notes, Vec::<String>::new());
        assert_eq!(converted.files.iter().map(|file| file.messages).sum::<u64>(), 1000);
        assert!(converted.files.iter().all(|file| file.path.is_file()), "{converted:?}");
        let error = files_of(&db).unwrap_err().to_string();
        assert!(error.contains("its files are SQLite's (.db3): `taut bag convert "), "{error}");
        let back = path(&format!("back{compression:?}"));
        to_mcap(&db, &back).unwrap();
        assert_eq!(all(&back), before);
        // What was said of it is, too.
        let (_, said) = index_of(&files_of(&back).unwrap()[0]).unwrap().unwrap();
        assert_eq!(said, []);
        let yaml = fs::read_to_string(back.join("metadata.yaml")).unwrap();
        assert!(yaml.contains("\"tautline:recording/lost\": \"3\""), "{yaml}");
        // A file alone, of which nobody says how it is compressed.
        let alone = path(&format!("alone{compression:?}"));
        to_mcap(&converted.files[0].path, &alone).unwrap();
        assert_eq!(all(&alone), before);
    }
    assert!(fs::read_dir(folder.path()).unwrap().all(|entry| {
        let name = entry.unwrap().file_name().into_string().unwrap();
        !name.contains("unfinished")
    }));
}

#[test]
fn what_sqlite_has_no_column_for_is_said() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    write(&path("bag"), 10, |log_ns| log_ns - 1);
    let converted = to(&path("bag"), &path("db"), Storage::Sqlite3, Compression::None).unwrap();
    assert!(converted.notes[0].starts_with("10 messages lose their time of publication"), "{converted:?}");
    let error = to(&path("bag"), &path("lz4"), Storage::Sqlite3, Compression::Lz4).unwrap_err().to_string();
    assert!(error.contains("with zstd alone") && !path("lz4").exists(), "{error}");
}

#[test]
fn one_topic_of_two_bags_is_one() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    for schema in [1, 2] {
        old(&path(&format!("bag{schema}")), schema);
    }
    let define = |_: &Topic, _: Option<&[u8]>| Some(Definition::ros2msg("string data\n"));
    let bags = [path("bag2"), path("bag1")];
    let converted = convert(&bags, &path("new"), Storage::Mcap, Options::default(), hooks(define)).unwrap();
    assert_eq!(converted.notes, Vec::<String>::new());
    let (topics, messages) = all(&path("new"));
    assert_eq!((topics.len(), &*topics[0].qos, messages.len()), (2, QOS, 20));
}

#[test]
fn files_of_a_database_are_split() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    write(&path("bag"), 1000, |log_ns| log_ns);
    let hooks = hooks(|_, _| None);
    let options = Options { split_bytes: Some(300_000), ..Options::default() };
    let converted = convert(&[path("bag")], &path("db"), Storage::Sqlite3, options, hooks).unwrap();
    assert!(converted.files.len() > 3, "{}", converted.files.len());
    to_mcap(&path("db"), &path("back")).unwrap();
    assert_eq!(all(&path("back")), all(&path("bag")));
}

/// A bag as rosbag2 of this version of the schema wrote it.
fn old(folder: &Path, schema: u32) -> PathBuf {
    fs::create_dir(folder).unwrap();
    let path = folder.join("old_0.db3");
    let connection = Connection::open(&path).unwrap();
    let run = |text: &str| connection.execute_batch(text).unwrap();
    if schema >= 3 {
        run("CREATE TABLE schema(schema_version INTEGER PRIMARY KEY,ros_distro TEXT NOT NULL);
             CREATE TABLE metadata(id INTEGER PRIMARY KEY,metadata_version INTEGER NOT NULL,metadata TEXT NOT NULL);
             INSERT INTO schema VALUES (3, 'humble');");
    }
    let qos = if schema >= 2 { ",offered_qos_profiles TEXT NOT NULL" } else { "" };
    run(&format!(
        "CREATE TABLE topics(id INTEGER PRIMARY KEY,name TEXT NOT NULL,type TEXT NOT NULL,serialization_format TEXT NOT NULL{qos});
         CREATE TABLE messages(id INTEGER PRIMARY KEY,topic_id INTEGER NOT NULL,timestamp INTEGER NOT NULL, data BLOB NOT NULL);
         CREATE INDEX timestamp_idx ON messages (timestamp ASC);"
    ));
    for (id, name) in [(1, "/some"), (2, "/none")] {
        let topic = "std_msgs/msg/String";
        if schema >= 2 {
            let values = params![id, name, topic, QOS_IN_NUMBERS];
            connection.execute("INSERT INTO topics VALUES (?, ?, ?, 'cdr', ?)", values).unwrap();
        } else {
            connection
                .execute("INSERT INTO topics VALUES (?, ?, ?, 'cdr')", params![id, name, topic])
                .unwrap();
        }
    }
    for n in 0..10 {
        let values = params![1, 1_000_000_000 + n as i64, cdr(n)];
        connection
            .execute("INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)", values)
            .unwrap();
    }
    let version = if schema == 1 { 2 } else { 4 };
    // Before version 4 paths began with the folder's name of then.
    let file = if schema == 1 { "named_otherwise/old_0.db3" } else { "old_0.db3" };
    metadata(
        folder,
        &format!("version: {version}\n  storage_identifier: sqlite3\n  relative_file_paths: [{file}]"),
    );
    path
}

fn metadata(folder: &Path, text: &str) {
    fs::write(folder.join("metadata.yaml"), format!("rosbag2_bagfile_information:\n  {text}\n")).unwrap();
}

#[test]
fn old_databases_are_read() {
    let folder = tempfile::tempdir().unwrap();
    for schema in 1..=3 {
        let [bag, new] = ["old", "new"].map(|name| folder.path().join(format!("{name}{schema}")));
        old(&bag, schema);
        let mut asked = Vec::new();
        let define = |topic: &Topic, cdr: Option<&[u8]>| {
            asked.push((topic.name.clone(), cdr.map(<[u8]>::len)));
            (topic.name == "/some").then(|| Definition::ros2msg("string data\n"))
        };
        let hooks = hooks(define);
        let converted =
            convert(std::slice::from_ref(&bag), &new, Storage::Mcap, Options::default(), hooks).unwrap();
        assert_eq!(converted.notes, ["/none: the definition of std_msgs/msg/String is not known"]);
        assert_eq!(asked, [("/some".to_owned(), Some(12)), ("/none".to_owned(), None)]);
        let (topics, messages) = all(&new);
        let qos = if schema >= 2 { QOS } else { "" };
        assert_eq!((&*topics[0].name, &*topics[0].qos, &*topics[0].type_hash), ("/some", qos, ""));
        assert_eq!(topics[0].ros2msg().as_deref(), Some("string data\n"));
        assert_eq!(
            messages.iter().map(|message| message.cdr.clone()).collect::<Vec<_>>(),
            (0..10).map(cdr).collect::<Vec<_>>()
        );
        assert!(messages.iter().all(|message| message.stamp.publish_ns == message.stamp.log_ns));
        let (summary, _) = index_of(&converted.files[0].path).unwrap().unwrap();
        assert_eq!(
            summary.topics.values().map(|(topic, count)| (&*topic.name, *count)).collect::<Vec<_>>(),
            [("/none", 0), ("/some", 10)]
        );
    }
}

#[test]
fn what_is_no_bag_leaves_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let bag = folder.path().join("bag");
    let path = old(&bag, 2);
    let whole = fs::read(&path).unwrap();
    for text in ["", "version: ["] {
        metadata(&bag, text);
        refused(&bag, "metadata.yaml' is not a bag: ");
    }
    let neither = "begins neither as MCAP nor as SQLite nor as what zstd compressed; its storage is called";
    let packed = |mode: &str| format!("[old_0.db3]\n  compression_mode: {mode}");
    for (files, words) in [
        ("[]", "it names no file"),
        ("[../old_0.db3]", "names '../old_0.db3', which is outside of its folder"),
        ("[/etc/passwd]", "names '/etc/passwd', which is outside"),
        ("[a/../../b]", "which is outside"),
        ("[old_1.db3]", "names 'old_1.db3', which is not there"),
        ("[.]", "outside of its folder"),
        (&*packed("FILE\n  compression_format: lz9"), "the compression 'lz9' is unknown"),
        (&*packed("some"), "the compression mode 'some' is unknown"),
        (&*packed("MESSAGE\n  compression_format: zstd"), "a message cannot be decompressed"),
        ("[metadata.yaml]", neither),
    ] {
        let described = "version: 5\n  storage_identifier: sqlite3\n  relative_file_paths:";
        metadata(&bag, &format!("{described} {files}"));
        refused(&bag, words);
    }
    refused(&folder.path().join("none"), "cannot be read");
    refused(&bag.join("metadata.yaml"), "begins neither as MCAP nor as SQLite");
    let damaged = |bytes: &[u8], words: &str| {
        fs::write(&path, bytes).unwrap();
        refused(&path, words);
    };
    damaged(b"", "it is empty");
    damaged(&whole[..5000], "it is cut off: 5000 bytes of 16384; `sqlite3 ");
    damaged(&[&whole[..16], &[0xff; 300]].concat(), "is not a bag: SQLite says:");
    damaged(
        &zstd::encode_all(&b"no database"[..], 1).unwrap(),
        "what is compressed in it: it begins neither",
    );
    let twice = zstd::encode_all(&*zstd::encode_all(&*whole, 1).unwrap(), 1).unwrap();
    damaged(&twice, "it is compressed twice");
    let packed = zstd::encode_all(&*whole, 1).unwrap();
    damaged(&packed[..packed.len() - 9], "it cannot be decompressed");
    for (text, words) in [
        ("UPDATE messages SET timestamp = 'noon' WHERE id = 3", "message 3: timestamp is Text, no integer"),
        ("UPDATE messages SET timestamp = -5 WHERE id = 3", "message 3: timestamp is -5, before 1970"),
        ("UPDATE messages SET data = 7 WHERE id = 3", "message 3: data is Integer, no blob"),
        ("UPDATE messages SET topic_id = x'00' WHERE id = 3", "message 3: topic_id is Blob, no integer"),
        ("UPDATE topics SET name = x'2f61'", "in its table 'topics' name is Blob, no text"),
        ("UPDATE topics SET type = cast(x'ff' AS TEXT)", "type has bytes that are no UTF-8"),
        ("DROP TABLE topics", "it is a database without a table 'topics'"),
        ("ALTER TABLE messages RENAME data TO bytes", "its table 'messages' has no column 'data'"),
        (
            "ALTER TABLE messages RENAME TO m; CREATE VIEW messages AS SELECT * FROM m",
            "'messages' in it is a view, no table",
        ),
        // Every row has more bytes than the file.
        (
            "CREATE TABLE m AS SELECT * FROM messages; DROP TABLE messages; CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, \
          data AS (zeroblob(100000000))); INSERT INTO messages SELECT id, topic_id, timestamp FROM m",
            "has no column 'data'",
        ),
        (
            "CREATE VIRTUAL TABLE x USING fts5(topic_id, timestamp, data); DROP TABLE messages; ALTER TABLE x RENAME TO messages",
            "'messages' in it is a virtual, no table",
        ),
    ] {
        fs::write(&path, &whole).unwrap();
        Connection::open(&path).unwrap().execute_batch(text).unwrap();
        refused(&path, words);
    }
    // What is no message's is left out, and said.
    fs::write(&path, &whole).unwrap();
    Connection::open(&path).unwrap().execute_batch("UPDATE messages SET topic_id = 9 WHERE id > 5").unwrap();
    let new = folder.path().join("new");
    let converted = to_mcap(&path, &new).unwrap();
    assert!(
        converted.notes.iter().any(|note| note.contains("5 messages of no topic are left out")),
        "{converted:?}"
    );
    let error = to_mcap(&path, &new).unwrap_err().to_string();
    assert!(error.contains("exists already"), "{error}");
}

#[test]
fn a_folder_without_metadata_is_taken_as_it_is() {
    let folder = tempfile::tempdir().unwrap();
    let bag = folder.path().join("bag");
    let path = old(&bag, 2);
    fs::remove_file(bag.join("metadata.yaml")).unwrap();
    let packed = zstd::encode_all(&*fs::read(&path).unwrap(), 1).unwrap();
    fs::write(bag.join("old_10.db3.zstd"), packed).unwrap();
    fs::rename(&path, bag.join("old_9.db3")).unwrap();
    let converted = to_mcap(&bag, &folder.path().join("new")).unwrap();
    assert!(
        converted.notes[0].contains("metadata.yaml' is not there: what is in the folder is taken"),
        "{converted:?}"
    );
    assert_eq!(converted.files[0].messages, 20);
    fs::remove_file(bag.join("old_9.db3")).unwrap();
    let error = files_of(&bag).unwrap_err().to_string();
    assert!(error.contains("compressed as a whole (.zstd): `taut bag convert"), "{error}");
    fs::remove_file(bag.join("old_10.db3.zstd")).unwrap();
    refused(&bag, "there is neither metadata.yaml nor a .mcap or .db3 file in it");
}

/// The last file of a killed recording is found, and the files are in the order of their numbers.
#[test]
fn names_may_have_dots() {
    let folder = tempfile::tempdir().unwrap();
    let bag = folder.path().join("a.b");
    let options = Options { split_ns: Some(1), ..Options::default() };
    let mut writer = Writer::create(&bag, options, BTreeMap::new()).unwrap();
    let id = writer.add_topic(topic("/one")).unwrap();
    for n in 0..11 {
        let log_ns = 1_000_000_000 + n;
        writer.write(id, Stamp { sequence: 0, log_ns, publish_ns: log_ns }, &cdr(n)).unwrap();
    }
    assert_eq!(writer.finish(BTreeMap::new()).unwrap().files.len(), 11);
    let named = (0..10).map(|n| format!("a.b_{n}.mcap")).collect::<Vec<_>>().join(", ");
    metadata(&bag, &format!("version: 9\n  storage_identifier: mcap\n  relative_file_paths: [{named}]"));
    for new in ["described", "undescribed"] {
        let converted = to_mcap(&bag, &folder.path().join(new)).unwrap();
        assert_eq!((converted.notes.len(), converted.files[0].messages), (1, 11), "{converted:?}");
        let mut reader = FileReader::open(&converted.files[0].path).unwrap();
        reader.read(&mut |_| Ok::<_, BagError>(())).unwrap();
        assert_eq!(reader.summary().disordered, 0, "{new}");
        // The next time, what is in the folder is taken.
        let _ = fs::remove_file(bag.join("metadata.yaml"));
    }
}

/// Rows whose bytes are in the same place are no more than one; a few of them could fill any disk.
#[test]
fn no_byte_of_a_database_is_two_messages() {
    let folder = tempfile::tempdir().unwrap();
    let path = old(&folder.path().join("bag"), 2);
    let connection = Connection::open(&path).unwrap();
    connection.execute_batch("DELETE FROM messages; VACUUM").unwrap();
    let body = vec![7_u8; 48 * 4092 + 540];
    for n in 0..5 {
        connection
            .execute("INSERT INTO messages (topic_id, timestamp, data) VALUES (1, ?, ?)", params![n, body])
            .unwrap();
    }
    let page = connection.query_row("PRAGMA page_size", [], |row| row.get::<_, u32>(0)).unwrap() as usize;
    let text = "SELECT rootpage FROM sqlite_master WHERE name = 'messages'";
    let root = connection.query_row(text, [], |row| row.get::<_, u32>(0)).unwrap() as usize;
    connection.close().unwrap();
    let mut bytes = fs::read(&path).unwrap();
    // A leaf with five cells, each with the number of its first further page at its end: https://sqlite.org/fileformat2.html.
    let leaf = (root - 1) * page;
    let number =
        |bytes: &[u8], at: usize| bytes[at..at + 2].iter().fold(0, |sum, byte| sum << 8 | usize::from(*byte));
    assert_eq!((bytes[leaf], number(&bytes, leaf + 3)), (13, 5));
    let least = (page - 12) * 32 / 255 - 23;
    let ends: Vec<_> = (0..5)
        .map(|cell| {
            let at = leaf + number(&bytes, leaf + 8 + 2 * cell);
            let payload = bytes[at..at + 3].iter().fold(0, |sum, byte| sum << 7 | usize::from(byte & 0x7f));
            let local = least + (payload - least) % (page - 4);
            at + 4 + if local <= page - 35 { local } else { least }
        })
        .collect();
    let first: [u8; 4] = bytes[ends[0]..ends[0] + 4].try_into().unwrap();
    ends.iter().for_each(|end| bytes[*end..*end + 4].copy_from_slice(&first));
    let pages = u32::from_be_bytes(first) as usize + body.len() / page;
    bytes.truncate(pages * page);
    bytes[28..32].copy_from_slice(&(pages as u32).to_be_bytes());
    fs::write(&path, &bytes).unwrap();
    refused(&path, "its messages have more bytes than it has");
}

/// As rosbag2's preset `resilient` leaves it after a kill.
#[test]
fn what_is_beside_a_database_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let file = old(&path("bag"), 2);
    let connection = Connection::open(&file).unwrap();
    connection.execute_batch("PRAGMA journal_mode = WAL; PRAGMA wal_autocheckpoint = 0").unwrap();
    let insert = "INSERT INTO messages (topic_id, timestamp, data) VALUES (1, 2000000000, ?)";
    connection.execute(insert, [cdr(99)]).unwrap();
    fs::create_dir(path("killed")).unwrap();
    for name in ["old_0.db3", "old_0.db3-wal"] {
        fs::copy(path("bag").join(name), path("killed").join(name)).unwrap();
    }
    for bag in ["bag", "killed"] {
        to_mcap(&path(bag), &path(&format!("{bag}_new"))).unwrap();
        let (_, messages) = all(&path(&format!("{bag}_new")));
        assert_eq!((messages.len(), &messages[10].cdr), (11, &cdr(99)), "{bag}");
    }
}

/// In containers another process has the same number.
#[test]
fn what_a_killed_conversion_has_left_is_in_nobodys_way() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    write(&path("bag"), 10, |log_ns| log_ns);
    let leftovers = [format!(".new.{}.unfinished", std::process::id()), ".new.unfinished".to_owned()];
    for leftover in &leftovers {
        fs::create_dir(path(leftover)).unwrap();
        fs::write(path(leftover).join("new_0.mcap"), "some").unwrap();
    }
    to_mcap(&path("bag"), &path("new")).unwrap();
    assert!(!path(".new.unfinished").exists());
    // What another one writes just now is left alone.
    let [first, second] = [".other.unfinished", ".other.1.unfinished"].map(path);
    fs::create_dir(&first).unwrap();
    let lock = fs::File::open(&first).unwrap();
    lock.try_lock().unwrap();
    to_mcap(&path("bag"), &path("other")).unwrap();
    assert!(first.exists() && !second.exists());
}

#[test]
fn an_interruption_leaves_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    write(&path("bag"), 1000, |log_ns| log_ns);
    for storage in [Storage::Mcap, Storage::Sqlite3] {
        let mut left = 500;
        let go_on = &mut || {
            left -= 1;
            left > 0
        };
        let hooks = Hooks { go_on: Box::new(go_on), ..hooks(|_, _| None) };
        let result = convert(&[path("bag")], &path("new"), storage, Options::default(), hooks);
        assert!(matches!(result, Err(BagError::Interrupted)), "{result:?}");
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }
}

/// What a database is that had bits changed: an answer, and nothing that is half.
#[test]
fn a_changed_database_is_no_crash() {
    let folder = tempfile::tempdir().unwrap();
    let bag = folder.path().join("bag");
    let path = old(&bag, 2);
    let whole = fs::read(&path).unwrap();
    let mut random = tautline_seed::random();
    let mut random = |below: usize| random.random_range(0..below);
    let new = folder.path().join("new");
    let (mut taken, mut left) = (0, 0);
    for _ in 0..400 {
        let mut bytes = whole.clone();
        for _ in 0..1 + random(4) {
            // Pages are mostly empty: what is in them is at their beginning and their end.
            let at = random(bytes.len() / 4096) * 4096 + [random(120), 4095 - random(1500)][random(2)];
            bytes[at] ^= 1 << random(8);
        }
        fs::write(&path, &bytes).unwrap();
        match to_mcap(&path, &new) {
            Ok(_) => {
                taken += 1;
                fs::remove_dir_all(&new).unwrap();
            }
            Err(_) => left += 1,
        }
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }
    assert!(taken > 20 && left > 20, "{taken} {left}");
}
