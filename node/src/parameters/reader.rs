// SPDX-License-Identifier: MIT OR Apache-2.0
//! Reads a parameter from a callback, and waits for its changes.

use crate::values::{ParameterValue, ParameterVariant};
use futures::Stream;
use futures::task::AtomicWaker;
use std::future::poll_fn;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use tautline_rt::{LatestReader, latest};

/// A parameter's value for one callback: reading never waits for a thread that sets it, and drops nothing.
///
/// As a stream it yields each change, or the last of several changes between two polls.
///
/// ```
/// use tautline::{Context, Node, Realtime};
///
/// let ctx = Context::builder().domain(124).realtime(Realtime::Off).build()?;
/// let mut node = Node::create(ctx, "controller", "")?;
/// let mut gain = node.declare_parameter("gain", 1.5)?; // or what the command line says: -p gain:=2.0
/// assert_eq!(gain.get(), 1.5);
/// node.set_parameter("gain", 3.0)?;
/// assert_eq!(gain.get(), 3.0);
/// # Ok::<(), tautline::Error>(())
/// ```
pub struct ParameterReader<T> {
    name: String,
    latest: LatestReader<T>,
    changed: Arc<AtomicWaker>,
}

/// The other side of a reader: takes a new value, if there is one, and returns whether the reader still exists.
pub(super) type Feed = Box<dyn FnMut(Option<&ParameterValue>) -> bool + Send>;

impl<T: ParameterVariant> ParameterReader<T> {
    /// A reader with its first value, and its feed.
    pub(super) fn new(name: &str, first: T) -> (ParameterReader<T>, Feed) {
        let (mut writer, latest) = latest(first);
        let changed = Arc::new(AtomicWaker::new());
        let reader = ParameterReader { name: name.to_owned(), latest, changed: changed.clone() };
        let feed = move |value: Option<&ParameterValue>| {
            if writer.is_abandoned() {
                return false;
            }
            if let Some(Ok(value)) = value.map(|value| T::from_value(value.clone())) {
                writer.write_and_wake(value, || changed.wake());
            }
            true
        };
        (reader, Box::new(feed))
    }

    /// The parameter's name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The value, by copy.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    pub fn get(&mut self) -> T
    where
        T: Copy,
    {
        *self.latest.read()
    }

    /// The value.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall; drops nothing: old values are dropped by the thread that sets
    /// new ones.
    pub fn read(&mut self) -> &T {
        self.latest.read()
    }

    /// Waits until the value has been changed since it was last read.
    ///
    /// # Real-time
    /// Each poll wait-free; no allocation.
    pub async fn changed(&mut self) -> &T {
        poll_fn(|context| self.poll_changed(context)).await;
        self.latest.read()
    }

    fn poll_changed(&self, context: &mut Context<'_>) -> Poll<()> {
        let is_fresh = self.latest.is_fresh_after(|| self.changed.register(context.waker()));
        if is_fresh { Poll::Ready(()) } else { Poll::Pending }
    }
}

impl<T: ParameterVariant> Stream for ParameterReader<T> {
    type Item = T;

    /// # Real-time
    /// Wait-free; allocates if `T` owns memory. Never ends.
    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<T>> {
        self.poll_changed(context).map(|()| Some(self.latest.read().clone()))
    }
}

tautline_rt::debug_fields!([T] ParameterReader<T>, |this| name = this.name);
