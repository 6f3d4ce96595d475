// SPDX-License-Identifier: MIT OR Apache-2.0
//! r2r's own tests and examples on Tautline, unchanged: as cargo has them for the bridge, with `r2r` as another name of `tautline-r2r`.

use crate::files;
use crate::machine::{self, Scope};
use crate::running::Running;
use crate::steps::{Steps, announce, cargo, json_of};
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

/// What is left out of r2r's dependencies besides its own crates: only its bench uses that.
const BENCH: &str = "criterion";

/// r2r's build script sets one of these for each message that there is; its examples ask for this one.
const CFG: &str = "r2r__rosgraph_msgs__msg__Clock";

/// Examples that run together, each in a scope of its own, with their arguments and what they are to print. One that is not said
/// to end is killed when all have printed theirs.
const RUNS: [&[Program]; 15] = [
    &[program("clock", &["rostime", "systemtime", "steadytime"]).ends()],
    &[program("serialization", &["as json", "Hello, world"]).ends()],
    &[program("publishers", &["All done!"]).ends()],
    &[program("wall_timer", &["timer called (9)", "exiting"]).ends()],
    &[program(
        "parameters --ros-args -p key1:=[hello,world] -p key2:=5.5 -r __ns:=/demo -r __node:=my_node",
        &[
            "node fully qualified name: /demo/my_node",
            "key1 - StringArray([\"hello\", \"world\"])",
            "key2 - Double(5.5)",
        ],
    )],
    &[program(
        "parameters_derive --ros-args -p par1:=5.1 -p nested.par4:=42 -r __ns:=/demo -r __node:=my_node",
        &["node fully qualified name: /demo/my_node", "par1: 5.1", "par3: \"initial value\"", "par4: 42"],
    )],
    &[program(
        "logging --ros-args --log-level DEBUG",
        &["debug msg: 0", "info msg 1", "i = 2", "fatal msg 0x4"],
    )],
    // Simulated time goes at a tenth of the speed.
    &[
        program("sim_time_publisher", &["Publishing time 0."]),
        program(
            "timer_sim_time --ros-args -p use_sim_time:=true",
            &["Timer called (0)", "current time ros="],
        ),
    ],
    &[
        program("action_server", &["Got goal request with order 5"]),
        program("action_client", &["goal accepted", "new feedback msg"]).ends(),
    ],
    &[
        program("action_server", &["Got goal request with order 5"]),
        program("action_client_untyped", &["goal accepted", "new feedback msg"]).ends(),
    ],
    &[
        program("service", &["passing request on to delayed service", "responding with: 90 + 9 = 99"]),
        program("client", &["90 + 9 = 99", "done."]),
    ],
    &[
        program("tokio_service", &[]),
        program("untyped_client", &["{\"sum\":99}", "done."]),
        program("tokio_client", &["service available.", "14"]),
    ],
    &[
        program("tokio_publisher", &[]),
        program("tokio_subscriber", &["topic: new msg: hello from r2r"]),
        program("rostopic_list", &["/topic: [\"std_msgs/msg/String\"]"]),
        program("rostopic_echo /topic", &["type: std_msgs/msg/String", "\"data\": \"hello from r2r\""]),
        program("subscriber", &["topic2: new msg: {\"data\":\"(0): new msg: hello from r2r\"}"]),
    ],
    &[
        program("tokio_raw_publisher", &[]),
        program("tokio", &["topic2: new msg: (0): new msg: ", "shared state is 1"]),
    ],
    &[
        program("tokio_examples", &["topic: new msg: hello from r2r", "service available.", "14"]),
        program(
            "tokio_raw_subscriber",
            &["... using ros: String { data: \"hello from r2r\" }", "... using cdr: "],
        ),
    ],
];

/// r2r's server rejects one goal in four, at random, at which its clients panic: they try again so often.
const REJECTED: &str = "goal rejected by server";
const TRIES: usize = 20;

/// Far longer than any of them takes.
const PATIENCE: Duration = Duration::from_secs(300);

#[derive(Clone, Copy)]
struct Program {
    /// The name and the arguments.
    line: &'static str,
    says: &'static [&'static str],
    ends: bool,
}

