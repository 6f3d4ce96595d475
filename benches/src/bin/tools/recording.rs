// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut record`: twenty topics at 1 kHz and a camera for a while, of which nothing may be lost; `taut play` of that; and 1 MiB messages as
//! fast as the disk takes a plain file, which is measured just before. And whether its memory stays what it was.

use crate::{Result, Taut};
use hdrhistogram::Histogram;
use rustix::process::{Pid, Signal, kill_process};
use serde::Serialize;
use serde_json::Value;
use std::fs::File;
use std::io::Write;
use std::path::Path;
use std::process::{Child, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};
use tautline_benches::rows::extent;
use tautline_rt::clock::{monotonic_ns, sleep_until_monotonic};
use tautline_rt::{CoreSet, Policy, set_affinity, set_policy};
use tautline_transport::{EndpointKind, Limits, Participant, Qos, RawPublisher, TopicType, Visitor};
use tempfile::TempDir;

const SMALL_TOPICS: usize = 20;
const SMALL_BYTES: usize = 256;
const MIB: usize = 1 << 20;
/// How long a recorder may take to begin.
const PATIENCE: Duration = Duration::from_secs(30);
/// Of the disk's own rate, at least.
const SHARE: f64 = 0.9;
/// What the player may be later than the timer that it sleeps by, of 99 messages in 100.
const MOST_JITTER_MS: f64 = 0.05;
/// The priorities of the player and of who publishes what is recorded.
const PLAYER: u8 = 40;
const ROBOT: u8 = 80;
/// What a recorder may add to the p99.9 of a publication.
const MOST_ADDED: f64 = 1.05;
/// What a recorder's memory may grow by after the first tenth of ten minutes: a page here and there, no message of 8 MiB.
const MOST_GROWTH_KB: u64 = 1024;

#[derive(Serialize)]
pub struct Flight {
    seconds: f64,
    messages: u64,
    megabytes: f64,
    lost: u64,
    /// The longest time between two looks at a topic, and what the topic nearest to a loss would have survived.
    longest_stall_ms: f64,
    survives_ms: f64,
    longest_write_ms: f64,
    publications: Publications,
    replay: Replay,
}

/// How long a publication on one of the small topics takes while there is a recorder, and while there is none: before and after that, so
/// that a machine that gets slower or faster meanwhile is in both.
#[derive(Serialize)]
struct Publications {
    /// p50, p99, p99.9, max.
    without_us: [f64; 4],
    with_us: [f64; 4],
}

/// Of a recorder that runs for long.
#[derive(Serialize)]
pub struct Memory {
    seconds: u64,
    messages: u64,
    lost: u64,
    /// What is resident, each second.
    resident_kb: Vec<u64>,
}

/// A plain file and a recording of as much, one after the other.
#[derive(Serialize)]
pub struct Sequential {
    bare_mb_s: f64,
    recorded_mb_s: f64,
    lost: u64,
}

/// The flight again, as `taut play` says of itself.
#[derive(Serialize)]
struct Replay {
    published: u64,
    starved: u64,
    /// p50, p99, max.
    late_ms: [f64; 3],
    /// Of that, as the player says.
    timer_late_ms: [f64; 3],
    /// A thread of this program on the player's core, meanwhile.
    beside_ms: [f64; 3],
}

/// A timer of its own on a core: how late it is at each millisecond, whether it slept until then or was late before.
struct Beside {
    stop: Arc<AtomicBool>,
    thread: JoinHandle<std::result::Result<Histogram<u64>, String>>,
}

impl Beside {
    const PERIOD_NS: u64 = 1_000_000;

    fn start(core: usize) -> Self {
        let stop = Arc::new(AtomicBool::new(false));
        let is_over = stop.clone();
        let thread = std::thread::spawn(move || {
            set_affinity(CoreSet::one(core)).map_err(|error| error.to_string())?;
            if let Err(error) = set_policy(Policy::Fifo(PLAYER + 1)) {
                println!("without a real-time priority: {error}");
            }
            let mut late = histogram()?;
            let mut due_ns = monotonic_ns();
            while !is_over.load(Ordering::Relaxed) {
                due_ns += Self::PERIOD_NS;
                sleep_until_monotonic(due_ns);
                late.saturating_record(monotonic_ns() - due_ns);
            }
            Ok(late)
        });
        Beside { stop, thread }
    }

