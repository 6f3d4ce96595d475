// SPDX-License-Identifier: MIT OR Apache-2.0
//! What is said of the rows.

use tautline_benches::claims::{Bench, verdicts};
use tautline_benches::rows::Row;
use tautline_benches::{machine, table, version_of};

use crate::Result;
use crate::plan::{Idle, PRIORITY, Plan};

/// The result of a run.
pub struct Rows {
    pub rows: Vec<Row>,
    pub disturbance: String,
    /// Why idle states could not be held off.
    pub idle_refused: Option<String>,
}

/// Prints the machine, a table per idle state and what must hold.
pub fn print(plan: &Plan, result: &Rows) -> Result<()> {
    println!("{}", machine());
    println!("{}; {}", versions(), result.disturbance);
    let [sender, receiver] = plan.cores;
    let priority =
        if plan.realtime { format!("FIFO {PRIORITY}") } else { "NO REAL-TIME PRIORITY".to_owned() };
    println!("two processes, {priority}, cores {sender} and {receiver}; half round trips in µs");
    if !plan.realtime {
        println!("\n*** measured without real-time priorities: these are not the numbers to compare ***");
    }
    for idle in Idle::ALL {
        let names = [false, true].map(|touched| idle.experiment(touched));
        let rows: Vec<_> = result.rows.iter().filter(|row| names.contains(&row.experiment)).collect();
        match idle {
            Idle::Default => println!("\nIdle states as shipped:"),
            Idle::Poll => println!("\nIdle states held off (/dev/cpu_dma_latency at 0):"),
        }
        match &result.idle_refused {
            Some(reason) if rows.is_empty() => println!("not measured: {reason}"),
            _ => println!("{}", table::of_rows(rows)),
        }
    }
    println!();
    for verdict in verdicts(Bench::Wake, &Idle::experiments(), &result.rows)? {
        println!("{verdict}");
    }
    Ok(())
}

fn versions() -> String {
    let version = |package| version_of(package).unwrap_or("?");
    format!("tautline {}, iceoryx2 {}", version("tautline"), version("iceoryx2"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_claim_is_about_an_experiment_that_there_is() {
        let verdicts = verdicts(Bench::Wake, &Idle::experiments(), &[]).unwrap();
        assert_eq!(verdicts.len(), 7);
        assert!(verdicts.iter().all(|verdict| verdict.found == "not measured"));
    }
}
