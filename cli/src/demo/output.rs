// SPDX-License-Identifier: MIT OR Apache-2.0
//! Where the report goes: the terminal, a picture, JSON.

use super::report::{self, DemoReport};
use super::{DemoArgs, plot};
use crate::verb::{Failure, Outcome};
use std::fs::File;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

/// The files to write. They are opened before the run, so an unusable path is an error at once.
pub struct Files {
    svg: Output,
    json: Option<Output>,
}

/// A file that gets its name when it is complete; until then an earlier file of this name stays.
struct Output {
    path: PathBuf,
    part: PathBuf,
    file: File,
}

impl Output {
    fn open(path: &Path) -> Outcome<Self> {
        let mut part = path.as_os_str().to_owned();
        part.push(".part");
        let part = PathBuf::from(part);
        let file = File::create(&part).map_err(|error| unwritten(path, &error))?;
        Ok(Output { path: path.to_path_buf(), file, part })
    }

    fn finish(&mut self, content: &[u8]) -> Outcome {
        let written = self.file.write_all(content).and_then(|()| std::fs::rename(&self.part, &self.path));
        written.map_err(|error| unwritten(&self.path, &error))
    }
}

fn unwritten(path: &Path, error: &io::Error) -> Failure {
    let path = path.display();
    Failure::unusable(format!("{path} cannot be written: {error}; choose another place with --svg or --json"))
}

impl Drop for Output {
    /// Removes the temporary file if it was not renamed.
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.part);
    }
}

impl Files {
    pub fn open(args: &DemoArgs) -> Outcome<Self> {
        let json = args.json.as_deref().map(Output::open).transpose()?;
        Ok(Files { svg: Output::open(&args.svg)?, json })
    }

    pub fn write(&mut self, report: &DemoReport, verbose: bool) -> Outcome {
        self.svg.finish(plot::render_svg(report)?.as_bytes())?;
        let mut written = format!("Picture: {}", self.svg.path.display());
        if let Some(json) = &mut self.json {
            let mut text = Vec::new();
            report::write_json(report, &mut text)?;
            json.finish(&text)?;
            written += &format!("; JSON: {}", json.path.display());
        }
        // After the files, which a closed terminal must not prevent.
        let mut out = crate::print::stdout();
        report::write_text(report, verbose, &mut out)?;
        let more = if verbose { "" } else { "; --verbose prints more" };
        Ok(writeln!(out, "{written}{more}")?)
    }
}
