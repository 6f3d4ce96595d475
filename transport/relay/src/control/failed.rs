// SPDX-License-Identifier: MIT OR Apache-2.0
//! What could not be done, and why: it is tried again.

use crate::mirror::{Action, InKey, Inward};

#[derive(Default)]
pub(super) struct Failed(Vec<(Action, String)>);

impl Failed {
    /// It failed, again if there was a reason `before`: what is new about it is said.
    pub(super) fn note(&mut self, action: Action, reason: String, before: Option<&str>) {
        if before != Some(&reason) {
            tracing::warn!("topic '{}' is not mirrored: {reason}", action.topic().topic);
        }
        self.0.push((action, reason));
    }

    /// What is not wanted any more is not tried again.
    pub(super) fn forget_replaced(&mut self, by: &Action) {
        self.0.retain(|(failed, _)| !by.replaces(failed));
    }

    /// If the class could not be started, it is started as `inward` says the next time. Returns whether that is so.
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

    /// All of it, to be tried again.
    pub(super) fn take(&mut self) -> Vec<(Action, String)> {
        std::mem::take(&mut self.0)
    }

    /// By topic.
    pub(super) fn reasons(&self) -> impl Iterator<Item = (String, String)> {
        self.0.iter().map(|(action, reason)| (action.topic().topic.clone(), reason.clone()))
    }
}
