// SPDX-License-Identifier: MIT OR Apache-2.0
//! Admission: what does not fit beside what runs is refused, whoever comes first and however others end.

mod common;

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use common::{File, realtime};
use futures::future::pending;
use tautline::{
    Admission, CallbackGroup, CallbackHandle, CallbackOptions, Context, Error, Node, Result, SystemError,
};
use tautline_executor::Admitted;
use tautline_system::{Running, shared_statistics};

/// Each test has a domain of its own, in a scope of its own.
fn scope() {
    tautline_rt::domain::set_scope(&format!("admission-{}", std::process::id())).unwrap();
}

/// Whether a test may have real-time priorities, in its scope.
fn may_run() -> bool {
    scope();
    realtime()
}

/// One timer of 10 ms on core 0.
fn timer(name: &str, wcet_ms: u32, priority: u8) -> File {
    File::new(
        name,
        &format!(
            "[hosts.robot]\ncores = 1\nsampler_priority = 60\n[overheads]\ncontext_switch = \"1us\"\n[nodes.{name}]\n[callbacks.{name}]\n\
             period = \"10ms\"\nwcet = \"{wcet_ms}ms\"\npriority = {priority}\n"
        ),
    )
}

#[track_caller]
fn refusal<T>(result: Result<T>) -> String {
    match result {
        Err(error @ Error::System(SystemError::NotAdmitted { .. })) => error.to_string(),
        Err(error) => panic!("another error: {error}"),
        Ok(_) => panic!("admitted"),
    }
}

fn spawn(context: &Context, options: CallbackOptions) -> Result<CallbackHandle> {
    Node::create(context.clone(), "node", "")?.spawn_callback(options, pending())
}

#[test]
fn a_file_that_does_not_fit_is_refused_with_the_response_time_that_would_break() {
    if !may_run() {
        return;
    }
    let (a, b, alone) = (timer("a", 4, 40), timer("b", 7, 50), timer("alone", 10, 30));
    let text = refusal(alone.context(1));
    assert!(text.contains("beside it run: nothing") && text.contains("callback `alone`"), "{text}");

    let first = a.context(1).unwrap();
    let _again = a.context(1).expect("two processes of one file are one system");
    let text = refusal(b.context(1));
    // 4 + 7 > 10: at the lower priority, `a` has no bound, or is late.
    for part in [
        "b.toml is not admitted to domain 1",
        "callback `a` of",
        "its deadline is 10ms",
        "TAUT_ADMISSION=force",
        "--admit",
    ] {
        assert!(text.contains(part), "{part}: {text}");
    }
    assert_eq!(shared_statistics(1).unwrap().0.len(), 2, "nothing of what was refused is left");
    let _elsewhere = b.context(2).expect("another domain is looked at alone");
    drop((first, _again));
    let _b = b.context(1).expect("what has ended leaves its place");
}

#[test]
fn by_force_it_runs_and_its_statistics_say_so() {
    if !may_run() {
        return;
    }
    let (a, b) = (timer("a", 4, 40), timer("b", 7, 50));
    let _a = a.context(1).unwrap();
    let _b = Context::builder().domain(1).system(&b.0).admission(Admission::Force).build().unwrap();
    let admitted: Vec<_> = shared_statistics(1)
        .unwrap()
        .0
        .iter()
        .map(|statistics| statistics.read().unwrap().unwrap().process)
        .map(|process| (process.system_path.ends_with(b.0.file_name().unwrap()), process.admitted))
        .collect();
    assert_eq!(admitted.len(), 2);
    for (is_b, admitted) in admitted {
        match admitted {
            Admitted::Forced(why) => assert!(is_b && why.contains("callback `a`"), "{why}"),
            other => assert!(!is_b && other == Admitted::Checked, "{other:?}"),
        }
    }
}

#[test]
fn without_real_time_priorities_or_a_check_nothing_is_refused() {
    scope();
    let alone = timer("alone", 10, 30);
    let off =
        Context::builder().domain(1).system(&alone.0).realtime(tautline::Realtime::Off).build().unwrap();
    assert!(Running::of_domain(1).unwrap().machine().is_empty(), "nobody is delayed by it");
    drop(off);
    if realtime() {
        Context::builder().domain(1).system(&alone.0).admission(Admission::Off).build().unwrap();
    }
}

#[test]
fn callbacks_are_checked_that_the_file_does_not_count() {
    if !may_run() {
        return;
    }
    let a = timer("a", 4, 40);
    let context = a.context(1).unwrap();
    let of_file = context.callback("a").unwrap();
    let first = spawn(&context, of_file.clone()).expect("it is the file's");
    // A second one: 8 of 10 ms are kept, a third is too much.
    let other = a.context(1).unwrap();
    let second = spawn(&other, of_file.clone()).unwrap();
    let text = refusal(spawn(&context, of_file.clone()));
    assert!(text.starts_with("callback 'a' is not admitted"), "{text}");
    second.stop();
    second.join().unwrap();
    let third = spawn(&context, of_file).expect("the second has ended");

    let ms = Duration::from_millis;
    let loose = |priority, budget| {
        CallbackOptions::fifo(priority).name("loose").core(0).period(ms(10)).budget(budget)
    };
    assert!(refusal(spawn(&context, loose(50, ms(3)))).contains("callback `a`"));
    assert!(refusal(spawn(&context, loose(30, ms(3)))).contains("callback `loose`"));
    spawn(&context, loose(30, ms(1))).unwrap();
    // What says nothing of its load may run where it delays nobody.
    let silent = |priority| CallbackOptions::fifo(priority).name("silent").core(0);
    let text = refusal(spawn(&context, silent(50)));
    assert!(text.contains("states no `period` or no `budget`") && text.contains("have no bound"), "{text}");
    spawn(&context, silent(20)).unwrap();
    spawn(&context, CallbackOptions::other().name("at leisure")).unwrap();

    let mut group = CallbackGroup::new();
    group.add(loose(50, ms(3)), futures::stream::pending::<u64>(), |at| *at, |_| async {});
    let node = Node::create(context.clone(), "grouped", "").unwrap();
    assert!(refusal(node.spawn_group(CallbackOptions::fifo(50).core(0), group)).contains("callback 'loose'"));
    drop((first, third));
}

