// SPDX-License-Identifier: MIT OR Apache-2.0
//! Where the report goes: the terminal, a picture, JSON.

use super::report::{self, DemoReport};
use super::{DemoArgs, DemoError, plot};
use std::fs::File;
use std::io::Write;
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
    fn open(path: &Path) -> Result<Self, DemoError> {
        let mut part = path.as_os_str().to_owned();
        part.push(".part");
        let part = PathBuf::from(part);
        let refuse = |source| DemoError::Write { path: path.to_path_buf(), source };
        Ok(Output { path: path.to_path_buf(), file: File::create(&part).map_err(refuse)?, part })
    }

    fn finish(&mut self, content: &[u8]) -> Result<(), DemoError> {
        let written = self.file.write_all(content).and_then(|()| std::fs::rename(&self.part, &self.path));
        written.map_err(|source| DemoError::Write { path: self.path.clone(), source })
    }
}

impl Drop for Output {
    /// Removes the temporary file if it was not renamed.
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.part);
    }
}

impl Files {
    pub fn open(args: &DemoArgs) -> Result<Self, DemoError> {
        let json = args.json.as_deref().map(Output::open).transpose()?;
        Ok(Files { svg: Output::open(&args.svg)?, json })
    }

    pub fn write(&mut self, report: &DemoReport, verbose: bool) -> Result<(), DemoError> {
        self.svg.finish(plot::render_svg(report)?.as_bytes())?;
        let mut written = format!("Picture: {}", self.svg.path.display());
        if let Some(json) = &mut self.json {
            let mut text = Vec::new();
            report::write_json(report, &mut text).map_err(DemoError::Print)?;
            json.finish(&text)?;
            written += &format!("; JSON: {}", json.path.display());
        }
        // After the files, which a closed terminal must not prevent.
        let mut out = crate::print::stdout();
        report::write_text(report, verbose, &mut out).map_err(DemoError::Print)?;
        let more = if verbose { "" } else { "; --verbose prints more" };
        writeln!(out, "{written}{more}").map_err(DemoError::Print)
    }
}
