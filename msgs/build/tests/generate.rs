// SPDX-License-Identifier: MIT OR Apache-2.0
//! Folders to code, and what cargo is told. That the code compiles, `examples/own_messages` shows.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use tempfile::TempDir;

/// A crate with these files.
fn project(files: &[(&str, &str)]) -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    for (path, text) in files {
        let path = folder.path().join(path);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, text).unwrap();
    }
    fs::create_dir_all(folder.path().join("out")).unwrap();
    folder
}

/// Runs `examples/build_script.rs` as cargo runs a `build.rs`.
fn build(project: &Path, ament: &[PathBuf]) -> Output {
    let test = std::env::current_exe().unwrap();
    let script = test.ancestors().nth(2).unwrap().join("examples/build_script");
    let mut command = Command::new(script);
    command.current_dir(project).env("CARGO_MANIFEST_DIR", project).env("OUT_DIR", project.join("out"));
    command.env("AMENT_PREFIX_PATH", std::env::join_paths(ament).unwrap());
    command.output().unwrap()
}

#[track_caller]
fn generated(project: &Path, ament: &[PathBuf]) -> (String, String) {
    let output = build(project, ament);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let code = fs::read_to_string(project.join("out/tautline_packages.rs")).unwrap();
    (code, String::from_utf8(output.stdout).unwrap())
}

#[track_caller]
fn refused(files: &[(&str, &str)], expected: &str) {
    let project = project(files);
    let output = build(project.path(), &[]);
    assert_eq!(output.status.code(), Some(1));
    let root = fs::canonicalize(project.path()).unwrap();
    let message = String::from_utf8_lossy(&output.stderr).replace(&*root.to_string_lossy(), "");
    assert!(message.contains(expected), "{message}");
    assert!(!project.path().join("out/tautline_packages.rs").exists());
}

#[test]
fn all_packages_of_a_folder_are_generated() {
    let project = project(&[
        ("msgs/track_msgs/msg/Track.msg", "std_msgs/Header header\nplace_msgs/Place[] places\n"),
        ("msgs/place_msgs/msg/Place.msg", "geometry_msgs/Point point\nstring name\n"),
        ("msgs/place_msgs/srv/Find.srv", "string name\n---\nPlace place\n"),
    ]);
    let (code, told) = generated(project.path(), &[]);
    for line in [
        "pub mod track_msgs {",
        "pub mod place_msgs {",
        "pub header: ::tautline::std_msgs::msg::Header,",
        "pub places: ::std::vec::Vec<super::super::place_msgs::msg::Place>,",
        "pub point: ::tautline::geometry_msgs::msg::Point,",
        "impl ::tautline::msgs::Service for Service {",
    ] {
        assert!(code.lines().any(|found| found.trim() == line), "{line}\n{code}");
    }
    assert!(!code.contains("pub mod std_msgs"), "it is bundled");
    let folder = fs::canonicalize(project.path().join("msgs")).unwrap();
    let told: Vec<_> = told.lines().collect();
    assert_eq!(
        told,
        [
            "cargo::rerun-if-changed=build.rs",
            "cargo::rerun-if-env-changed=AMENT_PREFIX_PATH",
            &format!("cargo::rerun-if-changed={}", folder.display()),
        ]
    );
}

#[test]
fn a_folder_can_be_a_package() {
    let manifest = "<package format=\"3\">\n  <name>arm_msgs</name>\n</package>\n";
    let project = project(&[("msgs/package.xml", manifest), ("msgs/msg/Grip.msg", "float32 force\n")]);
    let (code, told) = generated(project.path(), &[]);
    assert!(code.contains("pub mod arm_msgs {") && code.contains("\"arm_msgs/msg/Grip\""), "{code}");
    assert!(told.ends_with("/msgs\n"), "also for its first service: {told}");

    refused(
        &[("msgs/package.xml", "<name>Arm Msgs</name>"), ("msgs/msg/Grip.msg", "float32 force\n")],
        "/msgs/package.xml has no <name> that a package can have",
    );
}

/// The output lies in the package's folder: cargo would run the script again each time.
#[test]
fn a_crate_can_lie_in_its_package() {
    let project = project(&[("package.xml", "<name>arm_msgs</name>"), ("msg/Grip.msg", "float32 force\n")]);
    std::os::unix::fs::symlink(".", project.path().join("msgs")).unwrap();
    let (_, told) = generated(project.path(), &[]);
    let root = fs::canonicalize(project.path()).unwrap();
    let watched: Vec<_> =
        told.lines().filter_map(|line| line.strip_prefix("cargo::rerun-if-changed=/")).collect();
    let expected = ["msg", "package.xml"].map(|part| root.join(part).display().to_string()[1..].to_owned());
    assert_eq!(watched, expected);
}

