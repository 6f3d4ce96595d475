// SPDX-License-Identifier: MIT OR Apache-2.0
//! The tables of the documents.

use std::fmt::Write;

use tautline_harness::rows::{Row, median};
use tautline_harness::table::{distinct, figure as us, markdown, size};

use crate::callbacks::{FLOOD, QUIET};
use crate::plan::Bench;

/// What a bench found, and under which conditions.
pub fn tables(bench: Bench, rows: &[Row]) -> String {
    let (mut out, words) = match bench {
        Bench::Compare => (compare(rows), COMPARE),
        Bench::Wake => (wake(rows), WAKE),
        Bench::Services => (services(rows), SERVICES),
        Bench::Network => (network(rows), NETWORK),
    };
    let name = format!("{bench:?}").to_lowercase();
    let conditions = rows.iter().find(|row| row.system == "machine").map_or("?", |row| &row.note);
    let ours = rows.iter().filter(|row| row.system == "tautline");
    let lost = match ours.map(|row| row.lost).sum() {
        0 => "nothing of Tautline's was lost".to_owned(),
        1 => "1 message of Tautline's was lost".to_owned(),
        lost => format!("{lost} messages of Tautline's were lost"),
    };
    let _ = writeln!(out, "\n`cargo xtask bench {name}`: {words}; {lost}; {conditions}.{}", left_out(rows));
    out
}

const COMPARE: &str = "half round trips in µs (p50 / p99), payload written and read whole, the experiment with idle states held off; pinned; one way \
     at 1 kHz under load; 20 topics at 100 Hz: CPU time of all processes per message in µs, the topics evenly over the period and all at \
     once, and resident memory; -: not measured, or too few times for that percentile";
const WAKE: &str = "two processes, pinned, alternating rounds. A bare futex is the floor for anything that sleeps; busy polling occupies a core. \
     iceoryx2 alone is faster where it polls, and may be with large payloads: Tautline adds sequence numbers, time stamps, loss counters and a callback";
const SERVICES: &str = "two processes, each on a core, both blocking, alternating rounds, responses of 64 bytes; service: nothing is copied; r2r's \
     requests are a text that is";
const NETWORK: &str = "from a node over two gateways to a node, beside Zenoh's own publishers and subscribers and hiroz's, TCP over loopback, two processes, each \
     with its gateway on a core, alternating rounds";

/// What was not measured, and why.
fn left_out(rows: &[Row]) -> String {
    let missing = rows.iter().filter(|row| row.n == 0 && row.system != "machine");
    let all = distinct(missing.map(|row| {
        let name = if row.mode == "-" { row.system.clone() } else { format!("{}, {}", row.system, row.mode) };
        let of = if row.experiment == "-" { String::new() } else { format!("{}: ", row.experiment) };
        format!("{name} ({of}{})", row.note)
    }));
    if all.is_empty() { String::new() } else { format!(" Left out: {}.", all.join("; ")) }
}

/// A column: its title, and what it says of a way's rows.
type Column<'a> = (String, Box<dyn Fn(&[&Row]) -> String + 'a>);

/// What is said of the row of an experiment and a payload.
fn column<'a>(
    title: impl Into<String>,
    experiment: &'a str,
    bytes: usize,
    text: impl Fn(&Row) -> String + 'a,
) -> Column<'a> {
    let of_way = move |rows: &[&Row]| {
        let is_wanted = |row: &&&Row| row.experiment == experiment && row.payload_bytes == bytes;
        rows.iter().find(is_wanted).map_or("-".to_owned(), |row| text(row))
    };
    (title.into(), Box::new(of_way))
}

