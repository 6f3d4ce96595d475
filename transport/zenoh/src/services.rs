// SPDX-License-Identifier: MIT OR Apache-2.0
//! Services between hosts, in rmw_zenoh's form, as bytes: a queryable for each service of this host, which asks the service as a
//! client of it; and for services that only other hosts have, a server here that passes requests on as queries.
//!
//! One thread does both. It decides nothing: [`Routes`] says which services go which way.

use crate::wire::{Attachment, ENCAPSULATION, TopicKey, check_encapsulation};
use futures::channel::mpsc;
use futures::executor::block_on;
use futures::future::{AbortHandle, Aborted, BoxFuture, abortable, poll_fn};
use futures::stream::FuturesUnordered;
use futures::{FutureExt, StreamExt};
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc as mpsc_std;
use std::sync::{Arc, Weak};
use std::task::{Context, Poll};
use std::time::{Duration, Instant};
use tautline_rt::clock::wall_ns;
use tautline_rt::{JoinHandle, RtError, ThreadBuilder};
use tautline_transport::{
    Availability, Claim, Limits, MAX_PENDING_REQUESTS, Participant, RawClient, RawPending, RawSample,
    RawServer, RequestId, ServiceError, ServiceKind, ServiceType, TransportError,
};
use zenoh::bytes::ZBytes;
use zenoh::query::{ConsolidationMode, Query, QueryTarget, Queryable, Reply};
use zenoh::{Session, Wait};

/// Requests of one client on this host that wait to be passed on.
const DEPTH: usize = 100;
/// Requests of one service that are passed on before others have their turn.
const AT_ONCE: usize = 16;
/// Clients of one service of this host on behalf of others, when each has as many requests pending as it can.
const MAX_CLIENTS: usize = 16;
/// Commands that are obeyed before others have their turn.
const COMMANDS_AT_ONCE: usize = 256;
/// Queries and answers from the network that wait for this thread.
const MAX_WAITING: usize = 4096;
/// When Zenoh gives up: a client's own limit comes before. An action's result may take as long as it likes.
const TIMEOUT: Duration = Duration::from_secs(7 * 24 * 3600);

/// How long a request waits for a server.
const HELD_TIME: Duration = Duration::from_secs(10);
/// So many requests of a service, and so much in all of them.
const MAX_HELD: usize = 1024;
const MAX_HELD_BYTES: usize = 16 << 20;

/// How long the gateway waits for the thread to offer services.
const PATIENCE: Duration = Duration::from_secs(1);

/// Which services go which way.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Routes {
    /// Of this host: others may ask.
    pub(crate) offered: BTreeSet<TopicKey>,
    /// Of other hosts only, with clients here.
    pub(crate) sought: BTreeSet<TopicKey>,
}

impl Routes {
    /// What follows from the servers and clients of the domain, each with whether the network is told of it, and the servers
    /// elsewhere whose answers come in here.
    pub(crate) fn of<'a>(
        here: impl Iterator<Item = &'a (ServiceKind, TopicKey, bool)> + Clone,
        elsewhere: &BTreeSet<TopicKey>,
    ) -> Self {
        let of_kind = |kind| here.clone().filter(move |(of, ..)| *of == kind);
        let offered = of_kind(ServiceKind::Server).filter(|(.., is_announced)| *is_announced);
        let servers: BTreeSet<&TopicKey> = of_kind(ServiceKind::Server).map(|(_, key, _)| key).collect();
        let clients: BTreeSet<&TopicKey> = of_kind(ServiceKind::Client).map(|(_, key, _)| key).collect();
        let sought = clients.difference(&servers).filter(|key| elsewhere.contains(**key));
        Routes {
            offered: offered.map(|(_, key, _)| key.clone()).collect(),
            sought: sought.map(|key| (*key).clone()).collect(),
        }
    }
}

/// What the thread is told.
enum Command {
    /// And who waits for that.
    Routes(Routes, mpsc_std::Sender<()>),
    Query(TopicKey, Query),
    /// The answer to a request of a client on this host: as much of it as is one.
    Reply(TopicKey, RequestId, ZBytes),
    /// No more answers come to a request of a client on this host, and none has come.
    Unanswered(TopicKey, RequestId),
    /// Time went by.
    Look,
}