    fn end(self) -> Result<[f64; 3]> {
        self.stop.store(true, Ordering::Relaxed);
        let late = self.thread.join().map_err(|_| "the timer panicked")??;
        Ok([late.value_at_quantile(0.5), late.value_at_quantile(0.99), late.max()].map(|ns| ns as f64 / 1e6))
    }
}

impl Replay {
    fn run(taut: &Taut, bag: &Path) -> Result<Self> {
        let core = CoreSet::allowed()?.iter().last().ok_or("there is no core")?;
        let (core_name, priority) = (core.to_string(), PLAYER.to_string());
        let beside = Beside::start(core);
        let mut play = taut.command(&["play", "--json", "--core", &core_name, "--priority", &priority]);
        let output = play.arg(bag).stdout(Stdio::piped()).output();
        let (beside_ms, output) = (beside.end()?, output?);
        if !output.status.success() {
            return Err(format!("taut play: {}", output.status).into());
        }
        let report: Value = serde_json::from_slice(&output.stdout)?;
        let times =
            |key: &str| ["p50", "p99", "max"].map(|which| report[key][which].as_f64().unwrap_or(f64::NAN));
        let number = |key: &str| report[key].as_u64().unwrap_or(0);
        Ok(Replay {
            published: number("published"),
            starved: number("starved"),
            late_ms: times("late_ms"),
            timer_late_ms: times("timer_late_ms"),
            beside_ms,
        })
    }
}

/// A recorder of all topics.
struct Recorder(Child);

impl Recorder {
    fn start(taut: &Taut, bag: &Path, options: &[&str]) -> Result<Self> {
        let mut command = taut.command(&["record", "-a", "--json", "-o"]);
        Ok(Recorder(command.arg(bag).args(options).stdout(Stdio::piped()).spawn()?))
    }

    /// Until it is connected with each publisher, which only a visitor sees.
    fn wait(&mut self, publishers: usize) -> Result {
        let (mut visitor, start) = (Visitor::new(crate::DOMAIN)?, Instant::now());
        loop {
            if let Some(status) = self.0.try_wait()? {
                return Err(format!("taut record ended before it began: {status}").into());
            }
            if start.elapsed() > PATIENCE {
                return Err(format!("taut record is not connected to {publishers} publishers").into());
            }
            let graph = visitor.graph()?;
            let mut observed = 0;
            for end in graph.endpoints.iter().filter(|end| end.kind == EndpointKind::Publisher) {
                observed += usize::from(!visitor.overwritten(end)?.is_empty());
            }
            if observed >= publishers {
                return Ok(());
            }
            std::thread::yield_now();
        }
    }

    fn end(self) -> Result<Value> {
        if let Some(pid) = i32::try_from(self.0.id()).ok().and_then(Pid::from_raw) {
            kill_process(pid, Signal::INT)?;
        }
        let output = self.0.wait_with_output()?;
        Ok(serde_json::from_slice(&output.stdout)?)
    }
}

/// A plain file of as many bytes, written through the page cache and then on the disk, as a program that only writes does it: megabytes
/// a second.
fn bare(path: &Path, bytes: usize) -> Result<f64> {
    let (block, start_ns) = (vec![0x5a_u8; 4 * MIB], monotonic_ns());
    let mut file = File::create(path)?;
    for _ in 0..bytes / block.len() {
        file.write_all(&block)?;
    }
    file.sync_all()?;
    let seconds = (monotonic_ns() - start_ns) as f64 / 1e9;
    std::fs::remove_file(path)?;
    Ok(bytes as f64 / 1e6 / seconds)
}

fn publisher(participant: &Participant, topic: &str, bytes: usize, depth: usize) -> Result<RawPublisher> {
    let limits = Limits { message_bytes: bytes, ..Limits::default() };
    let mut topic_type = TopicType::new(format!("bench_msgs/msg/Bytes{bytes}"));
    if bytes < MIB {
        topic_type = topic_type.with_body_bytes(bytes);
    }
    Ok(participant.create_raw_publisher(topic, &topic_type, Qos::keep_last(depth), limits)?)
}

fn send(publisher: &RawPublisher, body: &[u8], hz: f64, messages: u64) -> Result {
    let start_ns = monotonic_ns();
    for n in 0..messages {
        sleep_until_monotonic(start_ns + (n as f64 * 1e9 / hz) as u64);
        publisher.publish(body)?;
    }
    Ok(())
}

