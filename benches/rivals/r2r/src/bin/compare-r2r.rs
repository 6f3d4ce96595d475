// SPDX-License-Identifier: MIT OR Apache-2.0
//! r2r as its examples have it: one thread that spins and runs its callbacks; `std_msgs/msg/UInt8MultiArray`.
//!
//! `typed`: messages are Rust structs. `native`: messages are the middleware's C structs, made once and written and read in
//! place. `loaned`: a new one for each message, lent by the middleware, which does so for types of a fixed size alone:
//! `geometry_msgs/msg/Inertia`, ten numbers of 8 bytes, of which the first eight carry 64 B. `service`: `test_msgs/srv/BasicTypes`,
//! numbers, one of which counts, and a text that makes the request as long as the job says and the response 64 bytes.

use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use futures::future::LocalBoxFuture;
use futures::stream::LocalBoxStream;
use futures::{FutureExt, Stream, StreamExt};
use r2r::geometry_msgs::msg::Inertia;
use r2r::std_msgs::msg::UInt8MultiArray;
use r2r::test_msgs::srv::BasicTypes;
use r2r::{Client, Context, Node, QosProfile, ServiceRequest};
use tautline_exchange::{
    Exchange, Inlet, Job, Line, Link, Result, Role, Sink, Source, Stamp, play, program, say, stop_flag,
};
use tautline_rt::clock::monotonic_ns;

/// How often it is looked whether the end has come.
const LOOK: Duration = Duration::from_millis(50);

/// What of a request is no text, in CDR.
const NUMBERS_BYTES: usize = 61;

fn main() -> ExitCode {
    if std::env::args().nth(1).as_deref() == Some("version") {
        println!("{}", rival_r2r::version().unwrap_or_default());
        return ExitCode::SUCCESS;
    }
    program("compare-r2r", |job| run(&job))
}

fn run(job: &Job) -> Result<()> {
    let (own, stop) = (job.clone(), stop_flag());
    // The middleware's threads inherit the priority.
    job.as_application(move || {
        let name = if own.role == Role::Near { "near" } else { "far" };
        let node = Node::create(Context::create()?, name, "")?;
        match (own.exchange, own.role) {
            (Exchange::RoundTrips, Role::Near) if own.way.mode == "service" => {
                play(&own, &mut Asking::new(node, &own)?, &stop, None)
            }
            (Exchange::RoundTrips, Role::Far) if own.way.mode == "service" => {
                play(&own, &mut Answering::new(node, &own)?, &stop, None)
            }
            (Exchange::RoundTrips, _) => round_trips(node, &own, &stop),
            (_, Role::Near) => send_flow(node, &own, stop),
            (_, Role::Far) => receive_flow(node, &own, &stop),
        }
    })
}

fn round_trips(mut node: Node, job: &Job, stop: &AtomicBool) -> Result<()> {
    let [to, from] = job.topics();
    let (out, input) = (Outlet::new(&mut node, job, &to)?, stamps(&mut node, job, &from)?);
    let mut end = End { node, out, input };
    play(job, &mut end, stop, None)
}

fn send_flow(mut node: Node, job: &Job, stop: Arc<AtomicBool>) -> Result<()> {
    let open = |index| Outlet::new(&mut node, job, &format!("{}/t{index}", job.topic));
    let mut outlets = (0..job.way.topics).map(open).collect::<Result<Vec<_>>>()?;
    Source::play(job, stop, |topic, stamp| outlets[topic].send(stamp))?;
    // What is under way is repeated from its history.
    std::thread::sleep(LOOK * 2);
    Ok(())
}

