//! Lifecycle: a managed node is configured, activated, and silent when it is not active; what is not possible is refused.
// SPDX-License-Identifier: MIT OR Apache-2.0

use std::process::ExitCode;
use std::sync::{Arc, Mutex};
use tautline::lifecycle::{CallbackReturn, State};
use tautline::{LifecycleCallbacks, LifecycleNode, ManagedNode, Node, Publisher, Qos, Result};
use tautline_examples::{UInt64, context, exit_code};

/// Shared with the thread that does the work.
type Speed = Arc<Mutex<Option<Publisher<UInt64>>>>;

struct Drive {
    speed: Speed,
}

impl LifecycleCallbacks for Drive {
    fn on_configure(&mut self, node: &mut ManagedNode) -> CallbackReturn {
        println!("configuring");
        let Ok(publisher) = node.create_publisher("~/speed", Qos::default()) else {
            return CallbackReturn::Failure;
        };
        *self.speed.lock().expect("nobody panics") = Some(publisher);
        CallbackReturn::Success
    }

    fn on_activate(&mut self, _: &mut ManagedNode) -> CallbackReturn {
        println!("activating: is the motor there?");
        CallbackReturn::Success
    }

    fn on_shutdown(&mut self, _: &mut ManagedNode, previous: State) -> CallbackReturn {
        println!("shutting down, from {previous}");
        CallbackReturn::Success
    }
}

fn main() -> ExitCode {
    exit_code(show())
}

fn show() -> Result<()> {
    let context = context()?;
    let mut listener = Node::create(context.clone(), "listener", "")?;
    let speeds = listener.subscribe::<UInt64>("/drive/speed", Qos::default())?;

    let speed = Speed::default();
    let drive = LifecycleNode::create(context, "drive", "", Drive { speed: speed.clone() })?;
    let publish = |data| -> Result<()> {
        let publisher = speed.lock().expect("nobody panics");
        let publisher = publisher.as_ref().expect("configured");
        publisher.publish(&UInt64 { data })?;
        println!("published {data}; {} so far were not sent", publisher.counters().silenced());
        Ok(())
    };
    if let Err(error) = drive.activate() {
        println!("{error}");
    }
    println!("{}", drive.configure()?.state);
    publish(1)?;
    println!("{}", drive.activate()?.state);
    publish(2)?;
    println!("{}", drive.deactivate()?.state);
    publish(3)?;
    println!("{}", drive.shutdown()?.state);
    while let Some(message) = speeds.try_take()? {
        println!("received {}", message.data);
    }
    Ok(())
}
