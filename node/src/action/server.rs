// SPDX-License-Identifier: MIT OR Apache-2.0
//! Action servers.

use super::goals::{Goals, MAX_WAITING, ResultOf, Stamp, cancel_code};
use super::names::{Names, qos, status_qos};
use crate::error::{Error, Result};
use crate::goal_state::{GoalEvent, GoalStatus, SharedStatus};
use crate::node::Node;
use crate::service::{Reply, ServiceRequest};
use futures::channel::{mpsc, oneshot};
use futures::future::{Either, Shared, select};
use futures::stream::FuturesUnordered;
use futures::{FutureExt, Stream, StreamExt};
use std::sync::Arc;
use std::time::Duration;
use tautline_executor::CallbackOptions;
use tautline_msgs::cdr::Endian;
use tautline_msgs::{Action, GoalId, Message, Service};
use tautline_ros_msgs::action_msgs::msg::{GoalInfo, GoalStatus as StatusMsg, GoalStatusArray};
use tautline_ros_msgs::action_msgs::srv::CancelGoal;
use tautline_rt::PiMutex;
use tautline_rt::clock::monotonic_ns;
use tautline_sampler::GuardCondition;
use tautline_transport::Publisher;
use uuid::Uuid;

/// Settings of an action server.
#[derive(Clone, Debug)]
pub struct ActionServerOptions {
    /// How long results of ended goals are kept, and how long these goals stay in the action's status: 10 seconds by
    /// default, as in ROS 2.
    pub result_timeout: Duration,
    /// The options of the thread that responds: ordinary priority by default.
    pub callback: CallbackOptions,
}

impl Default for ActionServerOptions {
    fn default() -> Self {
        ActionServerOptions { result_timeout: Duration::from_secs(10), callback: CallbackOptions::other() }
    }
}

/// Goals that wait to be decided on; more are rejected.
const GOALS_WAITING: usize = 1000;
/// Requests to cancel that wait for a decision; more are rejected.
const CANCELS_WAITING: usize = 1000;

type ResultResponse<T> = <<T as Action>::GetResult as Service>::Response;
type ResultReply<T> = Reply<<T as Action>::GetResult>;

/// The state that the goals of a server share with the responding thread.
struct Server<T: Action> {
    name: String,
    /// The clock for the goals' stamps, and for cancel requests by time.
    now: Box<dyn Fn() -> Stamp + Send + Sync>,
    /// Never held while something is published.
    state: PiMutex<ServerState<T>>,
    /// Locked by threads that execute goals, never by the responding thread.
    feedback: PiMutex<Publisher<T::FeedbackMessage>>,
    /// Held while the status of all goals is collected and published, so that the newest status is published last. Taken
    /// before `state`.
    status_of_all: PiMutex<Publisher<GoalStatusArray>>,
}

/// Held by the stream of goals and by the goals: without them, the responding thread ends.
struct User<T: Action> {
    server: Arc<Server<T>>,
    end: GuardCondition,
}

impl<T: Action> Drop for User<T> {
    fn drop(&mut self) {
        self.end.trigger();
    }
}

struct ServerState<T: Action> {
    goals: Goals<ResultReply<T>>,
    /// Entries of the goals that have not ended.
    cancels: Vec<Cancels>,
}

/// The destination of requests to cancel a goal.
struct Cancels {
    goal: GoalId,
    requests: mpsc::Sender<ActionServerCancelRequest>,
    /// The decision on the cancel request that was last delivered: all clients that request before the decision share
    /// it.
    decision: Option<Shared<oneshot::Receiver<bool>>>,
    /// Dropped with this entry: a request that is undecided by then is rejected.
    _end: oneshot::Sender<()>,
    ended: Shared<oneshot::Receiver<()>>,
}

impl<T: Action> Server<T> {
    /// Applies an event to a goal and publishes the new status.
    fn apply(&self, id: GoalId, event: GoalEvent) -> Result<GoalStatus> {
        let happened = self.state.lock().goals.apply(id, event);
        let status = happened.map_err(|status| self.goal_error(id, status))?;
        self.publish_status();
        Ok(status)
    }

    fn goal_error(&self, id: GoalId, status: GoalStatus) -> Error {
        Error::Goal { action: self.name.clone(), goal: Uuid::from_bytes(id).to_string(), status }
    }

