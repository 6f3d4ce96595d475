// SPDX-License-Identifier: MIT OR Apache-2.0
//! Nodes: names under which topics are published and subscribed to.

#[cfg(feature = "rosgraph_msgs")]
mod clock;
mod declare;
#[cfg(feature = "rcl_interfaces")]
mod logger_services;
#[cfg(feature = "rcl_interfaces")]
mod parameter_services;

use crate::callbacks::NodeCallbacks;
use crate::context::Context;
use crate::error::{Error, Result};
use crate::logging::{self, Logger};
use crate::names;
use crate::parameters::{self, Parameters};
use crate::remap::{NameKind, RemapRules};
use crate::subscription::Subscription;
#[cfg(feature = "rosgraph_msgs")]
use crate::time::TimeSource;
use crate::timer::Timer;
use crate::values::{ParameterEvents, ParameterValue};
use std::collections::HashMap;
use std::future::Future;
use std::sync::Arc;
use std::time::Duration;
use tautline_executor::{CallbackGroup, CallbackHandle, CallbackOptions};
use tautline_msgs::Message;
use tautline_transport::{Codec, Decode, Limits, NodeHandle, Participant, Publisher, Qos, TopicType};

/// A node. It ends when it has been dropped and the callbacks spawned through it have ended. Everything created through it ends with
/// it: streams deliver what had arrived and then end, timers end, publishing and requests return errors. Its context exists at least
/// as long.
///
/// A program can be structured like one for r2r: one thread that serves events and runs a pool.
///
/// ```
/// use futures::{StreamExt, executor::LocalPool, task::LocalSpawnExt};
/// use std::time::Duration;
/// use tautline::{Context, Message, Node, Qos, Realtime};
///
/// #[derive(Message, Clone, Copy)]
/// #[repr(C)]
/// #[message(name = "demo_msgs/msg/Speed")]
/// struct Speed { metres_per_second: f64 }
///
/// let ctx = Context::builder().domain(229).realtime(Realtime::Off).build()?;
/// let mut node = Node::create(ctx.clone(), "example", "/robot")?;
/// let mut speeds = node.subscribe::<Speed>("~/speed", Qos::default())?.owned(); // /robot/example/speed
/// let publisher = node.create_publisher::<Speed>("~/speed", Qos::default())?;
/// publisher.publish(&Speed { metres_per_second: 1.5 }).unwrap();
///
/// let mut pool = LocalPool::new();
/// let done = ctx.clone();
/// pool.spawner().spawn_local(async move {
///     let speed = speeds.next().await.unwrap();
///     assert_eq!(speed.metres_per_second, 1.5);
///     done.shutdown();
/// }).unwrap();
/// while ctx.is_valid() {
///     node.spin_once(Duration::from_millis(100));
///     pool.run_until_stalled();
/// }
/// # Ok::<(), tautline::Error>(())
/// ```
pub struct Node {
    pub(crate) context: Context,
    /// Under which other processes see this node.
    pub(crate) handle: NodeHandle,
    life: Arc<Life>,
    /// Makes publishers and subscriptions of this node.
    pub(crate) participant: Participant,
    name: String,
    namespace: String,
    full_name: String,
    remap: RemapRules,
    limits: HashMap<String, Limits>,
    pub(crate) service_limits: HashMap<String, Limits>,
    pub(crate) trace: tautline_trace::Object,
    pub(crate) parameters: Parameters,
    callbacks: NodeCallbacks,
    logger: Logger,
    #[cfg(feature = "rosgraph_msgs")]
    pub(crate) time_source: TimeSource,
}

/// A node's own options, in addition to its context's.
#[derive(Clone, Debug)]
#[must_use = "give it to Node::create_with_options"]
pub struct NodeOptions {
    remap: RemapRules,
    use_global_arguments: bool,
    parameter_overrides: Vec<(String, ParameterValue)>,
}

impl NodeOptions {
    /// Remapping rules for this node only; they take precedence over the context's.
    pub fn remap(self, rules: RemapRules) -> Self {
        NodeOptions { remap: rules, ..self }
    }

    /// Values for this node's parameters; they take precedence over those of the command line.
    pub fn parameter_overrides(
        mut self,
        overrides: impl IntoIterator<Item = (impl Into<String>, impl Into<ParameterValue>)>,
    ) -> Self {
        self.parameter_overrides =
            overrides.into_iter().map(|(name, value)| (name.into(), value.into())).collect();
        self
    }

    /// Whether the context's rules, and the parameters of its command line, also apply to this node. On by default.
    pub fn use_global_arguments(self, use_global_arguments: bool) -> Self {
        NodeOptions { use_global_arguments, ..self }
    }
}

