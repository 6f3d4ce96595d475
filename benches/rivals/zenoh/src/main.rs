// SPDX-License-Identifier: MIT OR Apache-2.0
//! Zenoh as its examples have it: peers with direct TCP links, publishers that wait for the link, express, answers from
//! within the callback. `shm`: payloads in its shared memory, allocated for each message as in `z_ping_shm`.

use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::sync::mpsc;
use std::time::Duration;

use tautline_exchange::{
    Arrivals, Error, Exchange, Job, Line, Link, Result, Role, Sink, Source, Stamp, drive, program, say,
    stop_flag, wait_for_stop,
};
use tautline_rt::clock::monotonic_ns;
use zenoh::bytes::ZBytes;
use zenoh::pubsub::{Publisher, Subscriber};
use zenoh::qos::CongestionControl;
use zenoh::sample::Sample;
use zenoh::shm::{BlockOn, GarbageCollect, PosixShmProviderBackend, ShmProvider, ShmProviderBuilder};
use zenoh::{Config, Session, Wait};

/// Messages that its shared memory has room for.
const POOL: usize = 16;
/// How long what is under way may take to arrive.
const DRAIN: Duration = Duration::from_millis(100);

fn main() -> ExitCode {
    program("rival-zenoh", run)
}

fn run(mut job: Job) -> Result<()> {
    // Its threads at one real-time priority wake one another for every packet.
    job.realtime &= job.way.mode != "tcp-ordinary";
    let (own, stop) = (job.clone(), stop_flag());
    // Zenoh's threads inherit the priority.
    job.as_application(move || {
        let session = zenoh::open(config(&own)?).wait().map_err(text)?;
        match (own.exchange, own.role) {
            (Exchange::Stream { window: None } | Exchange::Paced { .. }, Role::Near) => {
                send_flow(&session, &own, stop)
            }
            (Exchange::Stream { window: None } | Exchange::Paced { .. }, Role::Far) => {
                receive_flow(&session, &own, &stop)
            }
            (_, Role::Near) => ask(&session, &own),
            (_, Role::Far) => answer(&session, &own, &stop),
        }
    })
}

fn config(job: &Job) -> Result<Config> {
    let endpoints = job.endpoint.iter().flat_map(|all| all.split(','));
    let connect: Vec<String> = endpoints.map(|endpoint| format!("\"{endpoint}\"")).collect();
    let config = format!(
        r#"{{ mode: "peer", listen: {{ endpoints: ["tcp/127.0.0.1:0"] }}, connect: {{ endpoints: [{}] }},
             scouting: {{ multicast: {{ enabled: false }} }},
             transport: {{ shared_memory: {{ enabled: {} }} }} }}"#,
        connect.join(", "),
        job.way.mode == "shm"
    );
    Config::from_json5(&config).map_err(text)
}

fn text(error: zenoh::Error) -> Error {
    error.to_string().into()
}

/// Zenoh's keys do not begin with a slash.
fn key(topic: &str) -> String {
    topic.trim_start_matches('/').to_owned()
}

fn ready(session: &Session) {
    let locators = session.info().locators().wait();
    say(&Line::Ready(locators.first().map(ToString::to_string)));
}

/// Sends messages.
struct Outlet {
    publisher: Publisher<'static>,
    bytes: usize,
    whole: bool,
    /// What is not written again of a payload that is not written whole, as in `z_ping`.
    rest: ZBytes,
    pool: Option<Arc<ShmProvider<PosixShmProviderBackend>>>,
}

impl Outlet {
    fn new(
        session: &Session,
        job: &Job,
        topic: &str,
        pool: Option<Arc<ShmProvider<PosixShmProviderBackend>>>,
    ) -> Result<Self> {
        let publisher = session.declare_publisher(key(topic)).congestion_control(CongestionControl::Block);
        // A stream fills its packets: as `z_pub_thr`.
        let publisher = publisher.express(!matches!(job.exchange, Exchange::Stream { .. }));
        Ok(Outlet {
            publisher: publisher.wait().map_err(text)?,
            bytes: job.payload_bytes,
            whole: job.way.whole,
            rest: vec![0; job.payload_bytes - Stamp::BYTES].into(),
            pool,
        })
    }

    fn send(&self, stamp: Stamp) -> Result<()> {
        let payload = match &self.pool {
            Some(pool) => {
                let buffer = pool.alloc(self.bytes).with_policy::<BlockOn<GarbageCollect>>().wait();
                let mut buffer = buffer.map_err(|error| format!("no shared memory: {error:?}"))?;
                stamp.write(&mut buffer, self.whole);
                buffer.into()
            }
            None if self.whole => stamp.written(self.bytes).into(),
            None => {
                let mut first = vec![0; Stamp::BYTES];
                stamp.write(&mut first, false);
                let mut payload = ZBytes::writer();
                payload.append(first.into());
                payload.append(self.rest.clone());
                payload.finish()
            }
        };
        self.publisher.put(payload).wait().map_err(text)
    }
}

