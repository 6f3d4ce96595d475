// SPDX-License-Identifier: MIT OR Apache-2.0
//! One end of round trips of `rmw_wait` and take.

use crate::bindings::*;
use crate::rmw::{Node, Publish, Take, Twist, Waiting, checked};
use crate::system::Message;
use crate::types;
use std::ffi::c_void;
use std::ptr::null_mut;
use std::time::Duration;
use tautline_exchange::{Job, Link, Result, play, stop_flag};

/// Of a serialized `std_msgs/msg/UInt8MultiArray`: how it is encoded, no dimensions, no offset, the length of the data.
const HEADER_BYTES: usize = 16;

/// Plays one end.
pub fn run(job: &Job, message: Message) -> Result<()> {
    let (own, stop) = (job.clone(), stop_flag());
    // The RMW's threads inherit the priority, if it says nothing else of them.
    job.as_application(move || play(&own, &mut End::new(&own, message)?, &stop, None))
}

struct End {
    publisher: *mut rmw_publisher_t,
    waiting: Waiting,
    messages: Messages,
}

type PublishSerialized =
    unsafe extern "C" fn(*const rmw_publisher_t, *const rmw_serialized_message_t, *mut c_void) -> rmw_ret_t;
type TakeSerialized = unsafe extern "C" fn(
    *const rmw_subscription_t,
    *mut rmw_serialized_message_t,
    *mut bool,
    *mut c_void,
) -> rmw_ret_t;
type Borrow = unsafe extern "C" fn(
    *const rmw_publisher_t,
    *const rosidl_message_type_support_t,
    *mut *mut c_void,
) -> rmw_ret_t;
type TakeLoaned = unsafe extern "C" fn(
    *const rmw_subscription_t,
    *mut *mut c_void,
    *mut bool,
    *mut rmw_message_info_t,
    *mut c_void,
) -> rmw_ret_t;
type GiveBack = unsafe extern "C" fn(*const rmw_subscription_t, *mut c_void) -> rmw_ret_t;

/// How messages go and come.
enum Messages {
    Struct {
        publish: Publish,
        take: Take,
    },
    Serialized {
        publish: PublishSerialized,
        take: TakeSerialized,
        sent: rmw_serialized_message_t,
        taken: rmw_serialized_message_t,
    },
    Loaned {
        support: *const rosidl_message_type_support_t,
        borrow: Borrow,
        publish: Publish,
        take: TakeLoaned,
        give_back: GiveBack,
    },
}

impl Messages {
    fn new(job: &Job, node: &Node, message: Message) -> Result<(Self, *const rosidl_message_type_support_t)> {
        // SAFETY: the types of rmw's headers.
        unsafe {
            Ok(match message {
                Message::Struct => {
                    let (publish, take) = (node.function("rmw_publish")?, node.function("rmw_take")?);
                    (Messages::Struct { publish, take }, types::message("geometry_msgs", "Twist")?)
                }
                Message::Serialized => {
                    let sent = serialized(HEADER_BYTES + job.payload_bytes);
                    let bytes = std::slice::from_raw_parts_mut(sent.buffer, HEADER_BYTES);
                    bytes.copy_from_slice(&[0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]);
                    bytes[12..].copy_from_slice(&(job.payload_bytes as u32).to_le_bytes());
                    let messages = Messages::Serialized {
                        publish: node.function("rmw_publish_serialized_message")?,
                        take: node.function("rmw_take_serialized_message")?,
                        sent,
                        // ROS resizes what it takes into, by the allocator that it was made by: ample from the start.
                        taken: serialized(2 * HEADER_BYTES + job.payload_bytes),
                    };
                    (messages, types::message("std_msgs", "UInt8MultiArray")?)
                }
                Message::Loaned => {
                    let support = types::bytes(job.payload_bytes)?;
                    let messages = Messages::Loaned {
                        support,
                        borrow: node.function("rmw_borrow_loaned_message")?,
                        publish: node.function("rmw_publish_loaned_message")?,
                        take: node.function("rmw_take_loaned_message_with_info")?,
                        give_back: node.function("rmw_return_loaned_message_from_subscription")?,
                    };
                    (messages, support)
                }
            })
        }
    }
}

fn serialized(bytes: usize) -> rmw_serialized_message_t {
    let buffer = vec![0_u8; bytes].leak().as_mut_ptr();
    // SAFETY: a constant.
    let allocator = unsafe { rcutils_get_default_allocator() };
    rmw_serialized_message_t { buffer, buffer_length: bytes, buffer_capacity: bytes, allocator }
}

impl End {
    fn new(job: &Job, message: Message) -> Result<Self> {
        let node = Node::new(job, &format!("{:?}", job.role).to_lowercase())?;
        let (messages, support) = Messages::new(job, &node, message)?;
        let [to, from] = job.topics();
        let (publisher, subscription) = (node.publisher(support, &to)?, node.subscription(support, &from)?);
        // SAFETY: never freed.
        let lends = unsafe { (*publisher).can_loan_messages && (*subscription).can_loan_messages };
        if matches!(message, Message::Loaned) && !lends {
            return Err("it lends no messages of this type".into());
        }
        Ok(End { publisher, waiting: node.waiting(vec![subscription])?, messages })
    }

    /// The number of the next message, if there is one.
    fn take(&mut self) -> Result<Option<u64>> {
        let (from, mut taken) = (self.waiting.subscriptions[0], false);
        // SAFETY: rmw's protocol; what was sent is as long as it was made, and longer than its header.
        unsafe {
            match &mut self.messages {
                Messages::Struct { take, .. } => {
                    let mut message = Twist::default();
                    checked(take(from, message.place(), &mut taken, null_mut()), "take")?;
                    Ok(taken.then_some(message.0[0].to_bits()))
                }
                Messages::Serialized { take, taken: message, .. } => {
                    checked(take(from, message, &mut taken, null_mut()), "take")?;
                    let number = message.buffer.add(HEADER_BYTES).cast::<u64>().read_unaligned();
                    Ok(taken.then_some(number))
                }
                Messages::Loaned { take, give_back, .. } => {
                    let (mut message, mut info) = (null_mut(), rmw_message_info_t::default());
                    checked(take(from, &mut message, &mut taken, &mut info, null_mut()), "take a loan")?;
                    if !taken {
                        return Ok(None);
                    }
                    let number = message.cast::<u64>().read_unaligned();
                    checked(give_back(from, message), "give a loan back")?;
                    Ok(Some(number))
                }
            }
        }
    }
}

impl Link for End {
    fn send(&mut self, number: u64) -> Result<()> {
        let to = self.publisher;
        // SAFETY: rmw's protocol; longer than its header.
        let code = unsafe {
            match &mut self.messages {
                Messages::Struct { publish, .. } => {
                    let mut message = Twist([f64::from_bits(number), 1.0, 2.0, 3.0, 4.0, 5.0]);
                    publish(to, message.place(), null_mut())
                }
                Messages::Serialized { publish, sent, .. } => {
                    sent.buffer.add(HEADER_BYTES).cast::<u64>().write_unaligned(number);
                    publish(to, sent, null_mut())
                }
                Messages::Loaned { support, borrow, publish, .. } => {
                    let mut message = null_mut();
                    checked(borrow(to, *support, &mut message), "borrow")?;
                    message.cast::<u64>().write_unaligned(number);
                    publish(to, message, null_mut())
                }
            }
        };
        checked(code, "publish")
    }

    fn receive(&mut self, patience: Duration) -> Result<Option<u64>> {
        if self.waiting.wait(patience)? { self.take() } else { Ok(None) }
    }
}
