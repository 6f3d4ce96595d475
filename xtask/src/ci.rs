// SPDX-License-Identifier: MIT OR Apache-2.0
//! `cargo xtask ci`: what [`mod@test`] leaves out. The order is that of the build: what shares artefacts is adjacent. Benches run in
//! the tests' build, unoptimised: that they run and keep their promises is checked, what they measure belongs to a quiet machine and a release
//! build.

use crate::background::Background;
use crate::bench::{self, Name};
use crate::build::{Build, TARGETS, WHOLE, WITH_GATEWAY, WITH_ROS};
use crate::debian::{self, Architecture};
use crate::guests::{Extent, Guest};
use crate::machine::{self, Scope};
use crate::ros::Distribution;
use crate::steps::{Outcome, Steps, cargo, execute, reported};
use crate::test::{self, nextest};
use crate::{
    api, book, bridge, dependencies, dist, first, fuzz, guests, lab, lints, lttng, packages, peers, programs,
    r2r, r2r_tests, release, reports, rmw, ros, shared, stress_doorbell, stress_kills, word,
};
use clap::ValueEnum;
use std::path::Path;
use std::process::Command;

/// Enough to meet every interleaving of a race that is there; `cargo xtask stress doorbell` has no such limit.
const RINGS: u64 = 1_000_000;

/// Within two minutes; `cargo xtask stress kills` kills as many as it is told to.
const KILLS: u64 = 1000;

/// Without a build of its own; `cargo xtask guests` has more of them.
const GUESTS: [Guest; 1] = [Guest::RtX86];

/// Steps in the background of others: while these build, those wait, or the other way round. Cargo lets one build go on at a time, so that
/// all others of that time do without it; `cargo install` has a folder of its own.
#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Job {
    /// What comes from the network, or is looked up there.
    Prepare,
    /// The documentation, for which mdBook is built, and the first command, a release build.
    Book,
    /// What is built for a step alone, and takes the place of nothing but the RMW.
    Apart,
    /// What takes the place of `taut` and other programs of the tests' build: meanwhile nobody runs these.
    Variants,
    /// What has builds of its own: meanwhile the other distribution's tests wait for processes, and nothing is measured.
    Others,
}

impl Job {
    fn start(self) -> Background {
        // What else runs meanwhile is measured, or waits for others only so long; a download is waited for.
        let niceness = if self == Job::Prepare { 0 } else { 10 };
        Background::start(&word(self), niceness)
    }

    /// Its steps.
    pub fn run(self) -> Steps {
        let mut steps = Steps::new();
        match self {
            Job::Prepare => {
                prepare(&mut steps);
                dependencies::test(&mut steps);
            }
            Job::Book => {
                book::test(&mut steps);
                first::test(&mut steps);
            }
            Job::Apart => {
                examples_by_themselves(&mut steps);
                for_aarch64(&mut steps);
                dist::test_crates(&mut steps);
                peers::test(&mut steps);
            }
            Job::Variants => {
                fuzz::run(&mut steps, fuzz::RUNS_IN_CI, &[]);
                lttng::test(&mut steps);
            }
            Job::Others => {
                miri(&mut steps);
                steps.step("versions", release::beside_another_version);
                steps.step("semver", || release::semver(false));
            }
        }
        steps
    }
}

