// SPDX-License-Identifier: MIT OR Apache-2.0
//! Nodes of rclpy on rmw_tautline, through the gateway, and zenoh-ros2-sdk: types, hashes and values are those of the distribution that the
//! library is built for, and the other end has none of them.

mod support;

use serde_json::{Value, json};
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::{Arc, mpsc};
use std::time::Duration;
use support::gateway::{GatewayProcess, listen};
use support::{Domain, PATIENCE, STRING, wait_until};
use tautline_schema::{DynamicMessage, Packages, Schema};

/// So many of a type each way, once the way is there. Of types that the SDK reads whatever is in them: after an empty sequence of eight-byte numbers it
/// expects padding that ROS does not send.
const COUNT: usize = 50;

const SET_BOOL: &str = "std_srvs/srv/SetBool";

/// A program of zenoh-ros2-sdk's, which says a line for each message, request or response.
struct Sdk {
    child: Child,
    input: ChildStdin,
    lines: mpsc::Receiver<String>,
}

impl Sdk {
    /// Does this for a topic or a service, of which there is `more` to say.
    fn start(
        python: &Path,
        gateway: &GatewayProcess,
        domain: &Domain,
        script: &str,
        told: [&str; 2],
        more: &[&str],
    ) -> Self {
        let scripts = Path::new(env!("CARGO_MANIFEST_DIR")).join("../transport/zenoh/peers/python");
        let endpoint = gateway.endpoint();
        let port = endpoint.rsplit(':').next().unwrap();
        let mut command = Command::new(python);
        command
            .arg(scripts.join(script))
            .args([told[0], port, &domain.number.to_string(), told[1]])
            .args(more);
        let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
        let (input, output) = (child.stdin.take().unwrap(), BufReader::new(child.stdout.take().unwrap()));
        let (sender, lines) = mpsc::channel();
        std::thread::spawn(move || {
            output.lines().map_while(Result::ok).try_for_each(|line| sender.send(line))
        });
        let sdk = Sdk { child, input, lines };
        while sdk.line() != "started" {}
        sdk
    }

    fn line(&self) -> String {
        self.lines.recv_timeout(PATIENCE).expect("the SDK says something; else see its output above")
    }

    fn tell(&mut self, line: &str) {
        writeln!(self.input, "{line}").unwrap();
    }
}