impl Default for NodeOptions {
    fn default() -> Self {
        NodeOptions {
            remap: RemapRules::default(),
            use_global_arguments: true,
            parameter_overrides: Vec::new(),
        }
    }
}

impl Node {
    /// Creates a node called `name` in `namespace` (`""` is `/`), unless a remapping rule changes the name. Another node
    /// with the same name is allowed, but logged as a warning, as in ROS 2.
    ///
    /// # Errors
    /// [`Error::Name`] with the rule that a name breaks; [`Error::Transport`] if the node cannot be
    /// announced.
    pub fn create(ctx: Context, name: &str, namespace: &str) -> Result<Node> {
        Node::create_with_options(ctx, name, namespace, NodeOptions::default())
    }

    /// As [`create`](Self::create), with options.
    ///
    /// # Errors
    /// As [`create`](Self::create).
    pub fn create_with_options(
        ctx: Context,
        name: &str,
        namespace: &str,
        options: NodeOptions,
    ) -> Result<Node> {
        names::check_node(name)?;
        let mut remap = options.remap;
        if options.use_global_arguments {
            remap = remap.then(&ctx.shared.settings.remap);
        }
        let name = remap.node_name(name).to_owned();
        let namespace = names::absolute_namespace(remap.namespace(&name).unwrap_or(namespace))?;
        let participant = &ctx.shared.participant;
        let enclave = ctx.shared.arguments.enclave.as_deref().unwrap_or("/");
        let handle = participant.create_node_in_enclave(&name, &namespace, enclave)?;
        if participant.node_count(handle.name()) > 1 {
            tracing::warn!(
                "there is another node called {}: lookups by this name may return either; rename one with __node or __ns",
                handle.name()
            );
        }
        let trace = tautline_trace::node_init(participant.trace_id(), &name, &namespace);
        let participant = participant.for_node(&handle);
        let full_name = format!("{}/{name}", namespace.trim_end_matches('/'));
        let rules = &ctx.shared.arguments.parameters;
        let rules = if options.use_global_arguments { &rules[..] } else { &[] };
        let given = parameters::overrides(rules, &options.parameter_overrides, &full_name);
        let events = ParameterEvents::new(full_name.clone(), ctx.shared.parameter_events.clone());
        let parameters = Parameters::new(given, events);
        let logger = Logger::of_node(&full_name);
        if ctx.shared.arguments.outputs.rosout != Some(false) {
            logger.add_topic(Arc::downgrade(&ctx.shared.rosout));
        }
        let limits = HashMap::new();
        #[cfg(feature = "rosgraph_msgs")]
        let time_source = {
            let clock = names::expand_topic("/clock", &name, &namespace)?;
            let topic = remap.name(clock, NameKind::Topic, &name, &namespace)?;
            let source = TimeSource::new(participant.clone(), topic);
            source.set_enabled(parameters.declare_use_sim_time(&source)?)?;
            source
        };
        Ok(Node {
            context: ctx,
            life: Arc::new(Life(handle.clone())),
            handle,
            participant,
            name,
            namespace,
            full_name,
            remap,
            limits,
            service_limits: HashMap::new(),
            trace,
            parameters,
            callbacks: NodeCallbacks::default(),
            logger,
            #[cfg(feature = "rosgraph_msgs")]
            time_source,
        })
    }

    /// The node's name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The node's namespace.
    pub fn namespace(&self) -> &str {
        &self.namespace
    }

    /// The node's name with its namespace.
    pub fn fully_qualified_name(&self) -> &str {
        &self.full_name
    }

    /// The node's logger: its name is the node's, with `.` for `/`. For the log macros.
    ///
    /// # Real-time
    /// Setup only: starts the thread that writes the log lines of real-time threads. Logging is wait-free in
    /// these threads.
    pub fn logger(&self) -> &Logger {
        logging::start();
        &self.logger
    }

    /// The node's context.
    pub fn context(&self) -> &Context {
        &self.context
    }

    /// The fully qualified name of `topic` in this node, before remapping.
    ///
    /// # Errors
    /// [`Error::Name`].
    pub fn expand_topic_name(&self, topic: &str) -> Result<String> {
        names::expand_topic(topic, &self.name, &self.namespace)
    }

    /// The fully qualified name of `topic` in this node, after remapping: the name that publishers and subscriptions get.
    ///
    /// # Errors
    /// [`Error::Name`].
    pub fn resolve_topic_name(&self, topic: &str) -> Result<String> {
        self.remap.name(self.expand_topic_name(topic)?, NameKind::Topic, &self.name, &self.namespace)
    }

