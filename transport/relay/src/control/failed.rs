// SPDX-License-Identifier: MIT OR Apache-2.0
//! Failed actions, with their reasons, which are retried.

use crate::mirror::{Action, InKey, Inward};

#[derive(Default)]
pub(super) struct Failed(Vec<(Action, String)>);

impl Failed {
    /// Stores a failed action, and logs the reason if it differs from the reason `before`.
    pub(super) fn note(&mut self, action: Action, reason: String, before: Option<&str>) {
        if before != Some(&reason) {
            tracing::warn!("topic '{}' is not mirrored: {reason}", action.topic().topic);
        }
        self.0.push((action, reason));
    }

    /// Drops failed actions whose retry would undo `by`.
    pub(super) fn forget_replaced(&mut self, by: &Action) {
        self.0.retain(|(failed, _)| !by.replaces(failed));
    }

    /// If a start of the class has failed, sets `inward` for its retry. Returns whether a start has failed.
    pub(super) fn change_start(&mut self, key: &InKey, inward: &Inward) -> bool {
        for (failed, _) in &mut self.0 {
            if let Action::StartIn(other, wanted) | Action::AskAgain(other, wanted) = failed
                && other == key
            {
                *wanted = inward.clone();
                return true;
            }
        }
        false
    }

    pub(super) fn take(&mut self) -> Vec<(Action, String)> {
        std::mem::take(&mut self.0)
    }

    pub(super) fn reasons(&self) -> impl Iterator<Item = (String, String)> {
        self.0.iter().map(|(action, reason)| (action.topic().topic.clone(), reason.clone()))
    }
}
