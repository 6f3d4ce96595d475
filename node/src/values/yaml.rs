// SPDX-License-Identifier: MIT OR Apache-2.0
//! Parameters in YAML, with ROS 2's rules for numbers, strings and so on.

use super::error::ParameterError;
use super::value::ParameterValue;
use granit_parser::{Event, Parser, ScalarStyle, StrInput};
use std::path::Path;
use std::str::FromStr;

/// Maximum depth of nested mappings.
const MAX_DEPTH: usize = 64;

/// The content of a parameter file: for each pattern of nodes' names its parameters, in the order of the file. As in rcl, a node and a parameter
/// may occur several times.
pub(crate) type NodeParameters = Vec<(String, Vec<(String, ParameterValue)>)>;

fn read_file(text: &str) -> Result<NodeParameters, String> {
    let mut nodes = Vec::new();
    match parse(text)? {
        Some(Tree { node: Node::Mapping(entries), .. }) => find_nodes("", entries, &mut nodes)?,
        Some(other) => return Err(other.wrong("a file begins with the names of nodes, as `/**:`")),
        None => {}
    }
    Ok(nodes)
}

/// Reads a parameter file.
pub(crate) fn read_parameter_file(path: &Path) -> Result<NodeParameters, ParameterError> {
    let text = std::fs::read_to_string(path).map_err(|error| error.to_string());
    let wrong = |reason| ParameterError::File { path: path.to_owned(), reason };
    text.and_then(|text| read_file(&text)).map_err(wrong)
}

/// Reads a value as `-p name:=value` does: by YAML's rules.
///
/// ```
/// use tautline::ParameterValue;
///
/// assert_eq!("1.5".parse(), Ok(ParameterValue::Double(1.5)));
/// assert_eq!("[1, 2]".parse(), Ok(ParameterValue::IntegerArray(vec![1, 2])));
/// assert!("[1, x]".parse::<ParameterValue>().is_err());
/// ```
impl FromStr for ParameterValue {
    type Err = ParameterError;

    fn from_str(text: &str) -> Result<ParameterValue, ParameterError> {
        let invalid = |reason| ParameterError::InvalidValue { text: text.to_owned(), reason };
        read_value(text).map_err(invalid)
    }
}

/// Reads one value, as in `-p name:=value`.
pub(crate) fn read_value(text: &str) -> Result<ParameterValue, String> {
    match parse(text)? {
        Some(tree) => tree.value(),
        None => Err("there is no value".into()),
    }
}

/// Mappings down to `ros__parameters` are namespaces and a node's name.
fn find_nodes(prefix: &str, entries: Vec<(String, Tree)>, nodes: &mut NodeParameters) -> Result<(), String> {
    for (key, tree) in entries {
        if key == "ros__parameters" {
            if prefix.is_empty() {
                return Err(tree.wrong("`ros__parameters` stands below a node's name, or `/**:`"));
            }
            let mut parameters = Vec::new();
            match tree.node {
                Node::Mapping(entries) => flatten("", entries, &mut parameters)?,
                Node::Nothing => {}
                _ => return Err(tree.wrong("`ros__parameters` has a mapping of names to values")),
            }
            nodes.push((prefix.to_owned(), parameters));
            continue;
        }
        let name = match prefix {
            "" => key,
            prefix => format!("{}/{}", prefix.trim_end_matches('/'), key.trim_start_matches('/')),
        };
        match tree.node {
            Node::Mapping(entries) => find_nodes(&name, entries, nodes)?,
            _ => return Err(tree.wrong(&format!("`{name}` has no `ros__parameters:` with names and values"))),
        }
    }
    Ok(())
}

fn flatten(
    prefix: &str,
    entries: Vec<(String, Tree)>,
    parameters: &mut Vec<(String, ParameterValue)>,
) -> Result<(), String> {
    for (key, tree) in entries {
        let name = if prefix.is_empty() { key } else { format!("{prefix}.{key}") };
        match tree.node {
            Node::Mapping(entries) => flatten(&name, entries, parameters)?,
            _ => {
                let value = tree.value().map_err(|reason| format!("{reason} (parameter '{name}')"))?;
                parameters.push((name, value));
            }
        }
    }
    Ok(())
}

struct Tree {
    line: usize,
    node: Node,
}

enum Node {
    Nothing,
    /// Text with its stated type: `!!str`, or quotes.
    Scalar(String, Option<String>),
    Sequence(Vec<Tree>),
    Mapping(Vec<(String, Tree)>),
}

impl Tree {
    fn wrong(&self, what: &str) -> String {
        format!("line {}: {what}", self.line)
    }

