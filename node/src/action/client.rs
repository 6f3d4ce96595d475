// SPDX-License-Identifier: MIT OR Apache-2.0
//! Action clients.

use super::goals::cancel_code;
use super::names::{FEEDBACK_DEPTH, Names, status_qos};
use crate::error::{Error, Result};
use crate::goal_state::{GoalStatus, SharedStatus};
use crate::node::Node;
use crate::service::Client;
use crate::subscription::Subscription;
use futures::channel::{mpsc, oneshot};
use futures::future::{AbortHandle, Abortable, BoxFuture, try_join3};
use futures::stream::FuturesUnordered;
use futures::{FutureExt, Stream, StreamExt, TryFutureExt};
use std::future::{Future, poll_fn, ready};
use std::sync::{Arc, Weak};
use std::task::{Context, Poll};
use tautline_executor::CallbackOptions;
use tautline_msgs::{Action, GoalId, Service};
use tautline_ros_msgs::action_msgs::msg::GoalStatusArray;
use tautline_ros_msgs::action_msgs::srv::CancelGoal;
use tautline_rt::PiMutex;
use tautline_transport::{Decode, MAX_PENDING_REQUESTS, ServiceCodec, ServiceError, SubscriptionCounters};
use uuid::Uuid;

/// How goals, results and feedback of an action are encoded. Every [`Action`] is its own codec.
pub trait ActionCodec: Sized + Send + Sync + 'static {
    /// The goal that a client sends.
    type Goal: Send;
    /// The result at the end of the goal.
    type Result: Send + 'static;
    /// The feedback while the goal is executed.
    type Feedback: Send + 'static;
    /// The feedback with the goal's id, as published.
    type FeedbackMessage: Decode;
    /// The service that sends a goal.
    type SendGoal: ServiceCodec<Error: Into<Error>>;
    /// The service that waits for the result.
    type GetResult: ServiceCodec<Error: Into<Error>>;

    /// The request that sends a goal.
    fn goal_request(id: GoalId, goal: Self::Goal) -> <Self::SendGoal as ServiceCodec>::Request;
    /// Whether the goal was accepted.
    ///
    /// # Errors
    /// The response is not valid for the type.
    fn is_accepted(response: <<Self::SendGoal as ServiceCodec>::Response as Decode>::Owned) -> Result<bool>;
    /// The request for the result.
    fn result_request(id: GoalId) -> <Self::GetResult as ServiceCodec>::Request;
    /// The response to it.
    fn take_result(
        response: <<Self::GetResult as ServiceCodec>::Response as Decode>::Owned,
    ) -> (GoalStatus, Self::Result);
    /// The goal of the feedback, and the feedback. `None` if it belongs to no goal.
    fn take_feedback(message: <Self::FeedbackMessage as Decode>::Owned) -> Option<(GoalId, Self::Feedback)>;
}

type Outcome<T> = (GoalStatus, <T as ActionCodec>::Result);
type ResultFuture<T> = BoxFuture<'static, Result<Outcome<T>>>;

impl<T: Action> ActionCodec for T {
    type Goal = T::Goal;
    type Result = T::Result;
    type Feedback = T::Feedback;
    type FeedbackMessage = T::FeedbackMessage;
    type SendGoal = T::SendGoal;
    type GetResult = T::GetResult;

    fn goal_request(id: GoalId, goal: T::Goal) -> <T::SendGoal as Service>::Request {
        T::make_goal_request_msg(id, goal)
    }

    fn is_accepted(response: <T::SendGoal as Service>::Response) -> Result<bool> {
        Ok(T::destructure_goal_response_msg(response).0)
    }

    fn result_request(id: GoalId) -> <T::GetResult as Service>::Request {
        T::make_result_request_msg(id)
    }

    fn take_result(response: <T::GetResult as Service>::Response) -> (GoalStatus, T::Result) {
        let (status, result) = T::destructure_result_response_msg(response);
        (GoalStatus::from_rcl(status), result)
    }

    fn take_feedback(message: T::FeedbackMessage) -> Option<(GoalId, T::Feedback)> {
        Some(T::destructure_feedback_msg(message))
    }
}

/// What an action client's handles share.
struct ActionClientState<P: ActionCodec> {
    name: String,
    send_goal: PiMutex<Client<P::SendGoal>>,
    get_result: PiMutex<Client<P::GetResult>>,
    /// Shared by all threads that have a clone of the action client or of a goal.
    cancel_goal: PiMutex<Client<CancelGoal::Service>>,
    goals: PiMutex<Vec<Goal<P>>>,
    /// Results to wait for. When it is closed, the listening thread ends.
    results: mpsc::UnboundedSender<ResultToCome>,
}

