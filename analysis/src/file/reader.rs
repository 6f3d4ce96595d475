// SPDX-License-Identifier: MIT OR Apache-2.0
//! Reading typed values out of TOML, noting every problem instead of stopping at the first.
use toml::Spanned;
use toml::de::{DeTable, DeValue};

use super::problem::{Collector, is_unprintable};

/// A value and where it stands in the text.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct At<T> {
    pub value: T,
    pub at: usize,
}

type Value<'t> = Spanned<DeValue<'t>>;

/// A table whose keys are asked for one by one; what nobody asked for is unknown.
pub(super) struct Section<'t> {
    table: &'t DeTable<'t>,
    /// Its name in messages, such as "callback `imu`".
    pub title: String,
    pub at: usize,
    asked: Vec<&'static str>,
}

impl<'t> Section<'t> {
    pub fn root(table: &'t Spanned<DeTable<'t>>) -> Self {
        Self { table: table.get_ref(), title: "the file".into(), at: 0, asked: Vec::new() }
    }

    pub fn of(title: String, at: usize, value: &'t Value<'t>, problems: &mut Collector) -> Option<Self> {
        match value.get_ref() {
            DeValue::Table(table) => Some(Self { table, title, at, asked: Vec::new() }),
            other => {
                problems.add(value.span().start, format!("{title} must be a table, not {}", kind(other)));
                None
            }
        }
    }

    /// Where a key and its value stand.
    fn get(&mut self, key: &'static str) -> Option<(usize, &'t Value<'t>)> {
        if !self.asked.contains(&key) {
            self.asked.push(key);
        }
        self.table.get_key_value(key).map(|(key, value)| (key.span().start, value))
    }

    /// A sub-table for each name, in the order of the file.
    pub fn tables(
        &mut self,
        key: &'static str,
        what: &str,
        problems: &mut Collector,
    ) -> Vec<(String, Section<'t>)> {
        let Some((at, value)) = self.get(key) else { return Vec::new() };
        let Some(outer) = Section::of(format!("`{key}`"), at, value, problems) else { return Vec::new() };
        let mut entries: Vec<_> = outer.table.iter().collect();
        entries.sort_by_key(|(name, _)| name.span().start);
        let section = |(name, value): (&'t Spanned<_>, &'t Value<'t>)| {
            let name: &std::borrow::Cow<'t, str> = name.get_ref();
            (name.to_string(), format!("{what} `{name}`"), value)
        };
        let named = entries.into_iter().map(|(name, value)| (name.span().start, section((name, value))));
        let mut sections = Vec::new();
        for (at, (name, title, value)) in named {
            check_name(&title, &name, at, problems);
            sections.extend(Section::of(title, at, value, problems).map(|section| (name, section)));
        }
        sections
    }

