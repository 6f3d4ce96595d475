// SPDX-License-Identifier: MIT OR Apache-2.0
//! Callbacks that wait for several streams: joins.
//!
//! | a callback wants | use |
//! |---|---|
//! | messages with the same stamp | [`Synchronizer`] with [`ExactTime`] |
//! | messages whose stamps are close: of all possible sets the closest | [`Synchronizer`] with [`ApproximateTime`] |
//! | messages whose stamps are close: the first such set | [`Synchronizer`] with [`ApproximateEpsilonTime`] |
//! | a new message of every input, the newest of each | [`all_of`] |
//! | each message of one input, with the newest of the others | [`latest`] |
//! | each message of the fastest input, whichever that is, with the newest of the others | [`RateSynchronizer`] with [`LatestTime`] |
//!
//! All are streams whose items stay in place: samples in shared memory are neither copied nor reference-counted. All memory is
//! allocated when they are created, and each documents its work for one arrival. Messages that are not delivered are counted
//! ([`JoinCounters`]): for each input, received = matched + dropped + refused + waiting.
//!
//! This crate knows streams and stamps, but no topics. Every input of a join is a [`Source`]; [`stamped`] creates one from any
//! stream:
//!
//! ```
//! use futures::{StreamExt, executor::block_on_stream, stream};
//! use tautline_join::{ApproximateTime, Synchronizer, stamped};
//! use std::time::Duration;
//!
//! let images = stamped(stream::iter([0, 100, 200, 300]), |ms| ms * 1_000_000);
//! let clouds = stamped(stream::iter([3, 104, 205, 306]), |ms| ms * 1_000_000);
//! let policy = ApproximateTime::new(10).max_interval(Duration::from_millis(20));
//! let pairs = Synchronizer::new(policy, (images, clouds))?;
//! assert_eq!(block_on_stream(pairs).collect::<Vec<_>>(), [(0, 3), (100, 104), (200, 205)]);
//! # Ok::<(), tautline_join::JoinError>(())
//! ```
//! The last pair is missing: only the next message can show whether (300, 306) is the best one.
#![forbid(unsafe_code)]

mod all_of;
mod approximate;
mod counters;
mod epsilon;
mod exact;
mod latest;
mod latest_time;
mod policy;
mod rate;
mod source;
mod synchronizer;

pub use all_of::{AllOf, AllOfInputs, all_of};
pub use approximate::ApproximateTime;
pub use counters::{InputCounters, JoinCounters};
pub use epsilon::ApproximateEpsilonTime;
pub use exact::ExactTime;
pub use latest::{Kept, Latest, LatestInputs, latest};
pub use latest_time::{LatestTime, RateConfig};
pub use policy::{Arrival, Policy};
pub use rate::RateSynchronizer;
pub use source::{Plain, Room, Source, Stamped, StampedStream, stamped};
pub use synchronizer::{Synchronizer, SynchronizerInputs};

/// Maximum number of inputs of a join, as in message_filters.
pub const MAX_INPUTS: usize = 9;

/// Why a join cannot be created.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum JoinError {
    /// A queue without room.
    #[error(
        "a synchronizer's queue size is 0: it must keep a message until the others arrive; set it to at least 1"
    )]
    NoQueue,
    /// An input may not hold as many items as the join keeps.
    #[error(
        "`{input}` may hold {room} samples at once, but the join needs {needed} (what waits, one that arrives, one in \
         the callback's hands): raise `Limits::held` to {needed} before it is made (`Node::set_topic_limits`), or lower \
         the queue size, if it has one"
    )]
    Room {
        /// Its name.
        input: String,
        /// How many items it may hold.
        room: usize,
        /// How many items it must hold.
        needed: usize,
    },
}

/// Checks that each input can hold the messages that a join keeps, one that arrives, and one that the callback works on.
fn check_room(inputs: impl Iterator<Item = (String, usize)>, kept: usize) -> Result<(), JoinError> {
    let needed = kept.saturating_add(2);
    for (input, room) in inputs {
        if room < needed {
            return Err(JoinError::Room { input, room, needed });
        }
    }
    Ok(())
}

/// Calls a macro with the type parameters of each tuple of inputs.
macro_rules! for_each_tuple {
    ($each:ident) => {
        $each!(A 0, B 1);
        $each!(A 0, B 1, C 2);
        $each!(A 0, B 1, C 2, D 3);
        $each!(A 0, B 1, C 2, D 3, E 4);
        $each!(A 0, B 1, C 2, D 3, E 4, F 5);
        $each!(A 0, B 1, C 2, D 3, E 4, F 5, G 6);
        $each!(A 0, B 1, C 2, D 3, E 4, F 5, G 6, H 7);
        $each!(A 0, B 1, C 2, D 3, E 4, F 5, G 6, H 7, I 8);
    };
}
use for_each_tuple;
