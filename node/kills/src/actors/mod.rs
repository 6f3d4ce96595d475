// SPDX-License-Identifier: MIT OR Apache-2.0
//! The processes that are killed: each creates, uses and removes the same few topics, services and actions as others, repeatedly.
//! A peer that has ended is an expected error; an object that cannot be created is a defect.

mod calls;
mod components;
mod topics;

pub use components::check;

use crate::{Result, survivors};
use clap::ValueEnum;
use rand::rngs::SmallRng;
use rand::seq::IndexedRandom;
use rand::{RngExt, SeedableRng};
use std::thread;
use std::time::Duration;
use tautline::{Context, Node, Realtime};

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

struct Actor {
    context: Context,
    random: SmallRng,
}

impl Actor {
    fn node(&mut self, name: &str) -> Result<Node> {
        Ok(Node::create(self.context.clone(), name, "/actors")?)
    }

    fn spin(&self) -> survivors::Spinning {
        survivors::spin(&self.context)
    }

    fn chance(&mut self, of: f64) -> bool {
        self.random.random_bool(of)
    }

    fn up_to(&mut self, most: usize) -> usize {
        self.random.random_range(0..=most)
    }

    fn one_of<T: Copy>(&mut self, all: &[T]) -> T {
        *all.choose(&mut self.random).expect("one at least")
    }

    /// Leaves the core to others for a moment, or not.
    fn rest(&mut self) {
        if self.chance(0.7) {
            thread::sleep(Duration::from_micros(self.random.random_range(0..2000)));
        }
    }

    fn forget_one<T>(&mut self, things: &mut Vec<T>) {
        if !things.is_empty() {
            let which = self.up_to(things.len() - 1);
            drop(things.swap_remove(which));
        }
    }
}
