// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut record`: twenty topics at 1 kHz and a camera for a while, of which nothing may be lost; `taut play` of that; and 1 MiB messages as
//! fast as the disk takes a plain file, which is measured just before. And whether its memory stays what it was.

use crate::{Result, Taut, as_robot, interrupt, too_short};
use serde_json::Value;
use std::fs::File;
use std::io::Write;
use std::path::Path;
use std::process::{Child, Stdio};
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};
use tautline_harness::readings::Reading;
use tautline_harness::rows::extent;
use tautline_harness::{Beside, Distribution};
use tautline_rt::CoreSet;
use tautline_rt::clock::{monotonic_ns, sleep_until_monotonic};
use tautline_transport::{EndpointKind, Limits, Participant, Qos, RawPublisher, TopicType, Visitor};
use tempfile::TempDir;

const SMALL_TOPICS: usize = 20;
const SMALL_BYTES: usize = 256;
const MIB: usize = 1 << 20;
const PATIENCE: Duration = Duration::from_secs(30);
/// The priorities of the player and of who publishes what is recorded.
const PLAYER: u8 = 40;
const ROBOT: u8 = 80;

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

/// The flight again, as `taut play` says of itself, beside a thread of this program on the player's core.
fn replay(taut: &Taut, bag: &Path, recorded: u64, unfit: Option<&str>) -> Result<Vec<Reading>> {
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
    let published = number(&report, "published");
    let times = |key: &str, what| {
        let [p50, p99, max] = ["p50", "p99", "max"].map(|which| report[key][which].as_f64());
        Reading { n: published, p99, max, ..flight_of(what, "ms", p50.unwrap_or(f64::NAN)) }
    };
    let (late, timer) = (
        times("late_ms", "lateness of what is played"),
        times("timer_late_ms", "lateness of the player's timer"),
    );
    let other =
        Reading::of("flight", 0, "lateness of another timer on its core", "ms").times_in(&beside, 1e3);
    let later = late.p99.unwrap_or(f64::NAN) - other.p99.unwrap_or(f64::NAN);
    Ok(vec![
        flight_of("difference between recorded and played", "messages", recorded.abs_diff(published) as f64)
            .at_most(0.0)
            .must(),
        flight_of("played messages that are not read in time", "messages", number(&report, "starved") as f64),
        flight_of("p99 of what is played, later than that of another timer", "ms", later)
            .at_most(0.05)
            .unfit(unfit),
        late,
        timer,
        other,
    ])
}

