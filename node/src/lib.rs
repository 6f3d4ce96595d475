// SPDX-License-Identifier: MIT OR Apache-2.0
//! Zero-copy, real-time middleware for robots in Rust, without DDS. A publisher writes each message once, into shared memory, and subscribers
//! read it there. Each callback starts within a bound that you compute before you switch the robot on. The API follows ROS 2, and nodes of
//! rclcpp and rclpy run on it unchanged. A report compares a running system with its bounds.
//!
//! A [`Context`] joins a domain and owns the sampler and the callback threads. A [`Node`] makes publishers,
//! subscriptions and timers with ROS 2's names and quality of service. Each callback runs on its own thread, at its own
//! priority; [`Node::spin`] turns the calling thread into the sampler, which wakes them.
//!
//! ```no_run
//! use futures::StreamExt;
//! use std::time::Duration;
//! use tautline::{Context, Message, Node, Qos, Service};
//!
//! #[derive(Message, Clone, Copy)]
//! #[repr(C)]
//! #[message(name = "demo_msgs/msg/Odometry")]
//! struct Odometry { x: f64, y: f64, heading: f64 }
//! # #[derive(Message, Clone, Copy)]
//! # #[repr(C)]
//! # #[message(name = "demo_msgs/msg/Speed")]
//! # struct Speed { value: f64 }
//! # struct Stop;
//! # impl Service for Stop {
//! #     type Request = Speed; type Response = Speed; type Event = Speed;
//! #     const TYPE_NAME: &str = "demo_msgs/srv/Stop"; const TYPE_HASH: &str = "";
//! # }
//!
//! // The file has each callback's priority, core, deadline and queue; `taut check` has computed its bound.
//! let ctx = Context::builder().system("system.toml").build()?;
//! let mut node = Node::create(ctx.clone(), "example", "")?;
//!
//! let odometry = node.subscribe::<Odometry>("/odom", ctx.callback_qos("watch")?)?;
//! node.spawn_callback(ctx.callback("watch")?, odometry.for_each(|msg| async move {
//!     let _heading = msg.heading; // msg derefs into shared memory
//! }))?;
//!
//! let speed = node.create_publisher::<Speed>("/speed", Qos::default())?;
//! let mut timer = node.create_wall_timer(Duration::from_millis(10))?;
//! node.spawn_callback(ctx.callback("drive")?, async move {
//!     while timer.next().await.is_some() {
//!         let _ = speed.publish(&Speed { value: 0.5 });
//!     }
//! })?;
//!
//! let mut stop = node.create_service::<Stop>("/stop", Qos::default())?;
//! node.spawn_callback(ctx.callback("stop")?, async move {
//!     while let Some(request) = stop.next().await {
//!         let _ = stop.respond(&request, &Speed { value: 0.0 });
//!     }
//! })?;
//!
//! node.spin()?; // this thread becomes the sampler, at the highest priority
//! # Ok::<(), tautline::Error>(())
//! ```
//!
//! If the system refuses a real-time setting, the error names the fix. A program that should run without real time
//! must choose this explicitly: [`Realtime::Off`], or `TAUT_REALTIME=off` in the environment. Without a system file, callbacks get their
//! priorities from [`CallbackOptions`].
//!
//! # Features
//!
//! Four groups; the first three are on by default.
//!
//! | feature | adds |
//! |---|---|
//! | `node` | what every ROS 2 node has: actions, lifecycle, parameters with their services and `/rosout`, simulated time |
//! | `messages` | the message packages that most robots use; each other package has a feature with its name, `ros_all` adds all; `tf2_msgs` also adds transforms (`tautline::tf`) |
//! | `untyped` | topics, services and actions of types that are known at run time only |
//! | `tracing-layer`, `lttng` | `tracing`'s events in the log; LTTng-UST tracepoints |
//!
//! Programs that were written for `r2r` compile unchanged with the crate `tautline-r2r`, which has r2r's
//! names.
//!
//! # Figures
//!
//! ![Response times of the demo's five topics beside their prediction](https://github.com/tautline/tautline/raw/main/docs/demo.svg)
//!
//! Five topics share one core at 90 % load: response times, computed worst cases, deadlines. And beside others, half round trips in µs (p50 / p99)
//! as [the README](https://github.com/tautline/tautline#how-it-compares) explains them:
#![doc = include_str!("comparison.md")]
//! # Three ways to start
//!
//! - Rust: `cargo add tautline`, and [the first program](https://github.com/tautline/tautline/blob/main/docs/start.md#in-your-program).
//! - ROS 2: `pip install taut rmw-tautline` beside its wheels, or a `.deb` beside an installed one, and `RMW_IMPLEMENTATION=rmw_tautline`:
//!   [packages](https://github.com/tautline/tautline/blob/main/docs/start.md#install).
//! - To look: `cargo run --release -- demo` in a checkout.
#![forbid(unsafe_code)]

