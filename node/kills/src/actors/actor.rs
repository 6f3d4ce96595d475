// SPDX-License-Identifier: MIT OR Apache-2.0
//! What all actors have: a context, and what they leave to chance.

use crate::{Result, survivors};
use rand::RngExt;
use rand::rngs::SmallRng;
use rand::seq::IndexedRandom;
use std::thread;
use std::time::Duration;
use tautline::{Context, Node};

pub(super) struct Actor {
    pub(super) context: Context,
    pub(super) random: SmallRng,
}

impl Actor {
    pub(super) fn node(&mut self, name: &str) -> Result<Node> {
        Ok(Node::create(self.context.clone(), name, "/actors")?)
    }

    pub(super) fn spin(&self) -> survivors::Spinning {
        survivors::spin(&self.context)
    }

    pub(super) fn chance(&mut self, of: f64) -> bool {
        self.random.random_bool(of)
    }

    pub(super) fn up_to(&mut self, most: usize) -> usize {
        self.random.random_range(0..=most)
    }

    pub(super) fn one_of<T: Copy>(&mut self, all: &[T]) -> T {
        *all.choose(&mut self.random).expect("one at least")
    }

    /// Leaves the core to others for a moment, or not.
    pub(super) fn rest(&mut self) {
        if self.chance(0.7) {
            thread::sleep(Duration::from_micros(self.random.random_range(0..2000)));
        }
    }

    pub(super) fn forget_one<T>(&mut self, things: &mut Vec<T>) {
        if !things.is_empty() {
            let which = self.up_to(things.len() - 1);
            drop(things.swap_remove(which));
        }
    }
}
