// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut msg`: definitions, hashes, layouts and bytes of ROS 2 types, without a compiled-in type.

mod decode;
mod show;

pub use show::parts;

use crate::completions;
use crate::find::Finder;
use crate::verb::Outcome;
use clap::{Args, Subcommand};
use std::io::Write;
use std::path::PathBuf;

/// Shows definitions, hashes and layouts of ROS 2 types; decodes messages.
///
/// Definitions are searched in --path, in the prefixes of AMENT_PREFIX_PATH (source your ROS 2), in the ROS 2 that
/// `cargo xtask ros` installs, in this program, and in the definitions that the domain's processes have cached.
#[derive(Args, Clone, Debug)]
#[command(after_help = "Examples:
  taut msg show sensor_msgs/LaserScan          fields, offsets, whether it is read in place
  taut msg show std_srvs/srv/SetBool --json
  taut msg show my_msgs/msg/Status.msg --path ~/ws/src
  taut msg hash std_msgs/String                what nodes compare
  taut msg decode --type std_msgs/String --hex '00010000 08000000 48656c6c6f203000'
  taut msg decode --type sensor_msgs/Imu sample.cdr --json")]
pub struct MsgArgs {
    #[command(subcommand)]
    verb: Verb,
    /// Search this folder too: a prefix, a folder of packages, or a package
    #[arg(long, value_name = "DIR", global = true)]
    path: Vec<PathBuf>,
    /// Print JSON
    #[arg(long, global = true)]
    json: bool,
}

#[derive(Subcommand, Clone, Debug)]
enum Verb {
    /// Prints fields, constants, offsets, sizes and the hash
    Show {
        /// package/Name, package/srv/Name, package/action/Name, or a file (.msg, .srv, .action, or .json of a package)
        #[arg(value_name = "TYPE", add = completions::interfaces())]
        name: String,
    },
    /// Prints the hash (RIHS01) of each type
    Hash {
        /// The type, as for show
        #[arg(value_name = "TYPE", required = true, add = completions::interfaces())]
        names: Vec<String>,
    },
    /// Prints the values of a message, as YAML or JSON
    Decode(decode::DecodeArgs),
}

pub fn run(args: MsgArgs) -> Outcome {
    // A domain that cannot be read has no types.
    let domain = tautline::Context::domain_of_environment().unwrap_or_default();
    let mut finder = Finder::new(&args.path).in_domain(domain);
    let text = match &args.verb {
        Verb::Show { name } => {
            let report = show::Report::of(&mut finder, name)?;
            if args.json { report.json() } else { report.text() }
        }
        Verb::Hash { names } => hashes(&mut finder, names, args.json)?,
        Verb::Decode(decode) => decode::run(&mut finder, decode, args.json)?,
    };
    Ok(crate::print::stdout().write_all(text.as_bytes())?)
}

/// Prints a line for each type, with its name if there are several.
fn hashes(finder: &mut Finder, names: &[String], json: bool) -> Outcome<String> {
    let mut hashes = Vec::new();
    for name in names {
        let schema = finder.schema(name)?;
        hashes.push((schema.name().to_string(), schema.hash().to_string()));
    }
    if json {
        let list = hashes.iter().map(|(name, hash)| serde_json::json!({ "type": name, "hash": hash }));
        return Ok(format!("{}\n", serde_json::Value::from_iter(list)));
    }
    match &hashes[..] {
        [(_, hash)] => Ok(format!("{hash}\n")),
        hashes => Ok(hashes.iter().map(|(name, hash)| format!("{hash}  {name}\n")).collect()),
    }
}