#[test]
fn packages_of_an_installed_ros_are_generated_where_they_are_needed() {
    let project = project(&[
        ("msgs/arm_msgs/msg/Grip.msg", "control_msgs/Force force\n"),
        ("ros/share/control_msgs/msg/Force.msg", "float32 force\nunit_msgs/Unit unit\n"),
        ("ros/share/unit_msgs/msg/Unit.msg", "string name\n"),
        ("ros/share/other_msgs/msg/Other.msg", "string name\n"),
        // What is bundled is what there are types of.
        ("ros/share/std_msgs/msg/Header.msg", "string other\n"),
    ]);
    let (code, told) = generated(project.path(), &[project.path().join("ros")]);
    assert!(code.contains("pub mod control_msgs {") && code.contains("pub mod unit_msgs {"), "{code}");
    assert!(!code.contains("other_msgs") && !code.contains("pub mod std_msgs"), "{code}");
    assert!(told.contains("/ros/share/control_msgs\n"), "{told}");
}

#[test]
fn an_own_package_goes_before_a_bundled_one() {
    let project = project(&[
        ("msgs/std_msgs/msg/Header.msg", "string other\n"),
        ("msgs/arm_msgs/msg/Grip.msg", "std_msgs/Header header\n"),
    ]);
    let (code, _) = generated(project.path(), &[]);
    assert!(
        code.contains("pub mod std_msgs {") && code.contains("pub other: ::std::string::String"),
        "{code}"
    );
}

/// Cargo shows what a `build.rs` that fails writes to standard error.
#[test]
fn a_broken_definition_fails_the_build_with_its_place() {
    let grip = "msgs/arm_msgs/msg/Grip.msg";
    refused(
        &[(grip, "float32 force\n\nfloat32[ torque\n")],
        "Error: /msgs/arm_msgs/msg/Grip.msg:3:1: `float32[` is not a type",
    );
    refused(
        &[(grip, "float32 force\nfloat32 force\n")],
        "/msgs/arm_msgs/msg/Grip.msg:2:9: `force` is defined twice",
    );
    refused(
        &[(grip, "lost_msgs/Thing thing\n")],
        "/msgs/arm_msgs/msg/Grip.msg:1:1: `lost_msgs/msg/Thing` is defined nowhere",
    );
    refused(&[(grip, "int8 a\nGrip again\n")], "/msgs/arm_msgs/msg/Grip.msg:2:1: ");
    refused(
        &[("msgs/arm_msgs/srv/Open.srv", "int8 a\n")],
        "/msgs/arm_msgs/srv/Open.srv:1:1: 0 lines `---`: a service needs 1",
    );
    refused(&[("msgs/readme.txt", "")], "/msgs has no definitions");
    refused(&[("other/readme.txt", "")], "msgs");
}

#[test]
fn packages_can_be_chosen_and_placed() {
    let project = project(&[
        ("msgs/arm_msgs/msg/Grip.msg", "hand_msgs/Hand hand\nstd_msgs/Header header\n"),
        ("msgs/hand_msgs/msg/Hand.msg", "float32 force\n"),
        ("msgs/other_msgs/msg/Other.msg", "float32 force\n"),
    ]);
    let file = project.path().join("code.rs");
    let builder = tautline_build::Builder::new()
        .folder(project.path().join("msgs"))
        .msgs("::tautline_msgs")
        .bundled("::tautline_ros_msgs")
        .file(&file);
    builder.clone().only(["arm_msgs"]).generate().unwrap();
    let code = fs::read_to_string(&file).unwrap();
    assert!(code.contains("pub mod hand_msgs {") && !code.contains("other_msgs"), "{code}");
    assert!(
        code.contains("::tautline_ros_msgs::std_msgs::msg::Header") && !code.contains("::tautline::"),
        "{code}"
    );

    builder.clone().external("hand_msgs", "::hand::hand_msgs").generate().unwrap();
    let code = fs::read_to_string(&file).unwrap();
    assert!(
        code.contains("pub hand: ::hand::hand_msgs::msg::Hand") && !code.contains("pub mod hand_msgs"),
        "{code}"
    );

    let error = builder.only(["lost_msgs"]).generate().unwrap_err();
    assert_eq!(
        error.to_string(),
        "no folder has package lost_msgs: there are arm_msgs, hand_msgs, other_msgs"
    );
}
