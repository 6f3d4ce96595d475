// SPDX-License-Identifier: MIT OR Apache-2.0
//! `cargo xtask guests`: test executables, examples and the demo on emulated machines that are unlike this one: kernels with PREEMPT_RT, aarch64,
//! pages of 16 KiB. It shows that they work there, not how fast; nor that they get by with ARM's weak memory order, for the emulator orders memory
//! as this machine does.
//!
//! | module | holds |
//! |---|---|
//! | `image` | the file system that a guest starts with |
//! | `emulator` | a guest while it runs, and what it says |
//! | `init.sh` | its first process |

mod emulator;
mod image;

use crate::build::{SAME, TARGETS};
use crate::debian::{self, Architecture};
use crate::lints::{self, Executable};
use crate::ros::Distribution;
use crate::steps::{self, Outcome, Steps};
use crate::{examples, files, machine, packages, rmw, ros, word};
use clap::ValueEnum;
use emulator::Report;
use image::Image;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::{fs, io};

/// A kind of emulated machine.
#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Guest {
    /// x86-64, PREEMPT_RT
    RtX86,
    /// aarch64
    Arm64,
    /// aarch64, PREEMPT_RT
    RtArm64,
    /// aarch64, pages of 16 KiB
    #[value(name = "arm64-16k")]
    Arm64Pages16k,
}

/// How much is run.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Extent {
    /// What depends most on the kernel, in minutes.
    Quick,
    Whole,
    /// What the `.deb`s have that `cargo xtask dist` has made, and nothing that is built for tests.
    Packages,
}

/// What is built for a guest.
const PACKAGES: &str = "-p tautline-rt -p tautline-trace -p tautline-doorbell -p tautline-sampler -p tautline-executor \
                        -p tautline-transport -p tautline -p taut -p tautline-examples -p own-messages";

/// Folders of the packages whose tests are run.
const TESTED: [&str; 7] = ["rt", "trace", "transport/doorbell", "sampler", "executor", "transport", "node"];

/// Reads this repository's files.
const NOT_TESTED: &str = "transport/structure";

/// Executables of [`Extent::Quick`].
const QUICK: &str = "rt rt/realtime transport/doorbell sampler/timers executor/demotion executor/enforcer \
    executor/suspension transport/topics node/topics";

/// Its examples.
const QUICK_EXAMPLES: [&str; 2] = ["talker 5", "budget"];

/// What guests of these kinds need from the network.
pub fn prepare(guests: &[Guest]) -> Outcome {
    let emulators: Vec<_> = guests.iter().map(|guest| guest.architecture().emulator()[1]).collect();
    let missing = || match guests.iter().find(|guest| !guest.has_emulator()) {
        Some(guest) => Err(guest.architecture().emulator()[0]),
        None => Ok(()),
    };
    match packages::prepare(&emulators, missing) {
        Outcome::Ok => guests.iter().try_for_each(|guest| guest.unpack()).into(),
        other => other,
    }
}

/// The verb: these guests, or all if none is named.
pub fn run(steps: &mut Steps, named: &[Guest], extent: Extent) {
    let guests = if named.is_empty() { Guest::value_variants() } else { named };
    let is_prepared = steps.step("guests: packages", || match prepare(guests) {
        // It was asked for.
        Outcome::Skipped(reason) => Outcome::Failed(reason),
        other => other,
    });
    if is_prepared {
        let programs = build_for(steps, guests, extent, &format!("{PACKAGES} {SAME}"));
        test(steps, guests, extent, &programs);
    }
}

/// The programs that guests run, as far as they can be built: where this machine can run them, those of the tests' build of `targets`.
pub fn build_for(steps: &mut Steps, guests: &[Guest], extent: Extent, targets: &str) -> Programs {
    let mut programs = Vec::new();
    for architecture in Architecture::value_variants().iter().copied() {
        let mut of_architecture = guests.iter().filter(|guest| guest.architecture() == architecture);
        if extent == Extent::Packages {
            programs.push((architecture, Vec::new()));
        } else if of_architecture.any(|guest| guest.is_there()) {
            steps.step(&format!("guests: build for {architecture}"), || {
                build(architecture, targets).map(|built| programs.push((architecture, built)))
            });
        }
    }
    programs
}

