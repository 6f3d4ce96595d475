// SPDX-License-Identifier: MIT OR Apache-2.0
//! Numbers and strings as Python prints them: type descriptions and `ros2 topic echo` contain such text.

use std::fmt::{Display, LowerExp, Write};

/// `repr()` of a float: the shortest digits that give the same number; an exponent below 1e-4 and from 1e16.
/// `f32` gives the shortest digits of that type.
pub fn python_float<T: Display + LowerExp + Into<f64> + Copy>(value: T) -> String {
    let number: f64 = value.into();
    if number.is_nan() {
        return "nan".to_owned();
    }
    if number.is_infinite() {
        return if number > 0.0 { "inf" } else { "-inf" }.to_owned();
    }
    let scientific = format!("{value:e}");
    let (mantissa, exponent) = scientific.split_once('e').unwrap_or((&scientific, "0"));
    let exponent: i32 = exponent.parse().unwrap_or(0);
    if number != 0.0 && !(-4..16).contains(&exponent) {
        let sign = if exponent < 0 { '-' } else { '+' };
        return format!("{mantissa}e{sign}{:02}", exponent.abs());
    }
    let plain = value.to_string();
    if plain.contains('.') { plain } else { plain + ".0" }
}

/// `repr()` of a string.
pub fn python_str(text: &str) -> String {
    let quote = if text.contains('\'') && !text.contains('"') { '"' } else { '\'' };
    let mut result = String::with_capacity(text.len() + 2);
    result.push(quote);
    for character in text.chars() {
        match character {
            '\\' => result.push_str("\\\\"),
            '\n' => result.push_str("\\n"),
            '\r' => result.push_str("\\r"),
            '\t' => result.push_str("\\t"),
            _ if character == quote => result.extend(['\\', quote]),
            _ if character.is_control() => {
                // Writing to a `String` cannot fail.
                let _ = write!(result, "\\x{:02x}", u32::from(character));
            }
            _ => result.push(character),
        }
    }
    result.push(quote);
    result
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn floats_are_printed_as_python_prints_them() {
        for (value, text) in [
            (0.0, "0.0"),
            (-0.0, "-0.0"),
            (1.0, "1.0"),
            (0.1, "0.1"),
            (1e-4, "0.0001"),
            (1e-5, "1e-05"),
            (1.5e-7, "1.5e-07"),
            (1e15, "1000000000000000.0"),
            (1e16, "1e+16"),
            (1.25e300, "1.25e+300"),
            (f64::INFINITY, "inf"),
            (f64::NEG_INFINITY, "-inf"),
            (f64::NAN, "nan"),
        ] {
            assert_eq!(python_float(value), text);
        }
        assert_eq!(python_float(0.1f32), "0.1");
    }

    #[test]
    fn strings_are_printed_as_python_prints_them() {
        assert_eq!(python_str("it's"), "\"it's\"");
        assert_eq!(python_str("it's \"so\""), "'it\\'s \"so\"'");
        assert_eq!(python_str("a\n\\\u{1}é"), "'a\\n\\\\\\x01é'");
    }
}
