// SPDX-License-Identifier: MIT OR Apache-2.0
//! One run: a subscriber and a publisher process, and what they say.

use std::path::Path;
use std::process::Command;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use serde::{Deserialize, Serialize};
use tautline_harness::Process;
use tautline_paper::{Job, Line, Measured, Published, Role};
use tautline_rt::host::steal_ticks;

use crate::Result;
use crate::plan::{Cell, Plan, R2R};

/// How long a process may take to set itself up.
const PATIENCE: Duration = Duration::from_secs(60);

#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Run {
    pub published: Published,
    pub measured: Measured,
    /// Ticks of 10 ms that the hypervisor took from the core during the run.
    pub steal_ticks: u64,
    pub repetition: bool,
}

impl Run {
    /// Whether the core was taken away: by the hypervisor, or, as only the publisher at the highest priority could tell, by
    /// something else.
    pub fn is_disturbed(&self) -> bool {
        self.steal_ticks > 0 || self.published.missed > 0
    }
}

/// What r2r's program says that it is made of.
pub fn version(program: &Path) -> Result<String> {
    let output = Command::new(program).arg("--version").output()?;
    Ok(String::from_utf8_lossy(&output.stdout).trim().to_owned())
}

pub fn run(plan: &Plan, cell: Cell, namespace: String, interrupted: &AtomicBool) -> Result<Run> {
    let job = plan.job(cell, namespace);
    let program = if cell.system == R2R { plan.r2r.clone()? } else { std::env::current_exe()? };
    let mut subscriber = start(&program, &Job { role: Role::Subscriber, ..job.clone() }, interrupted)?;
    subscriber.expect(PATIENCE, |line| matches!(line, Line::Ready).then_some(()))?;
    let steal_before = steal_ticks(Some(plan.core));
    let mut publisher = start(&program, &Job { role: Role::Publisher, ..job.clone() }, interrupted)?;
    let published = publisher.expect(PATIENCE + Duration::from_secs_f64(job.seconds), |line| match line {
        Line::Published(published) => Some(published),
        _ => None,
    })?;
    subscriber.tell(&serde_json::to_string(&published.messages)?)?;
    let measured = subscriber.expect(PATIENCE, |line| match line {
        Line::Measured(measured) => Some(measured),
        _ => None,
    })?;
    let steal_ticks = steal_ticks(Some(plan.core)).saturating_sub(steal_before);
    // The subscriber first: a publisher that is gone is noticed by those who listen.
    subscriber.finish()?;
    publisher.finish()?;
    Ok(Run { published, measured, steal_ticks, repetition: false })
}

fn start<'a>(program: &Path, job: &Job, interrupted: &'a AtomicBool) -> Result<Process<'a, Line>> {
    let mut command = Command::new(program);
    // Nothing of this leaves the machine.
    command.arg("--child").arg(serde_json::to_string(job)?).env("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST");
    Process::start(&mut command, format!("{:?}", job.role), interrupted)
}
