// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut topic pub`: publishes messages written by hand.

use crate::arguments::full_name;
use crate::arguments::{WrittenMessage, type_and_values};
use crate::completions;
use crate::times::Times;
use crate::verb::{CommonArgs, End, Failure, Outcome};
use clap::{Args, ValueEnum};
use serde_json::json;
use std::io::Write;
use std::sync::Arc;
use std::time::Duration;
use tautline::{Context, Json, Node, Publisher, Qos, Realtime};
use tautline_rt::clock::{monotonic_ns, sleep_until_monotonic};
use tautline_rt::{Policy, set_policy};
use tautline_transport::{EndpointKind, TopicEndpoint, Visitor, graph_of};

/// The time in which a subscription on another host or in ROS discovers its new publisher there.
const FAR: Duration = Duration::from_secs(1);

/// Publishes a message, once or at a rate
///
/// Values are YAML or JSON. Omitted fields have their defaults; a header that is `auto` and a time that is `now` get the time of each
/// publication. The type may be omitted if the topic exists. At the end the verb prints how late the messages were.
#[derive(Args, Clone, Debug)]
#[command(after_help = "Examples:
  taut topic pub /chatter std_msgs/msg/String '{data: hello}' --once
  taut topic pub /cmd_vel geometry_msgs/msg/Twist '{linear: {x: 0.5}}' -r 50 --priority 40
  taut topic pub /pose geometry_msgs/msg/PoseStamped '{header: auto}' -r 10
  taut topic pub /pose '{header: {stamp: now, frame_id: map}}' -n 100")]
pub struct PubArgs {
    /// The topic
    #[arg(value_name = "TOPIC", add = completions::topics())]
    topic: String,
    /// The type, such as std_msgs/msg/String, required if the topic does not exist; the values [default: each field's default]
    #[arg(value_name = "[TYPE] [VALUES]", num_args = 0..=2, add = completions::message_types())]
    message: Vec<String>,
    /// Publish one message when there is a subscription; if that is on another host or in ROS, a second after a gateway or bridge
    /// subscribes to the topic
    #[arg(long, conflicts_with_all = ["rate", "count"])]
    once: bool,
    /// Messages a second
    #[arg(short, long, value_name = "HZ", default_value = "1", value_parser = rate)]
    rate: f64,
    /// End after N messages
    #[arg(short = 'n', long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    count: Option<u64>,
    /// Set header.stamp, or stamp, of each message
    #[arg(long, value_enum, value_name = "WHEN")]
    stamp: Option<Stamp>,
    /// Wait for N subscriptions first
    #[arg(short = 'w', long, value_name = "N")]
    wait: Option<usize>,
    /// Publish with this priority of SCHED_FIFO
    #[arg(long, value_name = "1..99", value_parser = clap::value_parser!(u8).range(1..=99))]
    priority: Option<u8>,
    /// Depth of the publisher's history
    #[arg(long, value_name = "N", default_value_t = 10, value_parser = clap::value_parser!(u16).range(1..))]
    qos_depth: u16,
    #[arg(long, value_parser = ["reliable", "best_effort"], default_value = "reliable")]
    qos_reliability: String,
    #[arg(long, value_parser = ["volatile", "transient_local"], default_value = "volatile")]
    qos_durability: String,
}

#[derive(ValueEnum, Clone, Copy, Debug)]
enum Stamp {
    /// The time of its publication
    Now,
}

fn rate(text: &str) -> Result<f64, String> {
    let rate = text.parse::<f64>().map_err(|_| format!("'{text}' is no number"))?;
    if (1e-6..=1e6).contains(&rate) { Ok(rate) } else { Err("a rate is 0.000001 to 1000000 Hz".into()) }
}

impl PubArgs {
    fn qos(&self) -> Qos {
        let qos = Qos::keep_last(self.qos_depth.into());
        let qos = if self.qos_reliability == "best_effort" { qos.best_effort() } else { qos };
        if self.qos_durability == "transient_local" { qos.transient_local() } else { qos }
    }

    /// The type and the values.
    fn message(&self, domain: u32, topic: &str) -> Outcome<(String, &str)> {
        let (type_name, values) = type_and_values(&self.message, "msg");
        if let Some(type_name) = type_name {
            return Ok((type_name, values));
        }
        let known = graph_of(domain)?.topic_type(topic).ok_or_else(|| {
            Failure::unusable(format!(
                "the type of '{topic}' is not known, because no node publishes or subscribes to it: give the type, as in `taut topic \
                 pub {topic} std_msgs/msg/String '{{data: hello}}'`"
            ))
        })?;
        Ok((known.name.into_owned(), values))
    }
}

