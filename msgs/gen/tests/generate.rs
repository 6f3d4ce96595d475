// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the generated code looks like. That it compiles and is right, `tautline-ros-msgs` shows.

use std::io::Write;
use std::process::{Command, Stdio};

use tautline_gen::{GenerateError, Options, generate, messages};
use tautline_schema::Packages;

/// The definitions of all bundled packages.
fn bundled() -> Packages {
    let mut packages = Packages::new();
    packages.add_folder(concat!(env!("CARGO_MANIFEST_DIR"), "/../ros/definitions"));
    packages
}

/// A package in a folder of its own.
fn demo(text: &str) -> (tempfile::TempDir, Packages) {
    let folder = tempfile::tempdir().unwrap();
    let messages = folder.path().join("demo_msgs/msg");
    std::fs::create_dir_all(&messages).unwrap();
    std::fs::write(messages.join("Demo.msg"), text).unwrap();
    let mut packages = Packages::new();
    packages.add_folder(folder.path());
    (folder, packages)
}

#[test]
fn a_message_becomes_a_struct() {
    let text = "uint8 LOST=255\nstring NAME=\"a\\\"b\"\nfloat64[40] many\nuint8 count 1\nstring<=3[<=2] type\nwstring self\n\
                std_msgs/Header header\nint8[3] three [1, 2, -3]\n";
    let (_folder, mut packages) = demo(text);
    packages.add_folder(concat!(env!("CARGO_MANIFEST_DIR"), "/../ros/definitions"));
    let mut options = Options { msgs: "::tautline::msgs".to_owned(), ..Options::default() };
    options.external.insert("std_msgs".to_owned(), "::tautline::std_msgs".to_owned());
    let code = generate(&mut packages, &["demo_msgs"], &options).unwrap();
    for line in [
        "pub const LOST: u8 = 255;",
        "pub const NAME: &'static str = \"a\\\"b\";",
        "#[serde(with = \"::tautline::msgs::serde_fields::float\")]",
        "pub many: [f64; 40],",
        "many: ::core::array::from_fn(|_| ::core::default::Default::default()),",
        "count: 1,",
        "pub type_: ::std::vec::Vec<::std::string::String>,",
        "type_: ::tautline::msgs::cdr::Bounded<::std::vec::Vec<::tautline::msgs::cdr::Bounded<::std::string::String, 3>>, 2>,",
        "#[serde(rename = \"self\")]",
        "pub self_: ::std::string::String,",
        "pub header: ::tautline::std_msgs::msg::Header,",
        "three: [1, 2, -3],",
        "::tautline::msgs::stamped! { Demo }",
    ] {
        assert!(code.lines().any(|found| found.trim() == line), "{line}\n{code}");
    }
}

/// The lines between the definitions of a bag's text are made of 80 `=`, too.
#[test]
fn a_definition_is_whole() {
    let line = "=".repeat(80);
    let text = format!("string LINE=\"{line}\"\nuint8 count 1\nInner inner\n");
    let (folder, mut packages) = demo(&text);
    std::fs::write(folder.path().join("demo_msgs/msg/Inner.msg"), "uint8 x\n").unwrap();
    let code = generate(&mut packages, &["demo_msgs"], &Options::default()).unwrap();
    let definition = format!("{:?},", text.replace("Inner inner", "demo_msgs/Inner inner"));
    assert!(code.lines().any(|found| found.trim() == definition), "{definition}\n{code}");
}

#[test]
fn fields_say_what_they_are_measured_in() {
    let code =
        generate(&mut bundled(), &["builtin_interfaces", "std_msgs", "geometry_msgs"], &Options::default());
    let code = code.unwrap();
    let (_, twist) = code.split_once("pub struct Twist {").unwrap();
    let fields: Vec<_> = twist.lines().map(str::trim).take(5).collect();
    assert_eq!(
        fields,
        [
            "",
            "/// `geometry_msgs/Vector3`, in m/s",
            "pub linear: Vector3,",
            "/// `geometry_msgs/Vector3`, in rad/s",
            "pub angular: Vector3,"
        ]
    );
}

