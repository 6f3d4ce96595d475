// SPDX-License-Identifier: MIT OR Apache-2.0
//! The arguments of `taut record`.

use clap::{Args, ValueEnum};
use std::num::NonZeroU32;
use std::path::PathBuf;
use std::time::Duration;
use taut_cli::arguments::full_name;
use taut_cli::completions;
use taut_cli::date::date;
use taut_cli::verb::{CommonArgs, time};
use tautline_bag::{Compression, Options};
use tautline_rt::CoreSet;
use tautline_rt::clock::{nanoseconds, wall_ns};

/// Records topics into a bag, as rosbag2 writes them: MCAP files and a metadata.yaml
///
/// Publishers do not notice: none waits for the recorder, wakes it, or lists it. Lost messages are counted. At the end the recorder prints
/// the stall that each topic survives: a queue of `--depth` messages over the rate of its fastest publisher.
/// Ctrl-C ends the recording. `taut bag recover` repairs the bag of a killed recorder, which has all but the last half second.
#[derive(Args, Clone, Debug)]
#[command(after_help = "Examples:
  taut record /scan /odom                          until Ctrl-C, into a new folder
  taut record -a --exclude 'camera|/rosout' -o run1
  taut record --service /add --action /dock        requests and responses as events
  taut record --type sensor_msgs/msg/Image --compression zstd --max-size 1GB
  taut record -a --max-time 5min --keep 12         the last hour
  taut record -a --black-box 30s --budget 1GB      the last 30 s before a deadline is missed, a process dies, a topic falls silent
  taut record /scan --throttle /scan=1 --timeout 60s --json

Exit codes: 0 nothing was lost; 1 something was, or a named topic did not come; 2 it could not be written.
On a terminal the enter key pauses and goes on; so does SIGUSR1. A black box is written then.")]
pub struct RecordArgs {
    #[command(flatten)]
    pub common: CommonArgs,
    /// Topics; those that do not exist are waited for
    #[arg(value_name = "TOPIC", add = completions::topics())]
    pub topics: Vec<String>,
    /// Every topic, service and action, also those that appear later
    #[arg(short, long)]
    pub all: bool,
    /// Requests and responses of this service, as /SERVICE/_service_event; may be given several times
    #[arg(long, value_name = "SERVICE")]
    pub service: Vec<String>,
    /// Goals, results, cancellations, feedback and states of this action; may be given several times
    #[arg(long, value_name = "ACTION")]
    pub action: Vec<String>,
    /// Topics whose name matches this regular expression in part
    #[arg(short = 'e', long, value_name = "REGEX")]
    pub regex: Option<String>,
    /// Topics of this type, or services; may be given several times
    #[arg(long = "type", value_name = "TYPE")]
    pub types: Vec<String>,
    /// Except topics whose name matches this regular expression in part
    #[arg(short = 'x', long, value_name = "REGEX")]
    pub exclude: Option<String>,
    /// Also topics of other hosts and of ROS, which see a subscription and send their messages
    #[arg(long)]
    pub fetch: bool,
    /// The bag: a folder that does not exist yet [default: bag_ and the time]
    #[arg(short, long, value_name = "FOLDER")]
    pub output: Option<PathBuf>,
    /// How chunks are compressed
    #[arg(long, value_enum, default_value_t = Compressed::None)]
    pub compression: Compressed,
    /// Begin a new file when one has this size, such as 500MB or 4GiB
    #[arg(long, value_name = "SIZE", value_parser = size)]
    pub max_size: Option<u64>,
    /// Begin a new file when one has messages of this time
    #[arg(long, value_name = "TIME", value_parser = time)]
    pub max_time: Option<Duration>,
    /// Keep no more files than this, or bags of a black box: the oldest is removed
    #[arg(long, value_name = "N")]
    pub keep: Option<NonZeroU32>,
    /// Keep at most this number of messages of this topic per second; may be given several times
    #[arg(long, value_name = "TOPIC=HZ", value_parser = throttle)]
    pub throttle: Vec<(String, f64)>,
    /// Begin without recording
    #[arg(long)]
    pub paused: bool,
    /// Memory for messages that wait for the disk, locked and touched at the start
    #[arg(long, value_name = "SIZE", default_value = "256MB", value_parser = size)]
    pub budget: u64,
    /// Messages that wait in the queue of each publisher [default: the greatest depth of the topic's endpoints, or as many as have 1 MiB, up to 1000]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=65_536))]
    pub depth: Option<u32>,
    /// The interval at which messages are taken
    #[arg(long, value_name = "TIME", default_value = "2ms", value_parser = time)]
    pub period: Duration,
    /// Keep the last TIME in memory, and write it into a bag of its own at each event of --on
    #[arg(long, value_name = "TIME", value_parser = time, conflicts_with = "paused")]
    pub black_box: Option<Duration>,
    /// The events at which the black box is written
    #[arg(long, value_enum, value_name = "WHAT", value_delimiter = ',', requires = "black_box",
          default_values_t = [Kind::Deadline, Kind::Death, Kind::Silence, Kind::Request])]
    pub on: Vec<Kind>,
    /// A topic is silent after this time [default: ten times its longest pause, 1s at least]; may be given several times
    #[arg(long, value_name = "TOPIC=TIME", value_parser = silent, requires = "black_box")]
    pub silent: Vec<(String, Duration)>,
    /// The bag also has the messages of this time after the event
    #[arg(long, value_name = "TIME", value_parser = time, default_value = "1s", requires = "black_box")]
    pub after: Duration,
    /// Keep no trace events in the black box: processes do not record any for it
    #[arg(long, requires = "black_box")]
    pub no_trace: bool,
    /// Run on these cores alone, such as 0-1,4 [default: those that no real-time thread of the domain is bound to, if there are any]
    #[arg(long, value_name = "LIST", value_parser = cores)]
    pub cores: Option<CoreSet>,
    /// Take messages at an ordinary priority, instead of SCHED_FIFO 1 where that is permitted
    #[arg(long)]
    pub no_rt: bool,
}

