// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a bench says of a figure that has a goal: a line for the terminal, a row of a table for the documents and pages.

use std::fmt;

use serde::Serialize;

use crate::table::Column::{Text, Words};
use crate::table::{Cell, Shown, Table, distinct, shown_of};

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Outcome {
    Held,
    Missed,
    /// Or measured under conditions that allow no comparison; the note says why.
    NotMeasured,
}

impl Outcome {
    pub fn word(self) -> &'static str {
        match self {
            Outcome::Held => "held",
            Outcome::Missed => "MISSED",
            Outcome::NotMeasured => "not measured",
        }
    }
}

/// `None`: it could not be judged.
impl From<Option<bool>> for Outcome {
    fn from(is_held: Option<bool>) -> Self {
        match is_held {
            Some(true) => Outcome::Held,
            Some(false) => Outcome::Missed,
            None => Outcome::NotMeasured,
        }
    }
}

/// A figure and its goal.
#[derive(Clone, Debug, Serialize)]
pub struct Verdict {
    /// Experiment, size and metric.
    pub what: String,
    /// Empty if there is none.
    pub figure: String,
    pub goal: String,
    pub outcome: Outcome,
    #[serde(skip_serializing_if = "String::is_empty")]
    pub note: String,
    /// Why a missed goal stays missed.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cause: Option<&'static str>,
    /// A miss fails the bench, as no machine has a part in it.
    #[serde(skip)]
    pub must: bool,
}

/// One line, without the cause.
impl fmt::Display for Verdict {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Verdict { what, figure, goal, outcome, note, .. } = self;
        let parts = [figure, goal, note].into_iter().filter(|part| !part.is_empty());
        write!(
            f,
            "{:12}  {what}: {}",
            outcome.word(),
            parts.map(String::as_str).collect::<Vec<_>>().join("; ")
        )
    }
}

/// A line for each; those with one cause stand together above it.
pub fn text(verdicts: &[Verdict]) -> String {
    let mut text = String::new();
    for cause in distinct(verdicts.iter().map(|verdict| verdict.cause)) {
        verdicts.iter().filter(|verdict| verdict.cause == cause).for_each(|of| text += &format!("{of}\n"));
        text += &cause.map_or(String::new(), |cause| format!("{:12}  why: {cause}\n", ""));
    }
    text
}

/// Prints them.
///
/// # Errors
/// One that must hold is missed.
pub fn print(verdicts: &[Verdict]) -> crate::Result {
    print!("{}", text(verdicts));
    let is_broken = |verdict: &&Verdict| verdict.must && verdict.outcome == Outcome::Missed;
    let broken: Vec<&str> = verdicts.iter().filter(is_broken).map(|verdict| &*verdict.what).collect();
    if broken.is_empty() {
        Ok(())
    } else {
        Err(format!("missed, and must hold: {}", broken.join("; ")).into())
    }
}

const SHOWN: [Shown<Verdict>; 6] = [
    (Words(""), |of| Cell::marked(of.outcome.word(), of.outcome == Outcome::Missed)),
    (Text("figure"), |of| of.what.as_str().into()),
    (Text("measured"), |of| of.figure.as_str().into()),
    (Words("goal"), |of| of.goal.as_str().into()),
    (Text("note"), |of| of.note.as_str().into()),
    (Text("why it is missed"), |of| of.cause.unwrap_or_default().into()),
];

/// For the documents and pages.
pub fn table(verdicts: &[Verdict]) -> Table {
    shown_of(0, &SHOWN, verdicts)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn verdict(what: &str, outcome: Outcome, cause: Option<&'static str>) -> Verdict {
        let [what, figure, goal] = [what, "2.00 x", "at most 1.00 x"].map(str::to_owned);
        Verdict { what, figure, goal, outcome, note: String::new(), cause, must: false }
    }

    #[test]
    fn a_verdict_is_a_line_and_a_cause_is_said_once() {
        let all = [
            verdict("a", Outcome::Held, None),
            verdict("b", Outcome::Missed, Some("two wakes")),
            Verdict {
                note: "lost".into(),
                figure: String::new(),
                ..verdict("c", Outcome::NotMeasured, None)
            },
            verdict("d", Outcome::Missed, Some("two wakes")),
        ];
        assert_eq!(
            text(&all),
            "held          a: 2.00 x; at most 1.00 x\n\
             not measured  c: at most 1.00 x; lost\n\
             MISSED        b: 2.00 x; at most 1.00 x\n\
             MISSED        d: 2.00 x; at most 1.00 x\n              why: two wakes\n"
        );
        let markdown = table(&all).markdown();
        assert!(markdown.contains("| MISSED | d | 2.00 x | at most 1.00 x |  | two wakes |"), "{markdown}");
        let mut page = String::new();
        table(&all).html(&mut page).unwrap();
        assert_eq!(page.matches("class=\"late\">MISSED").count(), 2, "{page}");
    }

    #[test]
    fn only_a_missed_goal_that_must_be_met_is_an_error() {
        let must = |outcome| Verdict { must: true, ..verdict("a", outcome, None) };
        assert!(print(&[verdict("b", Outcome::Missed, None), must(Outcome::NotMeasured)]).is_ok());
        assert_eq!(print(&[must(Outcome::Missed)]).unwrap_err().to_string(), "missed, and must hold: a");
    }
}