#[test]
fn paths_are_those_of_r2r() {
    let mut packages = bundled();
    let paths: Vec<_> = messages(&mut packages, &["test_msgs", "std_srvs"])
        .unwrap()
        .into_iter()
        .filter(|ty| ["Fibonacci", "SetBool"].iter().any(|name| ty.name.name().starts_with(name)))
        .map(|ty| ty.path)
        .collect();
    let action = "test_msgs::action::Fibonacci::";
    let service = "std_srvs::srv::SetBool::";
    let parts = ["Event", "Request", "Response"];
    let mut expected: Vec<_> = parts.iter().map(|part| format!("{service}{part}")).collect();
    expected.extend(["Feedback", "FeedbackMessage"].map(|part| format!("{action}{part}")));
    expected.extend(parts.iter().map(|part| format!("{action}GetResult::{part}")));
    expected.extend(["Goal", "Result"].map(|part| format!("{action}{part}")));
    expected.extend(parts.iter().map(|part| format!("{action}SendGoal::{part}")));
    expected.sort();
    let mut paths = paths;
    paths.sort();
    assert_eq!(paths, expected);
}

#[test]
fn a_missing_package_is_named() {
    let (_folder, mut packages) = demo("std_msgs/Header header\n");
    packages.add_folder(concat!(env!("CARGO_MANIFEST_DIR"), "/../ros/definitions"));
    let error = generate(&mut packages, &["demo_msgs"], &Options::default()).unwrap_err();
    assert!(matches!(&error, GenerateError::Package { package, .. } if package == "std_msgs"), "{error}");
    let error = generate(&mut packages, &["nothing_msgs"], &Options::default()).unwrap_err();
    assert!(matches!(&error, GenerateError::Empty { .. }), "{error}");
}

/// A doctest or a link in a comment would be one of the user's crate.
#[test]
fn comments_become_text() {
    let text = "uint8 first # the first joint\n# Joint torques, computed as\n#\n#     tau = J.transpose() * wrench\n#\n# ```\n\
                # for j in range(n): print(tau[j])\n# ```\nfloat64[] tau # [Nm] of each\nuint8 a # see https://example.org/a_b\n\
                uint8 b # a std::vector<int>\nuint8 c # ~~~\nuint8 d # ```` of four\nuint8 e # two\n         # lines\n\
                uint8 f # a\u{7}b\u{202e}c\n";
    let (_folder, mut packages) = demo(text);
    let code = generate(&mut packages, &["demo_msgs"], &Options::default()).unwrap();
    let docs = |field: &str| {
        let (above, _) = code.split_once(&format!("pub {field}: ")).unwrap();
        let lines = above.lines().rev().skip(1).map(str::trim).skip_while(|line| line.starts_with("#["));
        let docs = lines.map_while(|line| line.strip_prefix("///")).map(str::trim_start);
        let docs: Vec<_> =
            docs.take_while(|line| !line.starts_with("`u") && !line.starts_with("`f")).collect();
        docs.into_iter().rev().collect::<Vec<_>>()
    };
    assert_eq!(docs("first"), ["the first joint"]);
    assert_eq!(
        docs("tau"),
        [
            "",
            "````text",
            "Joint torques, computed as",
            "",
            "tau = J.transpose() * wrench",
            "",
            "```",
            "for j in range(n): print(tau[j])",
            "```",
            "[Nm] of each",
            "````",
        ]
    );
    assert_eq!(docs("a"), ["", "```text", "see https://example.org/a_b", "```"]);
    assert_eq!(docs("b"), ["", "```text", "a std::vector<int>", "```"]);
    assert_eq!(docs("c"), ["", "```text", "~~~", "```"]);
    assert_eq!(docs("d"), ["", "`````text", "```` of four", "`````"]);
    assert_eq!(docs("e"), ["two", "lines"]);
    assert_eq!(docs("f"), ["a b c"]);
}

