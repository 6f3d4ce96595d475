// SPDX-License-Identifier: MIT OR Apache-2.0
//! Processes that record and a recorder that fetches: switching on and off, losing and counting, dying on either side.
//!
//! What is traced is the process's, so each test runs in a process of its own. The domains are none of ROS 2: no topics are opened.

use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, Write};
use std::os::unix::fs::MetadataExt;
use std::path::PathBuf;
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use tautline_trace::{EventKind, MessageId, Record, Recorder, TraceError, TraceMode, TraceSettings};

/// Everything of a recording, by process name or thread name.
#[derive(Default, Debug)]
struct Seen {
    processes: Vec<u32>,
    ended: usize,
    objects: Vec<String>,
    threads: BTreeMap<u32, String>,
    /// Sequence numbers of publications, by thread.
    published: BTreeMap<u32, Vec<u64>>,
    kinds: Vec<EventKind>,
    lost: u64,
    unrecorded: u64,
}

impl Seen {
    fn note(&mut self, record: Record<'_>) {
        match record {
            Record::Process { pid, .. } => self.processes.push(pid),
            Record::Object { object, .. } => self.objects.push(object.name.clone()),
            Record::Thread { tid, name, .. } => drop(self.threads.insert(tid, name.to_owned())),
            Record::Events { tid, events, .. } => {
                self.kinds.extend(events.iter().map(|event| event.kind));
                let published = events.iter().filter(|event| event.kind == EventKind::Publish);
                self.published.entry(tid).or_default().extend(published.map(|event| event.arguments[0]));
            }
            Record::Lost { events, .. } => self.lost += events,
            Record::Unrecorded { events, .. } => self.unrecorded += events,
            Record::Ended { .. } => self.ended += 1,
            _ => {}
        }
    }

    fn numbers(&self) -> Vec<u64> {
        self.published.values().flatten().copied().collect()
    }
}

/// Fetches all that is there.
fn record(domain: u32) -> Seen {
    let mut seen = Seen::default();
    Recorder::start(domain).unwrap().finish(&mut |record| seen.note(record));
    seen
}

fn publish(publisher: &tautline_trace::Object, number: u64) {
    let message = MessageId { sequence_number: number, source_timestamp_ns: 1, gid: [1, 2], address: 0 };
    tautline_trace::publish(publisher.id(), &message);
}

fn folder(domain: u32) -> PathBuf {
    PathBuf::from("/dev/shm").join(tautline_rt::domain::shared_folder(domain))
}

fn files(domain: u32) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder(domain)).into_iter().flatten().flatten();
    entries.map(|entry| entry.path()).collect()
}

const CHILD: &str = "TAUT_TEST_CHILD";

/// A test run again in a process of its own, which reads lines and answers with lines that begin with '>'.
struct Process {
    child: Child,
    to: ChildStdin,
    from: BufReader<ChildStdout>,
}

impl Process {
    /// `None` in the child.
    fn start(test: &str) -> Option<Process> {
        if std::env::var_os(CHILD).is_some() {
            return None;
        }
        let mut command = Command::new(std::env::current_exe().unwrap());
        command.args(["--exact", test, "--nocapture", "--test-threads=1"]).env(CHILD, "1");
        command.env_remove("TAUT_TRACE").env_remove("TAUT_TRACE_EVENTS");
        let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
        let (to, from) = (child.stdin.take().unwrap(), BufReader::new(child.stdout.take().unwrap()));
        Some(Process { child, to, from })
    }

    /// Waits for the child's next answer; `None` at its end.
    fn answer(&mut self) -> Option<String> {
        loop {
            let mut line = String::new();
            if self.from.read_line(&mut line).unwrap() == 0 {
                return None;
            }
            // The test harness prints, too, and does not end its line before the test does.
            if let Some((_, answer)) = line.trim_end().split_once('>') {
                return Some(answer.to_owned());
            }
        }
    }

    fn tell(&mut self, line: &str) {
        writeln!(self.to, "{line}").unwrap();
    }

    fn succeeds(mut self) {
        drop(self.to);
        assert!(self.child.wait().unwrap().success());
    }
}

/// In the child.
fn say(line: &str) {
    println!(">{line}");
}

/// In the child: the next line, empty at the end.
fn hear() -> String {
    let mut line = String::new();
    std::io::stdin().read_line(&mut line).unwrap();
    line.trim_end().to_owned()
}

/// Runs a test in a process of its own.
fn alone(test: &str, body: impl FnOnce()) {
    match Process::start(test) {
        Some(process) => process.succeeds(),
        None => body(),
    }
}

