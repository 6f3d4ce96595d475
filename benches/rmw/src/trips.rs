// SPDX-License-Identifier: MIT OR Apache-2.0
//! Half round trips between two processes, a core each.

use crate::system::{Message, PATIENCE, Starter, System, measured, ready};
use std::time::Duration;
use tautline_exchange::{Exchange, Job, Line, Measured, Result, Role};
use tautline_harness::rows::Tally;
use tautline_harness::{Distribution, Process};

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

impl Trip {
    /// What it is called among the rows.
    pub fn experiment(self, held: bool) -> String {
        format!("{}/{}", self.client.name(), if held { "held-off" } else { "as-shipped" })
    }

    /// Another round of this length, with processes of its own.
    pub fn measure(
        self,
        starter: &Starter<'_>,
        system: &System,
        length: Duration,
        round: u32,
        tally: &mut Tally,
    ) -> Result<()> {
        let start = |role| {
            let job = starter.job(system, role, Exchange::RoundTrips, length);
            self.start(starter, system, &Job { payload_bytes: self.bytes, ..job })
        };
        let mut far = start(Role::Far)?;
        ready(&mut far, PATIENCE)?;
        let mut near = start(Role::Near)?;
        let Measured { times_ns, lost, .. } = measured(&mut near, PATIENCE)?;
        near.finish()?;
        far.finish()?;
        let mut times = Distribution::new();
        times_ns.into_iter().for_each(|time_ns| times.record(time_ns));
        tally.add(round, &times);
        tally.lost += lost;
        Ok(())
    }

    fn start(self, starter: &Starter<'_>, system: &System, job: &Job) -> Result<Process<'static, Line>> {
        match self.client {
            Client::C => starter.start(system, job, self.message.into()),
            client => starter.start_client(client, system, job),
        }
    }
}
