// SPDX-License-Identifier: MIT OR Apache-2.0
//! What other programs write into MCAP files is in the bags that are made of them: topics of any encoding, with and without messages,
//! attachments and metadata. The files are written and read with the `mcap` crate.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::path::{Path, PathBuf};
use tautline_bag::{
    BagError, Converted, Hooks, Options, Storage, Writer, convert, files_of, is_being_written, recover,
};

/// A list of QoS profiles by numbers, as rosbag2 wrote it before Iron; and what only looks like YAML's content.
const OLD_QOS: &str = "- history: 1\n  depth: 7\n  reliability: 1\n  durability: 1\n  deadline: {sec: 0, nsec: 0}\n  lifespan: {sec: 0, nsec: \
                       0}\n  liveliness: 1\n  liveliness_lease_duration: {sec: 0, nsec: 0}\n  avoid_ros_namespace_conventions: false\n";
const HOSTILE_QOS: &str = "[]\n        type_description_hash: x\n  message_count: 9999\n- [";

/// Topic, encoding and metadata; the schema's name, encoding and content.
type Channel = (String, String, BTreeMap<String, String>, String, String, Vec<u8>);

/// What is in a file.
#[derive(Debug, PartialEq)]
struct Content {
    channels: Vec<Channel>,
    messages: Vec<(String, u32, u64, u64, Vec<u8>)>,
    attachments: Vec<(String, String, u64, u64, Vec<u8>)>,
    metadata: Vec<(String, BTreeMap<String, String>)>,
}

fn content(path: &Path) -> Content {
    let bytes = fs::read(path).unwrap();
    let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
    let channel = |channel: &mcap::Channel<'_>| {
        let (name, encoding, data) = match &channel.schema {
            Some(schema) => (schema.name.clone(), schema.encoding.clone(), schema.data.to_vec()),
            None => Default::default(),
        };
        let (topic, of_message) = (channel.topic.clone(), channel.message_encoding.clone());
        (topic, of_message, channel.metadata.clone(), name, encoding, data)
    };
    let mut channels: Vec<_> = summary.channels.values().map(|known| channel(known)).collect();
    channels.sort();
    let messages = mcap::MessageStream::new(&bytes).unwrap().map(|message| {
        let message = message.unwrap();
        let (sequence, log, publish) = (message.sequence, message.log_time, message.publish_time);
        (message.channel.topic.clone(), sequence, log, publish, message.data.to_vec())
    });
    let attachments = summary.attachment_indexes.iter().map(|index| {
        let found = mcap::read::attachment(&bytes, index).unwrap();
        (found.name, found.media_type, found.log_time, found.create_time, found.data.to_vec())
    });
    let metadata = summary.metadata_indexes.iter().map(|index| {
        let found = mcap::read::metadata(&bytes, index).unwrap();
        (found.name, found.metadata)
    });
    Content {
        channels,
        messages: messages.collect(),
        attachments: attachments.collect(),
        metadata: metadata.collect(),
    }
}

/// As a program writes it that knows neither ROS nor Tautline.
fn write(path: &Path) {
    let options = mcap::WriteOptions::new().compression(None).profile("");
    let mut writer = options.create(File::create(path).unwrap()).unwrap();
    let text = |pairs: &[(&str, &str)]| -> BTreeMap<String, String> {
        pairs.iter().map(|(key, value)| ((*key).to_owned(), (*value).to_owned())).collect()
    };
    let mut channels = Vec::new();
    for (topic, encoding, schema, metadata) in [
        (
            "/speed",
            "cdr",
            Some(("std_msgs/msg/Float64", "ros2msg", &b"float64 data\n"[..])),
            text(&[("offered_qos_profiles", OLD_QOS)]),
        ),
        (
            "/log",
            "json",
            Some(("foxglove.Log", "jsonschema", b"{}")),
            text(&[("offered_qos_profiles", HOSTILE_QOS)]),
        ),
        ("/pose", "protobuf", Some(("demo.Pose", "protobuf", b"\x00\xff\x80")), text(&[("vendor", "acme")])),
        ("/raw", "application/octet-stream", None, text(&[])),
        ("/idl", "cdr", Some(("demo_msgs/msg/Idl", "ros2idl", b"module demo_msgs {};")), text(&[])),
        (
            "/silent",
            "cdr",
            Some(("std_msgs/msg/Float64", "ros2msg", b"float64 data\n")),
            text(&[("offered_qos_profiles", OLD_QOS)]),
        ),
    ] {
        let schema =
            schema.map_or(0, |(name, encoding, data)| writer.add_schema(name, encoding, data).unwrap());
        channels.push(writer.add_channel(schema, topic, encoding, &metadata).unwrap());
    }
    let attachment = mcap::Attachment {
        log_time: 5,
        create_time: 4,
        name: "calibration.yaml".to_owned(),
        media_type: "application/yaml".to_owned(),
        data: b"fx: 1.0\n"[..].into(),
    };
    writer.attach(&attachment).unwrap();
    let record =
        mcap::records::Metadata { name: "mission".to_owned(), metadata: text(&[("operator", "kim")]) };
    writer.write_metadata(&record).unwrap();
    for n in 0..10_u32 {
        for channel in &channels[..channels.len() - 1] {
            let (log_time, publish_time) = (1_000 + u64::from(n), u64::from(n));
            let header =
                mcap::records::MessageHeader { channel_id: *channel, sequence: n, log_time, publish_time };
            writer.write_to_known_channel(&header, &[0, 1, 0, 0, n as u8, 1, 2, 3, 4, 5, 6, 7]).unwrap();
        }
    }
    writer.finish().unwrap();
}

