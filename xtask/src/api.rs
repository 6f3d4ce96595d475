// SPDX-License-Identifier: MIT OR Apache-2.0
//! What users of the crate `tautline` see, from rustdoc's JSON: each item by its path, with its declaration; not which traits it
//! implements. A change of it is seen in `node/api.txt`; and whatever a declaration names has a path by which a program can name it, too.

use crate::build::SAME;
use crate::{files, lints, machine};
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};
use std::fs;
use std::path::{Path, PathBuf};

/// The crate whose surface this is.
const CRATE: &str = "tautline";

/// Everything that it can have: the bundled messages, and `logging::TracingLayer`.
const FEATURES: &str = "--features tautline/ros_all,tautline/tracing-layer";

/// Others' names for it begin so, too: their items are told of, and followed, if this one exports them.
const OURS: &str = "tautline";

/// Where messages are generated: their names are those of ROS, and not followed.
const GENERATED: &str = "tautline_ros_msgs";

/// Crates of others whose types it names, each with a reason.
const THEIRS: [(&str, &str); 5] = [
    ("indexmap", "the parameters of r2r's `RosParams`, in order"),
    ("serde_json", "`Json` holds a value"),
    ("uuid", "a goal's identifier"),
    (
        "futures_core",
        "`Stream`, which std does not have; its version is the one that all of Rust's async code agrees on",
    ),
    ("tracing_subscriber", "`logging::TracingLayer` is a layer of its registry"),
];

/// Traits that nobody else is to implement, with their crates: they have no path on purpose.
const SEALED: [(&str, &str); 2] = [("tautline_tf", "Resolve"), ("tautline_join", "Tuple")];

/// Of rustdoc's JSON, which changes with the compiler.
const FORMAT: u64 = 57;

/// Compares the surface with the one that was written down; with `bless` writes it down.
pub fn check(bless: bool) -> Result<(), String> {
    let surface = Surface::read(&lints::documents(&format!("--package {CRATE} {FEATURES} {SAME} --lib"))?)?;
    let listed = machine::root().join("node/api.txt");
    let text = surface.lines.iter().map(|line| format!("{line}\n")).collect::<String>();
    let before = fs::read_to_string(&listed).unwrap_or_default();
    let mut faults = Vec::new();
    if bless {
        files::write(&listed, &text)?;
    } else if before != text {
        let (before, now) = (lines_of(&before), lines_of(&text));
        before.difference(&now).for_each(|line| println!("- {line}"));
        now.difference(&before).for_each(|line| println!("+ {line}"));
        faults.push(
            "the surface has changed: look at it, and write it down with `cargo xtask api --bless`"
                .to_owned(),
        );
    }
    if !surface.unnameable.is_empty() {
        let named = surface.unnameable.iter().map(|(name, user)| format!("{name} (in {user})"));
        faults.push(format!("no path to {}", named.collect::<Vec<_>>().join(", ")));
    }
    let ours = |of: &str| of.starts_with(OURS) || ["alloc", "core", "std"].contains(&of);
    let theirs = |of: &str| THEIRS.iter().any(|(known, _)| *known == of);
    for (of, user) in surface.foreign.iter().filter(|(of, _)| !ours(of) && !theirs(of)) {
        faults.push(format!("{user} names a type of {of}: users would depend on its version"));
    }
    if !surface.globs.is_empty() {
        faults.push(format!("exported by a glob, not by name: {}", surface.globs.join(", ")));
    }
    println!("{} items", surface.lines.len());
    if faults.is_empty() { Ok(()) } else { Err(faults.join("; ")) }
}

fn lines_of(text: &str) -> BTreeSet<&str> {
    text.lines().collect()
}

/// What rustdoc tells of a crate.
struct Crate {
    index: HashMap<String, Value>,
    paths: HashMap<String, Value>,
    root: String,
}

