// SPDX-License-Identifier: MIT OR Apache-2.0
//! Reading typed values out of TOML, noting every problem instead of stopping at the first. Also for files of other programs.
use std::borrow::Cow;
use std::ops::RangeInclusive;
use toml::Spanned;
use toml::de::{DeInteger, DeTable, DeValue};

use super::problem::{Adder, Collector, Problems, is_unprintable};

/// A value and where it stands in the text.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct At<T> {
    /// The value.
    pub value: T,
    /// Its offset in bytes.
    pub at: usize,
}

/// A value, not read yet.
pub type Value<'t> = Spanned<DeValue<'t>>;

/// Reads a file's text by `read`. `example` is a line of such a file.
///
/// # Errors
/// Syntax that is not TOML, else everything that `read` found wrong.
pub fn read<T>(text: &str, example: &str, read: impl FnOnce(Section<'_>) -> T) -> Result<T, Problems> {
    let problems = Collector::new(text);
    let table = parse(&problems, text, example)?;
    let value = read(Section::root(&table, &problems));
    problems.check().map(|()| value)
}

pub(super) fn parse<'t>(
    problems: &Collector<'_>,
    text: &'t str,
    example: &str,
) -> Result<Spanned<DeTable<'t>>, Problems> {
    let (table, errors) = DeTable::parse_recoverable(text);
    // The content of a broken table is guesswork: only its syntax is reported.
    for error in errors {
        let message = error.message().trim_end().replace('\n', ", ");
        let at = error.span().map_or(0, |span| span.start);
        problems
            .at(at)
            .add(format!("{message}: write this line as TOML, such as {example}; text is in quotes"));
    }
    problems.check().map(|()| table)
}

/// A table whose keys are read one by one; a key that was not read is unknown.
pub struct Section<'t> {
    table: &'t DeTable<'t>,
    /// Its name in messages, such as "callback `imu`".
    pub title: String,
    /// Where it stands.
    pub at: usize,
    problems: &'t Collector<'t>,
    asked: Vec<&'static str>,
}

impl<'t> Section<'t> {
    pub(super) fn root(table: &'t Spanned<DeTable<'t>>, problems: &'t Collector<'t>) -> Self {
        Self { table: table.get_ref(), title: "the file".into(), at: 0, problems, asked: Vec::new() }
    }

    /// A table in this one.
    pub fn inner(&self, title: String, at: usize, value: &'t Value<'t>) -> Option<Self> {
        match value.get_ref() {
            DeValue::Table(table) => {
                Some(Self { table, title, at, problems: self.problems, asked: Vec::new() })
            }
            other => {
                self.problem(value.span().start).add(format!("{title} must be a table, not {}", kind(other)));
                None
            }
        }
    }

