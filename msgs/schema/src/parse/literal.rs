// SPDX-License-Identifier: MIT OR Apache-2.0
//! Values of constants and defaults.

use super::line::shortened;
use crate::number::{python_float, python_str};
use crate::value::List;
use crate::{Base, Fault, FieldType, Primitive, Shape, Value};

/// The default of a field, and the same as type descriptions write it: as Python prints it.
pub fn default(ty: &FieldType, text: &str) -> Result<(Value, String), Fault> {
    if matches!(ty.base, Base::Nested(_)) {
        return Err(Fault::NoDefault { text: ty.to_string() });
    }
    match ty.shape {
        Shape::Single => scalar(&ty.base, text),
        _ => list(ty, text, '[', ']'),
    }
}

/// A default as type descriptions write it. What is accepted is a value that definitions can have, too.
pub(crate) fn parse_python_default(ty: &FieldType, text: &str) -> Result<Value, Fault> {
    match (&ty.base, ty.shape) {
        (Base::Nested(_), _) => Err(Fault::NoDefault { text: ty.to_string() }),
        (Base::String { bound } | Base::WString { bound }, Shape::Single) => bounded(text.to_owned(), *bound),
        (_, Shape::Single) => Ok(scalar(&ty.base, text)?.0),
        _ => Ok(list(ty, text, '(', ')')?.0),
    }
}

/// A single value, and the same as Python prints it.
pub fn scalar(base: &Base, text: &str) -> Result<(Value, String), Fault> {
    match base {
        Base::Primitive(primitive) => number(*primitive, text),
        Base::String { bound } | Base::WString { bound } => {
            let value = string(text)?;
            Ok((bounded(value.clone(), *bound)?, value))
        }
        Base::Nested(_) => Err(Fault::NoDefault { text: base.to_string() }),
    }
}

fn bounded(text: String, bound: Option<u32>) -> Result<Value, Fault> {
    match bound {
        Some(bound) if text.chars().count() > bound as usize => {
            let expected = format!("string of at most {bound} characters");
            Err(Fault::Value { value: shortened(&text), expected })
        }
        _ => Ok(Value::String(text)),
    }
}

fn number(primitive: Primitive, text: &str) -> Result<(Value, String), Fault> {
    let name = primitive.as_str();
    let error = |range: String| Fault::Value { value: shortened(text), expected: format!("{name}{range}") };
    match primitive {
        Primitive::Bool => match text.to_ascii_lowercase().as_str() {
            "true" | "1" => Ok((Value::Bool(true), "True".to_owned())),
            "false" | "0" => Ok((Value::Bool(false), "False".to_owned())),
            _ => Err(error(": write true or false".to_owned())),
        },
        Primitive::F32 | Primitive::F64 => {
            let plain = if is_grouped(text) { text.replace('_', "") } else { text.to_owned() };
            let value: f64 = plain.parse().map_err(|_| error(String::new()))?;
            let fits = || error(" that fits".to_owned());
            Ok((Value::from_float(primitive, value).ok_or_else(fits)?, python_float(value)))
        }
        _ => {
            let bits = 8 * primitive.size() as u32;
            let signed =
                matches!(primitive, Primitive::I8 | Primitive::I16 | Primitive::I32 | Primitive::I64);
            let (low, high) = if signed {
                (-(1i128 << (bits - 1)), (1i128 << (bits - 1)) - 1)
            } else {
                (0, (1i128 << bits) - 1)
            };
            let value = integer(text).and_then(|value| Some((Value::from_integer(primitive, value)?, value)));
            let (value, integer) =
                value.ok_or_else(|| error(format!(": it needs to be from {low} to {high}")))?;
            Ok((value, integer.to_string()))
        }
    }
}

/// As Python's `int()`: a sign, `0x`, `0o` or `0b`, and underscores between digits.
fn integer(text: &str) -> Option<i128> {
    let (negative, digits) = match text.as_bytes().first()? {
        b'-' => (true, &text[1..]),
        b'+' => (false, &text[1..]),
        _ => (false, text),
    };
    let (radix, digits) = match digits.get(..2).map(str::to_ascii_lowercase).as_deref() {
        Some("0x") => (16, &digits[2..]),
        Some("0o") => (8, &digits[2..]),
        Some("0b") => (2, &digits[2..]),
        _ => (10, digits),
    };
    // `from_str_radix` would take another sign.
    if !digits.starts_with(|first: char| first.is_digit(radix)) {
        return None;
    }
    let digits = if is_grouped(digits) { digits.replace('_', "") } else { digits.to_owned() };
    let value = i128::from_str_radix(&digits, radix).ok()?;
    Some(if negative { -value } else { value })
}

