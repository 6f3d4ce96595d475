// SPDX-License-Identifier: MIT OR Apache-2.0
//! iceoryx2 as its users write it: a loan per message, and either polling or an event service with a `WaitSet`.

use std::hint::spin_loop;
use std::os::unix::ffi::OsStrExt;
use std::path::Path as FilePath;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use iceoryx2::active_request::ActiveRequest;
use iceoryx2::pending_response::PendingResponse;
use iceoryx2::port::client::Client;
use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::server::Server;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::*;
use tautline_exchange::{
    Exchange, Inlet, Job, Line, Link, Result, Role, Sink, Source, Stamp, play, say, stop_flag,
};
use tautline_rt::clock::monotonic_ns;

use super::LOOK;

type Service = ipc::Service;

/// Runs one end. The job's endpoint is the directory of its files, whose name starts those in shared memory.
pub fn run(job: &Job) -> Result<()> {
    if job.exchange != Exchange::RoundTrips {
        return flow(job);
    }
    with_node(job, |node, job, stop| match job.role {
        _ if job.way.mode != "request-response" => round_trips(node, job, &stop),
        Role::Near => play(job, &mut Asking::open(node, job)?, &stop, None),
        Role::Far => play(job, &mut Answering::open(node, job)?, &stop, job.endpoint.clone()),
    })
}

/// Runs one end of a flow.
pub fn flow(job: &Job) -> Result<()> {
    with_node(job, |node, job, stop| match job.role {
        Role::Near => send_flow(node, job, stop),
        Role::Far => receive_flow(node, job, &stop),
    })
}

fn with_node(job: &Job, run: fn(&Node<Service>, &Job, Arc<AtomicBool>) -> Result<()>) -> Result<()> {
    // Before there is a thread that polls on this core.
    let (own, stop) = (job.clone(), stop_flag());
    job.as_application(move || run(&node(&own)?, &own, stop))
}

fn round_trips(node: &Node<Service>, job: &Job, stop: &AtomicBool) -> Result<()> {
    let [to, from] = job.topics();
    let (out, input) = (Outlet::open(node, job, &to)?, node.input(job, &from)?);
    let listening = match input.listener {
        Some(_) => Some(waitset()?),
        None => None,
    };
    let guard = match (&listening, &input.listener) {
        (Some(waitset), Some(listener)) => Some(waitset.attach_notification(listener)?),
        _ => None,
    };
    let mut end = End { out, input: &input, waitset: listening.as_ref(), whole: job.way.whole };
    let played = play(job, &mut end, stop, job.endpoint.clone());
    drop(guard);
    played
}

fn send_flow(node: &Node<Service>, job: &Job, stop: Arc<AtomicBool>) -> Result<()> {
    let open = |index| Outlet::open(node, job, &format!("{}/{index}", job.topic));
    let outlets = (0..job.way.topics).map(open).collect::<Result<Vec<_>>>()?;
    Source::play(job, stop, |topic, stamp| outlets[topic].send(stamp, job.way.whole))?;
    // What it sent is read from its memory.
    std::thread::sleep(LOOK);
    Ok(())
}

fn receive_flow(node: &Node<Service>, job: &Job, stop: &AtomicBool) -> Result<()> {
    let sink = Sink::new(job);
    let mut inputs: Vec<Topic> = Vec::new();
    for (topic, inlet) in sink.inlets(job) {
        let name = format!("{}/{topic}", job.topic);
        match inputs.get_mut(topic) {
            // One listener for all subscribers of a process.
            Some(shared) => shared.more.push((node.subscriber(job, &name)?, inlet)),
            None => inputs.push(Topic { input: node.input(job, &name)?, inlet, more: Vec::new() }),
        }
    }
    say(&Line::Ready(job.endpoint.clone()));
    if job.way.mode == BUSY_POLL {
        poll(&inputs, job, stop)?;
    } else {
        wait(&inputs, job, stop)?;
    }
    say(&Line::Measured(sink.measured()));
    Ok(())
}

