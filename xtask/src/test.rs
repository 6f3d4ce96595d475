// SPDX-License-Identifier: MIT OR Apache-2.0
//! `cargo xtask test`: what is run before each commit. Everything is of one build, that of the tests; what needs another one, a ROS 2,
//! Zenoh or several hosts is in [`ci`](crate::ci).

use crate::build::{Build, SAME, TARGETS, WITH_GATEWAY, WITH_ROS, most};
use crate::reports::{ABLATION, DEMO};
use crate::steps::{Steps, cargo, execute, reported};
use crate::{examples, lints, locks, machine, machine::Scope, r2r};
use std::process::Command;

/// Runs every step, whatever fails.
pub fn run(steps: &mut Steps, scope: &Scope) {
    r2r::prepare_libclang(steps, machine::is_ci());
    steps.command("fmt", &mut cargo("fmt --all --check"));
    let built = lints::build(steps, "build and lints", &format!("{} {TARGETS}", most()));
    // Most wait for each other's processes more than they compute.
    nextest(steps, "tests", &most(), &format!("not({WITH_GATEWAY}|{WITH_ROS})"), 2);
    steps.command("doc tests", &mut lints::cargo(&format!("test {} --no-fail-fast --doc", most())));
    if built {
        steps.step("locks behind hot.rs", || locks::check(&most()));
    }
    demo(steps, built);
    examples::run(steps, built, Build::Tests, false);
    loom(steps);
    leftovers(steps, scope);
}

/// The tests of these packages that a filter of nextest's selects, so many at a time for each core.
pub fn nextest(steps: &mut Steps, name: &str, packages: &str, filter: &str, for_each_core: usize) {
    let mut tests = if machine::cargo_has("nextest --version").is_ok() {
        let profile = if machine::is_ci() { "ci" } else { "default" };
        lints::cargo(&format!("nextest run {packages} --no-fail-fast --profile {profile} -E {filter}"))
    } else {
        // Which cannot choose.
        lints::cargo(&format!("test {packages} --no-fail-fast {TARGETS}"))
    };
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    tests.env("NEXTEST_TEST_THREADS", (cores * for_each_core).to_string());
    steps.command(name, tests.envs(machine::is_ci().then_some(("TAUT_LEAK_CYCLES", "1000"))));
}

/// Three seconds of the demo: it runs and its report keeps its promises; and with the sampler below the callbacks it
/// shows what goes wrong.
fn demo(steps: &mut Steps, built: bool) {
    if !built {
        return steps.skip("demo", "not built");
    }
    let target = machine::target_dir();
    let (json, svg) = (target.join("demo.json"), target.join("demo.svg"));
    let mut run = |name, priority, check: &dyn Fn() -> Result<(), String>| {
        let mut command = Command::new(Build::Tests.folder().join("taut"));
        command.args(["demo", "--seconds", "3", "--sampler-priority", priority]);
        command.arg("--json").arg(&json).arg("--svg").arg(&svg);
        steps.step(name, || reported(&mut command, &json, check));
    };
    let realtime = machine::no_rt().is_none();
    run("demo", "21", &|| DEMO.of(&json, &[("realtime", realtime.into())]));
    if realtime {
        run("demo: sampler below the callbacks", "15", &|| ABLATION.of(&json, &[]));
    } else {
        steps.skip("demo: sampler below the callbacks", "real-time priorities are not permitted");
    }
}

/// Models of what has no lock, in every order within their bounds. Our crates alone are built with the flag, which in `RUSTFLAGS` would build all
/// others anew, too.
fn loom(steps: &mut Steps) {
    const PACKAGES: &str = "doorbell executor rt tf trace transport";
    let packages: String = PACKAGES.split(' ').map(|package| format!(" -p tautline-{package}")).collect();
    let mut command = cargo(&format!("test{packages} {SAME} --lib loom"));
    // Models need none of it, only their packages' other tests.
    command.args(["--config", "profile.dev.package.tautline-schema.opt-level=0"]);
    steps.step("loom", || {
        let rustc = machine::script("rustc-loom", "exec \"$@\" --cfg taut_loom")?;
        execute(command.env("RUSTC_WORKSPACE_WRAPPER", rustc))
    });
}

/// All processes have ended: nothing is left of them.
pub fn leftovers(steps: &mut Steps, scope: &Scope) {
    steps.step("nothing is left", || left(scope));
}

/// All processes have ended: their domains have gone from shared memory with them. Where a traced process was killed, what it had
/// recorded stays for a recorder.
fn left(scope: &Scope) -> Result<(), String> {
    let is_trace = |path: &std::path::Path| {
        path.file_name().is_some_and(|name| name.to_string_lossy().starts_with("trace_p"))
    };
    let (traces, left): (Vec<_>, Vec<_>) = scope.left().into_iter().partition(|path| is_trace(path));
    let of_traces = |path: &&std::path::PathBuf| traces.iter().any(|trace| trace.parent() == Some(path));
    match left.iter().find(|path| !of_traces(path)) {
        Some(path) => Err(format!("{} and others, {} in all", path.display(), left.len())),
        None => Ok(()),
    }
}