/// Where programs are built there is a disk.
fn folder() -> Result<TempDir> {
    let beside = std::env::current_exe()?.parent().ok_or("where is this program?")?.to_owned();
    Ok(tempfile::tempdir_in(beside)?)
}

fn number(report: &Value, key: &str) -> u64 {
    report[key].as_u64().unwrap_or(0)
}

fn histogram() -> std::result::Result<Histogram<u64>, String> {
    Histogram::new_with_bounds(1, 1_000_000_000_000, 3).map_err(|error| error.to_string())
}

/// The robot: a thread that publishes on the small topics each millisecond, with a real-time priority on a core of its own if it may have
/// that, beside one that films.
struct Robot {
    small: Vec<RawPublisher>,
    camera: RawPublisher,
    image: Vec<u8>,
}

impl Robot {
    fn new(participant: &Participant, image: usize) -> Result<Self> {
        let small =
            (0..SMALL_TOPICS).map(|n| publisher(participant, &format!("/small_{n}"), SMALL_BYTES, 10));
        let small = small.collect::<Result<Vec<_>>>()?;
        Ok(Robot { small, camera: publisher(participant, "/camera", image, 10)?, image: vec![7; image] })
    }

    /// For so long; how long each publication on a small topic took, in nanoseconds.
    fn fly(self, seconds: u64) -> Result<(Self, Histogram<u64>)> {
        let Robot { small, camera, image } = self;
        let filming = std::thread::spawn(move || {
            let filmed = send(&camera, &image, 30.0, seconds * 30).map_err(|error| error.to_string());
            filmed.map(|()| (camera, image))
        });
        let working = std::thread::spawn(move || {
            if let Some(core) = CoreSet::allowed().ok().and_then(|cores| cores.iter().last()) {
                set_affinity(CoreSet::one(core)).map_err(|error| error.to_string())?;
            }
            if let Err(error) = set_policy(Policy::Fifo(ROBOT)) {
                println!("without a real-time priority: {error}");
            }
            let (mut took, body, start_ns) = (histogram()?, [7_u8; SMALL_BYTES], monotonic_ns());
            for n in 0..seconds * 1000 {
                sleep_until_monotonic(start_ns + n * 1_000_000);
                let mut before_ns = monotonic_ns();
                for publisher in &small {
                    publisher.publish(&body).map_err(|error| error.to_string())?;
                    let after_ns = monotonic_ns();
                    took.saturating_record(after_ns - before_ns);
                    before_ns = after_ns;
                }
            }
            Ok::<_, String>((small, took))
        });
        let (small, took) = working.join().map_err(|_| "the publishing thread panicked")??;
        let (camera, image) = filming.join().map_err(|_| "the camera panicked")??;
        Ok((Robot { small, camera, image }, took))
    }
}