#[cfg(feature = "action_msgs")]
mod action;
mod args;
mod callbacks;
mod context;
mod error;
#[cfg(feature = "action_msgs")]
mod goal_state;
mod graph;
mod names;
mod node;
mod parameters;
mod qos_events;
mod reload;
mod remap;
mod service;
#[cfg(feature = "lifecycle_msgs")]
mod state_machine;
mod subscription;
mod system;
#[cfg(feature = "rosgraph_msgs")]
mod time;
mod timer;
#[cfg(feature = "untyped")]
mod untyped;
mod values;

#[cfg(feature = "lifecycle_msgs")]
pub mod lifecycle;
pub mod logging;
#[cfg(feature = "tf2_msgs")]
pub mod tf;

#[cfg(feature = "action_msgs")]
pub use action::{
    ActionClient, ActionClientGoal, ActionServerCancelRequest, ActionServerGoal, ActionServerGoalRequest,
    ActionServerOptions,
};
pub use callbacks::NodeCallbacks;
pub use context::{Context, ContextBuilder};
pub use error::{Error, Result};
#[cfg(feature = "action_msgs")]
pub use goal_state::GoalStatus;
pub use graph::TopicEndpointInfo;
#[cfg(feature = "lifecycle_msgs")]
pub use lifecycle::{LifecycleCallbacks, LifecycleNode, ManagedNode};
pub use logging::{LogSeverity, Logger};
pub use node::{Node, NodeOptions};
pub use parameters::{
    OnSetParameters, Parameter, ParameterDescriptor, ParameterRange, ParameterReader, Parameters, RosParams,
    parameters_of_file,
};
pub use qos_events::{
    DeadlineMissed, LivelinessLost, PublisherEvent, PublisherEvents, SubscriptionEvent, SubscriptionEvents,
};
pub use reload::apply_system;
pub use remap::RemapRules;
pub use service::{Client, ResponseFuture, Server, ServiceRequest};
pub use subscription::Subscription;
pub use system::CallbackJoin;
#[cfg(feature = "rosgraph_msgs")]
pub use time::{Clock, ClockChange, ClockJump, ClockType, JumpCallback, JumpThreshold, TimeSource};
pub use timer::Timer;
#[cfg(feature = "untyped")]
pub use untyped::{Cdr, Json};
pub use values::{
    ParameterError, ParameterType, ParameterValue, ParameterVariant, UnknownParameterType, WrongParameterType,
};

pub use indexmap;
pub use tautline_derive::RosParams;
pub use tautline_trace::{TraceError, TraceMode, TraceSettings};
#[cfg(feature = "action_msgs")]
pub use uuid;

pub use tautline_executor::{
    Bucket, CallbackGroup, CallbackHandle, CallbackOptions, CallbackStats, CoreSet, DeadlineMiss,
    ExecutorError, Handler, Histogram, HistogramSnapshot, MemberOptions, Overrun, OverrunPolicy, Panic,
    Policy, Realtime, Watch, assign, job::set_input_size,
};
/// Callbacks that wait for several topics.
pub use tautline_join as join;
pub use tautline_msgs as msgs;
pub use tautline_msgs::{Action, HasStamp, Message, Plain, Service};

/// The message packages, each with its feature.
macro_rules! packages {
    ($($package:ident $feature:literal)*) => {
        $(
            #[cfg(feature = $feature)]
            #[doc(no_inline)]
            pub use tautline_ros_msgs::$package;
        )*
    };
}
packages! {
    action_msgs "action_msgs"
    builtin_interfaces "builtin_interfaces"
    composition_interfaces "composition_interfaces"
    diagnostic_msgs "diagnostic_msgs"
    example_interfaces "example_interfaces"
    geometry_msgs "geometry_msgs"
    lifecycle_msgs "lifecycle_msgs"
    nav_msgs "nav_msgs"
    rcl_interfaces "rcl_interfaces"
    rosgraph_msgs "rosgraph_msgs"
    sensor_msgs "sensor_msgs"
    service_msgs "service_msgs"
    shape_msgs "shape_msgs"
    statistics_msgs "statistics_msgs"
    std_msgs "std_msgs"
    std_srvs "std_srvs"
    stereo_msgs "stereo_msgs"
    test_msgs "test_msgs"
    tf2_msgs "tf2_msgs"
    trajectory_msgs "trajectory_msgs"
    type_description_interfaces "type_description_interfaces"
    unique_identifier_msgs "unique_identifier_msgs"
    visualization_msgs "visualization_msgs"
}