    /// Like [`resolve_topic_name`](Self::resolve_topic_name), for a service.
    ///
    /// # Errors
    /// [`Error::Name`].
    pub fn resolve_service_name(&self, service: &str) -> Result<String> {
        self.remap.name(self.expand_topic_name(service)?, NameKind::Service, &self.name, &self.namespace)
    }

    /// Sets the limits of the publishers and subscriptions of `topic` that this node creates from now on.
    ///
    /// # Errors
    /// [`Error::Name`].
    pub fn set_topic_limits(&mut self, topic: &str, limits: Limits) -> Result<()> {
        let topic = self.resolve_topic_name(topic)?;
        self.limits.insert(topic, limits);
        Ok(())
    }

    /// Creates a publisher.
    ///
    /// # Errors
    /// [`Error::Name`]; [`Error::Transport`]: an invalid QoS, no memory left in /dev/shm.
    pub fn create_publisher<T: Message>(&mut self, topic: &str, qos: Qos) -> Result<Publisher<T>> {
        self.create_publisher_of(topic, &topic_type_of::<T>(), (), qos)
    }

    pub(crate) fn create_publisher_of<T: Codec>(
        &self,
        topic: &str,
        topic_type: &TopicType,
        definition: T::Definition,
        qos: Qos,
    ) -> Result<Publisher<T>> {
        let (topic, limits) = self.resolve(topic)?;
        let _node = tautline_trace::in_node(self.trace.id());
        Ok(self.participant.create_publisher_of(&topic, topic_type, definition, qos, limits)?)
    }

    /// Subscribes to a topic: returns a stream of samples, read in shared memory, through
    /// [`Sample::view`](crate::Sample::view), or by dereferencing if the type is plain. [`Subscription::owned`] converts it
    /// into a stream of owned messages.
    ///
    /// # Errors
    /// As [`create_publisher`](Self::create_publisher).
    pub fn subscribe<T: Message>(&mut self, topic: &str, qos: Qos) -> Result<Subscription<T>> {
        self.subscribe_of(topic, &topic_type_of::<T>(), (), qos)
    }

    pub(crate) fn subscribe_of<T: Decode>(
        &self,
        topic: &str,
        topic_type: &TopicType,
        definition: T::Definition,
        qos: Qos,
    ) -> Result<Subscription<T>> {
        let (topic, limits) = self.resolve(topic)?;
        let _node = tautline_trace::in_node(self.trace.id());
        let inner = self.participant.create_subscription_of(&topic, topic_type, definition, qos, limits)?;
        Ok(Subscription::new(inner))
    }

    pub(crate) fn resolve(&self, topic: &str) -> Result<(String, Limits)> {
        let topic = self.resolve_topic_name(topic)?;
        let limits = self.limits_of(&topic);
        Ok((topic, limits))
    }

    /// The limits that were set for `topic`, a fully qualified name.
    pub(crate) fn limits_of(&self, topic: &str) -> Limits {
        self.limits.get(topic).copied().unwrap_or_default()
    }

    /// Creates a timer on the monotonic clock whose first release is one period from now.
    ///
    /// # Errors
    /// [`Error::ZeroPeriod`]; [`Error::ShortPeriod`] below 1 µs; [`Error::Transport`] if there is no memory for its slot.
    pub fn create_wall_timer(&mut self, period: Duration) -> Result<Timer> {
        check_period(period)?;
        let _node = tautline_trace::in_node(self.trace.id());
        Ok(Timer::new(&self.handle, tautline_sampler::Timer::new(self.context.events(), period)?))
    }

    /// Creates a timer whose first release is at `first_release_ns` on `CLOCK_MONOTONIC`.
    ///
    /// # Errors
    /// [`Error::ZeroPeriod`]; [`Error::ShortPeriod`] below 1 µs; [`Error::Transport`] if there is no memory for its slot.
    pub fn create_wall_timer_at(&mut self, first_release_ns: u64, period: Duration) -> Result<Timer> {
        check_period(period)?;
        let _node = tautline_trace::in_node(self.trace.id());
        Ok(Timer::new(
            &self.handle,
            tautline_sampler::Timer::starting_at(self.context.events(), first_release_ns, period)?,
        ))
    }

    /// Runs a future on its own thread, with the policy, priority and core of `options`. On return the kernel has
    /// confirmed them. A priority that is not below the sampler's is logged as a warning, because the callback then
    /// delays the wake-up of all others.
    ///
    /// # Errors
    /// [`Error::Executor`] with the fix if a setting is refused; [`SystemError::NotAdmitted`](crate::SystemError::NotAdmitted) if the context checks new load, and a deadline
    /// would be missed: see [`ContextBuilder::admission`](crate::ContextBuilder::admission).
    pub fn spawn_callback(
        &self,
        options: CallbackOptions,
        future: impl Future<Output = ()> + Send + 'static,
    ) -> Result<CallbackHandle> {
        self.spawn_local(options, move || future)
    }