/// Twenty topics and a camera, and all of it again; the second value is what does not hold.
pub fn flight(taut: &Taut, quick: bool) -> Result<(Flight, Vec<String>)> {
    let (seconds, image) = if quick { (3_u64, MIB) } else { (60, 8 * MIB) };
    let (folder, participant) = (folder()?, Participant::new(crate::DOMAIN)?);
    let (robot, mut without) = Robot::new(&participant, image)?.fly(seconds.div_ceil(2))?;
    let mut recorder = Recorder::start(taut, &folder.path().join("flight"), &[])?;
    recorder.wait(SMALL_TOPICS + 1)?;
    let (robot, with) = robot.fly(seconds)?;
    let report = recorder.end()?;
    let (robot, after) = robot.fly(seconds.div_ceil(2))?;
    without.add(&after)?;
    drop(robot);
    let of = |took: &Histogram<u64>| {
        [took.value_at_quantile(0.5), took.value_at_quantile(0.99), took.value_at_quantile(0.999), took.max()]
            .map(|ns| ns as f64 / 1e3)
    };
    let publications = Publications { without_us: of(&without), with_us: of(&with) };
    let replay = Replay::run(taut, &folder.path().join("flight"))?;

    let topics = report["topics"].as_array().ok_or("no topics")?;
    let of_topics =
        |key: &str| topics.iter().filter_map(|topic| topic[key].as_f64()).map(|ns| ns / 1e6).collect();
    let (stalls, survives): (Vec<f64>, Vec<f64>) =
        (of_topics("longest_stall_ns"), of_topics("survives_stall_ns"));
    let flight = Flight {
        seconds: report["seconds"].as_f64().unwrap_or(0.0),
        messages: number(&report, "messages"),
        megabytes: number(&report, "bytes") as f64 / 1e6,
        lost: number(&report, "lost"),
        longest_stall_ms: stalls.into_iter().fold(0.0, f64::max),
        survives_ms: survives.into_iter().fold(f64::INFINITY, f64::min),
        longest_write_ms: number(&report, "longest_write_ns") as f64 / 1e6,
        publications,
        replay,
    };
    flight.print(image);
    let mut broken = Vec::new();
    let wanted = seconds * (SMALL_TOPICS as u64 * 1000 + 30);
    if flight.lost > 0 || flight.messages != wanted {
        let Flight { lost, messages, .. } = flight;
        broken.push(format!("taut record: {messages} of {wanted} messages are in the bag, {lost} lost"));
    }
    let Publications { without_us: [.., without_us, _], with_us: [.., with_us, _] } = flight.publications;
    if !quick && with_us > without_us * MOST_ADDED {
        broken.push(format!(
            "taut record: p99.9 of a publication is {with_us:.2} us, without it {without_us:.2}"
        ));
    }
    let Replay { published, late_ms: [_, late_ms, _], beside_ms: [_, beside_ms, _], .. } = flight.replay;
    if published != flight.messages {
        broken.push(format!("taut play: {published} of {} messages were published", flight.messages));
    }
    if !quick && late_ms > beside_ms + MOST_JITTER_MS {
        broken.push(format!("taut play: p99 is {late_ms:.3} ms late, a timer beside it {beside_ms:.3} ms"));
    }
    Ok((flight, broken))
}

/// The flight for ten minutes, into a ring of files: the recorder's memory meanwhile; the second value is what does not hold.
pub fn memory(taut: &Taut, quick: bool) -> Result<(Memory, Vec<String>)> {
    let (seconds, image, file) = if quick { (3_u64, MIB, "16MB") } else { (600, 8 * MIB, "2GB") };
    println!("\ntaut record for {seconds} s, a ring of 4 files of {file}\n");
    let (folder, participant) = (folder()?, Participant::new(crate::DOMAIN)?);
    let robot = Robot::new(&participant, image)?;
    let bag = folder.path().join("flight");
    let mut recorder = Recorder::start(taut, &bag, &["--max-size", file, "--keep", "4"])?;
    recorder.wait(SMALL_TOPICS + 1)?;
    let (status, stop) = (format!("/proc/{}/status", recorder.0.id()), Arc::new(AtomicBool::new(false)));
    let is_over = stop.clone();
    let watching = std::thread::spawn(move || {
        let (mut resident_kb, mut due_ns) = (Vec::new(), monotonic_ns());
        while !is_over.load(Ordering::Relaxed) {
            let text = std::fs::read_to_string(&status).unwrap_or_default();
            let line = text.lines().find_map(|line| line.strip_prefix("VmRSS:"));
            resident_kb.extend(line.and_then(|line| line.trim().strip_suffix(" kB")?.parse::<u64>().ok()));
            due_ns += Memory::PERIOD_NS;
            sleep_until_monotonic(due_ns);
        }
        resident_kb
    });
    let flown = robot.fly(seconds);
    stop.store(true, Ordering::Relaxed);
    let resident_kb = watching.join().map_err(|_| "the thread that watches the memory panicked")?;
    flown?;
    let report = recorder.end()?;
    let memory =
        Memory { seconds, messages: number(&report, "messages"), lost: number(&report, "lost"), resident_kb };
    let broken = memory.judge(seconds * (SMALL_TOPICS as u64 * 1000 + 30), quick);
    Ok((memory, broken))
}

impl Memory {
    const PERIOD_NS: u64 = 1_000_000_000;

    /// Prints it and says what does not hold.
    fn judge(&self, wanted: u64, quick: bool) -> Vec<String> {
        let Memory { messages, lost, resident_kb, .. } = self;
        let (first, later) = resident_kb.split_at(resident_kb.len().div_ceil(10));
        let most = |of: &[u64]| of.iter().max().copied().unwrap_or(0);
        let (first, later) = (most(first), most(later));
        println!("{messages} messages, {lost} lost");
        println!("memory: at most {first} kB in the first tenth of the time, {later} kB after that");
        let mut broken = Vec::new();
        if *lost > 0 || *messages != wanted {
            broken.push(format!("taut record: {messages} of {wanted} messages were recorded, {lost} lost"));
        }
        // In three seconds it has not yet used all that it uses.
        if resident_kb.len() as u64 * 2 < self.seconds {
            broken.push("taut record: its memory could not be read".to_owned());
        }
        if !quick && later > first + MOST_GROWTH_KB {
            broken.push(format!("taut record: its memory grew from {first} to {later} kB"));
        }
        broken
    }
}