/// A line for each way of each system of which there is something to say, in the order in which they first appear.
fn table(rows: &[Row], corner: &str, columns: &[Column<'_>]) -> String {
    let rows: Vec<&Row> = rows.iter().filter(|row| row.n > 0).collect();
    let ways = distinct(rows.iter().map(|row| (&row.system, &row.mode)));
    let line = |(system, mode): (&String, &String)| {
        let of_way: Vec<&Row> =
            rows.iter().filter(|row| (&row.system, &row.mode) == (system, mode)).copied().collect();
        let cells: Vec<String> = columns.iter().map(|(_, text)| text(&of_way)).collect();
        let is_said = cells.iter().any(|cell| cell != "-");
        is_said.then(|| [vec![format!("{system}, {mode}")], cells].concat())
    };
    let titles = [corner].into_iter().chain(columns.iter().map(|(title, _)| title.as_str()));
    markdown(titles, 1, ways.into_iter().filter_map(line))
}

/// Payloads of an experiment, from the least.
fn sizes(rows: &[Row], experiment: &str) -> Vec<usize> {
    let of = rows.iter().filter(|row| row.experiment == experiment && row.n > 0);
    let mut sizes: Vec<usize> = of.map(|row| row.payload_bytes).collect();
    sizes.sort_unstable();
    sizes.dedup();
    sizes
}

fn all_us<const N: usize>(numbers: [Option<f64>; N]) -> String {
    numbers.map(us).join(" / ")
}

fn compare(rows: &[Row]) -> String {
    let held = "latency/whole/held-off";
    let shipped = "latency/whole/as-shipped";
    let (apart, at_once) = ("robot/20x100Hz/as-shipped", "robot/20x100Hz/at-once/as-shipped");
    let both = |row: &Row| all_us([row.p50_us, row.p99_us]);
    let tail = |row: &Row| all_us([row.p99_us, row.p999_us]);
    let columns = [
        column("64 B", held, 64, both),
        column("1 MiB", held, 1 << 20, both),
        column("8 MiB", held, 8 << 20, both),
        column("1 kHz under load, p99 / p99.9", "open-loop/load/held-off", 1024, tail),
        column("robot: CPU", apart, 4096, |row| us(row.cpu_us_per_msg)),
        column("at once", at_once, 4096, |row| us(row.cpu_us_per_msg)),
        column("robot: MiB", apart, 4096, |row| us(row.rss_mib)),
    ];
    let by_size: Vec<_> = sizes(rows, held).into_iter().map(|bytes| pair([held, shipped], bytes)).collect();
    [
        table(rows, "system", &columns),
        titled("By size, half a round trip, p50 in µs (idle states held off / as shipped)", rows, &by_size),
        titled("Streams by size, from one message to the next in µs", rows, &streams(rows)),
        titled("Start to the first message, in ms", rows, &starts()),
        titled("1 MiB to several subscriptions, until the last has it, p50 in µs", rows, &fan_out(rows)),
    ]
    .concat()
}

fn streams(rows: &[Row]) -> Vec<Column<'_>> {
    let stream = "throughput/held-off";
    // The median round.
    let interval =
        |row: &Row| median(row.rounds.iter().filter_map(|it| Some(1e6 / it.msgs_per_s?)).collect());
    let of_size = |bytes| column(size(bytes), stream, bytes, move |row| us(interval(row)));
    sizes(rows, stream).into_iter().map(of_size).collect()
}

fn starts() -> [Column<'static>; 3] {
    [
        ("first message", "start-up/first-message/as-shipped"),
        ("to a late joiner", "start-up/late-joiner/as-shipped"),
        ("on each of 100 topics", "start-up/100-topics/as-shipped"),
    ]
    .map(|(title, experiment)| column(title, experiment, 64, |row| us(row.p50_us.map(|us| us / 1e3))))
}

/// Of each number of subscriptions that was measured.
fn fan_out(rows: &[Row]) -> Vec<Column<'_>> {
    let measured = || distinct(rows.iter().filter(|row| row.n > 0).map(|row| row.experiment.as_str()));
    let of_kind = |(kind, title): (&str, &str)| {
        let mut counts: Vec<(usize, &str)> = measured()
            .into_iter()
            .filter_map(|experiment| Some((experiment.strip_prefix(kind)?.parse().ok()?, experiment)))
            .collect();
        counts.sort_unstable();
        let text = |row: &Row| us(row.p50_us);
        counts
            .into_iter()
            .map(|(count, experiment)| column(format!("{count} {title}"), experiment, 1 << 20, text))
            .collect::<Vec<_>>()
    };
    let (one, many) = ("fan-out/one-process/held-off/", "fan-out/processes/held-off/");
    [(one, "in one process"), (many, "in as many processes")].into_iter().flat_map(of_kind).collect()
}