/// Completes with the goal, or when neither its result nor its feedback is awaited any more.
type ResultToCome = BoxFuture<'static, Option<GoalId>>;

/// A goal that was sent and is still in use.
struct Goal<P: ActionCodec> {
    id: GoalId,
    status: SharedStatus,
    /// Until the goal has ended.
    feedback: Option<mpsc::Sender<P::Feedback>>,
    /// Whether a warning was logged that feedback is lost because it is not read.
    is_warned: bool,
    /// Whether it occupies one of the slots for result requests: from before it is sent until its result has arrived, or until
    /// neither the result nor the feedback is awaited any more.
    has_place: bool,
    /// Number of live parts: its request, handles, result and feedback.
    held: usize,
}

impl<P: ActionCodec> ActionClientState<P> {
    /// Spawns the callback that receives feedback, status and results for a client.
    fn listen(
        node: &mut Node,
        shared: &Arc<Self>,
        messages: Subscription<P::FeedbackMessage>,
        requests: mpsc::UnboundedReceiver<ResultToCome>,
    ) -> Result<()> {
        let status = Names::of(&shared.name).status;
        let status = node.subscribe::<GoalStatusArray>(&status, status_qos())?.owned();
        let weak = Arc::downgrade(shared);
        let listening = Listening(weak.clone());
        let listen = async move {
            let _listening = listening;
            let mut lost = Lost { counters: messages.counters(), said: 0 };
            let feedback = messages.filter_map(|sample| ready(P::take_feedback(sample.to_owned())));
            let (mut feedback, mut status, mut requests) = (feedback.fuse(), status.fuse(), requests.fuse());
            let mut results = FuturesUnordered::new();
            loop {
                // Polled in random order, so that a flood of one input does not starve the others.
                futures::select! {
                    (id, feedback) = feedback.select_next_some() => {
                        let Some(shared) = weak.upgrade() else { return };
                        lost.warn(&shared.name);
                        shared.pass_on(id, feedback);
                    }
                    message = status.select_next_some() => {
                        let Some(shared) = weak.upgrade() else { return };
                        shared.note(&message);
                    }
                    result = requests.next() => match result {
                        Some(result) => results.push(result),
                        None => return,
                    },
                    ended = results.select_next_some() => {
                        let Some(shared) = weak.upgrade() else { return };
                        let Some(id) = ended else { continue };
                        // Feedback that was published before the goal's end is delivered before it: it is in the queue by now.
                        for _ in 0..FEEDBACK_DEPTH {
                            let Some(Some((id, feedback))) = feedback.next().now_or_never() else { break };
                            shared.pass_on(id, feedback);
                        }
                        lost.warn(&shared.name);
                        shared.end(id);
                    }
                }
            }
        };
        let options = CallbackOptions::other().name(format!("{}/_action client", shared.name));
        node.spawn_for_itself(options, listen).map(drop)
    }

    fn pass_on(&self, id: GoalId, feedback: P::Feedback) {
        let mut goals = self.goals.lock();
        let Some(goal) = goals.iter_mut().find(|goal| goal.id == id) else { return };
        let Some(sender) = &mut goal.feedback else { return };
        // Other errors: the stream was dropped.
        let is_full = sender.try_send(feedback).is_err_and(|error| error.is_full());
        if is_full && !goal.is_warned {
            goal.is_warned = true;
            tracing::warn!(
                "action '{}': nobody reads the feedback of a goal, of which {FEEDBACK_DEPTH} messages wait: what comes is lost \
                 until somebody does (drop the stream if it is not needed)",
                self.name
            );
        }
    }

    fn note(&self, message: &GoalStatusArray) {
        let mut goals = self.goals.lock();
        for message in &message.status_list {
            // An old message must not change a goal that has ended.
            let goal = goals.iter_mut().find(|goal| goal.id == message.goal_info.goal_id.uuid);
            if let Some(goal) = goal.filter(|goal| !goal.status.get().is_terminal()) {
                goal.status.set(GoalStatus::from_rcl(message.status));
            }
        }
    }

    /// Ends the feedback stream of this goal.
    fn end(&self, id: GoalId) {
        if let Some(goal) = self.goals.lock().iter_mut().find(|goal| goal.id == id) {
            goal.feedback = None;
        }
    }