/// Messages of 1 MiB as fast as a plain file of as many was written before, a few times; the second value is what does not hold.
pub fn sequential(taut: &Taut, quick: bool) -> Result<(Vec<Sequential>, Vec<String>)> {
    // A small one on a machine whose disk nobody knows.
    let (rounds, bytes) = if quick { (1, 256 * MIB) } else { (5, 4096 * MIB) };
    println!("\nmessages of 1 MiB as fast as a plain file is written: {} MiB\n", bytes / MIB);
    println!("plain MB/s  recorded MB/s     is x     lost");
    let rounds = (0..rounds).map(|_| Sequential::run(taut, bytes)).collect::<Result<Vec<_>>>()?;
    println!("rosbag2 says of itself: 110 to 120 MB/s (github.com/ros2/rosbag2/issues/1787)");
    let [_, share, _] = extent(rounds.iter().map(|round| round.recorded_mb_s / round.bare_mb_s).collect());
    let mut broken = Vec::new();
    if !quick && share < SHARE {
        broken.push(format!("taut record writes {share:.2} x of what a plain file gets, in most rounds"));
    }
    Ok((rounds, broken))
}

impl Sequential {
    fn run(taut: &Taut, bytes: usize) -> Result<Self> {
        let folder = folder()?;
        let bare_mb_s = bare(&folder.path().join("bare"), bytes)?;
        let participant = Participant::new(crate::DOMAIN)?;
        let stream = publisher(&participant, "/stream", MIB, 64)?;
        let mut recorder = Recorder::start(taut, &folder.path().join("stream"), &[])?;
        recorder.wait(1)?;
        let start_ns = monotonic_ns();
        send(&stream, &vec![7; MIB], bare_mb_s * 1e6 / MIB as f64, (bytes / MIB) as u64)?;
        let report = recorder.end()?;
        let seconds = (monotonic_ns() - start_ns) as f64 / 1e9;
        let recorded_mb_s = report["bytes"].as_f64().unwrap_or(0.0) / 1e6 / seconds;
        let lost = number(&report, "lost");
        println!("{bare_mb_s:>10.0}  {recorded_mb_s:>13.0}  {:>7.2}  {lost:>7}", recorded_mb_s / bare_mb_s);
        Ok(Sequential { bare_mb_s, recorded_mb_s, lost })
    }
}

impl Flight {
    fn print(&self, image: usize) {
        let Flight {
            seconds,
            messages,
            megabytes,
            lost,
            longest_stall_ms,
            survives_ms,
            longest_write_ms,
            ..
        } = self;
        println!(
            "\ntaut record: {SMALL_TOPICS} topics at 1 kHz and images of {} MiB at 30 Hz\n",
            image / MIB
        );
        println!("{messages} messages, {megabytes:.0} MB in {seconds:.1} s, {lost} lost");
        println!(
            "longest time between two looks {longest_stall_ms:.1} ms, survived would be {survives_ms:.1} ms; longest write {longest_write_ms:.1} ms"
        );
        println!("\na publication of {SMALL_BYTES} B, in us     p50      p99    p99.9      max");
        let Publications { without_us, with_us } = &self.publications;
        for (what, [p50, p99, p999, max]) in [("without a recorder", without_us), ("with it", with_us)] {
            println!("{what:<28}  {p50:>6.2}  {p99:>7.2}  {p999:>7.2}  {max:>7.1}");
        }
        let Replay { published, starved, late_ms, timer_late_ms, beside_ms } = &self.replay;
        println!("\ntaut play of that: {published} messages, {starved} not read in time\n");
        println!("late by, in ms                  p50      p99      max");
        let of_timer = "of that its timer";
        for (what, [p50, p99, max]) in
            [("messages", late_ms), (of_timer, timer_late_ms), ("another timer on its core", beside_ms)]
        {
            println!("{what:<26}  {p50:>7.3}  {p99:>7.3}  {max:>7.3}");
        }
    }
}
