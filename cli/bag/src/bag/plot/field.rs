// SPDX-License-Identifier: MIT OR Apache-2.0
//! Parses the name of a field, and checks that it can be drawn.

use std::fmt;
use taut_cli::arguments::full_name;
use taut_cli::verb::{Failure, Outcome, did_you_mean};
use tautline_schema::{Base, Definition, FieldType, Primitive, Schema, Shape};

/// The maximum number of names that an error lists.
const MOST_NAMES: usize = 30;

/// A field of a topic's messages.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Wanted {
    pub topic: String,
    /// The path of the field, in the form of `DynamicMessage::get`.
    pub path: String,
}

impl fmt::Display for Wanted {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}.{}", self.topic, self.path)
    }
}

impl Wanted {
    /// Splits at the first dot, because names of topics have no dots.
    pub fn parse(text: &str) -> Result<Self, String> {
        match text.split_once('.') {
            Some((topic, path)) if !topic.is_empty() && !path.is_empty() => {
                Ok(Wanted { topic: full_name(topic), path: path.to_owned() })
            }
            _ => Err("a topic, a dot and a field, such as /odom.pose.pose.position.x".to_owned()),
        }
    }

    /// The primitive type of the field, a number or a bool, by the type of the topic.
    ///
    /// # Errors
    /// There is no such field, or it is neither a number nor a bool.
    pub fn check(&self, schema: &Schema) -> Outcome<Primitive> {
        let (mut definition, mut above) = (schema.definition(), self.topic.clone());
        let mut parts = self.path.split('.').peekable();
        while let Some(part) = parts.next() {
            let (name, index) =
                indexed(part).map_err(|error| Failure::unusable(format!("{self}: {error}")))?;
            let Some(field) = definition.fields.iter().find(|field| field.name == name) else {
                let what = format!("field '{name}' in {above}, a {}", definition.name);
                return Err(missing(&what, name, names(definition)));
            };
            let path = format!("{above}.{name}");
            let refuse =
                |what: String| Err(Failure::unusable(format!("{path} is {}{what}", article(&field.ty))));
            match (field.ty.shape, index) {
                (Shape::Single, None) => {}
                (Shape::Single, Some(_)) => return refuse(", which has no elements".to_owned()),
                (_, None) => return refuse(format!(": name an element, such as {path}[0]")),
                (Shape::Array(len) | Shape::Bounded(len), Some(index)) if index >= len as usize => {
                    return refuse(format!(", which has no element {index}"));
                }
                (_, Some(_)) => {}
            }
            above = path.clone() + &part[name.len()..];
            let is_last = parts.peek().is_none();
            match &field.ty.base {
                Base::Primitive(primitive) if is_last => return Ok(*primitive),
                Base::Nested(name) => {
                    let inner = schema.referenced().find(|definition| definition.name == *name);
                    let Some(inner) = inner else { return refuse(", which is not defined".to_owned()) };
                    if is_last {
                        let names = list(names(inner));
                        return refuse(format!(": name a field of it: {names}"));
                    }
                    definition = inner;
                }
                _ if is_last => return refuse(": numbers and bools can be drawn".to_owned()),
                _ => return refuse(", which has no fields".to_owned()),
            }
        }
        Err(Failure::unusable(format!("{self} names no field")))
    }
}

/// A name and its index.
fn indexed(part: &str) -> Result<(&str, Option<usize>), String> {
    let Some((name, rest)) = part.split_once('[') else { return Ok((part, None)) };
    let index = rest.strip_suffix(']').and_then(|index| index.parse().ok());
    Ok((name, Some(index.ok_or_else(|| format!("'{part}' is no field and no field[index]"))?)))
}

fn article(ty: &FieldType) -> String {
    let ty = ty.to_string();
    format!("{} {ty}", if ty.starts_with(['a', 'e', 'i', 'o']) { "an" } else { "a" })
}

fn names(definition: &Definition) -> impl Iterator<Item = &str> + Clone {
    definition.fields.iter().map(|field| &*field.name)
}

fn list<'n>(names: impl Iterator<Item = &'n str>) -> String {
    let names: Vec<_> = names.collect();
    let more = names.len().saturating_sub(MOST_NAMES);
    let shown = names[..names.len() - more].join(", ");
    if more > 0 { format!("{shown} and {more} more") } else { shown }
}

/// The failure that there is no `what`, with the names that exist and the one that is most similar to `name`.
pub fn missing<'n>(what: &str, name: &str, there: impl Iterator<Item = &'n str> + Clone) -> Failure {
    let meant = did_you_mean(name, there.clone());
    Failure::no(format!("there is no {what};{meant} it has {}", list(there)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_cannot_be_drawn_is_said() {
        let text = "builtin_interfaces/Time stamp\nfloat32[] ranges\nParts[3] parts\nstring name\nbool on\nuint8[4] few\n===\n\
                    MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n===\nMSG: demo_msgs/Parts\nbuiltin_interfaces/Time at\n";
        let schema = Schema::from_text(&"demo_msgs/msg/Scan".parse().unwrap(), text).unwrap();
        let check = |path: &str| Wanted::parse(&format!("scan.{path}")).unwrap().check(&schema);
        for path in ["stamp.sec", "ranges[700]", "parts[2].at.nanosec", "on", "few[3]"] {
            assert!(check(path).is_ok(), "{path}");
        }
        for (path, error) in [
            (
                "stmp",
                "there is no field 'stmp' in /scan, a demo_msgs/msg/Scan; did you mean stamp? it has stamp, ranges, parts, name, on, few",
            ),
            (
                "stamp.x",
                "there is no field 'x' in /scan.stamp, a builtin_interfaces/msg/Time; it has sec, nanosec",
            ),
            ("stamp", "/scan.stamp is a builtin_interfaces/Time: name a field of it: sec, nanosec"),
            ("ranges", "/scan.ranges is a float32[]: name an element, such as /scan.ranges[0]"),
            ("ranges[0].x", "/scan.ranges is a float32[], which has no fields"),
            ("ranges[x]", "/scan.ranges[x]: 'ranges[x]' is no field and no field[index]"),
            ("parts[3].at.sec", "/scan.parts is a demo_msgs/Parts[3], which has no element 3"),
            ("name", "/scan.name is a string: numbers and bools can be drawn"),
            ("on[0]", "/scan.on is a bool, which has no elements"),
        ] {
            assert_eq!(check(path).unwrap_err().to_string(), error, "{path}");
        }
        for wrong in ["/scan", "scan.", ".x", ""] {
            assert!(Wanted::parse(wrong).is_err(), "{wrong}");
        }
    }
}