pub fn run(args: &PubArgs, common: &CommonArgs) -> Outcome {
    let end = End::of(common)?;
    let (domain, topic) = (common.domain()?, full_name(&args.topic));
    let (type_name, values) = args.message(domain, &topic)?;
    let context = Context::builder().domain(domain).realtime(Realtime::Off).build()?;
    let mut node = Node::create(context, &format!("taut_pub_{}", std::process::id()), "")?;
    let publisher = node.create_publisher_untyped(&topic, &type_name, args.qos())?;
    let mut message = WrittenMessage::new(publisher.definition(), values)?;
    if let Some(Stamp::Now) = args.stamp {
        message.add_stamp()?;
    }
    let wanted = args.wait.or(args.once.then_some(1));
    if let Some(wanted) = wanted {
        wait_for_subscriptions(domain, &node, &publisher, wanted, &end)?;
    }
    if let Some(priority) = args.priority {
        set_policy(Policy::Fifo(priority))?;
    }
    let count = if args.once { Some(1) } else { args.count };
    let late = send(args, &publisher, message, count, &end)?;
    let mut printed = Ok(());
    if common.json {
        let report = json!({ "topic": topic, "type": type_name, "published": late.count(), "late_ms": late.to_json() });
        printed = writeln!(crate::print::stdout(), "{report}");
    } else if let Some([p50, p99, max]) = late.ms().filter(|_| late.count() > 1) {
        eprintln!(
            "taut: published {} messages on '{topic}', late by {p50:.3} ms (p50), {p99:.3} (p99), {max:.3} at most",
            late.count()
        );
    }
    match count.filter(|count| late.count() < *count) {
        Some(count) => Err(Failure::no(format!("{} of {count} messages were published", late.count()))),
        None => Ok(printed?),
    }
}

fn wait_for_subscriptions(
    domain: u32,
    node: &Node,
    publisher: &Publisher<Json>,
    wanted: usize,
    end: &End,
) -> Outcome {
    let what = || format!("{wanted} subscriptions of '{}'", publisher.topic());
    end.wait(what, || {
        let graph = node.context().as_ref().graph()?;
        let elsewhere = graph.endpoints.iter().filter(|end| {
            end.is_remote && end.topic == publisher.topic() && end.kind == EndpointKind::Subscription
        });
        Ok((publisher.subscription_count().max(elsewhere.count()) >= wanted).then_some(()))
    })?;
    if publisher.subscription_count() >= wanted {
        return Ok(());
    }
    // The subscriptions are on another host, or in ROS.
    let (mut visitor, pid) = (Visitor::new(domain)?, Some(std::process::id()));
    let what = || format!("a gateway or bridge to take '{}'", publisher.topic());
    end.wait(what, || {
        let graph = visitor.graph()?;
        let is_own = |end: &&Arc<TopicEndpoint>| {
            end.kind == EndpointKind::Publisher && end.pid == pid && end.topic == publisher.topic()
        };
        let Some(own) = graph.endpoints.iter().find(is_own) else { return Ok(None) };
        Ok((!visitor.overwritten(own)?.is_empty()).then_some(()))
    })?;
    end.pause(FAR);
    eprintln!(
        "taut: the subscriptions of '{}' are on other hosts or in ROS: whether the message arrives there is not known",
        publisher.topic()
    );
    Ok(())
}

/// Publishes at absolute times. Returns how late each message was.
fn send(
    args: &PubArgs,
    publisher: &Publisher<Json>,
    mut message: WrittenMessage,
    count: Option<u64>,
    end: &End,
) -> Outcome<Times> {
    let mut late = Times::default();
    let mut bytes = message.message.to_cdr();
    let start_ns = monotonic_ns();
    for n in 0.. {
        if count == Some(n) || end.is_reached() {
            break;
        }
        let due_ns = start_ns + (n as f64 * 1e9 / args.rate) as u64;
        // The last 100 ms are slept exactly; Ctrl-C does not end that sleep.
        let ahead = Duration::from_nanos(due_ns.saturating_sub(monotonic_ns()));
        end.pause(ahead.saturating_sub(Duration::from_millis(100)));
        if end.is_reached() {
            break;
        }
        sleep_until_monotonic(due_ns);
        if message.has_stamps() {
            message.stamp()?;
            bytes = message.message.to_cdr();
        }
        late.record(monotonic_ns().saturating_sub(due_ns));
        publisher.publish_raw(&bytes)?;
    }
    Ok(late)
}
