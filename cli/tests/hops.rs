// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut trace hops`: a talker and a listener in two domains, a gateway in each, all of them programs that record themselves.

mod traced;

use serde_json::Value;
use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::mpsc;
use std::time::Duration;
use tautline_transport::{Limits, Participant, Qos, TopicType};
use traced::{scratch, taut, text};

const TEST: &str = "each_hop_of_each_message_from_domain_to_domain";
const TALKER: u32 = 217;
const LISTENER: u32 = 218;
/// As many as a gateway keeps until it knows their publisher.
const MESSAGES: u64 = 50;
/// Nothing that is waited for takes this long unless it is broken.
const PATIENCE: Duration = Duration::from_secs(60);

/// What is kept for late joiners, all of it published at once; and what goes message by message.
const KEPT: &str = "/hops/kept";
const LIVE: &str = "/hops/live";

fn qos(topic: &str) -> Qos {
    let qos = Qos::keep_last(1000);
    if topic == KEPT { qos.transient_local() } else { qos }
}

/// A hash that is no type's: of one that is known the gateway would check the bodies, which are numbers here.
fn topic_type() -> TopicType {
    let hash = format!("RIHS01_{:064x}", 0xDF);
    TopicType::new("std_msgs/msg/UInt64").with_hash(hash)
}

/// Publishes a message for each line.
fn talk() {
    let participant = Participant::new(TALKER).unwrap();
    let publisher = |topic| {
        participant.create_raw_publisher(topic, &topic_type(), qos(topic), Limits::default()).unwrap()
    };
    let (kept, live) = (publisher(KEPT), publisher(LIVE));
    (1..=MESSAGES).for_each(|value| kept.publish(&value.to_le_bytes()).unwrap());
    for (line, value) in std::io::stdin().lock().lines().zip(1..) {
        line.unwrap();
        live.publish(&u64::to_le_bytes(value)).unwrap();
    }
}

/// Says what it takes, until it is told that that is all.
fn listen() {
    let participant = Participant::new(LISTENER).unwrap();
    let subscription = |topic| {
        participant.create_raw_subscription(topic, &topic_type(), qos(topic), Limits::default()).unwrap()
    };
    let (kept, live) = (subscription(KEPT), subscription(LIVE));
    let (told, end) = mpsc::channel::<()>();
    std::thread::spawn(move || {
        let _ = std::io::stdin().read_line(&mut String::new());
        drop(told);
    });
    while end.try_recv() == Err(mpsc::TryRecvError::Empty) {
        for (topic, subscription) in [(KEPT, &kept), (LIVE, &live)] {
            while let Some(sample) = subscription.try_take().unwrap() {
                let value = u64::from_le_bytes(sample.body().try_into().unwrap());
                println!(">{topic} {value}");
            }
        }
        std::thread::yield_now();
    }
}

/// A program that is told to end, or killed, when this goes.
struct Running {
    child: Child,
    input: Option<ChildStdin>,
    said: mpsc::Receiver<String>,
}

impl Running {
    fn start(mut command: Command) -> Running {
        command.env("TAUT_TRACE", "on").env_remove("TAUT_TRACE_EVENTS").env_remove("RUST_LOG");
        command.env_remove("ZENOH_SESSION_CONFIG_URI").env_remove("ZENOH_CONFIG_OVERRIDE");
        command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = command.spawn().unwrap();
        let (sender, said) = mpsc::channel();
        let pipes: [Box<dyn std::io::Read + Send>; 2] =
            [Box::new(child.stdout.take().unwrap()), Box::new(child.stderr.take().unwrap())];
        for pipe in pipes {
            let sender = sender.clone();
            std::thread::spawn(move || {
                BufReader::new(pipe).lines().map_while(Result::ok).for_each(|line| drop(sender.send(line)));
            });
        }
        Running { input: child.stdin.take(), child, said }
    }

