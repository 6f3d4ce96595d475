// SPDX-License-Identifier: MIT OR Apache-2.0
//! Sentences of the documents whose numbers the code defines: each is named with its definition, so that neither changes alone.

use crate::machine;
use std::fs;
use std::path::{Path, PathBuf};

/// A sentence, or a part of one, and where the code defines its number: a folder, and text of a file in it.
type Claim = (&'static str, &'static str, &'static str);

const MEMORY: &[Claim] = &[
    ("| a domain | contexts on one host | | 2,048 |", "transport/src", "MEMBERS: usize = 2048;"),
    ("depth of a queue (`Qos::depth`) | 10 | 65,536 |", "transport/src", "MAX_DEPTH: usize = 65_536;"),
    (
        "samples that it holds at once (`Limits::held`) | 4 | 4,096 |",
        "transport/src",
        "MAX_HELD: usize = 4_096;",
    ),
    (
        "(`Limits::message_bytes`: without growing) | 4,096 | 4 GiB |",
        "transport/src",
        "MAX_MESSAGE_BYTES: usize = u32::MAX as usize & !7;",
    ),
    (
        "pending requests (`MAX_PENDING_REQUESTS`) | | 64 |",
        "transport/src",
        "MAX_PENDING_REQUESTS: usize = 64;",
    ),
    ("callback threads with `direct_wake` | | 256 |", "transport/doorbell", "THREADS: usize = 256;"),
    ("timers, sleeps and transform listeners on its ROS clock | | 64 |", "node/src", "WAITING: usize = 64;"),
    (
        "threads that record trace events; events of others are counted as lost | | 64 |",
        "trace/src",
        "RINGS: usize = 64;",
    ),
    ("real-time threads that log, with 64 queued lines each;", "node/src", "LINES: usize = 64;"),
    ("of a topic, a service or an action | bytes | | 255; 240 |", "node/src", "MAX_TOPIC_NAME: usize = 240;"),
    ("| the system | domains | | 0 to 232 |", "transport/src", "MAX_DOMAIN: u32 = 232;"),
];

const QOS: &[Claim] = &[
    (
        "more than 64 publishers have ended before the subscription took anything from them",
        "transport/src",
        "UNSEEN: usize = 64;",
    ),
    (
        "cannot map its last messages within 20 ms",
        "transport/src",
        "PATIENCE: Duration = Duration::from_millis(20);",
    ),
    (
        "Deadlines and leases shorter than 50 µs are monitored as 50 µs.",
        "sampler/src",
        "SHORTEST: Duration = Duration::from_micros(50);",
    ),
];

const REPORT: &[Claim] = &[
    (
        "the latest 128 for each callback and the sampler",
        "executor/src",
        "CAPACITY: usize = if cfg!(taut_loom) { 2 } else { 128 };",
    ),
    (
        "`--watch` keeps those that it reads each second, 10,000 for each",
        "cli",
        "MOST_MOMENTS: usize = 10_000;",
    ),
    ("An excess is explained to within 100 µs", "cli", "ACCOUNTED_TO_NS: u64 = 100_000;"),
    ("the longest tenth of the jobs (2,000 at most)", "cli", "MOST: usize = 2000;"),
    ("bootstrap, 400 samples;", "cli", "RESAMPLES: usize = 400;"),
    ("(shape 0.5 or more)", "cli", "HEAVIEST: f64 = 0.5;"),
    ("There are 32 classes per callback", "executor/src", "CLASSES: usize = 32;"),
    ("from the 64 longest jobs of the class", "executor/src", "LONGEST: usize = 64;"),
];

const TRACING: &[Claim] = &[
    ("events per thread, 2048 unless set", "trace/src", "RING_EVENTS: usize = 2048;"),
    ("one more of the 1024 objects that a process can describe", "trace/src", "OBJECTS: usize = 1024;"),
    ("The recorder runs at nice 10.", "cli", "Policy::Other { nice: 10 }"),
];

const DEPLOYMENT: &[Claim] = &[
    ("length (`--max-message`, 64 MiB)", "transport/zenoh/src", "MAX_MESSAGE_BYTES: usize = 64 << 20;"),
    (
        "8192 nodes and endpoints of other hosts (`--max-tokens`), 4096 of one session",
        "transport/zenoh/src",
        "GraphLimits { tokens: 8192, tokens_per_session: 4096 }",
    ),
    ("up to 1 KiB Zenoh's priority `interactive_high`", "transport/zenoh/src", "SMALL_BYTES: usize = 1024;"),
    ("from 64 KiB on `data_low`", "transport/zenoh/src", "BULK_BYTES: usize = 64 << 10;"),
    ("16 MiB of each", "transport/zenoh/src", "MOST_WAITING_BYTES: usize = 16 << 20;"),
    (
        "is still sent, for seven seconds at most",
        "transport/relay/src",
        "SETTLE_TIME: Duration = Duration::from_secs(7);",
    ),
    (
        "until a minute after its end",
        "transport/relay/src",
        "ENDED_TIME: Duration = Duration::from_secs(60);",
    ),
    ("at most 4096 are pending", "transport/zenoh/src", "MOST_PENDING: usize = 4096;"),
    (
        "more than 10 s old are counted as `clocks_differ`",
        "transport/relay/src",
        "CLOCKS_AGREE_NS: i64 = 10_000_000_000;",
    ),
    (
        "(`--budget 25`: 25 % of one core over 40 ms)",
        "transport/relay/src",
        "WINDOW: Duration = Duration::from_millis(40);",
    ),
    (
        "until they have needed less than the budget for 200 ms",
        "transport/relay/src",
        "CALM_WINDOWS: u32 = 5;",
    ),
    ("| `gw-out` | `--priority` (80) |", "transport/zenoh/src", "PRIORITY: u8 = 80;"),
    ("These priorities are below the sampler (90)", "node/src", "SAMPLER_PRIORITY: u8 = 90;"),
];

const BAGS: &[Claim] = &[
    ("an eighth of it, 32 MiB at most, holds chunks", "cli", "(self.budget / 8).clamp(8 << 10, 32 << 20)"),
    ("as many messages as fit in 1 MiB, up to 1,000", "cli", "QUEUE_BYTES: usize = 1 << 20;"),
    ("messages are already a quarter of a second old", "cli", "BEHIND_NS: i64 = 250_000_000;"),
    ("of more than 64 MiB of a topic the oldest are left out", "cli", "LATCHED_BYTES: usize = 64 << 20;"),
    ("A chunk is written at least every half second", "cli", "FLUSH: Duration = Duration::from_millis(500);"),
    ("polled every 100 ms |", "cli", "STATISTICS_NS: u64 = 100_000_000;"),
    ("A thread at SCHED_FIFO 40 (`--priority`)", "cli", "PRIORITY: u8 = 40;"),
    (
        "messages above 64 KiB are copied into shared memory ahead of time",
        "cli",
        "LONG_BYTES: usize = 64 << 10;",
    ),
];

const TOOLS: &[Claim] = &[
    ("(up to 400 Hz)", "cli", "SEEN_HZ: f64 = 400.0;"),
    (
        "After a second a verb prints what it is waiting for.",
        "cli",
        "PATIENCE: Duration = Duration::from_secs(1);",
    ),
    ("yields nothing 60 ms after the key press", "cli", "PATIENCE: Duration = Duration::from_millis(60);"),
    ("every completion appears within 80 ms", "cli", "LIMIT: Duration = Duration::from_millis(80);"),
];

const DOCTOR: &[Claim] = &[
    ("in slices of 100 ms", "cli", "SLICE: Duration = Duration::from_millis(100);"),
    ("Interruptions longer than 1 µs", "rt/src", "THRESHOLD_NS: u64 = 1_000;"),
    ("A longest interruption of 1 ms is bad", "cli", "BAD_NS: u64 = 1_000_000;"),
    ("one of 100 µs is worth advice", "cli", "LONG_NS: u64 = 100_000;"),
];

const RMW: &[Claim] = &[
    ("| keep all | 5,000 messages.", "rmw/src", "ALL: usize = 5_000;"),
    ("publishing waits 100 ms for room", "rmw/src", "FULL_NS: u64 = 100_000_000;"),
    (
        "1,000 requests of each client and responses of each server are queued",
        "rmw/src",
        "ROOM: usize = 1_000;",
    ),
];

const OTHERS: &[(&str, Claim)] = &[
    (
        "docs/troubleshooting.md",
        (
            "polls for them 25 times a second",
            "transport/src",
            "PERIOD: Duration = Duration::from_millis(40);",
        ),
    ),
    (
        "docs/troubleshooting.md",
        (
            "A new subscription waits 100 ms",
            "transport/src",
            "PATIENCE: Duration = Duration::from_millis(100);",
        ),
    ),
    (
        "docs/troubleshooting.md",
        ("it has 1 to 32 letters, digits, '-' and '_'", "rt/src", "MAX_SCOPE_BYTES: usize = 32;"),
    ),
    ("docs/composition.md", ("is larger than 1 GiB", "node/components/src", "MAX_BYTES: u64 = 1 << 30;")),
    ("docs/system-toml.md", ("a list of 2 to 9 topics", "analysis/src", "MOST_INPUTS: usize = 9;")),
    (
        "docs/system-toml.md",
        ("at most `\"10s\"`: queues are sized for it", "analysis/src", "MOST_NS: u64 = 10_000_000_000;"),
    ),
    (
        "docs/bridge.md",
        (
            "The bridge waits up to 7 s for the node",
            "bridge-ros/src",
            "NAME_TIME: Duration = Duration::from_secs(7);",
        ),
    ),
    ("docs/bridge.md", ("A path has at most eight domains", "transport/src", "MOST_HOPS: usize = 8;")),
    (
        "docs/bridge.md",
        (
            "waits up to 7 s until reliable subscriptions in ROS",
            "transport/relay/src",
            "SETTLE_TIME: Duration = Duration::from_secs(7);",
        ),
    ),
    (
        "docs/bridge.md",
        (
            "up to 3.5 s when the bridge itself ends",
            "transport/relay/src",
            "STOP_TIME: Duration = Duration::from_millis(3_500);",
        ),
    ),
    (
        "docs/bridge.md",
        ("the bridge's queue from ROS has 1000,", "transport/relay/src", "MIN_DEPTH_IN: usize = 1000;"),
    ),
    (
        "docs/bridge.md",
        ("at least 100 for a publisher", "transport/relay/src", "RELAYED_DEPTH: usize = 100;"),
    ),
    ("docs/bridge.md", ("10 is assumed for each", "bridge-ros/src", "UNKNOWN_DEPTH: usize = 10;")),
    (
        "docs/bridge-services.md",
        (
            "several of more than 16 MiB together",
            "transport/relay/src",
            "MOST_WAITING_BYTES: usize = 16 << 20;",
        ),
    ),
    (
        "docs/bridge-services.md",
        (
            "if it has had no response for 30 s",
            "transport/relay/src",
            "SILENT_TIME: Duration = Duration::from_secs(30);",
        ),
    ),
    (
        "docs/bridge-services.md",
        ("10 s at most and 1024 per service", "transport/relay/src", "MOST_WAITING: usize = 1024;"),
    ),
    ("docs/internals.md", ("(10 M rings, 4 processes)", "xtask/src", "default_value_t = 10_000_000")),
    ("docs/internals.md", ("(10 M rings, 4 processes)", "transport/doorbell", "RINGERS: usize = 4;")),
    ("docs/start.md", ("A Rust toolchain (1.89 or newer)", "Cargo.toml", "rust-version = \"1.89\"")),
];

#[test]
fn the_numbers_of_the_documents_are_those_of_the_code() {
    let pages = [
        ("docs/memory.md", MEMORY),
        ("docs/qos.md", QOS),
        ("docs/report.md", REPORT),
        ("docs/tracing.md", TRACING),
        ("docs/deployment.md", DEPLOYMENT),
        ("docs/bags.md", BAGS),
        ("docs/tools.md", TOOLS),
        ("docs/doctor.md", DOCTOR),
        ("docs/rmw.md", RMW),
    ];
    let claims = pages.iter().flat_map(|(page, claims)| claims.iter().map(|claim| (*page, *claim)));
    let mut faults = Vec::new();
    for (page, (sentence, folder, definition)) in claims.chain(OTHERS.iter().copied()) {
        if !prose(page).contains(sentence) {
            faults.push(format!("{page} no longer says: {sentence}"));
        }
        if !sources(&machine::root().join(folder)).iter().any(|source| read(source).contains(definition)) {
            faults.push(format!("{page} says: {sentence}; but {folder} no longer defines: {definition}"));
        }
    }
    assert_eq!(faults, Vec::<String>::new(), "change the sentence with the number, and both here");
}

#[test]
fn as_many_definitions_are_bundled_as_the_documents_say() {
    let folder = machine::root().join("msgs/ros/definitions");
    let packages = fs::read_dir(&folder).unwrap().flatten().filter(|entry| entry.path().is_dir()).count();
    let files = files_of(&folder, &["msg", "srv", "action"]);
    let bytes: u64 = files.iter().map(|file| file.metadata().unwrap().len()).sum();
    let sentence = format!("the bundled definitions, {} files with {} KB of text", files.len(), bytes / 1000);
    assert!(prose("docs/messages.md").contains(&sentence), "{sentence}");
    let sentence = format!("The {packages} packages that Tautline bundles");
    assert!(prose("docs/messages.md").contains(&sentence), "{sentence}");
    for page in ["docs/features.md", "ARCHITECTURE.md", "CHANGELOG.md"] {
        assert!(prose(page).contains(&format!("{packages}")), "{page}: {packages} packages");
    }
}

/// Their walks and tables name files by the end of a path.
#[test]
fn files_that_the_documents_name_are_there() {
    let root = machine::root();
    let folders = [
        "analysis",
        "bag",
        "benches",
        "bridge-ros",
        "cli",
        "examples",
        "executor",
        "msgs",
        "node",
        "rmw",
        "rt",
        "sampler",
    ];
    let folders = folders.into_iter().chain(["trace", "transport", "xtask"]);
    let there: Vec<String> = folders
        .flat_map(|folder| sources(&root.join(folder)))
        .map(|file| file.display().to_string())
        .collect();
    let mut lacking = Vec::new();
    for page in ["ARCHITECTURE.md", "docs/internals.md"] {
        let text = read(&root.join(page));
        // Every second piece is between two ticks.
        for name in text.split('`').skip(1).step_by(2).filter(|name| name.ends_with(".rs")) {
            let end = format!("/{name}");
            if !there.iter().any(|file| file.ends_with(&end)) {
                lacking.push(format!("{page}: {name}"));
            }
        }
    }
    assert_eq!(lacking, Vec::<String>::new());
}

/// ARCHITECTURE.md: "the only crate that calls `sched_*` and `mlock*`".
#[test]
fn no_crate_but_rt_sets_priorities_or_locks_memory() {
    let calls = ["libc::sched_", "libc::mlock", "libc::pthread_setsched", "mlockall("];
    let product = ["analysis", "bag", "cli", "executor", "msgs", "node", "sampler", "trace", "transport"];
    let found = product.iter().flat_map(|folder| sources(&machine::root().join(folder)));
    let found: Vec<_> = found.filter(|file| calls.iter().any(|call| read(file).contains(call))).collect();
    assert_eq!(found, Vec::<PathBuf>::new());
}

/// No part of the product; the demo's components have what our macro makes of them.
const NOT_PRODUCT: [&str; 6] =
    ["examples", "examples/own_messages", "fuzz", "node/components/demo", "node/kills", "xtask"];

/// SECURITY.md's table, and ARCHITECTURE.md: "`unsafe` in `executor`, `analysis` or `cli`, or in `node` except where `components/` loads libraries".
#[test]
fn unsafe_code_is_where_the_table_says() {
    let root = machine::root();
    let table = read(&root.join("SECURITY.md"));
    let listed = |folder: &str| {
        let row = table.lines().find_map(|line| line.strip_prefix(&format!("| `{folder}` | ")))?;
        row.split(' ').next()?.parse::<usize>().ok()
    };
    let manifest = read(&root.join("Cargo.toml"));
    let members = manifest.split_once("members = [").and_then(|(_, rest)| rest.split_once(']')).unwrap().0;
    let members = members.split('"').skip(1).step_by(2).filter(|folder| !folder.starts_with("xtask/"));
    let mut wrong = Vec::new();
    for folder in members.chain(["bridge-ros", "dylib", "rmw"]).filter(|folder| !NOT_PRODUCT.contains(folder))
    {
        let source = root.join(folder).join("src");
        let count: usize = sources(&source).iter().map(|file| count_unsafe(file)).sum();
        let tops = ["lib.rs", "main.rs"].map(|top| source.join(top)).into_iter().filter(|top| top.is_file());
        let forbids = tops.clone().all(|top| read(&top).contains("#![forbid(unsafe_code)]"));
        match listed(folder) {
            Some(number) if number == count => {}
            None if count == 0 && forbids => {}
            number => {
                wrong.push(format!("{folder}: {count}, SECURITY.md says {number:?}, forbidden: {forbids}"))
            }
        }
    }
    assert_eq!(wrong, Vec::<String>::new());
}

/// Blocks, functions and implementations of a file that are unsafe, without those of its tests, which are its last module or files of their own.
fn count_unsafe(file: &Path) -> usize {
    let name = file.file_name().unwrap_or_default().to_string_lossy();
    if name.starts_with("tests") || name.starts_with("loom") || name == "stress.rs" {
        return 0;
    }
    let text = read(file);
    let is_tests = |lines: &&[&str]| {
        lines[0].starts_with("#[cfg(") && lines[0].contains("test") && lines[1].ends_with('{')
    };
    let lines: Vec<_> = text.lines().collect();
    let code = lines.windows(2).take_while(|lines| !is_tests(lines));
    let code = code.map(|lines| lines[0].split("//").next().unwrap_or_default());
    code.map(|line| {
        let words = line.split("unsafe ").skip(1);
        words.filter(|rest| ["{", "impl", "fn", "extern"].iter().any(|kind| rest.starts_with(kind))).count()
    })
    .sum()
}

/// ARCHITECTURE.md: "`msgs`, `schema`, `rt`, `analysis`, `bag`, `join` and `tf` use no other crate of the workspace (`msgs` uses its
/// derive)", and what follows it.
#[test]
fn dependencies_point_down() {
    let used = |manifest: &str, allowed: &[&str]| {
        let text = read(&machine::root().join(manifest).join("Cargo.toml"));
        let section =
            text.split("\n[").find_map(|section| section.strip_prefix("dependencies]")).unwrap_or("");
        let ours =
            section.lines().filter_map(|line| line.strip_prefix("tautline-")?.split(['.', ' ']).next());
        let others: Vec<_> = ours.filter(|name| !allowed.contains(name)).map(str::to_owned).collect();
        assert_eq!(others, Vec::<String>::new(), "{manifest}");
    };
    for folder in ["msgs/schema", "rt", "analysis", "bag", "node/join", "node/tf"] {
        used(folder, &[]);
    }
    used("msgs", &["msgs-derive"]);
    used("trace", &["rt"]);
    used("transport/doorbell", &["rt"]);
    used("transport", &["msgs", "rt", "trace", "doorbell"]);
    used("sampler", &["transport", "doorbell", "rt", "trace"]);
    used("executor", &["rt", "trace"]);
    used("system", &["executor", "analysis", "rt"]);
    // docs/internals.md has these, too.
    used("msgs/gen", &["schema"]);
    used("msgs/build", &["schema", "gen"]);
    used("msgs/ros", &["msgs"]);
    used("transport/definitions", &["transport", "schema"]);
    used("transport/relay", &["transport", "schema", "rt"]);
    used("transport/zenoh/wire", &["transport", "schema"]);
    used("transport/zenoh", &["relay", "wire", "transport", "schema", "analysis", "rt"]);
    used("bridge-ros", &["relay", "transport", "schema", "analysis", "rt"]);
    used("rmw", &["sampler", "transport", "schema", "executor", "system", "analysis", "trace", "rt"]);
    let of_runtime = ["analysis", "executor", "system", "rt", "sampler", "trace", "transport"];
    let of_messages = ["join", "tf", "derive", "msgs", "ros-msgs", "schema", "definitions"];
    used("node", &[of_runtime, of_messages].concat());
}

/// ARCHITECTURE.md: "a log line on a hot path" is among "what does not exist".
#[test]
fn hot_paths_deny_what_would_wait() {
    let folders = ["executor", "sampler", "trace", "transport"].map(|folder| machine::root().join(folder));
    let hot: Vec<_> = folders
        .iter()
        .flat_map(|folder| sources(folder))
        .filter(|file| file.file_name().is_some_and(|name| name == "hot.rs"))
        .collect();
    assert!(hot.len() > 5, "{hot:?}");
    let denied = "clippy::disallowed_methods, clippy::disallowed_types, clippy::disallowed_macros";
    let lax: Vec<_> = hot.into_iter().filter(|file| !read(file).contains(denied)).collect();
    assert_eq!(lax, Vec::<PathBuf>::new());
}

/// README, PyPI and the book's first page are one text, whose beginning the packages take too.
#[test]
fn who_finds_it_reads_the_same_five_sentences() {
    let root = machine::root();
    let whole = |lines: Vec<&str>| lines.join(" ");
    let readme = read(&root.join("README.md"));
    let five = whole(readme.lines().skip(2).take_while(|line| !line.is_empty()).collect());
    let (first, rest) = five.split_once(". ").unwrap();
    assert_eq!(rest.matches(". ").count() + 2, 5, "{five}");
    let crate_page = read(&root.join("node/src/lib.rs"));
    let begin = crate_page.lines().skip(1).map_while(|line| line.strip_prefix("//! "));
    assert_eq!(whole(begin.collect()), five);
    assert_eq!(read(&root.join("docs/introduction.md")).trim(), "{{#include ../README.md}}");
    // Relative links are dead on crates.io and PyPI.
    let is_near = |range: &std::ops::Range<usize>| !readme[range.clone()].contains("://");
    let near: Vec<_> = super::links::targets(&readme).into_iter().filter(is_near).collect();
    assert_eq!(near.into_iter().map(|range| &readme[range]).collect::<Vec<_>>(), Vec::<&str>::new());
    let folded = |text: &str| text.split_whitespace().collect::<Vec<_>>().join(" ").to_lowercase();
    let (labels, prose): (Vec<_>, Vec<_>) = readme.lines().partition(|line| line.contains("]: http"));
    let prose = folded(&prose.join(" "));
    let labels = labels.iter().filter_map(|line| Some(line.split_once(": ")?.0));
    assert_eq!(
        labels.filter(|label| !prose.contains(&folded(label))).collect::<Vec<_>>(),
        Vec::<&str>::new()
    );
    assert!(readme.contains(&read(&root.join("node/src/comparison.md"))));
    for page in [&readme, &crate_page] {
        for part in
            ["/raw/main/docs/demo.svg)", "cargo add tautline", "pip install ", "cargo run --release -- demo"]
        {
            assert!(page.contains(part), "{part}");
        }
    }
    for file in ["node/Cargo.toml", "docs/book.toml"] {
        assert!(read(&root.join(file)).contains(&format!("description = \"{first}\"")), "{file}: {first}");
    }
    let packages = read(&root.join("xtask/src/dist/pack.sh"));
    assert!(
        packages.contains("pack_deb tautline \"libc6 (>= $GLIBC), libgcc-s1\" \"$first\" ")
            && packages.contains("pack_wheel taut \"$first: ")
    );
}

/// The text of a page, with one space between words.
fn prose(page: &str) -> String {
    read(&machine::root().join(page)).split_whitespace().collect::<Vec<_>>().join(" ")
}

fn read(path: &Path) -> String {
    fs::read_to_string(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

/// The Rust files of a folder, or the one file that is named.
fn sources(path: &Path) -> Vec<PathBuf> {
    if path.is_file() {
        return vec![path.to_owned()];
    }
    // This file names every definition.
    files_of(path, &["rs"]).into_iter().filter(|file| !file.ends_with("book/claims.rs")).collect()
}

fn files_of(folder: &Path, extensions: &[&str]) -> Vec<PathBuf> {
    let mut files = Vec::new();
    let mut folders = vec![folder.to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in
            fs::read_dir(&folder).unwrap_or_else(|error| panic!("{}: {error}", folder.display())).flatten()
        {
            let path = entry.path();
            let is_listed =
                |extension: &std::ffi::OsStr| extensions.iter().any(|listed| extension == *listed);
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(is_listed) {
                files.push(path);
            }
        }
    }
    files.sort();
    files
}
