// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut report` as people and scripts use it, on a system that runs in this process.

#[path = "support/schemas.rs"]
mod schemas;

use schemas::Checked;
use std::io::{BufRead, BufReader};
use std::path::PathBuf;
use std::process::{Command, Output, Stdio};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::thread::JoinHandle;
use std::time::Duration;

use futures::StreamExt;
use serde_json::Value;
use tautline::{CallbackOptions, Context, Message, Node, Publisher, Qos, Realtime, Sample};
use tautline_rt::clock;
use tautline_rt::permission::{realtime_permitted, test_needs};

#[derive(Message, Clone, Copy)]
#[repr(C)]
#[message(name = "test_msgs/msg/Work")]
struct Work {
    burn_ns: u64,
}

const PERIOD: Duration = Duration::from_secs(1);
const LITTLE: Duration = Duration::from_millis(1);
const MUCH: Duration = Duration::from_millis(30);

/// Its bounds are so long that other work of the machine does not matter.
const SYSTEM: &str = r#"
[hosts.robot]
cores = 1
sampler_priority = 60
[nodes.driver]
[topics]
fine = { period = "1000s" }
other = { period = "1000s" }
[callbacks.fine]
topic = "fine"
wcet = "20s"
priority = 50
[callbacks.other]
topic = "other"
wcet = "20s"
priority = 40
"#;

/// A directory of this test, removed at its end.
struct Scratch(PathBuf);

impl Scratch {
    fn new(name: &str) -> Scratch {
        let path = std::env::temp_dir().join(format!("taut-report-{}-{name}", std::process::id()));
        std::fs::create_dir_all(&path).unwrap();
        Scratch(path)
    }

