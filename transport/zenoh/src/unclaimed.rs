// SPDX-License-Identifier: MIT OR Apache-2.0
//! Messages that need shared memory which is not claimed yet: the first messages, and messages longer than all before. Claiming some
//! MiB takes milliseconds, in which Zenoh's thread would receive nothing of any topic, so they wait for a thread that may claim.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Weak, mpsc};
use tautline_relay::MessageMeta;
use tautline_rt::{JoinHandle, RtError, ThreadBuilder};
use tautline_transport::{LoanError, MemoryClaimer};
use zenoh::sample::Sample;

/// Maximum of waiting bytes of all topics together; a single message may exceed it if no other one waits.
pub(crate) const MOST_BYTES: usize = 256 << 20;
/// Memory of a waiting message besides its body.
const OVERHEAD_BYTES: usize = 1024;

/// The thread that claims memory; dropping this ends it.
pub(crate) struct ClaimThread {
    pub(crate) queue: ClaimQueue,
    thread: Option<JoinHandle<()>>,
}

/// The thread's queue: topics whose messages wait, each once; `None` ends the thread.
#[derive(Clone)]
pub(crate) struct ClaimQueue {
    topics: mpsc::Sender<Option<Weak<dyn Claimant>>>,
    waiting_bytes: Arc<AtomicUsize>,
}

impl ClaimThread {
    pub(crate) fn start(thread: ThreadBuilder) -> Result<Self, RtError> {
        let (topics, waiting) = mpsc::channel::<Option<Weak<dyn Claimant>>>();
        let thread = thread.spawn(move || {
            move || {
                while let Ok(Some(gate)) = waiting.recv() {
                    gate.upgrade().inspect(|gate| pass_waiting(&**gate));
                }
            }
        })?;
        let queue = ClaimQueue { topics, waiting_bytes: Arc::default() };
        Ok(ClaimThread { queue, thread: Some(thread) })
    }
}

impl Drop for ClaimThread {
    fn drop(&mut self) {
        let _ = self.queue.topics.send(None);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// A topic whose messages wait for memory.
pub(crate) trait Claimant: Send + Sync {
    /// Passes the first waiting message, if its memory is claimed. `claimed` is the outcome of a claim for it.
    fn pass_waiting(&self, claimed: Claimed) -> Next;
}

/// What to do next for a topic whose messages wait.
#[derive(Default)]
pub(crate) enum Next {
    /// Nothing: no message waits.
    #[default]
    Done,
    Pass,
    /// Claim memory for a message of this length.
    Claim(MemoryClaimer, usize),
}

/// Claims without the topic's lock, and releases the lock after each message, because the receiving threads wait for it.
fn pass_waiting(gate: &dyn Claimant) {
    let mut claimed = None;
    loop {
        match gate.pass_waiting(claimed.take()) {
            Next::Done => return,
            Next::Pass => {}
            Next::Claim(claimer, len_bytes) => claimed = Some(claimer.claim(len_bytes)),
        }
    }
}

/// The outcome of a claim for the first waiting message; `None`: nothing was claimed.
pub(crate) type Claimed = Option<Result<(), LoanError>>;

/// A topic's messages that wait for memory, in order.
pub(crate) struct Unclaimed {
    messages: VecDeque<(Sample, MessageMeta)>,
    gate: Weak<dyn Claimant>,
    queue: ClaimQueue,
}

impl Unclaimed {
    pub(crate) fn new(gate: Weak<dyn Claimant>, queue: ClaimQueue) -> Self {
        Unclaimed { messages: VecDeque::new(), gate, queue }
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.messages.is_empty()
    }

    /// Appends a message, if there is room. Returns whether there was.
    pub(crate) fn push(&mut self, sample: Sample, source: MessageMeta) -> bool {
        let bytes = bytes(&sample);
        let admitted =
            |waiting: usize| (waiting == 0 || waiting + bytes <= MOST_BYTES).then_some(waiting + bytes);
        let waiting = &self.queue.waiting_bytes;
        if waiting.fetch_update(Ordering::Relaxed, Ordering::Relaxed, admitted).is_err() {
            return false;
        }
        if self.messages.is_empty() {
            // Ignored: the gateway is ending.
            let _ = self.queue.topics.send(Some(self.gate.clone()));
        }
        self.messages.push_back((sample, source));
        true
    }

    pub(crate) fn first(&self) -> Option<&(Sample, MessageMeta)> {
        self.messages.front()
    }

    pub(crate) fn pop(&mut self) -> Option<(Sample, MessageMeta)> {
        let message = self.messages.pop_front()?;
        self.queue.waiting_bytes.fetch_sub(bytes(&message.0), Ordering::Relaxed);
        Some(message)
    }
}

impl Drop for Unclaimed {
    fn drop(&mut self) {
        while self.pop().is_some() {}
    }
}

/// The memory of a waiting sample.
pub(crate) fn bytes(sample: &Sample) -> usize {
    sample.payload().len() + OVERHEAD_BYTES
}