    /// Runs a future on its own thread, and creates it there; it need not be `Send`.
    ///
    /// # Errors
    /// As [`spawn_callback`](Self::spawn_callback).
    pub fn spawn_local<F: Future<Output = ()> + 'static>(
        &self,
        options: CallbackOptions,
        make: impl FnOnce() -> F + Send + 'static,
    ) -> Result<CallbackHandle> {
        self.prepare_thread(&options);
        let _gate = self.context.admit(&options, [&options].into_iter())?;
        let life = self.life.clone();
        let make = move || {
            let future = make();
            async move {
                future.await;
                drop(life);
            }
        };
        Ok(self.kept(self.context.shared.executor.spawn_local(options, make)?))
    }

    /// Runs a group of callbacks on one thread, one after the other in order of release.
    ///
    /// # Errors
    /// As [`spawn_callback`](Self::spawn_callback).
    pub fn spawn_group(&self, options: CallbackOptions, mut group: CallbackGroup) -> Result<CallbackHandle> {
        self.prepare_thread(&options);
        let _gate = self.context.admit(&options, group.members())?;
        group.keep(self.life.clone());
        Ok(self.kept(self.context.shared.executor.spawn_group(options, group)?))
    }

    /// Spawns a callback of the node's own, which ends with the node.
    #[cfg(feature = "action_msgs")]
    pub(crate) fn spawn_for_itself(
        &self,
        options: CallbackOptions,
        future: impl Future<Output = ()> + Send + 'static,
    ) -> Result<CallbackHandle> {
        self.prepare_thread(&options);
        let _gate = self.context.admit(&options, [&options].into_iter())?;
        Ok(self.kept(self.context.shared.executor.spawn_callback(options, future)?))
    }

    fn kept(&self, callback: CallbackHandle) -> CallbackHandle {
        self.callbacks.keep(&callback);
        callback
    }

    /// The callbacks spawned through this node, for code that ends them without their handles, such as a container.
    pub fn callbacks(&self) -> &NodeCallbacks {
        &self.callbacks
    }

    fn prepare_thread(&self, options: &CallbackOptions) {
        self.context.warn_if_above_sampler(options);
        // The callback may log under a name although no logger was requested.
        logging::start();
    }

    /// Turns the calling thread into the sampler: see [`Context::spin`].
    ///
    /// # Errors
    /// As [`Context::spin`].
    pub fn spin(&self) -> Result<()> {
        self.context.spin()
    }

    /// Serves ready tasks; waits up to `timeout`: see [`Context::spin_once`].
    pub fn spin_once(&mut self, timeout: Duration) {
        self.context.spin_once(timeout);
        // Calls the callbacks for jumps of the clock.
        #[cfg(feature = "rosgraph_msgs")]
        self.time_source.update();
    }
}

/// A release costs the sampler about as much time.
const SHORTEST_PERIOD: Duration = Duration::from_micros(1);

fn check_period(period: Duration) -> Result<()> {
    match period {
        Duration::ZERO => Err(Error::ZeroPeriod),
        _ if period < SHORTEST_PERIOD => Err(Error::ShortPeriod { period, min: SHORTEST_PERIOD }),
        _ => Ok(()),
    }
}

/// Ends a node when it has been dropped and its callbacks have ended.
struct Life(NodeHandle);

impl Drop for Life {
    fn drop(&mut self) {
        self.0.end();
    }
}

tautline_rt::debug_fields!(Node, |this| name = this.name, namespace = this.namespace);

const _: () = {
    const fn is_send<T: Send>() {}
    is_send::<Error>();
    is_send::<Node>();
    is_send::<Timer>();
};

/// The description of a type: for a type that is only defined in Rust also its hash, so that tools find its definition and read messages.
#[cfg(feature = "untyped")]
fn topic_type_of<T: Message>() -> TopicType {
    use tautline_schema::Schema;
    let topic_type = TopicType::of::<T>();
    let Some(text) = topic_type.definition.as_ref().filter(|_| topic_type.hash.is_none()) else {
        return topic_type;
    };
    // A type with field names that are not valid in ROS has no definition there.
    let schema = T::TYPE_NAME.parse().ok().and_then(|name| Schema::from_text(&name, text).ok());
    match schema {
        Some(schema) => topic_type.with_hash(schema.hash().to_string()),
        None => topic_type,
    }
}

#[cfg(not(feature = "untyped"))]
fn topic_type_of<T: Message>() -> TopicType {
    TopicType::of::<T>()
}
