// SPDX-License-Identifier: MIT OR Apache-2.0
//! Admission against the analysis of one file that holds everything.

use std::fmt::Write;

use rand::RngExt;
use rand::rngs::StdRng;
use tautline_analysis::file::SystemFile;
use tautline_analysis::file::admission::{Candidate, LooseThread, Machine, Share};

const HEAD: &str =
    "[hosts.robot]\ncores = 3\n[overheads]\ncontext_switch = \"5us\"\nper_message = \"40us\"\n";

/// One node with its callbacks: a timer, what it triggers, a group, a chain; some of them.
struct Part {
    /// Of a file: without hosts and overheads.
    body: String,
}

impl Part {
    fn random(rng: &mut StdRng, number: usize) -> Part {
        let mut body = format!("[nodes.n{number}]\n");
        // By which much is refused, and much is not.
        let load = rng.random_range(0.05..0.5);
        let core = rng.random_range(0..3);
        let period_us = [1_000, 2_000, 5_000, 10_000, 20_000, 50_000][rng.random_range(0..6)];
        let members = rng.random_range(1..=3);
        let wcet_us = ((f64::from(period_us) * load / f64::from(members)) as u64).max(1);
        let grouped = members > 1 && rng.random_bool(0.3);
        let priority = rng.random_range(10..80);
        if grouped {
            writeln!(body, "[groups.g{number}]\npriority = {priority}").unwrap();
        }
        for member in 0..members {
            writeln!(
                body,
                "[callbacks.c{number}_{member}]\nnode = \"n{number}\"\nwcet = \"{wcet_us}us\"\ncore = {core}"
            )
            .unwrap();
            match member {
                0 => {
                    writeln!(body, "period = \"{period_us}us\"\njitter = \"{}us\"", rng.random_range(0..100))
                        .unwrap()
                }
                _ => writeln!(body, "topic = \"t{number}_{}\"", member - 1).unwrap(),
            }
            writeln!(body, "publishes = \"t{number}_{member}\"\nshares_priority = true").unwrap();
            match grouped {
                true => writeln!(body, "group = \"g{number}\"").unwrap(),
                false => writeln!(body, "priority = {}", rng.random_range(10..80)).unwrap(),
            }
        }
        if members > 1 && rng.random_bool(0.5) {
            let deadline_us = (f64::from(period_us) * rng.random_range(0.5..2.0)) as u64;
            let path: Vec<_> = (0..members).map(|member| format!("\"c{number}_{member}\"")).collect();
            let path = path.join(", ");
            writeln!(
                body,
                "[[chains]]\nname = \"k{number}\"\npath = [{path}]\ndeadline = \"{deadline_us}us\""
            )
            .unwrap();
        }
        Part { body }
    }
}

fn file_of<'p>(parts: impl IntoIterator<Item = &'p Part>) -> SystemFile {
    let bodies: String = parts.into_iter().map(|part| part.body.as_str()).collect();
    let text = format!("{HEAD}{bodies}");
    SystemFile::parse(&text).unwrap_or_else(|problems| panic!("{problems}\n{text}"))
}

/// A thousand random loads: what is admitted is what one file with all of it calls schedulable.
#[test]
fn what_the_analysis_calls_unschedulable_is_refused_and_nothing_else() {
    let mut rng = tautline_seed::random();
    let (mut admitted, mut refused, mut of_others) = (0, 0, 0);
    while admitted + refused < 1_000 {
        let parts: Vec<_> = (0..8).map(|number| Part::random(&mut rng, number)).collect();
        let files: Vec<_> = parts.iter().map(|part| file_of([part])).collect();
        let labels: Vec<_> = (0..8).map(|number| format!("{number}.toml")).collect();
        let share = |number: usize| Share { file: &files[number], host: "robot", label: &labels[number] };
        let mut running: Vec<usize> = Vec::new();
        for next in 0..parts.len() {
            let mut machine = Machine::default();
            running.iter().for_each(|&number| machine.add_file(share(number)));
            let admission = machine.admit(&Candidate::File(share(next)));
            let all = file_of(running.iter().chain([&next]).map(|&number| &parts[number]));
            let whole = all.check();
            let broken = &admission.broken;
            assert_eq!(broken.is_empty(), whole.schedulable, "{broken:?} of {}", parts[next].body);
            // To the nanosecond, and each by its name.
            let responses = |checked: &tautline_analysis::file::CheckedSystem| -> Vec<_> {
                checked.callbacks.iter().map(|of| (of.entry.name.clone(), of.response_overhead_ns)).collect()
            };
            assert_eq!(responses(&admission.checked), responses(&whole));
            for broken in broken {
                let met = |name: &str| match broken.kind {
                    "chain" => whole.chains.iter().find(|of| of.name == name).map(|of| of.met),
                    _ => whole.callbacks.iter().find(|of| of.entry.name == name).map(|of| of.met),
                };
                assert_eq!(met(&broken.name), Some(false), "{broken:?}");
                assert_eq!(broken.is_own, broken.label == labels[next], "{broken:?}");
                of_others += usize::from(!broken.is_own);
            }
            match broken.is_empty() {
                true => (admitted, _) = (admitted + 1, running.push(next)),
                false => refused += 1,
            }
        }
    }
    println!("{admitted} admitted, {refused} refused, {of_others} deadlines of others kept by that");
    assert!(admitted > 100 && refused > 100 && of_others > 50, "the loads are no test");
}

