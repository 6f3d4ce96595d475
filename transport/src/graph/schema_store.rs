// SPDX-License-Identifier: MIT OR Apache-2.0
//! The definitions of the types on this host's topics, one file for each type hash. With them a tool can read messages
//! of a type that it was not built with.
//!
//! A process that opens a topic with hash and definition stores the definition here, in files that only this user can
//! read or write. A stored definition is untrusted: readers that can compute the hash check it before use.

use crate::graph::topic_type::TopicType;
use crate::names::is_hash;
use rustix::fs::{self, AtFlags, Mode, OFlags};
use rustix::io::Errno;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, Read, Write};
use std::os::fd::{AsFd, AsRawFd, OwnedFd};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, Once};
use tautline_rt::clock::monotonic_ns;

/// The longest definition that is stored or read. Definitions of ROS 2's own packages are below 20 KB.
pub const MAX_SCHEMA_BYTES: usize = 1 << 20;

const FOLDER: &str = "schemas";
const PRIVATE_FOLDER: Mode = Mode::RWXU;
const OTHERS: Mode = Mode::RWXG.union(Mode::RWXO);
const OTHERS_WRITE: Mode = Mode::WGRP.union(Mode::WOTH);

/// The folder of this user's schemas.
#[derive(Clone, Debug)]
pub struct SchemaStore {
    /// The parent folder.
    root: PathBuf,
}

/// A definition as read from a file. It has not been checked yet whether it belongs to the type whose hash
/// names the file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ClaimedSchema {
    /// The file.
    pub path: PathBuf,
    /// Its content: ros2msg text.
    pub text: String,
}

impl SchemaStore {
    /// The store of the user who runs this process, and of its scope:
    /// `/tmp/tautline_<uid>[.<scope>]/schemas`.
    pub fn of_user() -> Self {
        Self::at(tautline_rt::domain::kept_folder())
    }

    /// A store in this folder, which is created if its parent exists.
    pub fn at(root: impl Into<PathBuf>) -> Self {
        SchemaStore { root: root.into() }
    }

    /// The folder with the files.
    pub fn path(&self) -> PathBuf {
        self.root.join(FOLDER)
    }

    /// Stores a definition, unless there is already one for this hash. Readers see the whole definition or nothing, even if
    /// several processes write.
    ///
    /// # Errors
    /// [`io::Error`]: the folder cannot be created or written, or belongs to another user; the hash is invalid; the text is
    /// longer than [`MAX_SCHEMA_BYTES`].
    pub fn keep(&self, hash: &str, text: &str) -> io::Result<()> {
        check_hash(hash)?;
        if text.len() > MAX_SCHEMA_BYTES {
            return Err(invalid(format!(
                "a definition of {} bytes is too long: at most {MAX_SCHEMA_BYTES}",
                text.len()
            )));
        }
        let folder = self.make()?;
        match fs::statat(&folder, hash, AtFlags::SYMLINK_NOFOLLOW) {
            Ok(stat) if stat.st_size > 0 || text.is_empty() => return Ok(()),
            // An empty file, which a crash of the system left.
            Ok(_) => {}
            // The file has no name until it is complete, so that a killed process leaves nothing. Not every file system supports this.
            Err(Errno::NOENT) if link_whole(&folder, hash, text) => return Ok(()),
            Err(Errno::NOENT) => {}
            Err(error) => return Err(error.into()),
        }
        let (process, thread) = (rustix::process::getpid(), rustix::thread::gettid());
        let temporary = format!(
            ".{hash}.{}.{}.{}",
            process.as_raw_pid(),
            thread.as_raw_pid(),
            tautline_rt::clock::monotonic_ns()
        );
        let flags = OFlags::CREATE | OFlags::EXCL | OFlags::WRONLY | OFlags::CLOEXEC | OFlags::NOFOLLOW;
        let file = fs::openat(&folder, &temporary, flags, Mode::RUSR | Mode::WUSR)?;
        let written = File::from(file)
            .write_all(text.as_bytes())
            .and_then(|()| Ok(fs::renameat(&folder, &temporary, &folder, hash)?));
        if written.is_err() {
            let _ = fs::unlinkat(&folder, &temporary, AtFlags::empty());
        }
        written
    }

    /// Reads the definition that is stored for a hash; `None` if there is none.
    ///
    /// # Errors
    /// [`io::Error`]: the file cannot be read, is not a regular file, is longer than [`MAX_SCHEMA_BYTES`] or is not
    /// text; the folder belongs to another user.
    pub fn read(&self, hash: &str) -> io::Result<Option<ClaimedSchema>> {
        check_hash(hash)?;
        let folder = match self.open() {
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
            folder => folder?,
        };
        // Not blocking: it might be a pipe.
        let flags = OFlags::RDONLY | OFlags::NOFOLLOW | OFlags::NONBLOCK | OFlags::CLOEXEC;
        let file = match fs::openat(&folder, hash, flags, Mode::empty()) {
            Err(Errno::NOENT) => return Ok(None),
            file => File::from(file?),
        };
        if !file.metadata()?.is_file() {
            return Err(invalid("it is not a file".to_owned()));
        }
        let mut text = String::new();
        file.take(MAX_SCHEMA_BYTES as u64 + 1).read_to_string(&mut text)?;
        if text.len() > MAX_SCHEMA_BYTES {
            return Err(invalid(format!("it is longer than {MAX_SCHEMA_BYTES} bytes")));
        }
        Ok(Some(ClaimedSchema { path: self.path().join(hash), text }))
    }

