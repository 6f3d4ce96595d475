// SPDX-License-Identifier: MIT OR Apache-2.0
//! A process's membership of a domain: its file, its doorbell, its record, and the threads that maintain them.

pub(crate) mod file;
pub(crate) mod ranges;

use crate::cleanup::{Janitor, Warden, remove_dead_domains};
use crate::error::TransportError;
use crate::graph::domain::Domain;
use crate::graph::{GraphWatcher, Model, NodeEntry, OwnRecord};
use crate::qos::{Limits, Qos};
use crate::topic::matching::Matcher;
use crate::topic::publisher::{PublisherRole, RawPublisher};
use crate::topic::subscription::{RawSubscription, SubscriptionRole};
use crate::topic::topic_type::TopicType;
use crate::topic::typed::{Codec, Decode, Publisher, Subscription};
use file::{OwnMemory, Peer};
use iceoryx2_log::{LogLevel, set_log_level};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use tautline_doorbell::{Arena, Doorbell, Slot};
use tautline_msgs::Message;
use tautline_rt::{AtExit, at_exit};

/// Greatest domain number, as in ROS 2.
pub const MAX_DOMAIN: u32 = 232;

/// Membership of a domain. Processes see each other's topics if they are in the same domain, on the same host, as the
/// same user, in the same scope (`TAUT_SCOPE`). A clone is the same membership.
#[derive(Clone)]
pub struct Participant {
    pub(crate) state: Arc<ParticipantState>,
    /// Whose the publishers and subscriptions are that this one creates.
    pub(crate) node: Option<Arc<NodeEntry>>,
}

pub(crate) struct ParticipantState {
    // Dropped in this order: the threads first, the membership last.
    janitor: Janitor,
    _warden: Warden,
    pub(crate) graph_watcher: GraphWatcher,
    pub(crate) matcher: Arc<Matcher>,
    pub(crate) record: Arc<OwnRecord>,
    pub(crate) doorbell: Arc<Doorbell>,
    model: Mutex<Model>,
    trace: tautline_trace::Object,
    _tracing: tautline_trace::Membership,
    membership: Membership,
    pub(crate) memory: Arc<OwnMemory>,
    pub(crate) domain: Arc<Domain>,
    // Last: it leaves the domain, too.
    _at_exit: AtExit,
}

/// This participant's place among the members, and its file, until they are given up.
struct Membership {
    domain: Arc<Domain>,
    memory: Arc<OwnMemory>,
    record: Arc<OwnRecord>,
    matcher: Arc<Matcher>,
    place: usize,
}

impl Drop for Membership {
    fn drop(&mut self) {
        // What publishers sent may be wanted by somebody who has not found it yet. Then it stays for that one, and the domain's warden
        // cleans up after this participant as after one that was killed.
        if self.matcher.is_awaited() {
            return;
        }
        self.domain.remove(self.memory.id());
        if self.record.is_relay() {
            // With it goes what it said of other hosts, which may concern anybody.
            self.domain.call_all();
        }
        self.memory.retire();
    }
}

/// The participant that an arena belongs to: this process's own or another.
#[derive(Clone)]
pub(crate) enum ArenaOwner {
    Own(Arc<Doorbell>),
    Peer(Arc<Peer>),
}

impl ArenaOwner {
    pub(crate) fn arena(&self) -> &Arena {
        match self {
            ArenaOwner::Own(doorbell) => doorbell.arena(),
            ArenaOwner::Peer(peer) => peer.arena(),
        }
    }

    /// Makes sure that `slot` can be rung. False if there is no such slot.
    pub(crate) fn reach(&self, slot: usize) -> Result<bool, TransportError> {
        match self {
            ArenaOwner::Own(doorbell) => Ok(doorbell.arena().has(slot)),
            ArenaOwner::Peer(peer) => peer.reach(slot),
        }
    }
}

/// Whether there is such a domain, and the scope is one.
pub(crate) fn check_domain(domain: u32) -> Result<(), TransportError> {
    if domain > MAX_DOMAIN {
        return Err(TransportError::DomainRange { domain, max: MAX_DOMAIN });
    }
    tautline_rt::domain::scope()?;
    Ok(())
}

