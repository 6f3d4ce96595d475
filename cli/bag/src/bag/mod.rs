// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut bag`: shows, checks, repairs, cuts, merges, converts and draws bags.

mod convert;
mod damage;
mod plot;
mod progress;
mod sum;

pub use damage::placed;

use clap::{Args, Subcommand};
use convert::NewArgs;
use damage::more;
use progress::Progress;
use regex::Regex;
use serde_json::{Value, json};
use std::collections::{BTreeMap, BTreeSet};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::Duration;
use sum::Sum;
use taut_cli::arguments::full_name;
use taut_cli::verb::{CommonArgs, Failure, Outcome, Verbs, time};
use tautline_bag::{
    Damage, Event, FileReader, Hooks, Storage, Topic, custom_data_of, files_of, index_of, is_being_written,
    recover,
};

/// Shows, checks, repairs, cuts, merges, converts and draws bags
#[derive(Subcommand, Clone, Debug)]
#[command(after_help = "Examples:
  taut bag info run1                     topics, messages, times; what the recorder lost
  taut bag check run1                    exit code 1 if a message, a topic or the index is damaged
  taut bag recover run1                  what a killed recorder left is made whole
  taut bag cut run1 /scan --from 10s --to 20s -o part
  taut bag merge run1 run2 -o both
  taut bag convert old -o new            SQLite (.db3) or compressed files, as MCAP
  taut bag plot run1 /odom.twist.twist.linear.x -o speed.svg")]
pub enum Verb {
    /// Prints what is in a bag, from the index of its files
    Info(BagArg),
    /// Reads every message and reports damage; exits with 1 if there is any
    Check(BagArg),
    /// Writes truncated or damaged files again, with everything in them that is intact, and metadata.yaml
    Recover(BagArg),
    Cut(CutArgs),
    Merge(MergeArgs),
    Convert(convert::ConvertArgs),
    Plot(plot::PlotArgs),
}

#[derive(Args, Clone, Debug)]
pub struct BagArg {
    /// A folder of MCAP files, or one
    #[arg(value_name = "BAG")]
    bag: PathBuf,
}

/// Writes some topics, or a part of the time, into a new bag
#[derive(Args, Clone, Debug)]
#[command(after_help = "Examples:
  taut bag cut run1 /scan /odom -o scans
  taut bag cut run1 --from 10s --to 20s --compression zstd -o part
  taut bag cut run1 -x camera -o small")]
pub struct CutArgs {
    /// A folder of MCAP files, or one
    #[arg(value_name = "BAG")]
    bag: PathBuf,
    /// These topics [default: all]
    #[arg(value_name = "TOPIC")]
    topics: Vec<String>,
    /// But none whose name this regular expression is found in
    #[arg(short = 'x', long, value_name = "REGEX")]
    exclude: Option<String>,
    /// Messages received this time after the first message, or later
    #[arg(long, value_name = "TIME", value_parser = time)]
    from: Option<Duration>,
    /// Messages received less than this time after the first message
    #[arg(long, value_name = "TIME", value_parser = time)]
    to: Option<Duration>,
    #[command(flatten)]
    new: NewArgs,
}

/// Writes several bags into a new one
#[derive(Args, Clone, Debug)]
#[command(after_help = "Examples:
  taut bag merge run1 run2 -o both
  taut bag merge run1 --compression zstd -o small     one bag, compressed")]
pub struct MergeArgs {
    /// Folders of MCAP files, or such files
    #[arg(value_name = "BAG", required = true)]
    bags: Vec<PathBuf>,
    #[command(flatten)]
    new: NewArgs,
}

pub fn run(args: &Verbs<Verb>) -> Outcome {
    if args.common.is_domain_named() {
        return Err(Failure::unusable("a bag is of no domain: leave --domain out"));
    }
    let is_json = args.common.json;
    // A verb that writes a bag obeys the time limit itself, because it removes the incomplete bag.
    if !matches!(args.verb, Verb::Cut(_) | Verb::Merge(_) | Verb::Convert(_)) {
        args.common.bound();
    }
    match &args.verb {
        Verb::Info(args) => info(&args.bag, is_json),
        Verb::Check(args) => check(&args.bag, is_json),
        Verb::Recover(args) => mend(&args.bag, is_json),
        Verb::Cut(verb) => cut(verb, &args.common),
        Verb::Merge(verb) => {
            convert::write(&verb.bags, &verb.new, Storage::Mcap, Hooks::default(), &args.common)
        }
        Verb::Convert(verb) => convert::run(verb, &args.common),
        Verb::Plot(args) => plot::run(args, is_json),
    }
}

