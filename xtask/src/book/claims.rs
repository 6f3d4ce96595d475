// SPDX-License-Identifier: MIT OR Apache-2.0
//! Sentences of the documents whose numbers the code defines: each is named with its definition, so that neither changes alone.

use crate::{files, machine};
use std::fs;
use std::path::{Path, PathBuf};

/// Below the name of each page lines `sentence == folder: definition`: a sentence of it, or a part of one, and text of a file in the folder
/// that defines its number.
const CLAIMS: &str = include_str!("claims.txt");

#[test]
fn the_numbers_of_the_documents_are_those_of_the_code() {
    let (mut page, mut faults) = ("", Vec::new());
    for line in CLAIMS.lines() {
        if let Some(name) = line.strip_prefix("# ") {
            page = name;
            continue;
        }
        let (sentence, place) = line.split_once(" == ").expect(line);
        let (folder, definition) = place.split_once(": ").expect(line);
        if !prose(page).contains(sentence) {
            faults.push(format!("{page} no longer says: {sentence}"));
        }
        if !sources(&machine::root().join(folder)).iter().any(|source| read(source).contains(definition)) {
            faults.push(format!("{page} says: {sentence}; but {folder} no longer defines: {definition}"));
        }
    }
    assert_eq!(faults, Vec::<String>::new(), "change the sentence with the number, and both in claims.txt");
}

#[test]
fn as_many_definitions_are_bundled_as_the_documents_say() {
    let folder = machine::root().join("msgs/ros/definitions");
    let packages = fs::read_dir(&folder).unwrap().flatten().filter(|entry| entry.path().is_dir()).count();
    let files = files::below(&folder).unwrap();
    let is_definition =
        |file: &&PathBuf| ["msg", "srv", "action"].iter().any(|kind| file.extension() == Some(kind.as_ref()));
    let files: Vec<_> = files.iter().filter(is_definition).collect();
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
    let folders = "analysis bag benches bridge-ros cli examples executor msgs node rmw rt sampler trace transport xtask";
    let there: Vec<String> = folders
        .split(' ')
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
    files::read(path).unwrap()
}

/// The Rust files of a folder, or the one file that is named.
fn sources(path: &Path) -> Vec<PathBuf> {
    if path.is_file() {
        return vec![path.to_owned()];
    }
    let files = files::below(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    files.into_iter().filter(|file| file.extension().is_some_and(|extension| extension == "rs")).collect()
}
