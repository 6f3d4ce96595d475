// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut interface`: types of folders, of the program, and of a domain.

mod support;

use serde_json::json;
use std::fs;
use support::{Here, said};
use tautline::{Message, Qos};

/// Known to nobody but the domain.
#[derive(Message, Clone, Copy)]
#[repr(C)]
#[message(name = "own_msgs/msg/Spot")]
struct Spot {
    x: f64,
    labels: [u8; 3],
}

#[test]
fn types_are_listed_and_shown() {
    let here = Here::new(66);
    let mut node = here.node("owner", "");
    let _publisher = node.create_publisher::<Spot>("/spot", Qos::default()).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().to_str().unwrap();
    for (file, text) in [
        ("my_msgs/msg/Place.msg", "# Where it is\nstd_msgs/Header header\n# In m\nfloat64 x 1.5\n"),
        ("my_msgs/srv/Find.srv", "string name\n---\nPlace place\n"),
    ] {
        let file = folder.path().join(file);
        fs::create_dir_all(file.parent().unwrap()).unwrap();
        fs::write(file, text).unwrap();
    }
    let taut = |args: &[&str]| here.taut(&[&["interface", "--path", path], args].concat());

    assert_eq!(taut(&["package", "my_msgs"]), "my_msgs/msg/Place\nmy_msgs/srv/Find\n");
    assert_eq!(taut(&["package", "own_msgs"]), "own_msgs/msg/Spot\n");
    let listed = taut(&["list"]);
    for (title, line) in [
        ("Messages:", "    std_msgs/msg/String"),
        ("Messages:", "    own_msgs/msg/Spot"),
        ("Services:", "    my_msgs/srv/Find"),
        ("Actions:", "    example_interfaces/action/Fibonacci"),
    ] {
        let section = listed.split_once(&format!("{title}\n")).unwrap().1;
        let section = section.lines().take_while(|line| line.starts_with("    "));
        assert!(section.into_iter().any(|other| other == line), "{title} {line}:\n{listed}");
    }
    assert!(!taut(&["list", "--only", "actions"]).contains("/msg/"));
    let packages = here.json(&["interface", "packages", "--path", path, "--only", "srvs"]);
    assert!(packages.as_array().unwrap().contains(&json!("my_msgs")), "{packages}");

    let header = "std_msgs/Header header\n\tbuiltin_interfaces/Time stamp\n\t\tint32 sec\n\t\tuint32 nanosec\n\tstring frame_id\n";
    let place = format!("# Where it is\n{header}# In m\nfloat64 x 1.5\n");
    assert_eq!(taut(&["show", "my_msgs/Place"]), place);
    assert_eq!(taut(&["show", "--no-comments", "my_msgs/msg/Place"]), format!("{header}float64 x 1.5\n"));
    let commented = taut(&["show", "--all-comments", "my_msgs/srv/Find"]);
    assert!(commented.contains("place\n\t# Where it is\n"), "{commented}");
    let whole: String =
        format!("{header}float64 x 1.5\n").lines().map(|line| format!("\t{line}\n")).collect();
    assert_eq!(
        taut(&["show", "--no-comments", "my_msgs/srv/Find"]),
        format!("string name\n---\nmy_msgs/Place place\n{whole}")
    );
    assert_eq!(taut(&["show", "own_msgs/msg/Spot"]), "float64 x\nuint8[3] labels\n");
    assert_eq!(taut(&["proto", "own_msgs/msg/Spot"]), "x: 0.0\nlabels:\n- 0\n- 0\n- 0\n");
    assert_eq!(taut(&["proto", "my_msgs/srv/Find"]), "name: ''\n");
    assert_eq!(here.json(&["interface", "proto", "std_msgs/msg/Bool"]), json!({ "data": false }));
    let goal = taut(&["show", "example_interfaces/action/Fibonacci", "--no-comments"]);
    assert_eq!(goal, "int32 order\n---\nint32[] sequence\n---\nint32[] sequence\n");
    // So `taut msg` shows what is in no folder, too.
    assert!(here.taut(&["msg", "show", "own_msgs/msg/Spot"]).starts_with("own_msgs/msg/Spot\nRIHS01_"));

    let refused = |args: &[&str]| here.refused(&[&["interface"], args].concat());
    said(&refused(&["show", "std_msgs/msg/Strin"]), 1, "did you mean std_msgs/msg/String?");
    said(&refused(&["package", "std_mgs"]), 1, "did you mean std_msgs?");
    said(&refused(&["show", "no type"]), 2, "no type");
    assert_eq!(here.taut(&["interface", "--domain", "67", "packages"]).find("own_msgs"), None);
}