impl Participant {
    /// Joins `domain`: creates a file in /dev/shm, starts the janitor (an ordinary, low-priority thread that connects publishers
    /// and subscriptions of other processes) and the warden (a thread that detects dead processes).
    ///
    /// The first participant of a process also removes what is left of this user's other domains in which every process was killed, for
    /// at most 100 ms.
    ///
    /// Sets iceoryx2's log level, which applies to the whole process, to fatal: iceoryx2's errors are returned as errors here
    /// instead. Raises the process's limit of open files to the hard limit, at most to
    /// [`OPEN_FILES`](tautline_rt::host::OPEN_FILES).
    ///
    /// # Real-time
    /// Setup only: allocates, starts threads.
    ///
    /// # Errors
    /// [`TransportError`]: shared memory cannot be created or belongs to another user.
    pub fn new(domain: u32) -> Result<Self, TransportError> {
        check_domain(domain)?;
        set_log_level(LogLevel::Fatal);
        tautline_rt::host::raise_open_files();
        let domain = Domain::join(domain)?;
        remove_dead_domains();
        let number = domain.number();
        let tracing = tautline_trace::join(number)?;
        let memory = Arc::new(OwnMemory::create(number)?);
        let arena = memory.create_arena();
        let doorbell = {
            let memory = memory.clone();
            Doorbell::new(arena, Box::new(move |window| memory.grow_arena(window)))
        };
        let record = OwnRecord::new(&domain, &memory);
        let matcher = Arc::new(Matcher::new(&domain, memory.id(), &record));
        let place = domain.add(memory.id()).inspect_err(|_| memory.retire())?;
        let membership = Membership {
            domain: domain.clone(),
            memory: memory.clone(),
            record: record.clone(),
            matcher: matcher.clone(),
            place,
        };
        let left = domain.clone();
        // If others are there, one of them cleans up after this participant as after one that was killed: its threads run until then.
        let at_exit = at_exit(move || {
            tautline_trace::leave_at_exit();
            left.leave();
        });
        record.publish(place);
        let janitor = Janitor::start(&domain, place, &doorbell, &matcher, &memory)?;
        let warden = Warden::start(&domain)?;
        let state = ParticipantState {
            janitor,
            _warden: warden,
            graph_watcher: GraphWatcher::new(domain.clone()),
            matcher,
            record,
            doorbell,
            model: Mutex::new(Model::new(memory.id())),
            trace: tautline_trace::context_init(number),
            _tracing: tracing,
            membership,
            memory,
            domain,
            _at_exit: at_exit,
        };
        Ok(Participant { state: Arc::new(state), node: None })
    }

    /// Makes the participant's janitor call `attendant` each time that it is woken. The janitor is an ordinary thread of low priority;
    /// the function must not block it. Only the first function that is passed is used. It must not hold the participant.
    pub fn attend(&self, attendant: impl Fn() + Send + Sync + 'static) {
        self.state.janitor.attend(Box::new(attendant));
    }

    /// The domain.
    pub fn domain(&self) -> u32 {
        self.state.domain.number()
    }

    /// This participant's id in trace events.
    pub fn trace_id(&self) -> tautline_trace::ObjectId {
        self.state.trace.id()
    }

    /// Refuses to a forked child what only the process that joined may do.
    ///
    /// # Errors
    /// [`TransportError::Forked`].
    pub fn check_process(&self) -> Result<(), TransportError> {
        self.state.domain.check_process()
    }

    /// The doorbell that announces samples to this participant's sampler.
    pub fn doorbell(&self) -> &Arc<Doorbell> {
        &self.state.doorbell
    }

    /// Claims a slot for a timer or a guard condition.
    ///
    /// # Errors
    /// [`TransportError::Doorbell`] if all slots are in use.
    pub fn claim_slot(&self) -> Result<Slot, TransportError> {
        self.check_process()?;
        Ok(self.state.doorbell.claim()?)
    }

    /// Creates a publisher of `topic`, a fully qualified name.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// [`TransportError`]: no shared memory, an invalid QoS.
    pub fn create_publisher<T: Message>(
        &self,
        topic: &str,
        qos: Qos,
        limits: Limits,
    ) -> Result<Publisher<T>, TransportError> {
        self.create_publisher_of(topic, &TopicType::of::<T>(), (), qos, limits)
    }

    /// The same for callers that know more about the type than `T` states: the hash of a type that is only defined in Rust, or the
    /// definition of a type that is known at run time.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// As [`create_publisher`](Self::create_publisher).
    pub fn create_publisher_of<T: Codec>(
        &self,
        topic: &str,
        topic_type: &TopicType,
        definition: T::Definition,
        qos: Qos,
        limits: Limits,
    ) -> Result<Publisher<T>, TransportError> {
        Ok(Publisher::new(self.create_raw_publisher(topic, topic_type, qos, limits)?, definition))
    }

    /// Creates a subscription of `topic`, a fully qualified name. What is published from now on is queued.
    ///
    /// # Real-time
    /// Setup only. Waits up to 100 ms for the processes of existing publishers, because one of them may be
    /// stopped.
    ///
    /// # Errors
    /// [`TransportError`]: no shared memory, an invalid QoS.
    pub fn create_subscription<T: Message>(
        &self,
        topic: &str,
        qos: Qos,
        limits: Limits,
    ) -> Result<Subscription<T>, TransportError> {
        self.create_subscription_of(topic, &TopicType::of::<T>(), (), qos, limits)
    }

