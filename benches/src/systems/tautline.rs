// SPDX-License-Identifier: MIT OR Apache-2.0
//! Tautline as its users have it: a context, a node, callback threads, the main thread as the sampler.
//!
//! A plain message is bytes of a fixed number; one of variable size is a `sensor_msgs/msg/Image`. Both are written in the loan
//! and read in place.

use std::marker::PhantomData;
use std::pin::pin;
use std::sync::mpsc;
use std::time::Duration;

use ::tautline::{
    CallbackHandle, CallbackOptions, Context, Events, Limits, Loan, Message, Node, Plain, PublishError,
    Publisher, Qos, Realtime, Sample, SendError, Subscription, Timer,
};
use futures::future::{Either, select};
use futures::stream::FuturesUnordered;
use futures::{StreamExt, TryStreamExt};
use tautline_exchange::{
    APPLICATION_PRIORITY, Arrivals, Exchange, Inlet, Job, Line, Measured, PATIENCE, Result, Role, RoundTrips,
    Sink, Source, Stamp, Window, on_stop, say, stop_flag,
};
use tautline_ros_msgs::sensor_msgs::msg::{Image, ImageSizes};
use tautline_ros_msgs::std_msgs::msg::HeaderSizes;
use tautline_rt::clock::monotonic_ns;

use super::LOOK;

/// The sampler's priority: above the callbacks'.
const SAMPLER_PRIORITY: u8 = APPLICATION_PRIORITY + 10;
/// Ends a mode with Tautline's own default about idle states; in all others it leaves them as they are.
const OWN_DEFAULT: &str = "-default";
/// How long an answer to the first question is waited for.
const GREETING: Duration = Duration::from_millis(20);
/// Of the mode `direct-spin`: about what falling asleep and being woken costs.
const SPIN: Duration = Duration::from_micros(5);
/// Messages to a gateway that are written whole, whatever is asked for: more than a publisher has buffers. Memory that never was
/// written is one page of zeroes, which costs less to read.
const WRITTEN: u64 = 300;

/// What is measured of a message.
pub trait Payload: Message {
    /// Writes and publishes one of so many bytes.
    fn send(publisher: &Publisher<Self>, bytes: usize, stamp: Stamp, whole: bool) -> Result<()>;
    fn bytes(sample: &Sample<Self>) -> &[u8];
}

/// A message of a fixed number of bytes.
pub trait Frame: Message + Plain {
    fn bytes(&self) -> &[u8];
    fn bytes_mut(&mut self) -> &mut [u8];
}

impl<T: Frame> Payload for T {
    fn send(publisher: &Publisher<Self>, _bytes: usize, stamp: Stamp, whole: bool) -> Result<()> {
        let mut loan = publisher.loan()?;
        stamp.write(loan.bytes_mut(), whole);
        publish(loan)
    }

    fn bytes(sample: &Sample<Self>) -> &[u8] {
        Frame::bytes(&**sample)
    }
}

macro_rules! frames {
    ($($bytes:literal $name:ident $ros_name:literal,)*) => {
        $(
            #[derive(Message, Clone, Copy)]
            #[repr(C)]
            #[message(name = $ros_name)]
            pub struct $name {
                pub bytes: [u8; $bytes],
            }

            impl Frame for $name {
                fn bytes(&self) -> &[u8] {
                    &self.bytes
                }

                fn bytes_mut(&mut self) -> &mut [u8] {
                    &mut self.bytes
                }
            }
        )*

        fn run_plain(job: &Job) -> Result<()> {
            match job.payload_bytes {
                $($bytes => play::<$name, $name>(job),)*
                bytes => Err(format!("there is no frame of {bytes} bytes").into()),
            }
        }
    };
}