/// Policies, cores, clocks and locks, as programs use them beside their callbacks. All of it is the crate `tautline-rt`.
///
/// ```
/// let (mut pose, mut reader) = tautline::rt::latest([0.0; 3]); // one callback writes, another one reads
/// pose.write([1.0, 2.0, 0.0]);
/// assert_eq!(reader.read(), &[1.0, 2.0, 0.0]);
/// ```
pub mod rt {
    pub use tautline_rt::{
        CoreSet, Enforcement, LatestReader, LatestWriter, PiGuard, PiMutex, Policy, RtError, ThreadInfo,
        current_affinity, current_policy, latest, set_affinity, set_policy,
    };
    /// Times in nanoseconds.
    ///
    /// ```
    /// use tautline::rt::clock::{monotonic_ns, sleep_until_monotonic};
    ///
    /// let due_ns = monotonic_ns() + 1_000_000;
    /// sleep_until_monotonic(due_ns);
    /// assert!(monotonic_ns() >= due_ns);
    /// ```
    pub mod clock {
        pub use tautline_rt::clock::{
            burn_cpu, monotonic_ns, nanoseconds, sleep_until_monotonic, thread_cpu_ns, wall_ns,
        };
    }
    /// Selects the processes that see each other: those of one scope and domain.
    ///
    /// ```
    /// tautline::rt::domain::set_scope("simulation-2")?; // before anything else
    /// # Ok::<(), tautline::rt::domain::ScopeError>(())
    /// ```
    pub mod domain {
        pub use tautline_rt::domain::{ScopeError, set_scope};
    }
    /// The real-time settings that the system permits this process.
    ///
    /// ```
    /// if let Err(reason) = tautline::rt::permission::realtime_permitted(20) {
    ///     println!("{reason}"); // with the fix
    /// }
    /// ```
    pub mod permission {
        pub use tautline_rt::permission::realtime_permitted;
    }
}
pub use tautline_sampler::{Events, GuardCondition, Tick, Wait};
pub use tautline_system::{Admission, SystemError};
pub use tautline_transport::{
    BurstError, Claim, DoorbellError, Durability, Gid, GraphEvents, History, IncompatibleQos,
    IncompatibleType, Limits, Liveliness, LivelinessChanged, Loan, LoanError, MAX_PENDING_REQUESTS, Matched,
    MessageInfo, MessageLost, PendingResponse, PublishCdrError, PublishError, Publisher, PublisherCounters,
    Qos, QosPolicyKind, Reliability, Request, RequestId, Response, Sample, SendError, ServiceError,
    SubscriptionCounters, TakeError, TopicMemory, TransportError, Unwritten, UnwrittenResponse, topic_memory,
};

/// The codecs over which endpoints of topics, services and actions are generic: a Rust type is its own codec;
/// `Json` and `Cdr` are the codecs of types known by name. For bounds in generic code; the set of codecs is
/// fixed.
///
/// ```
/// use tautline::{Publisher, codec::Codec};
///
/// fn is_heard<T: Codec>(publisher: &Publisher<T>) -> bool {
///     publisher.subscription_count() > 0
/// }
/// ```
pub mod codec {
    #[cfg(feature = "action_msgs")]
    pub use crate::action::ActionCodec;
    pub use tautline_transport::{Codec, Decode, ServiceCodec};
}

/// Functions that the macros' code calls.
#[doc(hidden)]
pub mod __private {
    pub use crate::logging::Site;
    pub use crate::parameters::{field, no_field};

    /// For r2r's programs, which insert parameters directly.
    pub fn parameter_map(
        node: &crate::Node,
    ) -> std::sync::Arc<std::sync::Mutex<indexmap::IndexMap<String, crate::Parameter>>> {
        node.parameters.map()
    }
}

/// The first programs compile.
#[cfg(all(doctest, feature = "geometry_msgs"))]
#[doc = include_str!("../../README.md")]
#[doc = include_str!("../../docs/start.md")]
struct Readme;

/// The programs of the guides compile.
#[cfg(all(doctest, feature = "std_srvs", feature = "tf2_msgs", feature = "untyped"))]
#[doc = include_str!("../../docs/from-r2r.md")]
#[doc = include_str!("../../docs/from-rclcpp.md")]
#[doc = include_str!("../../docs/from-rclpy.md")]
#[doc = include_str!("../../docs/from-iceoryx2.md")]
#[doc = include_str!("../../docs/messages.md")]
#[doc = include_str!("../../docs/report.md")]
#[doc = include_str!("../../docs/system-toml.md")]
struct Guides;
