// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut bag convert`: converts bags between the storages and compressions of rosbag2.

use super::damage::whole;
use super::progress::Progress;
use super::sum::Sum;
use crate::definitions::recorded_type;
use crate::record::{Compressed, size};
use clap::{Args, ValueEnum};
use serde_json::json;
use std::io::Write;
use std::path::PathBuf;
use std::sync::Arc;
use taut_cli::verb::{CommonArgs, End, Failure, Outcome};
use tautline_bag::{BagError, Definition, Hooks, Options, Storage, Topic, convert};
use tautline_definitions::{find_schema, type_of};
use tautline_msgs::split_header;
use tautline_schema::{DynamicMessage, Endian, Schema, TypeName};

/// Writes bags of rosbag2 into a new one: SQLite to MCAP or back, decompressed, compressed
///
/// Messages of any encoding, their order and times, QoS, hashes and definitions of types, attachments and metadata are kept; what SQLite
/// cannot hold is refused by name. Definitions that an old bag does not have are taken from a sourced ROS 2, or from those that are built
/// in, if its messages are of them. A new bag that cannot be completed is removed.
#[derive(Args, Clone, Debug)]
#[command(after_help = "Examples:
  taut bag convert foxy_run -o run1                 a folder of .db3 files
  taut bag convert run_0.db3.zstd -o run1 --compression zstd
  taut bag convert run1 -o db --storage sqlite3     as rosbag2 of Jazzy writes it
  taut bag convert part1 part2 -o run1 --max-size 1GB")]
pub struct ConvertArgs {
    /// Folders of rosbag2, or files of them: .mcap or .db3, or these and .zstd
    #[arg(value_name = "BAG", required = true)]
    bags: Vec<PathBuf>,
    /// What holds the messages
    #[arg(long, value_enum, default_value_t = Stored::Mcap)]
    storage: Stored,
    #[command(flatten)]
    new: NewArgs,
}

#[derive(Args, Clone, Debug)]
pub struct NewArgs {
    /// The new bag: a folder that does not exist yet
    #[arg(short, long, value_name = "FOLDER")]
    output: PathBuf,
    /// How chunks are compressed
    #[arg(long, value_enum, default_value_t = Compressed::None)]
    compression: Compressed,
    /// A new file when one has this size, such as 500MB or 4GiB
    #[arg(long, value_name = "SIZE", value_parser = size)]
    max_size: Option<u64>,
}

impl NewArgs {
    fn options(&self) -> Options {
        Options { compression: self.compression.into(), split_bytes: self.max_size, ..Options::default() }
    }
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum Stored {
    /// Compressed in chunks
    Mcap,
    /// Compressed message by message, by zstd alone
    Sqlite3,
}

pub fn run(args: &ConvertArgs, common: &CommonArgs) -> Outcome {
    let storage = match args.storage {
        Stored::Mcap => Storage::Mcap,
        Stored::Sqlite3 => Storage::Sqlite3,
    };
    let define = |topic: &Topic, cdr: Option<&[u8]>| {
        defined(topic, cdr).map(|schema| Definition::ros2msg(schema.to_text()))
    };
    let hooks = Hooks { define: Some(Box::new(define)), ..Hooks::default() };
    write(&args.bags, &args.new, storage, hooks, common)
}

/// Writes the new bag and prints what is in it.
pub fn write(
    bags: &[PathBuf],
    new: &NewArgs,
    storage: Storage,
    hooks: Hooks<'_>,
    common: &CommonArgs,
) -> Outcome {
    let end = End::of(common)?;
    let progress = Progress::new(common.json);
    let go_on = || {
        progress.tick();
        !end.is_reached()
    };
    let hooks = Hooks { tell: Box::new(|path| progress.say(path)), go_on: Box::new(go_on), ..hooks };
    let written = convert(bags, &new.output, storage, new.options(), hooks);
    progress.end();
    let converted =
        written.map_err(|error| match (error, common.timeout().filter(|_| end.is_reached())) {
            (BagError::Interrupted, Some(timeout)) => {
                Failure::no(format!("not done after {timeout:?}; nothing is left of it"))
            }
            (error @ BagError::Interrupted, None) => Failure::no(error.to_string()),
            (error, _) => error.into(),
        })?;
    converted.notes.iter().for_each(|note| eprintln!("taut: warning: {note}"));
    let out = &mut taut_cli::print::stdout();
    let sum = Sum::of(&converted.files);
    let printed = if common.json {
        let mut report = sum.json(&converted.files);
        report["notes"] = json!(converted.notes);
        writeln!(out, "{report}")
    } else {
        sum.write(&new.output, &converted.files, out)
    };
    // Damage takes precedence over an error of printing.
    whole(&converted.damage, converted.damages)?;
    printed.map_err(Failure::from)
}

/// The definition of a topic's type on this host, if a message of the bag does not contradict it.
fn defined(topic: &Topic, cdr: Option<&[u8]>) -> Option<Arc<Schema>> {
    let name: TypeName = topic.type_name.parse().ok()?;
    let recorded = recorded_type(topic);
    let schema = find_schema(&topic.name, &name, Some(&recorded)).ok()?;
    if !type_of(&schema).agrees_with(&recorded) {
        return None;
    }
    if let Some(cdr) = cdr {
        let (endian, body) = split_header(cdr).ok()?;
        let endian = match endian {
            tautline_msgs::cdr::Endian::Little => Endian::Little,
            tautline_msgs::cdr::Endian::Big => Endian::Big,
        };
        // Fewer than four bytes at the end are padding.
        DynamicMessage::validate(&schema, body, endian).ok().filter(|trailing| *trailing < 4)?;
    }
    Some(schema)
}
