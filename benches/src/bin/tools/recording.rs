// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut record`: twenty topics at 1 kHz and a camera for a while, of which nothing may be lost; `taut play` of that; and 1 MiB messages as
//! fast as the disk takes a plain file, which is measured just before. And whether its memory stays what it was.

use crate::{Result, Taut, as_robot, interrupt};
use serde::Serialize;
use serde_json::Value;
use std::fs::File;
use std::io::Write;
use std::path::Path;
use std::process::{Child, Stdio};
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};
use tautline_benches::rows::extent;
use tautline_benches::table::Column::{Number, Words};
use tautline_benches::table::Table;
use tautline_benches::{Beside, Distribution, cells};
use tautline_rt::CoreSet;
use tautline_rt::clock::{monotonic_ns, sleep_until_monotonic};
use tautline_transport::{EndpointKind, Limits, Participant, Qos, RawPublisher, TopicType, Visitor};
use tempfile::TempDir;

const SMALL_TOPICS: usize = 20;
const SMALL_BYTES: usize = 256;
const MIB: usize = 1 << 20;
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

/// A timer of its own on the last core: how late it is at each millisecond, whether it slept until then or was late before.
fn time_beside() -> Beside<Result<Distribution>> {
    Beside::start(|stop| {
        as_robot(PLAYER + 1)?;
        let (mut late, mut due_ns) = (Distribution::new(), monotonic_ns());
        while !stop.load(Ordering::Relaxed) {
            due_ns += 1_000_000;
            sleep_until_monotonic(due_ns);
            late.record(monotonic_ns() - due_ns);
        }
        Ok(late)
    })
}

impl Replay {
    fn run(taut: &Taut, bag: &Path) -> Result<Self> {
        let core = CoreSet::allowed()?.iter().last().ok_or("there is no core")?;
        let (core_name, priority) = (core.to_string(), PLAYER.to_string());
        let beside = time_beside();
        let mut play = taut.command(&["play", "--json", "--core", &core_name, "--priority", &priority]);
        let output = play.arg(bag).stdout(Stdio::piped()).output();
        let (beside, output) = (beside.end()?, output?);
        if !output.status.success() {
            return Err(format!("taut play: {}", output.status).into());
        }
        let report: Value = serde_json::from_slice(&output.stdout)?;
        let times =
            |key: &str| ["p50", "p99", "max"].map(|which| report[key][which].as_f64().unwrap_or(f64::NAN));
        Ok(Replay {
            published: number(&report, "published"),
            starved: number(&report, "starved"),
            late_ms: times("late_ms"),
            timer_late_ms: times("timer_late_ms"),
            beside_ms: [beside.quantile_us(0.5), beside.quantile_us(0.99), beside.max_us()]
                .map(|us| us / 1e3),
        })
    }
}

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
        interrupt(&self.0)?;
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

    /// For so long; how long each publication on a small topic took.
    fn fly(&mut self, seconds: u64) -> Result<Distribution> {
        let Robot { small, camera, image } = self;
        std::thread::scope(|scope| {
            let filming = scope.spawn(move || send(camera, image, 30.0, seconds * 30));
            let working = scope.spawn(move || -> Result<_> {
                as_robot(ROBOT)?;
                let (mut took, body, start_ns) = (Distribution::new(), [7_u8; SMALL_BYTES], monotonic_ns());
                for n in 0..seconds * 1000 {
                    sleep_until_monotonic(start_ns + n * 1_000_000);
                    let mut before_ns = monotonic_ns();
                    for publisher in &mut *small {
                        publisher.publish(&body)?;
                        let after_ns = monotonic_ns();
                        took.record(after_ns - before_ns);
                        before_ns = after_ns;
                    }
                }
                Ok(took)
            });
            let took = working.join().map_err(|_| "the publishing thread panicked")?;
            filming.join().map_err(|_| "the camera panicked")??;
            took
        })
    }
}

/// Twenty topics and a camera, and all of it again; adds what does not hold to `broken`.
pub fn flight(taut: &Taut, quick: bool, broken: &mut Vec<String>) -> Result<Flight> {
    let (seconds, image) = if quick { (3_u64, MIB) } else { (60, 8 * MIB) };
    let (folder, participant) = (folder()?, Participant::new(crate::DOMAIN)?);
    let mut robot = Robot::new(&participant, image)?;
    let mut without = robot.fly(seconds.div_ceil(2))?;
    let mut recorder = Recorder::start(taut, &folder.path().join("flight"), &[])?;
    recorder.wait(SMALL_TOPICS + 1)?;
    let with = robot.fly(seconds)?;
    let report = recorder.end()?;
    without.add(&robot.fly(seconds.div_ceil(2))?.counts());
    drop(robot);
    let of = |took: &Distribution| {
        let [p50, p99, p999] = [0.5, 0.99, 0.999].map(|quantile| took.quantile_us(quantile));
        [p50, p99, p999, took.max_us()]
    };
    let publications = Publications { without_us: of(&without), with_us: of(&with) };
    let replay = Replay::run(taut, &folder.path().join("flight"))?;

    let topics = report["topics"].as_array().ok_or("no topics")?;
    let of_topics = |key: &'static str| topics.iter().filter_map(move |topic| topic[key].as_f64());
    let flight = Flight {
        seconds: report["seconds"].as_f64().unwrap_or(0.0),
        messages: number(&report, "messages"),
        megabytes: number(&report, "bytes") as f64 / 1e6,
        lost: number(&report, "lost"),
        longest_stall_ms: of_topics("longest_stall_ns").fold(0.0, f64::max) / 1e6,
        survives_ms: of_topics("survives_stall_ns").fold(f64::INFINITY, f64::min) / 1e6,
        longest_write_ms: number(&report, "longest_write_ns") as f64 / 1e6,
        publications,
        replay,
    };
    flight.print(image);
    check_recorded(flight.messages, flight.lost, seconds, broken);
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
    Ok(flight)
}