    fn make(&self) -> io::Result<OwnedFd> {
        for path in [&self.root, &self.path()] {
            match fs::mkdir(path, PRIVATE_FOLDER) {
                Ok(()) | Err(Errno::EXIST) => {}
                Err(error) => return Err(error.into()),
            }
        }
        self.open()
    }

    /// Opens the folder. Both folders must belong to this user, because anybody can create folders where they are.
    fn open(&self) -> io::Result<OwnedFd> {
        let flags = OFlags::DIRECTORY | OFlags::NOFOLLOW | OFlags::RDONLY | OFlags::CLOEXEC;
        let root = fs::open(&self.root, flags, Mode::empty())?;
        check_owner(&self.root, &root, OTHERS_WRITE)?;
        let folder = fs::openat(&root, FOLDER, flags, Mode::empty())?;
        check_owner(&self.path(), &folder, OTHERS)?;
        Ok(folder)
    }
}

/// How long a stored definition is not checked again: many topics of one type may be opened in a row.
const KEPT_NS: u64 = 1_000_000_000;

/// Stores the definition of a topic's type if its opener knows hash and definition. A failure is logged once and is not an
/// error: it affects only tools that lack the definition.
pub(crate) fn keep(topic_type: &TopicType) {
    static SAID: Once = Once::new();
    // Only try-locked: no thread waits for it, nor does a forked child.
    static KEPT: Mutex<BTreeMap<PathBuf, u64>> = Mutex::new(BTreeMap::new());
    let (Some(hash), Some(definition)) = (&topic_type.hash, &topic_type.definition) else { return };
    let store = SchemaStore::of_user();
    let (path, now_ns) = (store.path().join(&**hash), monotonic_ns());
    let is_recent = |kept_ns: &u64| now_ns.saturating_sub(*kept_ns) < KEPT_NS;
    if KEPT.try_lock().is_ok_and(|kept| kept.get(&path).is_some_and(is_recent)) {
        return;
    }
    match store.keep(hash, definition) {
        Ok(()) => {
            if let Ok(mut kept) = KEPT.try_lock() {
                kept.insert(path, now_ns);
            }
        }
        Err(error) => SAID.call_once(|| {
            tracing::warn!(
                "the definition of '{}' cannot be kept in {}: {error}; topics work, but tools that do not know the type \
                 cannot read them: see that the folder is this user's own, of mode 700, on a file system with room (said \
                 once)",
                topic_type.name,
                store.path().display()
            );
        }),
    }
}

/// Creates a file atomically with all its content. False if this is not possible; true also if another process was faster.
fn link_whole(folder: impl AsFd, name: &str, text: &str) -> bool {
    let flags = OFlags::TMPFILE | OFlags::WRONLY | OFlags::CLOEXEC;
    let Ok(file) = fs::openat(&folder, ".", flags, Mode::RUSR | Mode::WUSR) else { return false };
    let mut file = File::from(file);
    let unnamed = format!("/proc/self/fd/{}", file.as_raw_fd());
    let link = || match fs::linkat(fs::CWD, unnamed, folder, name, AtFlags::SYMLINK_FOLLOW) {
        Ok(()) | Err(Errno::EXIST) => true,
        Err(_) => false,
    };
    file.write_all(text.as_bytes()).is_ok() && link()
}

fn check_hash(hash: &str) -> io::Result<()> {
    if is_hash(hash) { Ok(()) } else { Err(invalid(format!("'{hash}' is not a type hash"))) }
}

fn check_owner(path: &Path, folder: impl AsFd, forbidden: Mode) -> io::Result<()> {
    let stat = fs::fstat(folder)?;
    let mode = Mode::from_raw_mode(stat.st_mode);
    if stat.st_uid == rustix::process::geteuid().as_raw() && !mode.intersects(forbidden) {
        return Ok(());
    }
    let reason = format!(
        "{} is open to other users (owner {}, mode {:o}): remove it",
        path.display(),
        stat.st_uid,
        mode.as_raw_mode() & 0o777
    );
    Err(io::Error::new(io::ErrorKind::PermissionDenied, reason))
}

fn invalid(reason: String) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, reason)
}

#[cfg(all(test, not(taut_loom)))]
mod tests {
    use super::*;
    use std::fs as files;
    use std::os::unix::fs::{PermissionsExt, symlink};

    struct Scratch(PathBuf);

