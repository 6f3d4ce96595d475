// SPDX-License-Identifier: MIT OR Apache-2.0
//! The publisher as the paper has it: absolute timers by timerfd, one Tokio worker that publishes.

use std::io;
use std::os::fd::OwnedFd;
use std::time::Duration;

use futures::future::join_all;
use r2r::std_msgs::msg::UInt64;
use r2r::{Context, Node, Publisher, QosProfile};
use rustix::time::{Itimerspec, TimerfdClockId, TimerfdFlags, TimerfdTimerFlags, Timespec};
use tautline_paper::{Job, Line, Published, Topic, priorities, say, set_up_publisher};
use tautline_rt::{Policy, clock, set_policy};
use tokio::io::unix::AsyncFd;
use tokio::runtime::Builder;

use rival_r2r::Result;

/// Time between set-up and the first release, which all topics have in common: the critical instant.
const LEAD: Duration = Duration::from_millis(200);
/// How long discovery may take.
const PATIENCE_NS: u64 = 30_000_000_000;

pub fn run(job: &Job) -> Result<()> {
    set_up_publisher(job)?;
    let mut node = Node::create(Context::create()?, "publisher", &job.namespace)?;
    let mut publishers = Vec::new();
    for topic in &job.topics {
        let qos = QosProfile::default().keep_last(topic.depth);
        publishers.push(node.create_publisher::<UInt64>(&topic.full_name(job), qos)?);
    }
    wait_for_subscriber(&publishers)?;

    let mut builder = Builder::new_multi_thread();
    builder.worker_threads(1).enable_io();
    if job.realtime {
        // Refused only if this process could not have its own, higher priority either.
        builder.on_thread_start(|| drop(set_policy(Policy::Fifo(priorities::PUBLISHER_WORKER))));
    }
    let runtime = builder.build()?;
    let first_ns = clock::monotonic_ns() + LEAD.as_nanos() as u64;
    let end_ns = first_ns + job.duration_ns();
    let cpu_before_ns = clock::process_cpu_ns();
    let mut tasks = Vec::new();
    for (topic, publisher) in job.topics.iter().zip(publishers) {
        let timer = timer(first_ns, topic)?;
        tasks.push(runtime.spawn(publish(publisher, timer, first_ns, topic.period_ns, end_ns)));
    }
    let mut published = Published::default();
    for outcome in runtime.block_on(join_all(tasks)) {
        let (sent, missed) = outcome??;
        published.messages.push(sent);
        published.missed += missed;
    }
    published.cpu_ns = clock::process_cpu_ns() - cpu_before_ns;
    say(&Line::Published(published));
    // What was sent must arrive before this end of it is gone.
    let _ = io::copy(&mut io::stdin().lock(), &mut io::sink());
    Ok(())
}

fn wait_for_subscriber(publishers: &[Publisher<UInt64>]) -> Result<()> {
    let give_up = clock::monotonic_ns() + PATIENCE_NS;
    while clock::monotonic_ns() < give_up {
        let mut matched = true;
        for publisher in publishers {
            matched &= publisher.get_inter_process_subscription_count()? > 0;
        }
        if matched {
            return Ok(());
        }
        std::thread::sleep(Duration::from_millis(10));
    }
    Err("the subscriber was not discovered".into())
}

/// A timer at `first_ns` and every period after it, on the monotonic clock.
fn timer(first_ns: u64, topic: &Topic) -> Result<OwnedFd> {
    let flags = TimerfdFlags::NONBLOCK | TimerfdFlags::CLOEXEC;
    let timer = rustix::time::timerfd_create(TimerfdClockId::Monotonic, flags)?;
    let at = Itimerspec { it_interval: timespec(topic.period_ns), it_value: timespec(first_ns) };
    rustix::time::timerfd_settime(&timer, TimerfdTimerFlags::ABSTIME, &at)?;
    Ok(timer)
}

fn timespec(ns: u64) -> Timespec {
    Timespec { tv_sec: (ns / 1_000_000_000) as i64, tv_nsec: (ns % 1_000_000_000) as i64 }
}

/// Publishes a message at each release before `end_ns`; returns how many, and how many releases were missed.
async fn publish(
    publisher: Publisher<UInt64>,
    timer: OwnedFd,
    first_ns: u64,
    period_ns: u64,
    end_ns: u64,
) -> io::Result<(u64, u64)> {
    // SAFETY: the descriptor is the timer's for as long as the AsyncFd owns it.
    let timer = unsafe { AsyncFd::register(timer) }?;
    let (mut next, mut sent, mut missed) = (0, 0, 0);
    loop {
        let mut ready = timer.readable().await?;
        let mut expirations = [0; 8];
        match rustix::io::read(timer.get_ref(), &mut expirations) {
            Ok(_) => {}
            Err(rustix::io::Errno::AGAIN) => {
                ready.clear_ready();
                continue;
            }
            Err(error) => return Err(error.into()),
        }
        let expirations = u64::from_ne_bytes(expirations);
        let release_ns = first_ns + (next + expirations - 1) * period_ns;
        next += expirations;
        if release_ns >= end_ns {
            return Ok((sent, missed));
        }
        missed += expirations - 1;
        sent += u64::from(publisher.publish(&UInt64 { data: release_ns }).is_ok());
    }
}
