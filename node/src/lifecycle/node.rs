// SPDX-License-Identifier: MIT OR Apache-2.0

use crate::context::Context;
use crate::error::Result;
use crate::node::Node;
use crate::state_machine::{CallbackReturn, LifecycleError, State, StateMachine, Transition};
use std::ops::{Deref, DerefMut};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicU8, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, TryLockError};
use tautline_msgs::Message;
use tautline_ros_msgs::lifecycle_msgs::msg;
use tautline_rt::clock::wall_ns;
use tautline_transport::{Gate, Publisher, Qos};

/// The callbacks of a managed node's transitions. A callback that is not implemented succeeds, except `on_error`, which
/// fails: the node is then finalized. A callback that panics counts as an error.
pub trait LifecycleCallbacks: Send + 'static {
    /// Creates what the node needs: publishers, subscriptions, timers.
    fn on_configure(&mut self, node: &mut ManagedNode) -> CallbackReturn {
        let _ = node;
        CallbackReturn::Success
    }

    /// Begins to work. Publishers send once this has succeeded.
    fn on_activate(&mut self, node: &mut ManagedNode) -> CallbackReturn {
        let _ = node;
        CallbackReturn::Success
    }

    /// Ends working. Publishers are silent already.
    fn on_deactivate(&mut self, node: &mut ManagedNode) -> CallbackReturn {
        let _ = node;
        CallbackReturn::Success
    }

    /// Undoes what `on_configure` did.
    fn on_cleanup(&mut self, node: &mut ManagedNode) -> CallbackReturn {
        let _ = node;
        CallbackReturn::Success
    }

    /// Ends for good, from the state `previous`.
    fn on_shutdown(&mut self, node: &mut ManagedNode, previous: State) -> CallbackReturn {
        let _ = (node, previous);
        CallbackReturn::Success
    }

    /// Clears up after a callback's error. `previous` is the state before the transition that failed, as in rclcpp. Success leads back to
    /// unconfigured.
    fn on_error(&mut self, node: &mut ManagedNode, previous: State) -> CallbackReturn {
        let _ = (node, previous);
        CallbackReturn::Failure
    }
}

/// The inner node of a managed node, for its callbacks: a [`Node`] whose publishers can be silenced.
pub struct ManagedNode {
    node: Node,
    gate: Gate,
}

impl ManagedNode {
    /// Creates a publisher that sends while the node is active. While the node is not active, publishing succeeds, costs an
    /// atomic load, and is counted by [`PublisherCounters::silenced`](crate::PublisherCounters::silenced).
    /// [`Node::create_publisher`] of the underlying node creates a publisher that always sends.
    ///
    /// # Errors
    /// As [`Node::create_publisher`].
    pub fn create_publisher<T: Message>(&mut self, topic: &str, qos: Qos) -> Result<Publisher<T>> {
        Ok(self.gate.guard(self.node.create_publisher(topic, qos)?))
    }

    /// Like [`create_publisher`](Self::create_publisher), for a type that is known by name.
    ///
    /// # Errors
    /// As [`Node::create_publisher_untyped`].
    #[cfg(feature = "untyped")]
    pub fn create_publisher_untyped(
        &mut self,
        topic: &str,
        topic_type: &str,
        qos: Qos,
    ) -> Result<Publisher<crate::Json>> {
        let publisher = self.node.create_publisher_untyped(topic, topic_type, qos)?;
        Ok(self.gate.guard(publisher))
    }
}

impl Deref for ManagedNode {
    type Target = Node;

    fn deref(&self) -> &Node {
        &self.node
    }
}

impl DerefMut for ManagedNode {
    fn deref_mut(&mut self) -> &mut Node {
        &mut self.node
    }
}

/// The result of a transition.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Transitioned {
    /// What its callback returned.
    pub result: CallbackReturn,
    /// The node's new state.
    pub state: State,
}

