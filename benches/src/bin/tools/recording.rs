// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut record`: twenty topics at 1 kHz and a camera for a while, of which nothing may be lost; `taut play` of that; and 1 MiB messages as
//! fast as the disk takes a plain file, which is measured just before.

use crate::{Result, Taut};
use rustix::process::{Pid, Signal, kill_process};
use serde::Serialize;
use serde_json::Value;
use std::fs::File;
use std::io::Write;
use std::path::Path;
use std::process::{Child, Stdio};
use std::time::{Duration, Instant};
use tautline_rt::clock::{monotonic_ns, sleep_until_monotonic};
use tautline_transport::{EndpointKind, Limits, Participant, Qos, RawPublisher, TopicType, Visitor};

const SMALL_TOPICS: usize = 20;
const SMALL_BYTES: usize = 256;
const MIB: usize = 1 << 20;
/// How long a recorder may take to begin.
const PATIENCE: Duration = Duration::from_secs(30);
/// Of the disk's own rate, at least.
const SHARE: f64 = 0.9;
/// What the player may be later than the timer that it sleeps by, of 99 messages in 100.
const MOST_JITTER_MS: f64 = 0.05;

#[derive(Serialize)]
pub struct Recording {
    seconds: f64,
    messages: u64,
    megabytes: f64,
    lost: u64,
    /// The longest time between two looks at a topic, and what the topic nearest to a loss would have survived.
    longest_stall_ms: f64,
    survives_ms: f64,
    longest_write_ms: f64,
    bare_mb_s: f64,
    recorded_mb_s: f64,
    recorded_lost: u64,
    replay: Replay,
}

/// The flight again, as `taut play` says of itself.
#[derive(Serialize)]
struct Replay {
    published: u64,
    starved: u64,
    /// p50, p99, max.
    late_ms: [f64; 3],
    timer_late_ms: [f64; 3],
}

impl Replay {
    fn run(taut: &Taut, bag: &Path) -> Result<Self> {
        let output = taut.command(&["play", "--json"]).arg(bag).stdout(Stdio::piped()).output()?;
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
        })
    }
}

/// A recorder of all topics.
struct Recorder(Child);

