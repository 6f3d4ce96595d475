//! Listener: a subscription whose messages are read where they were written, in shared memory.
//!
//! Without an argument it listens until Ctrl-C; with one, to that many messages.
// SPDX-License-Identifier: MIT OR Apache-2.0

use futures::StreamExt;
use std::process::ExitCode;
use tautline::{CallbackOptions, Node, Qos, Result};
use tautline_examples::{UInt64, context, exit_code};

fn main() -> ExitCode {
    let messages = std::env::args().nth(1).and_then(|argument| argument.parse().ok()).unwrap_or(usize::MAX);
    exit_code(listen(messages))
}

fn listen(messages: usize) -> Result<()> {
    let context = context()?;
    let mut node = Node::create(context.clone(), "listener", "")?;
    let subscription = node.subscribe::<UInt64>("/counter", Qos::default())?;
    let counters = subscription.counters();
    println!("listening on {}", subscription.topic());

    let listener = node.spawn_callback(CallbackOptions::fifo(10).name("listener"), async move {
        let heard = StreamExt::take(subscription, messages);
        heard
            .for_each(|message| {
                println!("heard {}", message.data); // `message` derefs into shared memory.
                async {}
            })
            .await;
        context.shutdown();
    })?;
    node.spin()?; // This thread is the sampler until the shutdown.
    println!("lost {}", counters.lost());
    Ok(listener.join()?)
}
