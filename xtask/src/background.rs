// SPDX-License-Identifier: MIT OR Apache-2.0
//! Steps in a process of their own while this one goes on with others: what waits, for a network or for other processes, leaves most of the
//! machine to what builds.

use crate::steps::{Done, Outcome, Steps, announce, are_timings_kept, only, variables};
use crate::{files, machine};
use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};
use std::process::{Child, Command};

/// Such a process.
#[must_use = "its steps count once they are joined"]
pub struct Background {
    job: String,
    child: io::Result<Child>,
    /// What it prints.
    printed: PathBuf,
    /// How its steps ended.
    done: PathBuf,
}

impl Background {
    /// Starts this program with the verb `background`, which runs the steps of a job, as nice to others as that.
    pub fn start(job: &str, niceness: u8) -> Background {
        let file = |ending| machine::target_dir().join(format!("background-{job}.{ending}"));
        let (printed, done) = (file("log"), file("json"));
        let _ = fs::remove_file(&done);
        let start = || {
            let to = File::create(&printed)?;
            // Where this program was, a build may have put another.
            let own = format!("/proc/{}/exe", std::process::id());
            let mut command = Command::new("nice");
            command.args([&*format!("-n{niceness}"), &own, "background", job]).arg(&done);
            command.envs(variables());
            command.args(only().iter().map(|begin| format!("--only={begin}")));
            command.args(are_timings_kept().then_some("--timings"));
            announce(&command);
            println!("{job}: in the background; what it prints comes when it has ended");
            command.stdout(to.try_clone()?).stderr(to).spawn()
        };
        let child = start();
        Background { job: job.to_owned(), child, printed, done }
    }
}

impl Steps {
    /// Waits for the end of a job, shows what it printed, and counts its steps with these; says whether none of them failed.
    pub fn join(&mut self, background: Background) -> bool {
        let Background { job, child, printed, done } = background;
        println!("\n{job}, in the background:");
        let ended = child.and_then(|mut child| child.wait());
        let shown = File::open(&printed).and_then(|mut printed| io::copy(&mut printed, &mut io::stdout()));
        let read = shown.map_err(|error| error.to_string()).and_then(|_| read(&done));
        let begin = self.done.len();
        match (ended, read) {
            (Ok(_), Ok(done)) => self.done.extend(done),
            (Ok(_), Err(reason)) => self.fail(&job, reason),
            (Err(error), _) => self.fail(&job, format!("cannot be started: {error}")),
        }
        !self.done[begin..].iter().any(|done| matches!(done.outcome, Outcome::Failed(_)))
    }

    /// Instead of [`finish`](Self::finish), for the process of a job: writes down how its steps ended.
    pub fn hand_over(self, path: &Path) -> Result<(), String> {
        let written = serde_json::to_vec(&self.done).map_err(io::Error::from);
        written.and_then(|written| fs::write(path, written)).map_err(files::at(path))
    }
}

/// What [`Steps::hand_over`] has written.
fn read(path: &Path) -> Result<Vec<Done>, String> {
    let done = fs::read(path).and_then(|text| Ok(serde_json::from_slice(&text)?));
    done.map_err(files::at(path))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::steps::text;

    #[test]
    fn steps_of_another_process_are_counted() {
        let folder = tempfile::tempdir().unwrap();
        let file = |name| folder.path().join(name);
        let mut others = Steps::new();
        others.step("passes", || Outcome::Ok);
        others.step("fails", || Err("with \"words\"".to_owned()));
        others.skip("is left out", "no network");
        others.hand_over(&file("done")).unwrap();
        fs::write(file("printed"), "").unwrap();
        let background = |done| {
            let child = Command::new("true").spawn();
            Background { job: "others".to_owned(), child, printed: file("printed"), done: file(done) }
        };
        let mut steps = Steps::new();
        assert!(!steps.join(background("done")), "one failed");
        let texts: Vec<String> =
            steps.done.iter().map(|done| format!("{} {}", done.name, text(&done.outcome))).collect();
        assert_eq!(texts, ["passes ok", "fails FAILED: with \"words\"", "is left out skipped: no network"]);
        assert!(!steps.join(background("nothing")), "it said nothing");
        let lost = text(&steps.done[3].outcome);
        assert!(steps.done[3].name == "others" && lost.contains("No such file"), "{lost}");
    }
}
