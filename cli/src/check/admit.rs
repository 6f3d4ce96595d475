// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut check --admit`: analyses a file together with everything that runs in a domain.
use std::io::{self, Write};

use serde::Serialize;
use tautline::Context;
use tautline_analysis::file::admission::{Admission, Candidate, Share};
use tautline_analysis::file::{CheckedSystem, SystemFile};
use tautline_system::Running;

use crate::table::{BAD, GOOD, WARNING, wrap};

/// The result of the admission.
pub struct Admitted {
    domain: u32,
    running: Running,
    admission: Admission,
}

/// The result in JSON.
#[derive(Serialize)]
pub struct Verdict<'a> {
    admitted: bool,
    domain: u32,
    /// The running processes.
    beside: &'a [String],
    broken: Vec<String>,
    /// What was not looked at.
    notes: &'a [String],
}

/// The name that the file gives to this host: `TAUT_HOST`, or the file's only host.
pub fn this_host<'f>(file: &'f SystemFile, label: &str) -> Result<&'f str, String> {
    let wanted = tautline_system::environment("TAUT_HOST");
    file.host(wanted.as_deref()).map_err(|hosts| {
        let hosts = hosts.join(", ");
        match &wanted {
            Some(wanted) => format!("{label} has no host '{wanted}': set TAUT_HOST to one of {hosts}"),
            None => format!("which of {label}'s hosts is this? TAUT_HOST=<{hosts}>"),
        }
    })
}

impl Admitted {
    /// Analyses the file together with what runs in `domain`, by default the environment's domain.
    pub fn new(file: &SystemFile, label: &str, domain: Option<u32>) -> Result<Admitted, String> {
        let host = this_host(file, label)?;
        let domain = match domain {
            Some(domain) => domain,
            None => Context::domain_of_environment().map_err(|error| error.to_string())?,
        };
        let running = Running::of_domain(domain).map_err(|error| error.to_string())?;
        let admission = running.machine().admit(&Candidate::File(Share { file, host, label }));
        Ok(Admitted { domain, running, admission })
    }

    /// Everything that would run, including the file.
    pub fn checked(&self) -> &CheckedSystem {
        &self.admission.checked
    }

    pub fn is_admitted(&self) -> bool {
        self.admission.broken.is_empty()
    }

    pub fn json(&self) -> Verdict<'_> {
        Verdict {
            admitted: self.is_admitted(),
            domain: self.domain,
            beside: &self.running.processes,
            broken: self.admission.broken.iter().map(ToString::to_string).collect(),
            notes: &self.running.notes,
        }
    }

    /// Writes the verdict below the table.
    pub fn write(&self, out: &mut impl Write) -> io::Result<()> {
        let Admitted { domain, running, admission } = self;
        for note in &running.notes {
            writeln!(out, "{WARNING}warning:{WARNING:#} {note}")?;
        }
        let beside = match running.processes.as_slice() {
            [] => "nothing that has real-time priorities and shares its statistics".to_owned(),
            processes => processes.join(", "),
        };
        if admission.broken.is_empty() {
            let text = format!("Admitted to domain {domain}, beside {beside}.");
            return writeln!(out, "{GOOD}{}{GOOD:#}", wrap(&text));
        }
        let text = format!("Not admitted to domain {domain}, beside {beside}:");
        writeln!(out, "{BAD}{}{BAD:#}", wrap(&text))?;
        admission.broken.iter().try_for_each(|broken| writeln!(out, "- {broken}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn people_and_scripts_are_told_what_was_not_looked_at() {
        let text = "[hosts.robot]\ncores = 1\n[nodes.n]\n[topics]\na = { period = \"100ms\" }\n\
                    [callbacks.drive]\ntopic = \"a\"\nwcet = \"10ms\"\npriority = 50\n";
        let file = SystemFile::parse(text).unwrap();
        let mut running = Running::default();
        running.notes.push("a process is not looked at".to_owned());
        let candidate = Candidate::File(Share { file: &file, host: "robot", label: "system.toml" });
        let admission = running.machine().admit(&candidate);
        let admitted = Admitted { domain: 3, running, admission };
        let mut shown = Vec::new();
        admitted.write(&mut shown).unwrap();
        assert!(String::from_utf8_lossy(&shown).contains("a process is not looked at"));
        let verdict = serde_json::to_value(admitted.json()).unwrap();
        assert_eq!(verdict["notes"], serde_json::json!(["a process is not looked at"]));
    }
}