fn flight_of(what: &str, unit: &'static str, value: f64) -> Reading {
    Reading::of("flight", 0, what, unit).value(value)
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

/// Twenty topics and a camera, and all of it again.
pub fn flight(taut: &Taut, quick: bool) -> Result<Vec<Reading>> {
    let (seconds, image) = if quick { (3_u64, MIB) } else { (60, 8 * MIB) };
    let (folder, participant) = (folder()?, Participant::new(crate::DOMAIN)?);
    let mut robot = Robot::new(&participant, image)?;
    // Before and after the recorder: a machine that gets slower or faster meanwhile is in both.
    let mut without = robot.fly(seconds.div_ceil(2))?;
    let mut recorder = Recorder::start(taut, &folder.path().join("flight"), &[])?;
    recorder.wait(SMALL_TOPICS + 1)?;
    let with = robot.fly(seconds)?;
    let report = recorder.end()?;
    without.add(&robot.fly(seconds.div_ceil(2))?.counts());
    drop(robot);
    let topics = report["topics"].as_array().ok_or("no topics")?;
    let of_topics = |key: &'static str| topics.iter().filter_map(move |topic| topic[key].as_f64());
    let stall_ms = of_topics("longest_stall_ns").fold(0.0, f64::max) / 1e6;
    let survives_ms = of_topics("survives_stall_ns").fold(f64::INFINITY, f64::min) / 1e6;
    let added = with.quantile_us(0.999) / without.quantile_us(0.999);
    let mut readings = recorded("flight", &report, seconds);
    readings.extend([
        flight_of("megabytes recorded", "MB", report["bytes"].as_f64().unwrap_or(f64::NAN) / 1e6),
        flight_of("longest stall of the recorder on a topic", "ms", stall_ms),
        flight_of("stall that loses nothing on any topic", "ms", survives_ms),
        flight_of("longest write", "ms", number(&report, "longest_write_ns") as f64 / 1e6),
        Reading::of("flight", 0, "a publication without a recorder", "µs").times(&without),
        Reading::of("flight", 0, "a publication with a recorder", "µs").times(&with),
        flight_of("p99.9 with a recorder, to that without", "x", added).at_most(1.05).unfit(too_short(quick)),
    ]);
    let (bag, messages) = (folder.path().join("flight"), number(&report, "messages"));
    readings.extend(replay(taut, &bag, messages, too_short(quick))?);
    Ok(readings)
}

/// Whether a bag has all that the robot has sent in so long.
fn recorded(experiment: &str, report: &Value, seconds: u64) -> Vec<Reading> {
    let (messages, wanted) = (number(report, "messages"), seconds * (SMALL_TOPICS as u64 * 1000 + 30));
    let of = |what, number: u64| Reading::of(experiment, 0, what, "messages").value(number as f64);
    let note = format!("of {wanted} in {seconds} s");
    vec![
        of("messages recorded", messages).note(note),
        of("difference between sent and recorded", wanted.abs_diff(messages)).at_most(0.0).must(),
        of("messages lost", number(report, "lost")).at_most(0.0).must(),
    ]
}

/// The flight for ten minutes, into a ring of files: the recorder's memory meanwhile.
pub fn memory(taut: &Taut, quick: bool) -> Result<Vec<Reading>> {
    let (seconds, image, file) = if quick { (3_u64, MIB, "16MB") } else { (600, 8 * MIB, "2GB") };
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
    if (resident_kb.len() as u64) * 2 < seconds {
        return Err("the recorder's memory could not be read".into());
    }
    let (first, later) = resident_kb.split_at(resident_kb.len().div_ceil(10));
    let [first, later] = [first, later].map(|of| of.iter().max().map_or(f64::NAN, |kb| *kb as f64));
    let of = |what, kb: f64| Reading::of("memory", 0, what, "kB").value(kb);
    let mut readings = recorded("memory", &report, seconds);
    readings.push(of("most in the first tenth of the time", first));
    readings.push(of("most after that", later));
    // A page here and there, no message of 8 MiB. In three seconds it has not yet used all that it uses.
    let growth = of("growth after the first tenth", later - first).at_most(1024.0).must();
    readings.push(growth.unfit(too_short(quick)));
    Ok(readings)
}

/// Messages of 1 MiB as fast as a plain file of as many was written before, a few times.
pub fn sequential(taut: &Taut, quick: bool) -> Result<Vec<Reading>> {
    // A small one on a machine whose disk nobody knows.
    let (rounds, bytes) = if quick { (1, 256 * MIB) } else { (5, 4096 * MIB) };
    let (mut plain, mut recorded, mut shares, mut lost) = (Vec::new(), Vec::new(), Vec::new(), 0);
    for _ in 0..rounds {
        let folder = folder()?;
        let plain_mb_s = bare(&folder.path().join("bare"), bytes)?;
        let participant = Participant::new(crate::DOMAIN)?;
        let stream = publisher(&participant, "/stream", MIB, 64)?;
        let mut recorder = Recorder::start(taut, &folder.path().join("stream"), &[])?;
        recorder.wait(1)?;
        let start_ns = monotonic_ns();
        send(&stream, &vec![7; MIB], plain_mb_s * 1e6 / MIB as f64, (bytes / MIB) as u64)?;
        let report = recorder.end()?;
        let seconds = (monotonic_ns() - start_ns) as f64 / 1e9;
        let recorded_mb_s = report["bytes"].as_f64().unwrap_or(0.0) / 1e6 / seconds;
        plain.push(plain_mb_s);
        recorded.push(recorded_mb_s);
        shares.push(recorded_mb_s / plain_mb_s);
        lost += number(&report, "lost");
    }
    let of = |what, unit, rounds: Vec<f64>| {
        let (n, [_, median, most]) = (rounds.len() as u64, extent(rounds));
        Reading { n, max: Some(most), ..Reading::of("sequential", 0, what, unit).value(median) }
    };
    let share = of("recorded, to the plain file", "x", shares).at_least(0.9).unfit(too_short(quick));
    Ok(vec![
        of("a plain file", "MB/s", plain),
        of("recorded", "MB/s", recorded),
        share.note("rosbag2 says of itself: 110 to 120 MB/s (github.com/ros2/rosbag2/issues/1787)"),
        of("messages lost", "messages", vec![lost as f64]),
    ])
}
