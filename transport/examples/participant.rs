// SPDX-License-Identifier: MIT OR Apache-2.0
//! One of two programs of a domain that may be of different versions: publishes its process's number, and prints those of others, and who is left out.
//! `cargo xtask versions` runs it beside that of another version.

use std::time::Duration;
use tautline_msgs::Message;
use tautline_transport::{Limits, Participant, Qos, Visitor};

#[derive(Message, Clone, Copy)]
#[message(name = "test_msgs/msg/Process", crate = "tautline_msgs")]
#[repr(C)]
struct Process {
    id: u32,
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let domain = std::env::args().nth(1).and_then(|domain| domain.parse().ok()).unwrap_or(0);
    let participant = Participant::new(domain)?;
    let qos = Qos::keep_last(4);
    let publisher = participant.create_publisher::<Process>("/process", qos, Limits::default())?;
    let subscription = participant.create_subscription::<Process>("/process", qos, Limits::default())?;
    let mut visitor = Visitor::new(domain)?;
    let own = std::process::id();
    loop {
        publisher.publish(&Process { id: own })?;
        while let Some(other) = subscription.try_take()?.filter(|sample| sample.id != own) {
            println!("heard {}", other.id);
        }
        visitor.graph()?;
        visitor.left_out().iter().for_each(|reason| println!("{reason}"));
        std::thread::sleep(Duration::from_millis(20));
    }
}
