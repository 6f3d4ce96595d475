// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut component` without a container; with one, see node/components/container/tests.

use std::process::Command;

#[test]
fn a_container_that_is_not_there_is_named() {
    for arguments in [&["list"][..], &["unload", "7"], &["load", "libx.so:x::Y"]] {
        let mut taut = Command::new(env!("CARGO_BIN_EXE_taut"));
        taut.arg("component").args(arguments).args(["--container", "/nobody"]).env("TAUT_DOMAIN", "230");
        let output = taut.output().unwrap();
        let text = String::from_utf8(output.stderr).unwrap();
        assert!(!output.status.success() && text.contains("/nobody does not answer"), "{text}");
        assert!(text.contains("taut component run"), "{text}");
    }
}

#[test]
fn what_is_no_argument_is_refused_before_a_container_is_asked() {
    for (arguments, reason) in [
        (["-p", "gain=1"], "no name before ':='"),
        (["-p", ":=1"], "no name before ':='"),
        (["-p", "gain:=[1, x]"], "here are integer and string (x)"),
        (["-e", "use_intra_process_comms"], "no name before ':='"),
        (["--log-level", "loud"], "a level is debug, info, warn, error or fatal"),
    ] {
        let mut taut = Command::new(env!("CARGO_BIN_EXE_taut"));
        let output = taut.args(["component", "load", "libx.so:x::Y"]).args(arguments).output().unwrap();
        let text = String::from_utf8(output.stderr).unwrap();
        assert!(!output.status.success() && text.contains(reason), "{arguments:?}: {text}");
    }
}