/// Nothing where nothing was measured.
fn titled(title: &str, rows: &[Row], columns: &[Column<'_>]) -> String {
    let table = table(rows, "system", columns);
    if table.lines().nth(2).is_none() { String::new() } else { format!("\n{title}:\n\n{table}") }
}

/// Medians of two experiments, in one column.
fn pair<'a>(experiments: [&'a str; 2], bytes: usize) -> Column<'a> {
    let [(title, one), (_, other)] =
        experiments.map(|name| column(size(bytes), name, bytes, |row| us(row.p50_us)));
    let both = move |rows: &[&Row]| match [one(rows), other(rows)] {
        [one, other] if one == "-" && other == "-" => "-".to_owned(),
        both => both.join(" / "),
    };
    (title, Box::new(both))
}

fn wake(rows: &[Row]) -> String {
    let times = |row: &Row| all_us([row.p50_us, row.p99_us, row.p999_us, row.max_us]);
    let of_64 = [
        column("idle states as shipped", "latency/untouched/as-shipped", 64, times),
        column("idle states held off", "latency/untouched/held-off", 64, times),
    ];
    let (untouched, whole) = ("latency/untouched/held-off", "latency/whole/held-off");
    let by_size: Vec<_> =
        sizes(rows, whole).into_iter().map(|bytes| pair([untouched, whole], bytes)).collect();
    format!(
        "64 B, from one process to another, half a round trip, in µs (p50 / p99 / p99.9 / max):\n\n{}\n\
         By size, idle states held off, p50 in µs (payload untouched / all of it written and read):\n\n{}",
        table(rows, "system", &of_64),
        table(rows, "system", &by_size)
    )
}

fn services(rows: &[Row]) -> String {
    let of_size = |bytes| {
        column(size(bytes), "request/held-off", bytes, |row| {
            all_us([row.p50_us, row.p99_us, row.p999_us, row.max_us])
        })
    };
    let columns: Vec<Column<'_>> = sizes(rows, "request/held-off").into_iter().map(of_size).collect();
    table(rows, "round trip in µs, p50 / p99 / p99.9 / max, by the request's size", &columns)
}