/// How Zenoh's threads reach this one: what it has no time for is not kept.
#[derive(Clone)]
struct Sender {
    commands: mpsc::UnboundedSender<Command>,
    waiting: Arc<AtomicUsize>,
}

impl Sender {
    /// What does not fit is dropped, which ends a query without an answer. Whether it fits.
    fn send(&self, command: Command) -> bool {
        let room = |waiting: usize| (waiting < MAX_WAITING).then_some(waiting + 1);
        let fits = self.waiting.fetch_update(Ordering::Relaxed, Ordering::Relaxed, room).is_ok();
        fits && self.commands.unbounded_send(command).is_ok()
    }

    /// What is never too much: there is one for each request that was passed on.
    fn tell(&self, command: Command) {
        // Ignored: the gateway ends.
        let _ = self.commands.unbounded_send(command);
    }
}

/// A request of a client on this host that others were asked. Dropped with the query, when no more answers come.
struct Asked {
    sender: Sender,
    key: TopicKey,
    id: RequestId,
    is_answered: AtomicBool,
}

impl Asked {
    fn hear(&self, reply: Reply) {
        match reply.result() {
            Ok(sample) => {
                let reply = Command::Reply(self.key.clone(), self.id, sample.payload().clone());
                if self.sender.send(reply) {
                    self.is_answered.store(true, Ordering::Relaxed);
                }
            }
            Err(error) => {
                let reason = error.payload().try_to_string().unwrap_or_default().into_owned();
                tracing::warn!("service '{}': another host does not answer: {reason}", self.key.topic);
            }
        }
    }
}

impl Drop for Asked {
    fn drop(&mut self) {
        if !self.is_answered.load(Ordering::Relaxed) {
            self.sender.tell(Command::Unanswered(self.key.clone(), self.id));
        }
    }
}

/// The thread, ended by dropping this.
pub(crate) struct Services {
    commands: Sender,
    routes: Routes,
    waiting: Arc<AtomicUsize>,
    thread: Option<JoinHandle<()>>,
}

impl Services {
    pub(crate) fn start(
        thread: ThreadBuilder,
        participant: Participant,
        session: Session,
        max_bytes: usize,
    ) -> Result<Self, RtError> {
        let (commands, received) = mpsc::unbounded();
        let commands = Sender { commands, waiting: Arc::default() };
        let sender = commands.clone();
        let waiting = Arc::<AtomicUsize>::default();
        let all_waiting = waiting.clone();
        let thread = thread.spawn(move || {
            let mut bridge = Bridge {
                participant,
                session,
                max_bytes,
                commands: received,
                sender,
                offered: BTreeMap::new(),
                sought: BTreeMap::new(),
                pending: FuturesUnordered::new(),
                unanswered: Vec::new(),
                waiting: all_waiting,
            };
            move || block_on(poll_fn(|context| bridge.poll(context)))
        })?;
        Ok(Services { commands, routes: Routes::default(), waiting, thread: Some(thread) })
    }

    /// Lets the thread look whether something has waited long enough. To be called now and then.
    pub(crate) fn look(&self) {
        if self.waiting.load(Ordering::Relaxed) != 0 {
            self.commands.tell(Command::Look);
        }
    }

    /// Waits until services that are now offered can be asked, so that they can be announced.
    pub(crate) fn set_routes(&mut self, routes: Routes) {
        if routes != self.routes {
            self.routes = routes.clone();
            let (done, obeyed) = mpsc_std::channel();
            self.commands.tell(Command::Routes(routes, done));
            if obeyed.recv_timeout(PATIENCE).is_err() {
                tracing::warn!("services change slowly: some are announced before they can be asked");
            }
        }
    }
}

