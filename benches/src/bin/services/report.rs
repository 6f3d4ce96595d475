// SPDX-License-Identifier: MIT OR Apache-2.0
//! What is said of the rows.

use serde::Serialize;
use tautline_benches::claims::{Bench, Verdict, verdicts};
use tautline_benches::rows::Row;
use tautline_benches::{machine, table};

use crate::Result;

/// What is done.
pub const EXPERIMENT: &str = "request";

/// The result of a run.
#[derive(Serialize)]
pub struct Report {
    machine: String,
    versions: String,
    rows: Vec<Row>,
    verdicts: Vec<Verdict>,
}

/// Judges and prints.
pub fn print(rows: Vec<Row>, disturbance: &str, versions: String) -> Result<Report> {
    let machine = machine();
    println!("Round trips between two processes, both blocking, in µs. {machine}; {disturbance}.");
    println!("{versions}\n{}\n", table::of_rows(&rows));
    let verdicts = verdicts(Bench::Services, &[EXPERIMENT.to_owned()].into(), &rows)?;
    verdicts.iter().for_each(|verdict| println!("{verdict}"));
    Ok(Report { machine, versions, rows, verdicts })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_claim_is_about_an_experiment_that_there_is() {
        let verdicts = print(Vec::new(), "", String::new()).map(|report| report.verdicts).unwrap();
        assert_eq!(verdicts.len(), 2);
        assert!(verdicts.iter().all(|verdict| verdict.found == "not measured"));
    }
}
