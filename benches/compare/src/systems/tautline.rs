// SPDX-License-Identifier: MIT OR Apache-2.0
//! Tautline as its users have it: a context, a node, callback threads, the main thread as the sampler.
//!
//! A plain message is bytes of a fixed number; one of variable size is a `sensor_msgs/msg/Image`. Both are written in the loan
//! and read in place.

use std::pin::pin;
use std::sync::mpsc;
use std::time::Duration;

use ::tautline::{
    CallbackOptions, Context, Limits, Loan, Message, Node, PublishError, Publisher, Qos, Realtime, Sample,
    SendError, Subscription, Timer,
};
use futures::future::{Either, select};
use futures::stream::FuturesUnordered;
use futures::{StreamExt, TryStreamExt};
use tautline_exchange::{
    APPLICATION_PRIORITY, Exchange, Inlet, Job, Line, Measured, PATIENCE, Result, Role, RoundTrips, Sink,
    Source, Stamp, on_stop, say, stop_flag,
};
use tautline_ros_msgs::sensor_msgs::msg::{Image, ImageSizes};
use tautline_ros_msgs::std_msgs::msg::HeaderSizes;
use tautline_rt::clock::monotonic_ns;

/// The sampler's priority: above the callbacks'.
const SAMPLER_PRIORITY: u8 = APPLICATION_PRIORITY + 10;
/// How long an answer to the first question is waited for.
const GREETING: Duration = Duration::from_millis(20);

/// Of the mode `direct-spin`: about what falling asleep and being woken costs.
const SPIN: Duration = Duration::from_micros(5);

/// What is measured of a message.
trait Payload: Message {
    /// Writes and publishes one.
    fn send(publisher: &Publisher<Self>, job: &Job, stamp: Stamp) -> Result<()>;
    fn bytes(sample: &Sample<Self>) -> &[u8];
}

macro_rules! frames {
    ($($bytes:literal $name:ident $ros_name:literal,)*) => {
        $(
            #[derive(Message, Clone, Copy)]
            #[repr(C)]
            #[message(name = $ros_name)]
            struct $name {
                bytes: [u8; $bytes],
            }

            impl Payload for $name {
                fn send(publisher: &Publisher<Self>, job: &Job, stamp: Stamp) -> Result<()> {
                    let mut loan = publisher.loan()?;
                    stamp.write(&mut loan.bytes, job.way.whole);
                    publish(loan)
                }

                fn bytes(sample: &Sample<Self>) -> &[u8] {
                    &sample.bytes
                }
            }
        )*

        fn run_plain(job: &Job) -> Result<()> {
            match job.payload_bytes {
                $($bytes => play::<$name>(job),)*
                bytes => Err(format!("there is no frame of {bytes} bytes").into()),
            }
        }
    };
}

frames! {
    64 Frame64B "bench_msgs/msg/Frame64B",
    512 Frame512B "bench_msgs/msg/Frame512B",
    1024 Frame1KiB "bench_msgs/msg/Frame1KiB",
    4096 Frame4KiB "bench_msgs/msg/Frame4KiB",
    32768 Frame32KiB "bench_msgs/msg/Frame32KiB",
    262144 Frame256KiB "bench_msgs/msg/Frame256KiB",
    1048576 Frame1MiB "bench_msgs/msg/Frame1MiB",
    2097152 Frame2MiB "bench_msgs/msg/Frame2MiB",
    8388608 Frame8MiB "bench_msgs/msg/Frame8MiB",
}

impl Payload for Image {
    fn send(publisher: &Publisher<Self>, job: &Job, stamp: Stamp) -> Result<()> {
        let sizes = ImageSizes { header: HeaderSizes { frame_id: 6 }, encoding: 5, data: job.payload_bytes };
        let loan = publisher.loan_with(sizes)?.write(|image| {
            image.header.frame_id.set("camera")?;
            image.encoding.set("mono8")?;
            image.height.set(1);
            image.width.set(job.payload_bytes as u32);
            image.step.set(job.payload_bytes as u32);
            stamp.write(image.data.slice_mut(), job.way.whole);
            image.default_rest();
            Ok(())
        })?;
        publish(loan)
    }

    fn bytes(sample: &Sample<Self>) -> &[u8] {
        sample.view().data()
    }
}

/// Publishes, once a subscription that keeps all has room.
fn publish<T: Message>(mut loan: Loan<'_, T>) -> Result<()> {
    loop {
        match loan.publish() {
            Ok(()) => return Ok(()),
            Err(SendError { error: PublishError::Full, loan: back }) => loan = back,
            Err(unsent) => return Err(unsent.to_string().into()),
        }
        std::thread::yield_now();
    }
}