fn receive_flow(mut node: Node, job: &Job, stop: &AtomicBool) -> Result<()> {
    let sink = Sink::new(job);
    let mut inputs: Vec<(Input, Inlet)> = Vec::new();
    for (topic, inlet) in sink.inlets(job) {
        inputs.push((stamps(&mut node, job, &format!("{}/t{topic}", job.topic))?, inlet));
    }
    say(&Line::Ready(None));
    while !stop.load(Ordering::Relaxed) {
        node.spin_once(LOOK);
        let mut is_idle = true;
        for (input, inlet) in &mut inputs {
            while let Some(Some(stamp)) = input.next().now_or_never() {
                inlet.arrive(stamp?);
                is_idle = false;
            }
        }
        if is_idle {
            // Fast DDS may say that there is a message as long as its own threads have not had their turn, which at the same
            // priority and on the same core they get from nobody else.
            std::thread::yield_now();
        }
    }
    say(&Line::Measured(sink.measured()));
    Ok(())
}

struct End {
    node: Node,
    out: Outlet,
    input: Input,
}

impl Link for End {
    fn send(&mut self, number: u64) -> Result<()> {
        self.out.send(Stamp { number, sent_ns: monotonic_ns() })
    }

    fn receive(&mut self, patience: Duration) -> Result<Option<u64>> {
        let stamp = spin_until(&mut self.node, patience, || self.input.next().now_or_never().flatten());
        Ok(stamp.transpose()?.map(|stamp| stamp.number))
    }
}

/// Spins until there is something, at most so long.
fn spin_until<T>(node: &mut Node, patience: Duration, mut look: impl FnMut() -> Option<T>) -> Option<T> {
    let end_ns = monotonic_ns() + patience.as_nanos() as u64;
    loop {
        let (found, now) = (look(), monotonic_ns());
        if found.is_some() || now >= end_ns {
            return found;
        }
        node.spin_once(Duration::from_nanos(end_ns - now));
    }
}

fn text(message_bytes: usize) -> String {
    "x".repeat(message_bytes.saturating_sub(NUMBERS_BYTES))
}

struct Asking {
    node: Node,
    client: Client<BasicTypes::Service>,
    request: BasicTypes::Request,
    response: Option<LocalBoxFuture<'static, r2r::Result<BasicTypes::Response>>>,
}

impl Asking {
    fn new(mut node: Node, job: &Job) -> Result<Self> {
        let client = node.create_client::<BasicTypes::Service>(&job.topic, QosProfile::default())?;
        let request = BasicTypes::Request { string_value: text(job.payload_bytes), ..Default::default() };
        Ok(Asking { node, client, request, response: None })
    }
}

impl Link for Asking {
    fn send(&mut self, number: u64) -> Result<()> {
        self.request.uint64_value = number;
        self.response = Some(self.client.request(&self.request)?.boxed_local());
        Ok(())
    }

    fn receive(&mut self, patience: Duration) -> Result<Option<u64>> {
        let response = self.response.as_mut().ok_or("nothing was asked")?;
        let answer = spin_until(&mut self.node, patience, || response.now_or_never());
        Ok(answer.transpose()?.map(|answer| answer.uint64_value))
    }
}

type Request = ServiceRequest<BasicTypes::Service>;

struct Answering {
    node: Node,
    requests: Box<dyn Stream<Item = Request> + Unpin>,
    request: Option<Request>,
}

impl Answering {
    fn new(mut node: Node, job: &Job) -> Result<Self> {
        let requests = node.create_service::<BasicTypes::Service>(&job.topic, QosProfile::default())?;
        Ok(Answering { node, requests: Box::new(requests), request: None })
    }
}

impl Link for Answering {
    fn send(&mut self, number: u64) -> Result<()> {
        let request = self.request.take().ok_or("nobody has asked")?;
        let response =
            BasicTypes::Response { uint64_value: number, string_value: text(64), ..Default::default() };
        Ok(request.respond(response)?)
    }

    fn receive(&mut self, patience: Duration) -> Result<Option<u64>> {
        let Answering { node, requests, .. } = self;
        self.request = spin_until(node, patience, || requests.next().now_or_never().flatten());
        Ok(self.request.as_ref().map(|request| request.message.uint64_value))
    }
}

fn qos(job: &Job) -> QosProfile {
    let profile = QosProfile::default().reliable();
    match job.exchange {
        // Holds the sender back instead of overwriting. The RMW then keeps up to 5,000, which nothing here bounds: of large
        // ones that is all of the memory.
        Exchange::Stream { .. } if job.payload_bytes <= 64 << 10 => profile.keep_all(),
        _ => profile.keep_last(job.depth()),
    }
}

