// SPDX-License-Identifier: MIT OR Apache-2.0
//! The systems and their ways.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::process::Command;

use crate::Result;

/// All systems, in the order of the tables.
pub const SYSTEMS: [&str; 11] = [
    "floor",
    "tautline",
    "iceoryx2",
    "taktora",
    "fastdds",
    "cyclonedds",
    "r2r",
    "zenoh",
    "hiroz",
    "copper",
    "dora",
];

/// How a system's processes are started.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Program {
    /// This one, with `--child`.
    Own,
    /// This one, with a gateway for each end.
    Gateways,
    /// A program of this name, which takes its job as JSON.
    Json(&'static str),
    /// The same beside a daemon: a program of the second name.
    Daemon(&'static str, &'static str),
}

/// What a mode takes part in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// Everything.
    All,
    /// Round trips.
    RoundTrips,
    /// Round trips with idle states as shipped, for it decides about them itself.
    AsShipped,
    /// Round trips of payloads that are written and read whole.
    Whole,
    /// The same with idle states held off alone, for nobody sleeps: a floor.
    Copy,
    /// Round trips of 64 B.
    Small,
    /// Flows of many topics.
    Topics,
    /// The same, and streams.
    Flows,
    /// Requests and their responses.
    Requests,
    /// The same of 64 B.
    SmallRequests,
}

/// A way of a system.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Mode {
    pub system: &'static str,
    pub mode: &'static str,
    pub program: Program,
    /// Both processes on the receiver's core.
    pub one_core: bool,
    pub part: Part,
    /// What was set.
    pub settings: &'static str,
}

impl Mode {
    const fn program(self, program: Program) -> Self {
        Mode { program, ..self }
    }

    const fn one_core(self) -> Self {
        Mode { one_core: true, ..self }
    }

    const fn settings(self, settings: &'static str) -> Self {
        Mode { settings, ..self }
    }

    /// Its system's and its own.
    pub fn name(&self) -> String {
        format!("{} {}", self.system, self.mode)
    }

    /// Whether a sender that is faster than its receiver is held back, rather than losing messages.
    pub fn holds_sender_back(&self, payload_bytes: usize) -> bool {
        // As their settings say.
        match (self.system, self.mode) {
            ("cyclonedds", "shared-memory") => false,
            ("r2r", _) => payload_bytes <= 64 << 10,
            _ => true,
        }
    }
}

const fn own(system: &'static str, mode: &'static str, part: Part) -> Mode {
    Mode { system, mode, program: Program::Own, one_core: false, part, settings: "" }
}

const fn json(system: &'static str, mode: &'static str, part: Part) -> Mode {
    own(system, mode, part).program(Program::Json(system))
}

