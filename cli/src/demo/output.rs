// SPDX-License-Identifier: MIT OR Apache-2.0
//! Where the report goes: the terminal, a picture, JSON.

use super::args::DemoArgs;
use super::report::{self, DemoReport};
use super::{plot, text};
use crate::replace::NewFile;
use crate::verb::{Failure, Outcome};
use std::io::{self, Write};
use std::path::Path;

/// The files to write. They are opened before the run, so an unusable path is an error at once.
pub struct Files {
    svg: NewFile,
    json: Option<NewFile>,
}

fn unwritten(path: &Path, error: &io::Error) -> Failure {
    let path = path.display();
    Failure::unusable(format!("{path} cannot be written: {error}; choose another place with --svg or --json"))
}

impl Files {
    pub fn open(args: &DemoArgs) -> Outcome<Self> {
        let open = |path: &Path| NewFile::create(path).map_err(|error| unwritten(path, &error));
        Ok(Files { svg: open(&args.svg)?, json: args.json.as_deref().map(open).transpose()? })
    }

    pub fn write(&mut self, report: &DemoReport, verbose: bool) -> Outcome {
        let finish = |file: &mut NewFile, content: &[u8]| {
            let written = file.write_all(content).and_then(|()| file.finish());
            written.map_err(|error| unwritten(file.path(), &error))
        };
        finish(&mut self.svg, plot::render_svg(report)?.as_bytes())?;
        let mut written = format!("Picture: {}", self.svg.path().display());
        if let Some(json) = &mut self.json {
            let mut text = Vec::new();
            report::write_json(report, &mut text)?;
            finish(json, &text)?;
            written += &format!("; JSON: {}", json.path().display());
        }
        // After the files, which a closed terminal must not prevent.
        let mut out = crate::print::stdout();
        text::write_text(report, verbose, &mut out)?;
        let more = if verbose { "" } else { "; --verbose prints more" };
        Ok(writeln!(out, "{written}{more}")?)
    }
}