frames! {
    64 Frame64B "bench_msgs/msg/Frame64B",
    1024 Frame1KiB "bench_msgs/msg/Frame1KiB",
    4096 Frame4KiB "bench_msgs/msg/Frame4KiB",
    16384 Frame16KiB "bench_msgs/msg/Frame16KiB",
    65536 Frame64KiB "bench_msgs/msg/Frame64KiB",
    262144 Frame256KiB "bench_msgs/msg/Frame256KiB",
    1048576 Frame1MiB "bench_msgs/msg/Frame1MiB",
    4194304 Frame4MiB "bench_msgs/msg/Frame4MiB",
    8388608 Frame8MiB "bench_msgs/msg/Frame8MiB",
}

impl Payload for Image {
    fn send(publisher: &Publisher<Self>, bytes: usize, stamp: Stamp, whole: bool) -> Result<()> {
        let sizes = ImageSizes { header: HeaderSizes { frame_id: 6 }, encoding: 5, data: bytes };
        let loan = publisher.loan_with(sizes)?.write(|image| {
            image.header.frame_id.set("camera")?;
            image.encoding.set("mono8")?;
            image.height.set(1);
            image.width.set(bytes as u32);
            image.step.set(bytes as u32);
            stamp.write(image.data.slice_mut(), whole);
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
        "image" | GATEWAY => play::<Image, Image>(job),
        _ => run_plain(job),
    }
}

const GATEWAY: &str = "gateway";

/// Plays an end: the near one sends `Q`, the far one `A`.
pub fn play<Q: Payload, A: Payload>(job: &Job) -> Result<()> {
    match (job.role, job.exchange) {
        (Role::Near, Exchange::RoundTrips) => End::<Q, A>::new(job)?.ask(),
        (Role::Near, Exchange::Stream { window: Some(window) }) => {
            End::<Q, A>::new(job)?.pour(Window::new(window))
        }
        (Role::Far, Exchange::RoundTrips) => End::<A, Q>::new(job)?.answer(),
        (Role::Far, Exchange::Stream { window: Some(_) }) => End::<A, Q>::new(job)?.gather(),
        _ => flow::<Q>(job),
    }
}

/// Runs one end of a flow.
pub fn flow<T: Payload>(job: &Job) -> Result<()> {
    let mut end = End::<T, T>::new(job)?;
    if job.role == Role::Near { end.send_flow() } else { end.receive_flow() }
}

/// One end, and what it sends and receives.
pub struct End<Out, In> {
    pub node: Node,
    context: Context,
    job: Job,
    kinds: PhantomData<(Out, In)>,
}

impl<Out: Payload, In: Payload> End<Out, In> {
    pub fn new(job: &Job) -> Result<Self> {
        let context = Context::builder()
            .domain(job.domain)
            .realtime(if job.realtime { Realtime::Required } else { Realtime::Off })
            .sampler_priority(SAMPLER_PRIORITY)
            .hold_idle(job.way.mode.ends_with(OWN_DEFAULT));
        let sampler_core = if job.way.mode == "two-cores" { job.way.other_core } else { job.core };
        let context = match sampler_core {
            Some(core) => context.sampler_core(core),
            None => context,
        };
        let context = context.build()?;
        let name = if job.role == Role::Near { "near" } else { "far" };
        let node = Node::create(context.clone(), name, "")?;
        Ok(End { node, context, job: job.clone(), kinds: PhantomData })
    }

    fn ask(&mut self) -> Result<()> {
        let (publisher, answers) = self.both()?;
        let (greeting, patience) = (self.node.create_wall_timer(GREETING)?, self.patience()?);
        let own = self.job.clone();
        self.measure(async move { ask(&own, publisher, answers, greeting, patience).await })
    }

    fn answer(&mut self) -> Result<()> {
        let (publisher, questions) = self.both()?;
        let own = self.job.clone();
        self.serve(async move { answer(&own, publisher, questions).await })
    }

    fn pour(&mut self, window: Window) -> Result<()> {
        let (publisher, confirmations) = self.both()?;
        let (own, look) = (self.job.clone(), self.node.create_wall_timer(LOOK)?);
        self.until(async move { pour(&own, window, publisher, confirmations, look).await })
    }

    fn gather(&mut self) -> Result<()> {
        let (publisher, messages) = self.both()?;
        let own = self.job.clone();
        self.serve(async move { gather(Arrivals::new(&own), publisher, messages).await })
    }

    fn both(&mut self) -> Result<(Publisher<Out>, Subscription<In>)> {
        let [to, from] = self.job.topics();
        Ok((self.publisher(&to)?, self.subscription(&from)?))
    }

    /// Ticks when it may be that an answer does not come.
    pub fn patience(&mut self) -> Result<Timer> {
        Ok(self.node.create_wall_timer(PATIENCE)?)
    }

    /// A callback that stops the context at its end.
    fn spawn<T: Send + 'static>(
        &self,
        work: impl Future<Output = Result<T>> + Send + 'static,
    ) -> Result<(CallbackHandle, mpsc::Receiver<Result<T>>)> {
        let (sender, outcome) = mpsc::channel();
        let end = self.end();
        let callback = self.node.spawn_callback(self.options(), async move {
            let _ = sender.send(work.await);
            end.stop();
        })?;
        Ok((callback, outcome))
    }

    /// Runs a callback until its end.
    fn until<T: Send + 'static>(&self, work: impl Future<Output = Result<T>> + Send + 'static) -> Result<T> {
        let (callback, outcome) = self.spawn(work)?;
        self.node.spin()?;
        callback.join()?;
        outcome.recv()?
    }

