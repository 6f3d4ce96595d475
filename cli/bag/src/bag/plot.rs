// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut bag plot`: fields of messages over time, as a picture.

mod columns;
mod field;
mod picture;

use super::damage::whole;
use super::progress::Progress;
use crate::definitions::{from_bag, recorded_type};
use clap::Args;
use columns::Columns;
use field::Wanted;
use picture::{Picture, Series};
use serde_json::{Value as Json, json};
use std::io::{self, IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;
use taut_cli::table::count;
use taut_cli::verb::{Failure, Outcome, time};
use tautline_bag::{CDR, Ordered, Topic, is_compressed};
use tautline_definitions::find_schema;
use tautline_rt::clock::nanoseconds;
use tautline_schema::{DynamicMessage, Primitive, Schema, TypeName, Value};

/// Draws fields of messages over time, as SVG
///
/// If there are more messages than columns of pixels, each column shows the first, the lowest, the highest and the last, so no spike is
/// lost. A value that is not a number (NaN, infinite, an element that the message does not have) is a gap. Times are those of reception.
#[derive(Args, Clone, Debug)]
#[command(after_help = "Examples:
  taut bag plot run1 /odom.twist.twist.linear.x -o speed.svg
  taut bag plot run1 /imu.angular_velocity.z /cmd_vel.angular.z --from 10s --to 20s -o turn.svg
  taut bag plot run1 '/scan.ranges[0]' '/scan.ranges[359]' --width 2000 > scan.svg
  taut bag plot run1 /battery.voltage --json | jq '.series[0].points[-1]'")]
pub struct PlotArgs {
    /// A folder of MCAP files, or one
    #[arg(value_name = "BAG")]
    bag: PathBuf,
    #[arg(value_name = "TOPIC.FIELD", required = true, value_parser = Wanted::parse,
          help = "What is drawn, in one picture: numbers and bools, such as /odom.pose.pose.position.x or /scan.ranges[3]")]
    fields: Vec<Wanted>,
    /// The picture [default: standard output]
    #[arg(short, long, value_name = "FILE.svg")]
    output: Option<PathBuf>,
    /// Messages received this time after the bag's first message, or later
    #[arg(long, value_name = "TIME", value_parser = time)]
    from: Option<Duration>,
    /// Messages received no more than this time after the bag's first message
    #[arg(long, value_name = "TIME", value_parser = time)]
    to: Option<Duration>,
    /// In pixels
    #[arg(long, value_name = "PIXELS", default_value_t = 1000, value_parser = clap::value_parser!(u16).range(320..=16_000))]
    width: u16,
    /// In pixels
    #[arg(long, value_name = "PIXELS", default_value_t = 420, value_parser = clap::value_parser!(u16).range(200..=16_000))]
    height: u16,
}

/// A field that is drawn.
struct Line {
    wanted: Wanted,
    /// The numbers of its topics in the bag: one, or one for each publisher.
    topics: Vec<usize>,
    schema: Arc<Schema>,
    series: Series,
    /// The values of every message, for JSON.
    points: Vec<(u64, Json)>,
    unread: (u64, Option<String>),
}