    /// This test again, as one of the ends.
    fn end_of_way(role: &str) -> Running {
        let mut command = Command::new(std::env::current_exe().unwrap());
        command.args(["--exact", TEST, "--nocapture", "--test-threads=1"]).env("TAUT_TEST_ROLE", role);
        Running::start(command)
    }

    fn gateway(program: &Path, domain: u32, links: &[&str]) -> Running {
        let mut command = Command::new(program);
        let (domain, network_domain) = (domain.to_string(), TALKER.to_string());
        command.args(["--domain", &domain, "--network-domain", &network_domain, "--no-rt"]).args(links);
        Running::start(command)
    }

    /// The rest of the first line that has this in it.
    fn says(&self, what: &str) -> String {
        loop {
            let line = self.said.recv_timeout(PATIENCE).unwrap_or_else(|_| panic!("nobody says {what}"));
            if let Some((_, rest)) = line.split_once(what) {
                return rest.to_owned();
            }
        }
    }

    fn tell(&mut self) {
        writeln!(self.input.as_mut().unwrap()).unwrap();
    }

    /// What it recorded stays.
    fn ends(mut self, with_signal: bool) -> u64 {
        self.input = None;
        let pid = self.child.id();
        if with_signal {
            assert!(Command::new("kill").arg(pid.to_string()).status().unwrap().success());
        }
        self.child.wait().unwrap();
        pid.into()
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// What is told of a topic: (hop, pids of both ends, n), in the order in which they are printed.
fn hops(report: &Value, topic: &str) -> Vec<(String, [u64; 2], u64)> {
    let rows = report["hops"].as_array().unwrap().iter().filter(|row| row["topic"] == topic);
    let told = |row: &Value| {
        let at = |quantile: &str| row[quantile].as_f64().unwrap();
        assert!(
            0.0 <= at("p50_us") && at("p50_us") <= at("p99_us") && at("p99_us") <= at("max_us"),
            "{row:#}"
        );
        assert!(row["clocks_differ"] == false && row["reversed"] == 0, "{row:#}");
        let pids = ["from", "to"].map(|end| row[end]["pid"].as_u64().unwrap());
        (row["hop"].as_str().unwrap().to_owned(), pids, row["n"].as_u64().unwrap())
    };
    rows.map(told).collect()
}

#[test]
fn each_hop_of_each_message_from_domain_to_domain() {
    match std::env::var("TAUT_TEST_ROLE").as_deref() {
        Ok("talker") => return talk(),
        Ok("listener") => return listen(),
        _ => {}
    }
    let program = Path::new(env!("CARGO_BIN_EXE_taut")).with_file_name("taut-gateway");
    if !program.is_file() {
        let missing = format!("no {}: cargo build -p tautline-gateway", program.display());
        assert!(std::env::var_os("CI").is_none(), "{missing}");
        eprintln!("skipped: {missing}");
        return;
    }
    let directory = scratch("hops");

    let first =
        Running::gateway(&program, TALKER, &["--listen", "tcp/127.0.0.1:0", "--connect", "tcp/127.0.0.1:1"]);
    let port = first.says("listening on tcp/127.0.0.1:");
    let port: String = port.chars().take_while(char::is_ascii_digit).collect();
    let second = Running::gateway(&program, LISTENER, &["--connect", &format!("tcp/127.0.0.1:{port}")]);
    let (mut talker, listener) = (Running::end_of_way("talker"), Running::end_of_way("listener"));

    // What is published before everything is connected gets lost; from the first message that arrives on nothing does.
    let (mut published, mut kept, mut live) = (0, 0, Vec::new());
    let hear = |live: &mut Vec<u64>, kept: &mut u64, patience: Duration| {
        let line = listener.said.recv_timeout(patience).ok()?;
        match line.split_once('>').and_then(|(_, said)| said.split_once(' ')) {
            Some((LIVE, value)) => live.push(value.parse().unwrap()),
            Some((KEPT, _)) => *kept += 1,
            _ => {}
        }
        Some(())
    };
    while live.is_empty() {
        talker.tell();
        published += 1;
        assert!(published < 3000, "nothing arrives");
        hear(&mut live, &mut kept, Duration::from_millis(20));
    }
    for _ in 0..MESSAGES {
        talker.tell();
        published += 1;
        while live.last() != Some(&published) {
            hear(&mut live, &mut kept, PATIENCE).expect("a message that arrives");
        }
    }
    while kept < MESSAGES {
        hear(&mut live, &mut kept, PATIENCE).expect("a message that was kept");
    }
    let [talker, listener] = [talker, listener].map(|end| end.ends(false));
    let [first, second] = [first, second].map(|gateway| gateway.ends(true));

    let recorded = [TALKER, LISTENER].map(|domain| {
        let file = directory.join(format!("{domain}.trace")).display().to_string();
        let out = taut(&["trace", "record", "--domain", &domain.to_string(), "--seconds", "0", "-o", &file]);
        assert!(out.status.success(), "{}", text(&out.stderr));
        file
    });
    let [there, here] = recorded.each_ref().map(String::as_str);
    let report = json(&["trace", "hops", there, here, "--json"]);
    assert_eq!(
        (&report["events_lost"], &report["unmatched"]),
        (&0.into(), &Value::Array(Vec::new())),
        "{report:#}"
    );

    let expected = [
        ("publish_to_take", [talker, first]),
        ("take_to_send", [first, first]),
        ("send_to_receive", [first, second]),
        ("receive_to_publish", [second, second]),
        ("publish_to_take", [second, listener]),
        ("whole_way", [talker, listener]),
    ];
    let rows = hops(&report, KEPT);
    assert_eq!(rows, expected.map(|(hop, pids)| (hop.to_owned(), pids, MESSAGES)), "{report:#}");
    let rows = hops(&report, LIVE);
    let arrived = live.len() as u64;
    assert_eq!(rows.iter().map(|(hop, pids, _)| (&**hop, *pids)).collect::<Vec<_>>(), expected, "{report:#}");
    let ns: Vec<u64> = rows.iter().map(|(_, _, n)| *n).collect();
    assert!(ns[..4].iter().is_sorted_by(|before, after| before >= after), "{ns:?}");
    assert!(
        ns[0] <= published && ns[3] >= arrived && ns[4..] == [arrived; 2],
        "{published} {ns:?} {arrived}"
    );
    // All of these messages came all the way, and no part of that is longer than the whole.
    let rows = report["hops"].as_array().unwrap().iter().filter(|row| row["topic"] == KEPT);
    let longest: Vec<f64> = rows.map(|row| row["max_us"].as_f64().unwrap()).collect();
    assert!(longest.iter().all(|part| Some(part) <= longest.last()), "{longest:?}");

    let table = text(&taut(&["trace", "hops", there, here]).stdout);
    assert!(table.contains("send to receive") && table.contains("taut-gateway"), "{table}");
    // Of one of the domains alone what happened there is told, and what is not known is said.
    let report = json(&["trace", "hops", here, "--json"]);
    let rows = hops(&report, KEPT);
    assert_eq!(rows, [3, 4].map(|at| (expected[at].0.to_owned(), expected[at].1, MESSAGES)), "{report:#}");
    let unmatched = report["unmatched"].as_array().unwrap().iter().find(|row| row["topic"] == KEPT).unwrap();
    assert!(unmatched["hop"] == "send_to_receive" && unmatched["n"] == MESSAGES, "{unmatched:#}");
    std::fs::remove_dir_all(directory).unwrap();
}

fn json(arguments: &[&str]) -> Value {
    let out = taut(arguments);
    assert!(out.status.success(), "{}", text(&out.stderr));
    serde_json::from_slice(&out.stdout).unwrap()
}
