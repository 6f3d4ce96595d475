// SPDX-License-Identifier: MIT OR Apache-2.0
//! Services on the network, in rmw_zenoh's form: a queryable for each service of this host, and queries as requests to services
//! that only other hosts have.

use crate::wire::{Attachment, ENCAPSULATION, TopicKey, check_encapsulation};
use futures::task::{ArcWake, waker};
use std::collections::{BTreeSet, VecDeque};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, OnceLock};
use std::task::Waker;
use std::thread::Thread;
use std::time::{Duration, Instant};
use tautline_relay::{
    Arrived, FarClient, FarServer, FarServices, OfferedService, Pending, Response, ServerId, SoughtService,
};
use tautline_rt::PiMutex;
use tautline_rt::clock::wall_ns;
use tautline_transport::{Gid, RawSample, RequestId, ServiceType};
use zenoh::bytes::ZBytes;
use zenoh::cancellation::CancellationToken;
use zenoh::query::{ConsolidationMode, Query, QueryTarget, Queryable, Reply};
use zenoh::{Session, Wait};

/// Maximum of queries and replies that wait for the services thread; further ones are dropped, and their requests get no response.
const MOST_WAITING: usize = 4096;
/// Zenoh's time-out of a query; time-outs of clients are shorter. An action's result may take any time.
const TIMEOUT: Duration = Duration::from_secs(7 * 24 * 3600);
/// Maximum of pending queries of a service: if its server is silent, the oldest queries end before their time-out. A gateway on the
/// server's host gives up the oldest when far fewer are pending.
const MOST_PENDING: usize = 4096;

pub(crate) struct NetworkServices {
    session: Session,
    domain: u32,
    max_bytes: usize,
    waker: Arc<ThreadWaker>,
}

#[derive(Default)]
struct ThreadWaker {
    thread: OnceLock<Thread>,
    is_woken: AtomicBool,
    /// Queries and replies of all services that wait for the thread.
    waiting: AtomicUsize,
}

impl ThreadWaker {
    /// Sleeps until woken, at most for `timeout`.
    fn sleep(&self, timeout: Option<Duration>) {
        let end = timeout.map(|timeout| Instant::now() + timeout);
        // Other calls in the thread may have consumed the unpark token.
        while !self.is_woken.swap(false, Ordering::SeqCst) {
            match end.map(|end| end.saturating_duration_since(Instant::now())) {
                Some(Duration::ZERO) => return,
                Some(left) => std::thread::park_timeout(left),
                None => std::thread::park(),
            }
        }
    }
}

impl ArcWake for ThreadWaker {
    fn wake_by_ref(waker: &Arc<Self>) {
        waker.is_woken.store(true, Ordering::SeqCst);
        // Before the thread has started it does not sleep.
        if let Some(thread) = waker.thread.get() {
            thread.unpark();
        }
    }
}

/// Queue from Zenoh's threads to the services thread.
struct Inbox<T> {
    waiting: PiMutex<VecDeque<T>>,
    waker: Arc<ThreadWaker>,
}

impl<T> Inbox<T> {
    fn new(waker: &Arc<ThreadWaker>) -> Arc<Self> {
        Arc::new(Inbox { waiting: PiMutex::new(VecDeque::new()), waker: waker.clone() })
    }

    /// Appends an item, unless `most` wait already. Returns whether there was room.
    fn push(&self, item: T, most: usize) -> bool {
        let room = |waiting: usize| (waiting < most).then_some(waiting + 1);
        let has_room = self.waker.waiting.fetch_update(Ordering::Relaxed, Ordering::Relaxed, room).is_ok();
        if has_room {
            self.waiting.lock().push_back(item);
            ThreadWaker::wake_by_ref(&self.waker);
        }
        has_room
    }

    fn pop(&self) -> Option<T> {
        let item = self.waiting.lock().pop_front()?;
        self.waker.waiting.fetch_sub(1, Ordering::Relaxed);
        Some(item)
    }

    fn is_empty(&self) -> bool {
        self.waiting.lock().is_empty()
    }
}

impl<T> Drop for Inbox<T> {
    fn drop(&mut self) {
        while self.pop().is_some() {}
    }
}

impl NetworkServices {
    pub(crate) fn new(session: &Session, domain: u32, max_bytes: usize) -> Self {
        NetworkServices { session: session.clone(), domain, max_bytes, waker: Arc::default() }
    }

    fn key(&self, key: &tautline_relay::TopicKey) -> Result<(TopicKey, ServiceType), String> {
        let wire_key = crate::locals::wire_key(self.domain, key)?;
        Ok((wire_key, ServiceType::new(&key.type_name, key.type_hash.as_deref())))
    }
}

