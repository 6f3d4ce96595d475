// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut log`: the log lines of nodes, and the levels of their loggers.

use crate::arguments::full_name;
use crate::call::NodeCaller;
use crate::compatibility::label;
use crate::completions;
use crate::print::Colour;
use crate::table::{BAD, WARNING};
use crate::verb::{CommonArgs, End, Failure, Outcome};
use clap::builder::{PossibleValuesParser, TypedValueParser};
use clap::{Args, Subcommand};
use serde_json::json;
use std::collections::BTreeSet;
use std::io::Write;
use std::time::{Duration, Instant};
use tautline::LogSeverity;
use tautline::rcl_interfaces::msg::{Log, LoggerLevel};
use tautline::rcl_interfaces::srv::{GetLoggerLevels, SetLoggerLevels};
use tautline_transport::{
    EndpointKind, Gid, GraphSnapshot, Limits, Participant, Qos, Subscription, TakeError, graph_of,
};

const TOPIC: &str = "/rosout";
/// The number of lines that ROS 2's nodes keep.
const DEPTH: usize = 1000;
/// The interval at which new lines are read. People do not notice it, and it costs little.
const POLL: Duration = Duration::from_millis(10);
/// The interval at which the list of nodes is read.
const LOOK: Duration = Duration::from_secs(1);

/// Prints the lines that nodes log on /rosout, beginning with those kept for late joiners; reads and sets levels.
///
/// Nodes of other hosts are visible if this host runs `taut gateway`.
#[derive(Args, Clone, Debug)]
#[command(after_help = "Examples:
  taut log                                  all lines, until Ctrl-C
  taut log /robot/arm --level warn          warnings and errors of a node's logger and its child loggers
  taut log --new --json | jq -r .text
  taut log level /robot/arm                 the level of the node's logger
  taut log level /robot/arm debug           from now on
  taut log level /robot/arm warn --logger robot.arm.driver

Exit codes: 0 done, 1 the answer is no, 2 the arguments cannot be used.")]
pub struct LogArgs {
    #[command(subcommand)]
    verb: Option<Verb>,
    #[command(flatten)]
    lines: LinesArgs,
    #[command(flatten)]
    common: CommonArgs,
}

#[derive(Args, Clone, Debug)]
struct LinesArgs {
    /// Print lines of these nodes only; waits for nodes that do not exist yet
    #[arg(value_name = "NODE", add = completions::nodes())]
    nodes: Vec<String>,
    /// Print lines of this severity and above
    #[arg(short, long, value_parser = severity(&LEVELS), value_name = "LEVEL", default_value = "debug")]
    level: LogSeverity,
    /// Print only new lines, not those that nodes keep for late joiners
    #[arg(long)]
    new: bool,
    /// End after N lines
    #[arg(short = 'n', long = "count", value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    count: Option<u64>,
    /// Print the place in the source that logged a line
    #[arg(long)]
    source: bool,
}

#[derive(Subcommand, Clone, Debug)]
enum Verb {
    /// Prints the level of a node's logger, or sets it
    ///
    /// Nodes of rclcpp and rclpy serve their levels if they were created with `enable_logger_service`, nodes of Tautline if they run
    /// `Node::make_logger_handler`.
    Level {
        /// The node's name with its namespace [default namespace: /]
        #[arg(value_name = "NODE", add = completions::nodes_with("set_logger_levels"))]
        node: String,
        /// The lowest severity to log; unset: the level of the parent logger
        #[arg(value_parser = severity(&LEVELS), value_name = "LEVEL")]
        level: Option<LogSeverity>,
        /// Another logger of the node's process [default: the node's own]
        #[arg(long, value_name = "NAME")]
        logger: Option<String>,
    },
}

pub const LEVELS: [&str; 6] = ["unset", "debug", "info", "warn", "error", "fatal"];

pub fn severity(levels: &'static [&'static str]) -> impl TypedValueParser<Value = LogSeverity> {
    PossibleValuesParser::new(levels).try_map(|name| name.parse().map_err(|()| "it is no level"))
}