    fn value(self) -> Result<ParameterValue, String> {
        let wrong = |what: &str| Err(format!("line {}: {what}", self.line));
        match self.node {
            Node::Nothing => wrong("there is no value"),
            Node::Mapping(_) => wrong("a mapping is not a value"),
            Node::Scalar(text, tag) => scalar(&text, tag.as_deref()).or_else(|what| wrong(&what)),
            Node::Sequence(items) => {
                let mut values = Vec::new();
                for item in items {
                    if matches!(item.node, Node::Sequence(_)) {
                        return Err(item.wrong("an array cannot lie in an array"));
                    }
                    values.push(item.value()?);
                }
                array(values).or_else(|what| wrong(&what))
            }
        }
    }
}

/// Rules and order of rcl_yaml_param_parser.
fn scalar(text: &str, tag: Option<&str>) -> Result<ParameterValue, String> {
    let (boolean, integer, double) = (boolean(text), integer(text), double(text));
    let missing = |kind: &str| format!("'{text}' is not {kind}");
    Ok(match tag {
        Some("bool") => ParameterValue::Bool(boolean.ok_or_else(|| missing("a boolean"))?),
        Some("int") => ParameterValue::Integer(integer.ok_or_else(|| missing("an integer"))?),
        Some("float") => ParameterValue::Double(double.ok_or_else(|| missing("a double"))?),
        Some("str") => ParameterValue::String(text.into()),
        Some(other) => {
            return Err(format!(
                "the tag '{other}' is not known: there are !!bool, !!int, !!float and !!str"
            ));
        }
        None => match (boolean, integer, double) {
            (Some(value), ..) => ParameterValue::Bool(value),
            (_, Some(value), _) => ParameterValue::Integer(value),
            (_, _, Some(value)) => ParameterValue::Double(value),
            _ => ParameterValue::String(text.into()),
        },
    })
}

fn boolean(text: &str) -> Option<bool> {
    match text {
        "Y" | "y" | "yes" | "Yes" | "YES" | "true" | "True" | "TRUE" | "on" | "On" | "ON" => Some(true),
        "N" | "n" | "no" | "No" | "NO" | "false" | "False" | "FALSE" | "off" | "Off" | "OFF" => Some(false),
        _ => None,
    }
}

/// As C's strtoll with base 0: 0x for base 16, 0 for base 8.
fn integer(text: &str) -> Option<i64> {
    let (sign, digits) = match text.strip_prefix(['-', '+']) {
        Some(digits) => (&text[..1], digits),
        None => ("", text),
    };
    if digits.starts_with(['-', '+']) {
        return None;
    }
    let parse = |digits: &str, base| i64::from_str_radix(&format!("{sign}{digits}"), base).ok();
    match digits.strip_prefix('0') {
        Some(rest) => match rest.strip_prefix(['x', 'X']) {
            Some(hex) if !hex.starts_with(['-', '+']) => parse(hex, 16),
            Some(_) => None,
            None => parse(digits, 8),
        },
        None => parse(digits, 10),
    }
}

fn double(text: &str) -> Option<f64> {
    match text {
        ".nan" | ".NaN" | ".NAN" => Some(f64::NAN),
        ".inf" | ".Inf" | ".INF" | "+.inf" | "+.Inf" | "+.INF" => Some(f64::INFINITY),
        "-.inf" | "-.Inf" | "-.INF" => Some(f64::NEG_INFINITY),
        _ => text.parse().ok(),
    }
}

fn array(values: Vec<ParameterValue>) -> Result<ParameterValue, String> {
    /// The array of this type, if each value has the item type.
    macro_rules! all {
        ($variant:ident, $array:ident) => {{
            let mut same = Vec::with_capacity(values.len());
            for value in &values {
                match value {
                    ParameterValue::$variant(value) => same.push(value.clone()),
                    other => {
                        return Err(format!(
                            "an array has items of one type, and here are {} and {} ({other})",
                            values[0].type_name(),
                            other.type_name()
                        ));
                    }
                }
            }
            Ok(ParameterValue::$array(same))
        }};
    }
    match values.first() {
        Some(ParameterValue::Bool(_)) => all!(Bool, BoolArray),
        Some(ParameterValue::Integer(_)) => all!(Integer, IntegerArray),
        Some(ParameterValue::Double(_)) => all!(Double, DoubleArray),
        // An empty array: the parameter's declaration states the item type.
        _ => all!(String, StringArray),
    }
}

fn parse(text: &str) -> Result<Option<Tree>, String> {
    let mut reader = Reader { parser: Parser::new_from_str(text) };
    let mut tree = None;
    loop {
        let (event, line) = reader.next()?;
        match event {
            Event::StreamEnd => return Ok(tree),
            Event::StreamStart | Event::DocumentEnd => {}
            Event::DocumentStart(..) if tree.is_some() => {
                return Err(format!("line {line}: there is a second document"));
            }
            Event::DocumentStart(..) => {}
            event => tree = Some(reader.tree(event, line, 0)?),
        }
    }
}

