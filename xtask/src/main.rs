// SPDX-License-Identifier: MIT OR Apache-2.0
//! What CI runs and what people run, as `cargo xtask <verb>`.

mod api;
mod background;
mod bench;
mod book;
mod bridge;
mod build;
mod ci;
mod colcon;
mod compare;
mod compiler;
mod debian;
mod dependencies;
mod dist;
mod examples;
mod files;
mod first;
mod fuzz;
mod guests;
mod headers;
mod lab;
mod lints;
mod locks;
mod lttng;
mod machine;
mod packages;
mod pages;
mod peers;
mod programs;
mod r2r;
mod r2r_tests;
mod readme;
mod release;
mod reports;
mod rmw;
mod ros;
mod running;
mod shared;
mod steps;
mod test;
mod tools;
mod with_ros;

use bench::Bench;
use build::{Build, SAME};
use clap::{Parser, Subcommand, ValueEnum};
use dist::Part;
use guests::{Extent, Guest};
use std::path::PathBuf;
use std::process::{Command, ExitCode};
use steps::Steps;

/// What `test` and `ci` are told.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  cargo xtask test --only tests
  cargo xtask ci --only 'bench: domain,stress'   on what the last build has made
  cargo xtask ci --only 'build and lints,bench'  on a new one")]
struct All {
    /// Keep cargo's reports of where the time of builds goes, under target/cargo-timings
    #[arg(long)]
    timings: bool,
    /// Only the steps whose names begin so, for example to repeat one that failed
    #[arg(long, value_name = "STEP,...", value_delimiter = ',')]
    only: Vec<String>,
}

impl All {
    fn tell(self) {
        steps::keep_timings(self.timings);
        steps::run_only(self.only);
    }
}

/// Which ROS 2.
#[derive(clap::Args)]
struct Ros {
    /// Its distribution, if it comes from PyPI
    #[arg(long, value_enum, default_value_t)]
    distro: ros::Distribution,
}

/// The tasks of this workspace.
#[derive(Parser)]
#[command(bin_name = "cargo xtask")]
struct Cli {
    #[command(subcommand)]
    verb: Verb,
}