fn network(rows: &[Row]) -> String {
    let rate = |row: &Row| row.mb_per_s.map_or("-".to_owned(), |rate| format!("{rate:.0}"));
    let trips = "latency/untouched/as-shipped";
    let (window, unbounded) = ("window/as-shipped", "throughput/untouched/as-shipped");
    let of_trip = |bytes| column(size(bytes), trips, bytes, |row| all_us([row.p50_us, row.p99_us]));
    let of_stream = |bytes| {
        [(window, "4 MiB under way"), (unbounded, "held back by the receiver")]
            .map(|(name, how)| column(format!("{}, {how}", size(bytes)), name, bytes, rate))
    };
    let (of_trips, of_streams): (Vec<_>, Vec<_>) = (
        sizes(rows, trips).into_iter().map(of_trip).collect(),
        sizes(rows, window).into_iter().flat_map(of_stream).collect(),
    );
    let p99 = |experiment: &str| {
        let of = rows.iter().filter(|row| row.experiment == experiment);
        of.map(|row| us(row.p99_us.map(|us| us / 1e3))).collect::<Vec<_>>().join(" / ")
    };
    let arrived = rows.iter().find(|row| row.experiment == FLOOD).and_then(|row| row.mb_per_s).unwrap_or(0.0);
    format!(
        "{}\n{}\np99 response times in ms of five real-time callbacks that load a core to 90 %: {} alone, {} while {arrived:.0} MB/s \
         arrive for another topic.\n",
        table(rows, "half a round trip in µs, p50 / p99", &of_trips),
        table(rows, "a stream in MB/s", &of_streams),
        p99(QUIET),
        p99(FLOOD),
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::tests::row;
    use tautline_harness::rows::Round;

    #[test]
    fn the_comparison_has_a_line_per_way_and_names_what_is_left_out() {
        let held = "latency/whole/held-off";
        let missing = |experiment: &str, system: &str, mode: &str| Row {
            note: "not measured: why".to_owned(),
            n: 0,
            ..row(experiment, system, mode, 1 << 20, 1.0)
        };
        let of_round = Round { msgs_per_s: Some(2e6), ..Round::default() };
        let stream =
            Row { rounds: vec![of_round], ..row("throughput/held-off", "tautline", "stream", 64, 9.0) };
        let rows = [
            row(held, "tautline", "m", 64, 5.0),
            row("latency/whole/as-shipped", "tautline", "own-default", 64, 7.0),
            stream,
            row("start-up/100-topics/as-shipped", "tautline", "m", 64, 2_000.0),
            row("fan-out/processes/held-off/4", "tautline", "m", 1 << 20, 600.0),
            Row {
                cpu_us_per_msg: Some(40.0),
                ..row("robot/20x100Hz/as-shipped", "tautline", "m", 4096, 5.0)
            },
            row(held, "fastdds", "m", 64, 500.0),
            missing(held, "fastdds", "m"),
            row("latency/untouched/held-off", "hiroz", "m", 64, 5.0),
            missing("-", "copper", "-"),
        ];
        let tables = tables(Bench::Compare, &rows);
        for line in [
            "| tautline, m | 5.00 / 5.00 | - | - | - | 40.00 | - | - |",
            "| fastdds, m | 500 / 500 | - | - | - | - | - | - |",
            "| system | 64 B |\n|---|--:|\n| tautline, m | 5.00 / - |\n| tautline, own-default | - / 7.00 |\n| fastdds, m | 500 / - |\n",
            "| tautline, stream | 0.50 |\n",
            "| tautline, m | - | - | 2.00 |\n",
            "| system | 4 in as many processes |\n|---|--:|\n| tautline, m | 600 |\n",
            "Left out: fastdds, m (latency/whole/held-off: not measured: why); copper (not measured: why).",
        ] {
            assert!(tables.contains(line), "{line}\n{tables}");
        }
        assert!(!tables.contains("hiroz"), "it has none of these numbers\n{tables}");
    }

    #[test]
    fn the_other_benches_have_a_column_per_payload() {
        let (untouched, held) = ("latency/untouched/as-shipped", "latency/whole/held-off");
        let rows = [
            row(untouched, "zenoh", "tcp", 64, 5.0),
            row(untouched, "tautline", "gateway", 1 << 20, 400.0),
            Row { mb_per_s: Some(700.4), ..row("window/as-shipped", "zenoh", "tcp", 64 << 10, 1.0) },
            row(QUIET, "tautline", "a", 0, 2000.0),
            Row { mb_per_s: Some(480.0), ..row(FLOOD, "tautline", "a", 1 << 20, 2100.0) },
            row(held, "floor", "futex", 64, 3.0),
            row("request/held-off", "r2r", "service", 64, 123.4),
        ];
        for (bench, line) in [
            (Bench::Network, "| half a round trip in µs, p50 / p99 | 64 B | 1 MiB |\n|---|--:|--:|"),
            (Bench::Network, "| zenoh, tcp | 5.00 / 5.00 | - |"),
            (Bench::Network, "| zenoh, tcp | 700 | - |"),
            (Bench::Network, "90 %: 2.00 alone, 2.10 while 480 MB/s"),
            (Bench::Wake, "| zenoh, tcp | 5.00 / 5.00 / 5.00 / 5.00 | - |"),
            (Bench::Wake, "| floor, futex | - / 3.00 |"),
            (Bench::Services, "| r2r, service | 123 / 123 / 123 / 123 |"),
        ] {
            let tables = tables(bench, &rows);
            assert!(tables.contains(line), "{line}\n{tables}");
        }
    }
}
