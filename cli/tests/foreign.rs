// SPDX-License-Identifier: MIT OR Apache-2.0
//! What others wrote reaches no terminal as it is: messages, logs, parameters, answers, bags, files.

mod support;

use futures::StreamExt;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use support::Here;
use tautline::rcl_interfaces::msg::Log;
use tautline::std_srvs::srv::Trigger;
use tautline::{Qos, log_error};
use tautline_bag::{Definition, Options, Stamp, Topic, Writer};

/// Sets the title, rings, clears the screen, overwrites the line, all of that in one byte of C1 too.
const HOSTILE: &str = "a\u{1b}]0;owned\u{7}b\u{1b}[2Jc\rd\u{9b}31me\u{7f}\u{8}";

fn is_raw(text: &str) -> bool {
    text.contains(|c: char| c.is_control() && !matches!(c, '\n' | '\t'))
}

/// What the verb prints has something of it, if it succeeds, and nothing raw.
#[track_caller]
fn is_escaped(args: &[&str], (code, out, words): &(i32, String, String)) {
    assert!(!is_raw(out) && !is_raw(words), "{args:?} prints {out:?} and {words:?}");
    assert!(*code != 0 || format!("{out}{words}").contains("owned"), "{args:?} prints {out} and {words}");
}

#[test]
fn nodes_and_their_messages() {
    let mut here = Here::new(46);
    let mut node = here.node("evil", "");
    let logger = node.logger().clone();
    log_error!(logger, "{HOSTILE}");
    node.declare_parameter("name", HOSTILE.to_owned()).unwrap();
    let requests =
        node.create_service::<Trigger::Service>("/answer", Qos::services_default()).unwrap().owned();
    let answer = requests.for_each(|request| {
        request.respond(Trigger::Response { success: true, message: HOSTILE.into() }).unwrap();
        std::future::ready(())
    });
    here.serve(&mut node, answer);
    let (handler, _changes) = node.make_parameter_handler().unwrap();
    here.serve(&mut node, handler);
    let publisher = node.create_publisher::<Log>("/said", Qos::keep_last(10).transient_local()).unwrap();
    let log = Log { name: HOSTILE.into(), msg: HOSTILE.into(), file: HOSTILE.into(), ..Log::default() };
    publisher.publish(&log).unwrap();
    for args in [
        &["log", "-n", "1", "--timeout", "20s"][..],
        &["log", "-n", "1", "--json", "--timeout", "20s"],
        &["topic", "echo", "/said", "--once", "--timeout", "20s"],
        &["topic", "echo", "/said", "--once", "--json", "--timeout", "20s"],
        &["topic", "echo", "/said", "--once", "--field", "msg", "--timeout", "20s"],
        &["service", "call", "/answer"],
        &["service", "call", "/answer", "--json"],
        &["param", "get", "/evil", "name"],
        &["param", "get", "/evil", "name", "--json"],
        &["param", "dump", "/evil"],
    ] {
        let ended = here.refused(args);
        assert_eq!(ended.0, 0, "{args:?}: {ended:?}");
        is_escaped(args, &ended);
    }
}

#[test]
fn bags_and_files() {
    let here = Here::new(47);
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let session = [("tautline:session", HOSTILE), ("owned", HOSTILE)];
    let session = session.map(|(key, text)| (key.to_owned(), text.to_owned()));
    let bag = path("bag");
    let mut writer = Writer::create(Path::new(&bag), Options::default(), BTreeMap::from(session)).unwrap();
    let hostile = |text: &str| format!("{text}{HOSTILE}");
    let topic = Topic {
        name: hostile("/owned"),
        type_name: hostile("std_msgs/msg/String"),
        type_hash: hostile("RIHS01_"),
        definition: Some(Definition::ros2msg(hostile("string data # "))),
        qos: hostile("- history: "),
        encoding: hostile("cdr"),
        metadata: [("owned".to_owned(), HOSTILE.to_owned())].into(),
    };
    let id = writer.add_topic(topic).unwrap();
    writer.write(id, Stamp { sequence: 0, log_ns: 5, publish_ns: 5 }, &[0, 1, 0, 0, 0]).unwrap();
    writer.finish(BTreeMap::new()).unwrap();
    let system = path("system.toml");
    std::fs::write(&system, format!("[hosts.h]\ncores = 1\n['owned{HOSTILE}']\nx = 1\n")).unwrap();
    let config = path("owned.json5");
    std::fs::write(&config, format!("{{ \"owned\": \"{HOSTILE}")).unwrap();
    for args in [
        &["bag", "info", &bag][..],
        &["bag", "info", &bag, "--json"],
        &["bag", "check", &bag],
        &["bag", "convert", &bag, "-o", &path("converted")],
        &["bag", "plot", &bag, "/owned.data"],
        &["play", &bag],
        &["check", &system],
        &["topic", "info", &hostile("/owned")],
        &["node", "info", &hostile("/owned")],
        &["gateway", "--domain", "47", "--config", &config],
        &["gateway", "--domain", "47", "--no-rt", "--connect", &hostile("owned")],
    ] {
        is_escaped(args, &here.refused(args));
    }
}

/// Whoever prints does so through the module that escapes, but for these.
#[test]
fn nobody_prints_past_it() {
    /// Scripts for shells; the demo's processes among themselves; jq's answers to `taut`; the screen of `top`.
    const OTHERS: [&str; 4] =
        ["src/completions/mod.rs", "src/demo/protocol.rs", "filter/src/main.rs", "src/print.rs"];
    fn sources(folder: &Path, found: &mut Vec<PathBuf>) {
        for entry in std::fs::read_dir(folder).unwrap().flatten() {
            let path = entry.path();
            match path.is_dir() {
                true => sources(&path, found),
                false => found.extend(path.extension().is_some_and(|end| end == "rs").then_some(path)),
            }
        }
    }
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut found = Vec::new();
    ["src", "bag/src", "top/src", "filter/src"]
        .iter()
        .for_each(|folder| sources(&here.join(folder), &mut found));
    let past: Vec<String> = found
        .iter()
        .filter(|path| !OTHERS.iter().any(|other| path.ends_with(other)))
        .flat_map(|path| {
            let text = std::fs::read_to_string(path).unwrap();
            let of_program = !["src", "bag/src"].iter().any(|own| path.starts_with(here.join(own)));
            let is_past = move |line: &str| {
                let is_stream =
                    ["io::stdout()", "io::stderr()", "anstream::"].iter().any(|one| line.contains(one));
                // In `taut` itself and in `taut-bag` these are the module's.
                let is_macro = of_program && ["println!(", "print!("].iter().any(|one| line.contains(one));
                (is_stream || is_macro) && !line.contains(".is_terminal()")
            };
            let lines: Vec<_> = text.lines().filter(|line| is_past(line)).map(str::to_owned).collect();
            lines.into_iter().map(|line| format!("{}: {}", path.display(), line.trim()))
        })
        .collect();
    assert!(found.len() > 50 && past.is_empty(), "{past:#?}");
    let bag = std::fs::read_to_string(here.join("bag/src/main.rs")).unwrap();
    assert!(bag.contains("#[macro_use]\nextern crate taut_cli;"), "taut-bag has the module's macros");
}