impl Crate {
    fn read(path: &Path) -> Result<Crate, String> {
        let unreadable = |reason: &str| format!("{}: {reason}", path.display());
        let text = fs::read(path).map_err(|error| unreadable(&error.to_string()))?;
        let mut json: Value =
            serde_json::from_slice(&text).map_err(|error| unreadable(&error.to_string()))?;
        if json["format_version"] != FORMAT {
            let version = &json["format_version"];
            return Err(unreadable(&format!(
                "this compiler's rustdoc writes format {version}, and {FORMAT} is read"
            )));
        }
        let root = json["root"].to_string();
        let mut map = |field: &str| match json[field].take() {
            Value::Object(map) => Ok(map.into_iter().collect()),
            _ => Err(unreadable(&format!("no {field}: this rustdoc writes another format"))),
        };
        Ok(Crate { index: map("index")?, paths: map("paths")?, root })
    }

    fn item(&self, id: &Value) -> Option<&Value> {
        self.index.get(&id.to_string())
    }

    fn public_item(&self, id: &Value) -> Option<Value> {
        let item = self.item(id)?;
        ["public", "default"].iter().any(|known| item["visibility"] == *known).then(|| item.clone())
    }

    /// The crate and the name of what an identifier stands for.
    fn definition(&self, id: &Value) -> Option<Definition> {
        let path = self.paths.get(&id.to_string())?["path"].as_array()?;
        let text = |segment: Option<&Value>| Some(segment?.as_str()?.to_owned());
        Some((text(path.first())?, text(path.last())?))
    }
}

/// Crate and name. Two types of one name in a crate would be taken for one: there are none but what is in [`SEALED`].
type Definition = (String, String);

#[derive(Default)]
struct Surface {
    crates: HashMap<String, Crate>,
    lines: BTreeSet<String>,
    /// What has a path, and which.
    exported: HashMap<Definition, String>,
    /// Which declarations name it.
    named: BTreeMap<Definition, String>,
    unnameable: BTreeMap<String, String>,
    /// Crates whose types it names, and where first.
    foreign: BTreeMap<String, String>,
    globs: Vec<String>,
    /// By owner and identifier: an item's first path. By others it is one line.
    first: HashMap<(String, String), String>,
    seen: HashSet<(String, String)>,
}

impl Surface {
    fn read(documents: &[PathBuf]) -> Result<Surface, String> {
        let name = |path: &Path| path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let ours = documents
            .iter()
            .map(|path| (name(path), path))
            .filter(|(name, _)| name.starts_with(OURS) && name != GENERATED);
        let crates: HashMap<String, Crate> =
            ours.map(|(name, path)| Ok((name, Crate::read(path)?))).collect::<Result<_, String>>()?;
        let root = crates.get(CRATE).ok_or(format!("{CRATE} is not documented without clippy"))?.root.clone();
        let mut surface = Surface { crates, ..Surface::default() };
        surface.module(CRATE, &root, CRATE);
        for (definition, user) in &surface.named {
            if !surface.exported.contains_key(definition)
                && !SEALED.contains(&(definition.0.as_str(), definition.1.as_str()))
            {
                surface.unnameable.insert(definition.1.clone(), user.clone());
            }
        }
        Ok(surface)
    }

    /// All that a module of a crate holds, by its path here.
    fn module(&mut self, owner: &str, id: &str, path: &str) {
        let items = self.crates[owner].index.get(id).map(|module| module["inner"]["module"]["items"].clone());
        for item in items.iter().flat_map(|items| items.as_array().into_iter().flatten()) {
            self.item(owner, item, path, None);
        }
    }

