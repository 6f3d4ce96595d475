// SPDX-License-Identifier: MIT OR Apache-2.0
//! The modules of this crate depend on each other in one direction: no circle of modules, and none of the folders or files of one folder.
//! The same holds for the other crates that are free of circles.
//!
//! A module uses another one if its code without tests has a path that begins with `crate`, `super`, `self` or a child module and leads
//! there; a name that the root exports leads to where it comes from. Methods that a module adds to a type of another one are not seen.

#![allow(missing_docs, reason = "a test")]

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;

/// The rooms of `src`, the lowest first: each uses only those before it. What lies beside them in `src` is below all of them.
const ROOMS: [&str; 6] = ["memory", "graph", "cleanup", "topic", "service", "observe"];

/// The other crates without circles, as seen from this one. A crate joins the list when its last circle goes: left are `msgs`, whose
/// traits name each other, and the benches `compare`, `domain`, `harness` and `rmw`.
const OTHERS: [&str; 36] = [
    "../analysis",
    "../bag",
    "../benches/alks",
    "../benches/bridge",
    "../benches/exchange",
    "../benches/paper",
    "../benches/reference",
    "../bridge-ros",
    "../cli",
    "../cli/bag",
    "../cli/filter",
    "../cli/top",
    "../executor",
    "../fuzz",
    "../msgs/build",
    "../msgs/derive",
    "../msgs/gen",
    "../msgs/schema",
    "../node",
    "../node/components",
    "../node/derive",
    "../node/join",
    "../node/kills",
    "../node/tautline-r2r",
    "../node/tf",
    "../rmw",
    "../rt",
    "../sampler",
    "../system",
    "../trace",
    "../xtask",
    "definitions",
    "doorbell",
    "relay",
    "zenoh",
    "zenoh/wire",
];

/// The code of modules by their names, such as `topic::pool`; the root is the empty name.
type Sources = BTreeMap<String, String>;
/// For each module those that it uses, with a path by which it does.
type Uses = BTreeMap<String, BTreeMap<String, String>>;

#[test]
fn no_modules_or_folders_use_each_other_in_a_circle() {
    let uses = uses_of(&sources("."));
    let found = circles(&uses);
    assert!(found.is_empty(), "{}", found.join("\n"));
    // The parser has found what is there.
    assert!(uses.len() > 50 && uses["topic::publisher::hot"].contains_key("memory::header"), "{uses:#?}");
}

#[test]
fn other_crates_stay_free_of_circles() {
    for other in OTHERS {
        let sources = sources(other);
        assert!(sources.contains_key(""), "{other} has a root");
        let found = circles(&uses_of(&sources));
        assert!(found.is_empty(), "{other}: {}", found.join("\n"));
    }
}

#[test]
fn each_room_uses_only_those_below_it() {
    let floor = |module: &str| ROOMS.iter().position(|room| module.split("::").next() == Some(room));
    let uses = uses_of(&sources("."));
    for room in ROOMS {
        assert!(
            uses.contains_key(room),
            "{room}/mod.rs says what comes in, what goes out, and who may touch it"
        );
    }
    // The root only exports.
    for (from, used) in uses.iter().filter(|(from, _)| !from.is_empty()) {
        let upwards: Vec<_> = used.iter().filter(|(to, _)| floor(to) > floor(from)).collect();
        assert!(upwards.is_empty(), "{from} uses what lies above it: {upwards:?}");
    }
}

#[test]
fn circles_are_found_and_named() {
    let sources = [
        ("", "mod a; mod b; mod c; mod d; pub use a::A; pub use f::{F, G}; // crate::nothing::X"),
        ("a", "mod deep; use crate::{b::B, c}; fn f() { deep::g::<'\"'>() }"),
        ("a::deep", "use std::fmt;\n#[cfg(test)]\n#[allow(x)]\nmod more_tests {\n    use crate::a::A;\n}"),
        ("b", "use crate::c::{self, C as _}; /// [`X`](crate::a::A)\nstruct S;"),
        ("c", "fn f() -> crate::a::deep::D { \"crate::b::B\" }"),
        ("d", "mod e; fn f() { e::g() }"),
        ("d::e", "use super::f;"),
        ("f", "pub struct F(crate::g::H); pub struct G;"),
        ("g", "pub struct H; fn f() { crate::F::new() }"),
    ];
    let sources = sources.map(|(name, text)| (name.to_owned(), text.to_owned())).into();
    let expected = [
        "circle of modules: d -> d::e (e::g), d::e -> d (super::f)",
        "circle of modules: f -> g (crate::g::H), g -> f (crate::F::new)",
        "circle in src: a -> c (crate::c), b -> c (crate::c::self), a -> b (crate::b::B), c -> a::deep (crate::a::deep::D)",
        "circle in src: f -> g (crate::g::H), g -> f (crate::F::new)",
        "circle in d: d -> d::e (e::g), d::e -> d (super::f)",
    ];
    let sorted =
        |circle: &str| circle.split([',', ':']).map(str::trim).map(str::to_owned).collect::<BTreeSet<_>>();
    let found: Vec<_> = circles(&uses_of(&sources)).iter().map(|circle| sorted(circle)).collect();
    assert_eq!(found, expected.map(sorted));
}

