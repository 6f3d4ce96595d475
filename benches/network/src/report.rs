// SPDX-License-Identifier: MIT OR Apache-2.0
//! What is said of the rows.

use clap::ValueEnum;
use tautline_benches::claims::{Bench, Verdict, verdicts};
use tautline_benches::rows::Row;
use tautline_benches::{machine, table, version_of};
use tautline_exchange::{APPLICATION_PRIORITY, NETWORK_PRIORITY};

use crate::Result;
use crate::plan::{Experiment, Plan};

/// What was sent beside the callbacks, and what of it arrived.
pub struct Flood {
    pub offered_mb_per_s: f64,
    pub arrived_mb_per_s: f64,
    /// How often the gateway used up its budget, in the round where it was most.
    pub throttled: u64,
}

/// The result of a run.
pub struct Report {
    pub rows: Vec<Row>,
    pub flood: Option<Flood>,
    pub disturbance: String,
}

impl Report {
    /// Prints the machine, a table per experiment and what must hold.
    pub fn print(&self, plan: &Plan) -> Result<()> {
        println!("{}", machine());
        println!("{}; {}", versions(), self.disturbance);
        println!("{}", conditions(plan));
        if let Err(reason) = &plan.hiroz {
            println!("without hiroz: {reason}");
        }
        if !plan.realtime {
            println!("\n*** measured without real-time priorities: these are not the numbers to compare ***");
        }
        for &experiment in &plan.experiments {
            let is_of = |row: &&Row| experiment.names().contains(&row.experiment.as_str());
            println!("\n{}\n{}", title(experiment), table::of_rows(self.rows.iter().filter(is_of)));
        }
        if let Some(flood) = &self.flood {
            println!(
                "flood: {:.0} MB/s sent, {:.0} MB/s arrived (median round); the gateway's budget was used up at most {} times a round",
                flood.offered_mb_per_s, flood.arrived_mb_per_s, flood.throttled
            );
        }
        println!();
        judge(&self.rows)?.iter().for_each(|verdict| println!("{verdict}"));
        Ok(())
    }
}

fn judge(rows: &[Row]) -> Result<Vec<Verdict>> {
    let names = Experiment::value_variants().iter().flat_map(|experiment| experiment.names());
    Ok(verdicts(Bench::Network, &names.map(|&name| name.to_owned()).collect(), rows)?)
}

fn conditions(plan: &Plan) -> String {
    let priorities = if plan.realtime {
        format!("FIFO {NETWORK_PRIORITY} for the network, FIFO {APPLICATION_PRIORITY} for the application")
    } else {
        "NO REAL-TIME PRIORITY".to_owned()
    };
    let cores = match plan.cores {
        [Some(near), Some(far)] => format!("each with its gateway on a core, {near} and {far}"),
        _ => "on any core".to_owned(),
    };
    format!("two processes, {cores}; {priorities}; TCP over loopback; {} rounds", plan.rounds)
}

fn title(experiment: Experiment) -> &'static str {
    match experiment {
        Experiment::RoundTrip => "Half round trips in µs:",
        Experiment::Stream => "Streams: times between arrivals in µs, and what arrived in a second:",
        Experiment::Callbacks => {
            "Response times of local callbacks that load a core to 90 %, in µs, medians of the rounds:"
        }
    }
}

fn versions() -> String {
    let version = |package| version_of(package).unwrap_or("?");
    let hiroz = include_str!("../../network-hiroz/Cargo.toml");
    let hiroz = hiroz.split_once("hiroz = \"=").and_then(|(_, rest)| rest.split('"').next()).unwrap_or("?");
    format!("tautline {}, zenoh {}, hiroz {hiroz}", version("tautline"), version("zenoh"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_claim_is_about_an_experiment_that_there_is() {
        let verdicts = judge(&[]).unwrap();
        assert_eq!(verdicts.len(), 17);
        assert!(verdicts.iter().all(|verdict| verdict.found == "not measured"));
    }
}