const fn program(line: &'static str, says: &'static [&'static str]) -> Program {
    Program { line, says, ends: false }
}

impl Program {
    const fn ends(self) -> Self {
        Program { ends: true, ..self }
    }

    fn name(&self) -> &'static str {
        self.line.split(' ').next().unwrap_or(self.line)
    }
}

/// Builds all.
pub fn build(steps: &mut Steps) -> Built {
    let mut built = Built::default();
    steps.step("r2r-tests: build", || {
        built = Source::find()?.build()?;
        let is_left = |target: &&Target| !built.executables.contains_key(*target);
        let left: Vec<&str> = built.targets.iter().filter(is_left).map(|(_, name)| &**name).collect();
        if left.is_empty() { Ok(()) } else { Err(format!("not built: {}", left.join(", "))) }
    });
    built
}

/// What r2r has, and what was built of it.
#[derive(Default)]
pub struct Built {
    targets: BTreeSet<Target>,
    executables: BTreeMap<Target, PathBuf>,
}

impl Built {
    /// Runs all.
    pub fn run(&self, steps: &mut Steps) {
        for target in self.targets.iter().filter(|(kind, _)| kind == "test") {
            steps.step(&format!("r2r-tests: test {}", target.1), || {
                test(self.executables.get(target).ok_or("not built")?)
            });
        }
        self.examples(steps);
    }

    /// Runs all at once: most of them wait.
    fn examples(&self, steps: &mut Steps) {
        let example = |program: &Program| ("example".to_owned(), program.name().to_owned());
        std::thread::scope(|scope| {
            let start = |run: &'static [Program]| {
                let paths = run.iter().map(|program| self.executables.get(&example(program)));
                let paths: Option<Vec<&PathBuf>> = paths.collect();
                (run, paths.map(|paths| scope.spawn(move || together(run, &paths))))
            };
            let started: Vec<_> = RUNS.into_iter().map(start).collect();
            for (run, running) in started {
                let names: Vec<&str> = run.iter().map(Program::name).collect();
                steps.step(&format!("r2r-tests: example {}", names.join(" + ")), || {
                    running.ok_or("not built")?.join().unwrap_or(Err("this program panicked".to_owned()))
                });
            }
        });
        let run: BTreeSet<Target> = RUNS.iter().flat_map(|run| run.iter()).map(example).collect();
        for (_, name) in self.targets.iter().filter(|of| of.0 == "example" && !run.contains(*of)) {
            let reason = "nothing here says how to run it".to_owned();
            steps.step(&format!("r2r-tests: example {name}"), || Err(reason));
        }
    }
}

/// A test or an example: its kind, as cargo calls it, and its name.
type Target = (String, String);

/// r2r as cargo has it.
struct Source {
    folder: PathBuf,
    edition: String,
    dependencies: String,
    targets: BTreeSet<Target>,
}

impl Source {
    fn find() -> Result<Source, String> {
        let mut command = Command::new("cargo");
        command.args(["metadata", "--format-version", "1", "--locked", "--manifest-path"]);
        command.arg(machine::root().join("node/r2r/Cargo.toml"));
        announce(&command);
        let metadata = json_of(&mut command)?;
        let packages = metadata["packages"].as_array().ok_or("cargo metadata lists no packages")?;
        let r2r = packages
            .iter()
            .find(|package| package["name"] == "r2r")
            .ok_or("node/r2r does not depend on r2r")?;
        let text = |value: &Value| value.as_str().unwrap_or_default().to_owned();
        let all = |name: &str| r2r[name].as_array().cloned().unwrap_or_default();
        let target = |target: Value| (text(&target["kind"][0]), text(&target["name"]));
        let manifest = PathBuf::from(text(&r2r["manifest_path"]));
        Ok(Source {
            folder: manifest.parent().unwrap_or(&manifest).to_owned(),
            edition: text(&r2r["edition"]),
            dependencies: dependencies(&all("dependencies")),
            targets: all("targets")
                .into_iter()
                .map(target)
                .filter(|(kind, _)| kind == "test" || kind == "example")
                .collect(),
        })
    }

