// SPDX-License-Identifier: MIT OR Apache-2.0
//! Which domain a verb looks at: one argument of all verbs, in any place behind the first word.

use clap::Args;
use tautline::Context;

#[derive(Args, Clone, Debug)]
pub struct DomainArgs {
    /// The domain [default: TAUT_DOMAIN, else ROS_DOMAIN_ID, else 0]
    #[arg(long, global = true, value_name = "N", value_parser = clap::value_parser!(u32).range(0..=232))]
    domain: Option<u32>,
}

impl DomainArgs {
    /// Its number.
    pub fn number(&self) -> Result<u32, tautline::Error> {
        self.domain.map_or_else(Context::domain_of_environment, Ok)
    }

    /// Whether it was named.
    pub fn is_named(&self) -> bool {
        self.domain.is_some()
    }
}
