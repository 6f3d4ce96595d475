// SPDX-License-Identifier: MIT OR Apache-2.0
//! The commands of the pages that a newcomer reads, run in their order on what looks like the newcomer's machine (`bare.sh`).
//!
//! In these pages commands are in fenced blocks of `sh`. What cannot be run there says why, as `sh,cargo`, and is listed when the page is
//! run. A block with a file's name after its language, as `python,talker.py`, becomes that file.

use crate::steps::{Outcome, Steps, execute};
use crate::{files, machine, packages, ros};
use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::Path;
use std::process::Command;

const PAGES: [&str; 8] = [
    "README.md",
    "docs/start.md",
    "docs/rmw.md",
    "docs/from-rclpy.md",
    "docs/from-rclcpp.md",
    "docs/from-rmw-zenoh.md",
    "docs/from-iceoryx2.md",
    "docs/from-r2r.md",
];

/// Pages after whose commands more is tried: one has installed both wheels and written nodes, the others wheels or the `.deb`. The last two install
/// packages of Debian's.
const WITH_MORE: [(&str, &str, bool); 3] = [
    ("docs/from-rclpy.md", "xtask/src/dist/refused.sh", false),
    ("docs/start.md", "xtask/src/dist/installed.sh", true),
    ("docs/rmw.md", "xtask/src/dist/installed_rmw.sh", true),
];

/// Of commands that are run where packages of Debian's can be installed.
const APT: (&str, &str) = ("apt", "only root installs packages of Debian's");

/// Why commands are not run there.
const REASONS: [(&str, &str); 6] = [
    APT,
    ("cargo", "it needs a Rust toolchain and minutes"),
    ("docker", "there is no Docker"),
    ("hosts", "there is one host"),
    ("machine", "it changes the machine's settings or packages"),
    ("ros", "there is no installed ROS 2"),
];

/// A fenced block.
#[derive(Debug, PartialEq)]
struct Block {
    line: usize,
    /// After the fence.
    language: String,
    /// After the language's comma.
    note: String,
    text: String,
}

impl Block {
    /// What is to be run or written, in the shell's words; else why it is not run; nothing for what is only to be read.
    fn script(&self, page: &str, has_apt: bool) -> Result<String, String> {
        let Block { line, note, text, .. } = self;
        if note.contains('.') {
            return Ok(format!("cat > {note} <<'END OF FILE'\n{text}END OF FILE\n"));
        }
        let is_left_out = |(reason, _): &&(&str, &str)| reason == note && !(has_apt && *reason == APT.0);
        match (self.language.as_str(), REASONS.iter().find(is_left_out)) {
            ("sh", None) => {
                let quoted = text.replace('\'', r"'\''");
                Ok(format!("say '{page}:{line}\n{quoted}'\n{text}"))
            }
            ("sh", Some((_, why))) => {
                let commands = text.lines().filter(|line| !line.is_empty()).collect::<Vec<_>>().join("; ");
                Err(format!("{page}:{line} is not run, {why}: {commands}"))
            }
            _ => Ok(String::new()),
        }
    }
}

/// Whether packages of Debian's can be installed: in CI they must be.
fn has_apt() -> bool {
    let is_root = fs::metadata("/proc/self").is_ok_and(|own| own.uid() == 0);
    machine::is_ci() || is_root && packages::runs("apt-get", &["--version"])
}

/// Runs each page, with these packages.
pub fn test(steps: &mut Steps, packages: &Path) {
    for page in PAGES {
        steps.step(&format!("dist: {page}"), || Outcome::from(run(page, packages)).unless_ci());
    }
}

fn run(page: &str, packages: &Path) -> Result<(), String> {
    let root = machine::root();
    let text = files::read(&root.join(page))?;
    if let Some(fault) = faults(page, &text).first() {
        return Err(fault.clone());
    }
    let mut script = String::from(
        "begin=$(date +%s%N)\nsay() { echo; echo \"$(( ($(date +%s%N) - begin) / 1000000 )) ms: $*\"; }\n",
    );
    let (mut is_run, has_apt) = (false, has_apt());
    for block in blocks(&text) {
        match block.script(page, has_apt) {
            Ok(part) => {
                is_run |= block.language == "sh";
                script += &part;
            }
            Err(why) => println!("{why}"),
        }
    }
    if !is_run {
        return Ok(());
    }
    match WITH_MORE.iter().find(|(of, ..)| *of == page) {
        Some((_, more, true)) if !has_apt => println!("{more} is not run, {}", APT.1),
        Some((_, more, _)) => script += &files::read(&root.join(more))?,
        None => {}
    }
    script += "say done\n";
    let (work, bare) = (packages.join("work"), machine::target_dir().join("bare"));
    files::remove(&bare).map_err(files::at(&bare))?;
    let constraints =
        format!("taut=={0}\nrmw-tautline=={0}\n{1}\n", env!("CARGO_PKG_VERSION"), ros::wheels().join("\n"));
    files::write(&bare.join("script"), script)?;
    files::write(&work.join("constraints"), constraints)?;
    // As the pages say, beside what this machine's own setting says.
    let mut links = std::env::var_os("PIP_FIND_LINKS").unwrap_or_default();
    links.push(" /home/robot/target/dist/pypi");
    let mut command = Command::new("timeout");
    command.args(["300", "sh", "-eu"]).arg(root.join("xtask/src/pages/bare.sh")).arg(bare.join("script"));
    command.env("BARE", &bare).env("PACKAGES", packages).env("PYTHON", ros::python()?);
    command
        .env("VERSION", env!("CARGO_PKG_VERSION"))
        .env("PIP_QUIET", "1")
        .env("PIP_FIND_LINKS", links)
        .env("PIP_CONSTRAINT", "/home/robot/target/dist/work/constraints");
    // ROS 2's wheels have been downloaded before.
    let cache = std::env::home_dir().map(|home| ("PIP_CACHE_DIR", home.join(".cache/pip")));
    execute(command.envs(cache).envs(machine::no_rt().map(|_| ("TAUT_REALTIME", "off"))))
}