/// The modules of the crate in a folder, as seen from this crate's.
fn sources(folder: &str) -> Sources {
    let root = &Path::new(env!("CARGO_MANIFEST_DIR")).join(folder).join("src");
    let (mut sources, mut folders) = (Sources::new(), vec![root.clone()]);
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
                continue;
            }
            let name = path.strip_prefix(root).unwrap().with_extension("").display().to_string();
            let name = name.trim_end_matches("/mod").replace('/', "::");
            if !name.ends_with("tests") {
                let name = if name == "lib" || name == "main" { String::new() } else { name };
                sources.insert(name, fs::read_to_string(&path).unwrap());
            }
        }
    }
    sources
}

fn uses_of(sources: &Sources) -> Uses {
    let is_module = |path: &[&str]| sources.contains_key(&path.join("::"));
    let root = code(sources.get("").map_or("", String::as_str));
    let exports: BTreeMap<&str, Vec<&str>> = paths(&tokens(&root), |first| is_module(&[first]))
        .into_iter()
        .map(|path| (*path.last().unwrap(), path))
        .collect();
    let uses = sources.iter().map(|(module, text)| {
        let own: Vec<&str> = module.split("::").filter(|part| !part.is_empty()).collect();
        let code = code(text);
        let mut used = BTreeMap::new();
        for path in paths(&tokens(&code), |first| is_module(&[&own[..], &[first]].concat())) {
            let mut place = own.clone();
            for part in &path {
                match *part {
                    "crate" => place.clear(),
                    "super" => drop(place.pop()),
                    "self" => {}
                    // What follows the module is its item's.
                    part => place.push(part),
                }
            }
            if let Some(exported) = place.first().and_then(|first| exports.get(first))
                && !is_module(&place[..1])
            {
                place.splice(..1, exported.iter().copied());
            }
            while !is_module(&place) {
                place.pop();
            }
            let target = place.join("::");
            if target != *module {
                used.entry(target).or_insert(path.join("::"));
            }
        }
        (module.clone(), used)
    });
    uses.collect()
}

/// Without comments, the contents of strings, and test modules.
fn code(text: &str) -> String {
    let mut code = String::new();
    let mut lines = text.lines();
    while let Some(line) = lines.next() {
        let is_test = line.starts_with("#[cfg(") && line.contains("test");
        let what = lines.clone().find(|next| !next.starts_with("#["));
        if is_test && what.is_some_and(|what| what.starts_with("mod ") && what.ends_with('{')) {
            // Formatted code: the first brace at a line's start ends it.
            lines.by_ref().find(|line| line.starts_with('}'));
            continue;
        }
        code.push_str(&without_strings(line));
        code.push('\n');
    }
    code
}

/// A line up to its comment, without what is between quotes. Strings of several lines have no paths in them.
fn without_strings(line: &str) -> String {
    let (mut code, mut in_string, mut before) = (String::new(), false, ' ');
    for (place, c) in line.char_indices() {
        match c {
            '"' if before != '\\' && !line[..place].ends_with('\'') => in_string = !in_string,
            '/' if !in_string && line[place..].starts_with("//") => break,
            _ if !in_string => code.push(c),
            _ => {}
        }
        before = if before == '\\' { ' ' } else { c };
    }
    code
}

/// Words, `::`, and single characters.
fn tokens(code: &str) -> Vec<&str> {
    let is_word = |c: char| c.is_alphanumeric() || c == '_';
    let (mut tokens, mut rest) = (Vec::new(), code.trim_start());
    while let Some(first) = rest.chars().next() {
        let len = match first {
            _ if is_word(first) => rest.find(|c| !is_word(c)).unwrap_or(rest.len()),
            ':' if rest.starts_with("::") => 2,
            _ => first.len_utf8(),
        };
        let (token, after) = rest.split_at(len);
        tokens.push(token);
        rest = after.trim_start();
    }
    tokens
}