/// A topic's subscribers in this process.
struct Topic {
    input: Input,
    inlet: Inlet,
    more: Vec<(Reader, Inlet)>,
}

impl Topic {
    fn take_all(&self, whole: bool) -> Result<()> {
        let more = self.more.iter().map(|(subscriber, inlet)| (subscriber, inlet));
        for (subscriber, inlet) in std::iter::once((&self.input.subscriber, &self.inlet)).chain(more) {
            while let Some(stamp) = take(subscriber, whole)? {
                inlet.arrive(stamp);
            }
        }
        Ok(())
    }
}

fn poll(inputs: &[Topic], job: &Job, stop: &AtomicBool) -> Result<()> {
    while !stop.load(Ordering::Relaxed) {
        for topic in inputs {
            topic.take_all(job.way.whole)?;
        }
        spin_loop();
    }
    Ok(())
}

fn wait(inputs: &[Topic], job: &Job, stop: &AtomicBool) -> Result<()> {
    let waitset = waitset()?;
    let mut guards = Vec::new();
    for topic in inputs {
        let listener = topic.input.listener.as_ref().ok_or("no listener")?;
        guards.push((waitset.attach_notification(listener)?, listener, topic));
    }
    while !stop.load(Ordering::Relaxed) {
        let mut failed = None;
        let on_event = |id: WaitSetAttachmentId<Service>| {
            let woken = guards.iter().find(|(guard, ..)| id.has_event_from(guard));
            if let (None, Some((_, listener, topic))) = (&failed, woken) {
                failed = collect(listener, topic, job.way.whole).err();
            }
            CallbackProgression::Continue
        };
        waitset.wait_and_process_once_with_timeout(on_event, LOOK)?;
        if let Some(error) = failed {
            return Err(error);
        }
    }
    Ok(())
}

fn collect(listener: &Listener<Service>, topic: &Topic, whole: bool) -> Result<()> {
    // Until none is left: iceoryx2 0.10 stops waking a listener that collects once per wake-up.
    while listener.try_wait(|_| {})? > 0 {}
    topic.take_all(whole)
}

const BUSY_POLL: &str = "busy-poll";

struct End<'a> {
    out: Outlet,
    input: &'a Input,
    /// `None`: it polls.
    waitset: Option<&'a WaitSet<Service>>,
    whole: bool,
}

impl Link for End<'_> {
    fn send(&mut self, number: u64) -> Result<()> {
        self.out.send(Stamp { number, sent_ns: monotonic_ns() }, self.whole)
    }

    fn receive(&mut self, patience: Duration) -> Result<Option<u64>> {
        let end_ns = monotonic_ns() + patience.as_nanos() as u64;
        loop {
            match (self.waitset, &self.input.listener) {
                (Some(waitset), Some(listener)) => {
                    let proceed = |_| CallbackProgression::Continue;
                    waitset.wait_and_process_once_with_timeout(proceed, patience)?;
                    while listener.try_wait(|_| {})? > 0 {}
                    if let Some(stamp) = self.input.take(self.whole)? {
                        return Ok(Some(stamp.number));
                    }
                }
                // The clock is looked at too seldom to slow the polling down.
                _ => {
                    for _ in 0..1024 {
                        if let Some(stamp) = self.input.take(self.whole)? {
                            return Ok(Some(stamp.number));
                        }
                        spin_loop();
                    }
                }
            }
            if monotonic_ns() > end_ns {
                return Ok(None);
            }
        }
    }
}

/// The first word of a request and of its response is its number.
type Response = [u64; 8];

/// Its request-response wakes nobody: an event service each way does.
struct Bells {
    notifier: Notifier<Service>,
    listener: Listener<Service>,
}

impl Bells {
    fn open(node: &Node<Service>, job: &Job) -> Result<Self> {
        let [to, from] = job.topics();
        let notifier = node.event(job, &to)?.notifier_builder().create()?;
        Ok(Bells { notifier, listener: node.event(job, &from)?.listener_builder().create()? })
    }