impl Drop for Sdk {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// The Python that `cargo xtask peers` makes, beside the tests' build; prints why a test is skipped without it.
fn sdk() -> Option<PathBuf> {
    let tests = std::env::current_exe().unwrap();
    let venv = tests.ancestors().nth(3).unwrap().join("peers/venv");
    let is_there = venv.join("wheels.txt").is_file();
    if !is_there {
        assert!(std::env::var_os("CI").is_none(), "CI needs zenoh-ros2-sdk: run `cargo xtask peers`");
        eprintln!("skipped: no zenoh-ros2-sdk in {}: run `cargo xtask peers`", venv.display());
    }
    is_there.then(|| venv.join("bin/python"))
}

/// Sends one after the other until the first is heard, then [`COUNT`] more: these are the last that are heard, none is lost.
fn one_way(sent: &[String], mut send: impl FnMut(&str), mut heard: impl FnMut() -> Vec<String>) {
    let (mut count, mut received) = (0, Vec::new());
    wait_until("the way from end to end", || {
        send(sent.get(count).expect("the way is there after so many"));
        count += 1;
        std::thread::sleep(Duration::from_millis(50));
        received.extend(heard());
        !received.is_empty()
    });
    let rest = &sent[count..count + COUNT];
    rest.iter().for_each(|one| send(one));
    // Not only the last: a value may occur more than once.
    wait_until("all that was sent, in its order", || {
        received.extend(heard());
        received.ends_with(rest)
    });
    // What was sent while there was no way yet is lost.
    assert!(sent[..count + COUNT].ends_with(&received));
}

#[test]
fn messages_both_ways() {
    let Some((python, domain)) = sdk().and_then(|python| Some((python, Domain::new(129)?))) else { return };
    let Some(gateway) = listen(domain.number) else { return };
    let mut ours = domain.simple_peer("ours");
    let mut packages = Packages::new();
    packages.add_folder(&domain.venv);
    let folder = tempfile::tempdir().unwrap();
    for name in [STRING, "geometry_msgs/msg/PoseWithCovarianceStamped", "sensor_msgs/msg/LaserScan"] {
        let schema = Arc::new(packages.schema(&name.parse().unwrap()).unwrap());
        let definition = folder.path().join("definition");
        std::fs::write(&definition, schema.to_text()).unwrap();
        let (hash, definition) = (schema.hash().to_string(), definition.display().to_string());
        let start = |role: &str, topic: &str| {
            Sdk::start(&python, &gateway, &domain, "peer.py", [role, topic], &[name, &hash, &definition])
        };
        let random = json!({ "do": "random", "type": name, "count": 10 * COUNT, "seed": 7 });
        let (topic, qos) = (format!("/{}", name.replace('/', "_").to_lowercase()), json!({ "depth": 1000 }));

        let theirs = start("subscribe", &format!("{topic}/out"));
        let publisher = ours.publisher(&format!("{topic}/out"), name, qos.clone());
        let mut prepare = random.clone();
        prepare["do"] = json!("prepare_random");
        let said = ours.tell(prepare);
        let said: Vec<String> = said.as_array().unwrap().iter().map(|one| text(&schema, one)).collect();
        let publish =
            |_: &str| drop(ours.tell(json!({ "do": "publish_prepared", "end": publisher, "count": 1 })));
        one_way(&said, publish, || {
            let heard = theirs.lines.try_iter();
            heard.map(|line| of_cdr(&schema, line.strip_prefix("heard ").unwrap())).collect()
        });
        drop(theirs);

        let said = ours.tell(random);
        let said: Vec<&str> = said.as_array().unwrap().iter().map(|one| one[0].as_str().unwrap()).collect();
        let values: Vec<String> = said.iter().map(|cdr| of_cdr(&schema, cdr)).collect();
        let subscription = ours.subscription(&format!("{topic}/in"), name, qos);
        let mut theirs = start("publish", &format!("{topic}/in"));
        let mut cdr = said.iter();
        one_way(
            &values,
            |_| theirs.tell(cdr.next().unwrap()),
            || ours.take(subscription, 0).iter().map(|one| text(&schema, one)).collect(),
        );
    }
}

/// A value in one form, whoever said it.
fn text(schema: &Arc<Schema>, value: &Value) -> String {
    DynamicMessage::from_json(schema, &value.to_string()).unwrap().to_json()
}

fn of_cdr(schema: &Arc<Schema>, hex: &str) -> String {
    let digits = |at: usize| u8::from_str_radix(&hex[at..at + 2], 16).unwrap();
    let bytes: Vec<u8> = (0..hex.len()).step_by(2).map(digits).collect();
    DynamicMessage::from_cdr(schema, &bytes).unwrap().to_json()
}

#[test]
fn a_service_each_way() {
    let Some((python, domain)) = sdk().and_then(|python| Some((python, Domain::new(130)?))) else { return };
    let Some(gateway) = listen(domain.number) else { return };
    let mut ours = domain.peer("ours");
    let mut packages = Packages::new();
    packages.add_folder(&domain.venv);
    let hash = packages.schema(&SET_BOOL.parse().unwrap()).unwrap().hash().to_string();
    let start =
        |role: &str, name: &str| Sdk::start(&python, &gateway, &domain, "service.py", [role, name], &[&hash]);

    let theirs = start("serve", "/theirs/switch");
    let client = ours.tell(json!({ "do": "client", "name": "/theirs/switch", "type": SET_BOOL }));
    for (data, asked, message) in [(true, "asked True", "théirs"), (false, "asked False", "")] {
        let answers = ours.tell(json!({ "do": "call", "end": client, "requests": [{ "data": data }] }));
        assert_eq!(answers, json!([{ "success": data, "message": message }]));
        assert_eq!(theirs.line(), asked);
    }
    drop(theirs);
    ours.tell(json!({ "do": "available", "end": client, "is_so": false }));

    ours.tell(json!({ "do": "service", "name": "/ours/switch", "type": SET_BOOL, "behaviour": "set_bool" }));
    let mut theirs = start("ask", "/ours/switch");
    for (data, answer) in [("True", "answer (True, 'on')"), ("False", "answer (False, 'off')")] {
        theirs.tell(data);
        assert_eq!(theirs.line(), answer);
    }
}