impl FarServices for NetworkServices {
    type Server = Server;
    type Client = Client;
    type With = ();

    fn offer<'a>(
        &'a mut self,
        key: &'a tautline_relay::TopicKey,
        _: &'a OfferedService,
        (): &'a (),
    ) -> Result<(ServiceType, Box<dyn FnOnce() -> Result<Server, String> + 'a>), String> {
        let (wire_key, service_type) = self.key(key)?;
        let open = move || {
            let queries = Inbox::new(&self.waker);
            let inbox = queries.clone();
            let queryable = self.session.declare_queryable(wire_key.to_string()).complete(true);
            let queryable = queryable
                .callback(move |query| {
                    inbox.push(query, MOST_WAITING);
                })
                .wait();
            let _queryable = queryable.map_err(|error| error.to_string())?;
            Ok(Server { queries, max_bytes: self.max_bytes, _queryable })
        };
        Ok((service_type, Box::new(open)))
    }

    fn seek(
        &mut self,
        key: &tautline_relay::TopicKey,
        _: &SoughtService,
    ) -> Result<(ServiceType, Client), String> {
        let (wire_key, service_type) = self.key(key)?;
        let (session, key) = (self.session.clone(), wire_key.to_string());
        let (outcomes, pending) = (Inbox::new(&self.waker), Pending::new(MOST_PENDING));
        let client = Client { session, key, max_bytes: self.max_bytes, outcomes, pending, asked: 0 };
        Ok((service_type, client))
    }

    fn waker(&self) -> Waker {
        waker(self.waker.clone())
    }

    fn begin(&mut self) {
        self.waker.thread.get_or_init(std::thread::current);
    }

    fn wait(
        &mut self,
        servers: &[&Server],
        clients: &[&Client],
        timeout: Option<Duration>,
    ) -> Result<Arrived, String> {
        let arrived = || Arrived {
            requests: servers.iter().map(|server| !server.queries.is_empty()).collect(),
            responses: clients.iter().map(|client| !client.outcomes.is_empty()).collect(),
        };
        let now = arrived();
        if now.requests.iter().chain(&now.responses).any(|has| *has) {
            return Ok(now);
        }
        self.waker.sleep(timeout);
        Ok(arrived())
    }
}

/// The queryable on the network for a service of this host.
pub(crate) struct Server {
    queries: Arc<Inbox<Query>>,
    max_bytes: usize,
    _queryable: Queryable<()>,
}

/// A query, and the attachment that its reply repeats.
pub(crate) struct Request {
    query: Query,
    asked: Attachment,
}

impl FarServer for Server {
    type Request = Request;

    fn take(&mut self) -> Option<Result<(Request, Vec<u8>), String>> {
        let query = self.queries.pop()?;
        let read = || -> Result<(Attachment, Vec<u8>), String> {
            let attachment =
                query.attachment().ok_or_else(|| "a request without an attachment".to_owned())?;
            let asked = Attachment::parse(&attachment.to_bytes()).map_err(|error| error.to_string())?;
            let payload = query.payload().map(ZBytes::to_bytes).unwrap_or_default();
            Ok((asked, body(&payload, self.max_bytes)?.to_vec()))
        };
        Some(match read() {
            Ok((asked, body)) => Ok((Request { query, asked }, body)),
            Err(reason) => {
                refuse(&query, &reason);
                Err(reason)
            }
        })
    }

    fn answer(&mut self, request: Request, answer: Result<&[u8], &str>) -> Result<(), String> {
        let Request { query, asked } = request;
        let body = match answer {
            Ok(body) => body,
            Err(reason) => {
                refuse(&query, reason);
                return Ok(());
            }
        };
        let attachment = Attachment { source_timestamp_ns: wall_ns(), ..asked };
        let payload = [&ENCAPSULATION[..], body].concat();
        let reply = query.reply(query.key_expr().clone(), payload).attachment(&attachment.encode()[..]);
        reply.wait().map_err(|error| error.to_string())
    }
}

/// Replies to a query with an error.
fn refuse(query: &Query, reason: &str) {
    // Ignored: the client has ended.
    let _ = query.reply_err(reason).wait();
}

/// The client on the network for clients of this host.
pub(crate) struct Client {
    session: Session,
    key: String,
    max_bytes: usize,
    outcomes: Arc<Inbox<Outcome>>,
    pending: Pending<Cancel>,
    /// The number of the last query.
    asked: i64,
}

