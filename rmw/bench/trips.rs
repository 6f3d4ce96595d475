// SPDX-License-Identifier: MIT OR Apache-2.0
//! Half round trips between two processes, a core each.

use crate::process::Process;
use crate::system::{Message, PATIENCE, Starter, System, measured, ready, said};
use serde_json::{Value, json};
use std::fmt;
use std::time::Duration;
use tautline_exchange::{Exchange, Job, Line, Measured, Result, Role};
use tautline_rt::host;

pub const HEAD: &str = "system            client  message        bytes  idle         n  lost      p50      p99    p99.9      max  steal";

/// Who calls the RMW.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Client {
    /// This program: `rmw_wait` and take.
    C,
    /// An executor of rclcpp with one thread.
    Rclcpp,
    /// One of rclpy.
    Rclpy,
}

impl Client {
    pub fn name(self) -> &'static str {
        match self {
            Client::C => "c",
            Client::Rclcpp => "rclcpp",
            Client::Rclpy => "rclpy",
        }
    }
}

/// What is sent, and by whom.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Trip {
    pub client: Client,
    pub message: Message,
    pub bytes: usize,
}

/// What was measured of one system.
pub struct Row {
    pub system: &'static str,
    pub trip: Trip,
    /// Whether idle states were held off.
    pub held: bool,
    /// Half round trips of all rounds, ascending.
    times_ns: Vec<u64>,
    /// Of each round, in µs.
    pub p50s_us: Vec<f64>,
    pub lost: u64,
    steal_ticks: u64,
}

impl Row {
    pub fn new(system: &'static str, trip: Trip, held: bool) -> Self {
        Row { system, trip, held, times_ns: Vec::new(), p50s_us: Vec::new(), lost: 0, steal_ticks: 0 }
    }

    /// Another round of this length, with processes of its own.
    pub fn add(&mut self, starter: &Starter<'_>, system: &System, length: Duration) -> Result<()> {
        let start = |role| {
            let job = starter.job(system, role, Exchange::RoundTrips, length);
            let job = Job { payload_bytes: self.trip.bytes, ..job };
            self.trip.start(starter, system, &job)
        };
        let before = host::steal_ticks(None);
        let mut far = start(Role::Far)?;
        ready(&mut far, PATIENCE)?;
        let mut near = start(Role::Near)?;
        let Measured { mut times_ns, lost, .. } = measured(&mut near, PATIENCE)?;
        said(near.finish())?;
        said(far.finish())?;
        times_ns.sort_unstable();
        self.p50s_us.push(percentile_us(&times_ns, 0.5));
        self.times_ns.extend(times_ns);
        self.times_ns.sort_unstable();
        self.lost += lost;
        self.steal_ticks += host::steal_ticks(None) - before;
        Ok(())
    }

    pub fn to_json(&self) -> Value {
        let percentile = |share| percentile_us(&self.times_ns, share);
        json!({
            "system": self.system, "client": self.trip.client.name(), "message": self.trip.message,
            "bytes": self.trip.bytes, "idle_states_held_off": self.held, "n": self.times_ns.len(), "lost": self.lost,
            "p50_us": percentile(0.5), "p99_us": percentile(0.99), "p999_us": percentile(0.999),
            "max_us": percentile(1.0), "p50_us_of_rounds": self.p50s_us, "steal_ticks": self.steal_ticks,
        })
    }
}

impl Trip {
    fn start(self, starter: &Starter<'_>, system: &System, job: &Job) -> Result<Process<'static, Line>> {
        match self.client {
            Client::C => starter.start(system, job, self.message.into()),
            client => starter.start_client(client, system, job),
        }
    }
}

fn percentile_us(times_ns: &[u64], share: f64) -> f64 {
    let at = ((times_ns.len() as f64 * share) as usize).min(times_ns.len().saturating_sub(1));
    times_ns.get(at).map_or(f64::NAN, |time| *time as f64 / 1e3)
}

impl fmt::Display for Row {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let message = format!("{:?}", self.trip.message).to_lowercase();
        let (client, idle) = (self.trip.client.name(), if self.held { "held" } else { "as is" });
        write!(f, "{:<18}{client:<8}{message:<11}{:>9}  {idle:<6}", self.system, self.trip.bytes)?;
        write!(f, "{:>8}{:>6}", self.times_ns.len(), self.lost)?;
        for share in [0.5, 0.99, 0.999, 1.0] {
            write!(f, "{:>9.1}", percentile_us(&self.times_ns, share))?;
        }
        write!(f, "{:>7}", self.steal_ticks)
    }
}
