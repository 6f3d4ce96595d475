// SPDX-License-Identifier: MIT OR Apache-2.0

/// A type that can be the type of a topic.
///
/// Derived: `#[derive(Message)]` with `#[message(name = "demo_msgs/msg/Tick")]`.
#[diagnostic::on_unimplemented(
    message = "`{Self}` is not a message",
    note = "give it `#[derive(Message, Clone, Copy)]`, `#[repr(C)]` and `#[message(name = \"my_msgs/msg/Name\")]`"
)]
pub trait Message: Send + Sync + 'static {
    /// The ROS 2 name, `package/msg/Name`.
    const TYPE_NAME: &'static str;
}
