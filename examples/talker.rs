//! Talker: a timer, and a publisher of one message per release. Run `listener` in another terminal.
//!
//! Without an argument it talks until Ctrl-C; with one, that many messages. A program may be killed at any instant: what
//! it leaves in shared memory is removed by the domain's other participants.
// SPDX-License-Identifier: MIT OR Apache-2.0

use futures::StreamExt;
use std::process::ExitCode;
use std::time::Duration;
use tautline::{CallbackOptions, Node, Qos, Result};
use tautline_examples::{UInt64, context, exit_code};

fn main() -> ExitCode {
    let messages = std::env::args().nth(1).and_then(|argument| argument.parse().ok()).unwrap_or(u64::MAX);
    exit_code(talk(messages))
}

fn talk(messages: u64) -> Result<()> {
    let context = context()?;
    let mut node = Node::create(context.clone(), "talker", "")?;
    let publisher = node.create_publisher::<UInt64>("/counter", Qos::default())?;
    let mut timer = node.create_wall_timer(Duration::from_millis(100))?;

    let talker = node.spawn_callback(CallbackOptions::fifo(10).name("talker"), async move {
        for data in 1..=messages {
            timer.next().await;
            match publisher.publish(&UInt64 { data }) {
                Ok(()) => println!("said {data}"),
                Err(error) => eprintln!("{error}"),
            }
        }
        context.shutdown();
    })?;
    node.spin()?; // This thread is the sampler until the shutdown.
    Ok(talker.join()?)
}