    /// The same for callers that know more about the type than `T` states, like
    /// [`create_publisher_of`](Self::create_publisher_of).
    ///
    /// # Real-time
    /// As [`create_subscription`](Self::create_subscription).
    ///
    /// # Errors
    /// As [`create_subscription`](Self::create_subscription).
    pub fn create_subscription_of<T: Decode>(
        &self,
        topic: &str,
        topic_type: &TopicType,
        definition: T::Definition,
        qos: Qos,
        limits: Limits,
    ) -> Result<Subscription<T>, TransportError> {
        Ok(Subscription::new(self.create_raw_subscription(topic, topic_type, qos, limits)?, definition))
    }

    /// Creates a publisher of bytes of `topic`, a fully qualified name.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// [`TransportError`]: no shared memory, an invalid QoS.
    pub fn create_raw_publisher(
        &self,
        topic: &str,
        topic_type: &TopicType,
        qos: Qos,
        limits: Limits,
    ) -> Result<RawPublisher, TransportError> {
        RawPublisher::create(self, topic, topic_type, qos, limits, PublisherRole::default())
    }

    /// Creates a subscription to the bytes of `topic`, a fully qualified name. What is published from now on is queued.
    ///
    /// # Real-time
    /// As [`create_subscription`](Self::create_subscription).
    ///
    /// # Errors
    /// [`TransportError`]: no shared memory, an invalid QoS.
    pub fn create_raw_subscription(
        &self,
        topic: &str,
        topic_type: &TopicType,
        qos: Qos,
        limits: Limits,
    ) -> Result<RawSubscription, TransportError> {
        RawSubscription::create(self, topic, topic_type, qos, limits, SubscriptionRole::default())
    }

    /// Like [`create_raw_publisher`](Self::create_raw_publisher), for relayed messages: every subscription gets them, whatever
    /// it requests.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// As [`create_raw_publisher`](Self::create_raw_publisher).
    pub fn create_relay_publisher(
        &self,
        topic: &str,
        topic_type: &TopicType,
        qos: Qos,
        limits: Limits,
    ) -> Result<RawPublisher, TransportError> {
        let role = PublisherRole { is_relay: true, ..PublisherRole::default() };
        RawPublisher::create(self, topic, topic_type, qos, limits, role)
    }

    /// Like [`create_raw_subscription`](Self::create_raw_subscription), for messages to be relayed: it gets the messages of
    /// every publisher, whatever the publisher offers.
    ///
    /// # Real-time
    /// As [`create_subscription`](Self::create_subscription).
    ///
    /// # Errors
    /// As [`create_raw_subscription`](Self::create_raw_subscription).
    pub fn create_relay_subscription(
        &self,
        topic: &str,
        topic_type: &TopicType,
        qos: Qos,
        limits: Limits,
    ) -> Result<RawSubscription, TransportError> {
        let role = SubscriptionRole { is_relay: true, ..SubscriptionRole::default() };
        RawSubscription::create(self, topic, topic_type, qos, limits, role)
    }

    /// An observer: a subscription for tools. It gets the messages of every publisher on this host, whatever the publisher offers, and the
    /// samples kept for late joiners, at most `depth` of each. It is invisible: it appears in no count, list or event, matches nothing,
    /// makes no gateway fetch messages, and no publisher waits for it. It is not rung, so [take](RawSubscription::try_take) from it at
    /// intervals.
    ///
    /// Its cost for each publisher: a queue of `depth`, into which the publishing thread puts each sample, and memory for
    /// `limits.held` samples, plus memory for `depth` samples if `depth` is greater than that of every subscription.
    ///
    /// # Real-time
    /// As [`create_subscription`](Self::create_subscription).
    ///
    /// # Errors
    /// As [`create_raw_subscription`](Self::create_raw_subscription).
    pub fn create_observer(
        &self,
        topic: &str,
        topic_type: &TopicType,
        depth: usize,
        limits: Limits,
    ) -> Result<RawSubscription, TransportError> {
        let role = SubscriptionRole { is_observer: true, ..SubscriptionRole::default() };
        let qos = Qos::keep_last(depth).best_effort().transient_local();
        RawSubscription::create(self, topic, topic_type, qos, limits, role)
    }
}

impl Participant {
    /// What has this slot ends with the node that this one makes things for.
    pub(crate) fn adopt(&self, slot: &Arc<Slot>) {
        if let Some(node) = &self.node {
            node.adopt(slot);
        }
    }
}

impl ParticipantState {
    pub(crate) fn model(&self) -> MutexGuard<'_, Model> {
        self.model.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Has this participant's janitor look.
    ///
    /// # Real-time
    /// Wait-free; one futex wake.
    pub(crate) fn call_janitor(&self) {
        self.domain.call(self.membership.place);
    }
}
