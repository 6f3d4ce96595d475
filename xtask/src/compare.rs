// SPDX-License-Identifier: MIT OR Apache-2.0
//! The programs of other middleware that Tautline is measured beside: those that can be built here.

use crate::build::{Build, build};
use crate::debian;
use crate::steps::{self, execute};
use crate::{files, lab, machine, r2r};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::{fs, io};

/// The benches that need it, its system, a program that is not in this workspace or not always built with it, and what makes that.
pub type Rival = (&'static [&'static str], &'static str, &'static str, fn(Build) -> Result<PathBuf, String>);

const COMPARE: &[&str] = &["compare"];
const NETWORK: &[&str] = &["compare", "network"];
/// Those after the first six are what some ways of a system need beside its own program.
const RIVALS: [Rival; 9] = [
    (COMPARE, "taktora", "taktora", |of| build_rival("rival-taktora", of)),
    (COMPARE, "fastdds", "fastdds", build_fastdds),
    (COMPARE, "cyclonedds", "cyclonedds", build_cyclonedds),
    (&["compare", "services"], "r2r", "r2r", build_r2r),
    (NETWORK, "zenoh", "zenoh", |of| build_rival("rival-zenoh", of)),
    (NETWORK, "hiroz", "hiroz", |of| build_rival("rival-hiroz", of)),
    (NETWORK, "tautline", "gateway", build_gateway),
    (&["network"], "tautline", "taut", build_taut),
    (COMPARE, "cyclonedds", "roudi", write_roudi),
];

/// The rivals of a bench, all or those of these systems.
pub fn rivals(bench: &str, systems: &[&str]) -> Vec<&'static Rival> {
    let is_wanted = |name: &str| systems.is_empty() || systems.contains(&name);
    RIVALS.iter().filter(|(benches, system, ..)| benches.contains(&bench) && is_wanted(system)).collect()
}

/// Builds rivals, and tells a bench where they are or why they are left out.
pub fn join(command: &mut Command, rivals: &[&Rival], of: Build) {
    for (_, _, name, build) in rivals {
        match build(of) {
            Ok(program) => command.arg(format!("--program={name}={}", program.display())),
            Err(reason) => command.arg(format!("--without={name}={reason}")),
        };
    }
}

/// With the Fast DDS of the ROS 2 that is sourced, else with that of the wheels; some seconds.
fn build_fastdds(build: Build) -> Result<PathBuf, String> {
    let prefix = r2r::prefix()?;
    let mut gcc = cpp("fastdds", build)?;
    gcc.command.arg("-isystem").arg(prefix.join("include")).arg("-L").arg(prefix.join("lib"));
    // RPATH, for RUNPATH does not reach what the libraries themselves need.
    let rpath = format!("-Wl,--disable-new-dtags,-rpath,{}/lib", prefix.display());
    gcc.command.args(["-lfastrtps", "-lfastcdr", "-lpthread", "-ldl", "-lm", &rpath]);
    gcc.finish()
}

/// Debian's packages of Cyclone DDS, of what it is linked with, and of iceoryx's daemon.
const CYCLONEDDS: &str = "iceoryx cyclonedds-dev libddsc0debian libiceoryx-binding-c2 libiceoryx-hoofs2 \
    libiceoryx-introspection2 libiceoryx-platform2 libiceoryx-posh-config2 libiceoryx-posh-roudi2 \
    libiceoryx-posh2";

/// With Debian's packages, unpacked under the target directory: nothing is installed.
fn build_cyclonedds(build: Build) -> Result<PathBuf, String> {
    let (root, lib) = cyclonedds_root()?;
    let include = root.join("usr/include");
    let mut gcc = cpp("cyclonedds", build)?;
    let by_machine = include.join(lib.file_name().unwrap_or_default());
    gcc.command.arg("-isystem").arg(&include).arg("-isystem").arg(by_machine);
    // All of them by name: the library's own RUNPATH hides ours from what it needs.
    gcc.command.args(["-Wl,--no-as-needed", "-lddsc"]).arg("-L").arg(&lib);
    for name in ["binding_c", "hoofs", "platform", "posh"] {
        gcc.command.arg(format!("-l:libiceoryx_{name}.so.2"));
    }
    let rpath = format!("-Wl,--disable-new-dtags,-rpath,{}", lib.display());
    gcc.command.args(["-lpthread", "-ldl", "-lm", &rpath]);
    gcc.finish()
}

/// Where the packages are unpacked, and their libraries among them.
fn cyclonedds_root() -> Result<(PathBuf, PathBuf), String> {
    let root = machine::target_dir().join("compare/cyclonedds-root");
    if !fs::read_to_string(root.join("complete")).is_ok_and(|there| there == CYCLONEDDS) {
        unpack(&root, CYCLONEDDS).map_err(|error| format!("Debian's packages cannot be had: {error}"))?;
    }
    let lib = fs::read_dir(root.join("usr/lib")).map_err(|error| error.to_string())?;
    let mut lib = lib.flatten().map(|entry| entry.path()).filter(|path| path.join("libddsc.so").exists());
    let lib = lib.next().ok_or("the packages have no libddsc.so")?;
    Ok((root, lib))
}

