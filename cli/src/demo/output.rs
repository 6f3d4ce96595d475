// SPDX-License-Identifier: MIT OR Apache-2.0
//! Where the report goes: the terminal, a picture, JSON.

use super::report::{self, DemoReport};
use super::{DemoArgs, DemoError, plot};
use crate::replace::NewFile;
use std::io::Write;
use std::path::Path;

/// The files to write. They are opened before the run, so an unusable path is an error at once.
pub struct Files {
    svg: NewFile,
    json: Option<NewFile>,
}

impl Files {
    pub fn open(args: &DemoArgs) -> Result<Self, DemoError> {
        let open = |path: &Path| {
            NewFile::create(path).map_err(|source| DemoError::Write { path: path.into(), source })
        };
        Ok(Files { svg: open(&args.svg)?, json: args.json.as_deref().map(open).transpose()? })
    }

    pub fn write(&mut self, report: &DemoReport, verbose: bool) -> Result<(), DemoError> {
        let finish = |file: &mut NewFile, content: &[u8]| {
            let written = file.write_all(content).and_then(|()| file.finish());
            written.map_err(|source| DemoError::Write { path: file.path().into(), source })
        };
        finish(&mut self.svg, plot::render_svg(report)?.as_bytes())?;
        let mut written = format!("Picture: {}", self.svg.path().display());
        if let Some(json) = &mut self.json {
            let mut text = Vec::new();
            report::write_json(report, &mut text).map_err(DemoError::Print)?;
            finish(json, &text)?;
            written += &format!("; JSON: {}", json.path().display());
        }
        // After the files, which a closed terminal must not prevent.
        let mut out = crate::print::stdout();
        report::write_text(report, verbose, &mut out).map_err(DemoError::Print)?;
        let more = if verbose { "" } else { "; --verbose prints more" };
        writeln!(out, "{written}{more}").map_err(DemoError::Print)
    }
}