fn info(bag: &Path, is_json: bool) -> Outcome {
    let progress = Progress::new(is_json);
    let (mut files, mut said, mut damaged, mut damages) = (Vec::new(), Vec::new(), None, 0);
    for path in files_of(bag)? {
        match index_of(&path)? {
            Some((summary, metadata)) => {
                files.push(summary);
                said.extend(metadata);
            }
            // A file without an index is complete if it has no damage.
            None => {
                let reader = read(&path, &progress, |event| {
                    if let Event::Metadata(name, values) = event {
                        said.push((name, values));
                    }
                })?;
                files.push(reader.summary());
                damages += reader.damage().1;
                damaged = damaged.or(reader.damage().0.first().map(|damage| (path, damage.clone())));
            }
        }
    }
    progress.end();
    let last = |name: &str| said.iter().rev().find(|(other, _)| other == name).map(|(_, values)| values);
    let (session, recording) = (last("tautline:session"), last("tautline:recording"));
    // A merged bag has an entry for each of its sources.
    let recordings = || said.iter().filter(|(name, _)| name == "tautline:recording");
    let lost: Option<u64> = recordings().map(|(_, values)| values.get("lost")?.parse::<u64>().ok()).sum();
    let lost = lost.filter(|_| recording.is_some());
    let of_others: BTreeSet<_> =
        said.iter().map(|(name, _)| &**name).filter(|name| !name.starts_with("tautline:")).collect();
    let out = &mut taut_cli::print::stdout();
    let sum = Sum::of(&files);
    if is_json {
        // The recorder's metadata of a topic are JSON in a string.
        let value = |text: &String| serde_json::from_str(text).unwrap_or_else(|_| json!(text));
        let values = |values: &BTreeMap<String, String>| -> Value {
            values.iter().map(|(key, text)| (key.clone(), value(text))).collect()
        };
        let mut report = sum.json(&files);
        report["session"] = session.map_or(Value::Null, values);
        report["recording"] = recording.map_or(Value::Null, values);
        report["lost"] = json!(lost);
        report["metadata"] = json!(of_others);
        writeln!(out, "{report}")?;
    } else {
        sum.write(bag, &files, out)?;
        if !of_others.is_empty() {
            writeln!(out, "metadata: {}", of_others.into_iter().collect::<Vec<_>>().join(", "))?;
        }
        if let Some(host) = session.and_then(|session| session.get("host")) {
            let said = |key: &str| recording.and_then(|recording| recording.get(key));
            let lost = match (lost, said("why")) {
                (_, Some(why)) => format!("from its black box: {why}"),
                (Some(0), _) => "and lost nothing".to_owned(),
                (Some(lost), _) => format!("and lost {lost} messages"),
                (None, _) => "and did not come to its end".to_owned(),
            };
            writeln!(out, "taut record wrote it on {host}, {lost}")?;
        }
    }
    match damaged {
        None => Ok(()),
        Some((path, damage)) => {
            let (advice, more) = (advice(bag, &path), more(damages));
            Err(Failure::no(format!("{}{more}; {advice}", placed(&path, &damage))))
        }
    }
}

