// SPDX-License-Identifier: MIT OR Apache-2.0
//! The benches: what takes part in one is built, and what it is told is passed on to its own program.

use crate::build::Build;
use crate::steps::{cargo, execute};
use crate::{bridge, compare, lab, rmw, word};
use clap::{Arg, ArgMatches, FromArgMatches, Subcommand, ValueEnum};
use std::process::Command;

#[derive(Clone, Copy, PartialEq, Eq, Subcommand, ValueEnum)]
pub enum Name {
    /// What overruns of one callback do to the deadlines of others, if they are counted and if they are demoted; half a minute with --quick
    Budgets,
    /// How late the event of a missed deadline is with 200 topics on a sampler, beside a timer and a bare sleep; some seconds with --quick
    Deadlines,
    /// What a domain of many processes, topics and ends costs: idle, looked at, joined, under load;
    /// a minute and a half with --quick
    Domain,
    /// What reading a parameter costs a callback, and whether a thread that sets parameters disturbs it; some seconds
    /// with --quick
    Parameters,
    /// Whether a publisher notices that `taut topic hz`, `taut top` or `taut topic echo` looks at its topic; some seconds with --quick
    Tools,
    /// What a trace event costs, recorded and not; a second with --quick
    Trace,
    /// The wake-up from one process to another, beside a bare futex and iceoryx2; a minute and a half with --quick
    Wake,
    /// Writing, publishing and reading messages, beside a plain buffer and other encoders; some seconds with --quick
    Messages,
    /// Tautline beside Fast DDS, iceoryx2 and others: latency, load, fan-out, throughput, start-up
    Compare,
    /// Topics over two gateways beside plain Zenoh and hiroz, and what a flood from the network costs local callbacks
    Network,
    /// A request and its response, beside a topic each way, iceoryx2's request-response and, if there is a ROS 2, r2r's services
    Services,
    /// The bridge to ROS 2 at 20 topics of 1 kHz, each way, beside r2r's own subscriber; some minutes to build
    Bridge,
    /// Round trips, CPU time and start-up on rmw_tautline and on Fast DDS's RMW
    Rmw,
    /// The evaluation of an ECRTS 2025 paper, on Tautline and, if there is a ROS 2, on r2r beside it
    Paper,
    /// The Autoware reference system, 24 nodes in one process, on Tautline and, if there is a ROS 2, on r2r beside it
    ReferenceSystem,
    /// An automated lane keeping system, three processes in a closed loop with a simulated car, on Tautline and, if there is a ROS 2, on r2r
    Alks,
}

impl Name {
    /// The program of r2r's side, if it has one.
    pub fn r2r(self) -> Option<&'static str> {
        match self {
            Name::Paper => Some("paper-r2r"),
            Name::ReferenceSystem => Some("reference-r2r"),
            Name::Alks => Some("alks-r2r"),
            _ => None,
        }
    }

    /// Of a program that knows no `--quick`: what it is told instead, and what without it.
    fn lengths(self) -> Option<[&'static [&'static str]; 2]> {
        match self {
            Name::Bridge => Some([&["--seconds=2"], &[]]),
            Name::ReferenceSystem => Some([&["--seconds=3"], &["--seconds=20"]]),
            Name::Alks => Some([&["--seconds=5", "--rounds=1"], &["--seconds=60"]]),
            _ => None,
        }
    }
}

/// Builds what takes part, and makes the command that measures. Not told to the bench itself: a first `--`, `--no-r2r` if there is a side of
/// r2r's, and `--quick` if it does not know it. For its help no rival is built.
pub fn command(name: Name, told: &[String], of: Build) -> Result<Command, String> {
    let mut command = match name {
        Name::Bridge => bridge::bench(of)?,
        Name::Rmw => rmw::bench(of)?,
        Name::Domain => lab::program(of, "tautline-bench-domain", "domain"),
        Name::ReferenceSystem => lab::program(of, "reference-system", "reference_system"),
        Name::Alks => lab::program(of, "alks", "alks"),
        Name::Wake | Name::Compare | Name::Network | Name::Services => {
            lab::program(of, "tautline-compare", "compare")
        }
        _ => lab::program(of, "tautline-benches", &word(name)),
    };
    let mut told = told.to_vec();
    if told.iter().any(|word| word == "--help" || word == "-h") {
        command.arg("--help");
        return Ok(command);
    }
    if let Some(at) = told.iter().position(|word| word == "--") {
        told.remove(at);
    }
    match name {
        // It runs the `taut` of this build.
        Name::Tools => _ = of.with(&mut cargo("build --release -p taut -p taut-top"))?,
        Name::Wake | Name::Compare | Name::Network | Name::Services => {
            command.arg(format!("--bench={}", word(name)));
            let rivals = compare::rivals(&word(name), &values(&told, "--systems"));
            // Of an earlier run nothing is measured.
            if !rivals.is_empty() && values(&told, "--from").is_empty() {
                let mut check = lab::program(of, "tautline-compare", "compare");
                execute(check.arg(format!("--bench={}", word(name))).args(&told).arg("--check-options"))?;
                compare::join(&mut command, &rivals, of);
            }
        }
        _ => {}
    }
    if let Some(program) = name.r2r() {
        lab::join_r2r(&mut command, program, take(&mut told, "--no-r2r"), of);
    }
    if let Some([quick, whole]) = name.lengths() {
        let lengths = if take(&mut told, "--quick") { quick } else { whole };
        let is_told = |length: &str| !values(&told, length.split('=').next().unwrap_or_default()).is_empty();
        command.args(lengths.iter().filter(|length| !is_told(length)));
    }
    command.args(told);
    Ok(command)
}

