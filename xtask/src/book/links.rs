// SPDX-License-Identifier: MIT OR Apache-2.0
//! Where the links of Markdown files are, and which file each leads to: the book redirects them. That none is dead is for lychee to check.

use std::ops::Range;
use std::path::{Component, Path, PathBuf};

/// Where a file is read that is no page of the book.
pub const REPOSITORY: &str = env!("CARGO_PKG_REPOSITORY");

/// The file, relative to the root, and the heading that `target`, a link in `file`, leads to; `None` if it leads elsewhere. What is shown outside of
/// the repository, too, names files by their addresses there.
pub fn local<'a>(file: &Path, target: &'a str) -> Option<(PathBuf, &'a str)> {
    let address = target.strip_prefix(REPOSITORY).and_then(|rest| rest.split_once("/main/"));
    if let Some((_, path)) = address {
        let (path, fragment) = path.split_once('#').unwrap_or((path, ""));
        return Some((Path::new(path).components().collect(), fragment));
    }
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
    fn links_are_found_where_they_are_links() {
        let text = "[a](b.md) `[c](d)` ![e\nf](g.svg) [h](i_(j).md \"title\") é\n```\n[k](l)\n```\n``x ` [m](n)``\n[o]: p.md\n";
        let found: Vec<&str> = targets(text).into_iter().map(|range| &text[range]).collect();
        assert_eq!(found, ["b.md", "g.svg", "i_(j).md", "p.md"]);
    }
}
