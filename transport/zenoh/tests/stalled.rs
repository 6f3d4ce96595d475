// SPDX-License-Identifier: MIT OR Apache-2.0
//! A link that stalls, for the other host's gateway reads no more, costs remote samples, which are counted; a local publisher
//! does not notice it, and no local sample is lost.

mod support;

use rustix::process::{Pid, Signal, kill_process};
use std::process::{Child, Command, Stdio};
use support::{Host, connect, image_type, until};
use tautline_gateway::{Direction, Reading};
use tautline_transport::{Participant, PublishError, Qos, RawPublisher, RawSubscription};

const BODY_BYTES: usize = 256 << 10;

/// The other host's gateway, a process that can be stopped.
struct Other(Child);

impl Other {
    fn start(domain: u32, network_domain: u32, locator: &str) -> Self {
        let mut command = Command::new(env!("CARGO_BIN_EXE_taut-gateway"));
        command.args(["--no-rt", "--json", "--domain", &domain.to_string(), "--connect", locator]);
        command.args(["--network-domain", &network_domain.to_string()]);
        Other(command.env("TAUT_SCOPE", support::scope()).stdout(Stdio::null()).spawn().unwrap())
    }

    fn signal(&self, signal: Signal) {
        kill_process(Pid::from_child(&self.0), signal).unwrap();
    }
}

impl Drop for Other {
    fn drop(&mut self) {
        if std::thread::panicking() {
            let _ = self.0.kill();
        } else {
            // So that it leaves nothing in /dev/shm.
            self.signal(Signal::TERM);
        }
        let _ = self.0.wait();
    }
}

/// A topic with a subscription on either host.
struct Topic {
    name: &'static str,
    publisher: RawPublisher,
    near: RawSubscription,
    far: RawSubscription,
    sent: u64,
}

impl Topic {
    fn open(host: &Host, other: &Participant, name: &'static str, qos: Qos) -> Self {
        let limits = tautline_transport::Limits { message_bytes: BODY_BYTES, ..Default::default() };
        let subscribe = |participant: &Participant, qos| {
            participant.create_raw_subscription(name, &image_type(), qos, limits).unwrap()
        };
        // The local one's queue is short: whoever held the publisher back would also keep it full.
        let (near, far) = (subscribe(&host.participant, qos), subscribe(other, qos));
        let publisher = host.participant.create_raw_publisher(name, &image_type(), qos, limits).unwrap();
        connect(&publisher, &[&near, &far], b"probe");
        Topic { name, publisher, near, far, sent: 0 }
    }

    /// Every sample is there for the local subscription when `publish` returns.
    fn publish(&mut self, samples: u64, bytes: usize) {
        let body = vec![7; bytes];
        for _ in 0..samples {
            if let Err(error) = self.publisher.publish(&body) {
                // The link is full, and what both ends keep is not lost.
                assert_eq!((error, self.name), (PublishError::Full, "/patient"));
                continue;
            }
            let sample = self.near.try_take_valid().unwrap().expect("the sample just published");
            assert_eq!(sample.body().len(), bytes);
            self.sent += 1;
            while self.far.try_take_valid().unwrap().is_some() {}
        }
    }
}

fn out(host: &Host, topic: &str) -> Reading {
    let topics = host.stats().topics;
    let found =
        topics.into_iter().find(|stats| stats.name.topic == topic && stats.direction == Direction::Out);
    found.unwrap().reading
}

/// What became of the samples that were to go out.
fn accounted(reading: &Reading) -> u64 {
    reading.messages + reading.lost + reading.dropped.values().sum::<u64>()
}

#[test]
fn a_stalled_link_costs_remote_samples_only() {
    let host = Host::first(126, 126);
    let other = Other::start(127, 126, &host.locator());
    let there = Participant::new(127).unwrap();
    let mut topics = [
        ("/small", Qos::keep_last(5), 64),
        ("/bulk", Qos::keep_last(5), BODY_BYTES),
        ("/patient", Qos { history: tautline_transport::History::KeepAll, ..Qos::keep_last(5) }, 1024),
        ("/kept", Qos::keep_last(5).transient_local(), 1024),
    ]
    .map(|(name, qos, bytes)| (Topic::open(&host, &there, name, qos), bytes));
    let before: Vec<u64> =
        topics.each_ref().map(|(topic, _)| accounted(&settled(&host, topic.name))).to_vec();

    other.signal(Signal::STOP);
    // Until the link's buffers, the kernel's and Zenoh's queues are full, and then as much again.
    for _ in 0..2 {
        for (topic, bytes) in &mut topics {
            topic.publish(if *bytes == BODY_BYTES { 200 } else { 3000 }, *bytes);
            assert_eq!(topic.near.counters().lost(), 0, "{}", topic.name);
        }
    }
    other.signal(Signal::CONT);

    for ((topic, _), before) in topics.iter().zip(before) {
        until("an account of every sample", || accounted(&settled(&host, topic.name)) - before == topic.sent);
    }
    let reading = out(&host, "/bulk");
    assert!(
        reading.lost + reading.dropped.values().sum::<u64>() > 100,
        "100 MiB do not fit into a link: {reading:?}"
    );
    // And the link goes on: what is published now arrives.
    for (topic, bytes) in &mut topics {
        until(topic.name, || {
            topic.publisher.publish(&vec![9; *bytes]).unwrap();
            drop(topic.near.try_take_valid().unwrap());
            std::thread::sleep(std::time::Duration::from_millis(5));
            topic.far.try_take_valid().unwrap().is_some_and(|sample| sample.body().first() == Some(&9))
        });
    }
}

/// The numbers, read once more: they are a second old at most.
fn settled(host: &Host, topic: &str) -> Reading {
    let uptime = host.stats().uptime_s;
    until("new numbers", || host.stats().uptime_s > uptime);
    out(host, topic)
}