    fn finish(&self, id: GoalId, event: GoalEvent, result: T::Result) -> Result<()> {
        let before = self.state.lock().goals.status(id);
        // Whatever happens meanwhile, the event leads to this status, or cannot happen.
        let status = before.after(event).ok_or_else(|| self.goal_error(id, before))?;
        let response = T::make_result_response_msg(status.to_rcl(), result);
        let mut body = vec![0; response.cdr_len()];
        response.encode(&mut body).map_err(|error| Error::Publish(error.into()))?;
        let waiting = {
            let mut state = self.state.lock();
            state.goals.apply(id, event).map_err(|status| self.goal_error(id, status))?;
            state.cancels.retain(|cancels| cancels.goal != id);
            state.goals.finish(id, body.clone(), monotonic_ns())
        };
        self.publish_status();
        waiting.into_iter().for_each(|reply| respond::<T>(reply, &body));
        Ok(())
    }

    /// Responds to a request for a result, now or when the goal has one.
    fn answer(&self, request: ServiceRequest<T::GetResult>) {
        let (message, reply) = request.into_parts();
        let id = T::destructure_result_request_msg(message);
        let asked = self.state.lock().goals.request_result(id, reply, Reply::is_awaited);
        match asked {
            ResultOf::Later => {}
            ResultOf::Known(reply, body) => respond::<T>(reply, &body),
            ResultOf::Unknown(reply) => self.answer_unknown(reply),
            ResultOf::TooMany(reply) => {
                tracing::warn!(
                    "action '{}': {MAX_WAITING} requests wait for the result of one goal: a further request gets the status unknown",
                    self.name
                );
                self.answer_unknown(reply);
            }
        }
    }

    fn answer_unknown(&self, reply: ResultReply<T>) {
        let response = T::make_result_response_msg(GoalStatus::Unknown.to_rcl(), T::Result::default());
        if let Err(error) = reply.respond(&response) {
            tracing::warn!("{error}");
        }
    }

    /// Publishes the status of all goals. Not called under the lock of the state, which goals' handles take.
    fn publish_status(&self) {
        let publisher = self.status_of_all.lock();
        let status = |(id, accepted, status): (GoalId, Stamp, GoalStatus)| StatusMsg {
            goal_info: goal_info(id, accepted),
            status: status.to_rcl(),
        };
        let message = GoalStatusArray { status_list: self.state.lock().goals.all().map(status).collect() };
        if let Err(error) = publisher.publish(&message) {
            tracing::warn!("{}: {error}", publisher.topic());
        }
    }
}

fn goal_info(id: GoalId, (sec, nanosec): Stamp) -> GoalInfo {
    let mut info = GoalInfo::default();
    info.goal_id.uuid = id;
    (info.stamp.sec, info.stamp.nanosec) = (sec, nanosec);
    info
}

/// Sends a response that was encoded when the goal ended.
fn respond<T: Action>(reply: ResultReply<T>, body: &[u8]) {
    let response = ResultResponse::<T>::decode(body, Endian::Little);
    let responded = match response {
        Ok(response) => reply.respond(&response).map_err(|error| error.to_string()),
        Err(error) => Err(error.to_string()),
    };
    if let Err(error) = responded {
        tracing::warn!("a goal's result was not delivered: {error}");
    }
}

/// Returns a function that reads the node's clock, which is the system's in a build without simulated time.
fn clock(node: &Node) -> Box<dyn Fn() -> Stamp + Send + Sync> {
    #[cfg(feature = "rosgraph_msgs")]
    let now_ns = {
        let clock = node.clock();
        move || clock.now_ns()
    };
    #[cfg(not(feature = "rosgraph_msgs"))]
    let (_, now_ns) = (node, tautline_rt::clock::wall_ns);
    Box::new(move || {
        let now = Duration::from_nanos(u64::try_from(now_ns()).unwrap_or_default());
        (i32::try_from(now.as_secs()).unwrap_or(i32::MAX), now.subsec_nanos())
    })
}

