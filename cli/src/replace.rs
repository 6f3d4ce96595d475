// SPDX-License-Identifier: MIT OR Apache-2.0
//! Files that a verb writes whole or not at all.

use std::fs::{self, File, OpenOptions};
use std::io::{self, Write};
use std::os::unix::fs::{MetadataExt, fchown};
use std::path::{Path, PathBuf};

/// A file that gets its name when it is complete; until then an earlier file of this name stays, whose owner and permissions it has. Of several that
/// are written at once the last one stays. What is no regular file, such as a pipe, `/dev/null` or a symbolic link, keeps its name and is written at once.
pub struct NewFile {
    path: PathBuf,
    partial: Option<PathBuf>,
    file: File,
}

impl NewFile {
    /// An error at once if the path is unusable.
    pub fn create(path: &Path) -> io::Result<Self> {
        let before = fs::symlink_metadata(path).ok();
        if before.as_ref().is_some_and(|before| !before.is_file()) {
            return Ok(NewFile { path: path.to_owned(), partial: None, file: File::create(path)? });
        }
        let (partial, file) = create_beside(path)?;
        let new = NewFile { path: path.to_owned(), partial: Some(partial), file };
        if let Some(before) = before {
            // Root alone may give a file away; who may not keeps it.
            let _ = fchown(&new.file, Some(before.uid()), Some(before.gid()));
            new.file.set_permissions(before.permissions())?;
        }
        Ok(new)
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Gives it its name.
    pub fn finish(&mut self) -> io::Result<()> {
        if let Some(partial) = &self.partial {
            fs::rename(partial, &self.path)?;
            self.partial = None;
        }
        Ok(())
    }
}

impl Write for NewFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.file.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Drop for NewFile {
    /// Removes what is not complete.
    fn drop(&mut self) {
        if let Some(partial) = &self.partial {
            let _ = fs::remove_file(partial);
        }
    }
}

/// A new file beside this one, which no other writer has.
fn create_beside(path: &Path) -> io::Result<(PathBuf, File)> {
    let mut number = 0;
    loop {
        let mut partial = path.as_os_str().to_owned();
        partial.push(format!(".{number}.partial"));
        match OpenOptions::new().write(true).create_new(true).open(&partial) {
            Ok(file) => return Ok((partial.into(), file)),
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => number += 1,
            Err(error) => return Err(error),
        }
    }
}

/// Replaces the file atomically.
pub fn replace(path: &Path, text: &str) -> io::Result<()> {
    // Follows a symbolic link, so that its target is replaced.
    let path = fs::canonicalize(path)?;
    let mut new = NewFile::create(&path)?;
    new.write_all(text.as_bytes())?;
    new.finish()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::{FileTypeExt, PermissionsExt};

    #[test]
    fn a_file_appears_when_it_is_complete() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a");
        fs::write(&path, "old").unwrap();
        let mut new = NewFile::create(&path).unwrap();
        new.write_all(b"new").unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), "old");
        new.finish().unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), "new");
        drop(NewFile::create(&path).unwrap());
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn writers_of_one_file_do_not_meet_and_its_permissions_stay() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a");
        fs::write(&path, "old").unwrap();
        fs::set_permissions(&path, fs::Permissions::from_mode(0o640)).unwrap();
        let mut both = [(); 2].map(|()| NewFile::create(&path).unwrap());
        for (new, text) in both.iter_mut().zip(["first", "the second"]) {
            new.write_all(text.as_bytes()).unwrap();
        }
        for (new, text) in both.iter_mut().zip(["first", "the second"]) {
            new.finish().unwrap();
            assert_eq!(fs::read_to_string(&path).unwrap(), text);
        }
        drop(both);
        assert_eq!(fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o640);
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn what_is_no_file_is_written_and_not_replaced() {
        let folder = tempfile::tempdir().unwrap();
        let pipe = folder.path().join("pipe");
        assert!(std::process::Command::new("mkfifo").arg(&pipe).status().unwrap().success());
        let reader = std::thread::spawn({
            let pipe = pipe.clone();
            move || fs::read_to_string(pipe).unwrap()
        });
        let mut new = NewFile::create(&pipe).unwrap();
        new.write_all(b"text").unwrap();
        new.finish().unwrap();
        drop(new);
        assert_eq!(reader.join().unwrap(), "text");
        assert!(fs::metadata(&pipe).unwrap().file_type().is_fifo());
    }
}
