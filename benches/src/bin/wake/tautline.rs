// SPDX-License-Identifier: MIT OR Apache-2.0
//! Tautline as its users have it: a context, a node, a callback thread, the main thread as the sampler.
//!
//! The round trip is from `loan` in the ping's callback to the first line after `next().await` there; in between lie the
//! pong's sampler, its callback, and the ping's own sampler.

use std::sync::mpsc;
use std::time::{Duration, Instant};

use ::tautline::{CallbackOptions, Context, Message, Node, Plain, Publisher, Qos, Realtime, Subscription};
use futures::StreamExt;
use tautline_benches::pair::Line;

use crate::Result;
use crate::child::{Pinger, Received, WAIT};
use crate::payload::STOP;
use crate::plan::{Job, Mode, PRIORITY, Payload, Role};

/// How long who answers may take to connect.
const PATIENCE: Duration = Duration::from_secs(10);
/// The sampler's priority: above the callback's.
const SAMPLER_PRIORITY: u8 = PRIORITY + 10;

/// A message of one of the measured sizes.
trait Frame: Message + Plain {
    fn words(&self) -> &[u64];
    fn words_mut(&mut self) -> &mut [u64];
}

macro_rules! frame {
    ($name:ident, $ros_name:literal, $bytes:expr) => {
        #[derive(Message, Clone, Copy)]
        #[repr(C)]
        #[message(name = $ros_name)]
        struct $name {
            words: [u64; $bytes / 8],
        }

        impl Frame for $name {
            fn words(&self) -> &[u64] {
                &self.words
            }

            fn words_mut(&mut self) -> &mut [u64] {
                &mut self.words
            }
        }
    };
}

frame!(Frame64B, "bench_msgs/msg/Frame64B", 64);
frame!(Frame4KiB, "bench_msgs/msg/Frame4KiB", 4 << 10);
frame!(Frame1MiB, "bench_msgs/msg/Frame1MiB", 1 << 20);
frame!(Frame8MiB, "bench_msgs/msg/Frame8MiB", 8 << 20);

/// Runs one side of the exchange to its end.
pub fn run(job: &Job, pinger: &mut Pinger) -> Result<()> {
    match job.payload.bytes {
        64 => play::<Frame64B>(job, pinger),
        4_096 => play::<Frame4KiB>(job, pinger),
        1_048_576 => play::<Frame1MiB>(job, pinger),
        8_388_608 => play::<Frame8MiB>(job, pinger),
        bytes => Err(format!("there is no frame of {bytes} bytes").into()),
    }
}

fn play<T: Frame>(job: &Job, pinger: &mut Pinger) -> Result<()> {
    let sampler_core = match (job.mode, job.role) {
        (Mode::TautlineTwoCores, Role::Ping) => job.cores[1],
        (Mode::TautlineTwoCores, Role::Pong) => job.cores[0],
        _ => job.core(),
    };
    let context = Context::builder()
        .realtime(if job.realtime { Realtime::Required } else { Realtime::Off })
        .sampler_priority(SAMPLER_PRIORITY)
        .sampler_core(sampler_core)
        .hold_idle(false) // the bench itself holds it, or not
        .build()?;
    let run: String = job.prefix.chars().filter(char::is_ascii_alphanumeric).collect();
    let mut node = Node::create(context.clone(), "wake", &format!("/{run}/pair{}", job.pair))?;
    let (to, from) = match job.role {
        Role::Ping => ("ping", "pong"),
        Role::Pong => ("pong", "ping"),
    };
    let qos = Qos::keep_last(2);
    let publisher = node.create_publisher::<T>(to, qos)?;
    let messages = node.subscribe::<T>(from, qos)?;
    if job.role == Role::Ping {
        wait_for_answering(&messages)?;
    }
    let options = CallbackOptions::fifo(PRIORITY).core(job.core()).name(from);
    let options = if job.mode == Mode::TautlineBusyPoll { options.busy_poll() } else { options };

    let payload = job.payload;
    let (sender, outcome) = mpsc::channel();
    let end = context.clone();
    let callback = match job.role {
        Role::Ping => {
            let own = std::mem::replace(pinger, Pinger::new(job));
            node.spawn_callback(options, async move {
                let result = ping(own, publisher, messages, payload).await;
                let _ = sender.send(result.map(Some));
                end.shutdown();
            })?
        }
        Role::Pong => node.spawn_callback(options, async move {
            let result = pong(publisher, messages, payload).await;
            let _ = sender.send(result.map(|()| None));
            end.shutdown();
        })?,
    };
    if job.role == Role::Pong {
        Line::Ready.say()?;
    }
    node.spin()?;
    callback.join()?;
    if let Some(own) = outcome.recv()?? {
        *pinger = own;
    }
    Ok(())
}

/// Who answers has connected the subscription, before the first question is asked: the thread that does it is an ordinary one, which a
/// callback that polls on its core may keep waiting.
fn wait_for_answering<T: Frame>(messages: &Subscription<T>) -> Result<()> {
    let since = Instant::now();
    while messages.publisher_count() == 0 {
        if since.elapsed() > PATIENCE {
            return Err(format!("the answering process has not connected in {} s", PATIENCE.as_secs()).into());
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    Ok(())
}

/// What crosses from the callback thread: its error as text.
type Outcome<T> = std::result::Result<T, String>;

async fn ping<T: Frame>(
    mut pinger: Pinger,
    publisher: Publisher<T>,
    mut messages: Subscription<T>,
    payload: Payload,
) -> Outcome<Pinger> {
    while let Some(number) = pinger.start() {
        let started_ns = tautline_rt::clock::monotonic_ns();
        send(&publisher, payload, number)?;
        let Some(answer) = messages.next().await else { return Err("the subscription ended".into()) };
        let number = read(&*answer, payload)?;
        // A wake-up that was lost is made up for by the janitor, a quarter of a second later.
        let late = tautline_rt::clock::monotonic_ns() - started_ns >= WAIT.as_nanos() as u64;
        pinger.end(Received { number, late }).map_err(|error| error.to_string())?;
    }
    send(&publisher, payload, STOP)?;
    Ok(pinger)
}

async fn pong<T: Frame>(
    publisher: Publisher<T>,
    mut messages: Subscription<T>,
    payload: Payload,
) -> Outcome<()> {
    while let Some(question) = messages.next().await {
        let number = read(&*question, payload)?;
        if number == STOP {
            break;
        }
        send(&publisher, payload, number)?;
    }
    Ok(())
}

fn send<T: Frame>(publisher: &Publisher<T>, payload: Payload, number: u64) -> Outcome<()> {
    let mut loan = publisher.loan().map_err(|error| error.to_string())?;
    if payload.touched {
        loan.words_mut().fill(number);
    } else {
        loan.words_mut()[0] = number;
    }
    loan.publish().map_err(|error| format!("{error:?}"))
}

fn read<T: Frame>(message: &T, payload: Payload) -> Outcome<u64> {
    let words = message.words();
    let number = words[0];
    let words = if payload.touched { words } else { &words[..1] };
    let difference = words.iter().fold(0, |sum, word| sum | (word ^ number));
    if difference == 0 { Ok(number) } else { Err(format!("message {number} arrived damaged")) }
}