struct Reader<'t> {
    parser: Parser<'t, StrInput<'t>>,
}

impl<'t> Reader<'t> {
    fn next(&mut self) -> Result<(Event<'t>, usize), String> {
        loop {
            match self.parser.next_event() {
                None => return Ok((Event::StreamEnd, 0)),
                Some(Err(error)) => return Err(error.to_string()),
                Some(Ok((Event::Comment(..), _))) => {}
                Some(Ok((event, span))) => return Ok((event, span.start.line())),
            }
        }
    }

    fn tree(&mut self, event: Event<'t>, line: usize, depth: usize) -> Result<Tree, String> {
        if depth > MAX_DEPTH {
            return Err(format!("line {line}: more than {MAX_DEPTH} levels lie in each other"));
        }
        let node = match event {
            Event::Scalar(text, style, _, tag) => {
                let tag = tag.map(|tag| tag.core_suffix().unwrap_or_else(|| tag.suffix()).to_owned());
                match (style, tag) {
                    // The parser writes ~ for nothing.
                    (ScalarStyle::Plain, None) if text.is_empty() || text == "~" => Node::Nothing,
                    (ScalarStyle::Plain, tag) => Node::Scalar(text.into_owned(), tag),
                    (_, tag) => Node::Scalar(text.into_owned(), tag.or(Some("str".into()))),
                }
            }
            Event::SequenceStart(..) => {
                let mut items = Vec::new();
                loop {
                    match self.next()? {
                        (Event::SequenceEnd, _) => break Node::Sequence(items),
                        (event, line) => items.push(self.tree(event, line, depth + 1)?),
                    }
                }
            }
            Event::MappingStart(..) => {
                let mut entries: Vec<(String, Tree)> = Vec::new();
                loop {
                    let key = match self.next()? {
                        (Event::MappingEnd, _) => break Node::Mapping(entries),
                        (Event::Scalar(key, ..), _) => key.into_owned(),
                        (_, line) => return Err(format!("line {line}: a key is a name")),
                    };
                    let (event, line) = self.next()?;
                    entries.push((key, self.tree(event, line, depth + 1)?));
                }
            }
            Event::Alias(_) => return Err(format!("line {line}: aliases are not allowed in parameters")),
            _ => return Err(format!("line {line}: a value should be here")),
        };
        Ok(Tree { line, node })
    }
}

/// Whether the pattern of a parameter file or a rule matches the node: `*` is one name, `**` any number of them. As in rclcpp, a pattern
/// that does not begin with `/` is as if it did.
pub(crate) fn matches(pattern: &str, fully_qualified_name: &str) -> bool {
    fn all_match(pattern: &[&str], name: &[&str]) -> bool {
        match (pattern.split_first(), name.split_first()) {
            (None, None) => true,
            (Some((&"**", rest)), _) => {
                all_match(rest, name)
                    || name.split_first().is_some_and(|(_, after)| all_match(pattern, after))
            }
            (Some((&first, rest)), Some((&token, after))) => {
                (first == "*" || first == token) && all_match(rest, after)
            }
            _ => false,
        }
    }
    let name: Vec<_> = fully_qualified_name.split('/').skip(1).collect();
    let pattern: Vec<_> = pattern.strip_prefix('/').unwrap_or(pattern).split('/').collect();
    all_match(&pattern, &name)
}

#[cfg(test)]
mod tests {
    use super::*;
    use ParameterValue as Value;