#[derive(Subcommand)]
enum Verb {
    /// What is run before each commit: format, lints, tests, doc tests, demo, examples, models
    Test(All),
    /// The rest of what CI runs: ROS 2, bridge, RMW, Zenoh and its peers, network namespaces, stress, smoke tests of benches, miri, fuzz
    Ci(All),
    /// Some steps of `ci`, which starts it
    #[command(hide = true)]
    Background {
        #[arg(value_enum)]
        job: ci::Job,
        /// Where it is written how they ended
        to: PathBuf,
        #[command(flatten)]
        all: All,
    },
    /// Documents the workspace, and compares the public surface of `tautline` with node/api.txt
    Api {
        /// Write the surface to node/api.txt
        #[arg(long)]
        bless: bool,
    },
    /// Reads from the tests' machine code that no lock without priority inheritance is reached from a hot.rs
    Locks,
    /// Runs each example and compares what it prints with examples/expected
    Examples {
        /// Write what the examples print to examples/expected
        #[arg(long)]
        bless: bool,
    },
    /// Builds the documentation as a book, into the target directory's `book`, and checks the links of all documents
    Book,
    /// Checks licences, sources, duplicates, vulnerabilities and `rust-version` of what all workspaces depend on
    Dependencies,
    /// Builds the README's first command as on a fresh clone, and checks how many units wait for one another
    First,
    /// Makes a real ROS 2 from PyPI under target/ros or target/ros-kilted; tests compare with it, and bridge and RMW are built with it
    Ros(Ros),
    /// Lints and tests the bridge to ROS 2, with the ROS 2 that is sourced, else with that of `cargo xtask ros`
    Bridge(Ros),
    /// Builds rmw_tautline for the ROS 2 that is sourced, else for that of `cargo xtask ros`, and says how nodes run on it
    Rmw {
        /// Run its lints and tests instead
        #[arg(long)]
        test: bool,
        #[command(flatten)]
        ros: Ros,
    },
    /// Tests the gateway against hiroz, zenoh-ros2-sdk (made under target/peers) and an rmw_zenoh_cpp that is sourced or that
    /// `TAUT_RMW_ZENOH` names; minutes to build
    Peers(Ros),
    /// Runs the programs of the tests of tautline-r2r on r2r, with the ROS 2 that is sourced or that under target/ros
    R2r,
    /// Builds r2r's own tests and examples, unchanged, on Tautline, and runs them; some minutes
    R2rTests,
    /// Measures
    #[command(
        subcommand,
        after_help = "What a bench is told is passed on to its own program:
  cargo xtask bench compare --help
  cargo xtask bench compare --systems tautline,iceoryx2,fastdds --only latency
  cargo xtask bench wake --quick
  cargo xtask bench paper --results paper.runs --minutes 30

Besides, where r2r has a side (paper, reference-system, alks):
  --no-r2r   leave it out
and where the program does not know it (bridge, reference-system, alks):
  --quick    runs of 2, 3 and 5 seconds instead of 30, 20 and 60, unless there is --seconds

r2r's side is built with the ROS 2 that is sourced, else with one from PyPI under target/ros. A
rival that cannot be built here is named in the report, with the reason. Zenoh and hiroz take
minutes to build."
    )]
    Bench(Bench),
    /// Runs the demo and the benches and puts their tables and pictures into docs/demo.md, docs/benchmarks.md and the README, those of
    /// domains into docs/adr/0007
    #[command(after_help = "Examples:
  cargo xtask readme                             all of it, some hours
  cargo xtask readme --only demo,wake
  cargo xtask readme --only paper --minutes 60   an hour more of the evaluation, and the table of all hours so far")]
    Readme {
        /// Fewer payloads, rounds and runs of the benches
        #[arg(long)]
        quick: bool,
        /// Only these parts [default: all]
        #[arg(long, value_name = "PART,...", value_delimiter = ',', value_enum)]
        only: Vec<readme::Part>,
        /// Stop the evaluation after so many minutes; the next time goes on
        #[arg(long, value_name = "N")]
        minutes: Option<u64>,
    },
    /// Runs the tests of unsafe code under miri: `rustup component add miri --toolchain nightly`
    Miri,
    /// Gives the decoders, views, writers and parsers inputs made up by libFuzzer, under the address sanitizer
    #[command(after_help = "Examples:\n  cargo xtask fuzz\n  cargo xtask fuzz --runs 50000 view fill")]
    Fuzz {
        /// Inputs per target
        #[arg(long, value_name = "N", default_value_t = 1_000_000)]
        runs: u64,
        /// The targets; all if none is named
        #[arg(value_name = "TARGET", value_parser = fuzz::TARGETS)]
        targets: Vec<String>,
    },
    /// Runs tests, the examples and the demo on emulated machines: PREEMPT_RT, aarch64, pages of 16 KiB
    #[command(after_help = "Examples:
  cargo xtask guests                          all, an hour: for aarch64 everything is built once more
  cargo xtask guests --only rt-x86 --quick    what CI runs, some minutes
  cargo xtask guests --only arm64-16k
  cargo xtask guests --only arm64 --packages  what `cargo xtask dist --architecture arm64` has made

QEMU emulates them (Debian: qemu-system-x86, qemu-system-arm; for aarch64 also gcc-aarch64-linux-gnu);
kernels are Debian's, fetched with apt-get. It shows that programs work there, not how fast, nor that
they get by with ARM's weak memory order.")]
    Guests {
        /// Only these machines [default: all]
        #[arg(long, value_name = "GUEST,...", value_delimiter = ',', value_enum)]
        only: Vec<Guest>,
        /// Only what depends most on the kernel
        #[arg(long)]
        quick: bool,
        /// Instead of tests, start the programs of the `.deb`s that `cargo xtask dist` has made, and load rmw_tautline
        #[arg(long, conflicts_with = "quick")]
        packages: bool,
    },
    /// Makes what is installed without a checkout, of a release build, into the target directory's `dist`
    #[command(after_help = "Examples:
  cargo xtask dist                     all, some minutes
  cargo xtask dist --only tarball,deb
  cargo xtask dist --architecture arm64   for Raspberry Pi 5 and others: all but wheels of rmw_tautline, crates, SBOM
  cargo xtask dist --only crates       also checks that all published crates build without this repository

