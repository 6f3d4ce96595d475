// SPDX-License-Identifier: MIT OR Apache-2.0
//! Another text of the system file, taken up while callbacks run; what cannot be taken up changes nothing.

mod common;

use std::future::pending;
use std::time::Duration;

use common::{File, realtime};
use tautline::{
    CallbackGroup, CallbackHandle, CallbackOptions, Context, Error, Node, Policy, Realtime, SystemError,
    apply_system,
};
use tautline_analysis::file::SystemFile;
use tautline_executor::{ForeignStatistics, StatisticsFile};
use tautline_rt::{policy_of, set_policy_of};
use tautline_system::{Admission, Gate};

const DOMAIN: u32 = 98;

/// One node of two callbacks on core 0.
fn text(priority: u8, wcet: &str, more: &str) -> String {
    format!(
        "[hosts.robot]\ncores = [0]\n[nodes.driver]\n\
         [callbacks.fast]\nperiod = \"10ms\"\nwcet = \"{wcet}\"\npriority = {priority}\n{more}\n\
         [callbacks.slow]\nperiod = \"100ms\"\nwcet = \"5ms\"\npriority = 20\ngroup = \"rest\"\n[groups.rest]\n"
    )
}

fn spawn(context: &Context) -> (Node, CallbackHandle, CallbackHandle) {
    let node = Node::create(context.clone(), "driver", "").unwrap();
    let fast = node.spawn_callback(context.callback("fast").unwrap(), pending()).unwrap();
    let mut group = CallbackGroup::new();
    let none = futures::stream::pending::<u64>();
    group.add(context.callback("slow").unwrap(), none, |n| *n, |_| async {});
    let slow = node.spawn_group(context.group("rest").unwrap(), group).unwrap();
    (node, fast, slow)
}

fn apply(file: &File) -> Result<usize, String> {
    apply_system(DOMAIN, &file.0).map(|processes| processes.len()).map_err(|error| error.to_string())
}

#[test]
fn a_new_text_is_taken_up_by_what_runs_or_by_nobody() {
    if !realtime() {
        return;
    }
    tautline_rt::domain::set_scope(&format!("apply-{}", std::process::id())).unwrap();
    let file = File::new("text", &text(30, "2ms", ""));
    assert!(matches!(apply_system(DOMAIN, &file.0), Err(Error::NobodyHas { .. })));
    let context = file.context(DOMAIN).unwrap();
    let (_node, fast, slow) = spawn(&context);
    let ms = Duration::from_millis;
    let now = || {
        let of = |callback: &CallbackHandle| policy_of(callback.thread().tid).unwrap();
        (of(&fast), of(&slow), fast.stats().budget(), fast.stats().deadline())
    };
    let first = (Policy::Fifo(30), Policy::Fifo(20), Some(ms(2)), Some(ms(10)));
    assert_eq!((apply(&file), now()), (Ok(1), first), "the same text");

    file.write(&text(10, "3ms", "deadline = \"9ms\""));
    assert_eq!(apply(&file), Ok(1));
    let second = (Policy::Fifo(10), Policy::Fifo(20), Some(ms(3)), Some(ms(9)));
    assert_eq!(now(), second);
    assert_eq!(tautline_executor::CallbackSnapshot::of(fast.stats()).unwrap().priority, Some(10));
    // Whatever is spawned now is as the new text says.
    assert_eq!(context.callback("fast").unwrap().policy, Policy::Fifo(10));

    for (more, why) in [
        ("publishes = \"x\"\noverrun = \"demote\"", "another `overrun`, which needs a restart"),
        ("jitter = \"15ms\"", "would take"),
        ("reservation = { runtime = \"4ms\", period = \"10ms\" }", "priority"),
    ] {
        file.write(&text(30, "2ms", more));
        let error = apply(&file).unwrap_err();
        assert!(error.contains(why), "{error}");
        assert_eq!(now(), second);
    }
    let moved = text(30, "2ms", "").replace("period = \"10ms\"", "period = \"20ms\"");
    file.write(&moved);
    let error = apply(&file).unwrap_err();
    assert!(error.contains("another period") && error.contains("nothing was changed"), "{error}");
    file.write("[hosts");
    assert!(matches!(apply_system(DOMAIN, &file.0), Err(Error::System(SystemError::File(_)))));
    assert_eq!(now(), second);

    file.write(&text(30, "2ms", ""));
    assert_eq!((apply(&file), now()), (Ok(1), first));
}

/// `taut apply --timeout` has ended while the process was stopped.
#[test]
fn an_order_whose_requester_has_ended_is_not_followed() {
    let domain = DOMAIN + 2;
    tautline_rt::domain::set_scope(&format!("apply-{}", std::process::id())).unwrap();
    let file = File::new("late", &text(30, "2ms", ""));
    let builder = Context::builder().domain(domain).realtime(Realtime::Off);
    let context = builder.system(&file.0).build().unwrap();
    let (_node, fast, _slow) = spawn(&context);
    let new = text(30, "3ms", "");
    file.write(&new);
    let hash = SystemFile::parse(&new).unwrap().fingerprint();
    let process = ForeignStatistics::list(&StatisticsFile::prefix(domain)).unwrap().remove(0);
    let answered = |number: u64| {
        process.order(number, hash, true).unwrap();
        tautline_transport::call_all(domain).unwrap();
        std::iter::repeat_with(|| process.answer(number).unwrap()).find_map(|answer| {
            std::thread::yield_now();
            answer
        })
    };
    let refused = answered(1).unwrap().unwrap_err();
    assert!(refused.contains("whoever ordered it has ended"), "{refused}");
    assert_eq!(fast.stats().budget(), Some(Duration::from_millis(2)));
    let gate = Gate::enter(domain, Admission::Check).unwrap();
    assert_eq!(answered(2), Some(Ok(())));
    drop(gate);
    assert_eq!(fast.stats().budget(), Some(Duration::from_millis(3)));
}

#[test]
fn what_runs_besides_keeps_its_deadlines() {
    if !realtime() {
        return;
    }
    tautline_rt::domain::set_scope(&format!("apply-{}", std::process::id())).unwrap();
    let file = File::new("besides", &text(30, "2ms", ""));
    let other = Context::builder().domain(DOMAIN + 1).build().unwrap();
    let context = file.context(DOMAIN + 1).unwrap();
    let (_node, fast, _slow) = spawn(&context);
    let node = Node::create(other, "other", "").unwrap();
    let options = CallbackOptions::fifo(25).core(0).name("loose").period(Duration::from_millis(10));
    let _loose = node.spawn_callback(options.budget(Duration::from_millis(5)), pending()).unwrap();
    file.write(&text(30, "6ms", ""));
    let error = apply_system(DOMAIN + 1, &file.0).unwrap_err();
    assert!(
        matches!(error, Error::System(SystemError::NotAdmitted { .. }))
            && error.to_string().contains("callback `loose`"),
        "{error}"
    );
    assert_eq!(fast.stats().budget(), Some(Duration::from_millis(2)));
    // A policy that somebody else has set meanwhile does not stop it.
    set_policy_of(fast.thread().tid, Policy::Fifo(5)).unwrap();
    file.write(&text(30, "3ms", ""));
    apply_system(DOMAIN + 1, &file.0).unwrap();
    assert_eq!(policy_of(fast.thread().tid).unwrap(), Policy::Fifo(30));
}