/// Removes an option without a value; says whether it was there.
fn take(told: &mut Vec<String>, option: &str) -> bool {
    let before = told.len();
    told.retain(|word| word != option);
    told.len() != before
}

/// The values of an option, one or several with commas between.
fn values<'t>(told: &'t [String], option: &str) -> Vec<&'t str> {
    let value = |(index, word): (usize, &'t String)| match word.strip_prefix(option)? {
        "" => told.get(index + 1).map(String::as_str),
        rest => rest.strip_prefix('='),
    };
    told.iter().enumerate().filter_map(value).flat_map(|value| value.split(',')).collect()
}

/// A bench, and what it is told.
pub struct Bench {
    name: Name,
    told: Vec<String>,
}

impl Bench {
    pub fn run(&self) -> Result<(), String> {
        execute(&mut command(self.name, &self.told, Build::Release)?)
    }
}

/// What follows a name is the bench's, `--help` too.
impl Subcommand for Bench {
    fn augment_subcommands(command: clap::Command) -> clap::Command {
        let told = || Arg::new("OPTIONS").num_args(0..).trailing_var_arg(true).allow_hyphen_values(true);
        Name::augment_subcommands(command).mut_subcommands(|bench| bench.disable_help_flag(true).arg(told()))
    }

    fn augment_subcommands_for_update(command: clap::Command) -> clap::Command {
        Bench::augment_subcommands(command)
    }

    fn has_subcommand(name: &str) -> bool {
        Name::has_subcommand(name)
    }
}

impl FromArgMatches for Bench {
    fn from_arg_matches(matches: &ArgMatches) -> Result<Bench, clap::Error> {
        let told = matches.subcommand().and_then(|(_, told)| told.get_many::<String>("OPTIONS"));
        let told = told.into_iter().flatten().cloned().collect();
        Ok(Bench { name: Name::from_arg_matches(matches)?, told })
    }

    fn update_from_arg_matches(&mut self, matches: &ArgMatches) -> Result<(), clap::Error> {
        *self = Bench::from_arg_matches(matches)?;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What the bench's own program is told.
    fn told(line: &str) -> String {
        let words = ["bench"].into_iter().chain(line.split(' '));
        let matches = Bench::augment_subcommands(clap::Command::new("bench")).try_get_matches_from(words);
        let bench = Bench::from_arg_matches(&matches.unwrap()).unwrap();
        let command = command(bench.name, &bench.told, Build::Release).unwrap();
        let words: Vec<_> = command.get_args().map(|word| word.to_string_lossy()).collect();
        words.join(" ").split_once(" -- ").unwrap().1.to_owned()
    }

    #[test]
    fn options_are_passed_on() {
        assert_eq!(told("domain --quick -- --only storm"), "--quick --only storm");
        assert_eq!(told("messages -- --markdown x.md"), "--markdown x.md");
        assert_eq!(told("wake -- --systems floor,iceoryx2"), "--bench=wake --systems floor,iceoryx2");
        let without = "--without-r2r=as --no-r2r says";
        let paper = "--runs 3 --results paper.runs --minutes 30 --html x.html";
        assert_eq!(
            told(&format!("paper --no-r2r {paper} -- --core 0")),
            format!("{without} {paper} --core 0")
        );
    }

    #[test]
    fn a_wrong_option_is_refused_before_rivals_are_built() {
        // What cannot be built is left out and no error, so that the error is the check's.
        let told = ["--systems=tautline", "--onli=latency"].map(str::to_owned);
        assert!(command(Name::Compare, &told, Build::Tests).is_err());
    }

    #[test]
    fn an_earlier_run_is_shown_without_rivals() {
        let from = "--from x.json --systems fastdds --svg x.svg";
        assert_eq!(told(&format!("compare {from}")), format!("--bench=compare {from}"));
    }

    #[test]
    fn help_is_the_benchs_own_and_needs_no_rival() {
        assert_eq!([told("paper --help"), told("compare -h"), told("alks -- --help")], ["--help"; 3]);
    }

    #[test]
    fn programs_without_quick_are_told_how_long() {
        let told = |line: &str| told(line).replace("--without-r2r=as --no-r2r says ", "");
        assert_eq!(told("reference-system --quick --no-r2r --json x.json"), "--seconds=3 --json x.json");
        assert_eq!(told("reference-system --no-r2r"), "--seconds=20");
        assert_eq!(told("alks --no-r2r --quick --seconds 7"), "--rounds=1 --seconds 7");
        assert_eq!(told("alks --no-r2r -- --seconds=7 --rounds=3"), "--seconds=7 --rounds=3");
    }

    #[test]
    fn values_are_those_behind_an_option_or_in_it() {
        let told = ["--systems", "a,b", "--systems=c", "--systems-not=d", "--system", "e", "--systems"];
        assert_eq!(values(&told.map(str::to_owned), "--systems"), ["a", "b", "c"]);
    }
}