    #[test]
    fn values_have_the_types_that_ros_gives_them() {
        let strings = |texts: &[&str]| Value::StringArray(texts.iter().map(|text| (*text).into()).collect());
        for (text, expected) in [
            ("true", Value::Bool(true)),
            ("off", Value::Bool(false)),
            ("y", Value::Bool(true)),
            ("42", Value::Integer(42)),
            ("-0x1F", Value::Integer(-31)),
            ("010", Value::Integer(8)),
            ("0", Value::Integer(0)),
            ("1.", Value::Double(1.0)),
            ("5e-3", Value::Double(0.005)),
            ("-.inf", Value::Double(f64::NEG_INFINITY)),
            ("99999999999999999999", Value::Double(1e20)),
            ("map", Value::String("map".into())),
            ("'42'", Value::String("42".into())),
            ("\"true\"", Value::String("true".into())),
            ("!!str 1.5", Value::String("1.5".into())),
            ("!!float 1", Value::Double(1.0)),
            ("1.2.3", Value::String("1.2.3".into())),
            ("--1", Value::String("--1".into())),
            ("/dev/ttyUSB0", Value::String("/dev/ttyUSB0".into())),
            ("''", Value::String(String::new())),
            ("[hello, world]", strings(&["hello", "world"])),
            ("[]", strings(&[])),
            ("[1, 2]", Value::IntegerArray(vec![1, 2])),
            ("[1.0, .5]", Value::DoubleArray(vec![1.0, 0.5])),
            ("[on, false]", Value::BoolArray(vec![true, false])),
        ] {
            assert_eq!(read_value(text).unwrap(), expected, "{text}");
        }
        assert!(matches!(read_value(".nan").unwrap(), Value::Double(value) if value.is_nan()));
        for (text, reason) in [
            ("", "there is no value"),
            ("[1, 2.0]", "here are integer and double (2.0)"),
            ("[[1]]", "an array cannot lie in an array"),
            ("{a: 1}", "a mapping is not a value"),
            ("!!int x", "'x' is not an integer"),
            ("!!set x", "the tag 'set' is not known"),
            ("[1", "line"),
            ("a\n---\nb", "second document"),
        ] {
            let error = read_value(text).unwrap_err();
            assert!(error.contains(reason), "{text}: {error}");
        }
        // However deep: a refusal, not a stack overflow.
        for (open, close) in [("[", "]"), ("{a: ", "}")] {
            let nested = |levels| read_value(&format!("{}1{}", open.repeat(levels), close.repeat(levels)));
            assert!(nested(100).unwrap_err().contains("64 levels"));
            assert!(nested(100_000).is_err());
        }
    }

    #[test]
    fn files_name_nodes_and_nested_parameters() {
        let text = "
# a comment
/**:
  ros__parameters:
    use_sim_time: false
/robot:
  left/camera:
    ros__parameters:
      exposure: {auto: true, limits: {max_ms: 30}} # in one line
      gains: [1.0, 2.0]
planner:
  ros__parameters:
";
        let nodes = read_file(text).unwrap();
        let names: Vec<_> = nodes.iter().map(|(node, _)| node.as_str()).collect();
        assert_eq!(names, ["/**", "/robot/left/camera", "planner"]);
        assert_eq!(
            nodes[1].1,
            [
                ("exposure.auto".to_owned(), Value::Bool(true)),
                ("exposure.limits.max_ms".to_owned(), Value::Integer(30)),
                ("gains".to_owned(), Value::DoubleArray(vec![1.0, 2.0])),
            ]
        );
        assert!(nodes[2].1.is_empty() && read_file("").unwrap().is_empty());
        for (text, reason) in [
            ("- a", "a file begins with the names of nodes"),
            ("a: 1", "line 1: `a` has no `ros__parameters:`"),
            ("ros__parameters: {a: 1}", "stands below a node's name"),
            ("a:\n  ros__parameters:\n    b:\n", "line 3: there is no value (parameter 'b')"),
            ("a:\n  ros__parameters: {b: &x 1, c: *x}", "line 2: aliases are not allowed"),
            ("a:\n\tros__parameters:\n", "line 2"),
        ] {
            let error = read_file(text).unwrap_err();
            assert!(error.contains(reason), "{text}: {error}");
        }
    }

    #[test]
    fn what_occurs_twice_counts_twice() {
        let text = "
robot:
  arm:
    ros__parameters: {a: 1, b: {c: 1}, a: 2}
robot:
  leg:
    ros__parameters: {d: 1}
  arm:
    ros__parameters: {a: 3}
    ros__parameters: {b: {c: 4}}
";
        let nodes = read_file(text).unwrap();
        let names: Vec<_> = nodes.iter().map(|(node, _)| node.as_str()).collect();
        assert_eq!(names, ["robot/arm", "robot/leg", "robot/arm", "robot/arm"]);
        let given = crate::parameters::overrides(&nodes, &[], "/robot/arm");
        let given: Vec<_> =
            given.iter().map(|(name, parameter)| (name.as_str(), parameter.value.clone())).collect();
        assert_eq!(given, [("a", Value::Integer(3)), ("b.c", Value::Integer(4))]);
    }

    #[test]
    fn patterns_match_nodes() {
        for (pattern, name, expected) in [
            ("/**", "/a/b", true),
            ("**", "/a", true),
            ("/a/b", "/a/b", true),
            ("/a", "/a/b", false),
            ("b", "/b", true),
            ("b", "/a/b", false),
            ("a/b", "/a/b", true),
            ("a/b", "/x/a/b", false),
            ("*/b", "/x/b", true),
            ("a", "/a/b", false),
            ("/*/b", "/a/b", true),
            ("/*/b", "/a/a/b", false),
            ("/**/b", "/a/a/b", true),
            ("/**/b", "/b", true),
            ("/a/*", "/a/b", true),
            ("/*", "/a/b", false),
        ] {
            assert_eq!(matches(pattern, name), expected, "{pattern} {name}");
        }
    }
}