    /// Waits until `look` finds something, at most so long.
    fn wait<T>(&self, patience: Duration, mut look: impl FnMut() -> Result<Option<T>>) -> Result<Option<T>> {
        let end_ns = monotonic_ns() + patience.as_nanos() as u64;
        loop {
            let found = look()?;
            if found.is_some() || monotonic_ns() > end_ns {
                return Ok(found);
            }
            self.listener.timed_wait(|_| {}, patience)?;
            while self.listener.try_wait(|_| {})? > 0 {}
        }
    }
}

type Requests =
    iceoryx2::service::port_factory::request_response::PortFactory<Service, [u64], (), Response, ()>;

fn requests(node: &Node<Service>, job: &Job) -> Result<Requests> {
    let service = node.service_builder(&ServiceName::new(&format!("{}/ask", job.topic))?);
    let service = service.request_response::<[u64], Response>().max_clients(1).max_servers(1);
    Ok(service.open_or_create()?)
}

struct Asking {
    client: Client<Service, [u64], (), Response, ()>,
    pending: Option<PendingResponse<Service, [u64], (), Response, ()>>,
    bells: Bells,
    words: usize,
}

impl Asking {
    fn open(node: &Node<Service>, job: &Job) -> Result<Self> {
        let words = job.payload_bytes / 8;
        let requests = requests(node, job)?;
        let client = requests.client_builder().initial_max_slice_len(words);
        let client = client.allocation_strategy(AllocationStrategy::Static).create()?;
        Ok(Asking { client, pending: None, bells: Bells::open(node, job)?, words })
    }
}

impl Link for Asking {
    fn send(&mut self, number: u64) -> Result<()> {
        let mut request = self.client.loan_slice_uninit(self.words)?;
        request.payload_mut()[0].write(number);
        // SAFETY: zeroed by the kernel, or written before.
        self.pending = Some(unsafe { request.assume_init() }.send()?);
        Ok(self.bells.notifier.notify().map(drop)?)
    }

    fn receive(&mut self, patience: Duration) -> Result<Option<u64>> {
        let pending = self.pending.as_ref().ok_or("nothing was asked")?;
        self.bells.wait(patience, || Ok(pending.receive()?.map(|response| response[0])))
    }
}

struct Answering {
    server: Server<Service, [u64], (), Response, ()>,
    request: Option<ActiveRequest<Service, [u64], (), Response, ()>>,
    bells: Bells,
}

impl Answering {
    fn open(node: &Node<Service>, job: &Job) -> Result<Self> {
        let server = requests(node, job)?.server_builder().create()?;
        Ok(Answering { server, request: None, bells: Bells::open(node, job)? })
    }
}

impl Link for Answering {
    fn send(&mut self, number: u64) -> Result<()> {
        let request = self.request.take().ok_or("nobody has asked")?;
        let mut answer = Response::default();
        answer[0] = number;
        request.loan_uninit()?.write_payload(answer).send()?;
        Ok(self.bells.notifier.notify().map(drop)?)
    }

    fn receive(&mut self, patience: Duration) -> Result<Option<u64>> {
        self.request = self.bells.wait(patience, || Ok(self.server.receive()?))?;
        Ok(self.request.as_ref().map(|request| request[0]))
    }
}

fn waitset() -> Result<WaitSet<Service>> {
    Ok(WaitSetBuilder::new().signal_handling_mode(SignalHandlingMode::Disabled).create::<Service>()?)
}

struct Outlet {
    publisher: Publisher<Service, [u8], ()>,
    notifier: Option<Notifier<Service>>,
    bytes: usize,
}

impl Outlet {
    fn open(node: &Node<Service>, job: &Job, topic: &str) -> Result<Self> {
        let factory = node.topic(job, topic)?;
        let publisher = factory.publisher_builder().initial_max_slice_len(job.payload_bytes);
        let publisher = publisher.allocation_strategy(AllocationStrategy::Static).create()?;
        let notifier = match job.way.mode == BUSY_POLL {
            true => None,
            false => Some(node.event(job, topic)?.notifier_builder().create()?),
        };
        Ok(Outlet { publisher, notifier, bytes: job.payload_bytes })
    }

