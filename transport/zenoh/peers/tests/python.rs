// SPDX-License-Identifier: MIT OR Apache-2.0
//! The gateway and zenoh-ros2-sdk, a third implementation of the wire, which serialises by itself as well.

#[path = "../../tests/support/mod.rs"]
mod support;

use futures::FutureExt;
use gateway_peers::{python, script};
use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::mpsc;
use std::time::Duration;
use support::{Host, until, wait};
use tautline_msgs::cdr::Endian;
use tautline_msgs::{Message, Service};
use tautline_ros_msgs::{geometry_msgs, sensor_msgs, std_msgs};
use tautline_transport::{Limits, Qos, TopicType};

struct Peer {
    child: Child,
    input: ChildStdin,
    lines: mpsc::Receiver<String>,
}

impl Peer {
    fn start<M: Message>(python: &Path, host: &Host, role: &str, topic: &str) -> Self {
        let definition = std::env::temp_dir().join(format!(
            "definition_{}_{}",
            std::process::id(),
            topic.replace('/', "_")
        ));
        std::fs::write(&definition, M::DEFINITION.unwrap().to_text()).unwrap();
        let more = [M::TYPE_NAME, M::TYPE_HASH.unwrap(), definition.to_str().unwrap()];
        let peer = Self::start_script(python, host, "peer.py", role, topic, &more);
        std::fs::remove_file(definition).unwrap();
        peer
    }

