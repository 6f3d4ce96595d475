// SPDX-License-Identifier: MIT OR Apache-2.0
//! The callbacks of a node, for code that must end them.

use crate::error::Result;
use std::sync::{Arc, Mutex, PoisonError};
use tautline_executor::CallbackHandle;

/// The callbacks that were, or are later, spawned through a node. A clone belongs to the same node.
#[derive(Clone, Debug, Default)]
pub struct NodeCallbacks {
    list: Arc<Mutex<Vec<CallbackHandle>>>,
}

impl NodeCallbacks {
    pub(crate) fn keep(&self, callback: &CallbackHandle) {
        let mut list = self.list.lock().unwrap_or_else(PoisonError::into_inner);
        // Callbacks that panicked stay, so that `end` reports them.
        list.retain(|callback| !(callback.is_finished() && callback.clone().join().is_ok()));
        list.push(callback.clone());
    }

    /// The callbacks that have not ended, or that have panicked, as far as known.
    pub fn handles(&self) -> Vec<CallbackHandle> {
        self.list.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Requests all of them to end, and waits until they have ended. A callback that computes without ever waiting blocks
    /// this function.
    ///
    /// # Errors
    /// [`Error::Executor`](crate::Error::Executor): a callback had panicked; if several had, the last one is named. All
    /// callbacks have ended.
    pub fn end(&self) -> Result<()> {
        let mut ended = Ok(());
        // Repeated until the list is empty: a callback may spawn others.
        loop {
            let list = std::mem::take(&mut *self.list.lock().unwrap_or_else(PoisonError::into_inner));
            if list.is_empty() {
                return ended;
            }
            list.iter().for_each(CallbackHandle::stop);
            for callback in list {
                if let Err(error) = callback.join() {
                    ended = Err(error.into());
                }
            }
        }
    }
}
