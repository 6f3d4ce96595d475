// SPDX-License-Identifier: MIT OR Apache-2.0

use super::*;
use crate::Distribution;
use crate::rows::Tally;

const HELD: &str = "latency/whole/held-off";

/// Each round has 10,000 times of so many µs.
fn row(system: &str, mode: &str, p50s_us: &[f64]) -> Row {
    let mut tally = Tally::default();
    for (index, us) in p50s_us.iter().enumerate() {
        let mut times = Distribution::new();
        times.add(&[((us * 1e3) as u64, 10_000)]);
        tally.add(index as u32 + 1, &times).cpu_us_per_msg = Some(*us);
    }
    tally.row(HELD, system, mode, 64)
}

fn ours(p50s_us: &[f64]) -> Row {
    row("tautline", "blocking", p50s_us)
}

fn measurable() -> Measurable {
    let modes = [
        ("tautline", "blocking"),
        ("tautline", "direct"),
        ("rival", "default"),
        ("other", "x"),
        ("other", "polling"),
        ("floor", "futex"),
    ];
    Measurable {
        payloads: [(HELD.to_owned(), 64)].into(),
        modes: modes.map(|(system, mode)| (system.to_owned(), mode.to_owned())).into(),
    }
}

/// A claim about rows of 64 B, with these lines more.
fn claim(lines: &str) -> String {
    format!(
        "[[claim]]\nwords = 'it is fast'\nexperiment = '{HELD}'\nbytes = '64 B'\nours = {{ system = 'tautline' }}\n\
         {lines}\n"
    )
}

fn judge_claim(lines: &str, rows: &[Row]) -> Verdict {
    read(&claim(lines), Bench::Compare, &measurable()).unwrap()[0].judge(rows)
}

fn refusal(text: &str) -> String {
    read(text, Bench::Compare, &measurable()).err().unwrap().to_string()
}

const FASTER: &str = "metric = 'p50'\ntheirs = { system = 'rival' }\nat-most = { times = 1.0 }";

#[test]
fn the_best_of_each_side_counts_and_what_was_not_measured_is_no_success() {
    let rows = [
        ours(&[6.0]),
        row("tautline", "direct", &[4.0]),
        row("rival", "default", &[10.0]),
        row("rival", "tuned", &[5.0]),
    ];
    assert_eq!(
        judge_claim(FASTER, &rows).to_string(),
        "holds       it is fast: 0.80 x in one round, at most 1.00 x: 4.00 µs (direct) against 5.00 µs (rival tuned)"
    );
    let blocking = FASTER.to_owned() + "\nfloor = { system = 'floor' }\nreason = 'x'\n[reasons]\nx = 'why'";
    let without_direct = [&rows[..1], &rows[2..], &[row("floor", "futex", &[7.5])]].concat();
    let missed = judge_claim(&blocking, &without_direct).to_string();
    assert!(missed.starts_with("MISSED ") && missed.ends_with("; why it stays: why"), "{missed}");
    assert!(missed.contains("; the floor itself 1.50 x: the limit lies below the floor"), "{missed}");
    assert_eq!(judge_claim(FASTER, &[]).to_string(), "not judged  it is fast: not measured");
    assert_eq!(judge_claim(FASTER, &rows[..2]).found, "theirs not measured");
}

#[test]
fn rounds_are_compared_with_their_own_rivals() {
    // The machine was slow in one round and in the next it was not: pooled figures would say 14 against 11.
    let rows = [ours(&[8.0, 16.0, 14.0]), row("rival", "tuned", &[10.0, 20.0, 11.0])];
    let verdict = judge_claim(FASTER, &rows);
    assert_eq!(verdict.holds, Some(true));
    assert!(verdict.found.starts_with("0.80 x, the median of 3 rounds (0.80 to 1.27)"), "{verdict}");
    let mut late = rows.clone();
    late[1].rounds.iter_mut().for_each(|round| round.round += 1);
    let verdict = judge_claim(FASTER, &late);
    assert!(verdict.found.starts_with("1.15 x, the median of 2 rounds (0.70 to 1.60)"), "{verdict}");
}