/// Whether a bag has all that the robot has sent in so long.
fn check_recorded(messages: u64, lost: u64, seconds: u64, broken: &mut Vec<String>) {
    let wanted = seconds * (SMALL_TOPICS as u64 * 1000 + 30);
    if lost > 0 || messages != wanted {
        broken.push(format!("taut record: {messages} of {wanted} messages were recorded, {lost} lost"));
    }
}

/// The flight for ten minutes, into a ring of files: the recorder's memory meanwhile; adds what does not hold to `broken`.
pub fn memory(taut: &Taut, quick: bool, broken: &mut Vec<String>) -> Result<Memory> {
    let (seconds, image, file) = if quick { (3_u64, MIB, "16MB") } else { (600, 8 * MIB, "2GB") };
    println!("\ntaut record for {seconds} s, a ring of 4 files of {file}\n");
    let (folder, participant) = (folder()?, Participant::new(crate::DOMAIN)?);
    let mut robot = Robot::new(&participant, image)?;
    let bag = folder.path().join("flight");
    let mut recorder = Recorder::start(taut, &bag, &["--max-size", file, "--keep", "4"])?;
    recorder.wait(SMALL_TOPICS + 1)?;
    let status = format!("/proc/{}/status", recorder.0.id());
    let watching = Beside::start(move |stop| {
        let (mut resident_kb, mut due_ns) = (Vec::new(), monotonic_ns());
        while !stop.load(Ordering::Relaxed) {
            let text = std::fs::read_to_string(&status).unwrap_or_default();
            let line = text.lines().find_map(|line| line.strip_prefix("VmRSS:"));
            resident_kb.extend(line.and_then(|line| line.trim().strip_suffix(" kB")?.parse::<u64>().ok()));
            due_ns += 1_000_000_000;
            sleep_until_monotonic(due_ns);
        }
        resident_kb
    });
    let flown = robot.fly(seconds);
    let resident_kb = watching.end();
    flown?;
    let report = recorder.end()?;
    let (messages, lost) = (number(&report, "messages"), number(&report, "lost"));
    let (first, later) = resident_kb.split_at(resident_kb.len().div_ceil(10));
    let most = |of: &[u64]| of.iter().max().copied().unwrap_or(0);
    let (first, later) = (most(first), most(later));
    println!("{messages} messages, {lost} lost");
    println!("memory: at most {first} kB in the first tenth of the time, {later} kB after that");
    check_recorded(messages, lost, seconds, broken);
    if resident_kb.len() as u64 * 2 < seconds {
        broken.push("taut record: its memory could not be read".to_owned());
    }
    // In three seconds it has not yet used all that it uses.
    if !quick && later > first + MOST_GROWTH_KB {
        broken.push(format!("taut record: its memory grew from {first} to {later} kB"));
    }
    Ok(Memory { seconds, messages, lost, resident_kb })
}

/// Messages of 1 MiB as fast as a plain file of as many was written before, a few times; adds what does not hold to `broken`.
pub fn sequential(taut: &Taut, quick: bool, broken: &mut Vec<String>) -> Result<Vec<Sequential>> {
    // A small one on a machine whose disk nobody knows.
    let (rounds, bytes) = if quick { (1, 256 * MIB) } else { (5, 4096 * MIB) };
    println!("\nmessages of 1 MiB as fast as a plain file is written: {} MiB\n", bytes / MIB);
    let mut table = Table::new(0, ["plain MB/s", "recorded MB/s", "is x", "lost"].map(Number));
    let (mut all, mut shares) = (Vec::new(), Vec::new());
    for _ in 0..rounds {
        let round = Sequential::run(taut, bytes)?;
        let Sequential { bare_mb_s, recorded_mb_s, lost } = round;
        let share = recorded_mb_s / bare_mb_s;
        table.add(cells![
            format!("{bare_mb_s:.0}"),
            format!("{recorded_mb_s:.0}"),
            format!("{share:.2}"),
            lost
        ]);
        shares.push(share);
        all.push(round);
    }
    println!("{table}\nrosbag2 says of itself: 110 to 120 MB/s (github.com/ros2/rosbag2/issues/1787)");
    let [_, share, _] = extent(shares);
    if !quick && share < SHARE {
        broken.push(format!("taut record writes {share:.2} x of what a plain file gets, in most rounds"));
    }
    Ok(all)
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
        Ok(Sequential { bare_mb_s, recorded_mb_s, lost: number(&report, "lost") })
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
        let Publications { without_us, with_us } = &self.publications;
        let columns =
            [Words("a publication, in us"), Number("p50"), Number("p99"), Number("p99.9"), Number("max")];
        let mut table = Table::new(0, columns);
        for (what, times) in [("without a recorder", without_us), ("with it", with_us)] {
            let [p50, p99, p999, max] = times.map(|us| format!("{us:.2}"));
            table.add(cells![what, p50, p99, p999, max]);
        }
        println!("\n{table}");
        let Replay { published, starved, late_ms, timer_late_ms, beside_ms } = &self.replay;
        println!("\ntaut play of that: {published} messages, {starved} not read in time\n");
        let columns = [Words("late by, in ms"), Number("p50"), Number("p99"), Number("max")];
        let mut table = Table::new(0, columns);
        let of_timer = "of that its timer";
        for (what, times) in
            [("messages", late_ms), (of_timer, timer_late_ms), ("another timer on its core", beside_ms)]
        {
            let [p50, p99, max] = times.map(|ms| format!("{ms:.3}"));
            table.add(cells![what, p50, p99, max]);
        }
        println!("{table}");
    }
}
