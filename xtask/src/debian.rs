// SPDX-License-Identifier: MIT OR Apache-2.0
//! Debian's packages of any architecture, unpacked under the target directory: nothing is installed.

use crate::steps::{Outcome, execute, stdout_of};
use crate::{files, machine, packages};
use clap::ValueEnum;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::{fmt, fs};

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Architecture {
    Amd64,
    Arm64,
    Riscv64,
}

impl fmt::Display for Architecture {
    /// As Debian names it.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Architecture::Amd64 => "amd64",
            Architecture::Arm64 => "arm64",
            Architecture::Riscv64 => "riscv64",
        })
    }
}

impl Architecture {
    /// This machine's.
    pub fn here() -> Self {
        let all = Architecture::value_variants().iter().copied();
        all.into_iter().find(|architecture| architecture.is_here()).unwrap_or(Architecture::Amd64)
    }

    /// As LLVM and GNU name it.
    pub fn name(self) -> &'static str {
        match self {
            Architecture::Amd64 => "x86_64",
            Architecture::Arm64 => "aarch64",
            Architecture::Riscv64 => "riscv64",
        }
    }

    pub fn is_here(self) -> bool {
        std::env::consts::ARCH == self.name()
    }

    /// As the compiler names it.
    pub fn triple(self) -> String {
        let extensions = if self == Architecture::Riscv64 { "gc" } else { "" };
        format!("{}{extensions}-unknown-linux-gnu", self.name())
    }

    /// A program of the toolchain for it.
    pub fn tool(self, name: &str) -> String {
        if self.is_here() { name.to_owned() } else { format!("{}-linux-gnu-{name}", self.name()) }
    }

    /// The emulator, and its package.
    pub fn emulator(self) -> [&'static str; 2] {
        match self {
            Architecture::Amd64 => ["qemu-system-x86_64", "qemu-system-x86"],
            Architecture::Arm64 => ["qemu-system-aarch64", "qemu-system-arm"],
            Architecture::Riscv64 => ["qemu-system-riscv64", "qemu-system-misc"],
        }
    }

    /// Where programs look for what loads their libraries.
    pub fn loader(self) -> &'static str {
        match self {
            Architecture::Amd64 => "lib64/ld-linux-x86-64.so.2",
            Architecture::Arm64 => "lib/ld-linux-aarch64.so.1",
            Architecture::Riscv64 => "lib/ld-linux-riscv64-lp64d.so.1",
        }
    }
}

/// Everything of the guests is here.
pub fn folder() -> PathBuf {
    machine::target_dir().join("guests")
}

/// A program of apt's, for packages of another architecture than this machine's, too: with lists of its own, which need no privilege.
fn apt(program: &str, architecture: Architecture) -> Result<Command, String> {
    let own = folder().join(format!("apt-{architecture}"));
    let cache = own.join("cache");
    for folder in [own.join("lists/partial"), cache.join("archives/partial")] {
        fs::create_dir_all(&folder).map_err(files::at(&folder))?;
    }
    let mut command = Command::new(program);
    command.arg("--quiet").args([
        format!("-oAPT::Architecture={architecture}"),
        format!("-oAPT::Architectures={architecture}"),
        format!("-oDir::State::Lists={}", own.join("lists").display()),
        format!("-oDir::Cache={}", cache.display()),
        "-oAPT::Sandbox::User=".to_owned(),
    ]);
    if architecture == Architecture::Riscv64
        && let Some(sources) = next_release()?
    {
        let list = own.join("sources.list");
        files::write(&list, sources)?;
        command.arg(format!("-oDir::Etc::SourceList={}", list.display())).arg("-oDir::Etc::SourceParts=-");
    }
    Ok(command)
}

/// Debian 13 is the first that has riscv64: its packages, from where this machine's Debian 12 has its own.
fn next_release() -> Result<Option<String>, String> {
    let mut command = Command::new("apt-get");
    let output = command.args(["indextargets", "--format", "$(CODENAME) $(REPO_URI)"]).output();
    let text = output.map_err(|error| format!("apt-get: {error}"))?.stdout;
    let text = String::from_utf8_lossy(&text);
    Ok(text.lines().find_map(|line| Some(format!("deb {} trixie main\n", line.strip_prefix("bookworm ")?))))
}

/// The package that the first of these depends on which there is.
pub fn newest(architecture: Architecture, among: &[&str]) -> Result<String, String> {
    update(architecture)?;
    let mut newest = among.iter().map(|package| needs(architecture, &[package]));
    newest.find_map(|needs| needs.map(|needs| needs.into_iter().next()).transpose()).unwrap_or_else(|| {
        Err(format!(
            "apt knows no {} for {architecture}: is this a Debian, with a network?",
            among.join(", ")
        ))
    })
}

/// Fetches the list of what there is.
fn update(architecture: Architecture) -> Result<(), String> {
    // A repository that cannot be reached shows when one of its packages is wanted.
    let _ = execute(apt("apt-get", architecture)?.arg("update"));
    Ok(())
}

