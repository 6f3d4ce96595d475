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

    for (verb, program, package) in [
        ("gateway", "taut-gateway", "tautline-gateway"),
        ("record", "taut-bag", "taut-bag"),
        ("top", "taut-top", "taut-top"),
    ] {
        let absent = Command::new(&taut).args([verb, "--help"]).env("PATH", "/nowhere").output().unwrap();
        let message = String::from_utf8(absent.stderr).unwrap();
        for said in [
            &format!("{program} is not there: neither beside"),
            "(`pip install --force-reinstall taut`, `apt reinstall tautline`)",
            &format!("cargo build --release -p {package}`"),
        ] {
            assert!(absent.status.code() == Some(2) && message.contains(said), "{message}");
        }
    }

    let absent = Command::new(&taut).args(["component", "run"]).env("PATH", "/nowhere").output().unwrap();
    let message = String::from_utf8(absent.stderr).unwrap();
    assert!(
        absent.status.code() == Some(2)
            && message.contains("taut-container is not there: neither beside")
            && message.contains("together with your components")
            && !message.contains("cargo install"),
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