#[test]
fn a_small_ring_keeps_the_newest_and_counts_the_rest() {
    alone("a_small_ring_keeps_the_newest_and_counts_the_rest", || {
        tautline_trace::configure(TraceSettings::from(TraceMode::On).ring_events(16));
        let membership = tautline_trace::join(1193).unwrap();
        let publisher = tautline_trace::publisher_init("/small", 1, [1, 2]);
        (0..100).for_each(|n| publish(&publisher, n));
        let seen = record(1193);
        assert_eq!(seen.numbers(), (84..100).collect::<Vec<_>>());
        assert_eq!((seen.lost, seen.unrecorded), (84, 0));
        assert_eq!(seen.objects, ["/small"]);

        (100..110).for_each(|n| publish(&publisher, n));
        let seen = record(1193);
        assert_eq!(
            (seen.numbers(), seen.lost),
            ((100..110).collect::<Vec<_>>(), 0),
            "where the last one ended"
        );
        drop(membership);
        assert_eq!(files(1193), Vec::<PathBuf>::new(), "everything was fetched");
    });
}

#[test]
fn each_thread_has_a_ring_and_the_65th_is_counted() {
    alone("each_thread_has_a_ring_and_the_65th_is_counted", || {
        tautline_trace::configure(TraceSettings::from(TraceMode::On).ring_events(16));
        let _membership = tautline_trace::join(1194).unwrap();
        let publisher = tautline_trace::publisher_init("/many", 1, [1, 2]);
        let tasks = || std::fs::read_dir("/proc/self/task").unwrap().count();
        let before = tasks();
        let round = |threads: u64| {
            let all_there = std::sync::Barrier::new(threads as usize);
            std::thread::scope(|scope| {
                for number in 1..=threads {
                    let (publisher, all_there) = (&publisher, &all_there);
                    let thread = std::thread::Builder::new().name(format!("worker {number}"));
                    let body = move || {
                        tautline_trace::register_thread();
                        publish(publisher, number);
                        all_there.wait();
                    };
                    thread.spawn_scoped(scope, body).unwrap();
                }
            });
        };
        // This thread has one.
        round(64);
        let seen = record(1194);
        assert_eq!((seen.numbers().len(), seen.unrecorded), (63, 1));
        assert!(seen.threads.values().any(|name| name == "worker 7"), "{:?}", seen.threads);
        // The ended threads' rings are free again when they are drained and somebody attends to them. A joined thread may
        // still be on its way out of the kernel.
        while tasks() > before {
            std::thread::yield_now();
        }
        tautline_trace::attend();
        round(63);
        let seen = record(1194);
        assert_eq!((seen.numbers().len(), seen.unrecorded), (63, 1), "1 from before");
    });
}

#[test]
fn a_recorder_switches_a_running_process_on_and_off() {
    const DOMAIN: u32 = 1195;
    let Some(mut process) = Process::start("a_recorder_switches_a_running_process_on_and_off") else {
        tautline_trace::configure(TraceMode::Ready.into());
        let _membership = tautline_trace::join(DOMAIN).unwrap();
        let publisher = tautline_trace::publisher_init("/switched", 1, [1, 2]);
        let mut number = 0;
        // Each line it hears: attend, publish once, say whether it records.
        say("ready");
        while !hear().is_empty() {
            tautline_trace::attend();
            publish(&publisher, number);
            number += 1;
            say(if tautline_trace::is_on() { "on" } else { "off" });
        }
        return;
    };
    let mut seen = Seen::default();
    let turn = |process: &mut Process| {
        process.tell("go");
        process.answer().unwrap()
    };
    assert_eq!(process.answer().unwrap(), "ready");
    assert_eq!(turn(&mut process), "off");
    let mut recorder = Recorder::start(DOMAIN).unwrap();
    assert!(matches!(Recorder::start(DOMAIN), Err(TraceError::SecondRecorder { domain: DOMAIN })));
    assert_eq!(turn(&mut process), "on");
    assert_eq!(turn(&mut process), "on");
    recorder.poll(&mut |record| seen.note(record));
    assert_eq!(recorder.recording(), 1);
    assert_eq!(seen.numbers(), [1, 2]);
    // Ends without waiting for the process, which only attends when told to.
    drop(recorder);
    assert_eq!(turn(&mut process), "off");
    // The next one begins anew.
    let mut recorder = Recorder::start(DOMAIN).unwrap();
    assert_eq!(turn(&mut process), "on");
    let mut seen = Seen::default();
    recorder.poll(&mut |record| seen.note(record));
    assert_eq!((seen.numbers(), seen.objects.as_slice()), (vec![4], ["/switched".to_owned()].as_slice()));
    process.succeeds();
    recorder.finish(&mut |record| seen.note(record));
    assert_eq!((seen.ended, files(DOMAIN)), (1, Vec::new()));
}