    /// Runs a callback until its end, and says what it measured.
    pub fn measure(&self, work: impl Future<Output = Result<Measured>> + Send + 'static) -> Result<()> {
        say(&Line::Measured(self.until(work)?));
        Ok(())
    }

    /// Says that it is ready, and runs a callback until it is told to stop.
    pub fn serve(&self, work: impl Future<Output = Result<()>> + Send + 'static) -> Result<()> {
        let (_callback, outcome) = self.spawn(work)?;
        self.shutdown_on_stop();
        say(&Line::Ready(None));
        self.node.spin()?;
        // Only an error ends before the context does.
        outcome.try_recv().unwrap_or(Ok(()))
    }

    fn send_flow(&mut self) -> Result<()> {
        let publishers = (0..self.job.way.topics.max(1))
            .map(|index| self.publisher(&format!("{}/t{index}", self.job.topic)))
            .collect::<Result<Vec<_>>>()?;
        let own = self.job.clone();
        let sent = async move { send_flow(&own, &publishers).map(|measured| (measured, publishers)) };
        let (measured, publishers) = self.until(sent)?;
        say(&Line::Measured(measured));
        // What it sent is read from its memory, and that a publisher goes wakes subscriptions once more.
        std::thread::sleep(LOOK);
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
        let is_one_thread = self.job.way.mode.starts_with("one-thread");
        while !ends.is_empty() {
            let of_callback: Vec<_> = ends.drain(..if is_one_thread { ends.len() } else { 1 }).collect();
            let (own, end, sender) = (self.job.clone(), self.end(), sender.clone());
            callbacks.push(self.node.spawn_callback(self.options(), async move {
                if let Err(error) = receive_all(&own, of_callback).await {
                    let _ = sender.send(error);
                    end.stop();
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
        let end = self.end();
        on_stop(move || end.stop());
    }

    /// What stops the context. A callback that held the context itself would keep it, and its files.
    fn end(&self) -> Events {
        self.context.events().clone()
    }

    fn options(&self) -> CallbackOptions {
        let options = CallbackOptions::fifo(APPLICATION_PRIORITY).name("callback");
        let options = match self.job.core {
            Some(core) => options.core(core),
            None => options,
        };
        match self.job.way.mode.trim_end_matches(OWN_DEFAULT) {
            "busy-poll" => options.busy_poll(),
            "direct" | "one-thread" => options.direct_wake(),
            "direct-spin" => options.direct_wake().spin(SPIN),
            // Such as "blocking" and "one-thread-blocking": the sampler wakes it.
            _ => options,
        }
    }

    pub fn qos(&self) -> Qos {
        match self.job.exchange {
            Exchange::Stream { window: None } => Qos::keep_all(self.job.depth()),
            _ => Qos::keep_last(self.job.depth()),
        }
    }

    fn publisher(&mut self, topic: &str) -> Result<Publisher<Out>> {
        self.limit(topic)?;
        Ok(self.node.create_publisher(topic, self.qos())?)
    }

    fn subscription(&mut self, topic: &str) -> Result<Subscription<In>> {
        self.limit(topic)?;
        Ok(self.node.subscribe(topic, self.qos())?)
    }

    fn limit(&mut self, topic: &str) -> Result<()> {
        let message_bytes = self.job.payload_bytes + 128;
        let limits = Limits { message_bytes, held: 2, loans: 2, ..Limits::default() };
        Ok(self.node.set_topic_limits(topic, limits)?)
    }
}

/// Sends a message to the other end.
fn send<T: Payload>(job: &Job, publisher: &Publisher<T>, number: u64) -> Result<()> {
    let whole = job.way.whole || job.way.mode == GATEWAY && number <= WRITTEN;
    T::send(publisher, job.payload_bytes, Stamp { number, sent_ns: monotonic_ns() }, whole)
}

async fn ask<Q: Payload, A: Payload>(
    job: &Job,
    publisher: Publisher<Q>,
    mut answers: Subscription<A>,
    mut greeting: Timer,
    mut patience: Timer,
) -> Result<Measured> {
    // Until one is answered: gateways tell each other of topics, and some are sent before they did.
    loop {
        send(job, &publisher, 0)?;
        if let Either::Left(_) = select(answers.next(), pin!(greeting.tick())).await {
            break;
        }
    }
    // Whose next tick would be what the kernel is to wake the sampler at in each of its waits.
    drop(greeting);
    let mut trips = RoundTrips::new(job);
    while let Some(number) = trips.start() {
        send(job, &publisher, number)?;
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

async fn answer<A: Payload, Q: Payload>(
    job: &Job,
    publisher: Publisher<A>,
    mut questions: Subscription<Q>,
) -> Result<()> {
    while let Some(question) = questions.next().await {
        let number = read(&question, job)?.number;
        drop(question);
        send(job, &publisher, number)?;
    }
    Ok(())
}

/// Sends as many messages as the window allows until enough were confirmed.
async fn pour<Q: Payload, A: Payload>(
    job: &Job,
    mut window: Window,
    publisher: Publisher<Q>,
    mut confirmations: Subscription<A>,
    mut look: Timer,
) -> Result<()> {
    let mut silent = Duration::ZERO;
    while !window.is_done() {
        while let Some(number) = window.next() {
            send(job, &publisher, number)?;
        }
        match select(confirmations.next(), pin!(look.tick())).await {
            Either::Left((Some(confirmed), _)) => {
                silent = Duration::ZERO;
                window.confirm(Stamp::read(A::bytes(&confirmed), false)?.number);
            }
            Either::Left((None, _)) => return Err("the subscription ended".into()),
            Either::Right(_) => {
                silent += LOOK;
                if silent >= window.patience() {
                    window.give_up()?;
                    silent = Duration::ZERO;
                }
            }
        }
    }
    Ok(())
}

/// Confirms what arrives of a stream.
async fn gather<A: Payload, Q: Payload>(
    mut arrivals: Arrivals,
    publisher: Publisher<A>,
    mut messages: Subscription<Q>,
) -> Result<()> {
    while let Some(message) = messages.next().await {
        let stamp = Stamp::read(Q::bytes(&message), false)?;
        drop(message);
        if let Some(number) = arrivals.arrive(stamp.number) {
            A::send(&publisher, Stamp::BYTES, Stamp { number, ..stamp }, false)?;
        }
    }
    Ok(())
}

fn send_flow<T: Payload>(job: &Job, publishers: &[Publisher<T>]) -> Result<Measured> {
    Source::new(job, stop_flag())
        .run(|topic, stamp| T::send(&publishers[topic], job.payload_bytes, stamp, job.way.whole))
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