/// Runs every step, whatever fails.
pub fn run(steps: &mut Steps, scope: &Scope) {
    r2r::prepare_libclang(steps, true);
    let prepared = Job::Prepare.start();
    formats(steps);
    let built = lints::build(steps, "build and lints", &format!("{WHOLE} {TARGETS}"));
    steps.join(prepared);
    steps.step("public surface", || api::check(false));
    steps.step("builds are shared", shared::check);
    let book = Job::Book.start();
    rest_of_tests(steps);
    bridge::test(steps);
    let has_rmw = rmw::test(steps);
    dist::test(steps, has_rmw);
    let has_release = steps.join(book);
    clock_step(steps);
    if has_release {
        demo_as_released(steps);
    } else {
        steps.skip("demo as released", "a step before it failed: it may not have been built");
    }
    programs::test(steps);
    steps.command("stress: doorbell", &mut stress_doorbell(Build::Tests, RINGS));
    let built = lab::test(steps) && built;
    if let Some(environment) = r2r::environment_of(steps, "benches with ROS 2") {
        lab::build_with_ros(steps, &environment);
        bridge_bench(steps);
        // Nothing is lost; how it compares is for a quiet machine and a release build.
        quick(steps, Name::Rmw, machine::no_rt());
    }
    let r2r = r2r_tests::build(steps);
    if built {
        let programs = guests::build_for(steps, &GUESTS, Extent::Quick, WHOLE);
        let apart = Job::Apart.start();
        guests::test(steps, &GUESTS, Extent::Quick, &programs);
        r2r.run(steps);
        of_the_build(steps);
        steps.join(apart);
        let variants = Job::Variants.start();
        of_the_build_without_taut(steps);
        steps.join(variants);
    } else {
        steps.skip("what runs in the tests' build", "not built");
    }
    // The library of the build is Kilted's from here on. Its tests have threads of real-time priorities, beside which nothing is measured.
    let others = Job::Others.start();
    ros::choose(Distribution::Kilted);
    let has_rmw = rmw::test(steps);
    dist::test_rmw(steps, has_rmw);
    bridge::test(steps);
    steps.join(others);
    test::leftovers(steps, scope);
}

/// Systems and benches.
fn of_the_build(steps: &mut Steps) {
    reference_system(steps);
    lane_keeping(steps);
    two_hosts(steps);
    systemd(steps);
    // What they say belongs to the machine.
    for name in [Name::Budgets, Name::Deadlines, Name::Trace, Name::Tools, Name::Parameters] {
        quick(steps, name, None);
    }
    comparison(steps, Name::Wake, OURS);
    comparison(steps, Name::Services, "tautline,iceoryx2");
    comparison(steps, Name::Network, "tautline");
}

/// What does not run `taut`: what may be killed, and more benches.
fn of_the_build_without_taut(steps: &mut Steps) {
    stress_kills(steps, Build::Tests, KILLS, None, false);
    // No process hangs or leaves anything, and every encoder writes the same bytes.
    quick(steps, Name::Domain, None);
    quick(steps, Name::Messages, None);
    comparison(steps, Name::Compare, &format!("{OURS},fastdds,taktora,zenoh"));
    paper(steps);
}

/// What tests compare with, and Debian's packages. What there is no network for is skipped, but not in CI.
fn prepare(steps: &mut Steps) {
    steps.step("ros", || Outcome::from(ros::prepare()).unless_ci());
    steps.step("peers: zenoh-ros2-sdk", peers::prepare);
    steps.step("gateway: packages", packages::firewall);
    steps.step("lttng: packages", lttng::prepare);
    steps.step("guests: packages", || guests::prepare(&GUESTS).unless_ci());
    steps.step("for aarch64: compiler", || debian::compiler(Architecture::Arm64).map(drop));
    ros::choose(Distribution::Kilted);
    steps.step(&ros::step("ros"), || Outcome::from(ros::prepare()).unless_ci());
}

/// Workspaces that are no part of [`mod@test`].
fn formats(steps: &mut Steps) {
    for folder in ["bridge-ros", "node/r2r", "rmw"] {
        let format = format!("fmt --manifest-path {folder}/Cargo.toml --check");
        steps.command(&format!("fmt: {folder}"), &mut cargo(&format));
    }
}

/// The gateway's after the others: it mirrors what other tests of its domains do.
fn rest_of_tests(steps: &mut Steps) {
    nextest(steps, "tests: beside ROS 2", WHOLE, WITH_ROS, 1);
    nextest(steps, "tests: gateway", WHOLE, WITH_GATEWAY, 1);
    // Of all: for some packages alone, cargo would build what they need with other features.
    steps.command("doc tests: all", &mut lints::cargo(&format!("test {WHOLE} --no-fail-fast --doc")));
}

/// The README's examples as a user builds them, with no more messages than each names.
fn examples_by_themselves(steps: &mut Steps) {
    let packages = "-p tautline-examples -p own-messages -p xtask-host-features";
    steps.command("examples by themselves", &mut cargo(&format!("check {packages} --examples --bins")));
}

/// What a Raspberry Pi 5 or a Jetson runs, as far as compiler and linker can tell; `cargo xtask guests` runs it on emulated machines.
fn for_aarch64(steps: &mut Steps) {
    steps.step("for aarch64", || {
        let mut command = cargo("build --locked --release -p tautline -p taut");
        // It is not run here.
        command.env("CARGO_PROFILE_RELEASE_OPT_LEVEL", "0");
        execute(debian::cross(&mut command, Architecture::Arm64)?)
    });
}

