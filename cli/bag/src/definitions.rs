// SPDX-License-Identifier: MIT OR Apache-2.0
//! Definitions in the form of bags: all types are `package/Name`, also the parts of services and actions, which ROS 2 calls
//! `package/srv/Name_Request`. Readers of bags accept no other form.

use tautline_bag::Topic;
use tautline_schema::{Kind, Schema, SchemaError, TypeName};
use tautline_transport::TopicType;

/// The type of a topic, as its bag states it.
pub fn recorded_type(topic: &Topic) -> TopicType {
    let bare = TopicType::new(topic.type_name.clone());
    if topic.type_hash.is_empty() { bare } else { bare.with_hash(topic.type_hash.clone()) }
}

/// The definition of a topic's type, for a bag.
pub fn for_bag(schema: &Schema) -> String {
    let folded = |word: &str| match word.split_once('/') {
        Some((package, rest)) => match rest.split_once('/') {
            Some(("srv" | "action" | "msg", name)) => format!("{package}/{name}"),
            _ => word.to_owned(),
        },
        None => word.to_owned(),
    };
    renamed(&schema.to_text(), folded)
}

/// The definition of a topic's type, from a bag. Types whose names begin like the topic's own, `AddTwoInts_`, have its kind.
///
/// # Errors
/// The text is no definition.
pub fn from_bag(name: &TypeName, text: &str) -> Result<Schema, SchemaError> {
    let stem = match name.name().split_once('_') {
        Some((stem, _)) if name.kind() != Kind::Msg => format!("{}/{stem}_", name.package()),
        _ => return Schema::from_text(name, text),
    };
    let unfolded = |word: &str| match word.starts_with(&stem) {
        true => word.replacen('/', &format!("/{}/", name.kind().as_str()), 1),
        false => word.to_owned(),
    };
    Schema::from_text(name, &renamed(text, unfolded))
}

/// Renames each type: types are the first word of a field, and the second of a line `MSG: package/Name`.
fn renamed(text: &str, name: impl Fn(&str) -> String) -> String {
    let renamed = |line: &str| {
        let (front, rest) = match line.strip_prefix("MSG: ") {
            Some(rest) => ("MSG: ", rest),
            None => ("", line),
        };
        let end = rest.find(char::is_whitespace).unwrap_or(rest.len());
        format!("{front}{}{}\n", name(&rest[..end]), &rest[end..])
    };
    text.lines().map(renamed).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use tautline_definitions::find_schema;

    #[test]
    fn parts_of_services_and_actions_come_back() {
        for (of, part) in [
            ("example_interfaces/srv/AddTwoInts", "example_interfaces/srv/AddTwoInts_Event"),
            (
                "example_interfaces/action/Fibonacci_SendGoal",
                "example_interfaces/action/Fibonacci_SendGoal_Event",
            ),
            (
                "example_interfaces/action/Fibonacci_FeedbackMessage",
                "example_interfaces/action/Fibonacci_FeedbackMessage",
            ),
            ("action_msgs/msg/GoalStatusArray", "action_msgs/msg/GoalStatusArray"),
            ("lifecycle_msgs/srv/ChangeState", "lifecycle_msgs/srv/ChangeState_Event"),
        ] {
            let name = part.parse().unwrap();
            let schema = find_schema("", &of.parse().unwrap(), None).unwrap();
            let schema = if of == part { (*schema).clone() } else { schema.of_part(&name).unwrap() };
            let text = for_bag(&schema);
            assert!(
                !text.contains("/srv/") && !text.contains("/action/") && !text.contains("/msg/"),
                "{text}"
            );
            assert_eq!(from_bag(&name, &text).unwrap().hash(), schema.hash(), "{text}");
        }
    }
}