/// Chunks of iceoryx's daemon: their bytes, with some for headers, and their number.
const CHUNKS: [(usize, usize); 6] = [
    (1 << 10, 2000),
    (8 << 10, 1000),
    (64 << 10, 64),
    (512 << 10, 32),
    ((1 << 20) + (64 << 10), 64),
    (9 << 20, 12),
];

/// A script that runs the daemon with room for these payloads, by the packages' libraries.
fn write_roudi(_: Build) -> Result<PathBuf, String> {
    let (root, lib) = cyclonedds_root()?;
    let config = machine::target_dir().join("compare/roudi.toml");
    let mut text = "[general]\nversion = 1\n\n[[segment]]\n".to_owned();
    for (size, count) in CHUNKS {
        text += &format!("\n[[segment.mempool]]\nsize = {size}\ncount = {count}\n");
    }
    let script = format!(
        "LD_LIBRARY_PATH='{}' exec '{}' --monitoring-mode off --config-file '{}'",
        lib.display(),
        root.join("usr/bin/iox-roudi").display(),
        config.display()
    );
    files::write(&config, text)?;
    machine::script("compare/roudi", &script)
}

/// The gateway of this workspace: a minute from cold, for it has a Zenoh.
fn build_gateway(build: Build) -> Result<PathBuf, String> {
    Ok(folder_with(build, "tautline-gateway --bins")?.join("taut-gateway"))
}

fn build_taut(build: Build) -> Result<PathBuf, String> {
    Ok(folder_with(build, "taut")?.join("taut"))
}

/// Where a package of this workspace is built; that of the tests has all of them.
fn folder_with(of: Build, package: &str) -> Result<PathBuf, String> {
    of.with(&mut steps::cargo(&format!("build --release -p {package}")))
}

/// Fetches packages and unpacks them to a folder.
fn unpack(root: &Path, packages: &str) -> Result<(), String> {
    files::make_empty(root).map_err(files::at(root))?;
    let mut download = Command::new("apt-get");
    execute(download.args(["download", "--quiet"]).args(packages.split(' ')).current_dir(root))?;
    debian::unpack_all(root)?;
    // Written last: what was interrupted is fetched anew.
    files::write(&root.join("complete"), packages)
}

/// A minute from cold, with the programs of other benches.
fn build_r2r(of: Build) -> Result<PathBuf, String> {
    lab::r2r_program("compare-r2r", of)
}

/// From cold half a minute for taktora, whose iceoryx2 is not ours, and minutes for Zenoh, which its own rival and hiroz share.
fn build_rival(name: &str, of: Build) -> Result<PathBuf, String> {
    Ok(lab::folder_with(of, &format!("-p {name}"))?.join(name))
}

/// A program of one C++ file in the making.
struct Cpp {
    program: PathBuf,
    command: Command,
    sources: [PathBuf; 3],
}

/// With the Rust library that measures.
fn cpp(name: &str, of: Build) -> Result<Cpp, String> {
    let library = lab::folder_with(of, "-p tautline-rivals-cpp")?.join("librivals_cpp.a");
    let folder = machine::root().join("benches/rivals/cpp");
    let source = folder.join(format!("{name}.cpp"));
    let target = machine::target_dir().join("compare");
    fs::create_dir_all(&target).map_err(files::at(&target))?;
    let program = target.join(name);
    let mut command = Command::new("g++");
    // As cargo's release profile.
    command.args(["-std=c++17", "-O3", "-Wall", "-Wextra", "-Werror"]).arg(&source).arg("-o").arg(&program);
    command.arg(&library);
    Ok(Cpp { program, command, sources: [source, folder.join("exchange.hpp"), library] })
}

impl Cpp {
    fn finish(mut self) -> Result<PathBuf, String> {
        // Another installation that was sourced, or other flags: the same sources make another program.
        let (record, words) = (self.program.with_extension("command"), format!("{:?}", self.command));
        let is_same = fs::read_to_string(&record).is_ok_and(|built| built == words);
        if is_same && is_newer(&self.program, &self.sources).unwrap_or(false) {
            return Ok(self.program);
        }
        build(&mut self.command)?;
        files::write(&record, words)?;
        Ok(self.program)
    }
}

fn is_newer(file: &Path, others: &[PathBuf]) -> io::Result<bool> {
    let built = fs::metadata(file)?.modified()?;
    others.iter().try_fold(true, |newer, other| Ok(newer && fs::metadata(other)?.modified()? < built))
}