/// Runs one end to its end.
pub fn run(job: &Job) -> Result<()> {
    match job.way.mode.as_str() {
        // Gateways tell each other a type by its hash, which the bundled messages have.
        "image" | "gateway" => play::<Image>(job),
        _ => run_plain(job),
    }
}

fn play<T: Payload>(job: &Job) -> Result<()> {
    let context = Context::builder()
        .domain(job.domain)
        .realtime(if job.realtime { Realtime::Required } else { Realtime::Off })
        .sampler_priority(SAMPLER_PRIORITY)
        .hold_idle(job.way.mode.ends_with("default"));
    let context = match job.core {
        Some(core) => context.sampler_core(core),
        None => context,
    };
    let context = context.build()?;
    let mut end = End::<T> {
        node: Node::create(context.clone(), if job.role == Role::Near { "near" } else { "far" }, "")?,
        context,
        job: job.clone(),
        kind: std::marker::PhantomData,
    };
    match (job.exchange, job.role) {
        (Exchange::RoundTrips, Role::Near) => end.ask(),
        (Exchange::RoundTrips, Role::Far) => end.answer(),
        (_, Role::Near) => end.send_flow(),
        (_, Role::Far) => end.receive_flow(),
    }
}

struct End<T> {
    context: Context,
    node: Node,
    job: Job,
    kind: std::marker::PhantomData<T>,
}

impl<T: Payload> End<T> {
    fn ask(&mut self) -> Result<()> {
        let [to, from] = self.job.topics();
        let (publisher, answers) = (self.publisher(&to)?, self.subscription(&from)?);
        let timers = [GREETING, PATIENCE].map(|period| self.node.create_wall_timer(period));
        let [greeting, patience] = timers;
        let (greeting, patience) = (greeting?, patience?);
        let (own, context) = (self.job.clone(), self.context.clone());
        let (sender, outcome) = mpsc::channel();
        let callback = self.node.spawn_callback(self.options(), async move {
            let asked = ask(&own, publisher, answers, greeting, patience).await;
            let _ = sender.send(asked);
            context.shutdown();
        })?;
        self.node.spin()?;
        callback.join()?;
        say(&Line::Measured(outcome.recv()??));
        Ok(())
    }

    fn answer(&mut self) -> Result<()> {
        let [to, from] = self.job.topics();
        let (publisher, questions) = (self.publisher(&to)?, self.subscription(&from)?);
        let (own, context) = (self.job.clone(), self.context.clone());
        let (sender, outcome) = mpsc::channel();
        let _callback = self.node.spawn_callback(self.options(), async move {
            let answered = answer(&own, publisher, questions).await;
            let _ = sender.send(answered);
            context.shutdown();
        })?;
        self.shutdown_on_stop();
        say(&Line::Ready(None));
        self.node.spin()?;
        // Only an error ends before the context does.
        outcome.try_recv().unwrap_or(Ok(()))
    }

    fn send_flow(&mut self) -> Result<()> {
        let publishers = (0..self.job.way.topics)
            .map(|index| self.publisher(&format!("{}/t{index}", self.job.topic)))
            .collect::<Result<Vec<_>>>()?;
        let (own, context) = (self.job.clone(), self.context.clone());
        let (sender, outcome) = mpsc::channel();
        let callback = self.node.spawn_callback(self.options(), async move {
            let sent = send_flow(&own, &publishers);
            let _ = sender.send(sent.map(|measured| (measured, publishers)));
            context.shutdown();
        })?;
        self.node.spin()?;
        callback.join()?;
        let (measured, publishers) = outcome.recv()??;
        say(&Line::Measured(measured));
        // What it sent is read from its memory, and that a publisher goes wakes subscriptions once more.
        std::thread::sleep(super::LOOK);
        drop(publishers);
        Ok(())
    }

    fn receive_flow(&mut self) -> Result<()> {
        let sink = Sink::new(&self.job);
        let (sender, outcome) = mpsc::channel();
        let mut callbacks = Vec::new();
        let mut ends = Vec::new();
        for (topic, inlet) in sink.inlets(&self.job) {
            ends.push((self.subscription(&format!("{}/t{topic}", self.job.topic))?, inlet));
        }
        let is_one_thread = self.job.way.mode == "one-thread";
        while !ends.is_empty() {
            let of_callback: Vec<_> = ends.drain(..if is_one_thread { ends.len() } else { 1 }).collect();
            let (own, context, sender) = (self.job.clone(), self.context.clone(), sender.clone());
            callbacks.push(self.node.spawn_callback(self.options(), async move {
                if let Err(error) = receive_all(&own, of_callback).await {
                    let _ = sender.send(error);
                    context.shutdown();
                }
            })?);
        }
        self.shutdown_on_stop();
        say(&Line::Ready(None));
        self.node.spin()?;
        if let Ok(error) = outcome.try_recv() {
            return Err(error);
        }
        say(&Line::Measured(sink.measured()));
        Ok(())
    }

