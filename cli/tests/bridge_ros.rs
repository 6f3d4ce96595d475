// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut bridge-ros` becomes taut-bridge-ros, or says how to build it, or why it cannot start.
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::Command;

#[test]
fn the_program_is_found_or_its_absence_explained() {
    let directory = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("bridge-ros-{}", std::process::id()));
    std::fs::create_dir_all(&directory).unwrap();
    // Away from what may be built beside the original.
    let taut = directory.join("taut");
    std::fs::copy(env!("CARGO_BIN_EXE_taut"), &taut).unwrap();

    let absent = Command::new(&taut).args(["bridge-ros", "--help"]).env("PATH", "/nowhere").output().unwrap();
    let message = String::from_utf8(absent.stderr).unwrap();
    assert!(
        !absent.status.success() && message.contains("--manifest-path bridge-ros/Cargo.toml"),
        "{message}"
    );

    let program = directory.join("taut-bridge-ros");
    let write = |script: &str| {
        std::fs::write(&program, format!("#!/bin/sh\n{script}\n")).unwrap();
        std::fs::set_permissions(&program, std::fs::Permissions::from_mode(0o755)).unwrap();
    };
    write("echo 'error while loading shared libraries: librcl.so: cannot open' >&2; exit 127");
    let unloadable = Command::new(&taut).arg("bridge-ros").output().unwrap();
    let message = String::from_utf8(unloadable.stderr).unwrap();
    assert!(
        !unloadable.status.success() && message.contains("librcl.so") && message.contains("source"),
        "{message}"
    );

    write("[ \"$1\" = --version ] && exit 0\necho \"$@\"\nexit 3");
    let options = ["--deny", "/camera/**", "--json", "--help"];
    let found = Command::new(&taut).arg("bridge-ros").args(options).output().unwrap();
    assert_eq!(found.status.code(), Some(3));
    assert_eq!(String::from_utf8(found.stdout).unwrap().trim(), options.join(" "));
    std::fs::remove_dir_all(directory).unwrap();
}