/// Names that Rust or generated code uses itself. The program checks that they compile, and keep ROS's names on the wire.
#[test]
fn every_name_of_ros_can_be_generated() {
    let folder = tempfile::tempdir().unwrap();
    let fields = "uint8 gen\nuint8 self\nstring type\nstring crate\nuint8 to_owned\nstring[] default_rest\nuint8 write\n\
                  float64[] loan\nuint8 clone\nuint8 view\nuint8 check\nuint8 sizes\nuint8 reader\nuint8 value\n\
                  float64 lambda\nuint8 in\nuint8 from\nstring async\n";
    for (file, text) in [
        ("name_msgs/msg/Option.msg", fields),
        ("name_msgs/msg/Vec.msg", "Option[] some\nOption none\nuint8 ok 3\n"),
        ("name_msgs/msg/Some.msg", "Box b\nOption[<=2] o\n"),
        ("name_msgs/msg/Box.msg", "String s\nSelf[3] me\nResult[] r\n"),
        ("name_msgs/msg/String.msg", "string data\n"),
        ("name_msgs/msg/Result.msg", "float64 ok\nuint8 err\n"),
        ("name_msgs/msg/Self.msg", "string name\nCopy copy\n"),
        ("name_msgs/msg/Copy.msg", "uint32 n\n"),
        ("name_msgs/msg/Default.msg", "uint8 NAN=1\nfloat32[40] many\n"),
        ("name_msgs/msg/Message.msg", "Default[] all\nClone[] c\n"),
        ("name_msgs/msg/Clone.msg", ""),
        ("name_msgs/srv/Self.srv", "Vec v\n---\nSelf s\n"),
        ("name_msgs/srv/Result.srv", "---\n"),
        ("name_msgs/action/Box.action", "Self s\n---\nString s\n---\nOption o\n"),
        ("ref_msgs/msg/Map.msg", "string id\nMapRef[] parts\n"),
        ("ref_msgs/msg/MapRef.msg", "string map_id\nMapWriter w\n"),
        ("ref_msgs/msg/MapWriter.msg", "MapSizes[2] sizes\n"),
        ("ref_msgs/msg/MapSizes.msg", "string a\nMapRefRef r\n"),
        ("ref_msgs/msg/MapRefRef.msg", "uint8 plain\n"),
        ("async/msg/Maps.msg", "ref_msgs/Map[] maps\nref_msgs/Map one\n"),
    ] {
        let file = folder.path().join(file);
        std::fs::create_dir_all(file.parent().unwrap()).unwrap();
        std::fs::write(file, text).unwrap();
    }
    let mut packages = Packages::new();
    packages.add_folder(folder.path());
    packages.add_folder(concat!(env!("CARGO_MANIFEST_DIR"), "/../ros/definitions"));
    let standard = ["action_msgs", "builtin_interfaces", "service_msgs", "unique_identifier_msgs"];
    let names = [&["name_msgs", "ref_msgs", "async"], &standard[..]].concat();
    let code = generate(&mut packages, &names, &Options::default()).unwrap();
    std::fs::write(folder.path().join("packages.rs"), code).unwrap();
    let program = folder.path().join("names.rs");
    std::fs::write(&program, include_str!("programs/names.rs")).unwrap();
    trybuild::TestCases::new().pass(program);
}

/// rustfmt, without a configuration, finds nothing to change.
#[test]
fn code_is_formatted() {
    let mut packages = bundled();
    let names = packages.list();
    let names: Vec<_> = names.iter().map(|name| name.package()).collect();
    let code = generate(&mut packages, &names, &Options::default()).unwrap();
    let mut command = Command::new("rustfmt");
    command.args(["--edition", "2024", "--config-path", "/dev/null"]);
    command.stdin(Stdio::piped()).stdout(Stdio::piped());
    let Ok(mut rustfmt) = command.spawn() else {
        assert!(std::env::var_os("CI").is_none(), "CI needs rustfmt");
        eprintln!("skipped: no rustfmt");
        return;
    };
    let mut input = rustfmt.stdin.take().unwrap();
    let sent = code.clone();
    let writer = std::thread::spawn(move || input.write_all(sent.as_bytes()).unwrap());
    let output = rustfmt.wait_with_output().unwrap();
    writer.join().unwrap();
    let formatted = String::from_utf8(output.stdout).unwrap();
    assert!(output.status.success());
    let differs = code.lines().zip(formatted.lines()).enumerate().find(|(_, (ours, theirs))| ours != theirs);
    assert_eq!(differs, None);
    assert_eq!(code.len(), formatted.len());
}