    fn write(&self, name: &str, text: &str) -> PathBuf {
        let path = self.0.join(name);
        std::fs::write(&path, text).unwrap();
        path
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

fn command(arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_taut"));
    command.arg("report").args(arguments);
    for variable in ["TAUT_DOMAIN", "ROS_DOMAIN_ID", "TAUT_REALTIME", "TAUT_HOST"] {
        command.env_remove(variable);
    }
    command
}

fn taut(arguments: &[&str]) -> Output {
    command(arguments).checked()
}

fn json(output: &Output) -> Value {
    serde_json::from_slice(&output.stdout).unwrap_or_else(|error| panic!("{error}: {output:?}"))
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// The names of what `callback` violated.
fn violations(report: &Value, callback: &str) -> Vec<String> {
    let callbacks =
        report["callbacks"].as_array().unwrap().iter().chain(report["unknown"].as_array().unwrap());
    let found = callbacks.into_iter().find(|entry| entry["name"] == callback).unwrap();
    let names = found["violations"].as_array().unwrap().iter();
    names.map(|violation| violation["name"].as_str().unwrap().to_owned()).collect()
}

/// A system that runs in this process until it is dropped.
struct Running {
    context: Context,
    node: Node,
    sampler: Option<JoinHandle<()>>,
    done: (Sender<()>, Receiver<()>),
}

impl Running {
    fn start(domain: u32, realtime: Realtime, system: &PathBuf) -> Running {
        let context = Context::builder()
            .domain(domain)
            .realtime(realtime)
            .lock_memory(false)
            .hold_idle(false)
            .system(system)
            .build()
            .unwrap();
        let node = Node::create(context.clone(), "driver", "").unwrap();
        let sampler = context.clone();
        let sampler = Some(std::thread::spawn(move || sampler.spin().unwrap()));
        Running { context, node, sampler, done: channel() }
    }

    fn publisher(&mut self, topic: &str) -> Publisher<Work> {
        self.node.create_publisher(topic, Qos::default()).unwrap()
    }

    /// A callback that burns what its messages say. They are there already: it takes them in one go.
    fn handle(&mut self, name: &str, depth: usize, messages: &[(Duration, u64)]) {
        let options = self.context.callback(name).unwrap();
        self.handle_with(options, name, depth, messages);
    }

    fn handle_with(
        &mut self,
        options: CallbackOptions,
        topic: &str,
        depth: usize,
        messages: &[(Duration, u64)],
    ) {
        let subscription = self.node.subscribe::<Work>(topic, Qos::keep_last(depth)).unwrap();
        let publisher = self.publisher(topic);
        for (burn, release_ns) in messages {
            publish(&publisher, *burn, *release_ns);
        }
        let done = self.done.0.clone();
        let work = move |work: Sample<Work>| {
            tautline::set_input_size(work.burn_ns);
            clock::burn_cpu(Duration::from_nanos(work.burn_ns));
            done.send(()).unwrap();
            async {}
        };
        let (handle, taken) = (
            self.node.spawn_callback(options, subscription.for_each(work)).unwrap(),
            depth.min(messages.len()),
        );
        for _ in 0..taken {
            self.done.1.recv_timeout(Duration::from_secs(60)).unwrap();
        }
        // A job ends when the next message is asked for.
        while handle.stats().completions() < taken as u64 {
            std::thread::yield_now();
        }
    }
}

/// The path of a saved run of [`SYSTEM`], of which each callback has had a job, and the run.
fn saved(scratch: &Scratch, domain: u32) -> (String, Value) {
    let system = scratch.write("system.toml", SYSTEM);
    let mut running = Running::start(domain, Realtime::Off, &system);
    for name in ["fine", "other"] {
        running.handle(name, 1, &releases(1, PERIOD, LITTLE));
    }
    let path = scratch.0.join("run.json").to_str().unwrap().to_owned();
    assert_eq!(taut(&["--domain", &domain.to_string(), "--save", &path]).status.code(), Some(0));
    let run = serde_json::from_str(&std::fs::read_to_string(&path).unwrap()).unwrap();
    (path, run)
}

impl Drop for Running {
    fn drop(&mut self) {
        self.context.shutdown();
        if let Some(sampler) = self.sampler.take() {
            sampler.join().unwrap();
        }
    }
}

fn publish(publisher: &Publisher<Work>, burn: Duration, release_ns: u64) {
    let mut loan = publisher.loan().unwrap();
    loan.burn_ns = burn.as_nanos() as u64;
    loan.publish_released_at(release_ns).unwrap();
}

/// `n` releases, the last one now.
fn releases(n: u64, apart: Duration, burn: Duration) -> Vec<(Duration, u64)> {
    let now_ns = clock::monotonic_ns();
    (0..n).rev().map(|before| (burn, now_ns - before * apart.as_nanos() as u64)).collect()
}

#[test]
fn what_was_kept_is_kept_and_a_saved_run_says_the_same() {
    let scratch = Scratch::new("kept");
    let system = scratch.write("system.toml", SYSTEM);
    let mut running = Running::start(168, Realtime::Off, &system);
    running.handle("fine", 1, &releases(1, PERIOD, LITTLE));
    running.handle("other", 1, &releases(1, PERIOD, LITTLE));
    let run = scratch.0.join("run.json");
    let run = run.to_str().unwrap();

    // The file is the one that the process was started with.
    let live = taut(&["--domain", "168", "--json", "--save", run]);
    assert_eq!(live.status.code(), Some(0), "{live:?}");
    let report = json(&live);
    assert_eq!((&report["kept"], &report["realtime"]), (&Value::Bool(true), &Value::Bool(false)));
    let fine = &report["callbacks"][0];
    assert_eq!((&fine["name"], &fine["predicted"]["response_ms"]), (&"fine".into(), &20_000.0.into()));
    assert_eq!((&fine["measured"]["jobs"], &fine["measured"]["lost"]), (&1.into(), &0.into()));
    assert!(fine["measured"]["execution_ms"]["max"].as_f64().unwrap() >= 1.0);
    assert_eq!(violations(&report, "fine"), [""; 0]);

    // A person gets a table, by the domain of the environment.
    let table = command(&[]).env("TAUT_DOMAIN", "168").output().unwrap();
    let shown = text(&table.stdout);
    assert!(shown.contains("Kept: no assumption") && shown.contains("2 jobs (one process)"), "{shown}");
    assert!(shown.contains("runs without real-time priorities"), "{shown}");

    drop(running);
    let gone = taut(&["--domain", "168"]);
    assert_eq!(gone.status.code(), Some(2));
    assert!(text(&gone.stderr).contains("no process of domain 168 shows statistics"), "{gone:?}");

    let saved = taut(&[run, "--json"]);
    assert_eq!((saved.status.code(), &saved.stdout), (Some(0), &live.stdout));

    // Against a file that allows less.
    let strict = SYSTEM.replacen("20s", "0.5ms", 1);
    let strict = scratch.write("strict.toml", &strict);
    let output = taut(&[run, "--system", strict.to_str().unwrap(), "--json"]);
    assert_eq!(output.status.code(), Some(1));
    assert!(violations(&json(&output), "fine").contains(&"wcet exceeded".to_owned()), "{output:?}");
    assert!(text(&output.stdout).contains("another text of the system file"));
}

/// As in `taut report | head -1`.
#[test]
fn a_reader_that_has_gone_changes_neither_the_exit_code_nor_what_is_saved() {
    let unread = |arguments: &[&str]| {
        let (reader, writer) = std::io::pipe().unwrap();
        drop(reader);
        let output = command(arguments).stdout(writer).output().unwrap();
        (output.status.code(), text(&output.stderr))
    };
    let scratch = Scratch::new("unread");
    let system = scratch.write("system.toml", SYSTEM);
    let mut running = Running::start(163, Realtime::Off, &system);
    for name in ["fine", "other"] {
        running.handle(name, 1, &releases(1, PERIOD, LITTLE));
    }
    let run = scratch.0.join("run.json");
    let run = run.to_str().unwrap();
    let (code, words) = unread(&["--watch", "--json", "--domain", "163", "--save", run]);
    assert_eq!(code, Some(0), "it ends although the process runs: {words}");
    assert_eq!(taut(&[run]).status.code(), Some(0), "{words}");

    let strict = scratch.write("strict.toml", &SYSTEM.replacen("20s", "0.5ms", 1));
    let strict = strict.to_str().unwrap();
    let forms: [&[&str]; 3] = [&[], &["--json"], &["--wcet"]];
    for more in forms {
        assert_eq!(unread(&[&[run, "--system", strict], more].concat()).0, Some(1), "{more:?}");
    }
}

#[test]
fn callbacks_without_a_job_are_nothing_to_compare() {
    let scratch = Scratch::new("idle");
    let system = scratch.write("system.toml", SYSTEM);
    let mut running = Running::start(152, Realtime::Off, &system);
    for name in ["fine", "other"] {
        running.handle(name, 1, &[]);
    }
    let output = taut(&["--domain", "152"]);
    assert_eq!(output.status.code(), Some(2), "{output:?}");
    assert!(text(&output.stdout).contains("Nothing to compare: no job"), "{output:?}");
    for wcet in [&[][..], &["--wcet"]] {
        let output = taut(&[&["--domain", "152", "--json"], wcet].concat());
        assert_eq!((output.status.code(), &json(&output)["kept"]), (Some(2), &false.into()), "{wcet:?}");
    }
    // Of some executors there never is one.
    let events = "[nodes.driver]\nclient = \"rclcpp\"\nexecutor = \"events\"";
    let events = scratch.write("events.toml", &SYSTEM.replace("[nodes.driver]", events));
    for (file, seen) in [(system, "no job has ended yet of"), (events, "sees no end of its callbacks")] {
        let report = json(&taut(&[file.to_str().unwrap(), "--domain", "152", "--json"]));
        let ways = ["no job has ended yet of", "sees no end of its callbacks"];
        let notes = report["notes"].to_string();
        assert!(ways.iter().all(|way| notes.contains(way) == (*way == seen)), "{notes}");
    }
}

/// What a host takes is not to be had at will: it is put into a saved run.
#[test]
fn what_the_host_took_explains_a_late_response_or_it_does_not() {
    let scratch = Scratch::new("host");
    let (path, saved) = saved(&scratch, 97);
    let path = path.as_str();

    // `other` took 43 s, its bound is 40 s, and while it ran the host had the core for this long.
    let report_of = |kind: &str, taken_ns: u64, accounts: bool| {
        let mut run = saved.clone();
        let callbacks = run["processes"][0]["callbacks"].as_array_mut().unwrap();
        let other = callbacks.iter_mut().find(|of| of["name"] == "other").unwrap();
        let (begin_ns, response_ns) = (100_000_000_000u64, 43_000_000_000u64);
        let end_ns = begin_ns + response_ns;
        other["response"] = serde_json::json!({
            "sum_ns": response_ns, "max_ns": response_ns, "buckets": [[response_ns, 1]],
        });
        other["accounts_core_time"] = accounts.into();
        let moment = |kind: &str, length_ns: u64| serde_json::json!({"kind": kind, "from_ns": begin_ns, "to_ns": end_ns, "length_ns": length_ns});
        other["moments"] = serde_json::json!([moment(kind, taken_ns), moment("late", response_ns)]);
        std::fs::write(path, run.to_string()).unwrap();
        (taut(&[path, "--json"]), text(&taut(&[path]).stdout).replace('\n', " "))
    };

    let report = |taken_ns, accounts| report_of("taken", taken_ns, accounts);
    let (explained, shown) = report(3_000_000_000, true);
    assert_eq!(explained.status.code(), Some(0), "{explained:?}");
    let other = &json(&explained)["callbacks"][1];
    let host = serde_json::json!({
        "response_ms": 43_000.0, "beyond": 1, "waited": 0, "unexplained": 0, "longest_ms": 43_000.0, "taken_ms": 3_000.0,
        "overran_ms": 0.0, "waited_ms": 0.0,
    });
    assert_eq!((&other["measured"]["host"], &other["violations"]), (&host, &serde_json::json!([])));
    assert!(shown.contains("other: once beyond its bound, by what the host took"), "{shown}");
    assert!(shown.contains("took 3000.00 ms of core 0 of `robot`") && shown.contains("host"), "{shown}");

    // What is shorter than 0.1 ms may not have been noted.
    assert_eq!(report(2_999_900_000, true).0.status.code(), Some(0));
    let (unexplained, shown) = report(2_999_899_999, true);
    assert_eq!(unexplained.status.code(), Some(1), "{unexplained:?}");
    assert_eq!(violations(&json(&unexplained), "other"), ["bound exceeded"]);
    assert!(shown.contains("1 of 1 such responses with less taken by the host"), "{shown}");

    // A job that used more than its wcet explains it as well, but nothing excuses that.
    let (overran, shown) = report_of("overran", 3_000_000_000, true);
    let host = &json(&overran)["callbacks"][1]["measured"]["host"];
    assert_eq!((&host["response_ms"], &host["unexplained"]), (&40_000.0.into(), &0.into()));
    assert_eq!((&host["taken_ms"], &host["overran_ms"]), (&0.0.into(), &3_000.0.into()));
    assert!(
        shown.contains("the host took 0 ns and jobs 3000 ms more than their wcet; mend the wcet"),
        "{shown}"
    );

    // It was without the core for 23 s, of which `fine` above it may have had 20: the rest is explained, but somebody has to see by whom.
    let (waited, shown) = report_of("waited", 23_000_000_000, true);
    assert_eq!(waited.status.code(), Some(1), "{waited:?}");
    let host = &json(&waited)["callbacks"][1]["measured"]["host"];
    assert_eq!(
        (&host["waited"], &host["unexplained"], &host["waited_ms"]),
        (&1.into(), &0.into(), &3_000.0.into())
    );
    assert!(shown.contains("1 of 1 such responses by waits for the core beyond the analysis"), "{shown}");
    assert!(
        shown.contains("the host took 0 ns and waits for the core were 3000 ms longer than by analysis"),
        "{shown}"
    );
    let (unexplained, _) = report_of("waited", 22_999_000_000, true);
    assert_eq!(json(&unexplained)["callbacks"][1]["measured"]["host"]["unexplained"], Value::from(1));

    // The sampler, on another core, saw the same 3 s as the callback, and no more explain the response than those.
    let with_sampler = |core: Value, taken_ns: u64| {
        let (_, _) = report(taken_ns, true);
        let mut run: Value = serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap();
        let moment = serde_json::json!({
            "kind": "taken", "from_ns": 110_000_000_000u64, "to_ns": 120_000_000_000u64, "length_ns": 3_000_000_000u64,
        });
        run["processes"][0]["sampler"] = serde_json::json!({ "core": core, "moments": [moment] });
        std::fs::write(path, run.to_string()).unwrap();
        let report = taut(&[path, "--json"]);
        (report.status.code(), json(&report)["callbacks"][1]["measured"]["host"]["taken_ms"].clone())
    };
    assert_eq!(with_sampler(5.into(), 2_999_000_000), (Some(0), 3_000.0.into()));
    // On the same core only one of them ran at a time.
    assert_eq!(with_sampler(0.into(), 1_000_000_000), (Some(0), 4_000.0.into()));

    // Nobody looked.
    let (unknown, shown) = report(3_000_000_000, false);
    assert_eq!(violations(&json(&unknown), "other"), ["bound exceeded"]);
    assert!(!shown.contains("the host took"), "{shown}");
}

#[test]
fn no_message_of_a_chain_took_longer_than_the_longest_responses_of_its_callbacks() {
    let scratch = Scratch::new("chains");
    let (path, mut run) = saved(&scratch, 90);
    let path = path.as_str();
    for callback in run["processes"][0]["callbacks"].as_array_mut().unwrap() {
        let response_ns = if callback["name"] == "fine" { 5_000_000_000u64 } else { 7_000_000_000 };
        callback["response"] = serde_json::json!({
            "sum_ns": response_ns, "max_ns": response_ns, "buckets": [[response_ns, 1]],
        });
        callback["accounts_core_time"] = true.into();
        if callback["name"] == "other" {
            callback["moments"] = serde_json::json!([
                {"kind": "taken", "from_ns": 10_000_000_000u64, "to_ns": 12_000_000_000u64, "length_ns": 1_000_000_000u64},
            ]);
        }
    }
    std::fs::write(path, run.to_string()).unwrap();

    // Against a file in which one publishes what triggers the other, and what a third one reads at its own pace.
    let chained = SYSTEM
        .replace("other = { period = \"1000s\" }\n", "")
        .replace("topic = \"fine\"\n", "topic = \"fine\"\npublishes = [\"other\", \"third\"]\n")
        + r#"
[callbacks.third]
period = "2000s"
reads = "third"
wcet = "1s"
priority = 30
[[chains]]
name = "through"
path = ["fine", "other"]
deadline = "100s"
[[chains]]
name = "sampled"
path = ["fine", "third"]
deadline = "9000s"
"#;
    let chained = scratch.write("chained.toml", &chained);
    let chained = chained.to_str().unwrap();
    let report = json(&taut(&[path, "--system", chained, "--json"]));
    // 20 s each, which are over 40 s after the first arrives; the host took 1 s of the core of both, whose responses are 20 and 40 s.
    let through = serde_json::json!({
        "name": "through", "callbacks": ["fine", "other"], "longest_ms": 12_000.0, "predicted_ms": 40_000.0,
        "host_ms": 62_000.0, "deadline_ms": 100_000.0,
    });
    assert_eq!(report["chains"], serde_json::json!([through]), "{report}");
    assert!(report["notes"].to_string().contains("are not looked at: sampled"), "{report}");
    let shown = text(&taut(&[path, "--system", chained]).stdout);
    assert!(shown.contains("through") && shown.contains("12000.000"), "{shown}");
}

#[test]
fn execution_times_are_fitted_and_written_with_their_source() {
    let scratch = Scratch::new("wcet");
    let (path, mut run) = saved(&scratch, 56);
    let (path, system) = (path.as_str(), scratch.0.join("system.toml"));

    // 1 ms and an exponential tail of 0.05 ms, of 20,000 jobs: one in a million takes 1.691 ms.
    let fine = run["processes"][0]["callbacks"].as_array_mut().unwrap();
    let fine = fine.iter_mut().find(|of| of["name"] == "fine").unwrap();
    let mut buckets = std::collections::BTreeMap::<u64, u64>::new();
    for n in 0..20_000 {
        let ns = 1e6 - 5e4 * ((f64::from(n) + 0.5) / 20_000.0).ln();
        *buckets.entry(ns as u64 / 8192 * 8192).or_default() += 1;
    }
    fine["execution"]["buckets"] = serde_json::json!(buckets.into_iter().collect::<Vec<_>>());
    fine["execution"]["max_ns"] = 1_530_000.into();
    fine["completions"] = 20_000.into();
    std::fs::write(path, run.to_string()).unwrap();

    let fits = taut(&[path, "--wcet", "--json"]);
    assert_eq!(fits.status.code(), Some(0), "{fits:?}");
    let fits = json(&fits);
    let fine = &fits["callbacks"][0];
    assert_eq!(
        (&fine["name"], &fine["jobs"], &fine["max_ms"]),
        (&"fine".into(), &20_000.into(), &1.53.into())
    );
    let [estimate, upper] = ["estimate_ms", "upper_ms"].map(|key| fine[key].as_f64().unwrap());
    assert!((1.64..1.75).contains(&estimate) && upper > estimate && upper < 2.2, "{fine}");
    // That of a single job is not known.
    assert_eq!(fits["callbacks"][1]["no_estimate"], "because that takes 10000 jobs");

    // What the file states is more, so it stays; and is lowered if that is asked for, where there is an estimate.
    let untouched = taut(&[path, "--wcet", "--write"]);
    assert!(text(&untouched.stdout).contains("states enough: nothing is changed"), "{untouched:?}");
    assert_eq!(std::fs::read_to_string(&system).unwrap(), SYSTEM);
    let lowered = taut(&[path, "--wcet", "--write", "--lower", "--json"]);
    assert_eq!(json(&lowered)["schedulable"], true);
    let written = std::fs::read_to_string(&system).unwrap();
    let line = written.lines().find(|line| line.contains("measured")).unwrap();
    assert!(line.contains("at most 1.53ms in 20000 jobs, 1 in 1000000 above"), "{line}");
    assert_eq!(written.replace(line, "wcet = \"20s\""), SYSTEM);
    // The run is of the file as it was.
    let refused = taut(&[path, "--wcet", "--write", "--lower"]);
    assert_eq!(refused.status.code(), Some(2), "{refused:?}");
    assert!(
        text(&refused.stderr)
            .contains("no longer the file of this run: name the one to change with --system")
    );
    assert_eq!(std::fs::read_to_string(&system).unwrap(), written);

    // What the file states is less: that is violated, until it is written.
    let strict = SYSTEM.replacen("wcet = \"20s\"", "wcet = \"0.5ms\" # guessed", 1);
    let strict = scratch.write("strict.toml", &strict);
    let strict = strict.to_str().unwrap();
    let exceeded = taut(&[path, "--system", strict, "--wcet"]);
    assert_eq!(exceeded.status.code(), Some(1));
    assert!(text(&exceeded.stdout).contains("wcet exceeded"), "{exceeded:?}");
    let raised = taut(&[path, "--system", strict, "--wcet", "--write"]);
    assert_eq!(raised.status.code(), Some(0), "{raised:?}");
    assert!(text(&raised.stdout).contains("fine: wcet \"500us\" -> "), "{raised:?}");
    assert!(std::fs::read_to_string(strict).unwrap().contains(" # guessed; measured 20"), "{raised:?}");
    let again = taut(&[path, "--system", strict, "--wcet", "--write"]);
    assert_eq!(again.status.code(), Some(0));
    assert!(text(&again.stdout).contains("nothing is changed"), "{again:?}");

    for (arguments, words) in [
        (&[path, "--wcet", "--exceedance", "2"][..], "no number of 1e-12 to 0.01"),
        (&[path, "--write"], "--wcet"),
        (&[path, "--wcet", "--lower"], "--write"),
    ] {
        let refused = taut(arguments);
        assert_eq!(refused.status.code(), Some(2));
        assert!(text(&refused.stderr).contains(words), "{refused:?}");
    }
}

#[test]
fn execution_times_are_fitted_by_the_size_of_the_input() {
    let scratch = Scratch::new("sizes");
    let (path, mut run) = saved(&scratch, 58);
    let path = path.as_str();

    // The callback says how long it is told to work: that went through the statistics' file.
    let fine = run["processes"][0]["callbacks"].as_array_mut().unwrap();
    let fine = fine.iter_mut().find(|of| of["name"] == "fine").unwrap();
    let [class] = fine["inputs"].as_array().unwrap().as_slice() else { panic!("{fine}") };
    let (jobs, least) = (&class["jobs"], &class["least"]);
    assert_eq!((jobs, least, &class["max_ns"]), (&1.into(), &1_000_000.into(), &fine["execution"]["max_ns"]));
    assert!(
        text(&taut(&[path, "--wcet"]).stdout)
            .contains("fine: no line, for all inputs were of about one size")
    );

    // 0.2 ms and 2 us for each unit, at most: 1.2 ms for 500, 2.2 ms for 1000.
    let class = |least: u64, greatest: u64, max_ns: u64| {
        serde_json::json!({
            "jobs": 700, "least": least, "greatest": greatest, "max_ns": max_ns, "size_of_max": least, "longest_ns": vec![max_ns; 64],
        })
    };
    fine["inputs"] = serde_json::json!([
        class(500, 500, 1_200_000),
        class(750, 760, 1_300_000),
        class(1000, 1000, 2_200_000)
    ]);
    fine["execution"] = serde_json::json!({"sum_ns": 0, "max_ns": 2_200_000, "buckets": [[2_200_000, 2100]]});
    fine["completions"] = 2100.into();
    let others = run["processes"][0]["callbacks"].as_array_mut().unwrap().iter_mut();
    others
        .filter(|of| of["name"] != "fine")
        .for_each(|of| drop(of.as_object_mut().unwrap().remove("inputs")));
    std::fs::write(path, run.to_string()).unwrap();
    let fits = json(&taut(&[path, "--wcet", "--json"]));
    let fine = &fits["callbacks"][0];
    assert_eq!(fine["line"], serde_json::json!({"fixed_ms": 0.2, "per_unit_ms": 0.002}));
    assert_eq!((&fine["sizes"][1]["greatest"], &fine["sizes"][1]["max_ms"]), (&760.into(), &1.3.into()));
    assert_eq!(fine["sizes"][1]["no_estimate"], "because that takes 10000 jobs");
    assert_eq!((&fine["needed_wcet_ms"], &fine["input_max"]), (&2.2.into(), &Value::Null));
    let shown = text(&taut(&[path, "--wcet"]).stdout).replace('\n', " ");
    assert!(
        shown.contains("no job used more than 200us + 2us * size") && shown.contains("750 to 760"),
        "{shown}"
    );
    assert!(shown.contains("with `input_max = 1000` or more in the file"), "{shown}");

    // What the file states is computed for the largest input that it allows.
    let stated = |input_max: u64| {
        let text = SYSTEM.replacen("wcet = \"20s\"", &format!("wcet = \"1ms\"\ninput_max = {input_max}"), 1);
        let file = scratch.write("stated.toml", &text).to_str().unwrap().to_owned();
        (taut(&[path, "--system", &file, "--wcet", "--write"]), std::fs::read_to_string(&file).unwrap(), file)
    };
    let (output, written, file) = stated(4000);
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    assert!(text(&output.stdout).replace('\n', " ").contains("no input above 1000 was seen"), "{output:?}");
    let line = written.lines().find(|line| line.contains("measured")).unwrap();
    assert!(line.starts_with("wcet = \"8.2ms\" # measured 20"), "{line}");
    assert!(
        line.contains(
            "200us + 2us * size for sizes to 1000 (1 in 1000000 above at 0 of 3 sizes, 95 %), of which 4000"
        ),
        "{line}"
    );
    let checked = Command::new(env!("CARGO_BIN_EXE_taut")).args(["check", &file]).output().unwrap();
    assert!(text(&checked.stdout).contains("wcet holds of fine for inputs up to 4000."), "{checked:?}");

    // Larger ones were seen than it allows: less than what was seen is not written, and it stays violated.
    let (output, written, file) = stated(600);
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    assert!(written.contains("wcet = \"2.2ms\" # measured"), "{written}");
    let report = json(&taut(&[path, "--system", &file, "--json"]));
    // How long its one real job took is the machine's affair.
    let found = violations(&report, "fine");
    assert!(found[0] == "input too large" && !found.contains(&"wcet exceeded".to_owned()), "{found:?}");
    let output = taut(&[path, "--system", &file, "--wcet"]);
    assert_eq!(output.status.code(), Some(1));
    let shown = text(&output.stdout).replace('\n', " ");
    assert!(shown.contains("the input of a job had the size 1000, the file allows `input_max = 600` (exceeded 1400 times in 2100 jobs"), "{shown}");
    assert!(shown.contains("set `input_max = 1000` or more"), "{shown}");

    // `other` states no sizes.
    let silent = scratch.write("silent.toml", &format!("{SYSTEM}input_max = 5\n"));
    let output = taut(&[path, "--system", silent.to_str().unwrap(), "--wcet"]);
    assert!(
        text(&output.stdout)
            .replace('\n', " ")
            .contains("other: the file states `input_max`, but its jobs state no sizes"),
        "{output:?}"
    );
}

/// The member of a JSON object.
fn member<'v>(value: &'v mut Value, path: &str) -> &'v mut Value {
    value.pointer_mut(path).unwrap_or_else(|| panic!("no {path}"))
}

#[test]
fn no_violation_gets_lost_between_buckets_or_processes() {
    let scratch = Scratch::new("lost");
    let (path, saved) = saved(&scratch, 129);
    let path = path.as_str();
    let report = |run: &Value, arguments: &[&str]| {
        std::fs::write(path, run.to_string()).unwrap();
        json(&taut(&[&[path, "--json"], arguments].concat()))
    };

    // A deadline within the bucket of the longest response, which is counted nowhere but as the maximum.
    let mut run = saved.clone();
    let fine =
        run["processes"][0]["callbacks"].as_array().unwrap().iter().position(|of| of["name"] == "fine");
    let fine = format!("/processes/0/callbacks/{}", fine.unwrap());
    *member(&mut run, &format!("{fine}/response/max_ns")) = 10_020_000.into();
    *member(&mut run, &format!("{fine}/response/buckets")) = serde_json::json!([[9_961_472, 1]]);
    let strict = SYSTEM.replacen("priority = 50", "priority = 50\ndeadline = \"10ms\"", 1);
    let strict = scratch.write("strict.toml", &strict);
    let shown = report(&run, &["--system", strict.to_str().unwrap()]);
    assert_eq!(shown["callbacks"][0]["measured"]["deadline_misses"], 1, "{shown}");
    assert!(violations(&shown, "fine").contains(&"deadline missed".to_owned()), "{shown}");

    // A process that ended before this one and was late.
    let mut run = saved;
    let mut before = run["processes"][0].clone();
    (before["pid"], before["running"]) = (1.into(), false.into());
    for callback in before["callbacks"].as_array_mut().unwrap() {
        (callback["ended"], callback["last_release_ns"]) =
            (true.into(), callback["first_release_ns"].clone());
    }
    *member(&mut before, &fine.replacen("/processes/0", "", 1)).pointer_mut("/deadline_misses").unwrap() =
        3.into();
    run["processes"].as_array_mut().unwrap().insert(0, before);
    let shown = report(&run, &[]);
    assert_eq!(
        (&shown["kept"], violations(&shown, "fine").as_slice()),
        (&false.into(), &["deadline missed".to_owned()][..])
    );
    let explanation = shown["callbacks"][0]["violations"][0]["explanation"].as_str().unwrap();
    assert!(
        explanation.starts_with("in report-") && explanation.contains("(process 1): 3 jobs"),
        "{explanation}"
    );
}

#[test]
fn a_job_that_does_not_end_is_late() {
    let scratch = Scratch::new("stuck");
    let system = scratch.write("system.toml", SYSTEM);
    let mut running = Running::start(198, Realtime::Off, &system);
    let numbers = running.node.subscribe::<Work>("fine", Qos::default()).unwrap();
    // Released when the machine was started, and never done while this test looks.
    let publisher = running.publisher("fine");
    publish(&publisher, LITTLE, 1);
    let (begun, (end, until_end)) = (running.done.0.clone(), channel::<()>());
    let stuck = move |_: Sample<Work>| {
        begun.send(()).unwrap();
        let _ = until_end.recv();
        async {}
    };
    let options = running.context.callback("fine").unwrap();
    let handle = running.node.spawn_callback(options, numbers.for_each(stuck)).unwrap();
    running.done.1.recv().unwrap();
    let report = json(&taut(&["--domain", "198", "--json"]));
    assert!(violations(&report, "fine").contains(&"bound exceeded".to_owned()), "{report}");
    let shown = text(&taut(&["--domain", "198"]).stdout).replace('\n', " ");
    assert!(shown.contains("so far, for its job has not ended"), "{shown}");
    drop(end);
    while handle.stats().completions() == 0 {
        std::thread::yield_now();
    }
}

#[test]
fn what_was_violated_is_named_with_what_to_change() {
    const MORE: &str = r#"
[callbacks]
hungry = { topic = "hungry", wcet = "2ms", priority = 30, deadline = "300s" }
rushed = { topic = "rushed", wcet = "20ms", priority = 29, deadline = "300s" }
late = { topic = "late", wcet = "20ms", priority = 28, deadline = "2s" }
lossy = { topic = "lossy", wcet = "20ms", priority = 27, deadline = "400s" }
full = { topic = "full", wcet = "20ms", priority = 26, deadline = "400s" }
often = { topic = "often", wcet = "1ms", priority = 23, deadline = "300s" }
absent = { topic = "other", wcet = "1ms", priority = 25 }
ticks = { period = "1s", wcet = "1ms", priority = 24 }
"#;
    let topics =
        ["hungry", "rushed", "late", "lossy", "full"].map(|name| format!("{name} = {{ period = \"1s\" }}\n"));
    let often = "often = { period = \"1s\", jitter = \"2s\" }\n";
    let system =
        SYSTEM.split("[callbacks.fine]").next().unwrap().to_owned() + &topics.concat() + often + MORE;
    let scratch = Scratch::new("violated");
    let path = scratch.write("system.toml", &system);
    let mut running = Running::start(169, Realtime::Off, &path);
    running.handle("hungry", 1, &releases(1, PERIOD, MUCH));
    running.handle("rushed", 3, &releases(3, PERIOD / 4, Duration::ZERO));
    running.handle("late", 1, &[(LITTLE, 1)]);
    running.handle("lossy", 1, &releases(3, Duration::ZERO, LITTLE));
    running.handle("full", 3, &releases(3, PERIOD, LITTLE));
    running.handle_with(CallbackOptions::other().name("stray"), "stray", 1, &releases(1, PERIOD, LITTLE));
    running.handle_with(CallbackOptions::other().name("idle"), "idle", 1, &[]);
    // Any two may be that close, but not all of them.
    running.handle("often", 9, &releases(9, PERIOD / 10, Duration::ZERO));
    let ticks = running.context.callback("ticks").unwrap();
    running.node.spawn_callback(ticks, async {}).unwrap().join().unwrap();

    let output = taut(&[path.to_str().unwrap(), "--domain", "169", "--json"]);
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    let report = json(&output);
    let has = |callback: &str, expected: &[&str]| {
        let found = violations(&report, callback);
        assert!(expected.iter().all(|name| found.iter().any(|one| one == name)), "{callback}: {found:?}");
        found
    };
    assert_eq!(has("hungry", &["wcet exceeded"])[0], "wcet exceeded");
    assert_eq!(has("rushed", &["period not kept"])[0], "period not kept");
    assert_eq!(has("late", &["bound exceeded", "deadline missed"]).len(), 2);
    assert_eq!(has("often", &["period not kept"])[0], "period not kept");
    has("lossy", &["messages lost"]);
    has("full", &["queue over capacity"]);
    assert_eq!(has("absent", &["not running"]).len(), 1);
    assert_eq!(has("ticks", &["not running"]).len(), 1, "it has ended");
    // Without real-time priority it takes nothing from anybody: named, not marked.
    assert_eq!(violations(&report, "stray"), [""; 0]);

    let shown = text(&taut(&["--domain", "169"]).stdout);
    for said in [
        "hungry: wcet exceeded: a job used 3",
        "set `wcet = \"3",
        "rushed: period not kept: two releases were 250 ms apart, the file allows no less than 1000 ms",
        "jitter = \"750ms\"",
        "often: period not kept: it was released 9 times in 800 ms, the file allows 3",
        "lossy: messages lost: 2 messages were overwritten in a queue of 1",
        "absent: not running: no process of domain 169",
        "ticks: not running: its future has ended in report-",
        "`stray` runs in report-",
        "note: not in the file, and not run yet: idle",
        "Violated: ",
    ] {
        assert!(shown.replace('\n', " ").contains(said), "{said}\n{shown}");
    }
}

#[test]
fn a_watcher_sees_a_run_to_its_end_and_keeps_it() {
    let scratch = Scratch::new("watch");
    let system = scratch.write("system.toml", &SYSTEM.replace("[callbacks.other]", "[callbacks.o]"));
    let run = scratch.0.join("run.json");
    let mut watcher = command(&["--watch", "--json", "--domain", "170", "--save", run.to_str().unwrap()])
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let mut running = Running::start(170, Realtime::Off, &system);
    running.handle("fine", 1, &releases(1, PERIOD, LITTLE));
    let mut lines = BufReader::new(watcher.stdout.take().unwrap()).lines();
    // It has found the process.
    lines.next().unwrap().unwrap();
    running.handle("o", 1, &[]);
    running.handle_with(running.context.callback("o").unwrap(), "other", 2, &releases(2, PERIOD, LITTLE));
    running.handle_with(CallbackOptions::other().name("stray"), "stray", 1, &releases(1, PERIOD, LITTLE));
    let both = json(&taut(&["--domain", "170", "--json"]));
    assert_eq!(violations(&both, "o")[0], "runs twice", "{both}");
    drop(running);
    let last: Value = serde_json::from_str(&lines.map_while(Result::ok).last().unwrap()).unwrap();
    assert_eq!(watcher.wait().unwrap().code(), Some(1), "{last}");
    assert!(!violations(&last, "o").contains(&"runs twice".to_owned()), "they have ended: {last}");
    let o = &last["callbacks"][1]["measured"];
    assert_eq!((&o["jobs"], &o["ended"]), (&2.into(), &true.into()), "{last}");
    assert_eq!(
        (&last["processes"][0]["running"], &last["unknown"][0]["name"]),
        (&false.into(), &"stray".into())
    );
    let saved = json(&taut(&[run.to_str().unwrap(), "--json"]));
    assert_eq!(saved, last);
}

#[test]
fn priorities_and_cores_are_compared_where_they_are_real() {
    if test_needs(realtime_permitted(60)).is_none() {
        return;
    }
    let scratch = Scratch::new("realtime");
    let system = scratch.write("system.toml", SYSTEM);
    let mut running = Running::start(171, Realtime::Required, &system);
    running.handle("fine", 1, &releases(1, PERIOD, LITTLE));
    let other = running.context.callback("other").unwrap();
    let lower = CallbackOptions { policy: tautline::Policy::Fifo(7), cores: None, ..other };
    running.handle_with(lower, "other", 1, &releases(1, PERIOD, LITTLE));
    running.handle_with(CallbackOptions::fifo(5).name("stray"), "stray", 1, &releases(1, PERIOD, LITTLE));
    let output = taut(&["--domain", "171", "--json"]);
    let report = json(&output);
    assert_eq!((output.status.code(), &report["realtime"]), (Some(1), &Value::Bool(true)));
    assert!(!violations(&report, "fine").iter().any(|name| name.starts_with("wrong")), "{report}");
    let one_core = tautline::CoreSet::allowed().unwrap().len() == 1;
    let expected = if one_core { vec!["wrong priority"] } else { vec!["wrong priority", "wrong core"] };
    assert_eq!(violations(&report, "other"), expected);
    assert_eq!(violations(&report, "stray"), ["not in the file"]);
    assert_eq!(report["processes"][0]["violations"], Value::Array(vec![]));

    // A sampler that callbacks keep from running.
    drop(running);
    let low = SYSTEM.replace("sampler_priority = 60", "sampler_priority = 45");
    let mut running = Running::start(171, Realtime::Required, &scratch.write("low.toml", &low));
    running.handle("fine", 1, &releases(1, PERIOD, LITTLE));
    let report = json(&taut(&["--domain", "171", "--json"]));
    assert_eq!(report["processes"][0]["violations"][0]["name"], "sampler too low", "{report}");
}

#[test]
fn what_does_not_fit_beside_it_is_told_by_check_and_by_the_report() {
    if test_needs(realtime_permitted(60)).is_none() {
        return;
    }
    let scratch = Scratch::new("admission");
    let system = scratch.write("system.toml", SYSTEM);
    let heavy = SYSTEM.replace("fine", "plan").replace("other", "act").replace("\"20s\"", "\"499s\"");
    let heavy = scratch.write("heavy.toml", &heavy);
    let check = |domain: &str, json: bool| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_taut"));
        command.args(["check", heavy.to_str().unwrap(), "--admit", "--domain", domain]);
        command.args(json.then_some("--json")).env_remove("TAUT_HOST").output().unwrap()
    };
    let alone = check("96", true);
    assert_eq!((alone.status.code(), &json(&alone)["admission"]["admitted"]), (Some(0), &Value::Bool(true)));

