// SPDX-License-Identifier: MIT OR Apache-2.0
//! The order in which the samples of a publisher are used again.

mod support;

use std::ptr::from_ref;
use support::domain;
use tautline_rt::Caches;
use tautline_transport::{Limits, Participant, Qos, RawLoan, RawPublisher, TopicType};

/// Loans some samples, frees the last one first, then the others in their order, and says where what is loaned then lies among those.
fn again(publisher: &RawPublisher, bytes: usize) -> Vec<usize> {
    let place = |loan: &RawLoan<'_>| from_ref::<[u8]>(loan).addr();
    let mut loans: Vec<_> = (0..3).map(|_| publisher.loan(bytes).unwrap()).collect();
    loans.rotate_right(1);
    let places: Vec<_> = loans.iter().map(place).collect();
    loans.into_iter().for_each(drop);
    let later: Vec<_> = (0..3).map(|_| publisher.loan(bytes).unwrap()).collect();
    later.iter().map(|loan| places.iter().position(|known| *known == place(loan)).unwrap()).collect()
}

#[test]
fn samples_are_used_in_the_order_in_which_they_were_freed_where_caches_gain_by_it() {
    let participant = Participant::new(domain(144)).unwrap();
    let Caches { l2_bytes, l3_bytes } = Caches::of_machine();
    for (bytes, in_turn) in [(64, false), (4 << 10, false), (64 << 10, l3_bytes / 4 > 2 * l2_bytes)] {
        // As many as are loaned, in whole pages.
        let limits = Limits { message_bytes: bytes, loans: 3, ..Limits::default() };
        let topic = format!("/reuse_{bytes}");
        let topic_type = TopicType::new("test_msgs/msg/Bytes");
        let publisher =
            participant.create_raw_publisher(&topic, &topic_type, Qos::keep_last(1), limits).unwrap();
        let all = again(&publisher, bytes);
        let expected = if in_turn { [0, 1, 2] } else { [2, 1, 0] };
        assert_eq!(all, expected, "{bytes} bytes");
    }
}