    /// A script whose arguments are what it does, the port, the domain, the name, and `more`.
    fn start_script(python: &Path, host: &Host, name: &str, role: &str, topic: &str, more: &[&str]) -> Self {
        let port = host.locator().rsplit(':').next().unwrap().to_owned();
        let mut child = Command::new(python)
            .arg(script(name))
            .args([role, &port, &host.network_domain.to_string(), topic])
            .args(more)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let (sender, lines) = mpsc::channel();
        let output = BufReader::new(child.stdout.take().unwrap());
        std::thread::spawn(move || {
            output.lines().map_while(Result::ok).try_for_each(|line| sender.send(line))
        });
        let input = child.stdin.take().unwrap();
        while lines.recv_timeout(Duration::from_secs(60)).expect("the peer does not start") != "started" {}
        Peer { child, input, lines }
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn both_ways<M: Message + PartialEq + std::fmt::Debug>(python: &Path, host: &Host, name: &str, message: &M) {
    let topic_type = TopicType::new(M::TYPE_NAME).with_hash(M::TYPE_HASH.unwrap());
    let mut body = vec![0; message.cdr_len()];
    message.encode(&mut body).unwrap();

    let topic = format!("/out/{name}");
    let peer = Peer::start::<M>(python, host, "subscribe", &topic);
    let publisher = host.publisher(&topic, &topic_type, Qos::keep_last(10));
    let heard = wait("their reception", || {
        publisher.publish(&body).unwrap();
        let line = peer.lines.recv_timeout(Duration::from_millis(50)).ok()?;
        line.strip_prefix("heard ").map(String::from)
    });
    assert_eq!(M::from_cdr(&bytes(&heard)).unwrap(), *message, "{topic}");
    drop(peer);

    let topic = format!("/in/{name}");
    let subscription = host.subscription(&topic, &topic_type, Qos::keep_last(10));
    let mut peer = Peer::start::<M>(python, host, "publish", &topic);
    let cdr: String = message.to_cdr().unwrap().iter().map(|byte| format!("{byte:02x}")).collect();
    let sample = wait("our reception", || {
        writeln!(peer.input, "{cdr}").unwrap();
        std::thread::sleep(Duration::from_millis(20));
        subscription.try_take_valid().unwrap()
    });
    assert_eq!(M::decode(sample.body(), Endian::Little).unwrap(), *message, "{topic}");
    let remote = host.gateway().remote();
    let theirs =
        remote.iter().find(|token| token.endpoint.as_ref().is_some_and(|e| e.name == topic)).unwrap();
    assert_eq!(theirs.node.full_name(), "/theirs/their_node");
}

fn bytes(hex: &str) -> Vec<u8> {
    (0..hex.len() / 2).map(|n| u8::from_str_radix(&hex[2 * n..2 * n + 2], 16).unwrap()).collect()
}

#[test]
fn messages_both_ways() {
    let Some(python) = python() else { return };
    let host = Host::first(210, 210);
    both_ways(&python, &host, "text", &std_msgs::msg::String { data: "Grüße".into() });
    let mut twist = geometry_msgs::msg::Twist::default();
    (twist.linear.x, twist.angular.z) = (0.5, -2.0);
    both_ways(&python, &host, "twist", &twist);
    let mut image = sensor_msgs::msg::Image::default();
    (image.height, image.width, image.step, image.encoding) = (48, 64, 192, "rgb8".into());
    image.header.frame_id = "camera".into();
    image.data = (0..48 * 192).map(|n| n as u8).collect();
    both_ways(&python, &host, "image", &image);
    let mut scan = sensor_msgs::msg::LaserScan::default();
    (scan.header.stamp.sec, scan.range_max) = (7, 72.0);
    scan.ranges = (0..720).map(|n| n as f32 / 10.0).collect();
    both_ways(&python, &host, "scan", &scan);
}

#[test]
fn a_service_each_way() {
    use tautline_ros_msgs::std_srvs::srv::SetBool;
    let Some(python) = python() else { return };
    let host = Host::first(67, 67);
    let limits = Limits::default();
    let hash = [<SetBool::Service as Service>::TYPE_HASH];
    // The network hears of what nodes have.
    let node = host.participant.create_node("our_node", "/").unwrap();
    let ours = host.participant.for_node(&node);

    let peer = Peer::start_script(&python, &host, "service.py", "serve", "/theirs/switch", &hash);
    let client = ours.create_client::<SetBool::Service>("/theirs/switch", limits).unwrap();
    until("their service", || client.server_count() == 1);
    for data in [true, false] {
        let mut pending = client.request(&SetBool::Request { data }).unwrap();
        let response = wait("their answer", || (&mut pending).now_or_never()).unwrap();
        let message = if data { "théirs" } else { "" };
        assert_eq!((response.view().success(), response.view().message()), (data, message));
        let asked = if data { "asked True" } else { "asked False" };
        assert_eq!(peer.lines.recv_timeout(Duration::from_secs(20)).unwrap(), asked);
    }
    // Killed: what it was asked ends, and with it the service.
    let _last = client.request(&SetBool::Request { data: true }).unwrap();
    drop(peer);
    until("the end of their service", || client.server_count() == 0);

    let server = ours.create_server::<SetBool::Service>("/ours/switch", 10, limits).unwrap();
    let mut peer = Peer::start_script(&python, &host, "service.py", "ask", "/ours/switch", &hash);
    for (data, answer) in [("True", "answer (True, 'Grüße')"), ("False", "answer (False, 'Grüße')")] {
        writeln!(peer.input, "{data}").unwrap();
        let request = wait("their request", || server.try_take().unwrap());
        assert_eq!(request.data, data == "True");
        let response = SetBool::Response { success: request.data, message: "Grüße".into() };
        server.respond(request.id(), &response).unwrap();
        assert_eq!(peer.lines.recv_timeout(Duration::from_secs(20)).unwrap(), answer);
    }
}

/// Their list of topics, types and endpoints, as `ros2 topic info -v` would show it.
#[test]
fn our_topics_are_in_their_graph() {
    let Some(python) = python() else { return };
    let host = Host::first(211, 211);
    let topic_type =
        TopicType::new("std_msgs/msg/String").with_hash(std_msgs::msg::String::TYPE_HASH.unwrap());
    let _publisher = host.publisher("/ours/chatter", &topic_type, Qos::keep_last(7).best_effort());
    let port = host.locator().rsplit(':').next().unwrap().to_owned();
    let program = "import sys\n\
        from zenoh_ros2_sdk.discovery import get_topic_names_and_types, get_topic_info\n\
        for name, types in get_topic_names_and_types(211, '127.0.0.1', int(sys.argv[1]), 3.0): print(name, types)\n\
        print(get_topic_info('/ours/chatter', 211, '127.0.0.1', int(sys.argv[1]), 3.0, True))\n";
    let output = wait("our topic", || {
        let output = Command::new(&python).args(["-c", program, &port]).output().unwrap();
        let text = String::from_utf8(output.stdout).unwrap() + &String::from_utf8(output.stderr).unwrap();
        text.contains("/ours/chatter ['std_msgs/msg/String']").then_some(text)
    });
    assert!(
        output.contains("2::,7:,:,:,,") && output.contains(std_msgs::msg::String::TYPE_HASH.unwrap()),
        "{output}"
    );
}
