// SPDX-License-Identifier: MIT OR Apache-2.0
//! Links and headings of Markdown files, as GitHub understands them.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::fs;
use std::ops::Range;
use std::path::{Component, Path, PathBuf};

/// What is wrong with the links of these files, which are named relative to `root`: a sentence for each.
pub fn dead(root: &Path, files: &[PathBuf]) -> Vec<String> {
    let mut anchors: BTreeMap<PathBuf, HashSet<String>> = BTreeMap::new();
    let mut faults = Vec::new();
    for file in files {
        let text = match fs::read_to_string(root.join(file)) {
            Ok(text) => text,
            Err(error) => {
                faults.push(format!("{} cannot be read: {error}", file.display()));
                continue;
            }
        };
        let mut fault = |at: usize, why: String| {
            let line = text[..at].matches('\n').count() + 1;
            faults.push(format!("{}:{line}: {why}", file.display()));
        };
        for range in targets(&text) {
            let target = &text[range.clone()];
            let Some((path, fragment)) = local(file, target) else { continue };
            if !root.join(&path).exists() {
                fault(range.start, format!("{target}: there is no {}", path.display()));
                continue;
            }
            let is_markdown = path.extension().is_some_and(|extension| extension == "md");
            if fragment.is_empty() || !is_markdown {
                continue;
            }
            let known = anchors.entry(path).or_insert_with_key(|path| {
                headings(&fs::read_to_string(root.join(path)).unwrap_or_default()).into_iter().collect()
            });
            if !known.contains(fragment) {
                fault(range.start, format!("{target}: there is no such heading"));
            }
        }
        for (at, included) in includes(&text) {
            if !root.join(resolve(file, included)).exists() {
                fault(at, format!("{included} is included, and is not there"));
            }
        }
    }
    faults
}

/// The file, relative to the root, and the heading that `target`, a link in `file`, leads to; `None` if it leads elsewhere.
pub fn local<'a>(file: &Path, target: &'a str) -> Option<(PathBuf, &'a str)> {
    let scheme = target.split(['/', '#', '.']).next().unwrap_or_default();
    if scheme.contains(':') || target.starts_with('/') || target.is_empty() {
        return None;
    }
    let (path, fragment) = target.split_once('#').unwrap_or((target, ""));
    Some((if path.is_empty() { file.to_owned() } else { resolve(file, path) }, fragment))
}

/// What `path`, said in `file`, is relative to the root.
fn resolve(file: &Path, path: &str) -> PathBuf {
    let mut resolved = file.parent().unwrap_or(Path::new("")).to_owned();
    for component in Path::new(path).components() {
        match component {
            Component::ParentDir if resolved.pop() => {}
            Component::CurDir => {}
            other => resolved.push(other),
        }
    }
    resolved
}

/// Where the targets of a text's links and pictures are. What stands in code is none.
pub fn targets(text: &str) -> Vec<Range<usize>> {
    let prose = without_code(text);
    let mut targets = Vec::new();
    for (at, _) in prose.match_indices("](") {
        let start = at + 2;
        let mut depth = 0;
        let end = prose[start..].find(|character: char| {
            depth += i32::from(character == '(');
            depth -= i32::from(character == ')');
            depth < 0 || character.is_whitespace()
        });
        targets.extend(end.map(|len| start..start + len));
    }
    // [name]: target
    let mut line_start = 0;
    for line in prose.split_inclusive('\n') {
        if line.starts_with('[')
            && let Some(colon) = line.find("]: ")
        {
            let target = line[colon + 3..].split_whitespace().next().unwrap_or_default();
            targets.push(line_start + colon + 3..line_start + colon + 3 + target.len());
        }
        line_start += line.len();
    }
    targets
}

/// The files that mdBook puts into a text, and where it says so. What follows the name (lines, or an anchor) is left out.
fn includes(text: &str) -> impl Iterator<Item = (usize, &str)> {
    text.match_indices("{{#include ").filter_map(|(at, directive)| {
        let (argument, _) = text[at + directive.len()..].split_once("}}")?;
        Some((at, argument.split(':').next().unwrap_or_default().trim()))
    })
}