#[test]
fn what_failed_lost_or_is_of_too_few_is_not_judged() {
    let holds = |metric: &str, ours: Row, theirs: Row| {
        judge_claim(&FASTER.replace("p50", metric), &[ours, theirs]).holds
    };
    let both =
        |ours: Row, theirs: Row| ["p50", "p99"].map(|metric| holds(metric, ours.clone(), theirs.clone()));
    let (us, them) = (|| ours(&[6.0]), || row("rival", "default", &[10.0]));
    assert_eq!(both(us(), them()), [Some(true); 2]);
    assert_eq!(both(Row { lost: 1, ..us() }, them()), [None; 2]);
    assert_eq!(both(us(), Row { lost: 1, ..them() }), [None; 2]);
    assert_eq!(both(Row { unfit: Some("failed".to_owned()), ..us() }, them()), [None; 2]);
    assert_eq!(both(Row { n: 999, ..us() }, them()), [Some(true), None]);
    assert_eq!(both(Row { n: 1000, ..us() }, them()), [Some(true); 2]);
    assert_eq!(holds("p99'\nhowever-few = true\n#", Row { n: 999, ..us() }, them()), Some(true));
}

#[test]
fn limits_are_of_a_ratio_a_difference_or_a_number() {
    let rows = [ours(&[8.0]), row("rival", "default", &[4.0])];
    let more = judge_claim("metric = 'p50'\ntheirs = { system = 'rival' }\nat-most = { more = 6 }", &rows);
    assert!(
        more.to_string().contains("holds       it is fast: +4.00 µs in one round, at most +6.00 µs: 8.00"),
        "{more}"
    );
    let least = "metric = 'CPU time'\ntheirs = { system = 'rival' }\nat-least = { times = 3 }";
    assert_eq!(judge_claim(least, &rows).holds, Some(false));
    let alone = judge_claim("metric = 'p50'\nat-most = { number = 9.5 }\nbeside = ['CPU time']", &rows);
    assert_eq!(
        alone.to_string(),
        format!("holds       it is fast: 8.00 µs, at most 9.50 (blocking, {HELD}); 8.00 µs")
    );
}

#[test]
fn one_entry_is_a_claim_for_each_text() {
    let lines =
        "each = ['rival', 'other']\nmetric = 'p50'\ntheirs = { system = '{}' }\nat-most = { times = 1 }";
    let text = claim(lines).replace("it is fast", "faster than {}");
    let claims = read(&text, Bench::Compare, &measurable()).unwrap();
    assert_eq!(
        claims.iter().map(|claim| claim.words.as_str()).collect::<Vec<_>>(),
        ["faster than rival", "faster than other"]
    );
    assert_eq!(claims[1].judge(&[ours(&[1.0]), row("rival", "x", &[2.0])]).found, "theirs not measured");
    let is_about = |rows: &[Row]| claims[1].is_about(rows);
    assert!(is_about(&[ours(&[1.0]), row("other", "x", &[])]), "also if nothing was measured of the other");
    assert!(!is_about(&[ours(&[1.0]), row("rival", "x", &[2.0])]), "a system that takes no part");
    assert!(!is_about(&[Row { experiment: "else".into(), ..ours(&[1.0]) }, row("other", "x", &[2.0])]));
}

#[test]
fn one_entry_is_a_claim_for_each_size() {
    let two = claim(FASTER).replace("'64 B'", "['64 B', '1 KiB']").replace("it is fast", "fast at {bytes}");
    let mut measurable = measurable();
    measurable.payloads.insert((HELD.to_owned(), 1 << 10));
    let claims = read(&two, Bench::Compare, &measurable).unwrap();
    assert_eq!(
        claims.iter().map(|claim| &*claim.words).collect::<Vec<_>>(),
        ["fast at 64 B", "fast at 1 KiB"]
    );
    let rows = [ours(&[6.0]), row("rival", "default", &[10.0])];
    assert_eq!([0, 1].map(|at| claims[at].judge(&rows).holds), [Some(true), None]);
    assert!(refusal(&two.replace("{bytes}", "size")).contains("needs a {bytes}"));
}

/// A claim for each metric of each experiment.
const SILENT: &str = "[[claim]]
silent = true
words = '{experiment}, {bytes}: {metric}'
ours = { system = 'tautline', modes = ['blocking'] }
instead = ['direct']
theirs = { system = 'rival', except = ['polling'] }
at-most = { times = 1.05 }
parts = [{ experiment = 'latency/', metric = ['p50', 'CPU time'], reason = 'wakes' }]
[reasons]
wakes = 'it wakes two'
";