impl Drop for Services {
    fn drop(&mut self) {
        self.commands.commands.close_channel();
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

struct Bridge {
    participant: Participant,
    session: Session,
    max_bytes: usize,
    commands: mpsc::UnboundedReceiver<Command>,
    sender: Sender,
    offered: BTreeMap<TopicKey, Offer>,
    sought: BTreeMap<TopicKey, RawServer>,
    /// Answers of services on this host.
    pending: FuturesUnordered<BoxFuture<'static, ()>>,
    /// Clients that could not be told yet that there is no answer.
    unanswered: Vec<(TopicKey, RequestId)>,
    /// How many requests wait for a server, and clients for word that there is no answer.
    waiting: Arc<AtomicUsize>,
}

/// A service of this host that others may ask.
struct Offer {
    /// One, and more while many requests wait for answers.
    clients: Vec<RawClient>,
    /// Requests, the oldest first, with what lives as long as they are pending.
    asked: VecDeque<(AbortHandle, Weak<()>)>,
    held: Held,
    availability: Option<Availability>,
    _queryable: Queryable<()>,
}

/// Requests of a service that wait for a server: whoever tells of one here, a bridge, makes it when somebody asks.
struct Held {
    requests: VecDeque<(Query, Instant)>,
    bytes: usize,
    /// Counts them together with all else that a look is for: the thread's `waiting`.
    all: Arc<AtomicUsize>,
}

impl Held {
    fn bytes_of(query: &Query) -> usize {
        query.payload().map_or(0, ZBytes::len)
    }

    fn push(&mut self, query: Query, since: Instant) {
        let bytes = self.bytes + Self::bytes_of(&query);
        if self.requests.len() >= MAX_HELD || bytes > MAX_HELD_BYTES {
            return refuse(&query, "too many requests wait for a server".to_owned());
        }
        self.bytes = bytes;
        self.requests.push_back((query, since));
        self.all.fetch_add(1, Ordering::Relaxed);
    }

    fn pop(&mut self) -> Option<(Query, Instant)> {
        let (query, since) = self.requests.pop_front()?;
        self.bytes -= Self::bytes_of(&query);
        self.all.fetch_sub(1, Ordering::Relaxed);
        Some((query, since))
    }

    fn pop_late(&mut self) -> Option<Query> {
        self.requests.front().filter(|(_, since)| since.elapsed() >= HELD_TIME)?;
        self.pop().map(|(query, _)| query)
    }
}

impl Drop for Held {
    fn drop(&mut self) {
        self.all.fetch_sub(self.requests.len(), Ordering::Relaxed);
    }
}

impl Bridge {
    fn poll(&mut self, context: &mut Context<'_>) -> Poll<()> {
        let unanswered = std::mem::take(&mut self.unanswered);
        self.waiting.fetch_sub(unanswered.len(), Ordering::Relaxed);
        for (key, id) in unanswered {
            self.give_up(key, id);
        }
        for count in 1.. {
            match self.commands.poll_next_unpin(context) {
                Poll::Ready(Some(command)) => self.obey(command, context),
                Poll::Ready(None) => return Poll::Ready(()),
                Poll::Pending => break,
            }
            if count == COMMANDS_AT_ONCE {
                context.waker().wake_by_ref();
                break;
            }
        }
        while let Poll::Ready(Some(())) = self.pending.poll_next_unpin(context) {}
        self.ask_held(context);
        for (key, server) in &self.sought {
            let mut passed = 0;
            while let Poll::Ready(request) = server.poll_take(context) {
                pass_on(&self.session, &self.sender, key, &request);
                passed += 1;
                if passed == AT_ONCE {
                    context.waker().wake_by_ref();
                    break;
                }
            }
        }
        Poll::Pending
    }

    fn obey(&mut self, command: Command, context: &mut Context<'_>) {
        if matches!(command, Command::Query(..) | Command::Reply(..)) {
            self.sender.waiting.fetch_sub(1, Ordering::Relaxed);
        }
        match command {
            Command::Routes(routes, done) => {
                self.set_routes(&routes);
                // Ignored: nobody waits any more.
                let _ = done.send(());
            }
            Command::Query(key, query) => match self.offered.get_mut(&key) {
                // After those that came before.
                Some(offer) if !offer.held.requests.is_empty() => offer.held.push(query, Instant::now()),
                _ => self.take(&key, query, Instant::now(), context),
            },
            Command::Reply(key, id, payload) => {
                if let Some(server) = self.sought.get(&key)
                    && let Err(reason) = answer(server, id, &payload, self.max_bytes)
                {
                    tracing::warn!(
                        "service '{}': an answer from another host is dropped: {reason}",
                        key.topic
                    );
                    self.give_up(key, id);
                }
            }
            Command::Unanswered(key, id) => self.give_up(key, id),
            Command::Look => {
                for offer in self.offered.values_mut() {
                    while let Some(query) = offer.held.pop_late() {
                        refuse(&query, format!("no server was there for {} s", HELD_TIME.as_secs()));
                    }
                    if offer.held.requests.is_empty() {
                        offer.availability = None;
                    }
                }
            }
        }
    }

    /// Another host asks a service of the domain.
    fn take(&mut self, key: &TopicKey, query: Query, since: Instant, context: &mut Context<'_>) {
        let Err(reason) = self.ask(key, &query, context).map(|answer| self.pending.push(answer)) else {
            return;
        };
        match self.offered.get_mut(key) {
            Some(offer) if reason.is_passing => {
                offer.held.push(query, since);
                // Polled before the thread sleeps.
                context.waker().wake_by_ref();
            }
            _ => refuse(&query, reason.text),
        }
    }

    /// Asks what waited for a server that is there now.
    fn ask_held(&mut self, context: &mut Context<'_>) {
        if self.waiting.load(Ordering::Relaxed) == 0 {
            return;
        }
        let mut found = Vec::new();
        for (key, offer) in self.offered.iter_mut().filter(|(_, offer)| !offer.held.requests.is_empty()) {
            if offer.availability.is_none() {
                offer.availability = offer.clients.first().and_then(|client| client.availability().ok());
            }
            let is_there =
                offer.availability.as_mut().is_some_and(|wait| wait.poll_unpin(context).is_ready());
            if is_there {
                offer.availability = None;
                found.extend(
                    std::iter::from_fn(|| offer.held.pop()).map(|(query, since)| (key.clone(), query, since)),
                );
            }
        }
        found.into_iter().for_each(|(key, query, since)| self.take(&key, query, since, context));
    }

    fn set_routes(&mut self, routes: &Routes) {
        self.offered.retain(|key, _| routes.offered.contains(key));
        self.sought.retain(|key, _| routes.sought.contains(key));
        for key in &routes.offered {
            if !self.offered.contains_key(key) {
                match self.offer(key) {
                    Ok(offer) => drop(self.offered.insert(key.clone(), offer)),
                    Err(reason) => {
                        tracing::warn!("service '{}' is not offered to other hosts: {reason}", key.topic)
                    }
                }
            }
        }
        for key in &routes.sought {
            if !self.sought.contains_key(key) {
                match self.seek(key) {
                    Ok(server) => drop(self.sought.insert(key.clone(), server)),
                    Err(error) => {
                        tracing::warn!("service '{}' of another host is not offered here: {error}", key.topic)
                    }
                }
            }
        }
    }

    fn offer(&self, key: &TopicKey) -> Result<Offer, String> {
        let client = self.client(key)?;
        let (sender, of) = (self.sender.clone(), key.clone());
        let queryable = self
            .session
            .declare_queryable(key.to_string())
            .complete(true)
            .callback(move |query| {
                sender.send(Command::Query(of.clone(), query));
            })
            .wait()
            .map_err(|error| error.to_string())?;
        let held = Held { requests: VecDeque::new(), bytes: 0, all: self.waiting.clone() };
        let (asked, availability) = Default::default();
        Ok(Offer { clients: vec![client], asked, held, availability, _queryable: queryable })
    }

    fn client(&self, key: &TopicKey) -> Result<RawClient, String> {
        let client = self.participant.create_raw_client(&key.topic, &service_type(key), limits());
        client.map_err(|error| error.to_string())
    }

    fn seek(&self, key: &TopicKey) -> Result<RawServer, TransportError> {
        self.participant.create_raw_server(&key.topic, &service_type(key), DEPTH, limits())
    }

    /// Asks a service of this host what another host asks.
    fn ask(
        &mut self,
        key: &TopicKey,
        query: &Query,
        context: &mut Context<'_>,
    ) -> Result<BoxFuture<'static, ()>, NotAsked> {
        let attachment = query.attachment().ok_or("a request without an attachment")?;
        let attachment = Attachment::parse(&attachment.to_bytes())?;
        let payload = query.payload().map(ZBytes::to_bytes).unwrap_or_default();
        let body = body(&payload, self.max_bytes)?;
        let offer = self.offered.get(key).ok_or("the service has gone")?;
        let mut response = send(&offer.clients, body);
        if matches!(response, Err(ServiceError::TooManyPending { .. })) {
            self.make_room(key, context)?;
            let offer = self.offered.get(key).ok_or("the service has gone")?;
            response = send(&offer.clients, body);
        }
        let (response, handle) = abortable(response.map_err(not_asked)?);
        let life = Arc::new(());
        if let Some(offer) = self.offered.get_mut(key) {
            if offer.asked.len() >= 2 * MAX_PENDING_REQUESTS * offer.clients.len() {
                offer.asked.retain(|(_, life)| life.strong_count() != 0);
            }
            offer.asked.push_back((handle, Arc::downgrade(&life)));
        }
        let query = query.clone();
        let reply = response.map(move |response| {
            drop(life);
            match response {
                Ok(Ok(response)) => reply(&query, attachment, &response),
                Ok(Err(error)) => refuse(&query, error.to_string()),
                Err(Aborted) => {
                    refuse(&query, "given up: too many later requests wait for answers".to_owned())
                }
            }
        });
        Ok(reply.boxed())
    }

    /// All clients of the service have as many requests pending as they can: makes one more, or gives the oldest request up. Whoever
    /// asked that may have gone long ago.
    fn make_room(&mut self, key: &TopicKey, context: &mut Context<'_>) -> Result<(), String> {
        let clients = self.offered.get(key).map_or(0, |offer| offer.clients.len());
        let one_more = (clients < MAX_CLIENTS).then(|| self.client(key)).transpose()?;
        let offer = self.offered.get_mut(key).ok_or("the service has gone")?;
        if let Some(client) = one_more {
            offer.clients.push(client);
            return Ok(());
        }
        offer.asked.retain(|(_, life)| life.strong_count() != 0);
        if let Some((oldest, _)) = offer.asked.pop_front() {
            oldest.abort();
        }
        // Until it is dropped it has its place.
        while let Poll::Ready(Some(())) = self.pending.poll_next_unpin(context) {}
        Ok(())
    }

    /// Tells the client on this host that there is no answer to its request.
    fn give_up(&mut self, key: TopicKey, id: RequestId) {
        let Some(server) = self.sought.get(&key) else { return };
        match server.refuse(id) {
            Ok(()) | Err(ServiceError::ClientGone { .. }) => {}
            // It waits: told when there is memory again.
            Err(error) if self.unanswered.len() < MAX_WAITING => {
                if self.unanswered.is_empty() {
                    tracing::warn!("{error}");
                }
                self.unanswered.push((key, id));
                self.waiting.fetch_add(1, Ordering::Relaxed);
            }
            Err(error) => tracing::warn!("{error}"),
        }
    }
}

/// Why a service was not asked.
struct NotAsked {
    text: String,
    /// Whether there is no server yet.
    is_passing: bool,
}

impl<T: ToString> From<T> for NotAsked {
    fn from(reason: T) -> Self {
        NotAsked { text: reason.to_string(), is_passing: false }
    }
}

fn not_asked(error: ServiceError) -> NotAsked {
    NotAsked { text: error.to_string(), is_passing: matches!(error, ServiceError::NoServer { .. }) }
}

/// Sends a request through the first client that has room for one more.
fn send(clients: &[RawClient], body: &[u8]) -> Result<RawPending, ServiceError> {
    let mut refused = None;
    for client in clients {
        let mut loan = client.loan(body.len())?;
        loan.copy_from_slice(body);
        match client.send(loan) {
            Ok(pending) => return Ok(pending),
            Err(unsent) if matches!(unsent.error, ServiceError::TooManyPending { .. }) => {
                refused = Some(unsent.error);
            }
            Err(unsent) => return Err(unsent.error),
        }
    }
    // There is one at least.
    Err(refused.unwrap_or(ServiceError::NoServer { service: "".into() }))
}

/// Most services are seldom asked, if ever: they take no memory before.
fn limits() -> Limits {
    Limits { claim: Claim::OnUse, ..Limits::default() }
}

fn service_type(key: &TopicKey) -> ServiceType {
    ServiceType::new(key.type_id.name.as_str(), Some(&key.type_id.hash.to_string()))
}

/// The body of a payload.
fn body(payload: &[u8], max_bytes: usize) -> Result<&[u8], String> {
    check_encapsulation(payload).map_err(|error| error.to_string())?;
    let body = payload.get(ENCAPSULATION.len()..).unwrap_or_default();
    if body.len() > max_bytes { Err(format!("more than {max_bytes} bytes")) } else { Ok(body) }
}

/// Passes a request of a client on this host on.
fn pass_on(session: &Session, sender: &Sender, key: &TopicKey, request: &RawSample) {
    let id = RequestId::of(request.info());
    let attachment = Attachment {
        sequence_number: i64::try_from(id.sequence_number).unwrap_or(i64::MAX),
        source_timestamp_ns: request.info().source_timestamp_ns,
        gid: id.client,
    };
    let asked = Asked { sender: sender.clone(), key: key.clone(), id, is_answered: AtomicBool::new(false) };
    let query = session
        .get(key.to_string())
        .payload([&ENCAPSULATION[..], request.body()].concat())
        .attachment(&attachment.encode()[..])
        .target(QueryTarget::AllComplete)
        .consolidation(ConsolidationMode::None)
        .timeout(TIMEOUT)
        .callback(move |reply| asked.hear(reply));
    if let Err(error) = query.wait() {
        tracing::warn!("service '{}': a request is not passed on: {error}", key.topic);
    }
}

/// Gives an answer from another host to the client on this one.
fn answer(server: &RawServer, id: RequestId, payload: &ZBytes, max_bytes: usize) -> Result<(), String> {
    let payload = payload.to_bytes();
    let body = body(&payload, max_bytes)?;
    let mut loan = server.loan(id, body.len()).map_err(|error| error.to_string())?;
    loan.copy_from_slice(body);
    loan.send().map_err(|unsent| unsent.to_string())
}

/// Answers a query with what a service of this host said.
fn reply(query: &Query, asked: Attachment, response: &RawSample) {
    let attachment = Attachment { source_timestamp_ns: wall_ns(), ..asked };
    let payload = [&ENCAPSULATION[..], response.body()].concat();
    let reply = query.reply(query.key_expr().clone(), payload).attachment(&attachment.encode()[..]);
    if let Err(error) = reply.wait() {
        tracing::warn!("{}: an answer is not sent: {error}", query.key_expr());
    }
}

/// Says why there is no answer.
fn refuse(query: &Query, reason: String) {
    // Ignored: whoever asked has gone.
    let _ = query.reply_err(reason).wait();
}

#[cfg(test)]
mod tests {
    use super::*;