    /// An item, by the name that it is exported under.
    fn item(&mut self, owner: &str, id: &Value, path: &str, exported: Option<&str>) {
        let Some(item) = self.crates[owner].public_item(id) else { return };
        let Some((kind, inner)) = item["inner"].as_object().and_then(|inner| inner.iter().next()) else {
            return;
        };
        if kind == "use" {
            return self.reexport(owner, inner, path);
        }
        let Some(name) = item["name"].as_str() else { return };
        let path = format!("{path}::{}", exported.unwrap_or(name));
        if !self.seen.insert((owner.to_owned(), path.clone())) {
            return;
        }
        self.exported.entry((owner.to_owned(), name.to_owned())).or_insert_with(|| path.clone());
        let first = self.first.entry((owner.to_owned(), id.to_string())).or_insert_with(|| path.clone());
        if *first != path {
            self.lines.insert(format!("use {path} = {first}"));
            return;
        }
        if kind == "module" {
            self.lines.insert(format!("mod {path}"));
            return self.module(owner, &id.to_string(), &path);
        }
        self.declare(owner, &item, &path);
        let ids = |value: &Value| value.as_array().into_iter().flatten().cloned().collect::<Vec<_>>();
        for member in ids(&inner["items"]).iter().chain(&ids(&inner["variants"])) {
            self.member(owner, member, &path);
        }
        let kind = &inner["kind"];
        for field in ids(&kind["plain"]["fields"]).iter().chain(&ids(&kind["tuple"])) {
            self.member(owner, field, &path);
        }
        for implementation in ids(&inner["impls"]) {
            let found = self.crates[owner].item(&implementation).map(|found| found["inner"]["impl"].clone());
            let Some(found) = found.filter(|found| found["trait"].is_null()) else { continue };
            for member in ids(&found["items"]) {
                self.member(owner, &member, &path);
            }
        }
    }

    /// A method, a field, a variant.
    fn member(&mut self, owner: &str, id: &Value, path: &str) {
        let Some(item) = self.crates[owner].public_item(id) else { return };
        let is_hidden = item["attrs"].to_string().contains("doc(hidden)");
        let Some(name) = item["name"].as_str().filter(|_| !is_hidden) else { return };
        let path = format!("{path}::{name}");
        self.declare(owner, &item, &path);
        let kind = &item["inner"]["variant"]["kind"];
        for field in
            [&kind["tuple"], &kind["struct"]["fields"]].iter().flat_map(|fields| fields.as_array()).flatten()
        {
            self.member(owner, field, &path);
        }
    }

    fn reexport(&mut self, owner: &str, inner: &Value, path: &str) {
        let id = &inner["id"];
        if owner == CRATE && inner["is_glob"] == true {
            self.globs.push(format!("{path}::{}", inner["source"].as_str().unwrap_or_default()));
        }
        let name = inner["name"].as_str().unwrap_or_default();
        if self.crates[owner].item(id).is_some() {
            if inner["is_glob"] == true {
                return self.module(owner, &id.to_string(), path);
            }
            return self.item(owner, id, path, Some(name));
        }
        let Some((other, original)) = self.crates[owner].definition(id) else { return };
        if !self.crates.contains_key(&other) {
            let (name, all) = if inner["is_glob"] == true { ("*", "::*") } else { (name, "") };
            let source = inner["source"].as_str().unwrap_or_default();
            self.lines.insert(format!("use {path}::{name} = {source}{all}"));
            return;
        }
        if other == original {
            // All of a crate.
            let root = self.crates[&other].root.clone();
            if inner["is_glob"] == true {
                return self.module(&other, &root, path);
            }
            self.lines.insert(format!("mod {path}::{name} = {other}"));
            return self.module(&other, &root, &format!("{path}::{name}"));
        }
        let kind = self.crates[owner].paths[&id.to_string()]["kind"].clone();
        let is_it = |(id, told): &(&String, &Value)| {
            told["kind"] == kind
                && told["path"].as_array().and_then(|path| path.last()?.as_str()) == Some(&*original)
                && self.crates[&other].index.get(*id).is_some_and(|item| item["visibility"] == "public")
        };
        let found = self.crates[&other].paths.iter().filter(is_it).map(|(id, _)| id.clone()).min();
        if let Some(id) = found.and_then(|id| serde_json::from_str(&id).ok()) {
            self.item(&other, &id, path, Some(name));
        }
    }

    /// Writes an item down as its source declares it, and notes what that names.
    fn declare(&mut self, owner: &str, item: &Value, path: &str) {
        let kind =
            item["inner"].as_object().and_then(|inner| inner.keys().next().cloned()).unwrap_or_default();
        self.lines.insert(format!("{} {path}{}", kind.replace('_', " "), declaration(item)));
        let mut named = Vec::new();
        names(&item["inner"], &mut named);
        for id in named {
            let Some(definition) = self.crates[owner].definition(&id) else { continue };
            self.foreign.entry(definition.0.clone()).or_insert_with(|| path.to_owned());
            if self.crates.contains_key(&definition.0) {
                self.named.entry(definition).or_insert_with(|| path.to_owned());
            }
        }
    }
}