    pub fn table(&mut self, key: &'static str, problems: &mut Collector) -> Option<Section<'t>> {
        let (at, value) = self.get(key)?;
        Section::of(format!("`{key}`"), at, value, problems)
    }

    /// The elements of an array.
    pub fn array(&mut self, key: &'static str, problems: &mut Collector) -> Vec<&'t Value<'t>> {
        match self.get(key).map(|(_, value)| (value, value.get_ref())) {
            None => Vec::new(),
            Some((_, DeValue::Array(array))) => array.iter().collect(),
            Some((value, other)) => {
                problems.add(value.span().start, format!("`{key}` must be an array, not {}", kind(other)));
                Vec::new()
            }
        }
    }

    pub fn text(&mut self, key: &'static str, problems: &mut Collector) -> Option<At<String>> {
        let (_, value) = self.get(key)?;
        text(key, value, problems)
    }

    /// A string or an array of strings.
    pub fn texts(&mut self, key: &'static str, problems: &mut Collector) -> Vec<At<String>> {
        match self.get(key).map(|(_, value)| (value, value.get_ref())) {
            None => Vec::new(),
            Some((_, DeValue::Array(array))) => array.iter().filter_map(|v| text(key, v, problems)).collect(),
            Some((value, _)) => text(key, value, problems).into_iter().collect(),
        }
    }

    /// A time, such as "1.5ms", in nanoseconds.
    pub fn time(&mut self, key: &'static str, problems: &mut Collector) -> Option<At<u64>> {
        let (_, value) = self.get(key)?;
        time(key, value, problems)
    }

    /// A time that must not be zero.
    pub fn positive_time(&mut self, key: &'static str, problems: &mut Collector) -> Option<At<u64>> {
        let time = self.time(key, problems)?;
        if time.value == 0 {
            problems.add(time.at, format!("`{key}` of {} is 0: set a time above it", self.title));
            return None;
        }
        Some(time)
    }

    pub fn integer(&mut self, key: &'static str, problems: &mut Collector) -> Option<At<i64>> {
        let (_, value) = self.get(key)?;
        integer(key, value, problems)
    }

    pub fn flag(&mut self, key: &'static str, problems: &mut Collector) -> bool {
        match self.get(key).map(|(_, value)| (value, value.get_ref())) {
            None => false,
            Some((_, DeValue::Boolean(flag))) => *flag,
            Some((value, other)) => {
                problems
                    .add(value.span().start, format!("`{key}` must be true or false, not {}", kind(other)));
                false
            }
        }
    }

    pub fn raw(&mut self, key: &'static str) -> Option<&'t Value<'t>> {
        self.get(key).map(|(_, value)| value)
    }

    pub fn has(&self, key: &str) -> bool {
        self.table.contains_key(key)
    }

    /// Notes the keys that nobody asked for.
    pub fn finish(self, problems: &mut Collector) {
        for key in self.table.keys() {
            let name: &str = key.get_ref();
            if !self.asked.contains(&name) {
                let hint = problems.suggestion(name, self.asked.iter().copied());
                let known =
                    if hint.is_empty() { format!(" (known: {})", self.asked.join(", ")) } else { hint };
                problems.add(key.span().start, format!("unknown key `{name}` in {}{known}", self.title));
            }
        }
    }
}

/// A name is shown in terminals and in tables.
pub(super) fn check_name(title: &str, name: &str, at: usize, problems: &mut Collector) {
    if name.is_empty() || name.chars().any(is_unprintable) {
        problems.add(at, format!("the name of {title} cannot be shown: use printable characters"));
    }
}

pub(super) fn text(key: &str, value: &Value<'_>, problems: &mut Collector) -> Option<At<String>> {
    let at = value.span().start;
    match value.get_ref() {
        DeValue::String(text) if text.chars().any(is_unprintable) => {
            problems
                .add(at, format!("`{key}` is \"{text}\", which cannot be shown: use printable characters"));
            None
        }
        DeValue::String(text) => Some(At { value: text.to_string(), at }),
        other => {
            problems.add(at, format!("`{key}` must be a string, not {}", kind(other)));
            None
        }
    }
}

pub(super) fn integer(key: &str, value: &Value<'_>, problems: &mut Collector) -> Option<At<i64>> {
    let at = value.span().start;
    let number = match value.get_ref() {
        DeValue::Integer(number) => i64::from_str_radix(number.as_str(), number.radix()).ok(),
        _ => None,
    };
    if number.is_none() {
        problems.add(at, format!("`{key}` must be a whole number, not {}", kind(value.get_ref())));
    }
    number.map(|value| At { value, at })
}

pub(super) fn time(key: &str, value: &Value<'_>, problems: &mut Collector) -> Option<At<u64>> {
    let at = value.span().start;
    let parsed = match value.get_ref() {
        DeValue::String(text) => nanoseconds(text).ok_or_else(|| {
            format!("`{key}` is not a time: \"{text}\"; write one such as \"1.5ms\" (ns, us, ms, s)")
        }),
        other => Err(format!("`{key}` must be a time with its unit, such as \"1.5ms\", not {}", kind(other))),
    };
    parsed.map(|value| At { value, at }).map_err(|message| problems.add(at, message)).ok()
}

/// Exact: a fraction below a nanosecond is refused.
fn nanoseconds(text: &str) -> Option<u64> {
    let text = text.trim();
    let unit_at = text.find(|c: char| !(c.is_ascii_digit() || c == '.' || c == '_'))?;
    let (number, unit) = (text[..unit_at].replace('_', ""), text[unit_at..].trim());
    let digits = match unit {
        "ns" => 0,
        "us" | "µs" | "μs" => 3,
        "ms" => 6,
        "s" => 9,
        _ => return None,
    };
    let (whole, fraction) = number.split_once('.').unwrap_or((&number, ""));
    let fraction = fraction.trim_end_matches('0');
    if whole.is_empty() || fraction.contains('.') || fraction.len() > digits {
        return None;
    }
    format!("{whole}{fraction:0<digits$}").parse().ok()
}

fn kind(value: &DeValue<'_>) -> &'static str {
    match value {
        DeValue::String(_) => "a string",
        DeValue::Integer(_) => "a number",
        DeValue::Float(_) => "a number with a fraction",
        DeValue::Boolean(_) => "true or false",
        DeValue::Datetime(_) => "a date",
        DeValue::Array(_) => "an array",
        DeValue::Table(_) => "a table",
    }
}

#[cfg(test)]
mod tests {
    use super::nanoseconds;

    #[test]
    fn times_are_exact() {
        for (text, ns) in [
            ("2ms", 2_000_000),
            ("0.15 ms", 150_000),
            ("1.5us", 1_500),
            ("7µs", 7_000),
            ("3ns", 3),
            ("1_000ms", 1_000_000_000),
            ("2.50s", 2_500_000_000),
            ("0s", 0),
        ] {
            assert_eq!(nanoseconds(text), Some(ns), "{text}");
        }
        for text in ["", "ms", "10", "1.5ns", "-1ms", "1.2.3ms", "5 min", "99999999999999999999s"] {
            assert_eq!(nanoseconds(text), None, "{text}");
        }
    }
}
