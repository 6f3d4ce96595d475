// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut man`: pages that can be read.

use std::fs;
use std::process::{Command, Output};

fn man(folder: &str) -> Output {
    Command::new(env!("CARGO_BIN_EXE_taut")).args(["man", folder]).output().unwrap()
}

#[test]
fn every_verb_has_a_page() {
    let folder = tempfile::tempdir().unwrap();
    let pages = folder.path().join("man/man1");
    let output = man(pages.to_str().unwrap());
    assert!(output.status.success(), "{output:?}");
    let mut names: Vec<String> = fs::read_dir(&pages)
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    names.sort();
    let said = String::from_utf8(output.stdout).unwrap();
    assert_eq!(said, format!("Wrote {} pages to {}\n", names.len(), pages.display()));
    for name in [
        "taut.1",
        "taut-topic.1",
        "taut-topic-echo.1",
        "taut-param-set.1",
        "taut-action-send_goal.1",
        "taut-man.1",
    ] {
        assert!(names.iter().any(|there| there == name), "{name}: {names:?}");
    }
    assert!(!names.iter().any(|name| name.contains("help")), "{names:?}");
    let page = |name: &str| fs::read_to_string(pages.join(name)).unwrap();
    let echo = page("taut-topic-echo.1");
    // An option of the verb, one of all verbs, an example in its line, and the page above.
    for part in [
        ".TH \"TAUT-TOPIC-ECHO\" \"1\" \"\" \"taut ",
        "\\-\\-filter",
        "\\-\\-domain",
        ".nf\ntaut topic echo /joint_states  ",
        "taut\\-topic(1)",
    ] {
        assert!(echo.contains(part), "{part}: {echo}");
    }
    assert!(
        page("taut-topic.1").contains(".SH \"EXIT STATUS\"\n0 done, 1 the answer is no"),
        "{}",
        page("taut-topic.1")
    );
}

/// What is not built is named.
#[test]
fn a_separate_program_has_its_options() {
    let folder = tempfile::tempdir().unwrap();
    let output = man(folder.path().to_str().unwrap());
    let page = fs::read_to_string(folder.path().join("taut-gateway.1")).unwrap();
    let words = String::from_utf8(output.stderr).unwrap();
    if words.contains("the page of taut-gateway has no options: ") {
        assert!(words.contains("cargo build"), "{words}");
    } else {
        assert!(page.contains(".SH NAME\ntaut\\-gateway \\- ") && page.contains("\\-\\-listen"), "{page}");
    }
}

#[test]
fn a_folder_that_cannot_be_written_is_named() {
    let output = man("/proc/nobody/man1");
    let words = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(2), "{words}");
    assert!(words.contains("/proc/nobody/man1 cannot be written: "), "{words}");
}