/// Ends a query when it is dropped.
struct Cancel(CancellationToken);

impl Drop for Cancel {
    fn drop(&mut self) {
        // Ignored: the query then ends at its time-out.
        let _ = self.0.cancel().wait();
    }
}

/// The outcome of the query with this number.
enum Outcome {
    /// A reply, not validated yet.
    Reply(i64, ZBytes),
    /// The query has ended without a reply.
    Unanswered(i64),
}

/// A pending query. Zenoh drops it with the query's callback, when no more replies come.
struct PendingQuery {
    outcomes: Arc<Inbox<Outcome>>,
    key: String,
    number: i64,
    is_answered: AtomicBool,
}

impl PendingQuery {
    fn receive(&self, reply: &Reply) {
        match reply.result() {
            Ok(sample) => {
                if self.outcomes.push(Outcome::Reply(self.number, sample.payload().clone()), MOST_WAITING) {
                    self.is_answered.store(true, Ordering::Relaxed);
                }
            }
            Err(error) => {
                let reason = error.payload().try_to_string().unwrap_or_default();
                tracing::warn!("{}: another host replied with an error: {reason:.200}", self.key);
            }
        }
    }
}

impl Drop for PendingQuery {
    fn drop(&mut self) {
        if !self.is_answered.load(Ordering::Relaxed) {
            // Bounded: one per sent request.
            self.outcomes.push(Outcome::Unanswered(self.number), usize::MAX);
        }
    }
}

impl Client {
    fn query(&mut self, id: RequestId, source_timestamp_ns: i64, request: &[u8]) {
        let sequence_number = i64::try_from(id.sequence_number).unwrap_or(i64::MAX);
        let attachment = Attachment { sequence_number, source_timestamp_ns, gid: id.client };
        self.asked += 1;
        let (outcomes, key, number) = (self.outcomes.clone(), self.key.clone(), self.asked);
        let asked = PendingQuery { outcomes, key, number, is_answered: AtomicBool::new(false) };
        let token = CancellationToken::default();
        self.pending.add(number, id, BTreeSet::new(), Instant::now(), Cancel(token.clone()));
        let query = self
            .session
            .get(&self.key)
            .payload([&ENCAPSULATION[..], request].concat())
            .attachment(&attachment.encode()[..])
            .target(QueryTarget::AllComplete)
            .consolidation(ConsolidationMode::None)
            .timeout(TIMEOUT)
            .cancellation_token(token)
            .callback(move |reply| asked.receive(&reply));
        if let Err(error) = query.wait() {
            // Zenoh has dropped the callback, which ends the query as unanswered.
            tracing::warn!("{}: a request is not sent: {error}", self.key);
        }
    }
}

impl FarClient for Client {
    const IS_POLLED: bool = false;

    /// True: the relay creates the client only while another host has a server.
    fn is_available(&mut self) -> bool {
        true
    }

    /// None: Zenoh itself ends the queries of servers that have ended.
    fn set_servers(&mut self, _: &BTreeSet<ServerId>) -> Vec<RequestId> {
        Vec::new()
    }

    fn make_room(&mut self, is_waited_for: &dyn Fn(Gid) -> bool) -> (bool, Option<RequestId>) {
        self.pending.make_room(is_waited_for, Instant::now())
    }

    fn send(&mut self, id: RequestId, request: &RawSample) -> Result<(), String> {
        self.query(id, request.info().source_timestamp_ns, request.body());
        Ok(())
    }

    /// Of several servers, the first response counts.
    fn take(&mut self) -> Option<Response> {
        loop {
            let (number, reply) = match self.outcomes.pop()? {
                Outcome::Reply(number, payload) => (number, Some(payload)),
                Outcome::Unanswered(number) => (number, None),
            };
            let Some(id) = self.pending.remove(number) else { continue };
            return Some(match reply.as_ref().map(|payload| payload.to_bytes()) {
                Some(payload) => match body(&payload, self.max_bytes) {
                    Ok(body) => Response::Answer(id, body.to_vec()),
                    Err(reason) => Response::None(id, reason),
                },
                None => Response::None(id, "no answer".to_owned()),
            });
        }
    }

    fn forget(&mut self) -> usize {
        self.pending.clear()
    }
}

fn body(payload: &[u8], max_bytes: usize) -> Result<&[u8], String> {
    check_encapsulation(payload).map_err(|error| error.to_string())?;
    let body = payload.get(ENCAPSULATION.len()..).unwrap_or_default();
    if body.len() > max_bytes { Err(format!("more than {max_bytes} bytes")) } else { Ok(body) }
}
