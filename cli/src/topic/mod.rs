// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut topic`: the topics of a domain and their messages, of any type.

mod delay;
mod echo;
mod filter;
pub mod info;
mod publish;
mod rates;
mod sim_clock;
pub mod tap;

use crate::arguments::full_name;
use crate::arguments::full_type;
use crate::completions;
use crate::table::write_wanted;
use crate::verb::{CommonArgs, Outcome, Verbs};
use clap::Subcommand;
use rates::Unit;
use serde_json::Value;
use std::io::Write;
use tautline_transport::graph_of;

/// Lists topics, their publishers and subscriptions; measures rates, bandwidths and delays; prints and publishes messages.
///
/// Topics of other hosts are visible if this host runs `taut gateway`.
/// Types need not be compiled in: processes cache their definitions
/// in /tmp/tautline_UID/schemas.
#[derive(Subcommand, Clone, Debug)]
#[command(after_help = "Examples:
  taut topic list
  taut topic list --domain 7        another domain
  taut topic info /joint_states -v  the nodes, and the quality of service of each
  taut topic echo /joint_states     as ros2 topic echo, until Ctrl-C
  taut topic hz /scan --expect 39..41
  taut topic pub /chatter std_msgs/msg/String '{data: hello}' -r 10

Exit codes: 0 done, 1 the answer is no, 2 the arguments cannot be used.")]
pub enum Verb {
    /// Prints the topics with their types, places, and numbers of publishers and subscriptions
    List,
    /// Prints the type and the numbers of publishers and subscriptions of a topic
    Info {
        /// The topic
        #[arg(value_name = "TOPIC", add = completions::topics())]
        topic: String,
        /// Print the node, the identifier and the quality of service of each
        #[arg(short, long)]
        verbose: bool,
    },
    /// Prints the type of a topic
    Type {
        /// The topic
        #[arg(value_name = "TOPIC", add = completions::topics())]
        topic: String,
    },
    /// Prints the topics of a type; exits with 1 if there are none
    Find {
        /// The type, such as sensor_msgs/msg/Image
        #[arg(value_name = "TYPE", add = completions::topic_types())]
        type_name: String,
    },
    Echo(echo::EchoArgs),
    /// Prints the rate and the periods of each publisher of a topic
    ///
    /// Reads the counters of publishers on this host, which does not disturb them.
    #[command(after_help = "Examples:
  taut topic hz /scan
  taut topic hz /scan --expect 39..41          exits with 1 if the rate is outside
  taut topic hz /imu --take                    also periods of publishers above 400 Hz
  taut topic hz /scan --json --every 100ms | jq .rate_hz")]
    Hz(rates::RateArgs),
    /// Prints the bandwidth of each publisher of a topic, and the sizes of its messages
    ///
    /// Reads the counters of publishers on this host, which does not disturb them.
    #[command(after_help = "Examples:
  taut topic bw /camera
  taut topic bw /camera --expect ..1e8         exits with 1 if it is more")]
    Bw(rates::RateArgs),
    Delay(delay::DelayArgs),
    Pub(publish::PubArgs),
}

pub fn run(args: &Verbs<Verb>) -> Outcome {
    let common = &args.common;
    match &args.verb {
        Verb::List => {
            let graph = graph_of(common.domain()?)?;
            Ok(info::list(&info::topics(&graph), common.json, &mut crate::print::stdout())?)
        }
        Verb::Info { topic, verbose } => print_info(common, topic, *verbose),
        Verb::Type { topic } => {
            let graph = graph_of(common.domain()?)?;
            let topics: Vec<_> =
                info::topics(&graph).iter().map(|topic| (topic.name, topic.type_name)).collect();
            write_wanted(common.json, &full_name(topic), &topics, ("topic", "topic list"))
        }
        Verb::Find { type_name } => {
            let graph = graph_of(common.domain()?)?;
            let types: Vec<_> =
                info::topics(&graph).iter().map(|topic| (topic.type_name, topic.name)).collect();
            write_wanted(common.json, &full_type(type_name, "msg"), &types, ("topic of type", "topic list"))
        }
        Verb::Echo(args) => echo::run(args, common),
        Verb::Hz(args) => rates::run(args, Unit::Messages, common),
        Verb::Bw(args) => rates::run(args, Unit::Bytes, common),
        Verb::Delay(args) => delay::run(args, common),
        Verb::Pub(args) => publish::run(args, common),
    }
}

fn print_info(common: &CommonArgs, topic: &str, verbose: bool) -> Outcome {
    let name = full_name(topic);
    let graph = graph_of(common.domain()?)?;
    let mut topics = info::topics(&graph);
    topics.retain(|topic| topic.name == name);
    if topics.is_empty() {
        return Err(tap::unknown(&graph, &name));
    }
    let mut out = crate::print::stdout();
    if common.json {
        let topics = topics.iter().map(info::Topic::info_json);
        return Ok(writeln!(out, "{}", Value::from_iter(topics))?);
    }
    // Hosts may disagree on a topic's type: then there are several.
    Ok(topics.iter().try_for_each(|topic| topic.print(verbose, &mut out))?)
}