Wheels need Python 3.10 to 3.13 and PyPI, the SBOM a tool that is built in a minute. Each file names a glibc of 2.35 at most, or it is refused.")]
    Dist {
        /// Only these parts [default: all]
        #[arg(long, value_name = "PART,...", value_delimiter = ',', value_enum)]
        only: Vec<Part>,
        /// Programs for machines of this architecture, cross-compiled unless it is this machine's, which is the default
        #[arg(long, value_name = "NAME", value_enum)]
        architecture: Option<debian::Architecture>,
        /// Build the programs of the last commit once more in another folder, and compare their bytes
        #[arg(long, conflicts_with = "architecture")]
        verify: bool,
        /// rmw_tautline for this ROS 2 alone [default: a `.deb` for each, one wheel for all]
        #[arg(long, value_enum)]
        distro: Option<ros::Distribution>,
    },
    /// Checks that all is committed, has one version and a section in the changelog; makes the packages and tags the commit, here alone
    Release {
        /// Check, and say what would be made
        #[arg(long)]
        dry_run: bool,
    },
    /// Compares the crates' surfaces with those of the last tag, with cargo-semver-checks, which it builds unless it is there
    Semver,
    /// Runs a program beside that of the last tag, or of another layout of shared memory: neither may misread the other
    Versions,
    /// Tries to break something by doing it very often
    #[command(subcommand)]
    Stress(Stress),
}

#[derive(Subcommand)]
enum Stress {
    /// Rings the doorbell from four processes; none may be lost
    Doorbell {
        /// How often
        #[arg(long, value_name = "N", default_value_t = 10_000_000)]
        rings: u64,
    },
    /// Kills processes at random instants, and at each of their system calls; others must not notice
    #[command(after_help = "Examples:
  cargo xtask stress kills
  cargo xtask stress kills --kills 20000 --seed 7
  cargo xtask stress kills --exhaustive
  cargo run --release -p tautline-kills -- syscalls --at attach:212:after")]
    Kills {
        /// How many processes are killed at random instants
        #[arg(long, value_name = "N", default_value_t = 1000)]
        kills: u64,
        /// What is random goes by this [default: random]
        #[arg(long, value_name = "S")]
        seed: Option<u64>,
        /// At every system call instead of 2,400 of them
        #[arg(long)]
        exhaustive: bool,
    },
}

fn main() -> ExitCode {
    if compiler::is_meant() {
        return compiler::run();
    }
    // SAFETY: before there is another thread.
    let scope = unsafe { machine::Scope::enter() };
    match Cli::parse().verb {
        Verb::Test(all) => {
            all.tell();
            as_steps(|steps| test::run(steps, &scope))
        }
        Verb::Ci(all) => {
            all.tell();
            as_steps(|steps| ci::run(steps, &scope))
        }
        Verb::Background { job, to, all } => {
            all.tell();
            exit(job.run().hand_over(&to))
        }
        Verb::Api { bless } => as_steps(|steps| {
            r2r::prepare_libclang(steps, false);
            steps.step("api", || api::check(bless));
        }),
        Verb::Locks => as_steps(|steps| {
            r2r::prepare_libclang(steps, false);
            steps.step("locks", || locks::check(&build::most()));
        }),
        Verb::Examples { bless } => as_steps(|steps| {
            let mut build =
                steps::cargo("build --release -p tautline-examples -p own-messages --examples --bins");
            let built = steps.command("examples: build", &mut build);
            examples::run(steps, built, Build::Release, bless);
        }),
        Verb::Book => as_steps(book::test),
        Verb::Dependencies => as_steps(dependencies::test),
        Verb::First => as_steps(first::test),
        Verb::Ros(Ros { distro }) => {
            ros::choose(distro);
            exit(r2r::run())
        }
        Verb::Bridge(Ros { distro }) => {
            ros::choose(distro);
            as_steps_with_ros(bridge::test)
        }
        Verb::Rmw { test, ros: Ros { distro } } => {
            ros::choose(distro);
            if test { as_steps_with_ros(|steps| _ = rmw::test(steps)) } else { exit(rmw::run()) }
        }
        Verb::Peers(Ros { distro }) => {
            ros::choose(distro);
            as_steps_with_ros(peers::build_and_test)
        }
        Verb::R2r => as_steps_with_ros(programs::test),
        Verb::R2rTests => as_steps_with_ros(|steps| r2r_tests::build(steps).run(steps)),
        Verb::Bench(bench) => exit(bench.run()),
        Verb::Readme { quick, only, minutes } => exit(readme::run(quick, minutes, &only)),
        Verb::Miri => as_steps(ci::miri),
        Verb::Fuzz { runs, targets } => as_steps(|steps| fuzz::run(steps, runs, &targets)),
        Verb::Guests { only, quick, packages } => as_steps(|steps| {
            let extent = match (quick, packages) {
                (_, true) => Extent::Packages,
                (true, _) => Extent::Quick,
                _ => Extent::Whole,
            };
            guests::run(steps, &only, extent);
        }),
        Verb::Dist { only, architecture, verify, distro } => as_steps(|steps| {
            let architecture = architecture.unwrap_or_else(debian::Architecture::here);
            dist::run(steps, &only, architecture, verify, distro);
        }),
        Verb::Release { dry_run } => as_steps(|steps| release::run(steps, dry_run)),
        Verb::Versions => as_steps(|steps| _ = steps.step("versions", release::beside_another_version)),
        Verb::Semver => as_steps(|steps| _ = steps.step("semver", || release::semver(true))),
        Verb::Stress(Stress::Doorbell { rings }) => {
            exit(steps::execute(&mut stress_doorbell(Build::Release, rings)))
        }
        Verb::Stress(Stress::Kills { kills, seed, exhaustive }) => {
            as_steps(|steps| stress_kills(steps, Build::Release, kills, seed, exhaustive))
        }
    }
}