pub fn run(args: &LogArgs) -> Outcome {
    match &args.verb {
        None => Lines::open(&args.lines, &args.common)?.run(),
        Some(Verb::Level { node, level, logger }) => {
            let lines = &args.lines;
            if !lines.nodes.is_empty() || lines.new || lines.count.is_some() || lines.source {
                return Err(Failure::unusable(
                    "`taut log level` prints no lines: see `taut log level --help`",
                ));
            }
            self::level(&args.common, node, *level, logger.as_deref())
        }
    }
}

/// Which lines of /rosout are printed, and how.
struct Lines<'a> {
    args: &'a LinesArgs,
    common: &'a CommonArgs,
    /// Loggers to print, with their child loggers; all loggers if empty.
    loggers: Vec<String>,
    end: End,
    participant: Participant,
    subscription: Subscription<Log>,
    /// Publishers for which the user was warned that their lines do not arrive.
    unheard: BTreeSet<Gid>,
}

impl<'a> Lines<'a> {
    fn open(args: &'a LinesArgs, common: &'a CommonArgs) -> Outcome<Self> {
        let (end, domain) = (End::of(common)?, common.domain()?);
        for node in args.nodes.iter().map(|node| full_name(node)) {
            let is_there = || {
                Ok(graph_of(domain)?.nodes.iter().any(|there| there.name.full_name() == node).then_some(()))
            };
            end.wait(|| format!("node '{node}' to exist in domain {domain}"), is_there)?;
        }
        let participant = Participant::new(domain)?;
        let node = participant.create_node(&format!("taut_log_{}", std::process::id()), "/")?;
        let qos = Qos::keep_last(DEPTH);
        let qos = if args.new { qos.best_effort() } else { qos.transient_local() };
        let limits = Limits { held: 1, ..Limits::default() };
        let subscription = participant.for_node(&node).create_subscription(TOPIC, qos, limits)?;
        let loggers = args.nodes.iter().map(|node| logger_of(&full_name(node))).collect();
        Ok(Lines { args, common, loggers, end, participant, subscription, unheard: BTreeSet::new() })
    }

    fn run(mut self) -> Outcome {
        let (mut printed, mut looked) = (0, None::<Instant>);
        let is_enough = |printed| self.args.count.is_some_and(|count| printed >= count);
        while !is_enough(printed) {
            if looked.is_none_or(|looked| looked.elapsed() >= LOOK) {
                looked = Some(Instant::now());
                let graph = self.participant.graph()?;
                warn_unreceived(&graph, &self.subscription, &mut self.unheard);
            }
            let sample = match self.subscription.try_take() {
                Ok(Some(sample)) => sample,
                Ok(None) if self.end.is_reached() => break,
                Ok(None) => {
                    if printed == 0 {
                        self.end.print_waiting_once(|| "a line on /rosout".into());
                    }
                    self.end.pause(POLL);
                    continue;
                }
                // The subscription counts invalid messages.
                Err(TakeError::Invalid(_)) if self.end.is_reached() => break,
                Err(TakeError::Invalid(_)) => continue,
                Err(error) => return Err(error.into()),
            };
            let log = sample.to_owned();
            if self.is_wanted(&log) {
                self.print(&log)?;
                printed += 1;
            }
            // Lines may arrive as fast as they are printed, so this loop must also check for the end.
            if self.end.is_reached() {
                break;
            }
        }
        let counters = self.subscription.counters();
        for (count, why) in [
            (counters.lost(), "were overwritten before they were printed"),
            (counters.invalid(), "are not valid messages"),
        ] {
            if count > 0 {
                eprintln!("taut: {count} lines {why}");
            }
        }
        match self.args.count.filter(|count| printed < *count) {
            Some(count) => Err(Failure::no(format!("{printed} of {count} lines came on {TOPIC}"))),
            None => Ok(()),
        }
    }

    fn is_wanted(&self, log: &Log) -> bool {
        let is_below = |above: &String| {
            log.name.strip_prefix(above.as_str()).is_some_and(|rest| rest.is_empty() || rest.starts_with('.'))
        };
        log.level >= self.args.level as u8 && (self.loggers.is_empty() || self.loggers.iter().any(is_below))
    }