/// A step for each guest, with the programs of [`build_for`]; then a table.
pub fn test(steps: &mut Steps, guests: &[Guest], extent: Extent, programs: &Programs) {
    let mut reports = Vec::new();
    for guest in guests {
        let name = format!("guest {}", word(*guest));
        let built = programs.iter().find(|(architecture, _)| *architecture == guest.architecture());
        match (guest.is_there(), built) {
            (false, _) => steps.skip(&name, "without its packages"),
            (true, None) => steps.skip(&name, "not built"),
            (true, Some((architecture, built))) => drop(steps.step(&name, || {
                let report = guest.run(|image| match extent {
                    Extent::Packages => package(*architecture, image),
                    _ => tests(built, extent, image),
                })?;
                let verdict = report.verdict();
                reports.push((word(*guest), report));
                verdict
            })),
        }
    }
    if !reports.is_empty() {
        emulator::print(&reports);
    }
}

/// By architecture.
pub type Programs = Vec<(Architecture, Vec<Executable>)>;

/// What runs on machines of this architecture.
fn build(architecture: Architecture, targets: &str) -> Result<Vec<Executable>, String> {
    let mut command = if architecture.is_here() {
        lints::json(&format!("{targets} {TARGETS}"))
    } else {
        let mut command = steps::cargo(&format!("build {PACKAGES} {TARGETS} --message-format=json"));
        debian::cross(&mut command, architecture)?;
        // Nobody debugs it.
        for (setting, value) in
            [("DEV_DEBUG", "none"), ("DEV_BUILD_OVERRIDE_DEBUG", "none"), ("DEV_STRIP", "debuginfo")]
        {
            command.env(format!("CARGO_PROFILE_{setting}"), value);
        }
        command.env("CARGO_INCREMENTAL", "0");
        command
    };
    let mut built = lints::executables(&mut command)?;
    built.sort_by(|one, other| (&one.folder, &one.target).cmp(&(&other.folder, &other.target)));
    Ok(built)
}

impl Guest {
    fn architecture(self) -> Architecture {
        match self {
            Guest::RtX86 => Architecture::Amd64,
            Guest::Arm64 | Guest::RtArm64 | Guest::Arm64Pages16k => Architecture::Arm64,
        }
    }

    /// Packages that depend on the newest kernel of a kind, as a Debian names them that has several, and any other.
    fn kernel(self) -> [&'static str; 2] {
        match self {
            Guest::RtX86 => ["linux-image-6.12-rt-amd64", "linux-image-rt-amd64"],
            Guest::Arm64 => ["linux-image-6.12-arm64", "linux-image-arm64"],
            Guest::RtArm64 => ["linux-image-6.12-rt-arm64", "linux-image-rt-arm64"],
            Guest::Arm64Pages16k => ["linux-image-6.12-arm64-16k", "linux-image-arm64-16k"],
        }
    }

    fn has_emulator(self) -> bool {
        packages::runs(self.architecture().emulator()[0], &["--version"])
    }

    /// Where its kernel, its shell and its libraries are.
    fn system(self) -> PathBuf {
        debian::folder().join(word(self))
    }

    fn is_there(self) -> bool {
        self.has_emulator() && debian::is_complete(&self.system())
    }

    fn unpack(self) -> Result<(), String> {
        let of = self.architecture();
        debian::unpack(&self.system(), || {
            let kernel = debian::newest(of, &self.kernel())?;
            let all = [&*kernel, "busybox-static", "libc6", "libgcc-s1", "util-linux"];
            Ok(all.map(|package| (of, package.to_owned())).to_vec())
        })
    }

    /// Makes its file system, whose `pack` returns its jobs, and boots it.
    fn run(self, pack: impl FnOnce(&mut Image) -> io::Result<String>) -> Result<Report, String> {
        let (system, name, of) = (self.system(), word(self), self.architecture());
        let path = debian::folder().join(format!("{name}.cpio"));
        let packed = Image::new(&path, &system, of).and_then(|mut image| {
            let jobs = pack(&mut image)?;
            image.file("jobs", jobs.as_bytes())?;
            image.finish()
        });
        packed.map_err(files::at(&path))?;
        emulator::run(&name, of, &image::kernel(&system)?, &path)
    }
}