    /// Makes a package of the tests and the examples and builds what can be built.
    fn build(self) -> Result<Built, String> {
        let package = machine::target_dir().join("r2r-tests");
        self.write(&package).map_err(files::at(&package))?;
        let mut command =
            cargo("build --tests --examples --keep-going --message-format=json-render-diagnostics");
        command.arg("--manifest-path").arg(package.join("Cargo.toml"));
        // Of their own: examples of this workspace have the same names. What they need is the bridge's.
        command.arg("--target-dir").arg(package.join("target"));
        command.env("CARGO_BUILD_BUILD_DIR", machine::target_dir());
        announce(&command);
        let output = command.stderr(Stdio::inherit()).output().map_err(|error| error.to_string())?;
        let messages = String::from_utf8_lossy(&output.stdout);
        let executables =
            messages.lines().filter_map(|line| executable(&serde_json::from_str(line).ok()?)).collect();
        Ok(Built { targets: self.targets, executables })
    }

    fn write(&self, package: &Path) -> std::io::Result<()> {
        for folder in ["tests", "examples", "src"] {
            files::make_empty(&package.join(folder))?;
        }
        for folder in ["tests", "examples"] {
            for entry in fs::read_dir(self.folder.join(folder))? {
                let path = entry?.path();
                fs::write(package.join(folder).join(path.file_name().unwrap_or_default()), fs::read(&path)?)?;
            }
        }
        let root = machine::root();
        let features = ["xtask-features", "xtask-host-features"].map(|name| {
            let folder = root.join("xtask").join(name.trim_start_matches("xtask-"));
            format!("{name} = {{ path = \"{}\" }}\n", folder.display())
        });
        // With the bridge's profile: what both need is built once.
        let bridge = fs::read_to_string(root.join("bridge-ros/Cargo.toml"))?;
        let profile = bridge.split_once("[profile.dev]").map_or("", |(_, profile)| profile);
        let manifest = format!(
            "[package]\nname = \"r2r-tests\"\nedition = \"{}\"\n\n[workspace]\n\n\
             [dependencies]\nr2r = {{ package = \"tautline-r2r\", path = \"{}\", features = [\"ros_all\"] }}\n{}\n\
             [dev-dependencies]\n{}\n[profile.dev]{profile}",
            self.edition,
            root.join("node/tautline-r2r").display(),
            self.dependencies,
            features.concat(),
        );
        fs::write(package.join("Cargo.toml"), manifest)?;
        let script = format!(
            "fn main() {{\n    println!(\"cargo:rustc-check-cfg=cfg({CFG})\");\n    println!(\"cargo:rustc-cfg={CFG}\");\n}}\n"
        );
        fs::write(package.join("build.rs"), script)?;
        // A package has a library or a program.
        fs::write(package.join("src/lib.rs"), "")?;
        // The workspace's versions, and those that were found for the rest since they last changed.
        let (ours, lock) = (root.join("Cargo.lock"), package.join("Cargo.lock"));
        let changed = |path: &Path| fs::metadata(path)?.modified();
        match changed(&lock) {
            Ok(since) if since >= changed(&ours)? => Ok(()),
            _ => fs::copy(ours, lock).map(drop),
        }
    }
}

/// Those of r2r that its tests and examples may use, as lines of a manifest.
fn dependencies(all: &[Value]) -> String {
    let mut lines = BTreeMap::new();
    for dependency in all {
        let name = dependency["name"].as_str().unwrap_or_default();
        if dependency["kind"] == "build" || name.starts_with("r2r") || name == BENCH {
            continue;
        }
        let (version, features) = (&dependency["req"], &dependency["features"]);
        lines.insert(name, format!("{name} = {{ version = {version}, features = {features} }}\n"));
    }
    lines.into_values().collect()
}

/// The program that cargo says it has made.
fn executable(message: &Value) -> Option<(Target, PathBuf)> {
    let target = &message["target"];
    let path = message["executable"].as_str()?;
    Some(((target["kind"][0].as_str()?.to_owned(), target["name"].as_str()?.to_owned()), path.into()))
}