    fn send(&self, stamp: Stamp, whole: bool) -> Result<()> {
        let mut loan = self.publisher.loan_slice_uninit(self.bytes)?;
        stamp.write_uninit(loan.payload_mut(), whole);
        // SAFETY: shared memory that the kernel zeroed when it was made; a payload that is not written whole leaves the rest
        // so, and its receiver reads the stamp, which is written.
        unsafe { loan.assume_init() }.send()?;
        if let Some(notifier) = &self.notifier {
            notifier.notify()?;
        }
        Ok(())
    }
}

struct Input {
    subscriber: Reader,
    listener: Option<Listener<Service>>,
}

impl Input {
    fn take(&self, whole: bool) -> Result<Option<Stamp>> {
        take(&self.subscriber, whole)
    }
}

fn take(subscriber: &Reader, whole: bool) -> Result<Option<Stamp>> {
    match subscriber.receive()? {
        Some(sample) => Stamp::read(sample.payload(), whole).map(Some),
        None => Ok(None),
    }
}

type Reader = Subscriber<Service, [u8], ()>;
type Data = iceoryx2::service::port_factory::publish_subscribe::PortFactory<Service, [u8], ()>;
type Event = iceoryx2::service::port_factory::event::PortFactory<Service>;

/// How many subscribers a topic may have.
fn readers(job: &Job) -> usize {
    job.way.processes.max(16)
}

trait Open {
    fn topic(&self, job: &Job, name: &str) -> Result<Data>;
    fn event(&self, job: &Job, name: &str) -> Result<Event>;
    fn subscriber(&self, job: &Job, name: &str) -> Result<Reader>;
    fn input(&self, job: &Job, name: &str) -> Result<Input>;
}

impl Open for Node<Service> {
    fn topic(&self, job: &Job, name: &str) -> Result<Data> {
        let name = ServiceName::new(&format!("{name}/topic"))?;
        let topic = self.service_builder(&name).publish_subscribe::<[u8]>();
        let topic = topic.payload_alignment(Alignment::new(8).ok_or("8 is a power of two")?);
        let topic = match job.exchange {
            // Holds the sender back instead of overwriting.
            Exchange::Stream { .. } => topic.enable_safe_overflow(false),
            _ => topic,
        };
        let topic = topic.subscriber_max_buffer_size(job.depth());
        Ok(topic
            .max_publishers(1)
            .max_subscribers(readers(job))
            .max_nodes(readers(job) + 4)
            .open_or_create()?)
    }

    fn event(&self, job: &Job, name: &str) -> Result<Event> {
        let name = ServiceName::new(&format!("{name}/event"))?;
        // Collecting events costs in proportion to the greatest id: 3 µs at the default of 255.
        let event = self.service_builder(&name).event().event_id_max_value(1);
        Ok(event.max_notifiers(1).max_listeners(readers(job)).max_nodes(readers(job) + 4).open_or_create()?)
    }

    fn subscriber(&self, job: &Job, name: &str) -> Result<Reader> {
        Ok(self.topic(job, name)?.subscriber_builder().create()?)
    }

    fn input(&self, job: &Job, name: &str) -> Result<Input> {
        let subscriber = self.subscriber(job, name)?;
        let listener = match job.way.mode == BUSY_POLL {
            true => None,
            false => Some(self.event(job, name)?.listener_builder().create()?),
        };
        Ok(Input { subscriber, listener })
    }
}

/// A node that shares nothing with other users of iceoryx2 on this machine.
fn node(job: &Job) -> Result<Node<Service>> {
    set_log_level(LogLevel::Error);
    let directory = FilePath::new(job.endpoint.as_deref().ok_or("no directory for files")?);
    let prefix = directory.file_name().ok_or("the directory has no name")?;
    let mut config = Config::default();
    config.global.prefix = FileName::new(prefix.as_bytes())?;
    config.global.set_root_path(&Path::new(directory.as_os_str().as_bytes())?);
    Ok(NodeBuilder::new()
        .config(&config)
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .create::<Service>()?)
}