/// As it is written on the command line.
fn word(value: impl ValueEnum) -> String {
    value.to_possible_value().map_or_else(String::new, |value| value.get_name().to_owned())
}

/// A verb that is steps.
fn as_steps(run: impl FnOnce(&mut Steps)) -> ExitCode {
    let mut steps = Steps::new();
    run(&mut steps);
    steps.finish()
}

/// One with builds that need libclang.
fn as_steps_with_ros(run: impl FnOnce(&mut Steps)) -> ExitCode {
    as_steps(|steps| {
        r2r::prepare_libclang(steps, true);
        run(steps);
    })
}

/// The end of a verb that is one task.
fn exit(result: Result<(), String>) -> ExitCode {
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(reason) => {
            eprintln!("FAILED: {reason}");
            ExitCode::FAILURE
        }
    }
}

fn stress_doorbell(build: Build, rings: u64) -> Command {
    const TESTS: &str = "test -p tautline-doorbell --lib stress";
    let mut command = match build {
        Build::Release => steps::cargo(&format!("{TESTS} --release -- --nocapture")),
        // The doorbell is optimised in it, too.
        Build::Tests => lints::cargo(&format!("{TESTS} {SAME} -- --nocapture")),
    };
    command.env("TAUT_STRESS_RINGS", rings.to_string());
    command
}

/// At random instants, then at system calls. Containers are among the processes: in one go, so that all have the same features.
fn stress_kills(steps: &mut Steps, build: Build, kills: u64, seed: Option<u64>, exhaustive: bool) {
    let programs = "build --release -p tautline-kills -p tautline-container -p tautline-demo-components";
    if build == Build::Release && !steps.command("stress: kills: build", &mut steps::cargo(programs)) {
        return steps.skip("stress: kills", "not built");
    }
    let folder = build.folder();
    // Before what cargo has put there for this program, which has another build of the same library.
    let libraries = machine::path_with("LD_LIBRARY_PATH", &folder);
    let command = |arguments: &str| {
        let mut command = Command::new(folder.join("kills"));
        command.env("LD_LIBRARY_PATH", &libraries);
        command.args(arguments.split(' ')).args(seed.map(|seed| format!("--seed={seed}")));
        // Beside builds, times say nothing.
        command.args((build == Build::Tests).then_some("--no-limits"));
        command
    };
    steps.command("stress: kills at random", &mut command(&format!("random --kills {kills}")));
    let all = if exhaustive { "syscalls --all" } else { "syscalls" };
    steps.command("stress: kills at system calls", &mut command(all));
}

#[cfg(test)]
mod tests {
    use super::*;

    /// There is no Docker where CI runs: what the image installs, CI installs elsewhere.
    #[test]
    fn the_image_is_made_of_a_deb_and_run_as_the_documents_say() {
        let root = machine::root();
        let read = |file: &str| std::fs::read_to_string(root.join(file)).unwrap();
        let (image, page) = (read("Containerfile"), read("docs/deployment.md"));
        let after = |begin: &str| image.lines().find_map(|line| line.strip_prefix(begin)).unwrap();
        let Verb::Dist { only, .. } = Cli::parse_from(after("RUN cargo ").split(' ')).verb else {
            panic!("the image is not made by `dist`");
        };
        assert!(only == [Part::Deb]);
        let (options, _) = after("#   docker run ").split_once(" tautline").unwrap();
        assert!(page.contains(&format!("docker run {options} tautline")), "{options}");
        let reasons = image.lines().filter(|line| line.starts_with("# --")).collect::<String>();
        for option in options.split(" --").filter(|option| *option != "--rm") {
            let name = option.split([' ', '=']).next().unwrap_or_default();
            assert!(reasons.contains(&format!("--{name}")), "{name}");
        }
    }
}