fn as_it_is(bags: &[PathBuf], to: &Path, storage: Storage) -> Result<Converted, BagError> {
    convert(bags, to, storage, Options::default(), Hooks::default())
}

/// Without its end, as a killed process leaves it.
fn cut(path: &Path) {
    let whole = fs::read(path).unwrap();
    fs::write(path, &whole[..whole.len() - 40]).unwrap();
}

#[test]
fn what_other_programs_wrote_is_kept() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    write(&path("in.mcap"));
    let wanted = content(&path("in.mcap"));
    let converted = as_it_is(&[path("in.mcap")], &path("new"), Storage::Mcap).unwrap();
    assert_eq!((converted.notes, content(&converted.files[0].path)), (Vec::new(), content(&path("in.mcap"))));
    cut(&path("in.mcap"));
    recover(&path("in.mcap"), &mut |_| {}).unwrap();
    assert_eq!(content(&path("in.mcap")), wanted);
    // Two of the same are one with each message twice.
    let both = as_it_is(&[path("in.mcap"), path("new")], &path("both"), Storage::Mcap).unwrap();
    let both = content(&both.files[0].path);
    assert_eq!((&both.channels, &both.metadata), (&wanted.channels, &wanted.metadata));
    assert_eq!((both.messages.len(), both.attachments.len()), (100, 2));
}

#[test]
fn what_sqlite_has_no_place_for_is_refused_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    write(&path("in.mcap"));
    let refused = |wants: fn(&str) -> bool| {
        let hooks = Hooks { wants: Box::new(move |topic| wants(&topic.name)), ..Hooks::default() };
        let bags = [path("in.mcap")];
        let error = convert(&bags, &path("db"), Storage::Sqlite3, Options::default(), hooks).unwrap_err();
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1, "nothing is left");
        error.to_string()
    };
    let fix = "cannot be kept in sqlite3; --storage mcap keeps it";
    assert_eq!(refused(|_| false), format!("the attachment 'calibration.yaml' {fix}"));
    assert_eq!(refused(|topic| topic == "/pose"), format!("the metadata 'vendor' of /pose {fix}"));
}

/// The profiles of `metadata.yaml` are those of version 9, whatever a channel says.
#[test]
fn no_text_of_a_channel_reaches_metadata_yaml_as_it_is() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    fs::create_dir(path("bag")).unwrap();
    write(&path("bag/bag_0.mcap"));
    as_it_is(&[path("bag")], &path("new"), Storage::Mcap).unwrap();
    recover(&path("bag"), &mut |_| {}).unwrap();
    for bag in ["bag", "new"] {
        let yaml = fs::read_to_string(path(bag).join("metadata.yaml")).unwrap();
        assert!(!yaml.contains("9999") && !yaml.contains("history: 1"), "{yaml}");
        assert_eq!(yaml.matches("- history: keep_last\n").count(), 2, "{yaml}");
        assert!(
            yaml.contains(
                "name: \"/log\"\n        type: \"foxglove.Log\"\n        serialization_format: \"json\""
            ),
            "{yaml}"
        );
        assert!(yaml.contains("  message_count: 50\n"), "{yaml}");
    }
}

#[test]
fn each_original_is_kept_and_nobody_recovers_what_is_written() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    write(&path("in.mcap"));
    let mut originals = Vec::new();
    for end in ["mcap.damaged", "mcap.damaged.1", "mcap.damaged.2"] {
        cut(&path("in.mcap"));
        originals.push((path(&format!("in.{end}")), fs::read(path("in.mcap")).unwrap()));
        let recovered = recover(&path("in.mcap"), &mut |_| {}).unwrap();
        assert_eq!(recovered[0].before.as_ref(), Some(&originals.last().unwrap().0));
        for (path, bytes) in &originals {
            assert!(fs::read(path).unwrap() == *bytes, "{}", path.display());
        }
    }
    let busy = |bag: &Path| {
        let error = recover(bag, &mut |_| panic!("nothing is read")).unwrap_err();
        assert!(matches!(error, BagError::Busy { .. }), "{error}");
        is_being_written(&files_of(bag).unwrap()[0]).unwrap()
    };
    // By our own recorder, and by any other program.
    let writer = Writer::create(&path("bag"), Options::default(), BTreeMap::new()).unwrap();
    assert!(busy(&path("bag")));
    assert!(busy(&path("bag/bag_0.mcap")));
    writer.finish(BTreeMap::new()).unwrap();
    assert!(!is_being_written(&path("bag/bag_0.mcap")).unwrap());
    let other = File::options().append(true).open(path("in.mcap")).unwrap();
    assert!(busy(&path("in.mcap")));
    drop(other);
    assert!(recover(&path("in.mcap"), &mut |_| {}).unwrap()[0].damage.is_empty());
}

/// A file without a summary is complete all the same.
#[test]
fn files_without_a_summary_are_whole() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("in.mcap");
    let options =
        mcap::WriteOptions::new().compression(None).emit_summary_records(false).emit_summary_offsets(false);
    let mut writer = options.create(File::create(&path).unwrap()).unwrap();
    let channel = writer.add_channel(0, "/raw", "raw", &BTreeMap::new()).unwrap();
    let header =
        mcap::records::MessageHeader { channel_id: channel, sequence: 1, log_time: 2, publish_time: 3 };
    writer.write_to_known_channel(&header, b"some").unwrap();
    writer.finish().unwrap();
    drop(writer);
    assert!(tautline_bag::index_of(&path).unwrap().is_none());
    let recovered = recover(&path, &mut |_| {}).unwrap().remove(0);
    assert_eq!((recovered.damage, recovered.summary.messages), (Vec::new(), 1));
}
