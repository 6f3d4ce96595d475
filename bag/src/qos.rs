// SPDX-License-Identifier: MIT OR Apache-2.0
//! QoS profiles as rosbag2 writes them: words since version 9 of `metadata.yaml`, rmw's numbers before.

use serde::Deserialize;
use std::fmt::Write;

const HISTORY: &[&str] = &["system_default", "keep_last", "keep_all", "unknown"];
const RELIABILITY: &[&str] = &["system_default", "reliable", "best_effort", "unknown", "best_available"];
const DURABILITY: &[&str] = &["system_default", "transient_local", "volatile", "unknown", "best_available"];
const LIVELINESS: &[&str] =
    &["system_default", "automatic", "manual_by_node", "manual_by_topic", "unknown", "best_available"];

#[derive(Deserialize)]
struct Profile {
    history: Policy,
    depth: u64,
    reliability: Policy,
    durability: Policy,
    #[serde(default)]
    deadline: Span,
    #[serde(default)]
    lifespan: Span,
    liveliness: Policy,
    #[serde(default)]
    liveliness_lease_duration: Span,
    #[serde(default)]
    avoid_ros_namespace_conventions: bool,
}

#[derive(Deserialize)]
#[serde(untagged)]
enum Policy {
    Number(i64),
    Name(String),
}

#[derive(Deserialize, Default)]
struct Span {
    sec: u64,
    nsec: u64,
}

impl Policy {
    fn name(&self, names: &[&'static str]) -> Result<&'static str, String> {
        match self {
            // A later ROS 2 may have more policies.
            Policy::Number(number) => {
                let known = usize::try_from(*number).ok().and_then(|number| names.get(number));
                Ok(known.copied().unwrap_or("unknown"))
            }
            Policy::Name(name) => {
                let known = names.iter().find(|known| **known == name.to_ascii_lowercase());
                known.copied().ok_or_else(|| format!("'{name}' is none of {}", names.join(", ")))
            }
        }
    }
}

/// Converts a list of profiles of any version of rosbag2 to one with words for the policies; empty for an empty text.
///
/// # Errors
/// The text is no such list.
pub fn in_words(text: &str) -> Result<String, String> {
    if text.trim().is_empty() {
        return Ok(String::new());
    }
    let profiles: Vec<Profile> = serde_saphyr::from_str(text).map_err(|error| error.to_string())?;
    let mut out = String::new();
    for profile in &profiles {
        let span = |Span { sec, nsec }: &Span| format!("\n    sec: {sec}\n    nsec: {nsec}");
        // Writing to a String does not fail.
        let _ = writeln!(
            out,
            "- history: {}\n  depth: {}\n  reliability: {}\n  durability: {}\n  deadline:{}\n  lifespan:{}\n  liveliness: {}\n  \
             liveliness_lease_duration:{}\n  avoid_ros_namespace_conventions: {}",
            profile.history.name(HISTORY)?,
            profile.depth,
            profile.reliability.name(RELIABILITY)?,
            profile.durability.name(DURABILITY)?,
            span(&profile.deadline),
            span(&profile.lifespan),
            profile.liveliness.name(LIVELINESS)?,
            span(&profile.liveliness_lease_duration),
            profile.avoid_ros_namespace_conventions,
        );
    }
    Ok(out)
}

/// Joins two lists, without duplicates; a list that cannot be read is left out.
pub fn joined(one: &str, other: &str) -> String {
    let [one, other] = [one, other].map(|text| in_words(text).unwrap_or_default());
    let profiles = |text: &str| -> Vec<String> {
        let parts = text.split("- history").skip(1);
        parts.map(|profile| format!("- history{profile}")).collect()
    };
    let known = profiles(&one);
    one + &profiles(&other).into_iter().filter(|profile| !known.contains(profile)).collect::<String>()
}

#[cfg(test)]
mod tests {
    use super::{in_words, joined};

    #[test]
    fn numbers_become_words() {
        let text = "- history: 1\n  depth: 7\n  reliability: 2\n  durability: 1\n  deadline: {sec: 2147483647, nsec: 4294967295}\n  \
                    lifespan: {sec: 0, nsec: 5}\n  liveliness: 3\n  liveliness_lease_duration: {sec: 1, nsec: 2}\n  \
                    avoid_ros_namespace_conventions: true\n";
        let words = in_words(text).unwrap();
        for part in [
            "- history: keep_last\n  depth: 7\n  reliability: best_effort\n  durability: transient_local\n",
            "deadline:\n    sec: 2147483647\n    nsec: 4294967295\n  lifespan:\n    sec: 0\n    nsec: 5\n",
            "liveliness: manual_by_topic\n  liveliness_lease_duration:\n    sec: 1\n    nsec: 2\n",
            "avoid_ros_namespace_conventions: true\n",
        ] {
            assert!(words.contains(part), "{part}: {words}");
        }
        assert_eq!(in_words(&words).as_ref(), Ok(&words));
        assert_eq!([in_words(""), in_words("[]\n")], [Ok(String::new()), Ok(String::new())]);
        let other = in_words(&text.replace("depth: 7", "depth: 8")).unwrap();
        assert_eq!(joined(text, &other), format!("{words}{other}"));
        assert_eq!((joined(&words, text), joined("- [", text)), (words.clone(), words.clone()));
        for unknown in ["9", "-1"] {
            let words = in_words(&text.replace("history: 1", &format!("history: {unknown}"))).unwrap();
            assert!(words.starts_with("- history: unknown\n"), "{words}");
        }
        for wrong in ["x", "- depth: 1", "- [", &text.replace("history: 1", "history: some")] {
            assert!(in_words(wrong).is_err(), "{wrong}");
        }
    }
}
