// SPDX-License-Identifier: MIT OR Apache-2.0
//! The result of a check, and its output.

use crate::table::{BAD, GOOD, WARNING, wrap};
use serde_json::{Value, json};
use std::io::{self, Write};

#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Verdict {
    /// No bound holds, or something is refused or lost.
    Bad,
    /// The value could not be read, which counts as a failure.
    Unknown,
    /// It costs time; bounds that were measured with it hold.
    Advice,
    Good,
}

tautline_rt::names!(Verdict: pub const fn as_str(self) -> &'static str {
    Bad: "bad", Unknown: "unknown", Advice: "advice", Good: "good",
});

impl Verdict {
    fn style(self) -> crate::print::Colour {
        match self {
            Verdict::Bad => BAD,
            Verdict::Unknown | Verdict::Advice => WARNING,
            Verdict::Good => GOOD,
        }
    }
}

/// The cost for a real-time thread.
#[derive(Clone, Debug)]
pub enum Cost {
    /// No time, or messages instead of time.
    None,
    /// The cost in µs, and its source.
    Known(f64, String),
    Unknown(&'static str),
}

/// An unknown cost that only a measurement shows.
pub const MEASURE: Cost = Cost::Unknown("not known; --measure shows it");

#[derive(Clone, Debug)]
pub struct Finding {
    pub check: &'static str,
    pub verdict: Verdict,
    /// The value that was measured or read.
    pub value: String,
    pub cost: Cost,
    pub fix: String,
    /// The fix as lines of a shell script; lines that need a person's decision are comments.
    pub script: Vec<String>,
}

/// `Err` names the value that could not be read.
pub type Checked = Result<Finding, String>;

impl Finding {
    pub fn new(verdict: Verdict, value: impl Into<String>) -> Self {
        let (fix, script) = (String::new(), Vec::new());
        Finding { check: "", verdict, value: value.into(), cost: Cost::None, fix, script }
    }

    pub fn good(value: impl Into<String>) -> Self {
        Finding::new(Verdict::Good, value)
    }

    pub fn advice(value: impl Into<String>) -> Self {
        Finding::new(Verdict::Advice, value)
    }

    pub fn bad(value: impl Into<String>) -> Self {
        Finding::new(Verdict::Bad, value)
    }

    pub fn unknown(value: impl Into<String>) -> Self {
        Finding::new(Verdict::Unknown, value)
    }

    /// The finding of the check with this name.
    pub fn of(check: &'static str, found: Checked) -> Self {
        let unread = |tried: String| {
            let fix = "run it as root, or find out why the kernel or the container hides it";
            Finding::unknown(format!("cannot be read: {tried}")).costs(MEASURE).fix(fix)
        };
        Finding { check, ..found.unwrap_or_else(unread) }
    }

    pub fn costs(self, cost: Cost) -> Self {
        Finding { cost, ..self }
    }

    pub fn fix(self, fix: impl Into<String>) -> Self {
        Finding { fix: fix.into(), ..self }
    }

    pub fn script<T: Into<String>>(self, lines: impl IntoIterator<Item = T>) -> Self {
        Finding { script: lines.into_iter().map(Into::into).collect(), ..self }
    }

    pub fn to_json(&self) -> Value {
        let (cost_us, cost_source) = match &self.cost {
            Cost::None => (None, None),
            Cost::Known(us, source) => (Some(us), Some(source.as_str())),
            Cost::Unknown(hint) => (None, Some(*hint)),
        };
        json!({
            "check": self.check, "verdict": self.verdict.as_str(), "value": self.value,
            "cost_us": cost_us, "cost_source": cost_source, "fix": self.fix, "script": self.script,
        })
    }

    /// The cost in words; `None` without a cost.
    pub fn cost_text(&self) -> Option<String> {
        match &self.cost {
            Cost::None => None,
            Cost::Known(us, source) => Some(format!("{us} µs ({source})")),
            Cost::Unknown(hint) => Some((*hint).to_owned()),
        }
    }

    pub fn write(&self, out: &mut impl Write) -> io::Result<()> {
        let (style, verdict) = (self.verdict.style(), self.verdict.as_str());
        let mut lines = vec![format!("{}: {}", self.check, plain(&self.value))];
        lines.extend(self.cost_text().map(|cost| format!("cost: {}", plain(&cost))));
        lines.extend((!self.fix.is_empty()).then(|| format!("fix: {}", plain(&self.fix))));
        let text = lines.iter().map(|line| wrap(line)).collect::<Vec<_>>().join("\n");
        let text = text.replace('\n', "\n         ");
        writeln!(out, "{style}{verdict:<7}{style:#}  {text}")
    }
}

/// Removes characters that would move a terminal's cursor or end a comment, because parts of the text come from other processes.
pub fn plain(text: &str) -> String {
    text.chars().map(|c| if c.is_control() { ' ' } else { c }).collect()
}

/// Whether no finding is bad or unknown.
pub fn is_fit(findings: &[Finding]) -> bool {
    findings.iter().all(|finding| finding.verdict > Verdict::Unknown)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_unknown_is_not_fit() {
        let all = |verdicts: &[Verdict]| -> Vec<Finding> {
            verdicts.iter().map(|verdict| Finding::new(*verdict, "")).collect()
        };
        assert!(is_fit(&all(&[Verdict::Good, Verdict::Advice])));
        assert!(!is_fit(&all(&[Verdict::Good, Verdict::Unknown])));
        assert!(!is_fit(&all(&[Verdict::Bad])));
    }

    #[test]
    fn findings_have_no_control_characters() {
        let finding = Finding { check: "x", ..Finding::good("a\x1b[31m\nb") };
        let mut out = Vec::new();
        finding.write(&mut out).unwrap();
        assert!(String::from_utf8(out).unwrap().ends_with("x: a [31m b\n"));
    }
}
