// SPDX-License-Identifier: MIT OR Apache-2.0

use crate::Message;

/// A message with the time of its measurement: generated types with a `std_msgs/Header header` implement it.
///
/// For your own type:
/// ```
/// use tautline_msgs::{HasStamp, Message};
///
/// #[derive(Message, Clone, Copy)]
/// #[message(name = "demo_msgs/msg/Scan", crate = "tautline_msgs")]
/// #[repr(C)]
/// struct Scan { stamp_ns: i64, range: f64 }
///
/// impl HasStamp for Scan {
///     fn stamp_ns(view: &Scan) -> i64 { view.stamp_ns }
/// }
/// ```
pub trait HasStamp: Message {
    /// The stamp in nanoseconds since the epoch of the robot's clock.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    fn stamp_ns(view: Self::View<'_>) -> i64;
}

/// The nanoseconds of a `builtin_interfaces/Time`.
pub const fn time_ns(sec: i32, nanosec: u32) -> i64 {
    sec as i64 * 1_000_000_000 + nanosec as i64
}
