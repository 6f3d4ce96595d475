// SPDX-License-Identifier: MIT OR Apache-2.0
//! The paths of a type's fields.

use tautline_schema::{Base, Definition, Schema, Shape};

/// The maximum number of candidates.
const MOST: usize = 1000;

/// The paths that begin with `typed`, as `taut topic echo --field` reads them, with elements of lists if `typed` contains a bracket.
pub fn of(schema: &Schema, typed: &str) -> Vec<(String, String)> {
    let mut found = Vec::new();
    let (numbered, begin) = (typed.contains('['), with_zeros(typed));
    add(schema, schema.definition(), "", &begin, numbered, &mut found);
    // Every element has the fields of the first one.
    let of_typed = |(path, of_type): (String, String)| (format!("{typed}{}", &path[begin.len()..]), of_type);
    found.into_iter().map(of_typed).collect()
}

fn add(
    schema: &Schema,
    definition: &Definition,
    above: &str,
    begin: &str,
    numbered: bool,
    found: &mut Vec<(String, String)>,
) {
    for field in &definition.fields {
        if found.len() >= MOST {
            return;
        }
        let path = format!("{above}{}", field.name);
        let is_list = field.ty.shape != Shape::Single;
        let element = if is_list { format!("{path}[0]") } else { path.clone() };
        let paths = if is_list { vec![path, element.clone()] } else { vec![path] };
        for path in paths.into_iter().take(if numbered { 2 } else { 1 }) {
            if path.starts_with(begin) {
                found.push((path, field.ty.to_string()));
            }
        }
        let Base::Nested(name) = &field.ty.base else { continue };
        let below = format!("{element}.");
        let is_on_the_way = below.starts_with(begin) || begin.starts_with(&below);
        if is_on_the_way
            && (numbered || !is_list)
            && let Some(inner) = schema.referenced().find(|definition| definition.name == *name)
        {
            add(schema, inner, &below, begin, numbered, found);
        }
    }
}

/// The path with 0 in place of each index.
fn with_zeros(typed: &str) -> String {
    let mut parts = typed.split('[');
    let first = parts.next().unwrap_or_default().to_owned();
    parts.fold(first, |text, part| {
        let rest = part.trim_start_matches(|c: char| c.is_ascii_digit());
        let zero = if rest.len() < part.len() { "0" } else { "" };
        text + "[" + zero + rest
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_are_those_that_echo_takes() {
        let text = "builtin_interfaces/Time stamp\nfloat32[] ranges\nParts[3] parts\nstring name\n===\nMSG: builtin_interfaces/Time\n\
                    int32 sec\nuint32 nanosec\n===\nMSG: demo_msgs/Parts\nbuiltin_interfaces/Time at\nuint8[] bytes\n";
        let schema = Schema::from_text(&"demo_msgs/msg/Scan".parse().unwrap(), text).unwrap();
        let found =
            |typed: &str| of(&schema, typed).into_iter().map(|(path, _)| path).collect::<Vec<_>>().join(" ");
        assert_eq!(found(""), "stamp stamp.sec stamp.nanosec ranges parts name");
        assert_eq!(found("stamp."), "stamp.sec stamp.nanosec");
        assert_eq!(found("pa"), "parts");
        assert_eq!(found("ranges["), "ranges[0]");
        assert_eq!(found("ranges[12"), "ranges[12]");
        assert_eq!(
            found("parts[2]"),
            "parts[2] parts[2].at parts[2].at.sec parts[2].at.nanosec parts[2].bytes parts[2].bytes[0]"
        );
        assert_eq!(found("parts[2].at.s"), "parts[2].at.sec");
        assert_eq!(found("none.x"), "");
        assert_eq!(of(&schema, "stamp.s"), [("stamp.sec".into(), "int32".into())]);
    }
}
