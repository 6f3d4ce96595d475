// SPDX-License-Identifier: MIT OR Apache-2.0
//! Where a result is written.

use crate::replace::NewFile;
use crate::verb::{Failure, Outcome};
use std::io::{self, Write};
use std::path::Path;

/// The failure of a file that was named with -o.
pub fn unwritable(path: &Path, error: &io::Error) -> Failure {
    let path = path.display();
    Failure::unusable(format!("`{path}` cannot be written: {error}; choose another place with -o"))
}

/// Writes to standard output, or to a file that appears when it is complete.
pub fn write_to(path: &Path, write: impl FnOnce(&mut dyn Write) -> io::Result<()>) -> Outcome {
    if path == Path::new("-") {
        let mut to = io::BufWriter::new(crate::print::stdout());
        return match write(&mut to).and_then(|()| to.flush()) {
            // The reader has closed the pipe.
            Err(error) if error.kind() == io::ErrorKind::BrokenPipe => Ok(()),
            result => Ok(result?),
        };
    }
    let refuse = |error: io::Error| unwritable(path, &error);
    let mut to = io::BufWriter::new(NewFile::create(path).map_err(refuse)?);
    let written = write(&mut to).and_then(|()| to.flush());
    written.and_then(|()| to.get_mut().finish()).map_err(refuse)
}
