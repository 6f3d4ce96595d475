// SPDX-License-Identifier: MIT OR Apache-2.0
//! Transforms between frames, like ROS 2's tf2: a listener of `/tf` and `/tf_static`, broadcasters, and the buffer.
//!
//! ```
//! use std::time::Duration;
//! use tautline::geometry_msgs::msg::TransformStamped;
//! use tautline::tf::{Limits, StaticTransformBroadcaster, Time, TransformListener};
//! use tautline::{CallbackOptions, Context, Node, Realtime};
//!
//! let context = Context::builder().domain(127).realtime(Realtime::Off).build()?;
//! let mut node = Node::create(context.clone(), "localisation", "")?;
//! let listener = TransformListener::new(&mut node, CallbackOptions::other().name("tf"), Limits::default())?;
//! let buffer = listener.buffer(); // for any thread
//!
//! let mut laser = TransformStamped { child_frame_id: "laser".into(), ..TransformStamped::default() };
//! laser.header.frame_id = "base_link".into();
//! laser.transform.translation.z = 0.3;
//! StaticTransformBroadcaster::new(&mut node)?.send_transform(&laser)?;
//! # let sampler = std::thread::spawn({ let context = context.clone(); move || context.spin() });
//! let found = futures::executor::block_on(buffer.wait_for("base_link", "laser", Time::Latest)?)?;
//! assert_eq!(found.transform.point([1.0, 0.0, 0.0]), [1.0, 0.0, 0.3]);
//! # context.shutdown();
//! # sampler.join().unwrap()?;
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

use crate::error::Result;
use crate::node::Node;
use crate::{Logger, log_warn};
use futures::task::AtomicWaker;
use futures::{StreamExt, stream};
use std::future::ready;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::{Context, Poll};
use std::time::Duration;
use tautline_executor::{CallbackHandle, CallbackOptions};
use tautline_msgs::time_ns;
use tautline_ros_msgs::geometry_msgs::msg;
use tautline_ros_msgs::tf2_msgs::msg::TFMessage;
use tautline_transport::{PublishError, Publisher, Qos, Sample};

pub use tautline_tf::{
    Buffer, BufferCounters, Frame, FrameId, FrameInfo, FrameName, Kind, Limits, LimitsError, LookupError,
    MAX_DEPTH, NamedFrame, SetError, Stamped, Time, Transform, TransformStamped, WaitError, WaitFor, Writer,
};

/// The queue of `/tf`, as tf2_ros has it.
const DEPTH: usize = 100;

/// Reads `/tf` and `/tf_static` into a buffer, in its own callback, until it is dropped.
///
/// Transforms that the buffer refuses are counted ([`Buffer::counters`]) and logged, at most every ten seconds. If simulated time
/// jumps back, all transforms except static ones are removed, as in tf2.
///
/// # Real-time
/// Its callback allocates nothing. Each transform of a message costs one [`Writer::set`].
#[must_use = "dropping it ends it"]
pub struct TransformListener {
    buffer: Buffer,
    callback: CallbackHandle,
    #[cfg(feature = "rosgraph_msgs")]
    _jump: crate::time::JumpCallback,
}

impl TransformListener {
    /// Creates a buffer of [`Limits::bytes`], and spawns the callback that fills it.
    ///
    /// # Errors
    /// [`Error::TransformLimits`](crate::Error::TransformLimits), [`Error::ClockUsers`](crate::Error::ClockUsers), else as
    /// [`Node::create_publisher`](crate::Node::create_publisher) and [`Node::spawn_callback`](crate::Node::spawn_callback).
    pub fn new(node: &mut Node, options: CallbackOptions, limits: Limits) -> Result<TransformListener> {
        let (mut writer, buffer) = Buffer::new(limits)?;
        let moving = node.subscribe::<TFMessage>("/tf", Qos::keep_last(DEPTH))?;
        let fixed = Qos::keep_last(DEPTH).transient_local();
        let fixed = node.subscribe::<TFMessage>("/tf_static", fixed)?;
        let leap = Arc::new(Leap::default());
        #[cfg(feature = "rosgraph_msgs")]
        let jump = {
            let leap = leap.clone();
            node.clock().on_jump(crate::time::JumpThreshold::default(), move |_| leap.note())?
        };
        let both = stream::select(
            moving.map(|sample| Some((sample, Kind::Dynamic))),
            fixed.map(|sample| Some((sample, Kind::Static))),
        );
        let leaps = leap.clone();
        #[cfg(feature = "rosgraph_msgs")]
        let time = node.time_source().waiter()?;
        let leaps = stream::poll_fn(move |context| {
            // Nobody else may read the time.
            #[cfg(feature = "rosgraph_msgs")]
            time.update(context);
            leaps.poll(context)
        });
        let leaps = leaps.map(|()| None);
        let logger = node.logger().clone();
        let callback = stream::select(leaps, both).for_each(move |event| {
            // A message that was published after a leap may be taken before the leap is polled.
            if event.is_none() || leap.take() {
                writer.clear();
            }
            if let Some((sample, kind)) = event {
                set_all(&mut writer, &sample, kind, &logger);
            }
            ready(())
        });
        let callback = node.spawn_callback(options, callback)?;
        Ok(TransformListener {
            buffer,
            callback,
            #[cfg(feature = "rosgraph_msgs")]
            _jump: jump,
        })
    }

