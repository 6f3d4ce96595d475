// SPDX-License-Identifier: MIT OR Apache-2.0
//! Parameter files as ROS 2 writes them.

use super::value::to_json;
use serde_json::{Map, Value, json};
use std::collections::BTreeMap;
use tautline::ParameterValue;

/// The parameter file of a node with these parameters. Names with dots become nested mappings, unless the part before the dot is a
/// parameter, too.
pub fn yaml(node: &str, parameters: &[(String, ParameterValue)]) -> String {
    let set = set(parameters).map(|(name, value)| (&**name, value));
    let mut text = String::new();
    write("    ", set.collect(), &mut text);
    let below = if text.is_empty() { " {}\n".into() } else { format!("\n{text}") };
    format!("{}:\n  ros__parameters:{below}", string(node))
}

/// The parameters as JSON, with dotted names.
pub fn json(node: &str, parameters: &[(String, ParameterValue)]) -> Value {
    let values: Map<_, _> = set(parameters).map(|(name, value)| (name.clone(), to_json(value))).collect();
    json!({ node: { "ros__parameters": values } })
}

fn set(parameters: &[(String, ParameterValue)]) -> impl Iterator<Item = &(String, ParameterValue)> {
    parameters.iter().filter(|(_, value)| *value != ParameterValue::NotSet)
}

fn write(margin: &str, parameters: Vec<(&str, &ParameterValue)>, text: &mut String) {
    let mut groups: BTreeMap<&str, Vec<_>> = BTreeMap::new();
    for (name, value) in parameters {
        let first = name.split('.').next().unwrap_or(name);
        groups.entry(first).or_default().push((name, value));
    }
    for (first, group) in groups {
        if group.iter().any(|(name, _)| *name == first) {
            group.iter().for_each(|(name, value)| entry(margin, name, value, text));
            continue;
        }
        *text += &format!("{margin}{}:\n", string(first));
        let below = group.into_iter().map(|(name, value)| (&name[first.len() + 1..], value));
        write(&format!("{margin}  "), below.collect(), text);
    }
}

fn entry(margin: &str, name: &str, value: &ParameterValue, text: &mut String) {
    let items: Vec<String> = match value {
        ParameterValue::BoolArray(values) => values.iter().map(bool::to_string).collect(),
        ParameterValue::ByteArray(values) => values.iter().map(u8::to_string).collect(),
        ParameterValue::IntegerArray(values) => values.iter().map(i64::to_string).collect(),
        ParameterValue::DoubleArray(values) => values.iter().map(|value| double(*value)).collect(),
        ParameterValue::StringArray(values) => values.iter().map(|value| string(value)).collect(),
        value => {
            let value = match value {
                ParameterValue::Double(value) => double(*value),
                ParameterValue::String(value) => string(value),
                value => value.to_string(),
            };
            *text += &format!("{margin}{}: {value}\n", string(name));
            return;
        }
    };
    let none = if items.is_empty() { " []" } else { "" };
    *text += &format!("{margin}{}:{none}\n", string(name));
    items.iter().for_each(|item| *text += &format!("{margin}- {item}\n"));
}

/// A number with a decimal point, and a sign in the exponent; some readers take other forms for strings.
fn double(value: f64) -> String {
    let text = format!("{value:?}");
    match text.split_once('e') {
        _ if value.is_nan() => ".nan".into(),
        _ if value.is_infinite() => if value > 0.0 { ".inf" } else { "-.inf" }.into(),
        None => text,
        Some((mantissa, exponent)) => {
            let point = if mantissa.contains('.') { "" } else { ".0" };
            let sign = if exponent.starts_with('-') { "" } else { "+" };
            format!("{mantissa}{point}e{sign}{exponent}")
        }
    }
}

/// A string, without quotes if ROS and other readers then read the same text.
fn string(text: &str) -> String {
    let is_word = text.starts_with(|c: char| c.is_alphabetic() || "/_".contains(c))
        && !["null", "y", "n"].contains(&text.to_lowercase().as_str());
    match text.parse() {
        Ok(ParameterValue::String(read)) if is_word && read == text => text.into(),
        _ if text.contains(char::is_control) => json!(text).to_string(),
        _ => format!("'{}'", text.replace('\'', "''")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;
    use tautline::parameters_of_file;

    #[test]
    fn what_is_written_is_read_again() {
        let strings = [
            "map",
            "",
            "true",
            "Y",
            "null",
            "1e5",
            "42",
            "it's",
            "a: b",
            "a #b",
            "- a",
            "a\nb\t",
            " a ",
            "{a",
            "ü",
            "inf",
            "/dev/tty0",
            "*a",
            "!a",
            "a:",
            "0x1F",
            "\"a\"",
            "\\n",
            "@a",
            "2024-01-01",
            "~",
            "..",
            "---",
        ];
        let mut parameters: Vec<(String, ParameterValue)> = strings
            .iter()
            .enumerate()
            .map(|(i, text)| (format!("strings.s{i:02}"), ParameterValue::from(*text)))
            .collect();
        let doubles = vec![0.1, 1.0, -0.0, 1e-5, 1.5e300, f64::INFINITY, f64::NEG_INFINITY];
        parameters.extend([
            ("a".into(), true.into()),
            ("a.b".into(), vec![true, false].into()),
            ("a.b.c".into(), 1e16.into()),
            ("doubles".into(), doubles.into()),
            ("odd..name.".into(), 1.into()),
            ("qos./topic.depth".into(), i64::MIN.into()),
            ("strings.all".into(), strings.map(String::from).to_vec().into()),
        ]);
        parameters.sort_by(|one, other| one.0.cmp(&other.0));
        let text = yaml("/robot/arm", &parameters);
        let path = std::env::temp_dir().join(format!("tautline_params_{}.yaml", std::process::id()));
        fs::write(&path, &text).unwrap();
        let mut read = parameters_of_file(&path, "/robot/arm").unwrap();
        assert_eq!(parameters_of_file(&path, "/robot/leg").unwrap(), []);
        fs::remove_file(&path).unwrap();
        read.sort_by(|one, other| one.0.cmp(&other.0));
        assert_eq!(read, parameters, "{text}");
    }

    #[test]
    fn files_look_as_those_of_ros() {
        let parameters = [
            ("bytes".into(), vec![1u8, 255].into()),
            ("empty".into(), ParameterValue::StringArray(vec![])),
            ("gain".into(), 1e-5.into()),
            ("qos./t.depth".into(), 5.into()),
            ("qos./t.history".into(), "keep_last".into()),
            ("unset".into(), ParameterValue::NotSet),
        ];
        let expected = "/a:\n  ros__parameters:\n    bytes:\n    - 1\n    - 255\n    empty: []\n    gain: 1.0e-5\n    qos:\n      /t:\n        \
                        depth: 5\n        history: keep_last\n";
        assert_eq!(yaml("/a", &parameters), expected);
        assert_eq!(json("/a", &parameters)["/a"]["ros__parameters"]["qos./t.depth"], 5);
        assert_eq!(yaml("/a", &[]), "/a:\n  ros__parameters: {}\n");
    }
}
