// SPDX-License-Identifier: MIT OR Apache-2.0
//! Claims a publisher's memory, in the publishing thread or in another one.

use crate::error::LoanError;
use crate::topic::participant::ParticipantState;
use crate::topic::publisher::counters::PublisherCounters;
use crate::topic::writer::core::PublisherCore;
use std::io;
use std::sync::Arc;
use std::sync::atomic::Ordering;

/// Claims memory of a publisher instead of a thread that must not, such as one that receives for many topics.
#[derive(Clone)]
pub struct MemoryClaimer {
    pub(super) core: Arc<PublisherCore>,
    pub(super) counters: Arc<PublisherCounters>,
    pub(super) participant: Arc<ParticipantState>,
}

/// As [`MemoryClaimer`], but borrowed from a publisher that outlives it: the publishing thread, if it is that, drops nothing.
pub(super) struct Claiming<'p> {
    pub(super) core: &'p Arc<PublisherCore>,
    pub(super) counters: &'p PublisherCounters,
    pub(super) participant: &'p ParticipantState,
    pub(super) is_publishing: bool,
}

impl MemoryClaimer {
    /// Claims memory for one more sample of `len_bytes`, and for some more of them if they are small.
    ///
    /// # Real-time
    /// Setup only: claims and maps memory, while the publisher may be in use in another thread.
    ///
    /// # Errors
    /// [`LoanError::OutOfMemory`]: there is no shared memory for it, or as many samples are in use as there can be.
    pub fn claim(&self, len_bytes: usize) -> Result<(), LoanError> {
        let MemoryClaimer { core, counters, participant } = self;
        let claiming = Claiming { core, counters, participant, is_publishing: false };
        claiming.lengthen(len_bytes)?;
        claiming.claim_more()
    }
}

impl Claiming<'_> {
    pub(super) fn lengthen(&self, len_bytes: usize) -> Result<usize, LoanError> {
        self.announce(self.core.lengthen(len_bytes, self.is_publishing))
    }

    pub(super) fn claim_more(&self) -> Result<(), LoanError> {
        self.announce(self.core.claim_more())?;
        self.counters.growths.fetch_add(1, Ordering::Relaxed);
        Ok(())
    }

    fn announce<T>(&self, claimed: io::Result<T>) -> Result<T, LoanError> {
        let claimed = claimed.map_err(|_| LoanError::OutOfMemory)?;
        self.participant.matcher.announce_segments(self.core);
        Ok(claimed)
    }
}

tautline_rt::debug_fields!(MemoryClaimer, |this| topic = this.core.topic.name);
