// SPDX-License-Identifier: MIT OR Apache-2.0
//! `cargo xtask release`: checks what a release needs, makes its packages and tags it, here alone. And whether the published crates still have what those
//! of the last tag had, and how programs of both get on with each other.

use crate::build::{Build, SAME};
use crate::debian::Architecture;
use crate::machine::Scope;
use crate::running::Running;
use crate::steps::{Outcome, Steps, cargo, execute, stdout_of};
use crate::{dist, files, lints, machine};
use std::fs;
use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

const VERSION: &str = env!("CARGO_PKG_VERSION");

/// The verb. With `dry_run` nothing is made: it says what would be.
pub fn run(steps: &mut Steps, dry_run: bool) {
    let tag = format!("v{VERSION}");
    steps.step("release: tree", clean_tree);
    steps.step("release: version", || one_version(&tag));
    let (mut notes, mut dated) = (String::new(), None);
    steps.step("release: changelog", || {
        let text = read("CHANGELOG.md")?;
        let day = stdout_of(Command::new("date").args(["-u", "+%F"]))?;
        dated = with_day(&text, VERSION, day.trim());
        notes = section(dated.as_deref().unwrap_or(&text), VERSION)?.to_owned();
        Ok::<(), String>(())
    });
    // Before the first release there is nothing to compare with.
    if last_tag().is_some() {
        steps.step("release: semver", || semver(true));
        steps.step("release: versions", beside_another_version);
    }
    let then = format!(
        "git push origin HEAD {tag}; `cargo publish` the crates, and publish what is in the target directory's `dist`"
    );
    if !dry_run && steps.are_all_ok() {
        // What was interrupted goes on with it.
        if let Some(text) = &dated {
            steps.step("release: day", || {
                files::write(&machine::root().join("CHANGELOG.md"), text)?;
                execute(git("commit --quiet CHANGELOG.md").args(["--message", &format!("Release {VERSION}")]))
            });
        }
        if steps.are_all_ok() {
            dist::run(steps, &[], Architecture::here(), true, None);
            // What pip, dpkg and binstall look for on the other usual machine.
            if !Architecture::Arm64.is_here() {
                dist::run(steps, &[], Architecture::Arm64, false, None);
            }
        }
    }
    if !steps.are_all_ok() {
        return steps.skip("release: tag", "a step before it was not ok");
    }
    if dry_run {
        let day = if dated.is_some() { "commit CHANGELOG.md with the day, " } else { "" };
        return println!(
            "\nIt would {day}run `cargo xtask dist --verify` and `cargo xtask dist --architecture arm64`, and tag {tag} with this:\n\n{notes}\n\nThen: {then}"
        );
    }
    let mut command = git("tag --annotate --cleanup=verbatim");
    if steps.command("release: tag", command.arg(&tag).args(["--message", &notes])) {
        println!("\nTagged here. Then: {then}");
    }
}

/// The crates of the working tree beside those of the last tag. Each is checked by itself, as the tool's issue 638 says of items that one crate exports
/// of another. The tool takes minutes to build, and no registry has it built: CI uses it where it is there, `is_made` makes it.
pub fn semver(is_made: bool) -> Outcome {
    let Some(tag) = last_tag() else {
        let reason = "nothing was released yet: there is no tag v* to compare with (`git fetch --tags`, if there should be one)";
        return Outcome::Skipped(reason.to_owned());
    };
    let root = machine::target_dir().join("tools");
    let tool = root.join("bin/cargo-semver-checks");
    if machine::cargo_has("semver-checks --version").is_err() && !tool.is_file() {
        if !is_made {
            let reason =
                format!("to compare with {tag}, `cargo xtask semver` builds cargo-semver-checks, in minutes");
            return Outcome::Skipped(reason);
        }
        let install = "install --quiet --debug --locked cargo-semver-checks --version 0.51.0";
        if let Err(reason) = execute(cargo(install).arg("--root").arg(&root)) {
            return Outcome::Failed(reason);
        }
    }
    // It leaves out crates with `publish = false`. The library of `taut` is for the programs beside it, which demand its version. Not all features:
    // LTTng's is a library of the host's.
    let mut command = Command::new("cargo");
    command.args(["semver-checks", "--workspace", "--exclude", "taut"]);
    command.args(["--default-features", "--baseline-rev", &tag]);
    command.env("PATH", machine::path_with("PATH", &root.join("bin")));
    execute(command.current_dir(machine::root())).into()
}