pub fn run(args: &PlotArgs, is_json: bool) -> Outcome {
    if args.fields.len() > picture::COLOURS.len() {
        let most = picture::COLOURS.len();
        return Err(Failure::unusable(format!(
            "more than {most} lines cannot be told apart: draw several pictures"
        )));
    }
    if let Some(path) = args.output.as_ref().filter(|path| path.extension().is_none_or(|end| end != "svg")) {
        return Err(Failure::unusable(format!("'{}': pictures are SVG: name it .svg", path.display())));
    }
    if args.output.is_none() && !is_json && io::stdout().is_terminal() {
        return Err(Failure::unusable("the picture is nothing for a terminal: name a file with -o FILE.svg"));
    }
    let progress = Progress::new(is_json);
    let mut bag = Ordered::open(&args.bag, &mut |path| progress.say(path))?;
    let (start_ns, from_ns, to_ns) = args.range(&bag)?;
    // The times of chunks are unchecked, so without --from and --to the range is unlimited.
    let wanted_ns = args.from.map_or(0, |_| from_ns)..=args.to.map_or(u64::MAX, |_| to_ns);
    let mut lines = Vec::new();
    for wanted in &args.fields {
        lines.push(args.line(&bag, wanted, (from_ns, to_ns))?);
    }
    bag.rewind(*wanted_ns.start());
    while let Some(message) = bag.next_message()? {
        progress.tick();
        let at_ns = message.stamp.log_ns;
        if at_ns > *wanted_ns.end() {
            break;
        }
        if at_ns < *wanted_ns.start() {
            continue;
        }
        let mut read: Option<Result<DynamicMessage, String>> = None;
        for line in lines.iter_mut().filter(|line| line.topics.contains(&message.topic)) {
            let read = read.get_or_insert_with(|| {
                if is_compressed(&message.cdr) {
                    return Err(
                        "it is compressed by itself; `taut bag convert` decompresses the bag".to_owned()
                    );
                }
                DynamicMessage::from_cdr(&line.schema, &message.cdr).map_err(|error| error.to_string())
            });
            line.add(at_ns, read.as_ref(), is_json);
        }
    }
    progress.end();
    lines.iter().try_for_each(|line| line.check(&args.bag))?;
    if is_json {
        print_json(args, start_ns, &lines)?;
    }
    if !is_json || args.output.is_some() {
        let name = std::path::absolute(&args.bag)?;
        let picture = Picture {
            name: name.file_name().unwrap_or_default().to_string_lossy().into_owned(),
            start_ns,
            from_ns,
            to_ns,
            size: (args.width.into(), args.height.into()),
            series: lines.iter().map(|line| &line.series).collect(),
        };
        let svg = picture.draw()?;
        match &args.output {
            None => taut_cli::print::stdout().write_all(svg.as_bytes())?,
            Some(path) => {
                let written = taut_cli::replace::write(path, svg);
                written.map_err(|error| {
                    Failure::unusable(format!("'{}' cannot be written: {error}", path.display()))
                })?;
                if !is_json {
                    let messages: u64 = lines.iter().map(|line| line.series.messages).sum();
                    let (messages, seconds) = (count(messages, "message"), (to_ns - from_ns) as f64 / 1e9);
                    let path = path.display();
                    writeln!(taut_cli::print::stdout(), "{path}: {messages} of {seconds:.1} s")?;
                }
            }
        }
    }
    lines.iter().for_each(Line::warn);
    let damage: Vec<_> = bag.damage().map(|(path, damage)| (path.to_owned(), damage)).collect();
    whole(&damage, bag.damages())
}

impl PlotArgs {
    /// The bag's beginning and the drawn range, in times of reception.
    fn range(&self, bag: &Ordered) -> Outcome<(u64, u64, u64)> {
        let Some((start_ns, end_ns)) = bag.span_ns() else {
            return Err(Failure::unusable(format!("{} has no messages", self.bag.display())));
        };
        let at = |time: Duration| start_ns.saturating_add(nanoseconds(time));
        let from_ns = self.from.map_or(start_ns, at);
        let to_ns = self.to.map_or(end_ns, at).min(end_ns);
        if from_ns > to_ns {
            let seconds = (end_ns - start_ns) as f64 / 1e9;
            return Err(Failure::unusable(format!("there is nothing between: the bag is of {seconds:.1} s")));
        }
        Ok((start_ns, from_ns, to_ns))
    }

    fn line(&self, bag: &Ordered, wanted: &Wanted, (from_ns, to_ns): (u64, u64)) -> Outcome<Line> {
        let topics = bag.topics();
        let Some(topic) = topics.iter().position(|topic| topic.name == wanted.topic) else {
            let names = topics.iter().map(|topic| &*topic.name);
            let what = format!("topic '{}' in {}", wanted.topic, self.bag.display());
            return Err(field::missing(&what, &wanted.topic, names));
        };
        let (first, bare) = (&topics[topic], topics[topic].bare());
        let of_name = || topics.iter().enumerate().filter(|(_, topic)| topic.name == first.name);
        if of_name().any(|(_, topic)| topic.bare() != bare) {
            let Topic { name, type_name, .. } = &**first;
            eprintln!(
                "taut: warning: {name} has several types or definitions, of which the first, {type_name}, is drawn"
            );
        }
        let schema = schema_of(first)?;
        let topics = of_name().filter(|(_, topic)| topic.bare() == bare).map(|(at, _)| at).collect();
        let is_step = wanted.check(&schema)? == Primitive::Bool;
        let columns = Columns::new(from_ns, to_ns, usize::from(self.width));
        let series = Series { name: wanted.to_string(), columns, is_step, messages: 0, gaps: 0 };
        Ok(Line { wanted: wanted.clone(), topics, schema, series, points: Vec::new(), unread: (0, None) })
    }
}