    /// Sends a goal; the future yields its handle, the future of its result, and its feedback.
    fn send(
        self: &Arc<Self>,
        goal: P::Goal,
    ) -> Result<impl Future<Output = Result<Sent<P>>> + Send + use<P>> {
        let id = Uuid::new_v4().into_bytes();
        let (feedback, received) = mpsc::channel(FEEDBACK_DEPTH);
        // Before the goal is sent: the first feedback may be as fast as the response, and the result needs a slot for its request.
        let (status, feedback) = (SharedStatus::default(), Some(feedback));
        let goal_sent =
            Goal { id, status: status.clone(), feedback, is_warned: false, has_place: true, held: 1 };
        {
            let mut goals = self.goals.lock();
            if goals.iter().filter(|goal| goal.has_place).count() >= MAX_PENDING_REQUESTS {
                return Err(Error::TooManyGoals { action: self.name.clone(), max: MAX_PENDING_REQUESTS });
            }
            goals.push(goal_sent);
        }
        let held = GoalHandleState { id, status, shared: self.clone() };
        let response = self.send_goal.lock().request(&P::goal_request(id, goal))?;
        Ok(async move {
            if !P::is_accepted(response.await?)? {
                return Err(Error::GoalRejected { action: held.shared.name.clone() });
            }
            let response = held.shared.get_result.lock().request(&P::result_request(id));
            let response = response.map_err(|error| held.give_up(error))?;
            let result = response.map(|response| response.map(P::take_result));
            Ok(held.listen(result.boxed(), received))
        })
    }

    /// Requests the server to cancel a goal.
    fn cancel(&self, id: GoalId) -> Result<impl Future<Output = Result<()>> + Unpin + Send + use<P>> {
        let mut request = CancelGoal::Request::default();
        request.goal_info.goal_id.uuid = id;
        let response = self.cancel_goal.lock().request(&request)?;
        Ok(response.map(|response| match response?.return_code {
            cancel_code::NONE => Ok(()),
            cancel_code::UNKNOWN_GOAL_ID => Err(Error::GoalCancelUnknownGoalID),
            cancel_code::GOAL_TERMINATED => Err(Error::GoalCancelAlreadyTerminated),
            _ => Err(Error::GoalCancelRejected),
        }))
    }
}

/// Logs that feedback was lost before the client received it.
struct Lost {
    counters: Arc<SubscriptionCounters>,
    /// The number of lost messages at the last warning.
    said: u64,
}

impl Lost {
    /// Logs a warning when the number of lost messages has more than doubled since the last one.
    fn warn(&mut self, action: &str) {
        let lost = self.counters.lost();
        if lost > self.said.saturating_mul(2) {
            self.said = lost;
            tracing::warn!(
                "action '{action}': {lost} feedback messages were lost so far: they came faster than the thread that listens \
                 for them could take them; publish less of it"
            );
        }
    }
}

/// Exists while feedback and results are received: until the client, or its context, ends.
struct Listening<P: ActionCodec>(Weak<ActionClientState<P>>);

impl<P: ActionCodec> Drop for Listening<P> {
    fn drop(&mut self) {
        if let Some(shared) = self.0.upgrade() {
            shared.goals.lock().iter_mut().for_each(|goal| goal.feedback = None);
        }
    }
}

/// A goal's handle, the future of its result, its feedback.
type Sent<P> = (GoalHandleState<P>, GoalResult<P>, GoalFeedback<P>);

/// Keeps the state of a goal, and the task that listens for it.
struct GoalHandleState<P: ActionCodec> {
    id: GoalId,
    status: SharedStatus,
    shared: Arc<ActionClientState<P>>,
}

impl<P: ActionCodec> GoalHandleState<P> {
    /// Listens for the result and the feedback of a goal that was accepted.
    fn listen(self, response: ResultFuture<P>, received: mpsc::Receiver<P::Feedback>) -> Sent<P> {
        let (id, shared) = (self.id, self.shared.clone());
        let (sender, result) = oneshot::channel();
        let response = Arc::new(PiMutex::new(Some(response)));
        let (abort, registration) = AbortHandle::new_pair();
        // The task holds a weak reference: the handles of the result and of the feedback keep the client's state.
        let weak = Arc::downgrade(&shared);
        let awaited = response.clone();
        let deliver = async move {
            let result = poll_fn(|context| {
                let mut awaited = awaited.lock();
                // Without a response future, the task is about to be aborted.
                let Some(response) = &mut *awaited else { return Poll::Pending };
                let result = std::task::ready!(response.poll_unpin(context));
                *awaited = None;
                Poll::Ready(result)
            });
            let result = result.await;
            if let Some(shared) = weak.upgrade()
                && let Some(goal) = shared.goals.lock().iter_mut().find(|goal| goal.id == id)
            {
                goal.has_place = false;
                if let Ok((status, _)) = &result {
                    goal.status.set(*status);
                }
            }
            // Ignored: an error means that the result is not awaited.
            let _ = sender.send(result);
            id
        };
        let deliver = Abortable::new(deliver, registration).map(std::result::Result::ok);
        if shared.results.unbounded_send(deliver.boxed()).is_err() {
            // The context has ended, and with it the receiving callback.
            shared.end(id);
        }
        let wanted = Arc::new(GoalInterest { response, abort, held: self.clone() });
        let feedback = GoalFeedback { received, _wanted: wanted.clone() };
        (self, GoalResult { result, wanted }, feedback)
    }