/// Runs a participant beside one of the last tag, of which each hears the other, or names it as of another version. Where no tag has the program, the
/// other one is this commit's, with another number of its layout: then nothing may be heard.
pub fn beside_another_version() -> Result<(), String> {
    const PROGRAM: &str = "transport/examples/participant.rs";
    let has_program = |tag: &String| stdout_of(git("cat-file -e").arg(format!("{tag}:{PROGRAM}"))).is_ok();
    let tag = last_tag().filter(has_program);
    let (target, source) = (machine::target_dir(), machine::target_dir().join("other-version"));
    let _ = fs::remove_dir_all(&source);
    execute(git("clone --quiet --shared").arg(machine::root()).arg(&source))?;
    match &tag {
        Some(tag) => execute(git("-C").arg(&source).args(["checkout", "--quiet", tag]))?,
        None => count_up(&source.join("transport/src/memory/file.rs"))?,
    }
    let build = |root: &Path, cargo: fn(&str) -> Command| {
        let mut build = cargo(&format!("build -p tautline-transport --example participant {SAME}"));
        execute(build.arg("--target-dir").arg(&target).current_dir(root))
    };
    let (own, other) = (Build::Tests.folder().join("examples/participant"), source.join("participant"));
    // Of the other one nobody reads lints.
    build(&source, cargo)?;
    fs::copy(&own, &other).map_err(files::at(&other))?;
    build(&machine::root(), lints::cargo)?;

    let (scope, end) = (Scope::new("versions"), Instant::now() + Duration::from_secs(60));
    let start = |program: &Path| Running::start(Command::new(program).env("TAUT_SCOPE", scope.name()), true);
    let mut both = [start(&own)?, start(&other)?];
    let is_refused = |said: &str| said.contains(" is of another version of Tautline: ");
    let has_heard = |said: &str| said.contains("heard ");
    for one in &mut both {
        let status = one.wait_until(end, |said| is_refused(said) || has_heard(said));
        let said = one.said();
        // Who refuses the domain itself ends.
        if !(is_refused(&said) || has_heard(&said) && status.is_none() && tag.is_some()) {
            return Err(format!("it neither heard the other ({tag:?}) nor named it: {said}"));
        }
        println!("{}", said.lines().last().unwrap_or_default());
    }
    Ok(())
}

/// Gives a copy of this commit another number of its participants' layout.
fn count_up(path: &Path) -> Result<(), String> {
    const LINE: &str = "pub(crate) const VERSION: u32 = ";
    let text = files::read(path)?;
    let other = text.replacen(LINE, &format!("{LINE}1000 + "), 1);
    if other == text {
        return Err(format!("{} has no `{LINE}`", path.display()));
    }
    files::write(path, other)
}

/// The newest one that is part of this commit's history.
fn last_tag() -> Option<String> {
    let tag = stdout_of(&mut git("describe --tags --abbrev=0 --match v[0-9]*")).ok()?;
    Some(tag.trim().to_owned()).filter(|tag| !tag.is_empty())
}

fn git(arguments: &str) -> Command {
    let mut command = Command::new("git");
    command.args(arguments.split(' ')).current_dir(machine::root());
    command
}

fn read(path: &str) -> Result<String, String> {
    files::read(&machine::root().join(path))
}

fn clean_tree() -> Result<(), String> {
    let changes = stdout_of(&mut git("status --porcelain"))?;
    match changes.lines().count() {
        0 => Ok(()),
        count => {
            print!("{changes}");
            Err(format!(
                "{count} files are not as committed: commit or remove them, for what is tagged is what is committed"
            ))
        }
    }
}

/// All manifests have it, and it was not released yet.
fn one_version(tag: &str) -> Result<(), String> {
    if !stdout_of(&mut git(&format!("tag --list {tag}")))?.is_empty() {
        return Err(format!("{tag} is there already: count `version` in Cargo.toml up"));
    }
    let manifests = stdout_of(&mut git("ls-files *Cargo.toml *package.xml"))?;
    for path in manifests.lines() {
        if let Some(other) = versions(&read(path)?).find(|version| *version != VERSION && *version != "0.0.0")
        {
            return Err(format!("{path} has version {other}, Cargo.toml {VERSION}: make them the same"));
        }
    }
    Ok(())
}

