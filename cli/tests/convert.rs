// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut bag convert` beside rosbags: bags of every storage and compression that it writes become bags in which it reads the same.

#[path = "support/schemas.rs"]
mod schemas;

#[path = "../../msgs/schema/tests/support/mod.rs"]
#[allow(dead_code, reason = "definitions of ROS are not used here")]
mod ros;

use schemas::{Checked, ended};
use serde_json::Value;
use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::fs;
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};
use std::process::Command;
use tautline_bag::{Compression, Options, Stamp, Topic, Writer, files_of, index_of};
use tempfile::TempDir;

struct Place(TempDir);

impl Place {
    fn new() -> Self {
        Place(tempfile::tempdir().unwrap())
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn taut(&self, args: &[&str]) -> (i32, String, String) {
        let mut command = Command::new(env!("CARGO_BIN_EXE_taut"));
        command.args(args).current_dir(self.0.path()).env("TAUT_DOMAIN", "95").env_remove("RUST_LOG");
        ended(command.checked())
    }

    fn convert(&self, args: &[&str]) -> Value {
        let (code, out, errors) = self.taut(&[&["bag", "convert", "--json"], args].concat());
        assert_eq!(code, 0, "{args:?}: {errors}");
        serde_json::from_str(&out).unwrap()
    }

    fn python(&self, venv: &Path, args: &[&str]) -> String {
        let mut script = Command::new(venv.join("bin/python"));
        script.arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/bag_kinds.py")).args(args);
        let output = script.current_dir(self.0.path()).env_remove("LD_LIBRARY_PATH").output().unwrap();
        assert!(output.status.success(), "{args:?}: {output:?}");
        String::from_utf8(output.stdout).unwrap()
    }

    fn names(&self) -> Vec<String> {
        let entries = fs::read_dir(self.0.path()).unwrap();
        let mut names: Vec<_> =
            entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }
}

#[test]
fn others_read_the_same() {
    let Some(venv) = ros::ros() else { return };
    let place = Place::new();
    let kinds = place.python(&venv, &["write", "."]);
    let kinds: Vec<_> = kinds.lines().collect();
    assert_eq!(kinds.len(), 14, "{kinds:?}");
    for (n, kind) in kinds.iter().enumerate() {
        let same =
            |other: &str| assert_eq!(place.python(&venv, &["same", kind, other]), "300\n", "{kind} {other}");
        let compression = ["none", "zstd", "lz4"][n % 3];
        let report = place.convert(&[kind, "-o", "mcap", "--compression", compression]);
        assert_eq!(
            (&report["messages"], &report["notes"]),
            (&300.into(), &Value::Array(Vec::new())),
            "{report}"
        );
        same("mcap");
        let (code, out, errors) = place.taut(&["bag", "check", "mcap"]);
        assert!(code == 0 && out.contains("/ns/imu") && out.contains("/scan"), "{out}{errors}");
        let compression = ["none", "zstd"][n % 2];
        let report = place.convert(&[kind, "-o", "db", "--storage", "sqlite3", "--compression", compression]);
        assert_eq!(
            (&report["messages"], &report["notes"]),
            (&300.into(), &Value::Array(Vec::new())),
            "{report}"
        );
        same("db");
        // And back again, from what is converted of it.
        place.convert(&["db", "-o", "back"]);
        same("back");
        place.convert(&["mcap", "-o", "forth", "--storage", "sqlite3", "--max-size", "100kB"]);
        same("forth");
        let described = fs::read_to_string(place.path("db/metadata.yaml")).unwrap();
        assert!(described.contains("\"robot\": \"number 5\""), "{described}");
        for made in ["mcap", "db", "back", "forth"] {
            fs::remove_dir_all(place.path(made)).unwrap();
        }
        // What our other verbs cannot read says what can; so does a file of it.
        if kind.ends_with("mcap_message") {
            let (_, _, errors) = place.taut(&["bag", "plot", kind, "/ns/imu.linear_acceleration.x"]);
            assert!(errors.contains("`taut bag convert` decompresses the bag"), "{errors}");
        }
        let is_readable = kind.contains("mcap") && !kind.contains("_file");
        if !is_readable {
            let file = fs::read_dir(place.path(kind)).unwrap().map(|entry| entry.unwrap().path());
            let file = file.into_iter().find(|path| path.extension().unwrap() != "yaml").unwrap();
            for bag in [*kind, file.to_str().unwrap()] {
                for verb in [&["bag", "info"][..], &["bag", "check"], &["play"]] {
                    let (code, _, errors) = place.taut(&[verb, &[bag]].concat());
                    let fix = format!("`taut bag convert {bag} -o NEW`");
                    assert!(code == 2 && errors.contains(&fix), "{verb:?} {bag}: {errors}");
                }
            }
        }
    }
}

#[test]
fn definitions_that_a_bag_has_not_are_those_that_are_known() {
    let place = Place::new();
    let mut writer = Writer::create(&place.path("bag"), Options::default(), BTreeMap::new()).unwrap();
    let string = "std_msgs/msg/String";
    // The second one's messages are of another definition, whatever it was.
    for (n, (name, type_name, body)) in [
        ("/known", string, &[2, 0, 0, 0, b'a', 0, 0, 0][..]),
        ("/changed", "std_msgs/msg/Float64", &[0; 24]),
        ("/unknown", "demo_msgs/msg/None", &[0; 4]),
    ]
    .into_iter()
    .enumerate()
    {
        let (name, type_name) = (name.to_owned(), type_name.to_owned());
        let id = writer.add_topic(Topic { name, type_name, ..Topic::default() }).unwrap();
        let stamp = Stamp { sequence: 0, log_ns: 5 + n as u64, publish_ns: 5 + n as u64 };
        writer.write(id, stamp, &[&[0, 1, 0, 0], body].concat()).unwrap();
    }
    writer.finish(BTreeMap::new()).unwrap();
    let report = place.convert(&["bag", "-o", "new"]);
    assert_eq!(
        report["notes"],
        serde_json::json!([
            "/changed: the definition of std_msgs/msg/Float64 is not known",
            "/unknown: the definition of demo_msgs/msg/None is not known"
        ])
    );
    let mut bag = tautline_bag::Ordered::open(&place.path("new"), &mut |_| {}).unwrap();
    let topic = bag.topics().iter().find(|topic| topic.name == "/known").unwrap();
    assert!(topic.ros2msg().unwrap().contains("string data"));
    assert_eq!(bag.next_message().unwrap().unwrap().stamp.log_ns, 5);
}

#[test]
fn what_is_refused_leaves_nothing() {
    let place = Place::new();
    let mut writer = Writer::create(
        &place.path("bag"),
        Options { compression: Compression::Zstd, ..Options::default() },
        BTreeMap::new(),
    )
    .unwrap();
    let topic = Topic { name: "/a".into(), type_name: "std_msgs/msg/Empty".into(), ..Topic::default() };
    let id = writer.add_topic(topic).unwrap();
    writer.write(id, Stamp { sequence: 1, log_ns: 9, publish_ns: 8 }, &[0, 1, 0, 0, 0]).unwrap();
    writer.finish(BTreeMap::new()).unwrap();
    fs::write(place.path("text.db3"), "SQLite it is not").unwrap();
    fs::create_dir(place.path("empty")).unwrap();
    let before = place.names();
    for (args, words) in [
        (&["none", "-o", "new"][..], "'none' cannot be read"),
        (&["text.db3", "-o", "new"], "'text.db3' is not a bag: it begins neither as MCAP nor as SQLite"),
        (&["empty", "-o", "new"], "there is neither metadata.yaml nor a .mcap or .db3 file in it"),
        (&["bag", "text.db3", "-o", "new"], "'text.db3' is not a bag"),
        (&["bag", "-o", "empty"], "'empty' exists already; choose another folder with -o, or remove it"),
        (&["bag", "-o", "new", "--storage", "sqlite3", "--compression", "lz4"], "with zstd alone"),
        (&["bag", "-o", "/proc/none/new"], "cannot be written"),
        (&["bag", "-o", "new", "--storage", "rosbag1"], "invalid value 'rosbag1'"),
        (&["bag", "-o", "new", "--domain", "3"], "a bag is of no domain"),
    ] {
        let (code, out, errors) = place.taut(&[&["bag", "convert"], args].concat());
        assert!(code == 2 && errors.contains(words) && out.is_empty(), "{args:?}: {code} {errors}");
        assert_eq!(place.names(), before, "{args:?}");
    }
    let (code, _, errors) = place.taut(&["bag", "convert", "bag", "-o", "new", "--timeout", "1ns"]);
    assert!(code == 1 && errors.contains("not done after 1ns; nothing is left of it"), "{errors}");
    assert_eq!(place.names(), before);
    // What is damaged is taken as far as it is whole, as by the other verbs.
    let file = place.path("bag/bag_0.mcap");
    let whole = fs::read(&file).unwrap();
    fs::write(&file, &whole[..whole.len() - 10]).unwrap();
    let (code, out, errors) = place.taut(&["bag", "convert", "bag", "-o", "new", "--storage", "sqlite3"]);
    assert!(
        code == 1 && out.contains("1 messages in 1 file") && errors.contains("what is whole was taken"),
        "{out}{errors}"
    );
    assert!(errors.contains("1 messages lose their time of publication and sequence number"), "{errors}");
}

#[test]
fn a_path_that_is_no_utf_8_is_printed_as_json() {
    let place = Place::new();
    let bag = place.0.path().join(OsStr::from_bytes(b"b\xffg"));
    Writer::create(&bag, Options::default(), BTreeMap::new()).unwrap().finish(BTreeMap::new()).unwrap();
    let file = files_of(&bag).unwrap().remove(0);
    let whole = fs::read(&file).unwrap();
    fs::write(&file, &whole[..whole.len() - 10]).unwrap();
    for verb in ["check", "recover"] {
        let mut command = Command::new(env!("CARGO_BIN_EXE_taut"));
        let output = command.args(["bag", verb, "--json"]).arg(&bag).env_remove("RUST_LOG").checked();
        assert!(String::from_utf8_lossy(&output.stdout).contains("b\u{fffd}g"), "{verb}: {output:?}");
    }
}

#[test]
fn a_description_that_cannot_be_read_is_no_whole_bag() {
    let place = Place::new();
    let writer = Writer::create(&place.path("bag"), Options::default(), BTreeMap::new()).unwrap();
    writer.finish(BTreeMap::new()).unwrap();
    assert_eq!(place.taut(&["bag", "check", "bag"]).0, 0);
    fs::write(place.path("bag/metadata.yaml"), "rosbag2_bagfile_information: [").unwrap();
    let (code, _, errors) = place.taut(&["bag", "check", "bag"]);
    assert!(code == 1 && errors.contains("'bag/metadata.yaml' is not a bag: "), "{code}: {errors}");
    assert_eq!(place.taut(&["bag", "recover", "bag"]).0, 0);
    assert_eq!(place.taut(&["bag", "check", "bag"]).0, 0);
}

/// Also where it is the head of a record that the disk cannot read: what is in front of that is kept.
#[test]
fn what_is_before_a_bad_sector_is_recovered() {
    let place = Place::new();
    let [source, library] = ["bad.c", "bad.so"].map(|name| place.path(name));
    fs::write(&source, BAD_SECTOR).unwrap();
    let compiled =
        Command::new("cc").args(["-shared", "-fPIC", "-O1", "-o"]).args([&library, &source]).status();
    assert!(compiled.unwrap().success(), "cc is needed");
    let mut writer = Writer::create(&place.path("bag"), Options::default(), BTreeMap::new()).unwrap();
    let topic = Topic { name: "/a".into(), type_name: "std_msgs/msg/Empty".into(), ..Topic::default() };
    let id = writer.add_topic(topic).unwrap();
    for n in 0..500 {
        writer.write(id, Stamp { sequence: n, log_ns: 9, publish_ns: 8 }, &[0, 1, 0, 0, 0]).unwrap();
        writer.flush().unwrap();
    }
    writer.finish(BTreeMap::new()).unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_taut"));
    command.args(["bag", "recover", "bag"]).current_dir(place.0.path()).env("LD_PRELOAD", &library);
    let output = command.output().unwrap();
    let out = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success() && out.contains("the disk cannot read it"), "{output:?}");
    let (summary, _) = index_of(&place.path("bag/bag_0.mcap")).unwrap().unwrap();
    assert!((10..500).contains(&summary.messages), "{out}");
}

/// A sector of each longer file, longer than a chunk and its index.
const BAD_SECTOR: &str = r#"
#include <errno.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/types.h>
#include <unistd.h>
ssize_t pread64(int fd, void *bytes, size_t length, off_t offset) {
    struct stat file;
    if (fstat(fd, &file) == 0 && file.st_size > 16384 && offset < 8704 && offset + (off_t)length > 8192) {
        errno = EIO;
        return -1;
    }
    return syscall(SYS_pread64, fd, bytes, length, offset);
}
ssize_t pread(int fd, void *bytes, size_t length, off_t offset) {
    return pread64(fd, bytes, length, offset);
}
"#;