/// All of them, rivals in question next to each other.
pub const MODES: &[Mode] = &[
    own("floor", "futex", Part::RoundTrips)
        .settings("memory that both processes map; one futex wake each way; the payload is written and read there, from 16 KiB in buffers of 4 MiB together, which are written in turn"),
    own("floor", "streaming", Part::Whole)
        .settings("as futex, but in one buffer each way, which is written with non-temporal stores"),
    own("floor", "ring", Part::Flows)
        .settings("memory that both processes map, with room for 64 messages of any topic, or for 4 MiB of large ones; one futex wake for each; one thread receives all"),
    own("floor", "one-core", Part::RoundTrips).one_core()
        .settings("as futex, with both processes on one core and one buffer each way"),
    own("floor", "memcpy", Part::Copy)
        .settings("a copy of the payload from one buffer to another within a process"),
    own("tautline", "blocking", Part::All)
        .settings("plain message, loaned and read in place; a callback thread at FIFO 50, the sampler at FIFO 60 on the same core; reliable, keep last 10"),
    own("tautline", "direct", Part::All)
        .settings("as blocking, but the publisher wakes the callback thread itself: CallbackOptions::direct_wake"),
    own("tautline", "one-thread", Part::Topics)
        .settings("as direct, but one callback serves the subscriptions of all topics, as a DDS listener's thread does"),
    own("tautline", "direct-spin", Part::RoundTrips)
        .settings("as direct, but each thread looks for 5 µs before it sleeps: in a round trip the answer often comes within, and then nobody sleeps; CallbackOptions::direct_wake().spin(5 µs)"),
    own("tautline", "one-core", Part::RoundTrips).one_core()
        .settings("as blocking, with samplers and callbacks of both processes on one core"),
    own("tautline", "two-cores", Part::RoundTrips)
        .settings("as blocking, but the sampler of each process is on the core of the other"),
    own("tautline", "busy-poll", Part::RoundTrips)
        .settings("as blocking, but the callback thread polls: CallbackOptions::busy_poll"),
    own("tautline", "image", Part::RoundTrips)
        .settings("sensor_msgs/msg/Image, a message of variable size: lengths stated, written in the loan, validated and read in place"),
    own("tautline", "own-default", Part::AsShipped)
        .settings("as blocking, with Tautline's own default about idle states: in real-time mode it holds them off (/dev/cpu_dma_latency)"),
    own("tautline", "gateway", Part::Whole).program(Program::Gateways)
        .settings("as image, in two domains with a gateway (taut gateway) each, which one TCP connection over the loopback joins; each gateway shares the core of its end, its threads at their default, FIFO 80; CPU time and memory without the gateways'"),
    own("tautline", "topics", Part::Requests)
        .settings("as blocking: a message each way on two topics, the answer of 64 B, as all responses"),
    own("tautline", "service", Part::Requests)
        .settings("requests and responses loaned and read in place: nothing is copied"),
    own("tautline", "service-owned", Part::SmallRequests)
        .settings("as service, with owned messages"),
    own("iceoryx2", "waitset", Part::All)
        .settings("loan_slice_uninit, an event per message, a WaitSet, one listener for all subscribers of a process; safe overflow; greatest event id 1, which makes collecting cheap"),
    own("iceoryx2", "busy-poll", Part::RoundTrips)
        .settings("as waitset, but the receiver asks again and again"),
    own("iceoryx2", "request-response", Part::Requests)
        .settings("its request-response, which wakes nobody, with an event each way; greatest event id 1"),
    json("taktora", "items", Part::RoundTrips)
        .settings("taktora-executor 0.6.0 on iceoryx2 0.9: items that their subscriber triggers, run in the executor's own thread (worker_threads 0), a loan per message (Publisher::loan); its channels collect no events, so that an executor which was triggered once does not sleep again: it polls; greatest event id 255; a buffer of 10 by a file of iceoryx2's; its executor at FIFO 50 polls without end and leaves its core to nobody, so only round trips are measured"),
    json("fastdds", "default", Part::All)
        .settings("listener; builtin transports as they come (shared memory with a segment of 512 KiB, and UDP); data sharing off, as in ROS 2; synchronous publishing; reliable, volatile"),
    json("fastdds", "tuned", Part::All)
        .settings("as default, with shared memory alone: segment of 64 MiB, messages of up to 16 MiB without fragments"),
    json("fastdds", "data-sharing", Part::All)
        .settings("as tuned, with a plain type, data sharing and loans on both sides: loan_sample, take of one at a time without a copy, is_sample_valid after it was read (what was written over meanwhile counts as lost), as many extra_samples as the queue has"),
    json("cyclonedds", "default", Part::All)
        .settings("C interface, an array of octets, listener; UDP as it comes; reliable"),
    json("cyclonedds", "tuned", Part::All)
        .settings("as default, on the loopback interface alone, with packets of up to 64 KiB and socket buffers of up to 16 MB"),
    json("cyclonedds", "shared-memory", Part::All).program(Program::Daemon("cyclonedds", ROUDI))
        .settings("as default, its payloads through iceoryx 2.0.3 with loans on both sides (dds_loan_sample, dds_take); its daemon iox-roudi runs without a priority on any core and is not counted; through iceoryx there is no keep all: throughput is with keep last 10"),
    json("r2r", "typed", Part::All)
        .settings("r2r 0.9.7 over rmw_fastrtps_cpp; std_msgs/msg/UInt8MultiArray as a Rust struct; one thread spins and runs the callbacks; the builtin transports as they come; reliable, keep last; throughput at 64 B with keep all, of which rmw_fastrtps holds up to 5,000 whatever is asked for; of 1 MiB that would be 5 GB, so there it is keep last, and loses what the receiver misses"),
    json("r2r", "native", Part::All)
        .settings("as typed, with the C struct: publish_native of a message that is made once, subscribe_native"),
    json("r2r", "loaned", Part::Small)
        .settings("as typed, with a message that rmw_fastrtps lends for each (borrow_loaned_message, ROS_DISABLE_LOANED_MESSAGES=0): geometry_msgs/msg/Inertia, 80 bytes, the first 64 of which are written and read; only types of a fixed size are lent, and those of ROS 2's packages are small"),
    json("r2r", "service", Part::Requests)
        .settings("as typed: test_msgs/srv/BasicTypes, whose text makes the request as long as is asked for and the response 64 B, and is copied"),
    json("zenoh", "tcp", Part::All)
        .settings("zenoh 1.10.2; two peers with one TCP link over the loopback, callbacks, answers from within them, congestion control: block; express; its threads at FIFO 50, too"),
    json("zenoh", "tcp-ordinary", Part::All)
        .settings("as tcp, without real-time priorities: its threads at one priority wake one another for every packet"),
    json("zenoh", "shm", Part::All)
        .settings("as tcp, with payloads in its shared memory, allocated for each message as in z_ping_shm (block until garbage is collected)"),
    json("hiroz", "pub-sub", Part::RoundTrips)
        .settings("hiroz 0.2.1 as in its z_pingpong: a node each, std_msgs/msg/ByteMultiArray, two peers with one TCP link; a buffer for each message that is written whole, else one that is made once; Zenoh's threads at FIFO 80 as the gateway's, above the threads that send and are called back"),
];

