// SPDX-License-Identifier: MIT OR Apache-2.0
//! Each message of one stream, with the newest messages of other streams.

use crate::counters::JoinCounters;
use crate::source::{Room, Source};
use crate::{JoinError, check_room, for_each_tuple};
use futures::stream::{Fuse, Stream, StreamExt};
use std::ops::Deref;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};

/// Number of messages of an input that are kept: the newest, and those that the callback may still hold.
const KEPT: usize = 2;

/// A stream of each message of a trigger, with the newest message of each of the other inputs, if there has been one. Created by
/// [`latest`].
///
/// The other inputs are read when a trigger message arrives, and wake no task. The stream ends with the
/// trigger.
///
/// # Real-time
/// No allocation. For each trigger message, at most as many messages of each other input are taken as its queue is
/// deep.
#[derive(Debug)]
#[must_use = "nothing is received unless it is polled"]
pub struct Latest<T, S: LatestInputs> {
    trigger: T,
    readers: S::Readers,
    counters: Arc<JoinCounters>,
}

/// Joins each message of `trigger` with the newest of 1 to 9 `others`, given as a tuple.
///
/// ```
/// use futures::{executor::block_on_stream, stream};
/// use tautline_join::{latest, stamped};
/// let input = |items: &'static [i64]| stamped(stream::iter(items.iter().copied()), |item| *item);
/// let mut joined = block_on_stream(latest(input(&[1, 2]), (input(&[10, 20]), input(&[])))?);
/// let (trigger, (tens, nothing)) = joined.next().unwrap();
/// assert_eq!((trigger, tens.as_deref()), (1, Some(&20)));
/// assert!(nothing.is_none());
/// # Ok::<(), tautline_join::JoinError>(())
/// ```
///
/// # Errors
/// [`JoinError::Room`] if one of the others may hold fewer than four items.
pub fn latest<T: Source, S: LatestInputs>(trigger: T, others: S) -> Result<Latest<T, S>, JoinError> {
    let mut readers = others.into_readers();
    check_readers::<S>(&mut readers)?;
    Ok(Latest { trigger, readers, counters: Arc::new(JoinCounters::new(S::COUNT)) })
}

pub(crate) fn check_readers<S: LatestInputs>(readers: &mut S::Readers) -> Result<(), JoinError> {
    let rooms = (0..S::COUNT).map(|i| S::reader(readers, i).room());
    check_room(rooms.map(|(name, room)| (name, room.held)), KEPT)
}

impl<T, S: LatestInputs> Latest<T, S> {
    /// Counters of the other inputs' messages, readable from any thread. Messages that were never delivered count as dropped: there
    /// was a newer one, or the callback held as many as are kept (two).
    pub fn counters(&self) -> Arc<JoinCounters> {
        self.counters.clone()
    }
}

impl<T: Source, S: LatestInputs> Stream for Latest<T, S> {
    type Item = (T::Item, S::Items);

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        let Latest { trigger, readers, counters } = &mut *self;
        trigger.poll_next_unpin(context).map(|item| {
            let item = item?;
            for input in 0..S::COUNT {
                S::reader(readers, input).catch_up(input, counters);
            }
            counters.passed_on();
            Some((item, S::read(readers)))
        })
    }
}

/// A message that several readers may hold. Its memory is released when a newer message needs its place, not
/// when it is dropped.
#[derive(Debug)]
pub struct Kept<T>(Arc<Option<T>>);

impl<T> Clone for Kept<T> {
    fn clone(&self) -> Self {
        Kept(self.0.clone())
    }
}

impl<T> Deref for Kept<T> {
    type Target = T;

    fn deref(&self) -> &T {
        match &*self.0 {
            Some(item) => item,
            // A place is emptied only while nothing else refers to it.
            None => unreachable!("a kept message is there as long as it is held"),
        }
    }
}

/// Tuples of 1 to 9 [`Source`]s.
pub trait LatestInputs: sealed::Tuple {
    /// The newest message of each input, if there is one.
    type Items;
    /// The newest of each.
    type All;
}

pub(crate) mod sealed {
    use super::{LatestInputs, Reader};

    pub trait Tuple {
        type Readers: Unpin;
        const COUNT: usize;
        fn into_readers(self) -> Self::Readers;
        fn reader(readers: &mut Self::Readers, input: usize) -> &mut dyn Reader;
        fn read(readers: &mut Self::Readers) -> Self::Items
        where
            Self: LatestInputs;
        /// The newest of each, if all have one.
        fn read_all(readers: &mut Self::Readers) -> Option<Self::All>
        where
            Self: LatestInputs;
    }
}

