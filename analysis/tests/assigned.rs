// SPDX-License-Identifier: MIT OR Apache-2.0
//! The priorities that a system file leaves open, beside those that it states.
use tautline_analysis::file::{CheckedSystem, SystemFile};

fn check(text: &str) -> CheckedSystem {
    SystemFile::parse(text).unwrap_or_else(|problems| panic!("{problems}\n{text}")).check()
}

fn priorities(checked: &CheckedSystem) -> Vec<(&str, u8)> {
    checked.callbacks.iter().map(|callback| (callback.entry.name.as_str(), callback.entry.priority)).collect()
}

/// By hand: below, `late` ends 55 ms after it comes, which is 20 ms late, and `tight` 55 ms after its release. Without `first` the last place
/// would do for `late`: 25 + 20 ms.
#[test]
fn the_search_for_an_order_knows_the_priorities_that_are_stated() {
    let checked = check(
        "[hosts.h]\ncores = 1\n[priorities]\npolicy = \"audsley\"\n[nodes.n]\n\
         [callbacks.first]\nperiod = \"20ms\"\nwcet = \"10ms\"\npriority = 85\n\
         [callbacks.late]\nperiod = \"100ms\"\njitter = \"20ms\"\nwcet = \"10ms\"\ndeadline = \"60ms\"\n\
         [callbacks.tight]\nperiod = \"100ms\"\nwcet = \"15ms\"\ndeadline = \"56ms\"\n",
    );
    assert_eq!(priorities(&checked), [("first", 85), ("late", 80), ("tight", 79)]);
    assert!(checked.schedulable, "{checked:?}");
}

/// A reservation takes as much from core 1, if it may run there: below, `late` ends at 55 + 20 ms, without the reservation at 25 + 20 ms.
#[test]
fn the_search_for_an_order_knows_reservations_of_other_cores() {
    let checked = check(
        "[hosts.h]\ncores = 2\n[priorities]\npolicy = \"audsley\"\n[nodes.m]\ncore = 0\n[nodes.n]\ncore = 1\n\
         [callbacks.first]\nnode = \"m\"\nperiod = \"40ms\"\nwcet = \"9ms\"\n\
         core = \"any\"\nreservation = { runtime = \"10ms\", period = \"40ms\" }\n\
         [callbacks.late]\nnode = \"n\"\nperiod = \"200ms\"\njitter = \"20ms\"\nwcet = \"10ms\"\ndeadline = \"70ms\"\n\
         [callbacks.tight]\nnode = \"n\"\nperiod = \"200ms\"\nwcet = \"15ms\"\ndeadline = \"66ms\"\n",
    );
    assert_eq!(priorities(&checked), [("first", 100), ("late", 80), ("tight", 79)]);
    assert!(checked.schedulable, "{checked:?}");
}

#[test]
fn no_priority_is_chosen_that_is_not_below_the_samplers() {
    let text = |sampler: u8, shared: &str| {
        format!(
            "[hosts.h]\ncores = 1\nsampler_priority = {sampler}\n[nodes.n]\n[groups.g]\n\
             [callbacks.fast]\nperiod = \"10ms\"\nwcet = \"1ms\"\n{shared}\n\
             [callbacks.slow]\nperiod = \"20ms\"\nwcet = \"1ms\"\ngroup = \"g\"\n"
        )
    };
    for (sampler, expected) in [(90, [80, 79]), (81, [80, 79]), (50, [49, 48]), (3, [2, 1])] {
        let checked = check(&text(sampler, ""));
        assert_eq!(priorities(&checked), [("fast", expected[0]), ("slow", expected[1])], "{sampler}");
        assert!(checked.schedulable, "{checked:?}");
    }
    let few = SystemFile::parse(&text(2, "")).unwrap_err().to_string();
    assert!(few.contains("2 priorities are needed but only 1 are free: raise `priorities.highest`"), "{few}");
    assert_eq!(priorities(&check(&text(2, "group = \"g\""))), [("fast", 1), ("slow", 1)]);
}