#[derive(ValueEnum, Clone, Copy, Debug, PartialEq, Eq)]
pub enum Compressed {
    /// Without compression
    None,
    /// Small
    Zstd,
    /// Fast
    Lz4,
}

impl From<Compressed> for Compression {
    fn from(compressed: Compressed) -> Self {
        match compressed {
            Compressed::None => Compression::None,
            Compressed::Zstd => Compression::Zstd,
            Compressed::Lz4 => Compression::Lz4,
        }
    }
}

/// A number of bytes and its unit.
pub fn size(text: &str) -> Result<u64, String> {
    let digits = text.trim_end_matches(|c: char| c.is_ascii_alphabetic());
    let unit: f64 = match &text[digits.len()..] {
        "" | "B" => 1.0,
        "kB" | "KB" | "k" | "K" => 1e3,
        "MB" | "M" => 1e6,
        "GB" | "G" => 1e9,
        "TB" | "T" => 1e12,
        "KiB" => 1024.0,
        "MiB" => 1048576.0,
        "GiB" => 1073741824.0,
        "TiB" => 1099511627776.0,
        other => return Err(format!("'{other}' is no unit: B, kB, MB, GB, TB, KiB, MiB, GiB, TiB")),
    };
    let number = digits.parse::<f64>().ok().map(|number| number * unit).filter(|n| (1.0..1e18).contains(n));
    number.map(|bytes| bytes as u64).ok_or_else(|| format!("'{text}' is no size: 500MB or 4GiB is one"))
}

fn silent(text: &str) -> Result<(String, Duration), String> {
    let (topic, text) = text.rsplit_once('=').ok_or("TOPIC=TIME, such as /scan=200ms")?;
    Ok((full_name(topic), time(text)?))
}

fn cores(text: &str) -> Result<CoreSet, String> {
    let cores = CoreSet::parse(text).filter(|cores| !cores.is_empty());
    cores.ok_or_else(|| format!("'{text}' is no list of cores: 0-1,4 is one"))
}

fn throttle(text: &str) -> Result<(String, f64), String> {
    let (topic, hz) = text.rsplit_once('=').ok_or("TOPIC=HZ, such as /scan=10")?;
    let hz = hz.parse::<f64>().ok().filter(|hz| (1e-6..1e9).contains(hz));
    let hz = hz.ok_or("HZ is a number of messages a second, above 0")?;
    Ok((full_name(topic), hz))
}

/// The events that are watched for.
#[derive(ValueEnum, Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// A callback misses its deadline
    Deadline,
    /// A process is killed, crashes, or leaves without ending what it had
    Death,
    /// A topic falls silent that has a publisher
    Silence,
    /// SIGUSR1, or the enter key on a terminal
    Request,
}

tautline_rt::names!(Kind: pub const fn name(self) -> &'static str {
    Deadline: "deadline", Death: "death", Silence: "silence", Request: "request",
});

impl RecordArgs {
    /// The part of the budget for data on their way to the disk.
    pub fn memory_bytes(&self) -> usize {
        (self.budget / 8).clamp(8 << 10, 32 << 20) as usize
    }

    pub fn options(&self) -> Options {
        Options {
            compression: self.compression.into(),
            split_bytes: self.max_size,
            split_ns: self.max_time.map(nanoseconds),
            keep_files: self.keep,
            memory_bytes: Some(self.memory_bytes()),
        }
    }

    /// `bag_` or `black_box_` and the time, UTC.
    pub fn default_folder(&self) -> String {
        let what = if self.black_box.is_some() { "black_box" } else { "bag" };
        format!("{what}_{}", date(wall_ns()).replace(' ', "-").replace(':', "_"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_and_rates_are_read() {
        assert_eq!([size("500MB"), size("4GiB"), size("7")], [Ok(500_000_000), Ok(4 << 30), Ok(7)]);
        for wrong in ["", "0", "-1MB", "5 MB", "3 parsec", "1e30GB", "nan"] {
            assert!(size(wrong).is_err(), "{wrong}");
        }
        assert_eq!(throttle("scan=10"), Ok(("/scan".into(), 10.0)));
        for wrong in ["/scan", "/scan=", "/scan=0", "/scan=x", "/scan=-1"] {
            assert!(throttle(wrong).is_err(), "{wrong}");
        }
    }
}