    fn print(&self, log: &Log) -> Outcome {
        let mut out = crate::print::stdout();
        if self.common.json {
            let time_ns = i64::from(log.stamp.sec) * 1_000_000_000 + i64::from(log.stamp.nanosec);
            let line = json!({
                "time_ns": time_ns,
                "level": word(log.level),
                "logger": log.name,
                "text": log.msg,
                "file": log.file,
                "function": log.function,
                "line": log.line,
            });
            writeln!(out, "{line}")?;
        } else {
            let style = match log.level {
                40.. => BAD,
                30.. => WARNING,
                _ => Colour::Plain,
            };
            let source = match self.args.source && !log.file.is_empty() {
                true => format!(" ({}:{})", log.file, log.line),
                false => String::new(),
            };
            writeln!(
                out,
                "{style}[{}] [{:010}.{:09}] [{}]: {}{source}{style:#}",
                word(log.level),
                log.stamp.sec,
                log.stamp.nanosec,
                log.name,
                log.msg
            )?;
        }
        Ok(out.flush()?)
    }
}

/// Warns once for each publisher whose lines do not arrive.
fn warn_unreceived(graph: &GraphSnapshot, subscription: &Subscription<Log>, said: &mut BTreeSet<Gid>) {
    for end in &graph.endpoints {
        if end.topic != TOPIC || end.kind != EndpointKind::Publisher {
            continue;
        }
        let Some(policy) = end.qos.incompatibility(&subscription.qos()) else { continue };
        if said.insert(end.gid) {
            let node = label(end);
            eprintln!(
                "taut: lines of {node} do not arrive, because its {policy} does not meet the requested one: --new prints new \
                 lines of all nodes"
            );
        }
    }
}

/// The name of a severity in a line; programs may use numbers between the named ones.
fn word(level: u8) -> String {
    let known =
        LEVELS.iter().find_map(|name| name.parse().ok().filter(|of: &LogSeverity| *of as u8 == level));
    known.map_or_else(|| level.to_string(), |severity| severity.name().into())
}

fn logger_of(node: &str) -> String {
    node.trim_start_matches('/').replace('/', ".")
}

fn level(common: &CommonArgs, node: &str, level: Option<LogSeverity>, logger: Option<&str>) -> Outcome {
    let service = if level.is_some() { "set_logger_levels" } else { "get_logger_levels" };
    let what = "does not serve the levels of its loggers (rclcpp, rclpy: enable_logger_service; Tautline: make_logger_handler)";
    let mut called = NodeCaller::find(common, node, service, what)?;
    let node = called.name.clone();
    let name = logger.map_or_else(|| logger_of(&node), str::to_owned);
    let mut out = crate::print::stdout();
    let Some(level) = level else {
        let request = GetLoggerLevels::Request { names: vec![name.clone()] };
        let answer = called.call::<GetLoggerLevels::Service>(service, request)?;
        let own = answer.levels.first().map_or(0, |level| u8::try_from(level.level).unwrap_or(u8::MAX));
        return Ok(match common.json {
            true => writeln!(out, "{}", json!({ "node": node, "logger": name, "level": word(own) })),
            false => writeln!(out, "{name}: {}", word(own)),
        }?);
    };
    let wanted = LoggerLevel { name: name.clone(), level: level as u32 };
    let request = SetLoggerLevels::Request { levels: vec![wanted] };
    let answer = called.call::<SetLoggerLevels::Service>(service, request)?;
    let result = answer.results.into_iter().next().unwrap_or_default();
    let now = level.name();
    if common.json {
        let (successful, reason) = (result.successful, &result.reason);
        let told =
            json!({ "node": node, "logger": name, "level": now, "successful": successful, "reason": reason });
        writeln!(out, "{told}")?;
    } else if result.successful {
        writeln!(out, "Set {name} to {now}")?;
    }
    match result.successful {
        true => Ok(()),
        false => Err(Failure::no(format!("{node} does not set the level of '{name}': {}", result.reason))),
    }
}