/// Three seconds of the first command, while nothing else runs. It was built, unless another build was there before.
fn demo_as_released(steps: &mut Steps) {
    let mut demo = cargo("run --release --locked -- demo --seconds 3");
    steps.command("demo as released", &mut demo);
}

/// Three seconds of the Autoware reference system: all of its nodes run, and its report keeps its promises. And a second of it beside r2r.
fn reference_system(steps: &mut Steps) {
    let target = machine::target_dir();
    let (json, svg) = (target.join("reference.json"), target.join("reference.svg").display().to_string());
    let run = |told: &[&str], beside: bool| {
        let mut command = Command::new(Build::Tests.folder().join("reference_system"));
        command.args(told).arg("--json").arg(&json).args(machine::no_rt());
        let given = [("realtime", machine::no_rt().is_none().into()), ("beside", beside.into())];
        reported(&mut command, &json, || reports::REFERENCE.of(&json, &given))
    };
    steps.step("reference system", || run(&["--seconds", "3", "--svg", &svg], false));
    beside_r2r(steps, "reference system", Name::ReferenceSystem, |program| {
        run(&["--seconds", "1", "--rounds", "1", "--r2r", program], true)
    });
}

/// Three seconds of the automated lane keeping system in each way to share, and two beside r2r: the lane is kept and hardly a message lost.
/// Its bounds are for a machine that does nothing else.
fn lane_keeping(steps: &mut Steps) {
    let target = machine::target_dir();
    let (json, page) = (target.join("alks.json"), target.join("alks.html"));
    let run = |told: &[&str]| {
        let _ = std::fs::remove_file(&json);
        let mut command = Command::new(Build::Tests.folder().join("alks"));
        command.args(told).args(["--rounds", "1", "--json"]).arg(&json).arg("--html").arg(&page);
        command.args(machine::no_rt());
        // What it says of bounds is not judged here.
        let _ = execute(&mut command);
        reports::LANE.of(&json, &[])
    };
    steps.step("lane keeping", || run(&["--seconds", "3", "--without-r2r", "a step of its own"]));
    beside_r2r(steps, "lane keeping", Name::Alks, |program| run(&["--seconds", "2", "--r2r", program]));
}

/// The same beside r2r's program, where there is a ROS 2.
fn beside_r2r(steps: &mut Steps, name: &str, bench: Name, run: impl FnOnce(&str) -> Result<(), String>) {
    let run = || run(&lab::r2r_program(bench.r2r().unwrap_or_default(), Build::Tests)?.display().to_string());
    steps.step(&format!("{name}: beside r2r"), || Outcome::from(run()).unless_ci());
}

/// Nodes with a gateway on each side, of the tests' build.
fn two_hosts(steps: &mut Steps) {
    let gateway = Build::Tests.folder().join("taut-gateway");
    for (name, program) in [("example two_hosts", "talker"), ("example remote_image", "remote_image")] {
        let mut command = Command::new("timeout");
        command.arg("60").arg(machine::root().join("examples/two_hosts.sh")).args(["5", program]);
        command.env("TAUT_GATEWAY", &gateway).env("TAUT_BUILT", Build::Tests.folder());
        if machine::no_rt().is_some() {
            command.env("TAUT_REALTIME", "off");
        }
        steps.command(name, &mut command);
    }
}

/// What systemd says of the gateway's unit, with this build's program in it.
fn systemd(steps: &mut Steps) {
    let name = "systemd unit";
    if Command::new("systemd-analyze").arg("--version").output().is_err() {
        return steps.skip(name, "no systemd-analyze here");
    }
    let path = machine::target_dir().join("taut-gateway@0.service");
    let write = || {
        let unit = std::fs::read_to_string(machine::root().join("docs/systemd/taut-gateway@.service"))?;
        let program = Build::Tests.folder().join("taut-gateway").display().to_string();
        std::fs::write(&path, unit.replace("/usr/local/bin/taut-gateway", &program))
    };
    steps.step(name, || {
        write().map_err(|error| error.to_string())?;
        execute(Command::new("systemd-analyze").arg("verify").arg(&path))
    });
}