/// What a package depends on.
fn needs(architecture: Architecture, told: &[&str]) -> Result<Vec<String>, String> {
    let output = apt("apt-cache", architecture)?.args(["depends", "--important"]).args(told).output();
    let output = output.map_err(|error| format!("apt-cache: {error}"))?;
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    Ok(text.lines().filter_map(|line| line.trim().strip_prefix("Depends: ").map(str::to_owned)).collect())
}

/// Downloads and unpacks packages into a folder, unless it was done before.
pub fn unpack(
    to: &Path,
    packages: impl FnOnce() -> Result<Vec<(Architecture, String)>, String>,
) -> Result<(), String> {
    if is_complete(to) {
        return Ok(());
    }
    files::make_empty(to).map_err(files::at(to))?;
    let mut all = String::new();
    for (architecture, package) in packages()? {
        let fetched = execute(apt("apt-get", architecture)?.args(["download", &package]).current_dir(to));
        fetched
            .map_err(|reason| format!("{package} cannot be downloaded ({reason}): is there a network?"))?;
        unpack_all(to)?;
        all += &format!("{package} {architecture}\n");
    }
    files::write(&to.join(LIST), all)
}

/// Unpacks packages that were downloaded to a folder there.
pub fn unpack_all(folder: &Path) -> Result<(), String> {
    for file in fs::read_dir(folder).map_err(files::at(folder))?.flatten().map(|entry| entry.path()) {
        if file.extension().is_some_and(|ending| ending == "deb") {
            execute(Command::new("dpkg").arg("-x").arg(&file).arg(folder))?;
            fs::remove_file(&file).map_err(files::at(&file))?;
        }
    }
    Ok(())
}

/// Written last: what was interrupted is made anew.
const LIST: &str = "packages.txt";

pub fn is_complete(folder: &Path) -> bool {
    folder.join(LIST).exists()
}

/// What a build for another architecture than this machine's needs: a linker, and a compiler whose standard library is there, too. This
/// machine's, if it has one; otherwise Debian's.
pub fn compiler(target: Architecture) -> Result<Vec<(String, String)>, String> {
    let (triple, gcc) = (target.triple(), target.tool("gcc"));
    let packages =
        [format!("gcc-{}-linux-gnu", target.name().replace('_', "-")), format!("libc6-dev-{target}-cross")];
    let links = ["-include", "stdio.h", "-x", "c", "-E", "/dev/null"];
    let is_there = || if packages::runs(&gcc, &links) { Ok(()) } else { Err("a linker") };
    match packages::prepare(&packages.each_ref().map(|package| &**package), is_there) {
        Outcome::Ok => {}
        Outcome::Failed(reason) | Outcome::Skipped(reason) => return Err(reason),
    }
    let name = triple.replace('-', "_");
    let mut variables = vec![
        (format!("CC_{name}"), gcc.clone()),
        (format!("AR_{name}"), target.tool("ar")),
        (format!("CARGO_TARGET_{}_LINKER", name.to_uppercase()), gcc.clone()),
    ];
    let library = stdout_of(Command::new("rustc").args(["--print", "target-libdir", "--target", &triple]));
    if !library.is_ok_and(|library| Path::new(library.trim()).is_dir()) {
        variables.push(("RUSTC".to_owned(), debians_compiler(target)?.display().to_string()));
    }
    Ok(variables)
}

/// Lets a command of cargo build for another architecture than this machine's, in a folder for that.
pub fn cross(command: &mut Command, target: Architecture) -> Result<&mut Command, String> {
    command.args(["--target", &target.triple(), "--target-dir"]).arg(folder().join("build"));
    Ok(command.envs(compiler(target)?))
}

/// A script that runs it where it was unpacked, with the standard libraries of both architectures.
fn debians_compiler(target: Architecture) -> Result<PathBuf, String> {
    let here = Architecture::here();
    let to = folder().join(format!("rust-{target}"));
    unpack(&to, || {
        update(here)?;
        update(target)?;
        let is_part =
            |package: &String| ["libstd-rust", "libllvm"].iter().any(|part| package.starts_with(part));
        let parts = needs(here, &["--recurse", "rustc-web"])?.into_iter().filter(is_part);
        let parts = BTreeSet::from_iter(parts.chain(["rustc-web".to_owned()]));
        let parts = parts.into_iter().map(|package| (here, package));
        Ok(parts.chain([(target, "libstd-rust-web-dev".to_owned())]).collect())
    })?;
    let usr = to.join("usr").display().to_string();
    let libraries = format!("{usr}/lib:{usr}/lib/{}-linux-gnu", here.name());
    machine::script(
        &format!("guests/rustc-{target}"),
        &format!("LD_LIBRARY_PATH={libraries} exec {usr}/bin/rustc \"$@\""),
    )
}
