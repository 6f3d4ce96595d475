// SPDX-License-Identifier: MIT OR Apache-2.0
//! Hosts for tests: each a domain of its own on this machine, with a gateway to one domain of the network.
#![allow(dead_code, reason = "each test uses a part")]

use std::time::{Duration, Instant};
use tautline_gateway::{Direction, Gateway, Network, Options, Stats, TopicStats};
use tautline_rt::Realtime;
use tautline_transport::{
    Limits, MessageInfo, Participant, Qos, RawPublisher, RawSample, RawSubscription, TopicType,
};
use zenoh::{Session, Wait};

/// Nothing that a test waits for takes this long unless it is broken.
const PATIENCE: Duration = Duration::from_secs(30);

/// No type's: were its definition known on this machine, bodies would be checked, and these are any bytes.
pub const UNKNOWN_HASH: &str = "RIHS01_df00000000000000000000000000000000000000000000000000000000000001";

pub fn string_type() -> TopicType {
    TopicType::new("std_msgs/msg/String").with_hash(UNKNOWN_HASH)
}

/// Some type of bytes.
pub fn image_type() -> TopicType {
    TopicType::new("sensor_msgs/msg/Image").with_hash(UNKNOWN_HASH.replace("df", "ab"))
}

/// That of whoever runs the tests, or one that no user's programs are in.
pub fn scope() -> &'static str {
    tautline_rt::domain::test_scope("test")
}

pub struct Host {
    pub domain: u32,
    pub network_domain: u32,
    pub gateway: Option<Gateway>,
    pub participant: Participant,
}

impl Host {
    /// A host that listens, for others to connect to.
    pub fn first(domain: u32, network_domain: u32) -> Self {
        Self::new(domain, network_domain, |options| options.network.listen = vec!["tcp/127.0.0.1:0".into()])
    }

    /// A host that connects to another one.
    pub fn beside(other: &Host, domain: u32) -> Self {
        let locator = other.locator();
        Self::new(domain, other.network_domain, |options| options.network.connect = vec![locator])
    }

    pub fn new(domain: u32, network_domain: u32, change: impl FnOnce(&mut Options)) -> Self {
        let mut options = Options {
            domain,
            network_domain: Some(network_domain),
            realtime: Realtime::Off,
            network: Network { connect: vec!["tcp/127.0.0.1:1".into()], ..Network::default() },
            ..Options::default()
        };
        change(&mut options);
        scope();
        let gateway = Some(Gateway::spawn(options).unwrap());
        Host { domain, network_domain, gateway, participant: Participant::new(domain).unwrap() }
    }

    pub fn gateway(&self) -> &Gateway {
        self.gateway.as_ref().unwrap()
    }

    pub fn locator(&self) -> String {
        let locators = self.gateway().locators();
        locators.into_iter().find(|locator| locator.starts_with("tcp/127.0.0.1")).unwrap()
    }

    /// A plain session of Zenoh that is connected to it.
    pub fn session(&self) -> Session {
        let text = format!(
            r#"{{ mode: "client", connect: {{ endpoints: ["{}"] }}, scouting: {{ multicast: {{ enabled: false }} }} }}"#,
            self.locator()
        );
        zenoh::open(zenoh::Config::from_json5(&text).unwrap()).wait().unwrap()
    }

    pub fn stats(&self) -> Stats {
        self.gateway().stats()
    }

    pub fn publisher(&self, topic: &str, topic_type: &TopicType, qos: Qos) -> RawPublisher {
        self.participant.create_raw_publisher(topic, topic_type, qos, Limits::default()).unwrap()
    }

    pub fn subscription(&self, topic: &str, topic_type: &TopicType, qos: Qos) -> RawSubscription {
        self.participant.create_raw_subscription(topic, topic_type, qos, Limits::default()).unwrap()
    }
}

/// What a host's gateway counts of a topic in one direction.
pub fn stats(host: &Host, topic: &str, direction: Direction) -> Option<TopicStats> {
    host.stats().topics.into_iter().find(|stats| stats.name.topic == topic && stats.direction == direction)
}

/// Waits until `done` says something.
pub fn wait<T>(what: &str, mut done: impl FnMut() -> Option<T>) -> T {
    let start = Instant::now();
    loop {
        if let Some(value) = done() {
            return value;
        }
        assert!(start.elapsed() < PATIENCE, "still waiting for: {what}");
        std::thread::sleep(Duration::from_millis(2));
    }
}

pub fn until(what: &str, mut done: impl FnMut() -> bool) {
    wait(what, || done().then_some(()));
}

pub fn take(subscription: &RawSubscription) -> RawSample {
    wait("a sample", || subscription.try_take_valid().unwrap())
}

/// Publishes `probe` until it has arrived, then takes all that came of it. From then on nothing is lost for want of a
/// connection.
pub fn connect(publisher: &RawPublisher, subscriptions: &[&RawSubscription], probe: &[u8]) {
    let mut pending: Vec<_> = subscriptions.iter().map(|s| (s, false)).collect();
    until("a connection", || {
        publisher.publish(probe).unwrap();
        std::thread::sleep(Duration::from_millis(5));
        for (subscription, has) in &mut pending {
            while subscription.try_take_valid().unwrap().is_some() {
                *has = true;
            }
        }
        pending.iter().all(|(_, has)| *has)
    });
    // What is still on its way.
    let last = b"the last probe".as_slice();
    publisher.publish(last).unwrap();
    for subscription in subscriptions {
        while take(subscription).body() != last {}
    }
}

impl Drop for Host {
    fn drop(&mut self) {
        if std::thread::panicking()
            && let Some(gateway) = &self.gateway
        {
            std::thread::sleep(Duration::from_millis(1100));
            println!(
                "domain {}: {}",
                self.domain,
                serde_json::to_string(&gateway.stats()).unwrap_or_default()
            );
        }
    }
}

pub fn origin(info: MessageInfo) -> (u64, i64) {
    (info.sequence_number, info.source_timestamp_ns)
}
