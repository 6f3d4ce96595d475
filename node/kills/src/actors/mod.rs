// SPDX-License-Identifier: MIT OR Apache-2.0
//! The processes that are killed: each creates, uses and removes the same few topics, services and actions as others, repeatedly.
//! A peer that has ended is an expected error; an object that cannot be created is a defect.

mod actor;
mod calls;
mod components;
mod topics;

pub use components::check;

use crate::Result;
use actor::Actor;
use clap::ValueEnum;
use rand::SeedableRng;
use rand::rngs::SmallRng;
use tautline::{Context, Realtime};

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Role {
    Topics,
    Services,
    Actions,
    Parameters,
    Lifecycle,
    /// `taut-container` with two components.
    Container,
    Loader,
}

impl Role {
    pub fn part(self) -> String {
        format!("actor-{}", format!("{self:?}").to_lowercase())
    }
}

pub fn play(name: &str, seed: u64) -> Result<()> {
    let role = Role::from_str(name, false)?;
    if role == Role::Container {
        return components::contain();
    }
    let context = Context::builder().realtime(Realtime::Off).build()?;
    let mut actor = Actor { context, random: SmallRng::seed_from_u64(seed) };
    match role {
        Role::Topics => topics::play(&mut actor),
        Role::Services => calls::serve_and_ask(&mut actor),
        Role::Actions => calls::pursue(&mut actor),
        Role::Parameters => calls::set_parameters(&mut actor),
        Role::Lifecycle => topics::live(&mut actor),
        Role::Container => Ok(()),
        Role::Loader => components::load(&mut actor),
    }
}