impl Line {
    fn add(&mut self, at_ns: u64, message: Result<&DynamicMessage, &String>, keeps_points: bool) {
        self.series.messages += 1;
        let value = match message {
            Ok(message) => message.get(&self.wanted.path).ok(),
            Err(why) => {
                self.unread.0 += 1;
                self.unread.1.get_or_insert_with(|| why.clone());
                None
            }
        };
        let value = value.as_deref();
        let number = value.and_then(number).filter(|number| columns::can_be_drawn(*number));
        self.series.gaps += u64::from(number.is_none());
        self.series.columns.add(at_ns, number);
        if keeps_points {
            self.points.push((at_ns, value.map_or(Json::Null, json_of)));
        }
    }

    /// # Errors
    /// There is nothing to draw.
    fn check(&self, bag: &Path) -> Outcome {
        let Series { name, messages, gaps, .. } = &self.series;
        if gaps < messages {
            return Ok(());
        }
        let (topic, bag) = (&self.wanted.topic, bag.display());
        let what = match &self.unread {
            _ if *messages == 0 => {
                format!("{topic} has no message in that time; `taut bag info {bag}` says how many in all")
            }
            (unread, Some(why)) if unread == messages => {
                format!("no message of {topic} can be read: {why}")
            }
            _ => format!(
                "{name} is no number in any of {messages} messages: NaN, infinite, or an element that is not there"
            ),
        };
        Err(Failure::no(what))
    }

    fn warn(&self) {
        if let (unread, Some(why)) = &self.unread {
            eprintln!("taut: warning: {unread} messages of {} cannot be read: {why}", self.wanted.topic);
        }
    }
}

/// The definition in the bag, or else the one that is known on this host.
fn schema_of(topic: &Topic) -> Outcome<Arc<Schema>> {
    let unusable = |error: &dyn std::fmt::Display| Failure::unusable(format!("{}: {error}", topic.name));
    if topic.encoding != CDR {
        return Err(unusable(&format!("its messages are {}; only {CDR} can be drawn", topic.encoding)));
    }
    let name: TypeName = topic.type_name.parse().map_err(|error| unusable(&error))?;
    if let Some(text) = &topic.ros2msg() {
        return from_bag(&name, text).map(Arc::new).map_err(|error| unusable(&error));
    }
    find_schema(&topic.name, &name, Some(&recorded_type(topic))).map_err(|error| unusable(&error))
}

fn number(value: &Value) -> Option<f64> {
    match value {
        Value::Bool(value) => Some(f64::from(u8::from(*value))),
        other => other.as_f64(),
    }
}

/// Integers are kept exactly; a value for which JSON has no number is null.
fn json_of(value: &Value) -> Json {
    match value {
        Value::Bool(value) => json!(value),
        Value::F32(value) => json!(value),
        Value::F64(value) => json!(value),
        other => match other.as_integer() {
            Some(value) => i64::try_from(value).map_or_else(|_| json!(value as u64), |value| json!(value)),
            None => Json::Null,
        },
    }
}

fn print_json(args: &PlotArgs, start_ns: u64, lines: &[Line]) -> Outcome {
    let series = |line: &Line| {
        json!({
            "topic": line.wanted.topic, "field": line.wanted.path, "messages": line.series.messages, "gaps": line.series.gaps,
            "points": line.points,
        })
    };
    let report = json!({
        "bag": args.bag.display().to_string(), "start_ns": start_ns, "series": lines.iter().map(series).collect::<Vec<_>>(),
    });
    Ok(writeln!(taut_cli::print::stdout(), "{report}")?)
}
