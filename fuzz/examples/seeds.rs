// SPDX-License-Identifier: MIT OR Apache-2.0
//! Writes the corpus anew, a few inputs for each target from which libFuzzer starts:
//! `cargo run -p tautline-fuzz --example seeds`.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::{fs, io};

use rand::SeedableRng;
use rand::rngs::StdRng;
use tautline_bag::{Attachment, BagError, Compression, Definition, Options, Stamp, Topic, Writer};
use tautline_schema::{DynamicMessage, HashedTypeDescription, Packages, Schema};

#[path = "../../msgs/ros/tests/values/random.rs"]
mod random;

/// Types with every kind of field, and those that are sent most.
const TYPES: [&str; 22] = [
    "std_msgs/msg/Header",
    "geometry_msgs/msg/Twist",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "sensor_msgs/msg/Image",
    "sensor_msgs/msg/PointCloud2",
    "sensor_msgs/msg/JointState",
    "sensor_msgs/msg/LaserScan",
    "sensor_msgs/msg/BatteryState",
    "nav_msgs/msg/OccupancyGrid",
    "tf2_msgs/msg/TFMessage",
    "visualization_msgs/msg/Marker",
    "diagnostic_msgs/msg/DiagnosticArray",
    "rcl_interfaces/msg/ParameterEvent",
    "std_srvs/srv/SetBool_Event",
    "test_msgs/action/Fibonacci_SendGoal_Request",
    "test_msgs/msg/BasicTypes",
    "test_msgs/msg/Arrays",
    "test_msgs/msg/BoundedSequences",
    "test_msgs/msg/UnboundedSequences",
    "test_msgs/msg/Strings",
    "test_msgs/msg/WStrings",
    "test_msgs/msg/Empty",
];

const DEFINITION: &str = "# Docs\nint32 x 5 # beside\nuint8 A=0x1F\nstring<=9 B=\"a\\\"b\"\nfloat64[<=3] f [1.5, -2e3]\n\
    string[] s ['a', \"b,c\"]\nbool[2] b [true, 0]\nwstring<=4[3] w\nInner[2] inner\nbyte y 7\nchar c\nInner[] more\n";
const NESTED: &str = "================\nMSG: demo_msgs/Inner\nLeaf leaf\nfloat32[] n\nuint64 u\n================\n\
    MSG: demo_msgs/Leaf\nstring name\nwstring wide\nbool ok\nint16[3] i\nEmpty e\n================\nMSG: demo_msgs/Empty\n";

/// YAML that no message is written as.
const YAML: [(&str, &str, &str); 4] = [
    ("anchors", "geometry_msgs/msg/Twist", "linear: &a {x: 1, y: .inf, z: -0.0}\nangular: *a\n"),
    ("blocks", "std_msgs/msg/Header", "stamp: {sec: 0x10, nanosec: 1_000}\nframe_id: |-\n  two\n  lines\n"),
    ("quotes", "std_msgs/msg/Header", "frame_id: \"\\u00e9\\x41\\n\"\n"),
    ("tags", "sensor_msgs/msg/JointState", "name: [!!str 1, 'yes', ~]\nposition:\n- .nan\n- 1e-3\n- 0o17\n"),
];