/// One of the other inputs, of any type.
pub trait Reader {
    fn catch_up(&mut self, input: usize, counters: &JoinCounters);
    /// Takes one message, as a job, and returns whether there was a place for it.
    fn poll_arrival(
        &mut self,
        context: &mut Context<'_>,
        input: usize,
        counters: &JoinCounters,
    ) -> Poll<Option<bool>>;
    fn finish(&mut self);
    fn is_empty(&self) -> bool;
    fn room(&self) -> (String, Room);
}

#[derive(Debug)]
pub struct Input<S: Source> {
    source: Fuse<S>,
    places: [Arc<Option<S::Item>>; KEPT],
    newest: usize,
    was_given: bool,
}

// Nothing in it is pinned but the source, which may be moved.
impl<S: Source> Unpin for Input<S> {}

impl<S: Source> Input<S> {
    fn new(source: S) -> Self {
        let places = [(); KEPT].map(|()| Arc::new(None));
        Input { source: source.fuse(), places, newest: 0, was_given: true }
    }

    fn read(&mut self) -> Option<Kept<S::Item>> {
        let newest = &self.places[self.newest];
        self.was_given |= newest.is_some();
        newest.is_some().then(|| Kept(newest.clone()))
    }

    /// Keeps a message as the newest; `false`: all places are read, so that it is dropped.
    fn put(&mut self, item: S::Item, input: usize, counters: &JoinCounters) -> bool {
        counters.of(input, |c| &c.received);
        // Uses a place without readers, beginning with that of the newest; messages in other such places are released.
        let mut item = Some(item);
        let (newest, was_given) = (self.newest, std::mem::replace(&mut self.was_given, false));
        for place in (0..KEPT).map(|step| (newest + step) % KEPT) {
            if let Some(free) = Arc::get_mut(&mut self.places[place]) {
                let is_newest = item.is_some();
                *free = item.take();
                if is_newest {
                    self.newest = place;
                }
            }
        }
        let is_kept = item.is_none();
        if !is_kept {
            self.was_given = was_given;
        }
        if !is_kept || !was_given {
            counters.of(input, |c| &c.dropped);
        }
        is_kept
    }
}

impl<S: Source> Reader for Input<S> {
    fn catch_up(&mut self, input: usize, counters: &JoinCounters) {
        for _ in 0..=self.source.get_ref().room().depth {
            let Some(item) = self.source.get_mut().try_next() else { return };
            self.put(item, input, counters);
        }
    }

    fn poll_arrival(
        &mut self,
        context: &mut Context<'_>,
        input: usize,
        counters: &JoinCounters,
    ) -> Poll<Option<bool>> {
        let poll = self.source.poll_next_unpin(context);
        poll.map(|item| item.map(|item| self.put(item, input, counters)))
    }

    fn finish(&mut self) {
        self.source.get_mut().finish();
    }

    fn is_empty(&self) -> bool {
        self.places[self.newest].is_none()
    }

    fn room(&self) -> (String, Room) {
        (self.source.get_ref().name(), self.source.get_ref().room())
    }
}

macro_rules! tuple {
    ($($name:ident $place:tt),*) => {
        impl<$($name: Source),*> LatestInputs for ($($name,)*) {
            type Items = ($(Option<Kept<$name::Item>>,)*);
            type All = ($(Kept<$name::Item>,)*);
        }

        impl<$($name: Source),*> sealed::Tuple for ($($name,)*) {
            type Readers = ($(Input<$name>,)*);
            const COUNT: usize = [$($place),*].len();

            fn into_readers(self) -> Self::Readers {
                ($(Input::new(self.$place),)*)
            }

            fn reader(readers: &mut Self::Readers, input: usize) -> &mut dyn Reader {
                match input {
                    $($place => &mut readers.$place,)*
                    // Unreachable: inputs are numbered below `COUNT`.
                    _ => &mut readers.0,
                }
            }

            fn read(readers: &mut Self::Readers) -> <Self as LatestInputs>::Items {
                ($(readers.$place.read(),)*)
            }

            fn read_all(readers: &mut Self::Readers) -> Option<<Self as LatestInputs>::All> {
                if $(readers.$place.is_empty() ||)* false {
                    return None;
                }
                Some(($(readers.$place.read()?,)*))
            }
        }
    };
}
tuple!(A 0);
for_each_tuple!(tuple);
