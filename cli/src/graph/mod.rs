// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut graph`: draws nodes, topics and the connections between them.

mod bounds;
mod dot;
mod gather;
mod json;
mod layout;
mod mermaid;
mod picture;
mod svg;
mod text;

use crate::check::read_file;
use crate::completions;
use crate::rates::RateMeter;
use crate::verb::{CommonArgs, Failure, Outcome, time};
use bounds::Running;
use clap::{Args, ValueEnum};
use gather::Wanted;
use picture::Picture;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};
use tautline_analysis::file::CheckedSystem;
use tautline_transport::Visitor;

/// Draws nodes, topics and rates, as text, SVG, DOT or Mermaid
///
/// Incompatible subscriptions are red: they request a quality of service that no publisher offers, or have another type. With a system
/// file, topics that trigger callbacks show the bounds of response times that `taut check` computes.
///
/// Does not subscribe: rates are read from the publishers' counters in shared memory. A question mark stands for a rate that no process
/// of this host counts. Nodes of other hosts are visible if this host runs `taut gateway`.
#[derive(Args, Clone, Debug)]
#[command(after_help = "Examples:
  taut graph                                  as text
  taut graph -o robot.svg                     or .dot, .mmd, .json: the name selects the format
  taut graph --format dot | dot -Tpdf -o robot.pdf
  taut graph --node /camera --services        the node, its topics, and the nodes that it is connected to
  taut graph --system system.toml -o robot.svg
  taut graph --json | jq '.edges[] | select(.problem)'

Exit codes: 0 done, 1 there is no such node or topic, 2 the arguments cannot be used.")]
pub struct GraphArgs {
    #[command(flatten)]
    common: CommonArgs,
    /// The format [default: by the name of the output, else text]
    #[arg(long, value_enum, value_name = "FORMAT")]
    format: Option<Format>,
    /// Write to this file
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// Show this node, its topics, and the nodes that it is connected to
    #[arg(long, value_name = "NODE", add = completions::nodes())]
    node: Option<String>,
    /// Show this topic and its nodes
    #[arg(long, value_name = "TOPIC", add = completions::topics())]
    topic: Option<String>,
    /// Show services and actions too: dashed, from the client to the server
    #[arg(long)]
    services: bool,
    /// Show /rosout, /parameter_events, parameter services and the parts of actions too
    #[arg(long)]
    all: bool,
    /// Count messages for this time; 0: no rates
    #[arg(long, value_name = "TIME", default_value = "1s", value_parser = time)]
    rates: Duration,
    /// A system file; its bounds are shown beside the running nodes
    #[arg(long, value_name = "FILE")]
    system: Option<PathBuf>,
}

#[derive(ValueEnum, Clone, Copy, Debug, PartialEq, Eq)]
enum Format {
    Text,
    Svg,
    Dot,
    Mermaid,
    Json,
}

impl Format {
    fn of_name(path: &Path) -> Option<Self> {
        match path.extension()?.to_str()? {
            "txt" => Some(Format::Text),
            "svg" => Some(Format::Svg),
            "dot" | "gv" => Some(Format::Dot),
            "mmd" | "mermaid" => Some(Format::Mermaid),
            "json" => Some(Format::Json),
            _ => None,
        }
    }

    fn write(self, picture: &Picture) -> String {
        let mut text = String::new();
        let written = match self {
            Format::Text => text::write(picture, &mut text),
            Format::Svg => svg::write(picture, &mut text),
            Format::Dot => dot::write(picture, &mut text),
            Format::Mermaid => mermaid::write(picture, &mut text),
            Format::Json => writeln!(text, "{}", picture.to_json()),
        };
        written.expect("a string takes everything");
        text
    }
}

pub fn run(args: &GraphArgs) -> Outcome {
    let format = format_of(args)?;
    let checked = args.system.as_deref().map(read_file).transpose()?.map(|file| file.check());
    let picture = gather_picture(args, checked.as_ref())?;
    let written = format.write(&picture);
    if format == Format::Mermaid && (picture.edges.len() > 500 || written.len() > 50_000) {
        eprintln!(
            "taut: Mermaid draws 500 edges and 50000 characters unless its maxEdges and maxTextSize say otherwise; here are {} and \
             {}: --node and --topic draw a part",
            picture.edges.len(),
            written.len()
        );
    }
    match &args.output {
        Some(path) => {
            // A file has no colours.
            crate::replace::write(path, crate::print::painted(&written, false))
                .map_err(|error| Failure::unwritable(path, &error))
        }
        None => {
            let mut out = crate::print::stdout();
            write!(out, "{written}")?;
            Ok(out.flush()?)
        }
    }
}

fn format_of(args: &GraphArgs) -> Outcome<Format> {
    match (args.format, args.common.json, &args.output) {
        (Some(format), true, _) if format != Format::Json => {
            Err(Failure::unusable("--json and another --format: say one of them"))
        }
        (Some(format), ..) => Ok(format),
        (None, true, _) => Ok(Format::Json),
        (None, false, None) => Ok(Format::Text),
        (None, false, Some(path)) => Format::of_name(path).ok_or_else(|| {
            let path = path.display();
            Failure::unusable(format!(
                "`{path}` does not say which format: .txt, .svg, .dot, .gv, .mmd and .json do, or --format"
            ))
        }),
    }
}

fn gather_picture(args: &GraphArgs, checked: Option<&CheckedSystem>) -> Outcome<Picture> {
    let domain = args.common.domain()?;
    let wanted = Wanted {
        node: args.node.as_deref(),
        topic: args.topic.as_deref(),
        services: args.services,
        all: args.all,
    };
    let (mut visitor, mut meter) = (Visitor::new(domain)?, RateMeter::default());
    let mut graph = visitor.graph()?;
    let mut rates = None;
    if !args.rates.is_zero() {
        // An unknown name is an error at once.
        gather::gather(domain, &graph, None, &wanted)?;
        meter.measure(&mut visitor, &graph)?;
        let start = Instant::now();
        let time = args.common.timeout().map_or(args.rates, |timeout| timeout.min(args.rates));
        if time > Duration::from_secs(1) {
            eprintln!("taut: counting messages for {time:?} ...");
        }
        // Ctrl-C ends the verb without an error.
        std::thread::sleep(time);
        graph = visitor.graph()?;
        let seconds = start.elapsed().as_secs_f64();
        rates = Some((meter.measure(&mut visitor, &graph)?, seconds));
    }
    let rates = rates.as_ref().map(|(rates, seconds)| (rates, *seconds));
    let mut picture = gather::gather(domain, &graph, rates, &wanted)?;
    if let Some(checked) = checked {
        let running = Running::new(&graph, callbacks(domain)?);
        for missing in bounds::add(&mut picture, checked, &running) {
            eprintln!("taut: {missing}");
        }
    }
    Ok(picture)
}

/// Maps each callback's name to the processes that run it.
fn callbacks(domain: u32) -> Outcome<BTreeMap<String, BTreeSet<u32>>> {
    let mut found: BTreeMap<String, BTreeSet<u32>> = BTreeMap::new();
    for process in tautline_system::shared_statistics(domain)?.0 {
        // A process that is ending, or has another version, is omitted.
        let Ok(Some(snapshot)) = process.read() else { continue };
        for callback in snapshot.callbacks.iter().filter(|callback| !callback.ended && !callback.is_group) {
            found.entry(callback.name.clone()).or_default().insert(snapshot.process.pid);
        }
    }
    Ok(found)
}

#[cfg(test)]
mod tests;