/// What a rival does better, whatever the figures say.
pub const STRENGTHS: [(&str, &str); 9] = [
    (
        "iceoryx2",
        "least time where the receiver polls or needs no more than bytes; C, C++, C# and Python bindings; runs without Linux; no process takes part but the two",
    ),
    (
        "taktora",
        "cyclic items on an absolute grid of time, budgets and fault states per item, chains and graphs of items run by a pool of threads",
    ),
    (
        "fastdds",
        "DDS on the wire: interoperates with other vendors; security, content filters, persistence, discovery servers; on networks without any further process; C++ and Python; many platforms",
    ),
    (
        "cyclonedds",
        "DDS on the wire in C with a small footprint; C, C++, Python, Rust bindings; many platforms",
    ),
    (
        "r2r",
        "every RMW of ROS 2 and its whole graph of tools; needs no other middleware than the one that is installed",
    ),
    (
        "zenoh",
        "any topology from microcontroller to cloud, queries and storages, routers, plugins; many languages and platforms",
    ),
    ("hiroz", "ROS 2's graph over Zenoh without a ROS 2 installation and without a gateway"),
    (
        "copper",
        "the whole schedule is compiled ahead; deterministic replay of a run; runs without an operating system",
    ),
    ("dora", "data flows across languages and hosts from one description, Arrow as the format of all data"),
];

/// What else was asked for, and why it is not measured.
pub const NOT_JOINED: [(&str, &str); 2] = [
    (
        "copper",
        "cu29 1.3 runs the tasks of a process in one order and hands messages on within it; what joins two processes are bridges to iceoryx2 and Zenoh, which are measured here themselves",
    ),
    (
        "dora",
        "dora 1.1 starts its nodes itself, from a description of the data flow, through a coordinator and a daemon of its own: no program has been written that measures it so",
    ),
];

/// Names of programs that are no system: the gateway, the one with the demo, and iceoryx's daemon.
pub const GATEWAY: &str = "gateway";
/// See [`GATEWAY`].
pub const TAUT: &str = "taut";
/// See [`GATEWAY`].
pub const ROUDI: &str = "roudi";

/// Where the rivals' programs are, or why they are not.
pub struct Programs {
    paths: BTreeMap<String, PathBuf>,
    missing: BTreeMap<String, String>,
}

impl Programs {
    /// Of `NAME=PATH` and `NAME=REASON`.
    pub fn new(programs: &[String], without: &[String]) -> Result<Self> {
        let split = |text: &String| -> Result<(String, String)> {
            let (name, rest) = text.split_once('=').ok_or_else(|| format!("{text}: not NAME=..."))?;
            let others = [GATEWAY, TAUT, ROUDI];
            if !others.contains(&name) && !SYSTEMS.contains(&name) {
                let names = [&SYSTEMS[..], &others].concat().join(", ");
                return Err(format!("{name} is none of {names}").into());
            }
            Ok((name.to_owned(), rest.to_owned()))
        };
        let paths = programs.iter().map(|text| split(text).map(|(name, path)| (name, path.into())));
        Ok(Programs {
            paths: paths.collect::<Result<_>>()?,
            missing: without.iter().map(split).collect::<Result<_>>()?,
        })
    }

    /// A system's program.
    pub fn find(&self, name: &str) -> std::result::Result<&PathBuf, String> {
        let path = self.paths.get(name);
        path.ok_or_else(|| self.missing.get(name).cloned().unwrap_or_else(|| NOT_BUILT.to_owned()))
    }

    /// What a program says that it was built with.
    pub fn version(&self, name: &str) -> Option<String> {
        let output = Command::new(self.paths.get(name)?).arg("version").output().ok()?;
        let text = String::from_utf8(output.stdout).ok()?;
        Some(text.trim().to_owned()).filter(|text| !text.is_empty())
    }
}

const NOT_BUILT: &str = "its program was not named: cargo xtask bench builds it";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_system_is_measured_or_says_why_not_and_every_rival_has_its_strength() {
        let is_in = |all: &[(&str, &str)], system| all.iter().any(|(name, _)| *name == system);
        assert!(MODES.iter().all(|mode| !mode.settings.is_empty()));
        for system in SYSTEMS {
            let has_modes = MODES.iter().any(|mode| mode.system == system);
            assert_ne!(has_modes, is_in(&NOT_JOINED, system), "{system}");
            assert_eq!(!["floor", "tautline"].contains(&system), is_in(&STRENGTHS, system), "{system}");
        }
        assert!(STRENGTHS.iter().chain(&NOT_JOINED).all(|(name, _)| SYSTEMS.contains(name)));
    }
}