/// Tests, examples and the demo.
fn tests(built: &[Executable], extent: Extent, image: &mut Image) -> io::Result<String> {
    let mut jobs = String::new();
    for executable in built {
        let folder = executable.folder.strip_prefix(machine::root()).unwrap_or(&executable.folder);
        if let Some(name) = tested(executable, folder, extent) {
            image.program(&format!("tests/{}", name.replace('/', "-")), &executable.path)?;
            jobs += &format!("tests {name}\n");
        } else if !executable.is_test && (folder.starts_with("examples") || executable.target == "taut") {
            image.program(&format!("programs/{}", executable.target), &executable.path)?;
        }
    }
    let is_wanted = |programs: &&[&str]| extent == Extent::Whole || QUICK_EXAMPLES.contains(&programs[0]);
    for programs in examples::RUNS.into_iter().filter(is_wanted) {
        for name in programs.iter().map(|program| examples::name_of(program)) {
            image.file(&format!("expected/{name}.txt"), &fs::read(examples::expected(name))?)?;
        }
        jobs += &format!("program 'example {0}' /init together '{0}'\n", programs.join("|"));
    }
    // Examples look for their system files where they were built.
    for file in fs::read_dir(machine::root().join("examples/systems"))?.flatten().map(|file| file.path()) {
        if file.is_file() {
            image.file(file.to_string_lossy().trim_start_matches('/'), &fs::read(&file)?)?;
        }
    }
    Ok(jobs + "program demo taut demo --seconds 3\nprogram doctor /init doctor\n")
}

/// The programs of the `.deb`, as they are in it, and the libraries of those for ROS 2.
fn package(architecture: Architecture, image: &mut Image) -> io::Result<String> {
    for program in fs::read_dir(unpack_deb("tautline", "deb", architecture)?.join("usr/bin"))?.flatten() {
        let name = format!("programs/{}", program.file_name().to_string_lossy());
        image.file(&name, &fs::read(program.path())?)?;
    }
    let mut jobs = String::from(
        "program version taut --version\nprogram bounds /init bounds\nprogram hosts /init hosts\n\
         program demo taut demo --seconds 3\nprogram doctor /init doctor\n",
    );
    for distribution in Distribution::value_variants() {
        ros::choose(*distribution);
        let distribution = ros::distribution();
        let package = format!("ros-{distribution}-rmw-tautline");
        if !deb(&package, architecture).is_file() {
            println!(
                "no {package}: `cargo xtask dist --only rmw-deb --architecture {architecture}` makes it"
            );
            continue;
        }
        let deb = unpack_deb(&package, "rmw-deb", architecture)?;
        let library = deb.join("opt/ros").join(&distribution).join("lib/librmw_tautline.so");
        for (name, path) in rmw::cross::loaded(&library, architecture).map_err(io::Error::other)? {
            image.file(&format!("{distribution}/{name}"), &fs::read(path)?)?;
        }
        jobs += &format!("program 'rmw_tautline for {distribution}' /{distribution}/load\n");
    }
    Ok(jobs)
}

/// A package that `cargo xtask dist` makes.
fn deb(package: &str, architecture: Architecture) -> PathBuf {
    let name = format!("{package}_{}_{architecture}.deb", env!("CARGO_PKG_VERSION"));
    machine::target_dir().join("dist").join(name)
}

/// What is in it.
fn unpack_deb(package: &str, part: &str, architecture: Architecture) -> io::Result<PathBuf> {
    let (deb, to) = (deb(package, architecture), debian::folder().join("package"));
    let _ = fs::remove_dir_all(&to);
    steps::execute(Command::new("dpkg").arg("-x").args([&deb, &to])).map_err(|reason| {
        let make = format!("cargo xtask dist --only {part} --architecture {architecture}");
        io::Error::other(format!("{}: {reason}: `{make}` makes it", deb.display()))
    })?;
    Ok(to)
}

/// The name by which an executable's tests are shown, if they are run. A library's have its folder's name.
fn tested(executable: &Executable, folder: &Path, extent: Extent) -> Option<String> {
    let folder = folder.to_str().filter(|folder| executable.is_test && TESTED.contains(folder))?;
    let is_library = executable.target.starts_with("tautline");
    let name = if is_library { folder.to_owned() } else { format!("{folder}/{}", executable.target) };
    let is_wanted = extent == Extent::Whole || QUICK.split(' ').any(|quick| quick == name);
    (is_wanted && name != NOT_TESTED).then_some(name)
}