pub(super) fn create<T: Action>(
    node: &mut Node,
    action: &str,
    options: ActionServerOptions,
) -> Result<impl Stream<Item = ActionServerGoalRequest<T>> + Unpin + Send + use<T>> {
    let names = Names::of(action);
    let feedback = node.create_publisher(&names.feedback, qos())?;
    let status = node.create_publisher(&names.status, status_qos())?;
    let mut send_goal = node.create_service::<T::SendGoal>(&names.send_goal, qos())?.owned().fuse();
    let mut cancel_goal =
        node.create_service::<CancelGoal::Service>(&names.cancel_goal, qos())?.owned().fuse();
    let mut get_result = node.create_service::<T::GetResult>(&names.get_result, qos())?.owned().fuse();
    let period = options.result_timeout.clamp(Duration::from_millis(1), Duration::from_secs(1));
    let mut expiry = node.create_wall_timer(period)?.fuse();
    let end = node.context.events().guard_condition()?;
    let mut ends = {
        let mut end = end.clone();
        futures::stream::poll_fn(move |context| end.poll_triggered(context).map(Some)).fuse()
    };
    let state = ServerState { goals: Goals::new(options.result_timeout), cancels: Vec::new() };
    let server = Arc::new(Server {
        name: action.to_owned(),
        now: clock(node),
        state: PiMutex::new(state),
        feedback: PiMutex::new(feedback),
        status_of_all: PiMutex::new(status),
    });
    let user = Arc::new(User { server: server.clone(), end });
    let (mut goals, requests) = mpsc::channel(GOALS_WAITING);
    let users = Arc::downgrade(&user);
    let answer = async move {
        let mut cancels = FuturesUnordered::new();
        loop {
            futures::select! {
                // `None`: the node has ended, and no request can arrive any more.
                request = send_goal.next() => match users.upgrade().zip(request) {
                    Some((user, request)) => offer(&user, &mut goals, request),
                    None => break,
                },
                request = cancel_goal.select_next_some() => match cancels.len() {
                    ..CANCELS_WAITING => cancels.push(ask_to_cancel(&server, request)),
                    _ => answer_cancel(request, cancel_code::REJECTED, Vec::new()),
                },
                () = cancels.select_next_some() => {}
                request = get_result.select_next_some() => server.answer(request),
                _ = expiry.select_next_some() => {
                    let any = server.state.lock().goals.expire(monotonic_ns());
                    if any {
                        server.publish_status();
                    }
                }
                () = ends.select_next_some() => if users.strong_count() == 0 { break },
            }
        }
        drop((goals, send_goal));
        // Requests that have arrived by now still get a response: no goal is left.
        while let Some(Some(request)) = cancel_goal.next().now_or_never() {
            cancels.push(ask_to_cancel(&server, request));
        }
        while let Some(()) = cancels.next().await {}
        while let Some(Some(request)) = get_result.next().now_or_never() {
            server.answer(request);
        }
    };
    node.spawn_for_itself(options.callback.name(format!("{action}/_action")), answer)?;
    // The stream keeps the server alive.
    Ok(requests.inspect(move |_| {
        let _ = &user;
    }))
}

/// Queues a goal in the stream for a decision; if the stream was dropped or is full, the goal is rejected.
fn offer<T: Action>(
    user: &Arc<User<T>>,
    goals: &mut mpsc::Sender<ActionServerGoalRequest<T>>,
    request: ServiceRequest<T::SendGoal>,
) {
    let (message, reply) = request.into_parts();
    let (id, goal) = T::destructure_goal_request_msg(message);
    let decision = Decision::<T> { reply: Some(reply) };
    let request = ActionServerGoalRequest { uuid: Uuid::from_bytes(id), goal, decision, user: user.clone() };
    // A request that is not queued is dropped, and thereby rejected.
    let _ = goals.try_send(request);
}

