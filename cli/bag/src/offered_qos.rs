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
/// The text is not such a list, or it has a policy that Tautline does not have.
pub fn read(text: &str) -> Result<Qos, String> {
    let words = tautline_bag::in_words(text)?;
    let offers: Vec<Offer> = serde_saphyr::from_str(&words).map_err(|error| error.to_string())?;
    let earliest = |one: Option<Duration>, other| one.into_iter().chain(other).min();
    let strongest = |one: Qos, other: Qos| Qos {
        history: stronger(History::KeepAll, one.history, other.history),
        depth: match (one.durability, other.durability) {
            (Durability::TransientLocal, Durability::TransientLocal) => one.depth + other.depth,
            (Durability::TransientLocal, _) => one.depth,
            (_, Durability::TransientLocal) => other.depth,
            _ => one.depth.max(other.depth),
        }
        .min(Limits::MAX_DEPTH),
        reliability: stronger(Reliability::Reliable, one.reliability, other.reliability),
        durability: stronger(Durability::TransientLocal, one.durability, other.durability),
        deadline: earliest(one.deadline, other.deadline),
        lifespan: one.lifespan.zip(other.lifespan).map(|(one, other)| one.max(other)),
        liveliness: stronger(Liveliness::ManualByTopic, one.liveliness, other.liveliness),
        liveliness_lease_duration: earliest(one.liveliness_lease_duration, other.liveliness_lease_duration),
    };
    let each = offers.iter().map(Offer::qos);
    each.reduce(|one, other| Ok(strongest(one?, other?))).unwrap_or_else(|| Ok(Qos::default()))
}

/// The strong one of two values of a policy if it is among them.
fn stronger<T: PartialEq>(strong: T, one: T, other: T) -> T {
    if one == strong { one } else { other }
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

/// Returns whether `found` is the second of two policies; the system's default and unknown ones count as the first.
fn is_second(found: &str, [first, second]: [&str; 2]) -> Result<bool, String> {
    match found {
        _ if found == second => Ok(true),
        _ if found == first || ["system_default", "unknown"].contains(&found) => Ok(false),
        _ => Err(format!("'{found}' is neither {first} nor {second}")),
    }
}

impl Offer {
    fn qos(&self) -> Result<Qos, String> {
        // A depth of 0 stands for the system's default, which the bag does not state.
        let depth = if self.depth == 0 { Qos::default().depth } else { self.depth as usize };
        let depth = depth.min(Limits::MAX_DEPTH);
        let keeps_all = is_second(&self.history, ["keep_last", "keep_all"])?;
        let qos = if keeps_all { Qos::keep_all(depth) } else { Qos::keep_last(depth) };
        let is_best_effort = is_second(&self.reliability, ["reliable", "best_effort"])?;
        let qos = if is_best_effort { qos.best_effort() } else { qos };
        let is_kept = is_second(&self.durability, ["volatile", "transient_local"])?;
        let qos = if is_kept { qos.transient_local() } else { qos };
        let is_manual = is_second(&self.liveliness, ["automatic", "manual_by_topic"])?;
        Ok(Qos {
            deadline: self.deadline.get(),
            lifespan: self.lifespan.get(),
            liveliness: if is_manual { Liveliness::ManualByTopic } else { Liveliness::Automatic },
            liveliness_lease_duration: self.liveliness_lease_duration.get(),
            ..qos
        })
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
        for (number, expected) in [
            ("history: 2", Qos { history: History::KeepLast, ..read(&text).unwrap() }),
            ("reliability: 2", Qos { reliability: Reliability::Reliable, ..read(&text).unwrap() }),
            ("durability: 1", Qos { durability: Durability::Volatile, ..read(&text).unwrap() }),
            ("liveliness: 1", read(&text).unwrap()),
        ] {
            let (name, _) = number.split_once(':').unwrap();
            for unknown in ["9", "-1"] {
                let text = text.replace(number, &format!("{name}: {unknown}"));
                assert_eq!(read(&text), Ok(expected), "{text}");
            }
        }
        for wrong in ["x", "- depth: 1", "- [", &text.replace("history: 2", "history: some")] {
            assert!(read(wrong).is_err(), "{wrong}");
        }
        for (number, word) in [
            ("reliability: 2", "reliability: best_available"),
            ("durability: 1", "durability: best_available"),
            ("liveliness: 1", "liveliness: manual_by_node"),
            ("liveliness: 1", "liveliness: best_available"),
        ] {
            let refusal = read(&text.replace(number, word)).unwrap_err();
            assert!(refusal.contains(word.split_once(": ").unwrap().1), "{refusal}");
        }
    }
}
