// SPDX-License-Identifier: MIT OR Apache-2.0
//! Files that a verb writes completely or not at all.

use rustix::fs::OFlags;
use std::fs::{self, File, Metadata, OpenOptions, Permissions, TryLockError};
use std::io::{self, Write};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt, PermissionsExt, fchown};
use std::path::{Path, PathBuf};

/// A file that replaces the earlier file at its path only when it is complete. It takes over that file's permissions, its group if this
/// user is a member, and its owner if this user is root. Of several files that are written to a path at once, the last one to finish stays.
/// A path that is not a regular file, such as a pipe, `/dev/null` or a symbolic link, is opened and written directly.
pub struct NewFile {
    path: PathBuf,
    /// The temporary file, locked until it is complete; `None` if the path is written directly.
    partial: Option<PathBuf>,
    /// The metadata of the earlier file.
    before: Option<Metadata>,
    file: File,
}

impl NewFile {
    /// Opens the file. An unusable path is an error here, before anything is written.
    pub fn create(path: &Path) -> io::Result<Self> {
        let before = fs::symlink_metadata(path).ok();
        if before.as_ref().is_some_and(|before| !before.is_file()) {
            return Ok(NewFile {
                path: path.to_owned(),
                partial: None,
                before: None,
                file: File::create(path)?,
            });
        }
        // No other user may read the file before it has the earlier file's permissions.
        let (partial, file) = create_beside(path, if before.is_some() { 0o600 } else { 0o666 })?;
        Ok(NewFile { path: path.to_owned(), partial: Some(partial), before, file })
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Renames the file to its path.
    pub fn finish(&mut self) -> io::Result<()> {
        if let Some(partial) = &self.partial {
            if let Some(before) = &self.before {
                // Only a member may set this group, and only root another owner; otherwise the file keeps the user's own.
                let _ = fchown(&self.file, None, Some(before.gid()));
                let _ = fchown(&self.file, Some(before.uid()), None);
                self.file.set_permissions(Permissions::from_mode(before.mode() & 0o777))?;
                // Without this, a power cut could leave an empty file in place of the earlier one.
                self.file.sync_all()?;
            }
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
    /// Removes the file if it is not complete.
    fn drop(&mut self) {
        if let Some(partial) = &self.partial {
            let _ = fs::remove_file(partial);
        }
    }
}

/// Creates and locks a new file beside this one. Files that other processes have locked stay; leftovers of killed runs are removed.
fn create_beside(path: &Path, mode: u32) -> io::Result<(PathBuf, File)> {
    let mut number = 0;
    loop {
        let mut partial = path.as_os_str().to_owned();
        partial.push(if number == 0 { ".partial".to_owned() } else { format!(".{number}.partial") });
        let partial = PathBuf::from(partial);
        let is_free = match OpenOptions::new().write(true).create_new(true).mode(mode).open(&partial) {
            Ok(file) => match file.try_lock() {
                Ok(()) if is_named(&file, &partial) => return Ok((partial, file)),
                // Another process removed the file as a leftover before it was locked.
                Ok(()) => true,
                Err(TryLockError::WouldBlock) => false,
                // On a file system without locks, no process removes the file.
                Err(TryLockError::Error(_)) => return Ok((partial, file)),
            },
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => remove_leftover(&partial),
            Err(error) => return Err(error),
        };
        number += u32::from(!is_free);
    }
}

/// Removes the file unless another process has locked it. Returns whether its name may be free now.
fn remove_leftover(partial: &Path) -> bool {
    let flags = OFlags::NOFOLLOW | OFlags::NONBLOCK;
    let file = match OpenOptions::new().write(true).custom_flags(flags.bits().cast_signed()).open(partial) {
        Ok(file) => file,
        Err(error) => return error.kind() == io::ErrorKind::NotFound,
    };
    let is_leftover = file.metadata().is_ok_and(|found| found.is_file()) && file.try_lock().is_ok();
    // The writer may have renamed the file just before.
    is_leftover && (!is_named(&file, partial) || fs::remove_file(partial).is_ok())
}

fn is_named(file: &File, path: &Path) -> bool {
    let [one, other] = [file.metadata(), fs::symlink_metadata(path)]
        .map(|found| found.ok().map(|found| (found.dev(), found.ino())));
    one.is_some() && one == other
}

/// Writes the file as [`NewFile`] does.
pub fn write(path: &Path, content: impl AsRef<[u8]>) -> io::Result<()> {
    let mut new = NewFile::create(path)?;
    new.write_all(content.as_ref())?;
    new.finish()
}

/// Replaces the existing file at this path, or the target of a symbolic link.
pub fn replace(path: &Path, text: &str) -> io::Result<()> {
    write(&fs::canonicalize(path)?, text)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::FileTypeExt;

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
        fs::set_permissions(&path, Permissions::from_mode(0o640)).unwrap();
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
    fn what_a_killed_run_has_left_is_taken_over_but_not_what_is_being_written() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a");
        let names = || {
            let entries = fs::read_dir(folder.path()).unwrap();
            let mut names: Vec<_> =
                entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
            names.sort();
            names
        };
        fs::write(folder.path().join("a.partial"), "a longer leftover").unwrap();
        fs::set_permissions(folder.path().join("a.partial"), Permissions::from_mode(0o600)).unwrap();
        let mut first = NewFile::create(&path).unwrap();
        assert_eq!(names(), ["a.partial"]);
        let second = NewFile::create(&path).unwrap();
        assert_eq!(names(), ["a.1.partial", "a.partial"]);
        first.write_all(b"new").unwrap();
        first.finish().unwrap();
        drop((first, second));
        assert_eq!(names(), ["a"]);
        assert_eq!(fs::read_to_string(&path).unwrap(), "new");
        // As any new file has them, and not the leftover's.
        fs::write(folder.path().join("b"), "").unwrap();
        let [a, b] = ["a", "b"].map(|name| fs::metadata(folder.path().join(name)).unwrap().mode());
        assert_eq!(a, b);
    }

    #[test]
    fn many_writers_at_once_each_have_their_own_partial_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a");
        std::thread::scope(|scope| {
            for writer in 0..8 {
                let path = &path;
                scope.spawn(move || {
                    for _ in 0..200 {
                        let text = writer.to_string().repeat(100);
                        let mut new = NewFile::create(path).unwrap();
                        for part in text.as_bytes().chunks(10) {
                            new.write_all(part).unwrap();
                        }
                        new.finish().unwrap();
                        let found = fs::read(path).unwrap();
                        assert!(
                            found.len() == 100 && found.iter().all(|byte| *byte == found[0]),
                            "{found:?}"
                        );
                    }
                });
            }
        });
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn what_replaces_a_file_is_private_until_it_is_complete() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a");
        fs::write(&path, "old").unwrap();
        fs::set_permissions(&path, Permissions::from_mode(0o4640)).unwrap();
        let mut new = NewFile::create(&path).unwrap();
        let mode = |name| fs::metadata(folder.path().join(name)).unwrap().mode() & 0o7777;
        assert_eq!(mode("a.partial"), 0o600);
        new.finish().unwrap();
        assert_eq!(mode("a"), 0o640);
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