    let _running = Running::start(96, Realtime::Required, &system);
    let beside = check("96", true);
    let told = json(&beside);
    assert_eq!((beside.status.code(), &told["admission"]["admitted"]), (Some(1), &Value::Bool(false)));
    assert_eq!(told["admission"]["beside"].as_array().unwrap().len(), 1, "{told}");
    assert_eq!(told["callbacks"].as_array().unwrap().len(), 4, "both files' callbacks");
    let shown = check("96", false);
    let shown = text(&shown.stdout);
    assert!(shown.contains("Not admitted to domain 96, beside report-"), "{shown}");
    assert!(shown.contains("- callback `act` of ") && shown.contains("its deadline is 1000s"), "{shown}");

    let builder = || Context::builder().domain(96).lock_memory(false).system(&heavy);
    let refused = builder().build().map(drop).unwrap_err().to_string();
    assert!(refused.contains("callback `act`") && refused.contains("heavy.toml --admit"), "{refused}");
    let forced = builder().admission(tautline::Admission::Force).build().unwrap();
    let report = taut(&["--domain", "96", "--json", system.to_str().unwrap()]);
    assert!(text(&report.stdout).contains("was admitted by force: "), "{report:?}");
    drop(forced);
}

#[test]
fn bad_input_is_refused_and_names_the_fix() {
    let scratch = Scratch::new("bad");
    let bad = scratch.write("bad.toml", "[hosts.robot]\ncoers = 1");
    let broken = scratch.write("broken.json", "{\"format\": 1}");
    let other = scratch.write("other.json", "{}");
    let (bad, broken, other) = (bad.to_str().unwrap(), broken.to_str().unwrap(), other.to_str().unwrap());
    let run = SYSTEM; // not a saved run
    let toml = scratch.write("system.toml", run);
    let toml = toml.to_str().unwrap();
    let cases: [(&[&str], &str); 8] = [
        (&["/nowhere.toml"], "`/nowhere.toml` cannot be read"),
        (&["--domain", "172"], "no process of domain 172 shows statistics"),
        (&[toml, "--domain", "172"], "`.system(\"system.toml\")`"),
        (&[broken], "is not a saved run"),
        (&[other], "missing field"),
        (&[other, "--watch"], "cannot be watched"),
        (&[toml, "--system", toml, "--domain", "172"], "--system goes with a saved run"),
        (&["--domain", "233"], "233"),
    ];
    for (arguments, said) in cases {
        let output = taut(arguments);
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {output:?}");
        assert!(text(&output.stderr).contains(said), "{arguments:?}: {output:?}");
    }
    let system = scratch.write("good.toml", SYSTEM);
    let _running = Running::start(172, Realtime::Off, &system);
    let output = taut(&[bad, "--domain", "172"]);
    assert_eq!(output.status.code(), Some(2));
    assert!(text(&output.stderr).contains("bad.toml:2:1: unknown key `coers`"), "{output:?}");
    let output = taut(&["--domain", "172", "--save", "/nowhere/run.json"]);
    assert_eq!(output.status.code(), Some(2));
    assert!(text(&output.stderr).contains("/nowhere/run.json` cannot be written"), "{output:?}");
}