/// Sets the system's clock by an hour for some milliseconds, which is nothing to do on somebody's own machine.
fn clock_step(steps: &mut Steps) {
    if !machine::is_ci() {
        return steps.skip("clock step", "sets the system's clock: only where CI is set");
    }
    // Of all packages: for one alone, cargo would build what it needs with other features.
    let mut command = lints::cargo(&format!("test {WHOLE} --test clock_step"));
    steps.command("clock step", command.env("TAUT_STEP_CLOCK", "1"));
}

/// A bench of the tests' build runs, and the numbers that it writes to `<name>.json` keep their promises. What cannot be had here is left out, but
/// not in CI.
fn bench<'t>(
    steps: &mut Steps,
    name: Name,
    told: impl IntoIterator<Item = &'t str>,
    check: impl FnOnce(&Path) -> Result<(), String>,
) {
    let json = machine::target_dir().join(format!("{}.json", word(name)));
    let file = json.display().to_string();
    let told = told.into_iter().map(str::to_owned).chain(["--json".to_owned(), file]).collect::<Vec<_>>();
    steps.step(&format!("bench: {}", word(name)), || match bench::command(name, &told, Build::Tests) {
        Ok(mut command) => reported(&mut command, &json, || check(&json)).into(),
        Err(reason) => Outcome::Failed(reason).unless_ci(),
    });
}

/// 20 topics at 1 kHz lose nothing in 15 s each way, or to ROS in so much longer as the machine needs: what the bridge adds is printed beside
/// r2r's own subscriber, and belongs to the machine and the build.
fn bridge_bench(steps: &mut Steps) {
    let told = ["--seconds=15", "--fit"].into_iter().chain(machine::no_rt());
    bench(steps, Name::Bridge, told, |json| {
        reports::BRIDGE.of(json, &[("expected", (20 * 1000 * 15).into())])
    });
}

/// Of all that is compared, what is built in seconds.
const OURS: &str = "floor,tautline,iceoryx2";

/// A round of a bench of the comparison: the numbers mean nothing, but it fails unless all is measured, the page is drawn and the tables are written.
fn comparison(steps: &mut Steps, name: Name, systems: &str) {
    let file = |ending| machine::target_dir().join(word(name)).with_extension(ending).display().to_string();
    let (html, markdown) = (file("html"), file("md"));
    let told = ["--smoke", "--systems", systems, "--html", &html, "--markdown", &markdown];
    bench(steps, name, told.into_iter().chain(machine::no_rt()), |_| Ok(()));
}

/// A quick run, which fails by itself if something is wrong.
fn quick(steps: &mut Steps, name: Name, told: Option<&str>) {
    bench(steps, name, ["--quick"].into_iter().chain(told), |_| Ok(()));
}

/// A second of each variant of the evaluation, Tautline's side: r2r's side takes a minute to build.
fn paper(steps: &mut Steps) {
    let html = machine::target_dir().join("paper.html").display().to_string();
    let told = ["--no-r2r", "--runs=1", "--seconds=1", "--repeats=0", "--html", &html];
    bench(steps, Name::Paper, told.into_iter().chain(machine::no_rt()), |json| {
        reports::PAPER.of(json, &[("realtime", machine::no_rt().is_none().into())])
    });
}

/// The unsafe code that needs no kernel, under an interpreter that sees undefined behaviour.
pub fn miri(steps: &mut Steps) {
    if let Err(reason) = machine::cargo_has("+nightly miri --version") {
        return steps.skip("miri", &reason);
    }
    // Of `owned`, what allocates and encodes very often shows nothing more here, and takes minutes.
    let messages = "+nightly miri test -p tautline-msgs --test cdr --test validate --test owned -- \
                    --skip lengths_are_not_believed --skip encoding_does_not_allocate";
    steps.command("miri: messages", &mut cargo(messages));
    let samples = "+nightly miri test -p tautline-transport --lib -- borrowed pending";
    steps.command("miri: samples", &mut cargo(samples));
    let rings = "+nightly miri test -p tautline-trace --lib -- ring object";
    steps.command("miri: rings", &mut cargo(rings));
    let latest = "+nightly miri test -p tautline-rt --lib -- latest";
    steps.command("miri: latest", &mut cargo(latest));
}