    fn key(name: &str, digit: char) -> TopicKey {
        let hash = String::from(digit).repeat(64);
        TopicKey::parse(&format!("0/{name}/std_srvs::srv::dds_::SetBool_/RIHS01_{hash}")).unwrap()
    }

    #[test]
    fn what_is_here_is_offered_and_what_is_only_elsewhere_is_sought() {
        let (one, two, three) = (key("one", '1'), key("two", '1'), key("three", '1'));
        let (other_type, four) = (key("three", '2'), key("four", '1'));
        let here = [
            (ServiceKind::Server, one.clone(), true),
            (ServiceKind::Client, one.clone(), true),
            (ServiceKind::Client, two.clone(), true),
            (ServiceKind::Server, other_type.clone(), true),
            (ServiceKind::Client, three.clone(), true),
            // Somebody else announces what this domain has too.
            (ServiceKind::Server, four.clone(), false),
            (ServiceKind::Client, four.clone(), true),
        ];
        let elsewhere = BTreeSet::from([one.clone(), two.clone(), three.clone(), four.clone()]);
        let routes = Routes::of(here.iter(), &elsewhere);
        assert_eq!(routes.offered, BTreeSet::from([one, other_type]));
        assert_eq!(routes.sought, BTreeSet::from([two, three]), "a service of another type is another one");
    }
}