/// It ends with this.
struct Killed(std::process::Child);

impl Drop for Killed {
    fn drop(&mut self) {
        let _ = self.0.kill();
    }
}

/// Its node's callbacks are not missed, and the others are looked at; when it ends they are.
#[test]
fn a_node_that_is_played_from_a_bag_is_told_of() {
    use std::collections::BTreeMap;
    use tautline_bag::{Definition, Options, Stamp, Topic, Writer};
    let scratch = Scratch::new("stand_in");
    let text = format!(
        "{}\n[nodes.camera]\n[callbacks.capture]\nnode = \"camera\"\nperiod = \"1s\"\nwcet = \"1ms\"\npriority = 55\n\
         publishes = \"fine\"\n",
        SYSTEM
            .replace("fine = { period = \"1000s\" }", "fine = {}")
            .replace("[callbacks.fine]", "[callbacks.fine]\nnode = \"driver\"")
            .replace("[callbacks.other]", "[callbacks.other]\nnode = \"driver\"")
            .replace("wcet = \"20s\"", "wcet = \"300ms\"")
    );
    let system = scratch.write("system.toml", &text);
    let mut writer = Writer::create(&scratch.0.join("bag"), Options::default(), BTreeMap::new()).unwrap();
    let topic = |name: &str| Topic {
        name: name.to_owned(),
        type_name: "test_msgs/msg/Work".to_owned(),
        definition: Some(Definition::ros2msg("uint64 burn_ns\n")),
        ..Topic::default()
    };
    let ids = ["/fine", "/elsewhere"].map(|name| writer.add_topic(topic(name)).unwrap());
    for n in 0..3_u64 {
        let cdr = [&[0, 1, 0, 0][..], &1_000_000_u64.to_le_bytes()].concat();
        let stamp = Stamp { sequence: n as u32 + 1, log_ns: (n + 1) * 1_000_000_000, publish_ns: n };
        ids.iter().for_each(|id| writer.write(*id, stamp, &cdr).unwrap());
    }
    writer.finish(BTreeMap::new()).unwrap();

    let mut running = Running::start(48, Realtime::Off, &system);
    let subscription = running.node.subscribe::<Work>("fine", Qos::keep_last(1)).unwrap();
    let done = running.done.0.clone();
    let work = subscription.for_each(move |work: Sample<Work>| {
        drop(work);
        done.send(()).unwrap();
        async {}
    });
    let options = running.context.callback("fine").unwrap();
    let _handle = running.node.spawn_callback(options, work).unwrap();
    running.handle("other", 1, &releases(1, PERIOD, LITTLE));
    let play = |more: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_taut"));
        command.args(["play", "bag", "--as", "camera", "--no-rt"]).args(more).current_dir(&scratch.0);
        command
            .env("TAUT_DOMAIN", "48")
            .env_remove("TAUT_SYSTEM")
            .stdout(Stdio::piped())
            .stderr(Stdio::piped());
        command
    };
    let report = || json(&taut(&["--domain", "48", "--json"]));
    assert_eq!(violations(&report(), "capture"), ["not running"]);
    // The file is the one that the process was started with.
    let mut player = Killed(play(&["--loop"]).spawn().unwrap());
    for _ in 0..2 {
        running.done.1.recv_timeout(Duration::from_secs(60)).unwrap();
    }
    let seen = report();
    assert_eq!(violations(&seen, "capture"), [""; 0], "{seen}");
    let fine =
        seen["callbacks"].as_array().unwrap().iter().find(|callback| callback["name"] == "fine").unwrap();
    assert!(fine["measured"]["jobs"].as_u64().unwrap() >= 2, "{fine}");
    assert_eq!(violations(&seen, "fine"), [""; 0], "{fine}");
    let notes = seen["notes"].to_string();
    assert!(notes.contains("camera is played from a bag by taut"), "{notes}");
    // What is not its own is not played, and another one is refused.
    let second = play(&[]).output().unwrap();
    let words = self::text(&second.stderr);
    assert!(
        second.status.code() == Some(2)
            && words.contains("/camera (process")
            && words.contains("runs itself"),
        "{words}"
    );
    player.0.kill().unwrap();
    player.0.wait().unwrap();
    assert_eq!(violations(&report(), "capture"), ["not running"]);
    for (more, code, expected) in
        [(&["--system", "none.toml"][..], 2, "`"), (&["/fine"], 2, "cannot be used with")]
    {
        let refused = play(more).output().unwrap();
        let words = self::text(&refused.stderr);
        assert!(refused.status.code() == Some(code) && words.contains(expected), "{words}");
    }
}