/// A node with ROS 2's lifecycle. A clone is the same node. Transitions may be requested in any thread, and through the node's
/// services as long as [`serve`](LifecycleNode::serve) is polled. Each change of state is published on `~/transition_event`.
///
/// ```
/// use tautline::lifecycle::{CallbackReturn, LifecycleCallbacks, LifecycleNode, ManagedNode, State};
/// # use tautline::{Context, Message, Publisher, Qos, Realtime};
/// # #[derive(Message, Clone, Copy)] #[repr(C)] #[message(name = "demo_msgs/msg/Speed")] struct Speed { v: f64 }
///
/// #[derive(Default)]
/// struct Drive { speed: Option<Publisher<Speed>> }
///
/// impl LifecycleCallbacks for Drive {
///     fn on_configure(&mut self, node: &mut ManagedNode) -> CallbackReturn {
///         self.speed = node.create_publisher("~/speed", Qos::default()).ok();
///         if self.speed.is_some() { CallbackReturn::Success } else { CallbackReturn::Failure }
///     }
/// }
///
/// # let ctx = Context::builder().domain(217).realtime(Realtime::Off).build()?;
/// let node = LifecycleNode::create(ctx, "drive", "", Drive::default())?;
/// assert_eq!(node.configure()?.state, State::Inactive);
/// assert_eq!(node.activate()?.state, State::Active);
/// assert!(node.cleanup().is_err()); // not while it is active
/// # Ok::<(), tautline::Error>(())
/// ```
#[derive(Clone)]
pub struct LifecycleNode {
    shared: Arc<LifecycleState>,
}

struct LifecycleState {
    inner: Mutex<Inner>,
    /// A copy of the machine's state, readable while a callback runs.
    state: AtomicU8,
}

struct Inner {
    node: ManagedNode,
    machine: StateMachine,
    callbacks: Box<dyn LifecycleCallbacks>,
    events: Publisher<msg::TransitionEvent>,
}

impl LifecycleNode {
    /// Creates a node in state unconfigured.
    ///
    /// # Errors
    /// As [`Node::create`]; [`Error::Transport`](crate::Error::Transport) if the topic of its transitions cannot be
    /// created.
    pub fn create(
        ctx: Context,
        name: &str,
        namespace: &str,
        callbacks: impl LifecycleCallbacks,
    ) -> Result<LifecycleNode> {
        LifecycleNode::of_node(Node::create(ctx, name, namespace)?, callbacks)
    }

    /// Creates a managed node from a node that was created with options, or by a container for a component.
    ///
    /// # Errors
    /// [`Error::Transport`](crate::Error::Transport) if the topic of its transitions cannot be created.
    pub fn of_node(mut node: Node, callbacks: impl LifecycleCallbacks) -> Result<LifecycleNode> {
        let events = node.create_publisher("~/transition_event", Qos::default())?;
        let (machine, gate) = (StateMachine::new(), Gate::new());
        let state = AtomicU8::new(machine.state().id());
        let (node, callbacks) = (ManagedNode { node, gate }, Box::new(callbacks));
        let inner = Mutex::new(Inner { node, machine, callbacks, events });
        Ok(LifecycleNode { shared: Arc::new(LifecycleState { inner, state }) })
    }

    /// The node's state. May be called in a callback.
    ///
    /// # Real-time
    /// Wait-free; no syscall.
    pub fn state(&self) -> State {
        State::from_id(self.shared.state.load(Ordering::Acquire)).unwrap_or(State::Unconfigured)
    }

    /// Runs `on_configure`.
    ///
    /// # Errors
    /// [`LifecycleError`]; the state does not change.
    pub fn configure(&self) -> Result<Transitioned, LifecycleError> {
        self.change_state_by_label("configure")
    }

    /// Runs `on_activate`.
    ///
    /// # Errors
    /// As [`configure`](Self::configure).
    pub fn activate(&self) -> Result<Transitioned, LifecycleError> {
        self.change_state_by_label("activate")
    }

    /// Runs `on_deactivate`.
    ///
    /// # Errors
    /// As [`configure`](Self::configure).
    pub fn deactivate(&self) -> Result<Transitioned, LifecycleError> {
        self.change_state_by_label("deactivate")
    }

    /// Runs `on_cleanup`.
    ///
    /// # Errors
    /// As [`configure`](Self::configure).
    pub fn cleanup(&self) -> Result<Transitioned, LifecycleError> {
        self.change_state_by_label("cleanup")
    }

