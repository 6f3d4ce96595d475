// SPDX-License-Identifier: MIT OR Apache-2.0
//! Quality of service in bags: a YAML list of the QoS that a topic's publishers offered.

use serde::Deserialize;
use std::time::Duration;
use tautline_transport::{Durability, History, Limits, Liveliness, Qos, Reliability};

/// ROS 2's value for "no time".
const NONE: Duration = Duration::new(9_223_372_036, 854_775_807);

/// One entry of the list, in the form of rosbag2's version 9.
pub fn write(qos: &Qos) -> String {
    let time = |time: Option<Duration>| {
        let time = time.unwrap_or(NONE);
        format!("\n    sec: {}\n    nsec: {}", time.as_secs(), time.subsec_nanos())
    };
    let history = if qos.history == History::KeepAll { "keep_all" } else { "keep_last" };
    let reliability = if qos.reliability == Reliability::Reliable { "reliable" } else { "best_effort" };
    let durability =
        if qos.durability == Durability::TransientLocal { "transient_local" } else { "volatile" };
    let liveliness = if qos.liveliness == Liveliness::Automatic { "automatic" } else { "manual_by_topic" };
    format!(
        "- history: {history}\n  depth: {}\n  reliability: {reliability}\n  durability: {durability}\n  deadline:{}\n  lifespan:{}\n  \
         liveliness: {liveliness}\n  liveliness_lease_duration:{}\n  avoid_ros_namespace_conventions: false\n",
        qos.depth,
        time(qos.deadline),
        time(qos.lifespan),
        time(qos.liveliness_lease_duration),
    )
}

/// The QoS of one publisher that replaces all publishers of the list: every subscription that matched one of them matches it, and a late
/// joiner gets what all of them had kept.
///
/// # Errors
/// The text is not such a list.
pub fn read(text: &str) -> Result<Qos, String> {
    let words = tautline_bag::in_words(text)?;
    let offers: Vec<Offer> = serde_saphyr::from_str(&words).map_err(|error| error.to_string())?;
    let strongest = |one: Qos, other: Qos| Qos {
        history: if one.history == History::KeepAll { one.history } else { other.history },
        depth: match (one.durability, other.durability) {
            (Durability::TransientLocal, Durability::TransientLocal) => one.depth + other.depth,
            (Durability::TransientLocal, _) => one.depth,
            (_, Durability::TransientLocal) => other.depth,
            _ => one.depth.max(other.depth),
        }
        .min(Limits::MAX_DEPTH),
        reliability: if one.reliability == Reliability::Reliable {
            one.reliability
        } else {
            other.reliability
        },
        durability: if one.durability == Durability::TransientLocal {
            one.durability
        } else {
            other.durability
        },
        deadline: one.deadline.into_iter().chain(other.deadline).min(),
        lifespan: one.lifespan.zip(other.lifespan).map(|(one, other)| one.max(other)),
        liveliness: if one.liveliness == Liveliness::Automatic { other.liveliness } else { one.liveliness },
        liveliness_lease_duration: one
            .liveliness_lease_duration
            .into_iter()
            .chain(other.liveliness_lease_duration)
            .min(),
    };
    Ok(offers.iter().map(Offer::qos).reduce(strongest).unwrap_or_default())
}

#[derive(Deserialize)]
struct Offer {
    history: String,
    depth: u64,
    reliability: String,
    durability: String,
    deadline: Span,
    lifespan: Span,
    liveliness: String,
    liveliness_lease_duration: Span,
}

#[derive(Deserialize)]
struct Span {
    sec: u64,
    nsec: u64,
}

impl Span {
    /// The time; `None` if it is unspecified (zero) or infinite, for which there are several values.
    fn get(&self) -> Option<Duration> {
        let time = Duration::from_secs(self.sec).saturating_add(Duration::from_nanos(self.nsec));
        let is_none = time.is_zero() || time >= NONE || self.sec >= i32::MAX as u64;
        (!is_none).then_some(time)
    }
}

impl Offer {
    /// The system's defaults, and policies that Tautline does not have, are those of a reliable publisher that keeps nothing for late joiners.
    fn qos(&self) -> Qos {
        // A depth of 0 stands for the system's default, which the bag does not state.
        let depth = if self.depth == 0 { Qos::default().depth } else { self.depth as usize };
        let depth = depth.min(Limits::MAX_DEPTH);
        let qos = if self.history == "keep_all" { Qos::keep_all(depth) } else { Qos::keep_last(depth) };
        let qos = if self.reliability == "best_effort" { qos.best_effort() } else { qos };
        let qos = if self.durability == "transient_local" { qos.transient_local() } else { qos };
        let is_manual = self.liveliness == "manual_by_topic";
        Qos {
            deadline: self.deadline.get(),
            lifespan: self.lifespan.get(),
            liveliness: if is_manual { Liveliness::ManualByTopic } else { Liveliness::Automatic },
            liveliness_lease_duration: self.liveliness_lease_duration.get(),
            ..qos
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_written_is_read() {
        let ms = |ms| Some(Duration::from_millis(ms));
        let first = Qos { deadline: ms(20), lifespan: ms(1500), ..Qos::keep_last(3).best_effort() };
        let second = Qos {
            liveliness: Liveliness::ManualByTopic,
            liveliness_lease_duration: ms(7),
            ..Qos::keep_all(5).transient_local()
        };
        assert_eq!(read(&write(&first)), Ok(first));
        assert_eq!(read(&write(&second)), Ok(second));
        let both = Qos { deadline: ms(20), ..second };
        assert_eq!(read(&[first, second].map(|qos| write(&qos)).concat()), Ok(both));
        // What two publishers keep is kept together.
        let twice = Qos { depth: 10, ..second };
        assert_eq!(read(&[second, second].map(|qos| write(&qos)).concat()), Ok(twice));
        assert_eq!((read(""), read("[]")), (Ok(Qos::default()), Ok(Qos::default())));
    }

    #[test]
    fn what_rosbag2_wrote_before_is_read() {
        let infinite = "{sec: 2147483647, nsec: 4294967295}";
        let text = format!(
            "- history: 3\n  depth: 0\n  reliability: 1\n  durability: 2\n  deadline: {infinite}\n  lifespan: {infinite}\n  \
             liveliness: 1\n  liveliness_lease_duration: {infinite}\n  avoid_ros_namespace_conventions: false"
        );
        assert_eq!(read(&text), Ok(Qos::default()));
        let text = text.replace("history: 3", "history: 2").replace("depth: 0", "depth: 4");
        let text = text.replace("reliability: 1", "reliability: 2").replace("durability: 2", "durability: 1");
        assert_eq!(read(&text), Ok(Qos::keep_all(4).best_effort().transient_local()));
        for wrong in ["x", "- depth: 1", "- [", &text.replace("history: 2", "history: some")] {
            assert!(read(wrong).is_err(), "{wrong}");
        }
    }
}
