// SPDX-License-Identifier: MIT OR Apache-2.0
//! `/rosout`: publishes the log lines of a context's nodes.

#[cfg(feature = "rcl_interfaces")]
pub(crate) use topic::Rosout;

#[cfg(feature = "rcl_interfaces")]
mod topic {
    use crate::Qos;
    use crate::logging::line::{Line, floor_char_boundary};
    use std::sync::{Mutex, PoisonError};
    use tautline_ros_msgs::builtin_interfaces::msg::Time;
    use tautline_ros_msgs::rcl_interfaces::msg::Log;
    use tautline_transport::{Claim, Limits, Participant, Publisher, TransportError};

    /// ROS 2's depth. A line is one of our own fixed size, or shortened.
    const DEPTH: usize = 1000;
    const TEXT_BYTES: usize = 3 * 1024;

    /// A context's publisher, made with the first line.
    pub(crate) struct Rosout {
        participant: Participant,
        /// Created once: after a failure it is not tried again.
        publisher: Mutex<Option<Result<Publisher<Log>, TransportError>>>,
    }

    impl Rosout {
        pub(crate) fn new(participant: Participant) -> Rosout {
            Rosout { participant, publisher: Mutex::new(None) }
        }

        pub(in super::super) fn publish(&self, line: &Line<'_>) {
            let mut publisher = self.publisher.lock().unwrap_or_else(PoisonError::into_inner);
            let publisher = publisher.get_or_insert_with(|| {
                self.open().inspect_err(|error| tracing::warn!("/rosout is not published: {error}"))
            });
            let Ok(publisher) = publisher else { return };
            let stamp = Time {
                sec: line.time_ns.div_euclid(1_000_000_000) as i32,
                nanosec: line.time_ns.rem_euclid(1_000_000_000) as u32,
            };
            let text = &line.text[..floor_char_boundary(line.text, TEXT_BYTES)];
            let log = Log {
                stamp,
                level: line.severity as u8,
                name: line.logger.to_owned(),
                msg: text.to_owned(),
                file: line.file.to_owned(),
                function: String::new(),
                line: line.line,
            };
            if let Err(error) = publisher.publish(&log) {
                tracing::warn!("/rosout: {error}");
            }
        }

        fn open(&self) -> Result<Publisher<Log>, TransportError> {
            let qos = Qos::keep_last(DEPTH).transient_local();
            let limits = Limits { may_grow: false, claim: Claim::OnUse, ..Limits::default() };
            self.participant.create_publisher("/rosout", qos, limits)
        }
    }
}

#[cfg(not(feature = "rcl_interfaces"))]
pub(crate) struct Rosout;

#[cfg(not(feature = "rcl_interfaces"))]
impl Rosout {
    pub(crate) fn new(_participant: tautline_transport::Participant) -> Rosout {
        Rosout
    }

    pub(super) fn publish(&self, _line: &super::line::Line<'_>) {}
}