/// The anchors of a text's headings, by GitHub's rules: lower case, letters, digits, '-' and '_' are left, spaces become '-', and what is
/// there already gets a number.
pub fn headings(text: &str) -> Vec<String> {
    let mut count: HashMap<String, u32> = HashMap::new();
    let mut anchors = Vec::new();
    let mut in_fence = false;
    for line in text.lines() {
        in_fence ^= is_fence(line);
        let level = line.bytes().take_while(|byte| *byte == b'#').count();
        if in_fence || !(1..=6).contains(&level) || !line[level..].starts_with(' ') {
            continue;
        }
        let slug = slug(&line[level..]);
        let before = count.entry(slug.clone()).or_default();
        anchors.push(if *before == 0 { slug } else { format!("{slug}-{before}") });
        *before += 1;
    }
    anchors
}

fn slug(heading: &str) -> String {
    // Of a link its text.
    let mut text = String::new();
    let mut rest = heading.trim();
    while let Some((before, after)) = rest.split_once("](") {
        text += before;
        rest = after.split_once(')').map_or("", |(_, rest)| rest);
    }
    text += rest;
    let kept = text.to_lowercase();
    let kept = kept.chars().filter(|character| character.is_alphanumeric() || " -_".contains(*character));
    kept.map(|character| if character == ' ' { '-' } else { character }).collect()
}

fn is_fence(line: &str) -> bool {
    line.trim_start().starts_with("```")
}

/// The text, of the same length, with spaces for what is in fences and code spans.
fn without_code(text: &str) -> String {
    let mut prose = String::with_capacity(text.len());
    let mut in_fence = false;
    for line in text.split_inclusive('\n') {
        if is_fence(line) || in_fence {
            in_fence ^= is_fence(line);
            prose.extend(line.bytes().map(|byte| if byte == b'\n' { '\n' } else { ' ' }));
        } else {
            prose += line;
        }
    }
    // Spans may go over the end of a line, not over an empty one.
    let mut blanked = String::with_capacity(text.len());
    for paragraph in prose.split_inclusive("\n\n") {
        let mut rest = paragraph;
        while let Some(start) = rest.find('`') {
            let ticks = rest[start..].bytes().take_while(|byte| *byte == b'`').count();
            let (mark, inside) = (&rest[start..start + ticks], &rest[start + ticks..]);
            let Some(len) = inside.find(mark) else { break };
            let end = start + 2 * ticks + len;
            blanked += &rest[..start];
            blanked.extend(rest[start..end].bytes().map(|byte| if byte == b'\n' { '\n' } else { ' ' }));
            rest = &rest[end..];
        }
        blanked += rest;
    }
    blanked
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn headings_get_the_anchors_that_github_gives_them() {
        let text = "# `[host.x]`: what, *where* & why?\n## Two words\n```sh\n# no heading\n```\n## Two words\n### [A link](x.md#y) äh\n#none\n";
        assert_eq!(
            headings(text),
            ["hostx-what-where--why", "two-words", "two-words-1", "a-link-äh"].map(str::to_owned)
        );
    }

    #[test]
    fn links_are_found_where_they_are_links() {
        let text = "[a](b.md) `[c](d)` ![e\nf](g.svg) [h](i_(j).md \"title\") é\n```\n[k](l)\n```\n``x ` [m](n)``\n[o]: p.md\n";
        let found: Vec<&str> = targets(text).into_iter().map(|range| &text[range]).collect();
        assert_eq!(found, ["b.md", "g.svg", "i_(j).md", "p.md"]);
    }

    #[test]
    fn what_is_dead_is_named_with_its_line() {
        let root = tempfile::tempdir().unwrap();
        fs::create_dir(root.path().join("docs")).unwrap();
        let readme = "# Top\n## Here\n[up](docs/page.md#there) [same](#here) [site](https://x.org/#y) [folder](docs/)\n";
        fs::write(root.path().join("README.md"), readme).unwrap();
        let page = "# There\n[a](../README.md#here)\n[b](../README.md#gone) [c](none.md)\n\n{{#include ../none.rs:part}}\n{{#include ../README.md}}\n";
        fs::write(root.path().join("docs/page.md"), page).unwrap();
        let faults = dead(root.path(), &["README.md".into(), "docs/page.md".into()]);
        assert_eq!(
            faults,
            [
                "docs/page.md:3: ../README.md#gone: there is no such heading",
                "docs/page.md:3: none.md: there is no docs/none.md",
                "docs/page.md:5: ../none.rs is included, and is not there"
            ]
        );
    }
}
