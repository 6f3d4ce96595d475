// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut gateway` becomes taut-gateway, or says how to build it.
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::Command;

#[test]
fn the_program_is_found_or_its_absence_explained() {
    let directory = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("gateway-{}", std::process::id()));
    std::fs::create_dir_all(&directory).unwrap();
    // Away from what may be built beside the original.
    let taut = directory.join("taut");
    std::fs::copy(env!("CARGO_BIN_EXE_taut"), &taut).unwrap();

    let absent = Command::new(&taut).args(["gateway", "--help"]).env("PATH", "/nowhere").output().unwrap();
    let message = String::from_utf8(absent.stderr).unwrap();
    assert!(
        !absent.status.success() && message.contains("cargo build --release -p tautline-gateway"),
        "{message}"
    );

    let script = "#!/bin/sh\necho \"$@\"\nexit 3\n";
    let program = directory.join("taut-gateway");
    std::fs::write(&program, script).unwrap();
    std::fs::set_permissions(&program, std::fs::Permissions::from_mode(0o755)).unwrap();
    let options = ["--listen", "tcp/0.0.0.0:7447", "--json", "--help"];
    let found = Command::new(&taut).arg("gateway").args(options).output().unwrap();
    assert_eq!(found.status.code(), Some(3));
    assert_eq!(String::from_utf8(found.stdout).unwrap().trim(), options.join(" "));
    std::fs::remove_dir_all(directory).unwrap();
}
