// SPDX-License-Identifier: MIT OR Apache-2.0
//! Without privilege real-time is an error that names the fix. Alone in its file: it lowers the process's limits.

mod common;

use common::{context, isolate};
use futures::FutureExt;
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use rustix::thread::{CapabilitySet, capabilities, set_capabilities};
use tautline::{CallbackOptions, Context, Error, Node};
use tautline_rt::current_policy;

/// Makes the calling thread, and those it starts, an ordinary user's.
fn drop_privileges() {
    for resource in [Resource::Rtprio, Resource::Memlock] {
        let maximum = getrlimit(resource).maximum;
        setrlimit(resource, Rlimit { current: Some(0), maximum }).unwrap();
    }
    let mut sets = capabilities(None).unwrap();
    sets.effective.remove(CapabilitySet::SYS_NICE | CapabilitySet::IPC_LOCK);
    set_capabilities(None, sets).unwrap();
}

#[test]
fn spinning_without_privilege_names_the_fix() {
    isolate();
    drop_privileges();
    let own = current_policy().unwrap();
    // Memory comes first, then the priority.
    for (lock_memory, fix) in [(true, "memlock"), (false, "rtprio")] {
        let context = Context::builder().domain(209).realtime(tautline::Realtime::Required);
        let context = context.lock_memory(lock_memory).build().unwrap();
        let error = context.spin().unwrap_err();
        assert!(matches!(error, Error::Realtime(_)), "{error:?}");
        let message = error.to_string();
        assert!(
            message.contains("setcap cap_sys_nice,cap_ipc_lock+ep") && message.contains(fix),
            "{message}"
        );
        assert_eq!(current_policy().unwrap(), own);

        let node = Node::create(context, "poor", "").unwrap();
        let refused =
            node.spawn_callback(CallbackOptions::fifo(20).name("/x"), std::future::pending()).unwrap_err();
        let message = refused.to_string();
        assert!(message.starts_with("callback `/x` cannot start: real-time priority 20 needs"), "{message}");
        node.spawn_callback(CallbackOptions::other(), async {}).unwrap();
    }

    let context = context(209);
    let mut node = Node::create(context.clone(), "content", "").unwrap();
    let mut timer = node.create_wall_timer(std::time::Duration::from_millis(1)).unwrap();
    let callback = {
        let context = context.clone();
        node.spawn_callback(CallbackOptions::fifo(20), async move {
            timer.tick().await.unwrap();
            context.shutdown();
        })
    };
    context.spin().unwrap();
    assert!(callback.unwrap().join().is_ok());
    assert!(timer_is_gone(&mut node));
}

/// A slot is free again: another timer can be had, and has not ticked.
fn timer_is_gone(node: &mut Node) -> bool {
    let mut timer = node.create_wall_timer(std::time::Duration::from_secs(3600)).unwrap();
    timer.tick().now_or_never().is_none()
}