/// Shared memory for the messages of this process.
fn pool(job: &Job) -> Result<Option<Arc<ShmProvider<PosixShmProviderBackend>>>> {
    if job.way.mode != "shm" {
        return Ok(None);
    }
    let bytes = job.payload_bytes.next_multiple_of(4096) * POOL;
    let pool = ShmProviderBuilder::default_backend(bytes).wait();
    Ok(Some(Arc::new(pool.map_err(|error| format!("no shared memory: {error:?}"))?)))
}

/// In place where it lies in one piece, as in shared memory.
fn stamp(sample: &Sample, job: &Job) -> Result<Stamp> {
    if job.way.whole {
        return Stamp::read(&sample.payload().to_bytes(), true);
    }
    let mut first = [0; Stamp::BYTES];
    let mut rest = &mut first[..];
    for slice in sample.payload().slices() {
        let len = slice.len().min(rest.len());
        let (head, tail) = std::mem::take(&mut rest).split_at_mut(len);
        head.copy_from_slice(&slice[..len]);
        rest = tail;
        if rest.is_empty() {
            break;
        }
    }
    Stamp::read(&first, false)
}

/// Has `then` called with what arrives. A message that is damaged ends the process.
fn subscribe(
    session: &Session,
    job: &Job,
    topic: &str,
    mut then: impl FnMut(Stamp) + Send + Sync + 'static,
) -> Result<Subscriber<()>> {
    let own = job.clone();
    let call = move |sample: Sample| {
        let stamp = stamp(&sample, &own);
        // As all ends: a message has arrived when its memory is back.
        drop(sample);
        match stamp {
            Ok(stamp) => then(stamp),
            Err(error) => {
                eprintln!("rival-zenoh: {error}");
                std::process::exit(1);
            }
        }
    };
    session.declare_subscriber(key(topic)).callback_mut(call).wait().map_err(text)
}

struct End {
    out: Outlet,
    answers: mpsc::Receiver<u64>,
}

impl Link for End {
    fn send(&mut self, number: u64) -> Result<()> {
        self.out.send(Stamp { number, sent_ns: monotonic_ns() })
    }

    fn receive(&mut self, patience: Duration) -> Result<Option<u64>> {
        match self.answers.recv_timeout(patience) {
            Ok(number) => Ok(Some(number)),
            Err(mpsc::RecvTimeoutError::Timeout) => Ok(None),
            Err(mpsc::RecvTimeoutError::Disconnected) => Err("the subscription ended".into()),
        }
    }
}

fn ask(session: &Session, job: &Job) -> Result<()> {
    let [to, from] = job.topics();
    let (sender, answers) = mpsc::sync_channel(16);
    // Ignored: nobody waits for an answer that comes too late.
    let keep = move |stamp: Stamp| {
        let _ = sender.try_send(stamp.number);
    };
    let _subscriber = subscribe(session, job, &from, keep)?;
    let mut end = End { out: Outlet::new(session, job, &to, pool(job)?)?, answers };
    drive(job, &mut end)
}

/// Answers each message, or confirms those of a stream.
fn answer(session: &Session, job: &Job, stop: &AtomicBool) -> Result<()> {
    let [to, from] = job.topics();
    let mut arrivals = (job.exchange != Exchange::RoundTrips).then(|| Arrivals::new(job));
    let payload_bytes = if arrivals.is_some() { Stamp::BYTES } else { job.payload_bytes };
    let out = Outlet::new(session, &Job { payload_bytes, ..job.clone() }, &to, pool(job)?)?;
    let answer = move |stamp: Stamp| {
        let number = match &mut arrivals {
            Some(arrivals) => arrivals.arrive(stamp.number),
            None => Some(stamp.number),
        };
        // Ignored: the other end counts what it misses.
        number.map(|number| out.send(Stamp { number, sent_ns: monotonic_ns() }));
    };
    let _subscriber = subscribe(session, job, &from, answer)?;
    ready(session);
    wait_for_stop(stop);
    Ok(())
}

fn send_flow(session: &Session, job: &Job, stop: Arc<AtomicBool>) -> Result<()> {
    let pool = pool(job)?;
    let open = |index| Outlet::new(session, job, &format!("{}/t{index}", job.topic), pool.clone());
    let outlets = (0..job.way.topics).map(open).collect::<Result<Vec<_>>>()?;
    Source::play(job, stop, |topic, stamp| outlets[topic].send(stamp))?;
    // What is under way lies in its memory.
    std::thread::sleep(DRAIN);
    Ok(())
}

fn receive_flow(session: &Session, job: &Job, stop: &AtomicBool) -> Result<()> {
    let sink = Sink::new(job);
    let mut subscribers = Vec::new();
    for (topic, inlet) in sink.inlets(job) {
        let topic = format!("{}/t{topic}", job.topic);
        subscribers.push(subscribe(session, job, &topic, move |stamp| inlet.arrive(stamp))?);
    }
    ready(session);
    wait_for_stop(stop);
    say(&Line::Measured(sink.measured()));
    Ok(())
}
