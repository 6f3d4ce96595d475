// SPDX-License-Identifier: MIT OR Apache-2.0
//! The documentation as a book, by mdBook, and the links of all documents.
//!
//! mdBook gets a copy of `docs/` in which links that leave the folder lead to a page of the book, if there is one for that file, else to
//! the file in the repository.

#[cfg(test)]
mod claims;
mod links;

use crate::steps::{Outcome, Steps, announce, cargo, execute, stdout_of};
use crate::{files, machine, tools};
use links::REPOSITORY;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::process::Command;

const MDBOOK: &str = "0.5.4";

/// Files outside of `docs/`, and the pages that show them.
const SHOWN: [(&str, &str); 2] =
    [("README.md", "docs/introduction.md"), ("ARCHITECTURE.md", "docs/architecture.md")];

/// Checks all links, then builds the book.
pub fn test(steps: &mut Steps) {
    steps.step("book: links", || Outcome::with(tools::program("lychee"), |program| check_links(&program)));
    steps.step("book", || Outcome::with(mdbook(), |program| build(&program)));
}

/// Those within the repository, in all of its documents: what is on the network may be away for a day.
fn check_links(lychee: &Path) -> Result<(), String> {
    let here = machine::root();
    let mut check = Command::new(lychee);
    check.args(["--offline", "--include-fragments", "--no-progress", "--extensions", "md", "."]);
    check.arg("--remap").arg(format!("{REPOSITORY}/(blob|raw|tree)/main/ file://{}/", here.display()));
    execute(check.current_dir(here))
}

fn build(mdbook: &Path) -> Result<(), String> {
    let (root, target) = (machine::root(), machine::target_dir());
    let (copy, book) = (target.join("book-source"), target.join("book"));
    let pages = pages(&root)?;
    fail(unlisted(&root, &pages)?)?;
    stage(&root, &copy, &pages).map_err(|error| format!("{} cannot be written: {error}", copy.display()))?;
    let mut command = Command::new(mdbook);
    command.arg("build").arg(copy.join("docs")).arg("--dest-dir").arg(&book);
    announce(&command);
    let output = command.output().map_err(|error| format!("mdbook cannot be started: {error}"))?;
    let said = String::from_utf8_lossy(&output.stderr) + String::from_utf8_lossy(&output.stdout);
    eprint!("{said}");
    if !output.status.success() {
        return Err(output.status.to_string());
    }
    fail(
        said.lines()
            .filter(|line| line.contains("WARN") || line.contains("ERROR"))
            .map(str::to_owned)
            .collect(),
    )?;
    println!("{}", book.join("index.html").display());
    Ok(())
}

/// Prints the faults; an error says how many there are.
fn fail(faults: Vec<String>) -> Result<(), String> {
    faults.iter().for_each(|fault| eprintln!("{fault}"));
    match &faults[..] {
        [] => Ok(()),
        [first] => Err(first.clone()),
        [first, others @ ..] => Err(format!("{first}, and {} more", others.len())),
    }
}

/// The Markdown files below `docs/`, relative to the root.
fn pages(root: &Path) -> Result<Vec<PathBuf>, String> {
    let docs = root.join("docs");
    let files = files::below(&docs).map_err(files::at(&docs))?;
    let is_page = |path: &Path| path.extension().is_some_and(|extension| extension == "md");
    let pages = files.iter().filter_map(|file| file.strip_prefix(root).ok()).filter(|path| is_page(path));
    Ok(pages.map(Path::to_owned).collect())
}

/// Pages that readers do not find: in the book by its summary, on GitHub by the index.
fn unlisted(root: &Path, pages: &[PathBuf]) -> Result<Vec<String>, String> {
    let mut faults = Vec::new();
    // The index is for those who read the folder, the other two for those who read the book.
    for (list, spared) in
        [("SUMMARY.md", "README.md"), ("README.md", "introduction.md architecture.md SUMMARY.md")]
    {
        let list = Path::new("docs").join(list);
        let text = files::read(&root.join(&list))?;
        let listed: Vec<PathBuf> = links::targets(&text)
            .into_iter()
            .filter_map(|range| Some(links::local(&list, &text[range])?.0))
            .collect();
        for page in pages.iter().filter(|page| **page != list && !listed.contains(page)) {
            let in_docs = page.strip_prefix("docs").unwrap_or(page).to_string_lossy();
            // The decisions have an index of their own.
            let is_decision = list.ends_with("README.md") && in_docs.starts_with("adr/");
            if !is_decision && !spared.split(' ').any(|name| name == in_docs) {
                faults.push(format!("{} is not in {}", page.display(), list.display()));
            }
        }
    }
    Ok(faults)
}

