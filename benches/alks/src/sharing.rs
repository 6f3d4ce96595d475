// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the subscribers' thread and the timer's share, in one of three ways.

use std::sync::{Arc, Mutex, PoisonError};

use tautline_rt::{LatestReader, LatestWriter, PiMutex, latest};

use crate::inputs::Inputs;
use crate::job::Shared;

/// The subscribers' side: one thread's.
#[expect(missing_debug_implementations, reason = "its ends have none")]
pub enum Store {
    /// All that is known, and where the timer finds it.
    Latest(Box<Inputs>, LatestWriter<Inputs>),
    Inherit(Arc<PiMutex<Inputs>>),
    Mutex(Arc<Mutex<Inputs>>),
}

/// The timer's side.
#[expect(missing_debug_implementations, reason = "its ends have none")]
pub enum View {
    Latest(LatestReader<Inputs>),
    Inherit(Arc<PiMutex<Inputs>>),
    Mutex(Arc<Mutex<Inputs>>),
}

pub fn share(shared: Shared) -> (Store, View) {
    match shared {
        Shared::Latest => {
            let (writer, reader) = latest(Inputs::default());
            (Store::Latest(Box::default(), writer), View::Latest(reader))
        }
        Shared::Inherit => {
            let inputs = Arc::new(PiMutex::new(Inputs::default()));
            (Store::Inherit(inputs.clone()), View::Inherit(inputs))
        }
        Shared::Mutex => {
            let inputs = Arc::new(Mutex::new(Inputs::default()));
            (Store::Mutex(inputs.clone()), View::Mutex(inputs))
        }
    }
}

impl Store {
    /// Changes what is known, and hands it over. `waited` is called once nobody else holds it.
    ///
    /// # Real-time
    /// [`Store::Latest`]: wait-free, a copy of less than a kilobyte. [`Store::Inherit`]: as long as the timer copies, at the priority of
    /// this thread. [`Store::Mutex`]: as long as the timer copies and whoever preempts it runs.
    pub fn update(&mut self, change: impl FnOnce(&mut Inputs), waited: impl FnOnce()) {
        match self {
            Store::Latest(inputs, writer) => {
                waited();
                change(inputs);
                writer.write(**inputs);
            }
            Store::Inherit(inputs) => {
                let mut inputs = inputs.lock();
                waited();
                change(&mut inputs);
            }
            Store::Mutex(inputs) => {
                let mut inputs = inputs.lock().unwrap_or_else(PoisonError::into_inner);
                waited();
                change(&mut inputs);
            }
        }
    }
}

impl View {
    /// What is known now: a copy, so that whoever computes with it keeps nobody waiting.
    pub fn snapshot(&mut self) -> Inputs {
        match self {
            View::Latest(reader) => *reader.read(),
            View::Inherit(inputs) => *inputs.lock(),
            View::Mutex(inputs) => *inputs.lock().unwrap_or_else(PoisonError::into_inner),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_way_hands_over_all_that_is_known() {
        for shared in Shared::ALL {
            let (mut store, mut view) = share(shared);
            assert_eq!(view.snapshot(), Inputs::default());
            let mut waited = 0;
            store.update(|inputs| inputs.speed_mps = 30.0, || waited += 1);
            store.update(|inputs| inputs.status = 1, || waited += 1);
            let expected = Inputs { speed_mps: 30.0, status: 1, ..Inputs::default() };
            assert_eq!((view.snapshot(), waited), (expected, 2), "{shared:?}");
        }
    }
}