impl Recorder {
    fn start(taut: &Taut, bag: &Path) -> Result<Self> {
        let mut command = taut.command(&["record", "-a", "--json", "-o"]);
        Ok(Recorder(command.arg(bag).stdout(Stdio::piped()).spawn()?))
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

/// A plain file of as many bytes, written as the recorder does and then on the disk: megabytes a second.
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

/// Prints the rates; the second value is what does not hold.
pub fn measure(taut: &Taut, quick: bool) -> Result<(Recording, Vec<String>)> {
    // A small one on a machine whose disk nobody knows.
    let (seconds, image, sequential) = if quick { (3, MIB, 256 * MIB) } else { (60, 8 * MIB, 4096 * MIB) };
    // Where programs are built there is a disk.
    let beside = std::env::current_exe()?.parent().ok_or("where is this program?")?.to_owned();
    let folder = tempfile::tempdir_in(beside)?;
    let participant = Participant::new(crate::DOMAIN)?;

    let many = (0..SMALL_TOPICS).map(|n| publisher(&participant, &format!("/small_{n}"), SMALL_BYTES, 10));
    let many = many.collect::<Result<Vec<_>>>()?;
    let camera = publisher(&participant, "/camera", image, 10)?;
    let mut recorder = Recorder::start(taut, &folder.path().join("flight"))?;
    recorder.wait(SMALL_TOPICS + 1)?;
    let filming = std::thread::spawn(move || {
        let filmed = send(&camera, &vec![7; image], 30.0, seconds * 30).map_err(|error| error.to_string());
        filmed.map(|()| camera)
    });
    let (body, start_ns) = ([7_u8; SMALL_BYTES], monotonic_ns());
    for n in 0..seconds * 1000 {
        sleep_until_monotonic(start_ns + n * 1_000_000);
        many.iter().try_for_each(|publisher| publisher.publish(&body))?;
    }
    let camera = filming.join().map_err(|_| "the camera panicked")??;
    let flight = recorder.end()?;
    drop((many, camera));
    let replay = Replay::run(taut, &folder.path().join("flight"))?;
    std::fs::remove_dir_all(folder.path().join("flight"))?;

    let bare_mb_s = bare(&folder.path().join("bare"), sequential)?;
    let stream = publisher(&participant, "/stream", MIB, 64)?;
    let mut recorder = Recorder::start(taut, &folder.path().join("stream"))?;
    recorder.wait(1)?;
    let start_ns = monotonic_ns();
    send(&stream, &vec![7; MIB], bare_mb_s * 1e6 / MIB as f64, (sequential / MIB) as u64)?;
    let streamed = recorder.end()?;
    let recorded_mb_s = streamed["bytes"].as_f64().unwrap_or(0.0) * 1e3 / (monotonic_ns() - start_ns) as f64;

    let topics = flight["topics"].as_array().ok_or("no topics")?;
    let of_topics =
        |key: &str| topics.iter().filter_map(|topic| topic[key].as_f64()).map(|ns| ns / 1e6).collect();
    let (stalls, survives): (Vec<f64>, Vec<f64>) =
        (of_topics("longest_stall_ns"), of_topics("survives_stall_ns"));
    let number = |report: &Value, key: &str| report[key].as_u64().unwrap_or(0);
    let recording = Recording {
        seconds: flight["seconds"].as_f64().unwrap_or(0.0),
        messages: number(&flight, "messages"),
        megabytes: number(&flight, "bytes") as f64 / 1e6,
        lost: number(&flight, "lost"),
        longest_stall_ms: stalls.into_iter().fold(0.0, f64::max),
        survives_ms: survives.into_iter().fold(f64::INFINITY, f64::min),
        longest_write_ms: number(&flight, "longest_write_ns") as f64 / 1e6,
        bare_mb_s,
        recorded_mb_s,
        recorded_lost: number(&streamed, "lost"),
        replay,
    };
    print(&recording, image);
    let mut broken = Vec::new();
    let wanted = seconds * (SMALL_TOPICS as u64 * 1000 + 30);
    if recording.lost > 0 || recording.messages != wanted {
        let Recording { lost, messages, .. } = recording;
        broken.push(format!("taut record: {messages} of {wanted} messages are in the bag, {lost} lost"));
    }
    let Replay { published, late_ms: [_, late_ms, _], timer_late_ms: [_, timer_ms, _], .. } =
        recording.replay;
    if published != recording.messages {
        broken.push(format!("taut play: {published} of {} messages were published", recording.messages));
    }
    if !quick && late_ms > timer_ms + MOST_JITTER_MS {
        broken.push(format!("taut play: p99 is {late_ms:.3} ms late, the timer {timer_ms:.3} ms"));
    }
    if !quick && recording.recorded_mb_s < SHARE * bare_mb_s {
        broken.push(format!(
            "taut record writes {recorded_mb_s:.0} MB/s where a plain file gets {bare_mb_s:.0}"
        ));
    }
    Ok((recording, broken))
}

fn print(recording: &Recording, image: usize) {
    let Recording {
        seconds, messages, megabytes, lost, longest_stall_ms, survives_ms, longest_write_ms, ..
    } = recording;
    println!("\ntaut record: {SMALL_TOPICS} topics at 1 kHz and images of {} MiB at 30 Hz\n", image / MIB);
    println!("{messages} messages, {megabytes:.0} MB in {seconds:.1} s, {lost} lost");
    println!(
        "longest time between two looks {longest_stall_ms:.1} ms, survived would be {survives_ms:.1} ms; longest write {longest_write_ms:.1} ms"
    );
    let Replay { published, starved, late_ms: [p50, p99, max], timer_late_ms } = &recording.replay;
    let [timer_p50, timer_p99, timer_max] = timer_late_ms;
    println!(
        "taut play of that: {published} messages, late by {p50:.3} ms (p50), {p99:.3} (p99), {max:.3} (max), the timer by {timer_p50:.3}, \
         {timer_p99:.3}, {timer_max:.3}; {starved} not read in time"
    );
    let Recording { bare_mb_s, recorded_mb_s, recorded_lost, .. } = recording;
    println!(
        "messages of 1 MiB as fast as a plain file is written, {bare_mb_s:.0} MB/s: {recorded_mb_s:.0} MB/s, {:.2} x, {recorded_lost} lost",
        recorded_mb_s / bare_mb_s
    );
    println!("rosbag2 says of itself: 110 to 120 MB/s (github.com/ros2/rosbag2/issues/1787)");
}