/// The versions that a manifest gives its package, or packages of this repository.
fn versions(manifest: &str) -> impl Iterator<Item = &str> {
    manifest.lines().filter_map(|line| {
        let line = line.trim();
        let is_own = line.starts_with("version = \"") || line.contains("{ path = \"");
        let (from, end) = if is_own { ("version = \"", '"') } else { ("<version>", '<') };
        let version = line.split_once(from)?.1.split_once(end)?.0;
        // The requirement of exactly this one.
        Some(version.trim_start_matches('='))
    })
}

/// A changelog whose section of this version, which was still to be released, has this day.
fn with_day(changelog: &str, version: &str, day: &str) -> Option<String> {
    let head = format!("\n## {version} (unreleased)\n");
    changelog.contains(&head).then(|| changelog.replacen(&head, &format!("\n## {version} ({day})\n"), 1))
}

/// What the changelog says of a version that has a day.
fn section<'t>(changelog: &'t str, version: &str) -> Result<&'t str, String> {
    let head = format!("\n## {version} (");
    let (_, rest) = changelog.split_once(&head).ok_or_else(|| {
        format!("CHANGELOG.md has no section `## {version} (<day>)`: write what users get with it")
    })?;
    let (day, rest) = rest.split_once(")\n").unwrap_or((rest, ""));
    let is_day = day.len() == 10 && day.split('-').map(str::len).eq([4, 2, 2]);
    if !is_day || !day.bytes().all(|byte| byte.is_ascii_digit() || byte == b'-') {
        return Err(format!(
            "CHANGELOG.md has `{version} ({day})`: write the day of the release, such as (2026-12-01)"
        ));
    }
    let text = rest.split("\n## ").next().unwrap_or_default().trim();
    if text.is_empty() { Err(format!("CHANGELOG.md says nothing of {version}")) } else { Ok(text) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_release_has_a_section_with_its_day() {
        let log = "# Changelog\n\n## 0.2.0 (2026-12-24)\n\nNew.\n- One.\n\n## 0.1.0 (unreleased)\n\nThe first.\n\n## 0.0.1 (2026-01-01)\n\n";
        assert_eq!(section(log, "0.2.0").unwrap(), "New.\n- One.");
        for (version, reason) in [
            ("0.3.0", "has no section `## 0.3.0 (<day>)`"),
            ("0.1.0", "`0.1.0 (unreleased)`: write the day"),
            ("0.0.1", "says nothing of 0.0.1"),
        ] {
            let refusal = section(log, version).unwrap_err();
            assert!(refusal.contains(reason), "{refusal}");
        }
        assert_eq!(with_day(log, "0.2.0", "2027-03-01"), None);
        let dated = with_day(log, "0.1.0", "2027-03-01").unwrap();
        assert_eq!(section(&dated, "0.1.0").unwrap(), "The first.");
    }

    #[test]
    fn versions_of_other_packages_are_none_of_ours() {
        let manifest = "[package]\nversion = \"0.1.0\"\nrust-version = \"1.89\"\n[dependencies]\nserde = { version = \"1\" }\n\
                        tautline = { path = \"../node\", version = \"0.2.0\" }\ntaut = { path = \"cli\" }\n\
                        taut = { path = \"cli\", version = \"=0.3.0\" }\n";
        assert_eq!(versions(manifest).collect::<Vec<_>>(), ["0.1.0", "0.2.0", "0.3.0"]);
        assert_eq!(
            versions("<package format=\"3\">\n  <version>0.3.0</version>\n").collect::<Vec<_>>(),
            ["0.3.0"]
        );
    }

    /// Cargo takes the newest of those that a requirement allows.
    #[test]
    fn programs_beside_taut_take_no_later_library_of_it() {
        let exactly = format!("\ntaut = {{ path = \"cli\", version = \"={VERSION}\" }}\n");
        assert!(read("Cargo.toml").unwrap().contains(&exactly), "{exactly}");
    }

    #[test]
    fn every_manifest_has_this_version() {
        assert_eq!(one_version("v0.0.0-none"), Ok(()));
    }
}