    impl Scratch {
        fn new(name: &str) -> (Scratch, SchemaStore) {
            let root = std::env::temp_dir().join(format!("taut_schemas_{}_{name}", std::process::id()));
            let store = SchemaStore::at(&root);
            (Scratch(root), store)
        }
    }

    impl Drop for Scratch {
        fn drop(&mut self) {
            let _ = files::remove_dir_all(&self.0);
            let _ = files::remove_file(&self.0);
        }
    }

    fn hash(digit: char) -> String {
        format!("RIHS01_{}", String::from(digit).repeat(64))
    }

    fn names(store: &SchemaStore) -> Vec<String> {
        let entries = files::read_dir(store.path()).unwrap();
        entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect()
    }

    #[test]
    fn what_is_kept_is_read_and_private() {
        let (scratch, store) = Scratch::new("kept");
        assert_eq!(store.read(&hash('1')).unwrap(), None);
        store.keep(&hash('1'), "uint8 x\n").unwrap();
        store.keep(&hash('1'), "another definition\n").unwrap();
        store.keep(&hash('2'), "").unwrap();
        let claimed = store.read(&hash('1')).unwrap().unwrap();
        assert_eq!((claimed.path, claimed.text.as_str()), (store.path().join(hash('1')), "uint8 x\n"));
        assert_eq!(store.read(&hash('2')).unwrap().unwrap().text, "");
        assert_eq!(store.read(&hash('3')).unwrap(), None);
        for folder in [scratch.0.clone(), store.path()] {
            assert_eq!(files::metadata(folder).unwrap().permissions().mode() & 0o777, 0o700);
        }
        // Cut off by a crash.
        files::write(store.path().join(hash('1')), "").unwrap();
        store.keep(&hash('1'), "uint8 x\n").unwrap();
        assert_eq!(store.read(&hash('1')).unwrap().unwrap().text, "uint8 x\n");
    }

    #[test]
    fn a_reader_beside_many_writers_sees_all_of_it_or_nothing() {
        let (_scratch, store) = Scratch::new("writers");
        let text = "uint8 x\n".repeat(10_000);
        std::thread::scope(|scope| {
            for _ in 0..4 {
                scope.spawn(|| {
                    for digit in ('0'..='9').chain('a'..='f') {
                        store.keep(&hash(digit), &text).unwrap();
                    }
                });
            }
            while store.read(&hash('f')).unwrap().is_none() {
                for digit in ('0'..='9').chain('a'..='f') {
                    assert!(store.read(&hash(digit)).unwrap().is_none_or(|claimed| claimed.text == text));
                }
            }
        });
        assert_eq!(names(&store).len(), 16, "nothing temporary is left: {:?}", names(&store));
    }

    #[test]
    fn what_is_no_schema_is_refused() {
        let (_scratch, store) = Scratch::new("refused");
        for no_hash in ["", "..", "../x", "RIHS01_", &hash('1')[1..]] {
            assert!(store.keep(no_hash, "").is_err() && store.read(no_hash).is_err(), "{no_hash}");
        }
        let long = " ".repeat(MAX_SCHEMA_BYTES + 1);
        assert!(store.keep(&hash('1'), &long).unwrap_err().to_string().contains("too long"));
        store.keep(&hash('0'), "x").unwrap();
        files::write(store.path().join(hash('1')), &long).unwrap();
        assert!(store.read(&hash('1')).unwrap_err().to_string().contains("longer than"));
        files::write(store.path().join(hash('2')), [0xff, 0xfe]).unwrap();
        store.read(&hash('2')).unwrap_err();
        files::create_dir(store.path().join(hash('3'))).unwrap();
        store.read(&hash('3')).unwrap_err();
        symlink("/etc/passwd", store.path().join(hash('4'))).unwrap();
        store.read(&hash('4')).unwrap_err();
    }

    #[test]
    fn a_folder_that_others_can_change_is_not_used() {
        let (scratch, store) = Scratch::new("folder");
        // A file is in the way.
        files::write(&scratch.0, "").unwrap();
        store.keep(&hash('1'), "x").unwrap_err();
        files::remove_file(&scratch.0).unwrap();
        // A link.
        symlink("/tmp", &scratch.0).unwrap();
        store.keep(&hash('1'), "x").unwrap_err();
        files::remove_file(&scratch.0).unwrap();
        // Others may look in, or write.
        store.keep(&hash('1'), "x").unwrap();
        for (folder, mode) in [(store.path(), 0o755), (scratch.0.clone(), 0o777)] {
            files::set_permissions(&folder, files::Permissions::from_mode(mode)).unwrap();
            let error = store.keep(&hash('2'), "x").unwrap_err();
            assert!(error.to_string().contains("open to other users"), "{error}");
            store.read(&hash('1')).unwrap_err();
            files::set_permissions(&folder, files::Permissions::from_mode(0o700)).unwrap();
        }
        store.read(&hash('1')).unwrap().unwrap();
    }
}
