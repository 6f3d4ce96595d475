// SPDX-License-Identifier: MIT OR Apache-2.0
//! The services and topics of an action.

use tautline_transport::Qos;

/// The services and topics of an action.
pub(super) struct Names {
    pub(super) send_goal: String,
    pub(super) cancel_goal: String,
    pub(super) get_result: String,
    pub(super) feedback: String,
    pub(super) status: String,
}

impl Names {
    pub(super) fn of(action: &str) -> Self {
        let part = |part: &str| format!("{action}/_action/{part}");
        Names {
            send_goal: part("send_goal"),
            cancel_goal: part("cancel_goal"),
            get_result: part("get_result"),
            feedback: part("feedback"),
            status: part("status"),
        }
    }
}

/// Queue depth of a client's subscription to feedback, and of one goal's feedback for its reader.
pub(super) const FEEDBACK_DEPTH: usize = 1000;

pub(super) fn feedback_qos() -> Qos {
    Qos::keep_last(FEEDBACK_DEPTH)
}

/// The QoS of a server's services and feedback: many results may be awaited at once.
pub(super) fn qos() -> Qos {
    Qos::keep_last(100)
}

/// The QoS of the status: the newest one, also for late joiners.
pub(super) fn status_qos() -> Qos {
    Qos::keep_last(1).transient_local()
}