/// The identifiers of the types and traits of a declaration.
fn names(value: &Value, found: &mut Vec<Value>) {
    match value {
        Value::Object(map) => {
            for (key, value) in map {
                match key.as_str() {
                    "resolved_path" | "trait" if value["id"].is_number() => found.push(value["id"].clone()),
                    // Items of their own.
                    "impls" | "items" | "implementations" => continue,
                    _ => {}
                }
                names(value, found);
            }
        }
        Value::Array(values) => values.iter().for_each(|value| names(value, found)),
        _ => {}
    }
}

/// What follows an item's name: of a function its qualifiers and all up to its body, of a type its parameters, of a field or a constant
/// its type. As the source has it; what macros made is told by its name alone.
fn declaration(item: &Value) -> String {
    let name = item["name"].as_str().unwrap_or_default();
    let kind = item["inner"].as_object().and_then(|inner| inner.keys().next()).map_or("", String::as_str);
    let (keyword, ends): (&str, &[char]) = match kind {
        "function" => ("fn", &['{', ';']),
        "struct" | "enum" | "trait" | "union" => (kind, &['{', ';', '(']),
        "constant" | "assoc_const" => ("const", &['=', ';']),
        "type_alias" | "assoc_type" => ("type", &[';']),
        "struct_field" => ("", &[]),
        _ => return String::new(),
    };
    let text = source(&item["span"]).unwrap_or_default();
    if kind == "struct_field" {
        let text = text.trim().trim_start_matches("pub ");
        // A field by its name, or one of a tuple, which is its type.
        let is_named = name.parse::<usize>().is_err();
        return match text.strip_prefix(&format!("{name}: ")).or((!is_named).then_some(text)) {
            Some(field) => {
                format!(": {}", field.trim_end_matches(',').split_whitespace().collect::<Vec<_>>().join(" "))
            }
            None => String::new(),
        };
    }
    let Some((_, after)) = text.split_once(&format!("{keyword} {name}")) else { return String::new() };
    let words = after[..end(after, ends)].split_whitespace().collect::<Vec<_>>().join(" ");
    let words = words.replace("( ", "(").replace(", )", ")").replace(",)", ")");
    let header = &item["inner"]["function"]["header"];
    let qualifiers =
        ["async", "const", "unsafe"].map(|one| if header[format!("is_{one}")] == true { one } else { "" });
    let qualifiers =
        qualifiers.iter().filter(|one| !one.is_empty()).map(|one| format!(" [{one}]")).collect::<String>();
    format!("{}{qualifiers}", words.trim_end())
}

/// Where one of these stands outside of all brackets, or the end.
fn end(text: &str, ends: &[char]) -> usize {
    let mut depth = 0_usize;
    for (at, letter) in text.char_indices() {
        if depth == 0 && ends.contains(&letter) {
            return at;
        }
        match letter {
            '(' | '[' => depth += 1,
            ')' | ']' => depth = depth.saturating_sub(1),
            _ => {}
        }
    }
    text.len()
}

/// The text of a span.
fn source(span: &Value) -> Option<String> {
    let text = fs::read_to_string(machine::root().join(span["filename"].as_str()?)).ok()?;
    let number = |end: &str, of: usize| usize::try_from(span[end][of].as_u64()?).ok();
    let (first, last) = (number("begin", 0)?, number("end", 0)?);
    let (from, to) = (number("begin", 1)?.saturating_sub(1), number("end", 1)?.saturating_sub(1));
    let lines = text.lines().enumerate().skip(first.saturating_sub(1)).take(last.saturating_sub(first) + 1);
    let lines = lines.map(|(index, line)| {
        let end = if index + 1 == last { to } else { usize::MAX };
        let start = if index + 1 == first { from } else { 0 };
        line.chars().take(end).skip(start).collect::<String>()
    });
    Some(lines.collect::<Vec<_>>().join("\n"))
}
