// SPDX-License-Identifier: MIT OR Apache-2.0
//! The system file at run time: callbacks get the priorities, cores and capacities that were computed.

mod common;

use common::File;
use std::time::Duration;
use tautline::{Context, CoreSet, Error, Limits, Node, Policy, Realtime, SystemError};

const DOMAIN: u32 = 195;

/// Two callbacks on one core; the slow one's queue needs more than one place.
const SYSTEM: &str = r#"
[hosts.robot]
cores = 1
sampler_priority = 40

[nodes.driver]

[topics]
scan = { period = "10ms" }
odom = { period = "20ms", depth = 7 }

[callbacks.fast]
topic = "scan"
wcet = "4ms"
priority = 30

[callbacks.slow]
topic = "scan"
wcet = "5ms"
priority = 20
deadline = "100ms"

[callbacks.stated]
topic = "odom"
wcet = "1ms"
priority = 10
deadline = "500ms"
"#;

fn context(file: &File) -> Result<Context, Error> {
    Context::builder().domain(DOMAIN).realtime(Realtime::Off).system(&file.0).build()
}

#[test]
fn a_callback_gets_what_the_file_says() {
    let file = File::new("says", SYSTEM);
    let ctx = context(&file).unwrap();
    let fast = ctx.callback("fast").unwrap();
    assert_eq!((fast.policy, fast.cores), (Policy::Fifo(30), Some(CoreSet::one(0))));
    assert_eq!((fast.name.as_str(), fast.period), ("fast", Some(Duration::from_millis(10))));
    let slow = ctx.callback("slow").unwrap();
    assert_eq!((slow.policy, slow.deadline), (Policy::Fifo(20), Some(Duration::from_millis(100))));
    assert_eq!((fast.budget, slow.budget), (Some(Duration::from_millis(4)), Some(Duration::from_millis(5))));
    // By name it can be spawned.
    let node = Node::create(ctx, "driver", "").unwrap();
    node.spawn_callback(fast, async {}).unwrap().join().unwrap();
}

#[test]
fn publishers_wake_the_threads_that_need_no_sampler() {
    let direct = |name: &str, text: &str| {
        let file = File::new(name, text);
        let ctx = context(&file).unwrap();
        ["fast", "slow", "stated"].map(|name| ctx.callback(name).unwrap().direct_wake)
    };
    // The first two take one topic.
    assert_eq!(direct("direct", SYSTEM), [false, false, true]);
    let timer = SYSTEM.replace("topic = \"odom\"", "period = \"20ms\"");
    let stated = timer.replace("priority = 20\n", "priority = 20\ndirect_wake = true\n");
    assert_eq!(direct("direct-timer", &timer), [false; 3]);
    assert_eq!(direct("direct-stated", &stated), [false, true, false]);
}

#[test]
fn a_reservation_is_bound_where_the_file_says() {
    let reserved = |core: &str| {
        let text = SYSTEM.replace(
            "priority = 20\n",
            &format!("core = {core}\nreservation = {{ runtime = \"6ms\", period = \"10ms\" }}\n"),
        );
        let file = File::new(&format!("reserved-{}", core.trim_matches('"')), &text);
        context(&file).unwrap().callback("slow").unwrap()
    };
    let policy = Policy::Deadline { runtime_ns: 6_000_000, period_ns: 10_000_000 };
    let bound = reserved("0");
    assert_eq!((bound.policy, bound.cores), (policy, Some(CoreSet::one(0))));
    let floating = reserved("\"any\"");
    assert_eq!((floating.policy, floating.cores), (policy, None));
    assert_eq!(floating.budget, Some(Duration::from_millis(5)));
}

#[test]
fn queues_are_as_deep_as_computed_or_stated() {
    let file = File::new("queues", SYSTEM);
    let ctx = context(&file).unwrap();
    assert_eq!(ctx.callback_qos("fast").unwrap().depth, 1);
    // Level utilisation 0.9, response 4 + 5 + 4 + ... past a period of 10 ms: more than one message waits.
    let report = tautline_analysis::file::SystemFile::parse(SYSTEM).unwrap().check();
    let computed = report.callbacks.iter().find(|callback| callback.entry.name == "slow").unwrap().capacity;
    assert_eq!(Some(ctx.callback_qos("slow").unwrap().depth), computed);
    assert_eq!(ctx.callback_qos("stated").unwrap().depth, 7);
    assert_eq!(tautline_analysis::file::MOST_DEPTH, Limits::MAX_DEPTH as u64);
}

#[test]
fn what_the_file_lacks_is_an_error_that_names_it() {
    let file = File::new("lacks", SYSTEM);
    let ctx = context(&file).unwrap();
    let text = ctx.callback("lidar").unwrap_err().to_string();
    assert!(
        text.contains("'lidar'") && text.contains("fast, slow, stated") && text.contains("host 'robot'"),
        "{text}"
    );
    let text = ctx.group("pair").unwrap_err().to_string();
    assert!(text.contains("'pair'") && text.contains("host 'robot'"), "{text}");
    let bare = Context::builder().domain(DOMAIN).realtime(Realtime::Off).build().unwrap();
    let text = bare.callback("fast").unwrap_err().to_string();
    assert!(text.contains("ContextBuilder::system"), "{text}");
}

#[test]
fn a_bad_file_is_refused_with_line_and_column() {
    let file = File::new("bad", &SYSTEM.replace("wcet = \"4ms\"", "wect = \"4ms\""));
    let text = context(&file).unwrap_err().to_string();
    assert!(text.contains("14:1: unknown key `wect`") && text.contains("lacks `wcet`"), "{text}");
    let text = Context::builder().domain(DOMAIN).system("/nowhere.toml").build().unwrap_err().to_string();
    assert!(text.contains("/nowhere.toml"), "{text}");
}

#[test]
fn of_several_hosts_one_must_be_named() {
    let two = format!("{SYSTEM}\n[hosts.station]\ncores = 1\n")
        .replace("[nodes.driver]", "[nodes.driver]\nhost = \"robot\"\ncore = 0");
    let file = File::new("hosts", &two);
    let text = context(&file).unwrap_err().to_string();
    assert!(text.contains("has several hosts: set TAUT_HOST") && text.ends_with("robot, station"), "{text}");
    let named =
        |host| Context::builder().domain(DOMAIN).realtime(Realtime::Off).system(&file.0).host(host).build();
    assert!(named("robot").unwrap().callback("fast").is_ok());
    assert!(matches!(
        named("station").unwrap().callback("fast"),
        Err(Error::System(SystemError::UnknownCallback { .. }))
    ));
    let Err(Error::System(error @ SystemError::Host { .. })) = named("moon") else { panic!("no such host") };
    assert!(error.to_string().contains("has no host 'moon': set TAUT_HOST"), "{error}");
}
