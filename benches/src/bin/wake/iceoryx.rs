// SPDX-License-Identifier: MIT OR Apache-2.0
//! iceoryx2 as its users write it: a loan per message, and either polling or an event service with a `WaitSet`.

use std::hint::spin_loop;
use std::os::unix::ffi::OsStrExt;

use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::*;
use tautline_rt::clock::monotonic_ns;

use crate::Result;
use crate::child::{Link, Received, WAIT};
use crate::payload;
use crate::plan::{Job, Payload, Role};

/// Runs `body` with a link whose receiver asks again and again.
pub fn run_busy_poll(job: &Job, body: impl FnOnce(&mut dyn Link) -> Result<()>) -> Result<()> {
    let node = node(job)?;
    body(&mut BusyPoll { ports: Ports::open(&node, job)? })
}

/// Runs `body` with a link whose receiver sleeps in a `WaitSet`.
pub fn run_waitset(job: &Job, body: impl FnOnce(&mut dyn Link) -> Result<()>) -> Result<()> {
    let node = node(job)?;
    let ports = Ports::open(&node, job)?;
    let (outgoing, incoming) = directions(job);
    let open_event = |direction: &str| -> Result<_> {
        let name = service_name(job, direction, "event")?;
        // Collecting events costs in proportion to the greatest id: 3 µs at the default of 255.
        let event = node.service_builder(&name).event().event_id_max_value(1);
        Ok(event.max_notifiers(1).max_listeners(1).open_or_create()?)
    };
    let notifier = open_event(outgoing)?.notifier_builder().create()?;
    let listener = open_event(incoming)?.listener_builder().create()?;
    let waitset =
        WaitSetBuilder::new().signal_handling_mode(SignalHandlingMode::Disabled).create::<ipc::Service>()?;
    let _guard = waitset.attach_notification(&listener)?;
    body(&mut WaitSetLink { ports, notifier, listener: &listener, waitset: &waitset })
}

struct BusyPoll {
    ports: Ports,
}

impl Link for BusyPoll {
    fn send(&mut self, number: u64) -> Result<()> {
        self.ports.send(number)
    }

    fn receive(&mut self) -> Result<Option<Received>> {
        let end_ns = monotonic_ns() + u64::from(WAIT.subsec_nanos());
        loop {
            // The clock is looked at too seldom to slow the polling down.
            for _ in 0..1024 {
                if let Some(number) = self.ports.receive()? {
                    return Ok(Some(Received { number, late: false }));
                }
                spin_loop();
            }
            if monotonic_ns() > end_ns {
                return Ok(None);
            }
        }
    }
}

struct WaitSetLink<'a> {
    ports: Ports,
    notifier: Notifier<ipc::Service>,
    listener: &'a Listener<ipc::Service>,
    waitset: &'a WaitSet<ipc::Service>,
}

impl Link for WaitSetLink<'_> {
    fn send(&mut self, number: u64) -> Result<()> {
        self.ports.send(number)?;
        self.notifier.notify()?;
        Ok(())
    }

    fn receive(&mut self) -> Result<Option<Received>> {
        loop {
            let mut woken = false;
            let on_event = |_| {
                woken = true;
                CallbackProgression::Continue
            };
            self.waitset.wait_and_process_once_with_timeout(on_event, WAIT)?;
            // Until none is left: iceoryx2 0.10 stops waking a listener that collects once per wake-up.
            while self.listener.try_wait(|_| {})? > 0 {}
            match self.ports.receive()? {
                Some(number) => return Ok(Some(Received { number, late: !woken })),
                None if woken => {}
                None => return Ok(None),
            }
        }
    }
}

struct Ports {
    publisher: Publisher<ipc::Service, [u8], ()>,
    subscriber: Subscriber<ipc::Service, [u8], ()>,
    payload: Payload,
}

impl Ports {
    fn open(node: &Node<ipc::Service>, job: &Job) -> Result<Self> {
        let (outgoing, incoming) = directions(job);
        let open_topic = |direction: &str| -> Result<_> {
            let name = service_name(job, direction, "topic")?;
            let topic = node.service_builder(&name).publish_subscribe::<[u8]>();
            let topic = topic.payload_alignment(Alignment::new(8).ok_or("8 is a power of two")?);
            Ok(topic.max_publishers(1).max_subscribers(1).subscriber_max_buffer_size(2).open_or_create()?)
        };
        let publisher = open_topic(outgoing)?
            .publisher_builder()
            .initial_max_slice_len(job.payload.bytes)
            .allocation_strategy(AllocationStrategy::Static)
            .create()?;
        let subscriber = open_topic(incoming)?.subscriber_builder().create()?;
        Ok(Self { publisher, subscriber, payload: job.payload })
    }

    fn send(&self, number: u64) -> Result<()> {
        let mut loan = self.publisher.loan_slice_uninit(self.payload.bytes)?;
        payload::write(loan.payload_mut(), self.payload, number);
        // SAFETY: shared memory that the kernel zeroed when it was made; an untouched payload leaves it so, and its
        // receiver reads the first 8 bytes, which are written.
        unsafe { loan.assume_init() }.send()?;
        Ok(())
    }

    fn receive(&self) -> Result<Option<u64>> {
        let Some(sample) = self.subscriber.receive()? else { return Ok(None) };
        payload::read(sample.payload(), self.payload).map(Some)
    }
}

/// A node that shares nothing with other users of iceoryx2 on this machine.
fn node(job: &Job) -> Result<Node<ipc::Service>> {
    set_log_level(LogLevel::Error);
    let mut config = Config::default();
    config.global.prefix = FileName::new(job.prefix.as_bytes())?;
    config.global.set_root_path(&Path::new(job.directory.as_os_str().as_bytes())?);
    Ok(NodeBuilder::new()
        .config(&config)
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .create::<ipc::Service>()?)
}

/// The outgoing and the incoming one.
fn directions(job: &Job) -> (&'static str, &'static str) {
    match job.role {
        Role::Ping => ("ping", "pong"),
        Role::Pong => ("pong", "ping"),
    }
}

fn service_name(job: &Job, direction: &str, kind: &str) -> Result<ServiceName> {
    Ok(ServiceName::new(&format!("wake/{}/{direction}/{kind}", job.pair))?)
}
