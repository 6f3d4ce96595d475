// SPDX-License-Identifier: MIT OR Apache-2.0
//! The arguments of `taut play`.

use crate::record::size;
use clap::Args;
use regex::Regex;
use std::num::NonZeroU64;
use std::path::PathBuf;
use std::time::Duration;
use taut_cli::arguments::full_name;
use taut_cli::verb::{CommonArgs, Failure, Outcome, time};
use tautline_bag::Ordered;
use tautline_rt::clock::nanoseconds;

/// The default priority of the thread that publishes.
pub const PRIORITY: u8 = 40;

/// Publishes the messages of a bag at the times of their reception
///
/// A thread with a real-time priority publishes each message at its absolute time. The end reports how late the messages were. Types, QoS,
/// time stamps and sequence numbers are as recorded. Topics that have publishers are not played without --mix.
/// Ctrl-C ends the verb.
#[derive(Args, Clone, Debug)]
#[command(after_help = "Examples:
  taut play run1
  taut play run1 /scan /odom --rate 0.5 --clock
  taut play run1 --from 10s --to 20s --loop
  taut play run1 --remap /scan:=/scan_recorded --max-jitter 1ms
  taut play run1 --as camera --loop           the system without its camera; `taut report` says whether the others keep their bounds
  taut play run1 --paused                     on a terminal: enter goes on, n plays one message, s 12 leaps to 12 s

Exit codes: 0 everything was played, or Ctrl-C; 1 some of it was not, or was later than --max-jitter; 2 it cannot be played.
SIGUSR1 pauses and goes on; SIGUSR2 plays one message while it is paused.")]
pub struct PlayArgs {
    #[command(flatten)]
    pub common: CommonArgs,
    /// A folder, or one of its files
    #[arg(value_name = "BAG")]
    pub bag: PathBuf,
    /// Topics of the bag [default: all]
    #[arg(value_name = "TOPIC")]
    pub topics: Vec<String>,
    /// Topics whose name matches this regular expression in part
    #[arg(short = 'e', long, value_name = "REGEX")]
    pub regex: Option<Regex>,
    /// Except topics whose name matches this regular expression in part
    #[arg(short = 'x', long, value_name = "REGEX")]
    pub exclude: Option<Regex>,
    /// Play this number of times as fast
    #[arg(short, long, value_name = "FACTOR", default_value = "1", value_parser = factor)]
    pub rate: f64,
    /// Repeat the bag for ever, or play it N times
    #[arg(short = 'l', long = "loop", value_name = "N", num_args = 0..=1, require_equals = true)]
    pub again: Option<Option<NonZeroU64>>,
    /// Leave out messages before this time from the bag's start; those that publishers had kept for late joiners until then are sent first
    #[arg(long, value_name = "TIME", value_parser = time)]
    pub from: Option<Duration>,
    /// Leave out messages after this time from the bag's start
    #[arg(long, value_name = "TIME", value_parser = time)]
    pub to: Option<Duration>,
    /// Begin paused
    #[arg(long)]
    pub paused: bool,
    /// Publish the bag's time on /clock with this rate, for nodes with use_sim_time; a recorded /clock is left out
    #[arg(long, value_name = "HZ", num_args = 0..=1, require_equals = true, default_missing_value = "100",
          value_parser = factor)]
    pub clock: Option<f64>,
    /// Publish on another topic; may be given several times
    #[arg(short = 'm', long, value_name = "FROM:=TO", value_parser = remap)]
    pub remap: Vec<(String, String)>,
    /// Also play topics that already have publishers
    #[arg(long)]
    pub mix: bool,
    /// Wait until each topic has a subscription
    #[arg(short, long)]
    pub wait: bool,
    /// Exit with 1 if a message was later than this
    #[arg(long, value_name = "TIME", value_parser = time)]
    pub max_jitter: Option<Duration>,
    /// Stand in for this node of the system file: play what it publishes, on its core, at its priority, so that `taut report` looks at the
    /// others with recorded input
    #[arg(long = "as", value_name = "NODE", conflicts_with_all = ["topics", "regex", "exclude", "remap"])]
    pub stands_in: Option<String>,
    /// The system file of --as [default: TAUT_SYSTEM, or what the processes of the domain were started with]
    #[arg(long, value_name = "FILE", requires = "stands_in")]
    pub system: Option<PathBuf>,
    /// Publish with this priority of SCHED_FIFO, where that is permitted [default: 40, or the node's]
    #[arg(long, value_name = "1..99", value_parser = clap::value_parser!(u8).range(1..=99))]
    pub priority: Option<u8>,
    /// Publish on this core [default: any, or the node's]
    #[arg(long, value_name = "N")]
    pub core: Option<usize>,
    /// Publish at an ordinary priority
    #[arg(long)]
    pub no_rt: bool,
    /// Memory for messages that are read ahead, locked and touched at the start
    #[arg(long, value_name = "SIZE", default_value = "256MB", value_parser = size)]
    pub budget: u64,
}

fn factor(text: &str) -> Result<f64, String> {
    let factor = text.parse::<f64>().ok().filter(|factor| (1e-6..=1e6).contains(factor));
    factor.ok_or_else(|| format!("'{text}' is no number of 0.000001 to 1000000"))
}

fn remap(text: &str) -> Result<(String, String), String> {
    let (from, to) = text.split_once(":=").ok_or("FROM:=TO, such as /scan:=/scan_recorded")?;
    Ok((full_name(from), full_name(to)))
}

impl PlayArgs {
    /// The range to play, in times of reception.
    pub fn range(&self, bag: &Ordered) -> Outcome<(u64, u64)> {
        let Some((start_ns, end_ns)) = bag.span_ns() else {
            return Err(Failure::unusable(format!("{} has no messages", self.bag.display())));
        };
        let at = |time: Duration| start_ns.saturating_add(nanoseconds(time));
        let from_ns = self.from.map_or(start_ns, at);
        let to_ns = self.to.map_or(u64::MAX, at);
        if from_ns > to_ns || from_ns > end_ns {
            let seconds = end_ns.saturating_sub(start_ns) as f64 / 1e9;
            return Err(Failure::unusable(format!("there is nothing between: the bag is of {seconds:.1} s")));
        }
        // The times of chunks are unchecked, so without --from the range begins at 0.
        Ok((self.from.map_or(0, at), to_ns))
    }
}