    fn shutdown_on_stop(&self) {
        let context = self.context.clone();
        on_stop(move || context.shutdown());
    }

    fn options(&self) -> CallbackOptions {
        let options = CallbackOptions::fifo(APPLICATION_PRIORITY).name("callback");
        let options = match self.job.core {
            Some(core) => options.core(core),
            None => options,
        };
        match self.job.way.mode.as_str() {
            "busy-poll" => options.busy_poll(),
            "direct" | "one-thread" => options.direct_wake(),
            "direct-spin" => options.direct_wake().spin(SPIN),
            _ => options,
        }
    }

    fn qos(&self) -> Qos {
        match self.job.exchange {
            Exchange::Stream { .. } => Qos::keep_all(self.job.depth()),
            _ => Qos::keep_last(self.job.depth()),
        }
    }

    fn publisher(&mut self, topic: &str) -> Result<Publisher<T>> {
        self.limit(topic)?;
        Ok(self.node.create_publisher(topic, self.qos())?)
    }

    fn subscription(&mut self, topic: &str) -> Result<Subscription<T>> {
        self.limit(topic)?;
        Ok(self.node.subscribe(topic, self.qos())?)
    }

    fn limit(&mut self, topic: &str) -> Result<()> {
        let message_bytes = self.job.payload_bytes + 128;
        let limits = Limits { message_bytes, held: 2, loans: 2, ..Limits::default() };
        Ok(self.node.set_topic_limits(topic, limits)?)
    }
}

async fn ask<T: Payload>(
    job: &Job,
    publisher: Publisher<T>,
    mut answers: Subscription<T>,
    greeting: Timer,
    mut patience: Timer,
) -> Result<Measured> {
    let publisher = greet(job, publisher, &mut answers, greeting).await?;
    let mut trips = RoundTrips::new(job);
    while let Some(number) = trips.start() {
        T::send(&publisher, job, Stamp { number, sent_ns: monotonic_ns() })?;
        loop {
            match select(answers.next(), pin!(patience.tick())).await {
                Either::Left((Some(answer), _)) => {
                    let number = read(&answer, job)?.number;
                    drop(answer);
                    if trips.end(number) {
                        break;
                    }
                }
                Either::Left((None, _)) => return Err("the subscription ended".into()),
                Either::Right(_) if trips.is_overdue() => {
                    trips.give_up()?;
                    break;
                }
                Either::Right(_) => {}
            }
        }
    }
    Ok(trips.measured())
}

/// Sends messages of number 0 until one is answered: gateways tell each other of topics, and some are sent before they did.
async fn greet<T: Payload>(
    job: &Job,
    publisher: Publisher<T>,
    answers: &mut Subscription<T>,
    mut timer: Timer,
) -> Result<Publisher<T>> {
    loop {
        T::send(&publisher, job, Stamp { number: 0, sent_ns: monotonic_ns() })?;
        if let Either::Left(_) = select(answers.next(), pin!(timer.tick())).await {
            return Ok(publisher);
        }
    }
}

async fn answer<T: Payload>(
    job: &Job,
    publisher: Publisher<T>,
    mut questions: Subscription<T>,
) -> Result<()> {
    while let Some(question) = questions.next().await {
        let number = read(&question, job)?.number;
        drop(question);
        T::send(&publisher, job, Stamp { number, sent_ns: monotonic_ns() })?;
    }
    Ok(())
}

fn send_flow<T: Payload>(job: &Job, publishers: &[Publisher<T>]) -> Result<Measured> {
    let mut source = Source::new(job, stop_flag());
    while let Some((topic, stamp)) = source.next() {
        T::send(&publishers[topic], job, stamp)?;
    }
    Ok(source.measured())
}

async fn receive_all<T: Payload>(job: &Job, mut ends: Vec<(Subscription<T>, Inlet)>) -> Result<()> {
    match (ends.pop(), ends.is_empty()) {
        (Some((messages, inlet)), true) => receive(job, messages, inlet).await,
        (last, _) => {
            // Those alone that were woken are looked at.
            let all = ends.into_iter().chain(last).map(|(messages, inlet)| receive(job, messages, inlet));
            all.collect::<FuturesUnordered<_>>().try_collect().await
        }
    }
}

async fn receive<T: Payload>(job: &Job, mut messages: Subscription<T>, inlet: Inlet) -> Result<()> {
    while let Some(message) = messages.next().await {
        let stamp = read(&message, job)?;
        // As all ends: a message has arrived when its memory is back.
        drop(message);
        inlet.arrive(stamp);
    }
    Ok(())
}

fn read<T: Payload>(message: &Sample<T>, job: &Job) -> Result<Stamp> {
    Stamp::read(T::bytes(message), job.way.whole)
}
