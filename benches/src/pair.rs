// SPDX-License-Identifier: MIT OR Apache-2.0
//! A pair of processes that measures round trips: one answers, the other asks and holds the clock.

use std::error::Error;
use std::io::{Write, stdout};
use std::process::Command;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::Process;

type Result<T> = std::result::Result<T, Box<dyn Error>>;

/// What one of a pair says: a line of JSON on its standard output.
#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Line {
    /// It can answer.
    Ready,
    Measured(Measured),
}

/// What the one that asks measured.
#[derive(Debug, Serialize, Deserialize)]
pub struct Measured {
    /// Times in ns, and how often each occurred.
    pub counts: Vec<(u64, u64)>,
    /// Round trips whose answer did not come, or whose wake-up was lost; not in `counts`.
    pub lost: u64,
}

impl Line {
    pub fn say(&self) -> Result<()> {
        println!("{}", serde_json::to_string(self)?);
        Ok(stdout().flush()?)
    }
}

/// Starts both, the one that asks when the other can answer, and waits for what was measured; both still run then.
///
/// # Errors
/// One of them failed, said nothing in time, or it was interrupted.
pub fn measure<'a>(
    [mut answers, mut asks]: [Command; 2],
    patience: Duration,
    interrupted: &'a AtomicBool,
) -> Result<(Measured, [Process<'a, Line>; 2])> {
    let mut answers = Process::start(&mut answers, "answering process", interrupted)?;
    answers.expect(patience, |line| matches!(line, Line::Ready).then_some(()))?;
    let mut asks = Process::start(&mut asks, "asking process", interrupted)?;
    let measured = asks.expect(patience, |line| match line {
        Line::Measured(measured) => Some(measured),
        Line::Ready => None,
    });
    match measured {
        Ok(measured) => Ok((measured, [asks, answers])),
        Err(error) if interrupted.load(Ordering::Relaxed) => Err(error),
        // Either of them may have been the first to fail.
        Err(error) => Err(format!("{error}; its peer: {}", answers.last_words()).into()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_one_that_asks_is_started_when_the_other_can_answer_and_both_words_are_told() {
        static NEVER: AtomicBool = AtomicBool::new(false);
        let shell = |script: &str| {
            let mut command = Command::new("sh");
            command.args(["-c", script]);
            command
        };
        let run = |answers: &str, asks: &str| {
            measure([shell(answers), shell(asks)], Duration::from_secs(20), &NEVER)
        };
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("there").display().to_string();
        let measured = format!(
            "test -e {file} && echo '{{\"measured\": {{\"counts\": [[5, 2]], \"lost\": 1}}}}'; read line"
        );
        let (measured, mut ends) =
            run(&format!("sleep 0.1; touch {file}; echo '\"ready\"'; read line"), &measured).unwrap();
        assert_eq!((measured.counts, measured.lost), (vec![(5, 2)], 1));
        ends[0].still_runs().unwrap();
        let error =
            run("echo '\"ready\"'; echo why >&2; read line", "echo because >&2").unwrap_err().to_string();
        assert!(
            error.contains("asking process ended early: stderr: because; its peer: stderr: why"),
            "{error}"
        );
        assert!(
            run("echo no >&2", "")
                .unwrap_err()
                .to_string()
                .contains("answering process ended early: stderr: no")
        );
    }
}