/// Runs a program of tests.
fn test(executable: &Path) -> Result<(), String> {
    let scope = Scope::new("r2r");
    let mut running = start(executable, "", &scope)?;
    let status = running.wait_until(Instant::now() + PATIENCE, |_| false);
    running.end();
    println!("{}", running.said());
    match status {
        Some(status) if status.success() => Ok(()),
        Some(_) => Err("some fail".to_owned()),
        None => Err(format!("not within {} s", PATIENCE.as_secs())),
    }
}

/// Runs examples together until all have done what they are to do.
fn together(programs: &[Program], paths: &[&PathBuf]) -> Result<(), String> {
    for _ in 0..TRIES {
        let scope = Scope::new("r2r");
        let mut all = Vec::new();
        for (program, path) in programs.iter().zip(paths) {
            let arguments = program.line.strip_prefix(program.name()).unwrap_or_default();
            let running = start(path, arguments, &scope);
            all.push((program, running.map_err(|reason| format!("{}: {reason}", program.name()))?));
        }
        let end = Instant::now() + PATIENCE;
        let outcome = loop {
            std::thread::sleep(Duration::from_millis(10));
            if let Some(outcome) = outcome_of(&mut all, end) {
                break outcome;
            }
        };
        all.iter_mut().for_each(|(_, running)| running.end());
        if all.iter().any(|(_, running)| running.said().contains(REJECTED)) {
            continue;
        }
        for (program, running) in all.iter().filter(|_| outcome.is_err()) {
            println!("{} said:\n{}", program.name(), running.said());
        }
        return outcome;
    }
    Err(format!("{REJECTED}, {TRIES} times"))
}

/// How it ended, if it has.
fn outcome_of(all: &mut [(&Program, Running)], end: Instant) -> Option<Result<(), String>> {
    let mut is_done = true;
    for (program, running) in all {
        let name = program.name();
        let (succeeded, said) = (running.status().map(|status| status.success()), running.said());
        let missing = program.says.iter().find(|text| !said.contains(**text));
        let failed = |what: &str| Some(Err(format!("{name} {what}")));
        if said.contains("panicked at") {
            return failed("panicked");
        }
        match (succeeded, missing) {
            (Some(false), _) => return failed("failed"),
            (Some(true), Some(missing)) => return failed(&format!("ended without '{missing}'")),
            (None, Some(missing)) if Instant::now() > end => {
                return failed(&format!("did not say '{missing}' within {} s", PATIENCE.as_secs()));
            }
            (None, None) if program.ends && Instant::now() > end => {
                return failed(&format!("did not end within {} s", PATIENCE.as_secs()));
            }
            (None, _) => is_done &= missing.is_none() && !program.ends,
            (Some(true), None) => {}
        }
    }
    is_done.then_some(Ok(()))
}

/// Starts one in this scope.
fn start(path: &Path, arguments: &str, scope: &Scope) -> Result<Running, String> {
    let mut command = Command::new(path);
    command.args(arguments.split_whitespace()).env("TAUT_SCOPE", scope.name());
    command.env_remove("TAUT_DOMAIN").env_remove("ROS_DOMAIN_ID");
    if machine::no_rt().is_some() {
        command.env("TAUT_REALTIME", "off");
    }
    Running::start(&mut command, true)
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn dependencies_are_r2rs_but_for_its_own_crates() {
        let one = |name: &str, kind: Value| json!({ "name": name, "kind": kind, "req": "^1.2", "features": ["derive"] });
        let all = [
            one("serde", Value::Null),
            one("r2r_rcl", Value::Null),
            one("rand", json!("dev")),
            one("syn", json!("build")),
        ];
        let line = |name: &str| format!("{name} = {{ version = \"^1.2\", features = [\"derive\"] }}\n");
        assert_eq!(dependencies(&all), line("rand") + &line("serde"));
    }

    #[test]
    fn what_cargo_has_made_is_found() {
        let message = json!({ "target": { "kind": ["example"], "name": "clock" }, "executable": "/x/clock" });
        let made = (("example".to_owned(), "clock".to_owned()), PathBuf::from("/x/clock"));
        assert_eq!(executable(&message), Some(made));
        assert_eq!(
            executable(&json!({ "target": { "kind": ["lib"], "name": "r2r" }, "executable": null })),
            None
        );
    }
}