/// Commands that would be left out silently.
fn faults(page: &str, text: &str) -> Vec<String> {
    let mut faults = Vec::new();
    for Block { line, language, note, .. } in blocks(text) {
        let is_known = note.is_empty() || REASONS.iter().any(|(reason, _)| *reason == note);
        if language.is_empty() || ["bash", "console", "shell"].contains(&language.as_str()) {
            faults.push(format!(
                "{page}:{line}: the block is {language:?}: commands are `sh`, what is printed is `text`"
            ));
        } else if language == "sh" && !is_known {
            let reasons = REASONS.map(|(reason, _)| reason).join(", ");
            faults.push(format!("{page}:{line}: {note} is no reason to leave commands out: {reasons}"));
        }
    }
    let (mut is_fenced, mut is_after_blank) = (false, true);
    for (number, line) in text.lines().enumerate() {
        is_fenced ^= line.trim_start().starts_with("```");
        if !is_fenced && is_after_blank && line.starts_with("    ") {
            faults.push(format!("{page}:{}: a block that is indented, not fenced", number + 1));
        }
        is_after_blank = line.is_empty();
    }
    faults
}

fn blocks(text: &str) -> Vec<Block> {
    let mut blocks = Vec::new();
    let mut lines = text.lines().enumerate();
    while let Some((number, fence)) = lines.next() {
        let Some(info) = fence.trim_start().strip_prefix("```") else { continue };
        let indent = fence.len() - fence.trim_start().len();
        let (language, note) = info.split_once(',').unwrap_or((info, ""));
        let inside =
            lines.by_ref().map(|(_, line)| line).take_while(|line| !line.trim_start().starts_with("```"));
        let text = inside.map(|line| format!("{}\n", line.get(indent..).unwrap_or_default())).collect();
        blocks.push(Block { line: number + 1, language: language.to_owned(), note: note.to_owned(), text });
    }
    blocks
}

#[cfg(test)]
mod tests {
    use super::*;

    const PAGE: &str = "\
Install it:

```sh
pip install 'taut'
```

1. Write a node.

   ```python,talker.py
   if True:
       pass
   ```

   ```sh,cargo
   cargo build
   cargo test
   ```

```rust,no_run
fn main() {}
```
";

    #[test]
    fn commands_are_run_files_are_written_and_what_is_left_out_is_named() {
        let scripts: Vec<_> = blocks(PAGE).iter().map(|block| block.script("a.md", true)).collect();
        let expected = [
            Ok("say 'a.md:3\npip install '\\''taut'\\''\n'\npip install 'taut'\n"),
            Ok("cat > talker.py <<'END OF FILE'\nif True:\n    pass\nEND OF FILE\n"),
            Err("a.md:14 is not run, it needs a Rust toolchain and minutes: cargo build; cargo test"),
            Ok(""),
        ];
        assert_eq!(scripts, expected.map(|one| one.map(str::to_owned).map_err(str::to_owned)));
        assert_eq!(faults("a.md", PAGE), Vec::<String>::new());
        let installs = &blocks("```sh,apt\nsudo apt install a\n```\n")[0];
        assert!(installs.script("a.md", true).is_ok_and(|script| script.ends_with("sudo apt install a\n")));
        assert!(installs.script("a.md", false).is_err_and(|why| why.contains("only root installs")));
    }

    #[test]
    fn commands_that_would_be_left_out_silently_are_faults() {
        let of = |text: &str| faults("a.md", text).join("\n");
        assert!(of("Do:\n\n    cargo test\n").starts_with("a.md:3: a block that is indented"));
        assert!(of("```bash\nls\n```\n").contains("commands are `sh`"));
        assert!(of("```\nls\n```\n").contains("commands are `sh`"));
        assert!(of("```sh,later\nls\n```\n").contains("later is no reason"));
    }

    #[test]
    fn every_page_is_run_or_says_why_not() {
        let root = machine::root();
        let of = |page: &str| faults(page, &fs::read_to_string(root.join(page)).unwrap());
        assert_eq!(PAGES.map(of).concat(), Vec::<String>::new());
    }

    /// They are read on PyPI and crates.io, too.
    #[test]
    fn no_page_takes_from_a_checkout_what_is_published() {
        for page in PAGES {
            let text = fs::read_to_string(machine::root().join(page)).unwrap();
            for Block { line, text, .. } in blocks(&text) {
                for source in ["--find-links", "--git ", "git = "] {
                    assert!(!text.contains(source), "{page}:{line}: {source}");
                }
            }
        }
    }
}
