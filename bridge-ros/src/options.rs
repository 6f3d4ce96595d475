// SPDX-License-Identifier: MIT OR Apache-2.0
//! The options of a bridge.

use tautline_relay::{Budget, Rules};
use tautline_rt::Realtime;

/// Options of a bridge. Every field has a default.
#[derive(Clone, Debug)]
pub struct Options {
    /// Tautline's domain.
    pub domain: u32,
    /// ROS's domain; `None`: `ROS_DOMAIN_ID`, else 0.
    pub ros_domain: Option<u32>,
    /// The topics to bridge.
    pub rules: Rules,
    /// The services to bridge.
    pub services: Rules,
    /// Whether endpoints that gateways and other bridges announce in the domain are mirrored into ROS.
    pub transit: bool,
    /// `SCHED_FIFO` priority of the threads that carry messages, at least 3. The RMW's threads run one below, the bridge's
    /// other threads two below. It must be below the sampler's (90) and above the callbacks'.
    pub priority: u8,
    /// Whether real-time priorities are required.
    pub realtime: Realtime,
    /// Processor budget at these priorities; `None`: no limit.
    pub budget: Option<Budget>,
}

impl Options {
    /// Default of [`Options::priority`].
    pub const PRIORITY: u8 = 80;
    /// Default of [`Options::budget`]: half a core.
    pub const BUDGET: Budget = Budget { percent: 50 };
}

impl Default for Options {
    fn default() -> Self {
        let rules = Rules { auto: true, ..Rules::default() };
        Options {
            domain: 0,
            ros_domain: None,
            services: rules.clone(),
            rules,
            transit: true,
            priority: Self::PRIORITY,
            realtime: Realtime::Required,
            budget: Some(Self::BUDGET),
        }
    }
}
