// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut apply`: what its answers and exit codes are.

#[path = "support/schemas.rs"]
mod schemas;

use schemas::Checked;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use std::future::pending;
use std::time::Duration;
use tautline::{Context, Node, Realtime};

const DOMAIN: u32 = 220;

struct File(PathBuf);

impl File {
    fn new(text: &str) -> File {
        let path = std::env::temp_dir().join(format!("taut-apply-{}.toml", std::process::id()));
        std::fs::write(&path, text).unwrap();
        File(path)
    }
}

impl Drop for File {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.0);
    }
}

fn text(wcet: &str, period: &str) -> String {
    format!(
        "[hosts.robot]\ncores = [0]\n[nodes.n]\n[callbacks.c]\nperiod = \"{period}\"\nwcet = \"{wcet}\"\n"
    )
}

fn apply(file: &Path, more: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_taut"));
    command.arg("apply").arg(file).args(["--domain", &DOMAIN.to_string()]).args(more);
    command.checked()
}

fn said(output: &Output) -> (Option<i32>, String) {
    let text = [&output.stdout[..], &output.stderr[..]].concat();
    (output.status.code(), String::from_utf8(text).unwrap().replace('\n', " "))
}

#[test]
fn its_answers_and_exit_codes() {
    let file = File::new(&text("1ms", "10ms"));
    let (code, answer) = said(&apply(&file.0, &[]));
    assert!(code == Some(1) && answer.contains("no process of domain 220 runs with"), "{answer}");

    let context = Context::builder().domain(DOMAIN).realtime(Realtime::Off).system(&file.0).build().unwrap();
    let node = Node::create(context.clone(), "n", "").unwrap();
    let callback = node.spawn_callback(context.callback("c").unwrap(), pending()).unwrap();
    std::fs::write(&file.0, text("2ms", "10ms")).unwrap();
    let (code, answer) = said(&apply(&file.0, &[]));
    assert!(code == Some(0) && answer.contains("Taken up in domain 220 by"), "{answer}");
    assert_eq!(callback.stats().budget(), Some(Duration::from_millis(2)));
    // By another path, it is the same file.
    let folder = file.0.parent().unwrap();
    let around = folder.join("..").join(folder.file_name().unwrap()).join(file.0.file_name().unwrap());
    let (code, answer) = said(&apply(&around, &[]));
    assert!(code == Some(0) && answer.contains("Taken up in domain 220 by"), "{answer}");
    let json: serde_json::Value = serde_json::from_slice(&apply(&file.0, &["--json"]).stdout).unwrap();
    assert_eq!(json["processes"].as_array().unwrap().len(), 1);

    std::fs::write(&file.0, text("2ms", "20ms")).unwrap();
    let (code, answer) = said(&apply(&file.0, &[]));
    assert!(
        code == Some(1) && answer.contains("another period") && answer.contains("nothing was changed"),
        "{answer}"
    );
    std::fs::write(&file.0, text("2ms", "10ms") + "jitter = \"9ms\"\n").unwrap();
    let (code, answer) = said(&apply(&file.0, &[]));
    assert!(code == Some(1) && answer.contains("not admitted"), "{answer}");
    std::fs::write(&file.0, "[hosts").unwrap();
    let (code, answer) = said(&apply(&file.0, &[]));
    assert!(code == Some(2) && answer.contains(":1:"), "{answer}");
    assert_eq!(callback.stats().budget(), Some(Duration::from_millis(2)));
}
