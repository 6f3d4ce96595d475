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