#[test]
fn what_a_killed_process_recorded_is_fetched_and_its_file_removed() {
    const DOMAIN: u32 = 1196;
    let Some(mut process) = Process::start("what_a_killed_process_recorded_is_fetched_and_its_file_removed")
    else {
        tautline_trace::configure(TraceMode::On.into());
        let _membership = tautline_trace::join(DOMAIN).unwrap();
        let publisher = tautline_trace::publisher_init("/killed", 1, [1, 2]);
        (0..10).for_each(|n| publish(&publisher, n));
        say("published");
        hear();
        unreachable!("killed before");
    };
    assert_eq!(process.answer().unwrap(), "published");
    process.child.kill().unwrap();
    process.child.wait().unwrap();
    tautline_trace::remove_dead_files(DOMAIN);
    assert_eq!(files(DOMAIN).len(), 1, "it holds events that nobody has fetched");
    let seen = record(DOMAIN);
    assert_eq!(seen.processes, [process.child.id()]);
    assert_eq!(seen.numbers(), (0..10).collect::<Vec<_>>());
    assert_eq!((seen.ended, files(DOMAIN)), (1, Vec::new()));
}

#[test]
fn a_killed_process_that_recorded_nothing_leaves_nothing() {
    const DOMAIN: u32 = 1197;
    let Some(mut process) = Process::start("a_killed_process_that_recorded_nothing_leaves_nothing") else {
        tautline_trace::configure(TraceMode::Ready.into());
        let _membership = tautline_trace::join(DOMAIN).unwrap();
        let publisher = tautline_trace::publisher_init("/silent", 1, [1, 2]);
        (0..10).for_each(|n| publish(&publisher, n));
        say("published");
        hear();
        unreachable!("killed before");
    };
    assert_eq!(process.answer().unwrap(), "published");
    assert_eq!(files(DOMAIN).len(), 1);
    tautline_trace::remove_dead_files(DOMAIN);
    assert_eq!(files(DOMAIN).len(), 1, "its owner lives");
    process.child.kill().unwrap();
    process.child.wait().unwrap();
    tautline_trace::remove_dead_files(DOMAIN);
    assert_eq!(files(DOMAIN), Vec::<PathBuf>::new());
}

#[test]
fn a_killed_recorder_leaves_nothing_switched_on() {
    const DOMAIN: u32 = 1198;
    let Some(mut recorder) = Process::start("a_killed_recorder_leaves_nothing_switched_on") else {
        let _recorder = Recorder::start(DOMAIN).unwrap();
        say("recording");
        hear();
        unreachable!("killed before");
    };
    assert_eq!(recorder.answer().unwrap(), "recording");
    tautline_trace::configure(TraceMode::Ready.into());
    let membership = tautline_trace::join(DOMAIN).unwrap();
    assert!(tautline_trace::is_on(), "from the first event on");
    let publisher = tautline_trace::publisher_init("/orphan", 1, [1, 2]);
    publish(&publisher, 1);
    recorder.child.kill().unwrap();
    recorder.child.wait().unwrap();
    tautline_trace::attend();
    assert!(!tautline_trace::is_on() || cfg!(feature = "lttng"));
    let seen = record(DOMAIN);
    assert_eq!(seen.numbers(), Vec::<u64>::new(), "what was left is not the next recording's");

    // Nor does it outlive a process that ends before it has noticed.
    let mut recorder = Process::start("a_killed_recorder_leaves_nothing_switched_on").unwrap();
    assert_eq!(recorder.answer().unwrap(), "recording");
    tautline_trace::attend();
    publish(&publisher, 2);
    recorder.child.kill().unwrap();
    recorder.child.wait().unwrap();
    drop(membership);
    assert_eq!(files(DOMAIN), Vec::<PathBuf>::new());
}

/// To read a page that was never written takes memory, and kills the recorder if there is none.
#[test]
fn a_recorder_takes_no_memory_in_the_file_of_a_process() {
    const DOMAIN: u32 = 1208;
    alone("a_recorder_takes_no_memory_in_the_file_of_a_process", || {
        tautline_trace::configure(TraceSettings::from(TraceMode::On).ring_events(16));
        let _membership = tautline_trace::join(DOMAIN).unwrap();
        let publisher = tautline_trace::publisher_init("/small", 1, [1, 2]);
        publish(&publisher, 1);
        let file = files(DOMAIN).pop().unwrap();
        let blocks = || std::fs::metadata(&file).unwrap().blocks();
        let before = blocks();
        let (mut recorder, mut seen) = (Recorder::start(DOMAIN).unwrap(), Seen::default());
        recorder.poll(&mut |record| seen.note(record));
        assert_eq!((seen.numbers(), seen.objects.as_slice()), (vec![1], ["/small".to_owned()].as_slice()));
        assert_eq!(blocks(), before);
    });
}