/// Makes what mdBook reads.
fn stage(root: &Path, copy: &Path, pages: &[PathBuf]) -> io::Result<()> {
    files::remove(copy)?;
    fs::create_dir_all(copy.join("docs/adr"))?;
    std::os::unix::fs::symlink(root.join("examples"), copy.join("examples"))?;
    std::os::unix::fs::symlink(root.join("node"), copy.join("node"))?;
    for entry in fs::read_dir(root.join("docs"))? {
        let path = entry?.path();
        if path.is_file() {
            fs::copy(&path, copy.join("docs").join(path.file_name().unwrap_or_default()))?;
        }
    }
    let is_page = |path: &Path| pages.iter().any(|page| page == path) && path != Path::new("docs/README.md");
    for page in pages {
        let text = fs::read_to_string(root.join(page))?;
        fs::write(copy.join(page), redirected(&text, page, page, &is_page))?;
    }
    for (file, shown) in SHOWN {
        let text = fs::read_to_string(root.join(file))?;
        fs::write(copy.join(file), redirected(&text, Path::new(file), Path::new(shown), &is_page))?;
    }
    Ok(())
}

/// The text of `file` as it stands in the book's `page`: each link leads to a page of the book, or to the repository.
fn redirected(text: &str, file: &Path, page: &Path, is_page: &dyn Fn(&Path) -> bool) -> String {
    let mut redirected = String::with_capacity(text.len());
    let mut done = 0;
    let mut targets = links::targets(text);
    targets.sort_by_key(|range| range.start);
    for range in targets {
        let Some((path, fragment)) = links::local(file, &text[range.clone()]) else { continue };
        let shown =
            SHOWN.iter().find(|(shown, _)| path == Path::new(shown)).map(|(_, page)| PathBuf::from(page));
        let index = path.join("README.md");
        let path = shown.unwrap_or(if is_page(&index) { index } else { path });
        let is_picture =
            path.starts_with("docs") && path.extension().is_some_and(|extension| extension == "svg");
        let target = if is_page(&path) || is_picture {
            // The book's folders are one deep.
            let up = if page.starts_with("docs/adr") { "../" } else { "" };
            // mdBook makes a folder's index.html of its README.md.
            let path = path.to_string_lossy().replace("README.md", "index.md");
            format!("{up}{}", path.trim_start_matches("docs/"))
        } else {
            format!("{REPOSITORY}/blob/main/{}", path.display())
        };
        redirected += &text[done..range.start];
        redirected += &target;
        if !fragment.is_empty() {
            redirected += "#";
            redirected += fragment;
        }
        done = range.end;
    }
    redirected + &text[done..]
}

/// The program: that in PATH, else one that is installed under the target directory, which takes a minute or two.
fn mdbook() -> Result<PathBuf, String> {
    let root = machine::target_dir().join("tools");
    let installed = root.join("bin/mdbook");
    let version = |program: &Path| stdout_of(Command::new(program).arg("--version"));
    // Another version of the same book format will do.
    if version(Path::new("mdbook")).is_ok_and(|version| version.starts_with("mdbook v0.5.")) {
        return Ok("mdbook".into());
    }
    if version(&installed).is_ok_and(|version| version.trim().ends_with(MDBOOK)) {
        return Ok(installed);
    }
    // Without its server and what watches files.
    let mut install =
        cargo("install --debug mdbook --locked --no-default-features --features search --version");
    execute(install.arg(MDBOOK).arg("--root").arg(root))?;
    Ok(installed)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn links_lead_to_pages_of_the_book_or_to_the_repository() {
        let pages = ["docs/qos.md", "docs/adr/README.md", "docs/adr/0001-x.md", "docs/introduction.md"]
            .map(PathBuf::from);
        let is_page = |path: &Path| pages.iter().any(|page| page == path);
        let case =
            |text: &str, file: &str, page: &str| redirected(text, Path::new(file), Path::new(page), &is_page);
        assert_eq!(
            case(
                &format!(
                    "[a](docs/qos.md#b) [c](docs/adr/) ![d](docs/e.svg) [f](rt/) [g]\n[g]: {REPOSITORY}/blob/main/docs/qos.md#h\n"
                ),
                "README.md",
                "docs/introduction.md"
            ),
            format!(
                "[a](qos.md#b) [c](adr/index.md) ![d](e.svg) [f]({REPOSITORY}/blob/main/rt) [g]\n[g]: qos.md#h\n"
            )
        );
        assert_eq!(
            case(
                "[a](../qos.md) [b](0001-x.md) [c](../../README.md#d) `[e](f)`",
                "docs/adr/0001-x.md",
                "docs/adr/0001-x.md"
            ),
            "[a](../qos.md) [b](../adr/0001-x.md) [c](../introduction.md#d) `[e](f)`"
        );
    }

    #[test]
    fn every_page_is_found() {
        let root = machine::root();
        assert_eq!(unlisted(&root, &pages(&root).unwrap()).unwrap(), Vec::<String>::new());
    }
}
