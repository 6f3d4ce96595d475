// SPDX-License-Identifier: MIT OR Apache-2.0
//! Files that a verb writes whole or not at all.

use rustix::fs::OFlags;
use std::fs::{self, File, Metadata, OpenOptions, Permissions, TryLockError};
use std::io::{self, Write};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt, PermissionsExt, fchown};
use std::path::{Path, PathBuf};

/// A file that gets its name when it is complete; until then an earlier file of this name stays, whose permissions it has then, its group if this user
/// is in it, and for root its owner. Of several that are written at once the last one stays. What is no regular file, such as a pipe, `/dev/null` or a
/// symbolic link, keeps its name and is written at once.
pub struct NewFile {
    path: PathBuf,
    /// Locked until it is complete.
    partial: Option<PathBuf>,
    /// Of the earlier file.
    before: Option<Metadata>,
    file: File,
}

impl NewFile {
    /// An error at once if the path is unusable.
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
        // Until it has the earlier file's permissions nobody else reads it.
        let (partial, file) = create_beside(path, if before.is_some() { 0o600 } else { 0o666 })?;
        Ok(NewFile { path: path.to_owned(), partial: Some(partial), before, file })
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Gives it its name.
    pub fn finish(&mut self) -> io::Result<()> {
        if let Some(partial) = &self.partial {
            if let Some(before) = &self.before {
                // Not everyone may give a file to this group, and root alone to another owner; who may not keeps it.
                let _ = fchown(&self.file, None, Some(before.gid()));
                let _ = fchown(&self.file, Some(before.uid()), None);
                self.file.set_permissions(Permissions::from_mode(before.mode() & 0o777))?;
                // After a power cut there may be an empty file else, and the earlier one be gone.
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
    /// Removes what is not complete.
    fn drop(&mut self) {
        if let Some(partial) = &self.partial {
            let _ = fs::remove_file(partial);
        }
    }
}

/// A new file beside this one, which is locked. What others have locked stays; what a killed run has left is removed.
fn create_beside(path: &Path, mode: u32) -> io::Result<(PathBuf, File)> {
    let mut number = 0;
    loop {
        let mut partial = path.as_os_str().to_owned();
        partial.push(if number == 0 { ".partial".to_owned() } else { format!(".{number}.partial") });
        let partial = PathBuf::from(partial);
        let is_free = match OpenOptions::new().write(true).create_new(true).mode(mode).open(&partial) {
            Ok(file) => match file.try_lock() {
                Ok(()) if is_named(&file, &partial) => return Ok((partial, file)),
                // Another one took it for a leftover before it was locked.
                Ok(()) => true,
                Err(TryLockError::WouldBlock) => false,
                // Where there are no locks nobody removes it.
                Err(TryLockError::Error(_)) => return Ok((partial, file)),
            },
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => remove_leftover(&partial),
            Err(error) => return Err(error),
        };
        number += u32::from(!is_free);
    }
}

/// Says whether the name may be free now: nobody had locked the file.
fn remove_leftover(partial: &Path) -> bool {
    let flags = OFlags::NOFOLLOW | OFlags::NONBLOCK;
    let file = match OpenOptions::new().write(true).custom_flags(flags.bits().cast_signed()).open(partial) {
        Ok(file) => file,
        Err(error) => return error.kind() == io::ErrorKind::NotFound,
    };
    let is_leftover = file.metadata().is_ok_and(|found| found.is_file()) && file.try_lock().is_ok();
    // Its writer may have given it another name just before.
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

/// Replaces the file that is there, or to which a symbolic link leads.
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
