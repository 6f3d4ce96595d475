// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut bag`: shows, checks, repairs, cuts, merges, converts and draws bags.

mod convert;
mod plot;

use crate::record::{Compressed, size};
use clap::{Args, Subcommand};
use indicatif::ProgressBar;
use regex::Regex;
use serde_json::{Value, json};
use std::collections::{BTreeMap, BTreeSet};
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};
use taut_cli::arguments::full_name;
use taut_cli::date::date;
use taut_cli::table::write_table;
use taut_cli::verb::{CommonArgs, Failure, Outcome, Verbs, time};
use tautline_bag::{
    CDR, Damage, Event, FileReader, FileSummary, Hooks, Options, Storage, Topic, custom_data_of, files_of,
    index_of, is_being_written, recover,
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

#[derive(Args, Clone, Debug)]
struct NewArgs {
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

/// A damaged part and its place.
pub fn placed(path: &Path, Damage { offset, what }: &Damage) -> String {
    format!("{}: at byte {offset}: {what}", path.display())
}

/// The number of damaged parts besides the first, in words.
fn more(damages: u64) -> String {
    match damages {
        0 | 1 => String::new(),
        _ => format!(", and {} more", damages - 1),
    }
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

/// Fails if there was damage; `damages` is the number of damaged parts.
fn whole(damage: &[(PathBuf, Damage)], damages: u64) -> Outcome {
    let Some((path, damage)) = damage.first() else { return Ok(()) };
    Err(Failure::no(format!("{}{}; what is whole was taken", placed(path, damage), more(damages))))
}

struct Sum {
    topics: BTreeMap<(String, String), (Topic, u64)>,
    attachments: Vec<String>,
    messages: u64,
    bytes: u64,
    start_ns: u64,
    end_ns: u64,
}

impl Sum {
    fn of(files: &[FileSummary]) -> Self {
        let with_messages = || files.iter().filter(|file| file.messages > 0);
        let mut topics = BTreeMap::new();
        for (key, (topic, messages)) in files.iter().flat_map(|file| &file.topics) {
            topics.entry(key.clone()).or_insert_with(|| (topic.clone(), 0)).1 += messages;
        }
        Sum {
            topics,
            attachments: files.iter().flat_map(|file| file.attachments.clone()).collect(),
            messages: files.iter().map(|file| file.messages).sum(),
            bytes: files.iter().map(|file| file.bytes).sum(),
            start_ns: with_messages().map(|file| file.start_ns).min().unwrap_or(0),
            end_ns: with_messages().map(|file| file.end_ns).max().unwrap_or(0),
        }
    }

    fn seconds(&self) -> f64 {
        self.end_ns.saturating_sub(self.start_ns) as f64 / 1e9
    }

    fn json(&self, files: &[FileSummary]) -> Value {
        let topic = |(Topic { name, type_name, type_hash, encoding, .. }, messages): &(Topic, u64)| json!({ "topic": name, "type": type_name, "hash": type_hash, "encoding": encoding, "messages": messages });
        let file = |file: &FileSummary| {
            json!({
                "file": file.name(), "bytes": file.bytes, "messages": file.messages,
                "start_ns": file.start_ns, "end_ns": file.end_ns,
            })
        };
        json!({
            "messages": self.messages, "bytes": self.bytes, "start_ns": self.start_ns, "end_ns": self.end_ns,
            "topics": self.topics.values().map(topic).collect::<Vec<_>>(), "files": files.iter().map(file).collect::<Vec<_>>(),
            "attachments": self.attachments,
        })
    }

    fn write(&self, bag: &Path, files: &[FileSummary], out: &mut impl Write) -> io::Result<()> {
        let seconds = self.seconds();
        if !self.topics.is_empty() {
            let row = |(Topic { name, type_name, encoding, .. }, messages): &(Topic, u64)| {
                let hz =
                    if seconds > 0.0 { format!("{:.1}", *messages as f64 / seconds) } else { "-".into() };
                let of_type =
                    if encoding == CDR { type_name.clone() } else { format!("{type_name} ({encoding})") };
                (true, vec![name.clone(), of_type, messages.to_string(), hz])
            };
            write_table(
                &["topic", "type", "messages", "mean/s"],
                2,
                self.topics.values().map(row).collect(),
                out,
            )?;
        }
        let (files, megabytes) = (files.len(), self.bytes as f64 / 1e6);
        write!(
            out,
            "{}: {} messages in {files} {}, {megabytes:.1} MB",
            bag.display(),
            self.messages,
            if files == 1 { "file" } else { "files" }
        )?;
        match self.messages {
            0 => writeln!(out)?,
            _ => writeln!(out, ", {seconds:.1} s from {} UTC", date(self.start_ns.cast_signed()))?,
        }
        match &*self.attachments {
            [] => Ok(()),
            names => writeln!(out, "attachments: {}", names.join(", ")),
        }
    }
}

/// Progress on a terminal, shown after two seconds.
struct Progress {
    bar: ProgressBar,
    start: Instant,
}

impl Progress {
    fn new(is_json: bool) -> Self {
        let bar = if is_json { ProgressBar::hidden() } else { ProgressBar::new_spinner() };
        Progress { bar, start: Instant::now() }
    }

    fn say(&self, path: &Path) {
        self.bar.set_message(format!("reading {}", path.display()));
        self.tick();
    }

    fn tick(&self) {
        if self.start.elapsed() > Duration::from_secs(2) {
            self.bar.tick();
        }
    }

    fn end(&self) {
        self.bar.finish_and_clear();
    }
}
