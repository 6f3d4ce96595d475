// SPDX-License-Identifier: MIT OR Apache-2.0
//! The options of a gateway.

use crate::config::{MAX_MESSAGE_BYTES, Network};
use crate::graph::GraphLimits;
use crate::rules::Rule;
use tautline_relay::{Budget, Filter};
use tautline_rt::{CoreSet, Realtime};

/// Options of a gateway. Every field has a default that works on one host.
#[derive(Clone, Debug)]
pub struct Options {
    /// The domain on this host.
    pub domain: u32,
    /// The domain on the network, if different.
    pub network_domain: Option<u32>,
    /// Network options.
    pub network: Network,
    /// Topics to mirror: all by default.
    pub filter: Filter,
    /// Priorities on a busy link; without a rule, the size of a topic's samples decides.
    pub rules: Vec<Rule>,
    /// Whether endpoints that bridges announce in the domain are announced too.
    pub transit: bool,
    /// `SCHED_FIFO` priority of the network's threads: below the sampler's (90), above the callbacks'.
    pub priority: u8,
    /// Whether real-time priorities are required.
    pub realtime: Realtime,
    /// Cores of the network's threads.
    pub cores: Option<CoreSet>,
    /// Processor budget at that priority; `None`: no limit.
    pub budget: Option<Budget>,
    /// Longest body accepted from the network.
    pub max_message_bytes: usize,
    /// Limits of what is stored about other hosts.
    pub limits: GraphLimits,
}

impl Options {
    /// Default of [`Options::priority`].
    pub const PRIORITY: u8 = 80;

    pub(crate) fn domain_there(&self) -> u32 {
        self.network_domain.unwrap_or(self.domain)
    }
}

impl Default for Options {
    fn default() -> Self {
        Options {
            domain: 0,
            network_domain: None,
            network: Network::default(),
            filter: Filter::default(),
            rules: Vec::new(),
            transit: true,
            priority: Self::PRIORITY,
            realtime: Realtime::Required,
            cores: None,
            budget: Some(Budget::default()),
            max_message_bytes: MAX_MESSAGE_BYTES,
            limits: GraphLimits::default(),
        }
    }
}
