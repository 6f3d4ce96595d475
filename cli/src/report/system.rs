// SPDX-License-Identifier: MIT OR Apache-2.0
//! A system file and its analysis.
use std::path::Path;

use tautline_analysis::file::{CheckedSystem, FileError, SystemFile};

use crate::check::file_failure;
use crate::verb::{Failure, Outcome};

pub struct System {
    pub text: String,
    pub file: SystemFile,
    pub checked: CheckedSystem,
}

impl System {
    pub fn parse(path: &Path, text: &str) -> Outcome<System> {
        let file = SystemFile::parse(text)
            .map_err(|source| file_failure(&FileError::Content { path: path.into(), source }))?;
        Ok(System { text: text.into(), checked: file.check(), file })
    }
}

pub fn read(path: &Path) -> Outcome<String> {
    std::fs::read_to_string(path).map_err(|error| Failure::unreadable(path, &error))
}