/// Whether every underscore stands between digits.
fn is_grouped(text: &str) -> bool {
    let bytes = text.as_bytes();
    bytes.contains(&b'_')
        && bytes.iter().enumerate().all(|(i, &byte)| {
            let digit = |at: usize| bytes.get(at).is_some_and(u8::is_ascii_hexdigit);
            byte != b'_' || (i > 0 && digit(i - 1) && digit(i + 1))
        })
}

/// A string with or without quotes around it.
fn string(text: &str) -> Result<String, Fault> {
    match text.chars().next() {
        Some(quote @ ('"' | '\'')) => match quoted(text, quote) {
            Some((content, "")) => Ok(content),
            _ => Err(Fault::Value {
                value: shortened(text),
                expected: format!("string: close it with {quote}, write \\{quote} inside, and no # anywhere"),
            }),
        },
        _ => Ok(unescaped(text)),
    }
}

/// The content of a quoted string at the start of `text`, and what follows it.
fn quoted(text: &str, quote: char) -> Option<(String, &str)> {
    let inner = text.strip_prefix(quote)?;
    let mut escaped = false;
    for (at, character) in inner.char_indices() {
        match character {
            _ if escaped => escaped = false,
            '\\' => escaped = true,
            _ if character == quote => return Some((unescaped(&inner[..at]), &inner[at + 1..])),
            _ => {}
        }
    }
    None
}

/// Replaces `\n`, `\t`, `\r`, `\0`, `\\`, `\"`, `\'`, `\xHH`, `\uHHHH`; leaves other backslashes.
fn unescaped(text: &str) -> String {
    let mut result = String::with_capacity(text.len());
    let mut rest = text;
    while let Some(at) = rest.find('\\') {
        result.push_str(&rest[..at]);
        rest = &rest[at + 1..];
        let simple = match rest.chars().next() {
            Some('n') => Some('\n'),
            Some('t') => Some('\t'),
            Some('r') => Some('\r'),
            Some('0') => Some('\0'),
            Some(same @ ('\\' | '"' | '\'')) => Some(same),
            _ => None,
        };
        if let Some(character) = simple {
            result.push(character);
            rest = &rest[1..];
        } else if let Some((character, len)) = code_point(rest) {
            result.push(character);
            rest = &rest[len..];
        } else {
            result.push('\\');
        }
    }
    result + rest
}

/// The character of `xHH` or `uHHHH`, and the length of that.
fn code_point(text: &str) -> Option<(char, usize)> {
    let len = match text.as_bytes().first()? {
        b'x' => 3,
        b'u' => 5,
        _ => return None,
    };
    let digits = text.get(1..len).filter(|digits| digits.bytes().all(|digit| digit.is_ascii_hexdigit()))?;
    Some((char::from_u32(u32::from_str_radix(digits, 16).ok()?)?, len))
}