#[test]
fn a_silent_claim_is_told_only_where_it_is_missed() {
    let claims = read(SILENT, Bench::Compare, &measurable()).unwrap();
    let (us, them) = (ours(&[6.0]), row("rival", "default", &[5.0]));
    let rows = [us.clone(), row("tautline", "direct", &[4.0]), them.clone(), row("rival", "polling", &[1.0])];
    let verdicts: Vec<String> = told(&claims, &rows).iter().map(ToString::to_string).collect();
    assert_eq!(verdicts.len(), 2, "{verdicts:?}");
    assert_eq!(
        verdicts[0],
        "MISSED      latency/whole/held-off, 64 B: p50: 1.20 x in one round, at most 1.05 x: 6.00 µs (blocking) against \
         5.00 µs (rival default); direct 4.00 µs; why it stays: it wakes two"
    );
    assert!(verdicts[1].starts_with("MISSED      latency/whole/held-off, 64 B: CPU time: "), "{verdicts:?}");
    let better = told(&claims, &[us.clone(), row("tautline", "direct", &[7.0]), them.clone()]);
    assert!(!better[0].found.contains("direct"), "{}", better[0]);
    for (us, them) in [(ours(&[5.0]), them.clone()), (us, Row { lost: 1, ..them })] {
        assert!(told(&claims, &[us, them]).is_empty());
    }
}

#[test]
fn a_bad_file_says_where_and_what_would_be_right() {
    for (lines, words) in [
        (FASTER.replace("metric", "metrik"), vec!["line 6", "unknown field `metrik`", "`metric`"]),
        (FASTER.replace("p50", "p51"), vec!["line 1, 'metric'", "no metric 'p51'", "p50, p99"]),
        (FASTER.replace("1.0", "'1.0'"), vec!["line 8", "invalid type: string"]),
        (FASTER.replace("at-most", "at-least = { times = 1 }\nat-most"), vec!["line 1, 'at-most'", "either"]),
        (FASTER.replace("times", "number"), vec!["line 1, 'theirs'", "leave 'theirs' out"]),
        ("metric = 'p50'\nat-most = { times = 1 }".to_owned(), vec!["line 1, 'theirs'", "missing"]),
        (FASTER.to_owned() + "\neach = ['a']", vec!["line 1, 'words'", "needs a {}"]),
    ] {
        let refused = refusal(&claim(&lines));
        for word in words.into_iter().chain(["benches/claims.toml"]) {
            assert!(refused.contains(word), "no '{word}' in: {refused}");
        }
    }
    let whole = claim(FASTER);
    let unknown = refusal(&format!("{whole}{}", whole.replace(HELD, "latency/hole")));
    assert!(
        unknown.contains(
            "line 9, 'experiment' of \"it is fast\": there is no 'latency/hole'; there are latency/whole"
        ),
        "{unknown}"
    );
    for (from, to, why) in [
        ("64 B", "64 KiB", "'bytes' of \"it is fast\": 'latency/whole/held-off' is not measured with 64 KiB"),
        ("'rival'", "'arrival'", "'system' of \"it is fast\": there is no 'arrival'"),
        ("'rival'", "'rival', modes = ['fault']", "'rival' has no 'fault'; it has default"),
    ] {
        assert!(refusal(&whole.replace(from, to)).contains(why), "{}", refusal(&whole.replace(from, to)));
    }
    assert!(refusal(&whole.replace("64 B", "64")).contains("'bytes' of \"it is fast\": '64' is no size"));
    assert!(
        refusal(&whole.replace("experiment =", "# ")).contains("'experiment' of \"it is fast\": missing")
    );
    let nowhere = whole.replace(&format!("'{HELD}'"), "[]");
    assert!(refusal(&nowhere).contains("'experiment' of \"it is fast\": missing"));
    assert!(refusal(&whole.replace("it is fast", "as {}")).contains("no 'each' says"));
    assert!(refusal(&whole.replace("[claim]", "[clame]")).contains("unknown field `clame`"));
    for (from, to, why) in [
        (
            "reason = 'wakes'",
            "reason = 'waits'",
            "'reason' of \"{experiment}, {bytes}: {metric}\": there is no 'waits'",
        ),
        ("'latency/'", "'latencies/'", "nothing is measured of 'latencies/'"),
        (
            "metric = ",
            "bytes = '1 KiB', metric = ",
            "nothing is measured of 'latency/', or nothing of such sizes",
        ),
        ("['polling']", "['poling']", "no system has a 'poling'"),
        (": {metric}'", "'", "with several metrics it needs a {metric}"),
    ] {
        assert!(refusal(&SILENT.replace(from, to)).contains(why), "{}", refusal(&SILENT.replace(from, to)));
    }
}