/// Reads a whole file, and hands its events on.
fn read(path: &Path, progress: &Progress, mut take: impl FnMut(Event<'_>)) -> Outcome<FileReader> {
    progress.say(path);
    let mut reader = FileReader::open(path)?;
    reader.read(&mut |event| {
        progress.tick();
        take(event);
        Ok::<_, Failure>(())
    })?;
    Ok(reader)
}

/// What to do about a damaged file.
fn advice(bag: &Path, file: &Path) -> String {
    match is_being_written(file) {
        Ok(true) => "it is still being written".to_owned(),
        _ => format!("`taut bag recover {}` keeps what is whole", bag.display()),
    }
}

fn check(bag: &Path, is_json: bool) -> Outcome {
    let progress = Progress::new(is_json);
    let (mut files, mut damage, mut damages) = (Vec::new(), Vec::new(), 0);
    for path in files_of(bag)? {
        let reader = read(&path, &progress, |_| {})?;
        let (some, all) = reader.damage();
        damage.extend(some.iter().map(|damage| (path.clone(), damage.clone())));
        damages += all;
        files.push(reader.summary());
    }
    progress.end();
    let described = if bag.is_dir() { custom_data_of(bag).map(drop) } else { Ok(()) };
    let out = &mut taut_cli::print::stdout();
    let sum = Sum::of(&files);
    let printed = if is_json {
        let mut report = sum.json(&files);
        let place = |(path, damage): &(PathBuf, Damage)| json!({ "file": path.display().to_string(), "offset": damage.offset, "what": damage.what });
        report["damage"] = damage.iter().map(place).collect();
        report["damages"] = json!(damages);
        report["has_metadata_yaml"] = json!(described.is_ok());
        writeln!(out, "{report}")
    } else {
        let mut placed = damage.iter().map(|(path, damage)| placed(path, damage));
        let listed = placed.try_for_each(|damage| writeln!(out, "{damage}"));
        listed.and_then(|()| sum.write(bag, &files, out))
    };
    let first = damage.first().map_or(bag, |(path, _)| path);
    let recover = advice(bag, first);
    match (damages, described) {
        // Damage takes precedence over an error of printing.
        (0, Ok(())) => printed.map_err(Failure::from),
        (0, Err(error)) => Err(Failure::no(format!("{error}; {recover}, and writes it"))),
        _ => Err(Failure::no(format!("damaged in {damages} places; {recover}"))),
    }
}

fn mend(bag: &Path, is_json: bool) -> Outcome {
    let progress = Progress::new(is_json);
    let files = recover(bag, &mut |path| progress.say(path))?;
    progress.end();
    let out = &mut taut_cli::print::stdout();
    if is_json {
        let file = |file: &tautline_bag::Recovered| {
            let damage = file.damage.iter();
            let damage: Vec<_> =
                damage.map(|damage| json!({ "offset": damage.offset, "what": damage.what })).collect();
            let before = file.before.as_ref().map(|before| before.display().to_string());
            json!({
                "file": file.summary.path.display().to_string(), "messages": file.summary.messages, "damage": damage,
                "damages": file.damages, "before": before,
            })
        };
        writeln!(out, "{}", files.iter().map(file).collect::<Value>())?;
        return Ok(());
    }
    for file in &files {
        let (path, messages) = (file.summary.path.display(), file.summary.messages);
        match file.damage.first() {
            None => writeln!(out, "{path}: was whole, {messages} messages")?,
            Some(Damage { offset, what }) => {
                let more = more(file.damages);
                writeln!(out, "{path}: {what}, at byte {offset}{more}: {messages} messages kept")?;
                if let Some(before) = &file.before {
                    writeln!(out, "  the original is kept as {}", before.display())?;
                }
            }
        }
    }
    Ok(())
}

fn cut(args: &CutArgs, common: &CommonArgs) -> Outcome {
    let topics: Vec<_> = args.topics.iter().map(|topic| full_name(topic)).collect();
    let exclude = args.exclude.as_deref().map(Regex::new).transpose()?;
    let mut files = Vec::new();
    for path in files_of(&args.bag)? {
        files.push(match index_of(&path)? {
            Some((summary, _)) => summary,
            None => read(&path, &Progress::new(true), |_| {})?.summary(),
        });
    }
    let there = Sum::of(&files);
    let names = || there.topics.keys().map(|(name, _)| &**name);
    if let Some(unknown) = topics.iter().find(|topic| !names().any(|name| name == **topic)) {
        return Err(Failure::unknown("topic", unknown, names(), &format!("bag info {}", args.bag.display())));
    }
    let at = |time: Option<Duration>| {
        time.map(|time| there.start_ns.saturating_add(u64::try_from(time.as_nanos()).unwrap_or(u64::MAX)))
    };
    let (from_ns, to_ns) = (at(args.from).unwrap_or(0), at(args.to).unwrap_or(u64::MAX));
    if from_ns >= to_ns || from_ns > there.end_ns {
        let seconds = there.seconds();
        return Err(Failure::unusable(format!("there is nothing between: the bag is of {seconds:.1} s")));
    }
    let wants = |topic: &Topic| {
        (topics.is_empty() || topics.contains(&topic.name))
            && !exclude.as_ref().is_some_and(|regex| regex.is_match(&topic.name))
    };
    let hooks = Hooks { wants: Box::new(wants), span_ns: from_ns..to_ns, ..Hooks::default() };
    convert::write(std::slice::from_ref(&args.bag), &args.new, Storage::Mcap, hooks, common)
}