/// Requests a decision for each of the goals, unless one is pending, and responds when all are decided.
fn ask_to_cancel<T: Action>(
    server: &Arc<Server<T>>,
    request: ServiceRequest<CancelGoal::Service>,
) -> impl Future<Output = ()> + use<T> {
    let info = &request.message.goal_info;
    let mut state = server.state.lock();
    let state = &mut *state;
    let (goals, code) = state.goals.to_cancel(info.goal_id.uuid, (info.stamp.sec, info.stamp.nanosec));
    let asked = goals.iter().filter_map(|&id| {
        // Each goal that can be cancelled has an entry.
        let cancels = state.cancels.iter_mut().find(|cancels| cancels.goal == id)?;
        let undecided = cancels.decision.take().filter(|decision| decision.peek().is_none());
        let decision = undecided.unwrap_or_else(|| {
            let (sender, decision) = oneshot::channel();
            let weak = Arc::downgrade(server);
            let request = ActionServerCancelRequest {
                uuid: Uuid::from_bytes(id),
                accept: Box::new(move || {
                    weak.upgrade().is_some_and(|server| server.apply(id, GoalEvent::CancelGoal).is_ok())
                }),
                decision: sender,
            };
            // A request that is not queued is dropped, and thereby rejected.
            let _ = cancels.requests.try_send(request);
            decision.shared()
        });
        cancels.decision = Some(decision.clone());
        let info = goal_info(id, state.goals.accepted(id));
        let decided = select(decision, cancels.ended.clone());
        Some(decided.map(move |first| (info, matches!(first, Either::Left((Ok(true), _))))))
    });
    let asked = futures::future::join_all(asked.collect::<Vec<_>>());
    asked.map(move |decisions| {
        let any = !decisions.is_empty();
        let canceling = decisions.into_iter().filter(|(_, accepted)| *accepted);
        let goals_canceling: Vec<_> = canceling.map(|(info, _)| info).collect();
        let return_code = if any && goals_canceling.is_empty() { cancel_code::REJECTED } else { code };
        answer_cancel(request, return_code, goals_canceling);
    })
}

fn answer_cancel(
    request: ServiceRequest<CancelGoal::Service>,
    return_code: i8,
    goals_canceling: Vec<GoalInfo>,
) {
    if let Err(error) = request.respond(CancelGoal::Response { return_code, goals_canceling }) {
        tracing::warn!("{error}");
    }
}

/// A request to cancel a goal. Dropping it rejects it.
pub struct ActionServerCancelRequest {
    /// The goal's id.
    pub uuid: Uuid,
    accept: Box<dyn FnOnce() -> bool + Send>,
    decision: oneshot::Sender<bool>,
}

impl ActionServerCancelRequest {
    /// Accepts: the goal is being cancelled from now on, and should end with [`ActionServerGoal::cancel`]. If the goal has ended
    /// meanwhile, it stays ended, and the clients are informed that it is not cancelled.
    pub fn accept(self) {
        let accepted = (self.accept)();
        // Ignored: an error means that no client waits for the decision.
        let _ = self.decision.send(accepted);
    }

    /// Rejects: the goal continues.
    pub fn reject(self) {
        let _ = self.decision.send(false);
    }
}

/// The decision for the client that sent a goal. Dropping it rejects the goal.
struct Decision<T: Action> {
    reply: Option<Reply<T::SendGoal>>,
}

impl<T: Action> Decision<T> {
    fn respond(&mut self, accepted: bool, stamp: Stamp) -> Result<()> {
        let Some(reply) = self.reply.take() else { return Ok(()) };
        reply.respond(&T::make_goal_response_msg(accepted, stamp))
    }
}

impl<T: Action> Drop for Decision<T> {
    fn drop(&mut self) {
        if let Err(error) = self.respond(false, (0, 0)) {
            tracing::warn!("{error}");
        }
    }
}

/// A goal that a client sent, to be accepted or rejected. Dropping it rejects it.
pub struct ActionServerGoalRequest<T: Action> {
    /// The goal's id.
    pub uuid: Uuid,
    /// The goal.
    pub goal: T::Goal,
    decision: Decision<T>,
    user: Arc<User<T>>,
}

impl<T: Action> ActionServerGoalRequest<T> {
    /// Accepts the goal: it is executing from now on. Returns a handle to it and a stream of requests to cancel it, which ends
    /// with the goal. Until a request is decided on, the stream yields no other: all clients that request meanwhile get the same
    /// response.
    ///
    /// # Real-time
    /// Allocates, and waits while other threads, including the responding thread, change goals or publish their
    /// status.
    ///
    /// # Errors
    /// [`Error::Goal`] if there is already a goal with this id; [`Error::Service`] if the client cannot be
    /// informed.
    pub fn accept(
        mut self,
    ) -> Result<(ActionServerGoal<T>, impl Stream<Item = ActionServerCancelRequest> + Unpin + Send + use<T>)>
    {
        let server = &self.user.server;
        let (id, stamp) = (self.uuid.into_bytes(), (server.now)());
        // Room for one undecided request, and for one that was decided on meanwhile.
        let (requests, cancel_requests) = mpsc::channel(1);
        let (end, ended) = oneshot::channel();
        let mut state = server.state.lock();
        let status = state.goals.accept(id, stamp).map_err(|status| server.goal_error(id, status))?;
        state.cancels.push(Cancels { goal: id, requests, decision: None, _end: end, ended: ended.shared() });
        drop(state);
        let pursued = Arc::new(Pursued { id, status, user: self.user.clone() });
        self.user.server.apply(id, GoalEvent::Execute)?;
        self.decision.respond(true, stamp)?;
        Ok((ActionServerGoal { uuid: self.uuid, goal: self.goal, pursued }, cancel_requests))
    }