#[test]
fn a_callback_moved_from_where_the_file_has_it_counts_besides() {
    if !may_run() {
        return;
    }
    let a = timer("a", 4, 40);
    let context = a.context(1).unwrap();
    let mut moved = context.callback("a").unwrap();
    moved.policy = tautline::Policy::Fifo(41);
    spawn(&context, moved.clone()).expect("8 of 10 ms, in the file's place and in its own");
    let text = refusal(spawn(&context, moved));
    assert!(text.contains("callback `a`"), "{text}");
}

#[test]
fn a_reservation_delays_every_core_that_it_may_run_on() {
    if !may_run() {
        return;
    }
    let a = timer("a", 4, 40);
    let context = a.context(1).unwrap();
    let reserved = |runtime| {
        CallbackOptions::reserved(Duration::from_millis(runtime), Duration::from_millis(10)).name("points")
    };
    let text = refusal(spawn(&context, reserved(6)));
    assert!(text.contains("callback `a`"), "{text}");
    let points = spawn(&context, reserved(1)).expect("4 and 2 of 10 ms");
    assert_eq!(
        points.thread().policy,
        tautline::Policy::Deadline { runtime_ns: 1_000_000, period_ns: 10_000_000 }
    );
    // What runs is known from what the kernel says of it.
    let b = CallbackOptions::fifo(50).core(0).name("b").period(Duration::from_millis(10));
    let text = refusal(spawn(&context, b.budget(Duration::from_millis(5))));
    assert!(text.contains("callback `a`"), "{text}");
}

const PART: &str = "TAUT_TEST_PART";

/// The child's part; without its variable it is no test: it wants to be admitted with the file, says how that went, and stays.
#[test]
fn child_main() {
    let Some(path) = std::env::var_os(PART) else { return };
    match Context::builder().domain(1).system(Path::new(&path)).build() {
        Ok(context) => {
            spawn(&context, context.callback("a").unwrap()).unwrap();
            println!("\nadmitted");
            std::io::stdin().lines().next();
        }
        Err(Error::System(SystemError::NotAdmitted { .. })) => println!("\nrefused"),
        Err(error) => println!("\n{error}"),
    }
}

struct Peer(Child, std::io::Lines<BufReader<std::process::ChildStdout>>);

impl Peer {
    fn start(file: &File) -> Peer {
        let mut command = Command::new(std::env::current_exe().unwrap());
        command.args(["--exact", "child_main", "--nocapture", "--test-threads=1"]).env(PART, &file.0);
        command.env("TAUT_SCOPE", format!("admission-{}", std::process::id()));
        let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
        let lines = BufReader::new(child.stdout.take().unwrap()).lines();
        Peer(child, lines)
    }

    fn is_admitted(&mut self) -> bool {
        let word = self
            .1
            .by_ref()
            .map_while(std::result::Result::ok)
            .find(|line| line == "admitted" || line == "refused");
        word.expect("a word") == "admitted"
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

#[test]
fn of_many_that_start_at_once_as_many_are_admitted_as_fit_and_killed_ones_leave_their_places() {
    if !may_run() {
        return;
    }
    // Texts of their own are systems of their own: 3 of 3 ms fit, a fourth does not.
    let file = |n: u32| {
        let text = std::fs::read_to_string(&timer("a", 3, 40).0).unwrap();
        File::new(
            &format!("file{n}"),
            &format!("# {n}\n{}", text.replace("priority = 40", "priority = 40\nshares_priority = true")),
        )
    };
    let files: Vec<_> = (0..8).map(file).collect();
    // The last one of the domain, who takes away what killed processes leave.
    let _last = Context::builder().domain(1).build().unwrap();
    for round in 0..3 {
        let mut peers: Vec<_> = files.iter().map(Peer::start).collect();
        let admitted = peers.iter_mut().map(Peer::is_admitted).filter(|admitted| *admitted).count();
        assert_eq!(admitted, 3, "round {round}");
        // All are killed by that, in the midst of whatever they do.
    }
}

#[test]
fn who_dies_while_it_is_being_admitted_keeps_nobody_out() {
    if !may_run() {
        return;
    }
    let a = timer("a", 4, 40);
    let _member = a.context(1).unwrap();
    let folder = tautline_rt::domain::shared_path(1);
    let script = format!("exec 9<{} && flock -x 9 && echo locked && exec sleep 100", folder.display());
    let mut holder = Command::new("sh").args(["-c", &script]).stdout(Stdio::piped()).spawn().unwrap();
    let mut line = String::new();
    BufReader::new(holder.stdout.as_mut().unwrap()).read_line(&mut line).unwrap();
    assert_eq!(line, "locked\n");
    let waiting = std::thread::spawn({
        let path = a.0.clone();
        move || Context::builder().domain(1).system(path).build().map(drop)
    });
    holder.kill().unwrap();
    holder.wait().unwrap();
    waiting.join().unwrap().unwrap();
}