/// A publisher and its message, made once.
struct Outlet {
    send: Box<dyn FnMut(Stamp) -> Result<()>>,
}

impl Outlet {
    fn new(node: &mut Node, job: &Job, topic: &str) -> Result<Self> {
        if job.way.mode == "loaned" {
            return Self::of_loans(node, job, topic);
        }
        let mut message = UInt8MultiArray { data: vec![0; job.payload_bytes], ..Default::default() };
        let publisher = node.create_publisher::<UInt8MultiArray>(topic, qos(job))?;
        let whole = job.way.whole;
        if !is_native(job) {
            let send = move |stamp: Stamp| {
                stamp.write(&mut message.data, whole);
                Ok(publisher.publish(&message)?)
            };
            return Ok(Outlet { send: Box::new(send) });
        }
        // Of a type that cannot be loaned this is memory of its own.
        let mut native = publisher.borrow_loaned_message()?;
        native.data.update(&message.data);
        let send = move |stamp: Stamp| {
            // SAFETY: a sequence owns `size` bytes at `data`, and nobody else has this one.
            let bytes = unsafe { std::slice::from_raw_parts_mut(native.data.data, native.data.size) };
            stamp.write(bytes, whole);
            Ok(publisher.publish_native(&mut native)?)
        };
        Ok(Outlet { send: Box::new(send) })
    }

    /// Of a message that the middleware lends for each.
    fn of_loans(node: &mut Node, job: &Job, topic: &str) -> Result<Self> {
        let publisher = node.create_publisher::<Inertia>(topic, qos(job))?;
        let (bytes, whole) = (job.payload_bytes, job.way.whole);
        let send = move |stamp: Stamp| {
            let mut loan = publisher.borrow_loaned_message()?;
            if !loan.is_loaned {
                return Err("the middleware lends no messages of geometry_msgs/msg/Inertia".into());
            }
            if bytes > size_of_val(&*loan) {
                return Err(format!("geometry_msgs/msg/Inertia carries no {bytes} bytes").into());
            }
            // SAFETY: numbers without padding, and more bytes of them than these; nobody else has this loan.
            let out = unsafe { std::slice::from_raw_parts_mut(loan.msg.cast::<u8>(), bytes) };
            stamp.write(out, whole);
            Ok(publisher.publish_native(&mut loan)?)
        };
        Ok(Outlet { send: Box::new(send) })
    }

    fn send(&mut self, stamp: Stamp) -> Result<()> {
        (self.send)(stamp)
    }
}

fn is_native(job: &Job) -> bool {
    job.way.mode == "native"
}

type Input = LocalBoxStream<'static, Result<Stamp>>;

/// What is read of the messages of a topic.
fn stamps(node: &mut Node, job: &Job, topic: &str) -> Result<Input> {
    let (whole, bytes) = (job.way.whole, job.payload_bytes);
    if job.way.mode == "loaned" {
        let messages = node.subscribe_native::<Inertia>(topic, qos(job))?;
        let stamps = messages.map(move |message| {
            // SAFETY: numbers without padding, and more bytes of them than the sender accepts.
            let bytes = unsafe { std::slice::from_raw_parts(message.msg.cast::<u8>(), bytes) };
            Stamp::read(bytes, whole)
        });
        return Ok(stamps.boxed_local());
    }
    Ok(if is_native(job) {
        let messages = node.subscribe_native::<UInt8MultiArray>(topic, qos(job))?;
        let stamps = messages.map(move |message| {
            // SAFETY: a sequence owns `size` bytes at `data`.
            let bytes = unsafe { std::slice::from_raw_parts(message.data.data, message.data.size) };
            Stamp::read(bytes, whole)
        });
        stamps.boxed_local()
    } else {
        let messages = node.subscribe::<UInt8MultiArray>(topic, qos(job))?;
        messages.map(move |message| Stamp::read(&message.data, whole)).boxed_local()
    })
}