    /// The error for a goal that was accepted, but whose result cannot be requested. The goal is cancelled, as its result would be lost.
    fn give_up(&self, error: Error) -> Error {
        // The response is not awaited: it arrives when the code that executes the goal has decided.
        let asked = self.shared.cancel(self.id).map(drop);
        let fate = match asked {
            Ok(()) => "its server was asked to cancel it".into(),
            Err(error) => format!("it goes on, for it cannot be cancelled either: {error}"),
        };
        Error::GoalUnheard { action: self.shared.name.clone(), fate, source: error.into() }
    }
}

impl<P: ActionCodec> Clone for GoalHandleState<P> {
    fn clone(&self) -> Self {
        if let Some(goal) = self.shared.goals.lock().iter_mut().find(|goal| goal.id == self.id) {
            goal.held += 1;
        }
        GoalHandleState { id: self.id, status: self.status.clone(), shared: self.shared.clone() }
    }
}

impl<P: ActionCodec> Drop for GoalHandleState<P> {
    fn drop(&mut self) {
        let mut goals = self.shared.goals.lock();
        if let Some(index) = goals.iter().position(|goal| goal.id == self.id) {
            goals[index].held -= 1;
            if goals[index].held == 0 {
                goals.swap_remove(index);
            }
        }
    }
}

/// Exists as long as a goal's result or feedback is awaited; then the slot of the result request is released.
struct GoalInterest<P: ActionCodec> {
    /// The result future, until the result has arrived.
    response: Arc<PiMutex<Option<ResultFuture<P>>>>,
    /// Ends the task that listens for it.
    abort: AbortHandle,
    held: GoalHandleState<P>,
}

impl<P: ActionCodec> Drop for GoalInterest<P> {
    fn drop(&mut self) {
        // Dropped first, so that a thread that finds a free slot by the count also finds one for its request.
        let response = self.response.lock().take();
        drop(response);
        self.abort.abort();
        if let Some(goal) = self.held.shared.goals.lock().iter_mut().find(|goal| goal.id == self.held.id) {
            goal.has_place = false;
        }
    }
}

struct GoalResult<P: ActionCodec> {
    result: oneshot::Receiver<Result<Outcome<P>>>,
    wanted: Arc<GoalInterest<P>>,
}

impl<P: ActionCodec> Future for GoalResult<P> {
    type Output = Result<Outcome<P>>;

    fn poll(mut self: std::pin::Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Self::Output> {
        self.result.poll_unpin(context).map(|result| {
            // The receiving callback has ended with the context.
            let gone =
                || ServiceError::ServerGone { service: self.wanted.held.shared.name.as_str().into() }.into();
            result.unwrap_or_else(|_| Err(gone()))
        })
    }
}

/// The feedback of a goal, until that has ended.
struct GoalFeedback<P: ActionCodec> {
    received: mpsc::Receiver<P::Feedback>,
    _wanted: Arc<GoalInterest<P>>,
}

impl<P: ActionCodec> Stream for GoalFeedback<P> {
    type Item = P::Feedback;

    fn poll_next(mut self: std::pin::Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        self.received.poll_next_unpin(context)
    }
}

/// Sends goals to an action's server. A clone is the same client.
pub struct ActionClient<T: ActionCodec> {
    shared: Arc<ActionClientState<T>>,
}

impl<T: ActionCodec> ActionClient<T> {
    pub(super) fn create(
        node: &mut Node,
        action: &str,
        send_goal: Client<T::SendGoal>,
        get_result: Client<T::GetResult>,
        feedback: Subscription<T::FeedbackMessage>,
    ) -> Result<Self> {
        let cancel_goal = node.create_client::<CancelGoal::Service>(&Names::of(action).cancel_goal)?;
        let (results, requests) = mpsc::unbounded();
        let shared = Arc::new(ActionClientState {
            name: action.to_owned(),
            send_goal: PiMutex::new(send_goal),
            get_result: PiMutex::new(get_result),
            cancel_goal: PiMutex::new(cancel_goal),
            goals: PiMutex::new(Vec::new()),
            results,
        });
        ActionClientState::listen(node, &shared, feedback, requests)?;
        Ok(ActionClient { shared })
    }