    /// The buffer for lookups; a clone is the same buffer.
    pub fn buffer(&self) -> Buffer {
        self.buffer.clone()
    }

    /// The callback, with its statistics.
    pub fn callback(&self) -> &CallbackHandle {
        &self.callback
    }
}

tautline_rt::debug_fields!(TransformListener, |this| counters = this.buffer.counters());

impl Drop for TransformListener {
    fn drop(&mut self) {
        self.callback.stop();
    }
}

/// Signals that time has leapt back; set by the thread that reads `/clock`.
#[derive(Default)]
struct Leap {
    is_new: AtomicBool,
    waker: AtomicWaker,
}

impl Leap {
    #[cfg(feature = "rosgraph_msgs")]
    fn note(&self) {
        self.is_new.store(true, Ordering::Release);
        self.waker.wake();
    }

    fn take(&self) -> bool {
        self.is_new.swap(false, Ordering::Acquire)
    }

    fn poll(&self, context: &mut Context<'_>) -> Poll<Option<()>> {
        self.waker.register(context.waker());
        if self.take() { Poll::Ready(Some(())) } else { Poll::Pending }
    }
}

fn set_all(writer: &mut Writer, sample: &Sample<TFMessage>, kind: Kind, logger: &Logger) {
    for stamped in sample.view().transforms() {
        let (stamp, transform) = (stamped.header().stamp(), stamped.transform());
        let stamped = TransformStamped {
            parent: stamped.header().frame_id(),
            child: stamped.child_frame_id(),
            stamp_ns: time_ns(stamp.sec, stamp.nanosec),
            transform: of_message(transform),
        };
        if let Err(error) = writer.set(&stamped, kind) {
            log_warn!(logger.throttle(Duration::from_secs(10)), "{error}");
        }
    }
}

/// Publishes transforms on `/tf`.
#[derive(Debug)]
pub struct TransformBroadcaster {
    publisher: Publisher<TFMessage>,
}

impl TransformBroadcaster {
    /// Publishes for `node`.
    ///
    /// # Errors
    /// As [`Node::create_publisher`](crate::Node::create_publisher).
    pub fn new(node: &mut Node) -> Result<Self> {
        let publisher = node.create_publisher("/tf", Qos::keep_last(DEPTH))?;
        Ok(TransformBroadcaster { publisher })
    }

    /// Publishes a message, which is written into shared memory unchanged: keep one message and modify it.
    ///
    /// # Real-time and errors
    /// As [`Publisher::publish`].
    pub fn send(&self, message: &TFMessage) -> Result<(), PublishError> {
        self.publisher.publish(message)
    }

    /// Publishes one transform. Allocates: real-time callbacks [`send`](Self::send).
    ///
    /// # Errors
    /// As [`Publisher::publish`].
    pub fn send_transform(&self, transform: &msg::TransformStamped) -> Result<(), PublishError> {
        self.send(&TFMessage { transforms: vec![transform.clone()] })
    }
}

/// Publishes transforms that never change on `/tf_static`, where late joiners get them, too.
#[derive(Debug)]
pub struct StaticTransformBroadcaster {
    publisher: Publisher<TFMessage>,
    all: TFMessage,
}

impl StaticTransformBroadcaster {
    /// Publishes for `node`, as long as the broadcaster exists.
    ///
    /// # Errors
    /// As [`Node::create_publisher`](crate::Node::create_publisher).
    pub fn new(node: &mut Node) -> Result<Self> {
        let qos = Qos::keep_last(1).transient_local();
        let publisher = node.create_publisher("/tf_static", qos)?;
        Ok(StaticTransformBroadcaster { publisher, all: TFMessage::default() })
    }

    /// Publishes this transform together with the previous ones; it replaces one with the same child.
    /// Allocates.
    ///
    /// # Errors
    /// As [`Publisher::publish`].
    pub fn send_transform(&mut self, transform: &msg::TransformStamped) -> Result<(), PublishError> {
        let all = &mut self.all.transforms;
        match all.iter_mut().find(|known| known.child_frame_id == transform.child_frame_id) {
            Some(known) => known.clone_from(transform),
            None => all.push(transform.clone()),
        }
        self.publisher.publish(&self.all)
    }
}

/// Converts a transform into its message.
pub fn to_message(transform: &Transform) -> msg::Transform {
    let ([x, y, z], [qx, qy, qz, qw]) = (transform.translation, transform.rotation);
    msg::Transform {
        translation: msg::Vector3 { x, y, z },
        rotation: msg::Quaternion { x: qx, y: qy, z: qz, w: qw },
    }
}

/// Converts a message into a transform.
pub fn of_message(transform: &msg::Transform) -> Transform {
    let (by, turned) = (&transform.translation, &transform.rotation);
    Transform::new([by.x, by.y, by.z], [turned.x, turned.y, turned.z, turned.w])
}
