// SPDX-License-Identifier: MIT OR Apache-2.0
//! The callbacks of a node, for whoever has to end them.

use crate::error::Result;
use std::sync::{Arc, Mutex, PoisonError};
use tautline_executor::CallbackHandle;

/// The callbacks that were spawned through a node, and are by those that have it, also after this was asked for. A clone is of the
/// same node.
#[derive(Clone, Debug, Default)]
pub struct NodeCallbacks {
    list: Arc<Mutex<Vec<CallbackHandle>>>,
}

impl NodeCallbacks {
    pub(crate) fn keep(&self, callback: &CallbackHandle) {
        let mut list = self.list.lock().unwrap_or_else(PoisonError::into_inner);
        // Those that panicked stay: whoever ends them is told.
        list.retain(|callback| !(callback.is_finished() && callback.clone().join().is_ok()));
        list.push(callback.clone());
    }

    /// Those that have not ended, or have panicked, as far as it is known.
    pub fn handles(&self) -> Vec<CallbackHandle> {
        self.list.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Tells all of them to end, and waits until they have. One that computes without ever waiting keeps this waiting, too.
    ///
    /// # Errors
    /// [`Error::Executor`](crate::Error::Executor): a callback had panicked; of several the last one is named. All have ended.
    pub fn end(&self) -> Result<()> {
        let mut ended = Ok(());
        // Until there is none: a callback may spawn others.
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
