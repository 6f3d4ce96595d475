// SPDX-License-Identifier: MIT OR Apache-2.0
//! What is measured.

use std::fmt;
use std::path::PathBuf;

use tautline_paper::{Job, Role, Variant};

use crate::application::{Application, Capacity};
use crate::{Options, Result, application};

/// The systems, as in the JSON.
pub const TAUTLINE: &str = "tautline";
pub const R2R: &str = "r2r";

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Experiment {
    /// The paper's five topics in one of its variants.
    Paper(Variant),
    /// The deep queue with this many places, in the variant futures-rt.
    Capacity(usize),
}

impl fmt::Display for Experiment {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Experiment::Paper(variant) => variant.fmt(f),
            Experiment::Capacity(depth) => write!(f, "capacity-{depth}"),
        }
    }
}

/// Something that is run several times.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Cell {
    pub system: &'static str,
    pub experiment: Experiment,
}

impl fmt::Display for Cell {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {}", self.system, self.experiment)
    }
}

pub struct Plan {
    pub runs: u32,
    pub seconds: f64,
    /// How often a cell may be run once more because the hypervisor took the core away.
    pub repeats: u32,
    pub core: usize,
    pub realtime: bool,
    /// r2r's program, or why it is left out.
    pub r2r: std::result::Result<PathBuf, String>,
    pub paper: Application,
    pub capacity: Capacity,
    pub cells: Vec<Cell>,
}

/// The capacity experiment shows in one second what it has to show; more makes it no clearer.
const CAPACITY_SECONDS: f64 = 5.0;

impl Plan {
    pub fn new(options: &Options, core: usize) -> Result<Self> {
        let (runs, seconds) =
            if options.documented.run.quick { (2, 3.0) } else { (options.runs, options.seconds) };
        let variants = options.variants.clone().unwrap_or_else(Variant::all);
        let r2r = options.r2r.clone().ok_or_else(|| options.without_r2r.clone());
        let capacity = application::capacity()?;
        let cells = cells(&variants, r2r.is_ok(), capacity.computed());
        let (repeats, realtime) = (options.repeats.unwrap_or(runs.div_ceil(2).max(2)), !options.no_rt);
        Ok(Plan {
            runs,
            seconds,
            repeats,
            core,
            realtime,
            r2r,
            paper: application::paper()?,
            capacity,
            cells,
        })
    }

    /// The topics of a cell, and how long its runs last.
    pub fn job(&self, cell: Cell, namespace: String) -> Job {
        let (topics, variant, seconds) = match cell.experiment {
            Experiment::Paper(variant) => (self.paper.topics.clone(), variant, self.seconds),
            Experiment::Capacity(depth) => {
                (self.capacity.topics(depth), Variant::FUTURES_RT, self.seconds.min(CAPACITY_SECONDS))
            }
        };
        let (role, core, realtime) = (Role::Subscriber, self.core, self.realtime);
        Job { role, variant, topics, core, seconds, namespace, realtime }
    }

    pub fn rta_ns(&self, cell: Cell) -> &[Option<u64>] {
        match cell.experiment {
            Experiment::Paper(_) => &self.paper.rta_ns,
            Experiment::Capacity(_) => &self.capacity.application.rta_ns,
        }
    }

    /// How long the runs take, repetitions aside, in seconds.
    pub fn expected_seconds(&self) -> f64 {
        /// Starting two processes, the first release, the last callback.
        const AROUND: f64 = 1.5;
        let each = |cell: &Cell| self.job(*cell, String::new()).seconds + AROUND;
        self.cells.iter().map(each).sum::<f64>() * f64::from(self.runs)
    }
}

fn cells(variants: &[Variant], with_r2r: bool, computed: usize) -> Vec<Cell> {
    let systems = if with_r2r { &[TAUTLINE, R2R][..] } else { &[TAUTLINE][..] };
    let paper = variants.iter().map(|variant| Experiment::Paper(*variant));
    let mut cells: Vec<_> =
        paper.flat_map(|experiment| systems.iter().map(move |&system| Cell { system, experiment })).collect();
    let capacity = |system, depth| Cell { system, experiment: Experiment::Capacity(depth) };
    cells.push(capacity(TAUTLINE, computed));
    cells.push(capacity(TAUTLINE, computed - 1));
    if with_r2r {
        cells.push(capacity(R2R, computed));
    }
    cells
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    #[test]
    fn every_variant_is_measured_on_both_systems_and_the_deep_queue_three_times() {
        let variants = Variant::all();
        let both = cells(&variants, true, 16);
        let distinct: BTreeSet<_> = both.iter().map(Cell::to_string).collect();
        let is_on = |system: &str, variant: &Variant| distinct.contains(&format!("{system} {variant}"));
        assert!(variants.iter().all(|variant| is_on("tautline", variant) && is_on("r2r", variant)));
        assert_eq!((both.len(), distinct.len()), (2 * variants.len() + 3, both.len()));
        let names: Vec<_> = both[both.len() - 3..].iter().map(Cell::to_string).collect();
        assert_eq!(names, ["tautline capacity-16", "tautline capacity-15", "r2r capacity-16"]);
        assert_eq!(cells(&variants, false, 16).len(), variants.len() + 2);
    }
}