const SCAN: &str = "[hosts.robot]\ncores = 2\n[nodes.driver]\ncore = 0\n[callbacks.scan]\nperiod = \"10ms\"\nwcet = \"2ms\"\npriority = 50\n";
const PLAN: &str = "[hosts.pc]\ncores = 2\n[nodes.plan]\ncore = 0\n[callbacks.scan]\nperiod = \"20ms\"\nwcet = \"9ms\"\npriority = 40\n";

fn thread(core: Option<usize>, priority: u8) -> LooseThread {
    LooseThread {
        name: "loop".into(),
        label: "player (process 7)".into(),
        core,
        priority,
        reservation: None,
        period_ns: Some(10_000_000),
        streams: 1,
        jitter_ns: 0,
        budget_ns: Some(1_000_000),
        deadline_ns: Some(10_000_000),
    }
}

#[test]
fn hosts_of_several_names_are_one_machine_and_callbacks_of_one_name_are_two() {
    let (scan, plan) = (SystemFile::parse(SCAN).unwrap(), SystemFile::parse(PLAN).unwrap());
    let mut machine = Machine::default();
    machine.add_file(Share { file: &scan, host: "robot", label: "scan.toml" });
    machine.add_file(Share { file: &scan, host: "robot", label: "a copy of it" });
    let admission = machine.admit(&Candidate::File(Share { file: &plan, host: "pc", label: "plan.toml" }));
    assert!(admission.broken.is_empty());
    let callbacks: Vec<_> = admission
        .checked
        .callbacks
        .iter()
        .map(|of| (of.entry.name.as_str(), of.response_overhead_ns.unwrap() / 1_000_000))
        .collect();
    assert_eq!(callbacks, [("scan (scan.toml)", 2), ("scan (plan.toml)", 9 + 4)]);
}

#[test]
fn a_thread_is_refused_for_what_it_breaks() {
    let scan =
        SystemFile::parse(&SCAN.replace("wcet = \"2ms\"", "wcet = \"2ms\"\ndeadline = \"2.5ms\"")).unwrap();
    let mut machine = Machine::default();
    machine.add_file(Share { file: &scan, host: "robot", label: "scan.toml" });
    let admit = |thread: LooseThread| machine.admit(&Candidate::Thread(thread)).broken;

    assert_eq!(admit(thread(Some(0), 40)), [], "below");
    assert_eq!(admit(thread(Some(1), 60)), [], "on another core");
    let broken = admit(thread(Some(0), 60));
    let text = "callback `scan` of scan.toml would take up to 3ms, its deadline is 2.5ms";
    assert_eq!(broken.iter().map(ToString::to_string).collect::<Vec<_>>(), [text]);
    assert_eq!(admit(thread(None, 60)).len(), 1, "it may run there, too");

    // What says nothing of its load has no bound itself, and leaves none to what is below.
    let silent = |priority| LooseThread { budget_ns: None, deadline_ns: None, ..thread(Some(0), priority) };
    assert_eq!(admit(silent(40)), []);
    let text = "callback `scan` of scan.toml would have no bound, its deadline is 2.5ms";
    assert_eq!(admit(silent(60)).iter().map(ToString::to_string).collect::<Vec<_>>(), [text]);
}

#[test]
fn what_is_broken_without_the_candidate_is_not_its_fault() {
    let late =
        SystemFile::parse(&SCAN.replace("wcet = \"2ms\"", "wcet = \"2ms\"\ndeadline = \"1ms\"")).unwrap();
    let plan = SystemFile::parse(PLAN).unwrap();
    let mut machine = Machine::default();
    let share = Share { file: &late, host: "robot", label: "late.toml" };
    machine.add_file(share);
    let other = Candidate::File(Share { file: &plan, host: "pc", label: "plan.toml" });
    assert_eq!(machine.admit(&other).broken, []);
    // Another process of the same file is told the same as the first one.
    let again = machine.admit(&Candidate::File(share)).broken;
    assert!(again.len() == 1 && again[0].is_own, "{again:?}");
}
