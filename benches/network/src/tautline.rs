// SPDX-License-Identifier: MIT OR Apache-2.0
//! Tautline as its users have it: a node on each host, its main thread the sampler, one callback; between the hosts the two
//! gateways. The message is `std_msgs/msg/ByteMultiArray`, written in place and read in place.

use std::pin::pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc;
use std::time::Duration;

use ::tautline::{CallbackOptions, Context, Limits, Node, Publisher, Qos, Realtime, Subscription, Timer};
use futures::StreamExt;
use futures::future::{Either, select};
use tautline_exchange::{
    APPLICATION_PRIORITY, Arrivals, Exchange, Job, Line, Result, Role, RoundTrips, Window, say, stop_flag,
};
use tautline_ros_msgs::std_msgs::msg::{ByteMultiArray, ByteMultiArraySizes, MultiArrayLayoutSizes};

/// The sampler's priority: above the callback's.
const SAMPLER_PRIORITY: u8 = APPLICATION_PRIORITY + 10;
/// Messages that are written as a whole: more than a publisher has buffers.
const WRITTEN: u64 = 300;
/// How often it is looked whether an answer is overdue.
const LOOK: Duration = Duration::from_millis(50);

/// Runs one end to its end.
pub fn run(job: &Job) -> Result<()> {
    let context = Context::builder().domain(job.domain).hold_idle(false);
    let context = context.realtime(if job.realtime { Realtime::Required } else { Realtime::Off });
    let context = match job.core {
        Some(core) => context.sampler_core(core),
        None => context,
    };
    let context = context.sampler_priority(SAMPLER_PRIORITY).build()?;
    let mut node = Node::create(context.clone(), if job.role == Role::Near { "near" } else { "far" }, "")?;
    let [to, from] = job.topics();
    let depth = match job.exchange {
        Exchange::Stream { window: Some(window) } => usize::try_from(window)? * 2,
        _ => 10,
    };
    let limits = Limits { message_bytes: job.payload_bytes + 64, ..Limits::default() };
    for topic in [&to, &from] {
        node.set_topic_limits(topic, limits)?;
    }
    let qos = Qos::keep_last(depth);
    let publisher = node.create_publisher::<ByteMultiArray>(&to, qos)?;
    let messages = node.subscribe::<ByteMultiArray>(&from, qos)?;
    let period = match job.exchange {
        Exchange::Paced { rate } if job.role == Role::Near => Duration::from_secs_f64(1.0 / rate),
        _ => LOOK,
    };
    let end = End { publisher, messages, timer: node.create_wall_timer(period)?, bytes: job.payload_bytes };
    let options = CallbackOptions::fifo(APPLICATION_PRIORITY).name("callback");
    let options = match job.core {
        Some(core) => options.core(core),
        None => options,
    };
    let (sender, outcome) = mpsc::channel();
    let (own, ending, stop) = (job.clone(), context.clone(), stop_flag());
    let callback = node.spawn_callback(options, async move {
        let _ = sender.send(end.play(&own, &stop).await);
        ending.shutdown();
    })?;
    if job.role == Role::Far {
        say(&Line::Ready(None));
    }
    node.spin()?;
    callback.join()?;
    outcome.recv()?
}

/// What the callback has.
struct End {
    publisher: Publisher<ByteMultiArray>,
    messages: Subscription<ByteMultiArray>,
    timer: Timer,
    bytes: usize,
}

impl End {
    async fn play(mut self, job: &Job, stop: &Arc<AtomicBool>) -> Result<()> {
        match (job.role, job.exchange) {
            (Role::Near, Exchange::RoundTrips) => self.ask(RoundTrips::new(job)).await,
            (Role::Near, Exchange::Stream { window }) => self.pour(Window::new(window)).await,
            (Role::Near, Exchange::Paced { .. }) => self.tick(stop).await,
            (Role::Far, Exchange::RoundTrips) => self.answer(stop).await,
            (Role::Far, _) => self.gather(Arrivals::new(job), stop).await,
        }
    }

    /// The next message's number; `None` at a tick of the timer.
    async fn next(&mut self) -> Option<u64> {
        let tick = pin!(self.timer.tick());
        match select(self.messages.next(), tick).await {
            Either::Left((message, _)) => message.map(|sample| number(sample.view().data())),
            Either::Right(_) => None,
        }
    }

    fn send(&self, number: u64, bytes: usize) -> Result<()> {
        let sizes = ByteMultiArraySizes { layout: MultiArrayLayoutSizes { dim: &[] }, data: bytes };
        let loan = self.publisher.loan_with(sizes)?.write(|message| {
            message.layout.data_offset.set(0);
            let data = message.data.slice_mut();
            // All of it until every buffer was written: memory that never was is one page of zeroes, which costs less to
            // read. Then the rest as it lies there, for `z_ping` writes its message once only.
            if number <= WRITTEN {
                data.fill(7);
            }
            data[..8].copy_from_slice(&number.to_le_bytes());
            Ok(())
        })?;
        loan.publish().map_err(|error| error.to_string().into())
    }

    async fn ask(&mut self, mut trips: RoundTrips) -> Result<()> {
        while let Some(number) = trips.start() {
            self.send(number, self.bytes)?;
            loop {
                match self.next().await {
                    Some(answer) if trips.end(answer) => break,
                    None if trips.is_overdue() => {
                        trips.give_up()?;
                        break;
                    }
                    _ => {}
                }
            }
        }
        say(&Line::Measured(trips.measured()));
        Ok(())
    }

    async fn answer(&mut self, stop: &AtomicBool) -> Result<()> {
        while !stop.load(Ordering::Relaxed) {
            if let Some(number) = self.next().await {
                self.send(number, self.bytes)?;
            }
        }
        Ok(())
    }

    async fn pour(&mut self, mut window: Window) -> Result<()> {
        let mut silent = Duration::ZERO;
        while !window.is_done() {
            while let Some(number) = window.next() {
                self.send(number, self.bytes)?;
            }
            match self.next().await {
                Some(confirmed) => {
                    silent = Duration::ZERO;
                    window.confirm(confirmed);
                }
                None => {
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

    async fn tick(&mut self, stop: &AtomicBool) -> Result<()> {
        let mut number = 0;
        while !stop.load(Ordering::Relaxed) {
            self.timer.tick().await?;
            number += 1;
            self.send(number, self.bytes)?;
        }
        Ok(())
    }

    async fn gather(&mut self, mut arrivals: Arrivals, stop: &AtomicBool) -> Result<()> {
        while !stop.load(Ordering::Relaxed) {
            let Some(number) = self.next().await else { continue };
            if let Some(number) = arrivals.arrive(number) {
                self.send(number, size_of::<u64>())?;
            }
        }
        Ok(())
    }
}

fn number(data: &[u8]) -> u64 {
    data.first_chunk().copied().map_or(0, u64::from_le_bytes)
}