/// `[a, b]`, or `(a, b)` and `(a,)` as Python prints it.
fn list(ty: &FieldType, text: &str, open: char, close: char) -> Result<(Value, String), Fault> {
    let error = |expected: String| Fault::Value { value: shortened(text), expected };
    let inner = text.strip_prefix(open).and_then(|text| text.strip_suffix(close));
    let mut rest = inner.ok_or_else(|| error(format!("list: write {open}a, b{close}")))?.trim();
    let is_text = matches!(ty.base, Base::String { .. } | Base::WString { .. });
    let mut list = List::empty(&ty.base);
    let mut texts = Vec::new();
    while !rest.is_empty() {
        let (element, after) = match rest.chars().next() {
            Some(quote @ ('"' | '\'')) if is_text => {
                let (_, after) =
                    quoted(rest, quote).ok_or_else(|| error("list: a string is not closed".to_owned()))?;
                (&rest[..rest.len() - after.len()], after)
            }
            _ => {
                let end = rest.find(',').unwrap_or(rest.len());
                (rest[..end].trim_end(), &rest[end..])
            }
        };
        let (value, printed) = scalar(&ty.base, element)?;
        texts.push(if is_text { python_str(&printed) } else { printed });
        list.push(value).map_err(|_| error(ty.to_string()))?;
        let after = after.trim_start();
        rest = match (after.strip_prefix(','), after) {
            (Some(next), _) => next.trim_start(),
            (None, "") => "",
            _ => return Err(error("list: its elements need commas between them".to_owned())),
        };
    }
    let (valid, needed) = match ty.shape {
        Shape::Array(len) => (list.len() == len as usize, format!("list of {len} elements")),
        Shape::Bounded(bound) => (list.len() <= bound as usize, format!("list of at most {bound} elements")),
        _ => (true, String::new()),
    };
    if !valid {
        return Err(error(needed));
    }
    let comma = if texts.len() == 1 { "," } else { "" };
    Ok((Value::List(list), format!("({}{comma})", texts.join(", "))))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::parse::parse_type;

    fn parsed(ty: &str, text: &str) -> Result<(Value, String), Fault> {
        default(&parse_type(ty, "p").unwrap(), text)
    }

    fn value(ty: &str, text: &str) -> Value {
        parsed(ty, text).unwrap().0
    }

    #[test]
    fn integers_are_read_as_python_reads_them() {
        assert_eq!(value("uint8", "0xfF"), Value::U8(255));
        assert_eq!(value("int8", "-0b11"), Value::I8(-3));
        assert_eq!(value("int32", "+1_000"), Value::I32(1000));
        assert_eq!(value("int32", "007"), Value::I32(7));
        assert_eq!(value("uint64", "18446744073709551615"), Value::U64(u64::MAX));
        assert_eq!(value("int64", "-9223372036854775808"), Value::I64(i64::MIN));
        for (ty, text) in
            [("uint8", "256"), ("int8", "-129"), ("uint8", "-1"), ("char", "'a'"), ("byte", "300")]
        {
            assert!(matches!(parsed(ty, text), Err(Fault::Value { .. })), "{ty} {text}");
        }
        for text in ["", "--1", "+-1", "0x", "0x-1", "1_", "_1", "1__0", "1.0", "é", "-", "0é"] {
            assert!(parsed("int32", text).is_err(), "{text}");
        }
    }

    #[test]
    fn strings_may_have_quotes_and_escapes() {
        assert_eq!(value("string", r"'Hello\'world!'"), "Hello'world!".into());
        assert_eq!(value("string", r#""Hello\"world!""#), "Hello\"world!".into());
        assert_eq!(value("string", "two words"), "two words".into());
        assert_eq!(value("string", r#""a\nb\x41\u00e9\q""#), "a\nbAé\\q".into());
        assert_eq!(value("string<=2", "\"éé\""), "éé".into());
        assert!(parsed("string<=2", "abc").is_err());
        assert!(parsed("string", "\"open").is_err());
        assert!(parsed("string", "\"a\"b\"").is_err());
    }

    #[test]
    fn lists_are_checked_against_their_type() {
        assert_eq!(parsed("float64[]", "[3.1415, 0, -1e-7]").unwrap().1, "(3.1415, 0.0, -1e-07)");
        assert_eq!(parsed("bool[<=3]", "[true]").unwrap().1, "(True,)");
        assert_eq!(parsed("string[2]", r#"["a, b", 'it\'s']"#).unwrap().1, r#"('a, b', "it's")"#);
        assert_eq!(value("int8[]", "[]"), Value::List(List::I8(vec![])));
        for (ty, text) in [
            ("int8[2]", "[1]"),
            ("int8[<=2]", "[1, 2, 3]"),
            ("int8[]", "1, 2"),
            ("int8[]", "[1 2]"),
            ("int8[]", "[1, , 2]"),
            ("string[]", "[\"a\" \"b\"]"),
            ("string[]", "[\"a]"),
            ("int8[]", "[300]"),
            ("P", "1"),
            ("P[]", "[1]"),
        ] {
            assert!(parsed(ty, text).is_err(), "{ty} {text}");
        }
    }

    #[test]
    fn floats_have_ranges_too() {
        assert_eq!(value("float32", "1e38"), Value::F32(1e38));
        assert!(parsed("float32", "1e39").is_err());
        assert_eq!(value("float64", "-inf"), Value::F64(f64::NEG_INFINITY));
        assert!(parsed("float64", "1,5").is_err());
    }
}