    /// Runs `on_shutdown`, from any state.
    ///
    /// # Errors
    /// As [`configure`](Self::configure).
    pub fn shutdown(&self) -> Result<Transitioned, LifecycleError> {
        self.change_state_by_label("shutdown")
    }

    /// Performs the transition with this number, as in `lifecycle_msgs/msg/Transition`.
    ///
    /// # Errors
    /// As [`configure`](Self::configure).
    pub fn change_state(&self, id: u8) -> Result<Transitioned, LifecycleError> {
        let mut inner = self.try_lock()?;
        let transition = inner.machine.begin(id)?;
        Ok(inner.run(transition, &self.shared.state))
    }

    /// Performs the transition with this name.
    ///
    /// # Errors
    /// As [`configure`](Self::configure).
    pub fn change_state_by_label(&self, label: &str) -> Result<Transitioned, LifecycleError> {
        let mut inner = self.try_lock()?;
        let transition = inner.machine.begin_by_label(label)?;
        Ok(inner.run(transition, &self.shared.state))
    }

    /// The transitions that can be requested now; while a callback runs, those to which its result can lead.
    pub fn available_transitions(&self) -> Vec<Transition> {
        Transition::from(self.state()).collect()
    }

    /// Calls a function with the inner node, if no callback of a transition is running.
    ///
    /// # Errors
    /// [`LifecycleError::Busy`].
    pub fn with_node<R>(&self, action: impl FnOnce(&mut ManagedNode) -> R) -> Result<R, LifecycleError> {
        Ok(action(&mut self.try_lock()?.node))
    }

    fn try_lock(&self) -> Result<MutexGuard<'_, Inner>, LifecycleError> {
        match self.shared.inner.try_lock() {
            Ok(inner) => Ok(inner),
            Err(TryLockError::Poisoned(poisoned)) => Ok(poisoned.into_inner()),
            Err(TryLockError::WouldBlock) => Err(LifecycleError::Busy { state: self.state() }),
        }
    }
}

impl Inner {
    /// Runs the callback of a transition that has begun, and that of an error.
    fn run(&mut self, begun: Transition, state: &AtomicU8) -> Transitioned {
        self.note(begun, state);
        let result = self.call(begun.goal, begun.start);
        if let Some(done) = self.machine.finish(result) {
            self.note(done, state);
            if done.goal == State::ErrorProcessing {
                let cleared = self.call(done.goal, begun.start);
                if let Some(done) = self.machine.finish(cleared) {
                    self.note(done, state);
                }
            }
        }
        Transitioned { result, state: self.machine.state() }
    }

    /// Calls the callback of `state`, which a transition from the primary state `previous` has reached.
    fn call(&mut self, state: State, previous: State) -> CallbackReturn {
        let (callbacks, node) = (&mut self.callbacks, &mut self.node);
        let call = AssertUnwindSafe(|| match state {
            State::Configuring => callbacks.on_configure(node),
            State::Activating => callbacks.on_activate(node),
            State::Deactivating => callbacks.on_deactivate(node),
            State::CleaningUp => callbacks.on_cleanup(node),
            State::ShuttingDown => callbacks.on_shutdown(node, previous),
            _ => callbacks.on_error(node, previous),
        });
        catch_unwind(call).unwrap_or_else(|_| {
            tracing::error!("a callback panicked in state '{state}': this counts as its error");
            CallbackReturn::Error
        })
    }

    /// Records a transition: opens or closes the publishers' gate, and publishes the transition's event.
    fn note(&self, transition: Transition, state: &AtomicU8) {
        let Transition { id, label, start, goal } = transition;
        // The gate closes before the callback of a deactivation, and opens after that of an activation.
        self.node.gate.set_open(goal == State::Active);
        state.store(goal.id(), Ordering::Release);
        let event = msg::TransitionEvent {
            timestamp: wall_ns().max(0) as u64,
            transition: msg::Transition { id, label: label.into() },
            start_state: described(start),
            goal_state: described(goal),
        };
        if let Err(error) = self.events.publish(&event) {
            tracing::warn!("{}: a transition is not published: {error}", self.events.topic());
        }
    }
}

pub(super) fn described(state: State) -> msg::State {
    msg::State { id: state.id(), label: state.label().into() }
}

tautline_rt::debug_fields!(LifecycleNode, |this| state = this.state());