fn main() -> io::Result<()> {
    let corpus = Path::new(env!("CARGO_MANIFEST_DIR")).join("corpus");
    let write = |target: &str, name: &str, parts: &[&[u8]]| {
        let folder = corpus.join(target);
        fs::create_dir_all(&folder)?;
        fs::write(folder.join(name), parts.concat())
    };
    let mut packages = Packages::new();
    packages.add_folder(concat!(env!("CARGO_MANIFEST_DIR"), "/../msgs/ros/definitions"));
    let mut rng = StdRng::seed_from_u64(1);
    let names = fuzz::type_names();
    let choice = |name: &str| {
        let index = names
            .iter()
            .position(|listed| *listed == name)
            .unwrap_or_else(|| panic!("{name} is not bundled"));
        (index as u16).to_le_bytes()
    };

    for name in TYPES {
        let schema = packages.schema(&name.parse().expect("a type's name")).expect("a valid definition");
        let schema = Arc::new(schema);
        let file = name.replace('/', "-");
        let body = (0..100)
            .map(|_| random::message(&mut rng, &schema).to_body())
            .find(|body| body.len() < 1000)
            .unwrap_or_else(|| DynamicMessage::new(&schema).to_body());
        let message = DynamicMessage::from_body(&schema, &body, tautline_schema::Endian::Little);
        let message = message.expect("just encoded");
        for target in ["owned", "view"] {
            write(target, &file, &[&choice(name), &[0], &body])?;
        }
        // The lengths of the value, and others.
        write("fill", &file, &[&choice(name), &[2, 0], &body])?;
        write("fill", &format!("{file}-lengths"), &[&choice(name), &[1, 4, 70, 0, 193, 224], &body])?;
        write("dynamic", &file, &[&choice(name), &[0], &body])?;
        write("json", &file, &[&choice(name), &[0], message.to_json().as_bytes()])?;
        write("yaml", &file, &[&choice(name), &[0], message.to_string().as_bytes()])?;
    }
    for (file, name, text) in YAML {
        write("yaml", file, &[&choice(name), &[0], text.as_bytes()])?;
    }

    let bundle = format!("{DEFINITION}{NESTED}");
    let schema = Schema::from_text(&"demo_msgs/msg/Demo".parse().expect("a type's name"), &bundle);
    let schema = Arc::new(schema.expect("a valid definition"));
    let body = random::message(&mut rng, &schema).to_body();
    write("dynamic", "definition", &[&[0, 0, 2], bundle.as_bytes(), &[0], &body])?;
    let description = HashedTypeDescription::from(&*schema).to_json();
    for (file, kind, text) in [
        ("message", 0, DEFINITION.to_owned()),
        ("service", 1, format!("{DEFINITION}---\nint8 x\n")),
        ("action", 2, format!("{DEFINITION}---\nint8 x\n---\nfloat32 y\n")),
        ("bundle", 3, bundle.clone()),
        (
            "bundle-known",
            3,
            "std_msgs/Header h\n===\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\n".to_owned(),
        ),
        ("recursive", 3, "A a\n===\nMSG: demo_msgs/A\nB[] b\n===\nMSG: demo_msgs/B\nA a\n".to_owned()),
        ("description", 4, description),
    ] {
        write("schema", file, &[&[kind], text.as_bytes()])?;
    }

    let padded = [1, 0, 0, 0, 0, 0, 0, 0x80, 7, 0, 0, 0, 65, 0, 0, 0, 0xff, 0xff, 0x10, 0, 0, 0, 0, 0];
    let end = [1, 2, 3, 4, 5, 6, 7, 8, 1];
    for (kind, file) in ["outer", "inner", "padded", "numbers"].into_iter().enumerate() {
        write("plain", file, &[&[kind as u8, 0, 0], &padded, &end, &[0; 16]])?;
        write("plain", &format!("{file}-zeros"), &[&[kind as u8, 0, 1], &[0; 48]])?;
    }
    write("plain", "padded-exact", &[&[2, 0, 0], &padded, &end])?;
    write("plain", "inner-exact", &[&[1, 0, 0, 65, 0, 0, 0, 1, 0, 255]])?;

    let string = "std_msgs::msg::dds_::String_/\
                  RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18";
    let endpoint = format!("@ros2_lv/7/a1b2/3/11/MP/%/%robot/talker/%robot%chatter/{string}");
    for (file, kind, text) in [
        ("node", 0, "@ros2_lv/7/a1b2/3/3/NN/%/%robot/talker".to_owned()),
        ("publisher", 0, format!("{endpoint}/2:1:2,5:1,0:0,500000000:1,0:9223372036,854775807")),
        ("defaults", 0, format!("{endpoint}/::,10:,:,:,,")),
        ("key", 1, format!("7/robot/chatter/{string}")),
        ("qos", 2, "1:2:1,42:,:,:,,".to_owned()),
    ] {
        write("wire", file, &[&[kind], text.as_bytes()])?;
    }
    let (number, stamp_ns) = (7_i64.to_le_bytes(), 1_700_000_000_000_000_000_i64.to_le_bytes());
    write("wire", "attachment", &[&[3], &number, &stamp_ns, &[16], &[5; 16]])?;
    write("wire", "payload", &[&[3], &[0, 1, 0, 0, 65, 0, 0, 0]])?;

    for (file, text) in [
        ("hosts", include_str!("../../examples/systems/two-hosts.toml")),
        ("reserved", include_str!("../../examples/systems/reserved.toml")),
        ("fusion", include_str!("../../examples/systems/fusion.toml")),
    ] {
        write("system", file, &[&[0], text.as_bytes()])?;
    }
    // Pieces: a host, a node, two callbacks that trigger each other.
    write("system", "pieces", &[&[1, 12, 14, 19, 25, 21, 29, 34, 36, 46, 22, 29, 36, 49]])?;

    let folder = tempfile::tempdir()?;
    for compression in [Compression::None, Compression::Zstd, Compression::Lz4] {
        let name = format!("{compression:?}").to_lowercase();
        let file = bag(&folder.path().join(&name), compression).expect("there is room");
        write("bag", &name, &[&fs::read(file)?])?;
    }
    Ok(())
}

/// Two topics, two chunks.
fn bag(folder: &Path, compression: Compression) -> Result<PathBuf, BagError> {
    let session = BTreeMap::from([("host".to_owned(), "seed".to_owned())]);
    let mut writer = Writer::create(folder, Options { compression, ..Options::default() }, session.clone())?;
    let mut topics = Vec::new();
    for name in ["/one", "/two"] {
        let (name, type_name) = (name.to_owned(), "std_msgs/msg/String".to_owned());
        let definition = Some(Definition::ros2msg("string data\n"));
        topics.push(writer.add_topic(Topic { name, type_name, definition, ..Topic::default() })?);
    }
    let (name, media_type, data) = ("notes.txt".to_owned(), "text/plain".to_owned(), b"some"[..].into());
    writer.attach(&Attachment { name, media_type, log_ns: 1, create_ns: 0, data })?;
    for n in 0..8 {
        let stamp = Stamp { sequence: n, log_ns: u64::from(n) * 1000, publish_ns: u64::from(n) };
        writer.write(topics[n as usize % 2], stamp, &[0, 1, 0, 0, 2, 0, 0, 0, b'a', 0])?;
        if n == 3 {
            writer.flush()?;
        }
    }
    Ok(writer.finish(session)?.files.remove(0).path)
}
