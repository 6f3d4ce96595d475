// SPDX-License-Identifier: MIT OR Apache-2.0
//! What nodes log: on the console, on /rosout, and from real-time threads.

mod common;

use std::time::Duration;

use common::{context, realtime, run_again};
use tautline::logging::{flush, lost_lines};
use tautline::rcl_interfaces::msg::Log;
use tautline::{
    Context, LogSeverity, Logger, Node, Qos, Realtime, Subscription, log_debug, log_error, log_fatal,
    log_info, log_warn,
};
use tautline_rt::{Policy, ThreadBuilder};

fn rosout(node: &mut Node) -> Subscription<Log> {
    let qos = Qos::keep_last(1000).transient_local();
    node.subscribe("/rosout", qos).unwrap()
}

type Heard = (String, u8, String);

fn heard(subscription: &Subscription<Log>) -> Vec<Heard> {
    std::iter::from_fn(|| subscription.try_take().unwrap())
        .map(|log| log.to_owned())
        .map(|log| (log.name, log.level, log.msg))
        .collect()
}

/// What has been logged may come from the history.
fn wait_for(count: u64, node: &mut Node, subscription: &Subscription<Log>) -> Vec<Heard> {
    let mut lines = Vec::new();
    while (lines.len() as u64) < count {
        node.spin_once(Duration::from_millis(10));
        lines.extend(heard(subscription));
    }
    lines
}

#[test]
fn what_a_nodes_loggers_say_is_on_rosout() {
    let ctx = context(16);
    let mut node = Node::create(ctx, "arm", "/robot").unwrap();
    let subscription = rosout(&mut node);
    let logger = node.logger().clone();
    assert_eq!(&*logger, "robot.arm");
    log_debug!(logger, "not wanted");
    log_info!(node.logger(), "{} of {}", 1, 2);
    log_warn!("another", "only on the console");
    let driver = logger.child("driver");
    driver.set_level(LogSeverity::Error);
    log_warn!(driver, "not wanted");
    log_error!(driver, "broken");
    logger.set_level(LogSeverity::Debug);
    log_debug!(logger, "wanted");
    for attempt in 0..3 {
        log_info!(logger.once(), "attempt {attempt}");
        log_fatal!(logger.throttle(Duration::from_secs(3600)), "attempt {attempt}");
    }
    let line = |name: &str, level, text: &str| (name.to_owned(), level, text.to_owned());
    assert_eq!(
        wait_for(5, &mut node, &subscription),
        [
            line("robot.arm", 20, "1 of 2"),
            line("robot.arm.driver", 40, "broken"),
            line("robot.arm", 10, "wanted"),
            line("robot.arm", 20, "attempt 0"),
            line("robot.arm", 50, "attempt 0"),
        ]
    );
}

#[test]
fn one_that_comes_late_hears_what_was_logged() {
    let ctx = context(181);
    let node = Node::create(ctx.clone(), "early", "").unwrap();
    log_info!(node.logger(), "first");
    log_info!(node.logger(), "second");
    let mut late = Node::create(ctx, "late", "").unwrap();
    let subscription = rosout(&mut late);
    let lines = wait_for(2, &mut late, &subscription);
    assert_eq!(lines.iter().map(|(.., text)| text.as_str()).collect::<Vec<_>>(), ["first", "second"]);
}

#[test]
fn a_topic_that_was_opened_for_few_lines_carries_them() {
    let mut node = Node::create(context(6), "few", "").unwrap();
    let subscription = node.subscribe::<Log>("/rosout", Qos::keep_last(5)).unwrap();
    log_info!(node.logger(), "heard");
    assert_eq!(wait_for(1, &mut node, &subscription)[0].2, "heard");
}

#[test]
fn a_real_time_thread_never_waits_and_its_lines_arrive_or_are_counted() {
    if !realtime() {
        return;
    }
    let ctx = context(198);
    let mut node = Node::create(ctx, "control", "").unwrap();
    let subscription = rosout(&mut node);
    let logger = node.logger().clone();
    // Others wait for this one's turn to write; a real-time thread does not even then.
    let thread = ThreadBuilder::new("cb:control").policy(Policy::Fifo(30)).spawn(move || {
        move || {
            for number in 0..1000 {
                log_info!(logger, "line {number}");
            }
        }
    });
    thread.unwrap().join().unwrap();
    flush();
    let lost = lost_lines();
    assert!(lost <= 1000 - 64, "{lost} lost");
    let lines = wait_for(1000 - lost, &mut node, &subscription);
    assert_eq!(lines[0], ("control".to_owned(), 20, "line 0".to_owned()));
}

#[test]
fn the_console_has_lines_as_those_of_ros() {
    let name = "the_console_has_lines_as_those_of_ros";
    let variables = [("RCUTILS_COLORIZED_OUTPUT", "0")];
    if let Some(output) = run_again(name, &variables) {
        assert!(output.status.success(), "{output:?}");
        let text = String::from_utf8(output.stderr).unwrap();
        let lines: Vec<&str> = text.lines().filter(|line| line.starts_with('[')).collect();
        assert_eq!(lines.len(), 2, "{text}");
        let rest = lines[0].strip_prefix("[WARN] [").unwrap();
        let (time, rest) = rest.split_once("] ").unwrap();
        assert_eq!(rest, "[talker]: too fast");
        let (sec, nanosec) = time.split_once('.').unwrap();
        assert!(
            sec.len() == 10 && nanosec.len() == 9 && sec.parse::<u64>().unwrap() > 1_600_000_000,
            "{time}"
        );
        assert!(lines[1].ends_with("[talker.driver]: debugged"), "{text}");
        return;
    }
    let args =
        ["--ros-args", "--log-level", "warn", "--log-level", "talker.driver:=debug", "--disable-rosout-logs"];
    let ctx = Context::builder().domain(45).realtime(Realtime::Off).args(args).build().unwrap();
    let mut node = Node::create(ctx, "talker", "").unwrap();
    let subscription = rosout(&mut node);
    log_info!(node.logger(), "not wanted");
    log_warn!(node.logger(), "too fast");
    log_debug!(Logger::new("talker.driver"), "debugged");
    node.spin_once(Duration::from_millis(10));
    assert!(heard(&subscription).is_empty());
}