#[test]
fn files_that_lie_are_left_out_by_name() {
    const DOMAIN: u32 = 1199;
    tautline_rt::shm::make_folder(&tautline_rt::domain::shared_folder(DOMAIN)).unwrap();
    let path = |name: &str| folder(DOMAIN).join(format!("trace_p{name}"));
    std::fs::write(path("garbage"), [0xAB; 5000]).unwrap();
    std::fs::write(path("short"), b"tauttrac\x02\0\0\0\x40\0\0\0").unwrap();
    std::fs::write(path("empty"), b"").unwrap();
    let mut recorder = Recorder::start(DOMAIN).unwrap();
    let mut records = 0;
    for _ in 0..3 {
        recorder.poll(&mut |_| records += 1);
    }
    let mut complaints = recorder.complaints();
    complaints.sort();
    assert_eq!((records, complaints.len()), (0, 2), "{complaints:?}");
    assert!(
        complaints[0]
            .contains("garbage is left out: it is no trace file, or of another version of Tautline: "),
        "{complaints:?}"
    );
    assert!(complaints[1].contains("short is left out: shorter than its rings"), "{complaints:?}");
    drop(recorder);
    assert!(!path("empty").exists(), "its owner died before it wrote anything");
    for name in ["garbage", "short"] {
        std::fs::remove_file(path(name)).unwrap();
    }
    std::fs::remove_dir(folder(DOMAIN)).unwrap();
}

#[test]
fn files_of_others_are_not_mapped() {
    const DOMAIN: u32 = 1207;
    tautline_rt::shm::make_folder(&tautline_rt::domain::shared_folder(DOMAIN)).unwrap();
    let path = |name: &str| folder(DOMAIN).join(format!("trace_{name}"));
    let (file, control) = (path("pforeign"), path("control"));
    std::fs::write(&file, [0; 64]).unwrap();
    std::fs::write(&control, b"1").unwrap();
    let given = [&file, &control].map(|path| std::os::unix::fs::chown(path, Some(65_534), None));
    if given.iter().all(Result::is_ok) {
        tautline_trace::remove_dead_files(DOMAIN);
        assert!(file.exists());
        let refused = Recorder::start(DOMAIN).map(drop);
        assert!(matches!(refused, Err(TraceError::File { .. })), "{refused:?}");
        std::fs::remove_file(&control).unwrap();
        let mut recorder = Recorder::start(DOMAIN).unwrap();
        recorder.poll(&mut |record| panic!("{record:?}"));
        let complaints = recorder.complaints();
        drop(recorder);
        assert!(complaints[0].contains("it belongs to user 65534: "), "{complaints:?}");
    } else {
        println!("skipped: only root can give a file away");
        std::fs::remove_file(&control).unwrap();
    }
    std::fs::remove_file(&file).unwrap();
    std::fs::remove_dir(folder(DOMAIN)).unwrap();
}

#[test]
fn off_means_no_file() {
    alone("off_means_no_file", || {
        tautline_trace::configure(TraceMode::Off.into());
        let _membership = tautline_trace::join(1200).unwrap();
        let publisher = tautline_trace::publisher_init("/off", 1, [1, 2]);
        publish(&publisher, 1);
        tautline_trace::attend();
        assert_eq!(files(1200), Vec::<PathBuf>::new());
    });
}

#[test]
fn memberships_may_come_and_go() {
    alone("memberships_may_come_and_go", || {
        for (round, events) in [16, 16, 64, 16].into_iter().enumerate() {
            tautline_trace::configure(TraceSettings::from(TraceMode::On).ring_events(events));
            let membership = tautline_trace::join(1201).unwrap();
            let publisher = tautline_trace::publisher_init("/again", 1, [1, 2]);
            (0..100).for_each(|n| publish(&publisher, n));
            let seen = record(1201);
            assert_eq!((seen.numbers().len(), seen.lost), (events, 100 - events as u64), "round {round}");
            drop(membership);
            // Into the void.
            publish(&publisher, 0);
            assert_eq!(files(1201), Vec::<PathBuf>::new());
        }
    });
}