    /// Rejects the goal.
    ///
    /// # Errors
    /// [`Error::Service`] if the client cannot be informed.
    pub fn reject(mut self) -> Result<()> {
        self.decision.respond(false, (0, 0))
    }
}

/// A goal that was accepted. If the last clone is dropped before the goal has a result, the goal ends without one: as
/// cancelled if it was being cancelled, otherwise as aborted.
pub struct ActionServerGoal<T: Action> {
    /// The goal's id.
    pub uuid: Uuid,
    /// The goal.
    pub goal: T::Goal,
    pursued: Arc<Pursued<T>>,
}

/// Exists as long as a handle of an accepted goal does.
struct Pursued<T: Action> {
    id: GoalId,
    status: SharedStatus,
    user: Arc<User<T>>,
}

impl<T: Action> Drop for Pursued<T> {
    fn drop(&mut self) {
        let event = match self.status.get() {
            GoalStatus::Canceling => GoalEvent::Canceled,
            GoalStatus::Executing => GoalEvent::Abort,
            _ => return,
        };
        // Ignored: the goal cannot have ended, because only its handles can end it.
        let _ = self.user.server.finish(self.id, event, T::Result::default());
    }
}

/// Ending a goal allocates, and waits while other threads, including the responding thread, change goals or publish their status: for
/// ordinary priorities, or at the end of real-time work.
impl<T: Action> ActionServerGoal<T> {
    /// Whether a request to cancel this goal was accepted.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    pub fn is_cancelling(&self) -> bool {
        self.pursued.status.get() == GoalStatus::Canceling
    }

    /// Publishes feedback to all clients; the client of this goal delivers it.
    ///
    /// # Real-time
    /// Takes a lock with priority inheritance, which only threads take that publish feedback of this action. The message's strings and
    /// sequences are copied, and freed.
    ///
    /// # Errors
    /// [`Error::Goal`] if the goal has ended; [`Error::Publish`].
    pub fn publish_feedback(&self, msg: T::Feedback) -> Result<()> {
        let Pursued { id, status, user } = &*self.pursued;
        let server = &user.server;
        match status.get() {
            GoalStatus::Executing | GoalStatus::Canceling => {
                let message = T::make_feedback_msg(*id, msg);
                Ok(server.feedback.lock().publish(&message)?)
            }
            status => Err(server.goal_error(*id, status)),
        }
    }

    /// Ends the goal as cancelled, after a cancel request was accepted.
    ///
    /// # Errors
    /// [`Error::Goal`] if it is not being cancelled.
    pub fn cancel(&mut self, msg: T::Result) -> Result<()> {
        self.pursued.user.server.finish(self.pursued.id, GoalEvent::Canceled, msg)
    }

    /// Ends the goal as aborted.
    ///
    /// # Errors
    /// [`Error::Goal`] if it has ended.
    pub fn abort(&mut self, msg: T::Result) -> Result<()> {
        self.pursued.user.server.finish(self.pursued.id, GoalEvent::Abort, msg)
    }

    /// Ends the goal as succeeded.
    ///
    /// # Errors
    /// [`Error::Goal`] if it has ended.
    pub fn succeed(&mut self, msg: T::Result) -> Result<()> {
        self.pursued.user.server.finish(self.pursued.id, GoalEvent::Succeed, msg)
    }
}

impl<T: Action> Clone for ActionServerGoal<T>
where
    T::Goal: Clone,
{
    fn clone(&self) -> Self {
        ActionServerGoal { uuid: self.uuid, goal: self.goal.clone(), pursued: self.pursued.clone() }
    }
}

tautline_rt::debug_fields!(ActionServerCancelRequest, |this| uuid = this.uuid);

tautline_rt::debug_fields!([T: Action] ActionServerGoalRequest<T>, |this| uuid = this.uuid);

tautline_rt::debug_fields!([T: Action] ActionServerGoal<T>, |this| uuid = this.uuid);