    /// For a problem at this place: `section.problem(at).add(...)`.
    pub fn problem(&self, at: usize) -> Adder<'t> {
        self.problems.at(at)
    }

    fn get(&mut self, key: &'static str) -> Option<&'t Value<'t>> {
        if !self.asked.contains(&key) {
            self.asked.push(key);
        }
        self.table.get(key)
    }

    /// Reads the sub-table of each name by `read`, in the order of the file.
    pub fn tables<T>(&mut self, key: &'static str, what: &str, read: fn(String, Self) -> T) -> Vec<T> {
        let Some(outer) = self.table(key) else { return Vec::new() };
        let mut entries: Vec<_> = outer.table.iter().collect();
        entries.sort_by_key(|(name, _)| name.span().start);
        let entry = |(name, value): (&Spanned<Cow<'t, str>>, &'t Value<'t>)| {
            let (at, name) = (name.span().start, name.get_ref().to_string());
            let title = format!("{what} `{name}`");
            // A name is shown in terminals and in tables.
            if name.is_empty() || name.chars().any(is_unprintable) {
                self.problem(at)
                    .add(format!("the name of {title} cannot be shown: use printable characters"));
            }
            self.inner(title, at, value).map(|section| read(name, section))
        };
        entries.into_iter().filter_map(entry).collect()
    }

    /// The table `key`.
    pub fn table(&mut self, key: &'static str) -> Option<Section<'t>> {
        let value = self.get(key)?;
        let at = self.table.get_key_value(key).map_or(0, |(key, _)| key.span().start);
        self.inner(format!("`{key}`"), at, value)
    }

    /// The elements of an array.
    pub fn array(&mut self, key: &'static str) -> &'t [Value<'t>] {
        match self.get(key).map(|value| (value, value.get_ref())) {
            None => &[],
            Some((_, DeValue::Array(array))) => array,
            Some((value, other)) => {
                let kind = kind(other);
                self.problem(value.span().start).add(format!("`{key}` must be an array, not {kind}"));
                &[]
            }
        }
    }

    /// A string.
    pub fn text(&mut self, key: &'static str) -> Option<At<String>> {
        self.get(key).and_then(|value| self.text_of(key, value))
    }

    /// A string or an array of strings.
    pub fn texts(&mut self, key: &'static str) -> Vec<At<String>> {
        match self.get(key).map(|value| (value, value.get_ref())) {
            None => Vec::new(),
            Some((_, DeValue::Array(array))) => array.iter().filter_map(|v| self.text_of(key, v)).collect(),
            Some((value, _)) => self.text_of(key, value).into_iter().collect(),
        }
    }

    /// A time, such as "1.5ms", in nanoseconds.
    pub fn time(&mut self, key: &'static str) -> Option<At<u64>> {
        self.get(key).and_then(|value| self.time_of(key, value))
    }

    /// A time that must not be zero.
    pub fn positive_time(&mut self, key: &'static str) -> Option<At<u64>> {
        let time = self.time(key)?;
        if time.value == 0 {
            self.problem(time.at).add(format!("`{key}` of {} is 0: set a time above it", self.title));
            return None;
        }
        Some(time)
    }

    /// A whole number.
    pub fn integer(&mut self, key: &'static str) -> Option<At<i64>> {
        self.get(key).and_then(|value| self.integer_of(key, value))
    }

    /// A whole number in this range.
    pub fn integer_in<N: TryFrom<i64>>(
        &mut self,
        key: &'static str,
        range: RangeInclusive<i64>,
    ) -> Option<N> {
        let At { value, at } = self.integer(key)?;
        let number =
            Some(value).filter(|value| range.contains(value)).and_then(|value| N::try_from(value).ok());
        if number.is_none() {
            let (least, most) = range.into_inner();
            self.problem(at).add(format!("`{key}` is {value}: write a whole number from {least} to {most}"));
        }
        number
    }

    /// A number in this range, with a fraction or without.
    pub fn number_in(&mut self, key: &'static str, range: RangeInclusive<f64>, unit: &str) -> Option<f64> {
        let (number, text) = match self.raw(key)? {
            DeValue::Integer(number) => (integer(number).map(|number| number as f64), number.to_string()),
            DeValue::Float(number) => (number.as_str().parse().ok(), number.to_string()),
            other => (None, kind(other).to_owned()),
        };
        let number = number.filter(|number| range.contains(number));
        if number.is_none() {
            let (least, most) = range.into_inner();
            let at = self.at(key).unwrap_or(self.at);
            self.problem(at).add(format!("`{key}` is {text}: write {unit} from {least} to {most}"));
        }
        number
    }

    /// True or false; false if it is not there.
    pub fn flag(&mut self, key: &'static str) -> bool {
        self.optional_flag(key).unwrap_or(false)
    }

    /// True or false; `None` if it is not there.
    pub fn optional_flag(&mut self, key: &'static str) -> Option<bool> {
        let value = self.get(key)?;
        let flag = value.get_ref().as_bool();
        if flag.is_none() {
            let kind = kind(value.get_ref());
            self.problem(value.span().start).add(format!("`{key}` must be true or false, not {kind}"));
        }
        flag
    }

    /// One of the values that have names.
    pub fn choice<T: Copy>(&mut self, key: &'static str, choices: &[(&str, T)]) -> Option<At<T>> {
        let At { value: given, at } = self.text(key)?;
        let found = choices.iter().find(|(name, _)| *name == given);
        if found.is_none() {
            let hint = self.hint(&given, &choices.iter().map(|(name, _)| *name).collect::<Vec<_>>());
            self.problem(at).add(format!("unknown `{key}` \"{given}\" in {}{hint}", self.title));
        }
        found.map(|(_, value)| At { value: *value, at })
    }

    /// The value as it is.
    pub fn raw(&mut self, key: &'static str) -> Option<&'t DeValue<'t>> {
        self.get(key).map(Spanned::get_ref)
    }

    /// Where the value of a key stands.
    pub fn at(&mut self, key: &'static str) -> Option<usize> {
        self.get(key).map(|value| value.span().start)
    }

    /// Whether there is such a key.
    pub fn has(&self, key: &str) -> bool {
        self.table.contains_key(key)
    }

    /// Adds a problem for each key that was not read.
    pub fn finish(self) {
        for key in self.table.keys() {
            let name: &str = key.get_ref();
            if !self.asked.contains(&name) {
                let hint = self.hint(name, &self.asked);
                self.problem(key.span().start).add(format!("unknown key `{name}` in {}{hint}", self.title));
            }
        }
    }

    /// The known name that is close to the one given, else all of them.
    fn hint(&self, given: &str, known: &[&str]) -> String {
        let hint = self.problems.suggestion(given, known.iter().copied());
        if hint.is_empty() { format!(" (known: {})", known.join(", ")) } else { hint }
    }

    fn text_of(&self, key: &str, value: &Value<'_>) -> Option<At<String>> {
        let at = value.span().start;
        match value.get_ref() {
            DeValue::String(text) if text.chars().any(is_unprintable) => {
                let fix = "which cannot be shown: use printable characters";
                self.problem(at).add(format!("`{key}` is \"{text}\", {fix}"));
                None
            }
            DeValue::String(text) => Some(At { value: text.to_string(), at }),
            other => {
                self.problem(at).add(format!("`{key}` must be a string, not {}", kind(other)));
                None
            }
        }
    }

    /// A whole number in the array `key`.
    pub fn integer_of(&self, key: &str, value: &Value<'_>) -> Option<At<i64>> {
        let at = value.span().start;
        let problem = match value.get_ref() {
            DeValue::Integer(number) => match integer(number) {
                Some(value) => return Some(At { value, at }),
                None => format!("`{key}` is {number}, out of range: write a whole number of at most 63 bits"),
            },
            other => format!("`{key}` must be a whole number, not {}", kind(other)),
        };
        self.problem(at).add(problem);
        None
    }

    /// A time in the array `key`.
    pub fn time_of(&self, key: &str, value: &Value<'_>) -> Option<At<u64>> {
        let at = value.span().start;
        let parsed = match value.get_ref() {
            DeValue::String(text) => nanoseconds(text).map_err(|no| match no {
                NoTime::Other => {
                    format!("`{key}` is not a time: \"{text}\"; write one such as \"1.5ms\" (ns, us, ms, s)")
                }
                NoTime::TooFine => {
                    format!("`{key}` is \"{text}\", which is finer than 1ns, the smallest unit: round it up")
                }
                NoTime::TooLong => {
                    format!(
                        "`{key}` is \"{text}\", longer than {} s, the longest time: lower it",
                        u64::MAX / 1_000_000_000
                    )
                }
            }),
            other => {
                Err(format!("`{key}` must be a time with its unit, such as \"1.5ms\", not {}", kind(other)))
            }
        };
        parsed.map(|value| At { value, at }).map_err(|message| self.problem(at).add(message)).ok()
    }
}

fn integer(number: &DeInteger<'_>) -> Option<i64> {
    i64::from_str_radix(number.as_str(), number.radix()).ok()
}

/// Why a text is not a time.
#[derive(Debug, PartialEq)]
enum NoTime {
    Other,
    TooFine,
    TooLong,
}

/// Exact: a fraction below a nanosecond is refused.
fn nanoseconds(text: &str) -> Result<u64, NoTime> {
    let text = text.trim();
    let unit_at = text.find(|c: char| !(c.is_ascii_digit() || c == '.' || c == '_')).ok_or(NoTime::Other)?;
    let (number, unit) = (text[..unit_at].replace('_', ""), text[unit_at..].trim());
    let digits = match unit {
        "ns" => 0,
        "us" | "µs" | "μs" => 3,
        "ms" => 6,
        "s" => 9,
        _ => return Err(NoTime::Other),
    };
    let (whole, fraction) = number.split_once('.').unwrap_or((&number, ""));
    let fraction = fraction.trim_end_matches('0');
    if whole.is_empty() || fraction.contains('.') {
        return Err(NoTime::Other);
    }
    if fraction.len() > digits {
        return Err(NoTime::TooFine);
    }
    format!("{whole}{fraction:0<digits$}").parse().map_err(|_| NoTime::TooLong)
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
    use super::{NoTime, Section, nanoseconds, read};

    #[test]
    fn numbers_are_read_in_their_radix_and_named_if_they_are_too_large() {
        let number = |text: &str| {
            let found =
                read(text, "`n = 1`", |mut root: Section<'_>| root.number_in("n", 0.5..=1e3, "a number"));
            found.map_err(|problems| problems.to_string())
        };
        for text in ["n = 0x10", "n = 16", "n = 16.0"] {
            assert_eq!(number(text), Ok(Some(16.0)), "{text}");
        }
        let refused = |shown: &str| Err(format!("1:5: `n` is {shown}: write a number from 0.5 to 1000"));
        for wrong in ["nan", "inf", "-1", "0x1000"] {
            assert_eq!(number(&format!("n = {wrong}")), refused(wrong));
        }
        let integer = |text: &str| read(text, "`n = 1`", |mut root: Section<'_>| root.integer("n"));
        assert_eq!(integer("n = 0x10").unwrap().unwrap().value, 16);
        let refused = integer("n = 9223372036854775808").unwrap_err().to_string();
        assert!(
            refused.contains("`n` is 9223372036854775808, out of range: write a whole number"),
            "{refused}"
        );
    }

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
            assert_eq!(nanoseconds(text), Ok(ns), "{text}");
        }
        for text in ["", "ms", "10", "-1ms", "1.2.3ms", "5 min", "._ms"] {
            assert_eq!(nanoseconds(text), Err(NoTime::Other), "{text}");
        }
        for text in ["1.5ns", "0.0000000001s"] {
            assert_eq!(nanoseconds(text), Err(NoTime::TooFine), "{text}");
        }
        for text in ["99999999999999999999s", "18446744073709551616ns"] {
            assert_eq!(nanoseconds(text), Err(NoTime::TooLong), "{text}");
        }
        let said = |text: &str| {
            let found = read(&format!("t = \"{text}\""), "`t = 1`", |mut root: Section<'_>| root.time("t"));
            found.unwrap_err().to_string()
        };
        assert_eq!(
            said("1.5ns"),
            "1:5: `t` is \"1.5ns\", which is finer than 1ns, the smallest unit: round it up"
        );
        assert_eq!(
            said("600000000000s"),
            "1:5: `t` is \"600000000000s\", longer than 18446744073 s, the longest time: lower it"
        );
    }
}
