// SPDX-License-Identifier: MIT OR Apache-2.0
//! The inputs of joins.

use futures::stream::Fuse;
use futures::{Stream, StreamExt};
use std::pin::Pin;
use std::task::{Context, Poll, Waker};

/// The limits of a source.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Room {
    /// Maximum number of live items; no more arrive while there are this many.
    pub held: usize,
    /// Maximum number of queued items.
    pub depth: usize,
}

/// A stream that can be joined with others.
pub trait Source: Stream + Unpin {
    /// The source's name in errors, such as its topic.
    fn name(&self) -> String {
        "an input".to_owned()
    }

    /// The source's limits. By default it holds any number of items, and at most 1,000 are taken at once.
    fn room(&self) -> Room {
        Room { held: usize::MAX, depth: 1_000 }
    }

    /// Takes the next item if there is one, without a wake-up for later items, and without a job for it: an item that is read beside
    /// a trigger has no response time of its own.
    fn try_next(&mut self) -> Option<Self::Item> {
        match self.poll_next_unpin(&mut Context::from_waker(Waker::noop())) {
            Poll::Ready(item) => item,
            Poll::Pending => None,
        }
    }

    /// Ends the job of the last item, if it has one: the item has been handled. Otherwise the job ends with the next poll.
    fn finish(&mut self) {}
}

/// A source whose items have a time stamp.
pub trait Stamped: Source {
    /// The stamp of an item in nanoseconds, of any clock that all inputs have in common.
    fn stamp_ns(&self, item: &Self::Item) -> i64;
}

/// A source whose stamps a function provides; created by [`stamped`].
#[derive(Debug)]
#[must_use = "nothing is received unless it is polled"]
pub struct StampedStream<S, F> {
    source: S,
    stamp: F,
}

/// Creates a source from any stream, with a function that returns an item's stamp in nanoseconds.
pub fn stamped<S: Stream + Unpin, F: Fn(&S::Item) -> i64>(stream: S, stamp: F) -> StampedStream<Plain<S>, F> {
    StampedStream { source: Plain(stream.fuse()), stamp }
}

/// A stream without its own limits.
#[derive(Debug)]
pub struct Plain<S>(Fuse<S>);

impl<S: Stream + Unpin> Stream for Plain<S> {
    type Item = S::Item;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<S::Item>> {
        self.0.poll_next_unpin(context)
    }
}

impl<S: Stream + Unpin> Source for Plain<S> {}

impl<S: Source, F: Fn(&S::Item) -> i64> StampedStream<S, F> {
    /// A source whose stamps come from a function instead of the source.
    pub fn new(source: S, stamp: F) -> Self {
        StampedStream { source, stamp }
    }
}

impl<S: Source, F: Unpin> Stream for StampedStream<S, F> {
    type Item = S::Item;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<S::Item>> {
        self.source.poll_next_unpin(context)
    }
}

impl<S: Source, F: Unpin> Source for StampedStream<S, F> {
    fn name(&self) -> String {
        self.source.name()
    }

    fn room(&self) -> Room {
        self.source.room()
    }

    fn try_next(&mut self) -> Option<S::Item> {
        self.source.try_next()
    }

    fn finish(&mut self) {
        self.source.finish();
    }
}

impl<S: Source, F: Fn(&S::Item) -> i64 + Unpin> Stamped for StampedStream<S, F> {
    fn stamp_ns(&self, item: &S::Item) -> i64 {
        (self.stamp)(item)
    }
}