    /// Waits until each of the action's services has a server. The wait counts as a pending request of each service
    /// client.
    ///
    /// # Errors
    /// [`Error::Service`] if a client has no room for one more; of the future, if the client's node ends.
    pub fn wait_for_action_server(&self) -> Result<impl Future<Output = Result<()>> + Unpin + Send + use<T>> {
        let ActionClientState { send_goal, get_result, cancel_goal, .. } = &*self.shared;
        let send_goal = send_goal.lock().wait_for_service()?;
        let get_result = get_result.lock().wait_for_service()?;
        let cancel_goal = cancel_goal.lock().wait_for_service()?;
        Ok(try_join3(send_goal, get_result, cancel_goal).map_ok(drop))
    }

    /// Sends a goal. If the server accepts it, the future yields the goal's handle, a future of its result, and a stream of its feedback,
    /// which ends with the goal. Up to 1000 feedback messages of the goal are queued for the reader, and up to 1000 of the whole server for
    /// the client's listening thread; further messages are lost, with a warning.
    ///
    /// A client can have 64 goals at once whose result or feedback is awaited ([`MAX_PENDING_REQUESTS`]). A goal's slot is
    /// released when both are dropped, or when the goal ends.
    ///
    /// # Errors
    /// [`Error::TooManyGoals`]: nothing was sent; [`Error::Service`]: there is no server. Errors of the future:
    /// [`Error::GoalRejected`]; [`Error::Service`] if the server ends; [`Error::GoalUnheard`] if the result cannot be requested.
    #[allow(clippy::type_complexity, reason = "a future of a goal, its result and its feedback")]
    pub fn send_goal_request(
        &self,
        goal: T::Goal,
    ) -> Result<
        impl Future<
            Output = Result<(
                ActionClientGoal<T>,
                impl Future<Output = Result<(GoalStatus, T::Result)>> + Unpin + Send + use<T>,
                impl Stream<Item = T::Feedback> + Unpin + Send + use<T>,
            )>,
        > + Send
        + use<T>,
    > {
        let sent = self.shared.send(goal)?;
        Ok(async move {
            let (held, result, feedback) = sent.await?;
            Ok((ActionClientGoal { uuid: Uuid::from_bytes(held.id), held }, result, feedback))
        })
    }
}

/// A goal that was accepted. A clone is the same goal.
pub struct ActionClientGoal<T: ActionCodec> {
    /// The goal's id.
    pub uuid: Uuid,
    held: GoalHandleState<T>,
}

impl<T: ActionCodec> ActionClientGoal<T> {
    /// The last known status of the goal.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    pub fn status(&self) -> GoalStatus {
        self.held.status.get()
    }

    /// Requests the server to cancel the goal. The future ends when the server has decided.
    ///
    /// # Real-time
    /// As [`Client::request`](crate::Client::request): plus a lock with priority inheritance, which only threads take that cancel goals of
    /// the same action client.
    ///
    /// # Errors
    /// [`Error::Service`]: there is no server. Errors of the future: [`Error::GoalCancelRejected`],
    /// [`Error::GoalCancelUnknownGoalID`], [`Error::GoalCancelAlreadyTerminated`].
    pub fn cancel(&self) -> Result<impl Future<Output = Result<()>> + Unpin + Send + use<T>> {
        self.held.shared.cancel(self.held.id)
    }
}

impl<T: ActionCodec> Clone for ActionClient<T> {
    fn clone(&self) -> Self {
        ActionClient { shared: self.shared.clone() }
    }
}

impl<T: ActionCodec> Clone for ActionClientGoal<T> {
    fn clone(&self) -> Self {
        ActionClientGoal { uuid: self.uuid, held: self.held.clone() }
    }
}

tautline_rt::debug_fields!(
    [T: ActionCodec] ActionClient<T>, |this| action = this.shared.name, goals = this.shared.goals.lock().len()
);

tautline_rt::debug_fields!([T: ActionCodec] ActionClientGoal<T>, |this| uuid = this.uuid);
