// SPDX-License-Identifier: MIT OR Apache-2.0
//! By how much execution times and overheads may grow until a deadline is missed.
use std::io::{self, Write};

use serde::Serialize;
use tautline_analysis::file::SystemFile;
use tautline_analysis::sensitivity;

/// Factors without a missed deadline; below 1 if a deadline is missed already, `None` if there is nothing to scale.
#[derive(Serialize)]
pub struct Growth {
    /// The factor of all execution times together.
    load: f64,
    load_without_overheads: f64,
    /// The factor of all overheads together.
    overhead: Option<f64>,
    /// The factor of each callback's execution time, with the others unchanged; none if a deadline is missed already.
    callbacks: Vec<CallbackGrowth>,
}

#[derive(Serialize)]
struct CallbackGrowth {
    name: String,
    wcet: f64,
    /// An execution time with which all deadlines are still met.
    wcet_ms: f64,
}

impl Growth {
    /// Searches the limits: those of all together with a dozen analyses each, and those of all callbacks with about as many.
    pub fn of(file: &SystemFile) -> Self {
        let system = file.system();
        let factor = |thousandths: u64| thousandths as f64 / 1e3;
        let tasks: Vec<_> = file.callbacks().iter().map(|callback| callback.tasks.clone()).collect();
        let each = sensitivity::wcet_of_each(system, &tasks).unwrap_or_default();
        let callbacks = file.callbacks().iter().zip(each).map(|(callback, thousandths)| {
            let now_ns = u128::from(system.callbacks[callback.tasks.start].task.wcet_ns);
            let wcet_ms = (now_ns * u128::from(thousandths) / 1_000) as f64 / 1e6;
            CallbackGrowth { name: callback.name.clone(), wcet: factor(thousandths), wcet_ms }
        });
        // The search ends at this factor: nothing limits the overheads.
        let overhead = Some(sensitivity::overhead(system)).filter(|factor| *factor < 1_000_000).map(factor);
        Self {
            load: factor(sensitivity::load(system)),
            load_without_overheads: factor(sensitivity::load(&file.system_without_overheads())),
            overhead,
            callbacks: callbacks.collect(),
        }
    }
}

/// Writes the limits for people.
pub fn write(growth: &Growth, out: &mut impl Write) -> io::Result<()> {
    writeln!(out, "\nUntil the first deadline is missed,")?;
    let Growth { load, load_without_overheads, .. } = growth;
    writeln!(
        out,
        "  all execution times together may be multiplied by {load:.3} \
         ({load_without_overheads:.3} on a machine that costs nothing)"
    )?;
    if let Some(overhead) = growth.overhead {
        writeln!(out, "  all overheads together by {overhead:.3}")?;
    }
    if growth.callbacks.is_empty() {
        writeln!(out, "  no callback alone: a deadline is missed already")?;
    }
    let width = growth.callbacks.iter().map(|callback| callback.name.chars().count()).max().unwrap_or(0);
    for callback in &growth.callbacks {
        let CallbackGrowth { name, wcet, wcet_ms } = callback;
        writeln!(out, "  wcet of {name:width$} alone by {wcet:>8.3} at least, to {wcet_ms:.3} ms")?;
    }
    Ok(())
}