/// The paths that lead into this crate: `use a::{b, c}` gives two.
fn paths<'a>(tokens: &[&'a str], is_child: impl Fn(&str) -> bool) -> Vec<Vec<&'a str>> {
    let mut found = Vec::new();
    let mut place = 0;
    while place < tokens.len() {
        let starts = matches!(tokens[place], "crate" | "super" | "self") || is_child(tokens[place]);
        if starts && tokens.get(place + 1) == Some(&"::") && (place == 0 || tokens[place - 1] != "::") {
            place = read_path(tokens, place, &[], &mut found);
        } else {
            place += 1;
        }
    }
    found
}

/// Adds the paths that begin at `place` and go on from `before`; returns where they end.
fn read_path<'a>(
    tokens: &[&'a str],
    place: usize,
    before: &[&'a str],
    found: &mut Vec<Vec<&'a str>>,
) -> usize {
    let (mut path, mut place) = (before.to_vec(), place);
    loop {
        match tokens[place] {
            "{" => {
                place += 1;
                while tokens[place] != "}" {
                    place = match tokens[place] {
                        "," => place + 1,
                        // `A as B`
                        "as" => place + 2,
                        // At least past a `*`.
                        _ => read_path(tokens, place, &path, found).max(place + 1),
                    };
                }
                return place + 1;
            }
            // `a::*` and `a::<T>` end here.
            token if token.chars().all(|c| c.is_alphanumeric() || c == '_') => path.push(token),
            _ => break,
        }
        place += 1;
        if tokens.get(place) != Some(&"::") {
            break;
        }
        place += 1;
    }
    found.push(path);
    place.max(before.len() + 1)
}

/// The circles of modules, and those of the children of each folder, with the paths that make them.
fn circles(uses: &Uses) -> Vec<String> {
    let mut found = circles_among(uses, |module| Some(module.to_owned()), "circle of modules");
    let folders: BTreeSet<&str> =
        uses.keys().flat_map(|module| module.match_indices("::").map(|(at, _)| &module[..at])).collect();
    for folder in std::iter::once("").chain(folders) {
        let child = |module: &str| {
            let inside = match folder {
                "" => module,
                _ if module == folder => return Some(module.to_owned()),
                _ => module.strip_prefix(folder)?.strip_prefix("::")?,
            };
            let first = inside.split("::").next()?;
            Some(if folder.is_empty() { first.to_owned() } else { format!("{folder}::{first}") })
        };
        let name = if folder.is_empty() { "src" } else { folder };
        found.extend(circles_among(uses, child, &format!("circle in {name}")));
    }
    found
}

/// The circles among the groups in which `group` puts modules; those in no group are left out, as is the root, which exports.
fn circles_among(uses: &Uses, group: impl Fn(&str) -> Option<String>, what: &str) -> Vec<String> {
    let mut arrows: BTreeMap<String, BTreeMap<String, String>> = BTreeMap::new();
    for (from, used) in uses.iter().filter(|(from, _)| !from.is_empty()) {
        let Some(source) = group(from) else { continue };
        for (to, path) in used {
            let Some(target) = group(to).filter(|target| *target != source) else { continue };
            let arrow = format!("{from} -> {to} ({path})");
            arrows.entry(source.clone()).or_default().entry(target).or_insert(arrow);
        }
    }
    let reached = |from: &str| {
        let (mut seen, mut open) = (BTreeSet::new(), vec![from.to_owned()]);
        while let Some(next) = open.pop() {
            for to in arrows.get(&next).into_iter().flat_map(BTreeMap::keys) {
                if seen.insert(to.clone()) {
                    open.push(to.clone());
                }
            }
        }
        seen
    };
    let reached: BTreeMap<&String, BTreeSet<String>> =
        arrows.keys().map(|from| (from, reached(from))).collect();
    let is_tied = |one: &String, other: &String| {
        let reaches = |from, to| reached.get(from).is_some_and(|seen| seen.contains(to));
        reaches(one, other) && reaches(other, one)
    };
    let circles: BTreeSet<Vec<&String>> = arrows
        .keys()
        .map(|one| arrows.keys().filter(|other| is_tied(one, other)).collect::<Vec<_>>())
        .filter(|tied| !tied.is_empty())
        .collect();
    let named = circles.iter().map(|tied| {
        let inside = tied.iter().flat_map(|one| arrows[*one].iter());
        let inside = inside.filter(|(to, _)| tied.contains(to)).map(|(_, arrow)| arrow.as_str());
        format!("{what}: {}", inside.collect::<Vec<_>>().join(", "))
    });
    named.collect()
}
