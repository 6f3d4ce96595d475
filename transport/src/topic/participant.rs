// SPDX-License-Identifier: MIT OR Apache-2.0
//! A process's membership of a domain: its file, its doorbell, its record, and the threads that maintain them.

use crate::cleanup::dead_domains::remove_dead_domains;
use crate::cleanup::janitor::Janitor;
use crate::cleanup::warden::Warden;
use crate::error::TransportError;
use crate::graph::domain::{Domain, check_domain};
use crate::graph::entities::{GraphSnapshot, NodeName};
use crate::graph::events::{GraphEvents, GraphWatcher};
use crate::graph::model::Model;
use crate::graph::own::{NodeEntry, NodeHandle, OwnRecord};
use crate::graph::remote::RemoteGraph;
use crate::memory::file::OwnMemory;
use crate::topic::matching::Matcher;
use iceoryx2_log::{LogLevel, set_log_level};
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex, PoisonError};
use tautline_doorbell::{Doorbell, Slot};
use tautline_rt::{AtExit, at_exit};

/// Membership of a domain. Processes see each other's topics if they are in the same domain, on the same host, as the
/// same user, in the same scope (`TAUT_SCOPE`). A clone is the same membership.
#[derive(Clone)]
pub struct Participant {
    pub(crate) state: Arc<ParticipantState>,
    /// The node that owns the publishers and subscriptions that are created through this handle.
    pub(crate) node: Option<Arc<NodeEntry>>,
}

pub(crate) struct ParticipantState {
    // Dropped in this order: the threads first, the membership last.
    janitor: Janitor,
    _warden: Warden,
    graph_watcher: GraphWatcher,
    pub(crate) matcher: Arc<Matcher>,
    pub(crate) record: Arc<OwnRecord>,
    pub(crate) doorbell: Arc<Doorbell>,
    model: Mutex<Model>,
    trace: tautline_trace::Object,
    _tracing: tautline_trace::Membership,
    membership: Membership,
    pub(crate) memory: Arc<OwnMemory>,
    pub(crate) domain: Arc<Domain>,
    // Last: its function holds a reference to the domain, and the process leaves the domain with the last reference.
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
        // A subscription may not have found yet what the publishers sent. Then the memory stays for it, and the domain's warden cleans up
        // after this participant as after a killed one.
        if self.matcher.is_awaited() {
            return;
        }
        // For those who have read a record that was rewritten since, and find no file any more: it leaves nothing.
        self.memory.head().record.store(0, Ordering::Release);
        self.domain.remove(self.memory.id());
        if self.record.is_relay() {
            // The announcements of other hosts' endpoints disappear with the relay, which may concern any participant.
            self.domain.call_all();
        }
        self.memory.retire();
    }
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
        let graph_watcher = GraphWatcher::new(domain.clone());
        let matcher = Arc::new(Matcher::new(&domain, memory.id(), &record, &graph_watcher.listeners));
        let place = domain.add(memory.id()).inspect_err(|_| memory.retire())?;
        let membership = Membership {
            domain: domain.clone(),
            memory: memory.clone(),
            record: record.clone(),
            matcher: matcher.clone(),
            place,
        };
        let left = domain.clone();
        // If the domain has other participants, one of them cleans up after this one as after a killed one: its threads run until then.
        let at_exit = at_exit(move || {
            tautline_trace::leave_at_exit();
            left.leave();
        });
        record.publish(place);
        let refresh = {
            let matcher = matcher.clone();
            move || matcher.refresh()
        };
        let janitor = Janitor::start(&domain, place, &doorbell, &memory, Box::new(refresh))?;
        let warden = Warden::start(&domain)?;
        let state = ParticipantState {
            janitor,
            _warden: warden,
            graph_watcher,
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

    /// Creates a node, which the other processes of the domain see.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// [`TransportError`]: names that break ROS 2's rules, no shared memory.
    pub fn create_node(&self, name: &str, namespace: &str) -> Result<NodeHandle, TransportError> {
        self.create_node_in_enclave(name, namespace, "/")
    }

    /// As [`create_node`](Self::create_node), in an SROS 2 enclave, which others see. Nothing is encrypted by it.
    ///
    /// # Errors
    /// As [`create_node`](Self::create_node).
    pub fn create_node_in_enclave(
        &self,
        name: &str,
        namespace: &str,
        enclave: &str,
    ) -> Result<NodeHandle, TransportError> {
        self.check_process()?;
        let node = NodeName { namespace: namespace.into(), name: name.into() };
        Ok(NodeHandle { entry: self.state.record.add_node(node, enclave)? })
    }

    /// The same membership; publishers and subscriptions that are created through the result belong to the
    /// node.
    #[must_use = "only what is created through the returned participant is the node's"]
    pub fn for_node(&self, node: &NodeHandle) -> Participant {
        Participant { state: self.state.clone(), node: Some(node.entry.clone()) }
    }

    /// Distinguishes this domain from domains of other hosts, users and scopes, and from the same domain at another time: a
    /// random number, created with the domain's first participant.
    ///
    /// # Real-time
    /// Wait-free; no syscall.
    pub fn domain_id(&self) -> u64 {
        self.state.domain.id()
    }

    /// This participant's own number. It is the [`teller`](crate::TopicEndpoint::teller) of everything that this
    /// participant announces.
    ///
    /// # Real-time
    /// Wait-free; no syscall.
    pub fn id(&self) -> u64 {
        self.state.memory.id()
    }

    /// Announces the entities of other hosts, in place of the previous announcement, and marks this participant's
    /// own ports as proxies for them. For gateways and bridges, which have a participant of their own.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// [`TransportError::File`] if there is no shared memory for it; a part may have been announced by then.
    pub fn set_remote(&self, remote: &RemoteGraph) -> Result<(), TransportError> {
        self.state.matcher.set_remote(remote)
    }

    /// Ends the endpoint that has this slot together with this handle's node, if it has one.
    pub(crate) fn adopt(&self, slot: &Arc<Slot>) {
        if let Some(node) = &self.node {
            node.adopt(slot);
        }
    }
}

impl ParticipantState {
    /// Everything that exists in the domain: see [`Participant::graph`].
    pub(crate) fn graph(&self) -> Result<Arc<GraphSnapshot>, TransportError> {
        self.model.lock().unwrap_or_else(PoisonError::into_inner).refresh(&self.domain)
    }

    /// Wakes a task when the graph changes: see [`Participant::graph_events`].
    pub(crate) fn graph_events(&self) -> Result<GraphEvents, TransportError> {
        self.graph_watcher.subscribe()
    }

    /// Wakes this participant's janitor, which then refreshes.
    ///
    /// # Real-time
    /// Wait-free; one futex wake.
    pub(crate) fn call_janitor(&self) {
        self.domain.call(self.membership.place);
    }
}
