// SPDX-License-Identifier: MIT OR Apache-2.0
//! Makes a valid bag of what a killed process, a full disk or a bad sector left.

use crate::disk::rename_to_new;
use crate::metadata::{Description, write_metadata};
use crate::parts::custom_data_of;
use crate::reader::{Event, FileReader, FileSummary, files_of};
use crate::writer::{Open, TopicId};
use crate::{BagError, Damage, Options, Topic};
use std::collections::{BTreeMap, HashMap};
use std::fs::{self, File, TryLockError};
use std::io::{Error, ErrorKind};
use std::os::fd::AsRawFd;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// A file of a bag that was recovered.
#[derive(Clone, Debug)]
pub struct Recovered {
    /// Its content now.
    pub summary: FileSummary,
    /// The damage found; if empty, the file is unchanged.
    pub damage: Vec<Damage>,
    /// The total number of damaged parts; the first hundred are listed.
    pub damages: u64,
    /// The path of the original file, if it was damaged.
    pub before: Option<PathBuf>,
}

/// Replaces each damaged file by a new one with all its undamaged messages, topics, attachments and metadata, and writes the folder's
/// `metadata.yaml` again. The original file is kept next to it as `.damaged`, or `.damaged.1` and so on if that exists: other tools may
/// be able to read more of it; so is a `metadata.yaml` that cannot be read. `tell` is called with each file before it is read.
///
/// # Errors
/// There is no bag; a file of it is being written or recovered by another process; a file cannot be read or written: then it is
/// unchanged.
pub fn recover(path: &Path, tell: &mut dyn FnMut(&Path)) -> Result<Vec<Recovered>, BagError> {
    let files = files_of(path)?;
    // All files are locked before the first one is changed.
    let _locks = files.iter().map(|file| lock(file)).collect::<Result<Vec<_>, _>>()?;
    let one = |file: &PathBuf| {
        tell(file);
        recover_file(file)
    };
    let files = files.iter().map(one).collect::<Result<Vec<_>, _>>()?;
    if path.is_dir() {
        let summaries: Vec<_> = files.iter().map(|file| file.summary.clone()).collect();
        let custom_data = match custom_data_of(path) {
            Ok(custom_data) => custom_data,
            Err(BagError::Read { source, .. }) if source.kind() == ErrorKind::NotFound => BTreeMap::new(),
            // Other tools may be able to read it.
            Err(_) => keep_original(&path.join("metadata.yaml")).map(|_| BTreeMap::new())?,
        };
        write_metadata(path, &Description::mcap(&custom_data), &summaries)?;
    }
    Ok(files)
}

/// Whether another process has the file open for writing, as far as the kernel tells this user: for the user's own files and, for root,
/// for all files on local file systems.
///
/// # Errors
/// The file cannot be opened.
pub fn is_being_written(path: &Path) -> Result<bool, BagError> {
    let file = File::open(path).map_err(BagError::read(path))?;
    Ok(is_locked(file.try_lock_shared()) || has_writer(&file))
}

/// Takes the lock that a recorder and `recover` hold on a file.
fn lock(path: &Path) -> Result<File, BagError> {
    let file = File::open(path).map_err(BagError::read(path))?;
    match is_locked(file.try_lock()) || has_writer(&file) {
        true => Err(BagError::Busy { path: path.to_owned() }),
        false => Ok(file),
    }
}

/// On file systems without locks, no file is locked.
fn is_locked(locked: Result<(), TryLockError>) -> bool {
    matches!(locked, Err(TryLockError::WouldBlock))
}

/// Whether any process, of any program, has the file open for writing: then the kernel grants no read lease.
#[expect(unsafe_code, reason = "rustix has no leases")]
fn has_writer(file: &File) -> bool {
    /// Selects the signal that reports that a process wants to write; from <linux/fcntl.h>.
    const F_SETSIG: libc::c_int = 10;
    let fd = file.as_raw_fd();
    // SAFETY: the descriptor is open; the calls have integers for arguments. A process that opens the file for writing while the lease is
    // held is made to wait and SIGURG is sent here, which is ignored by default.
    unsafe {
        libc::fcntl(fd, F_SETSIG, libc::SIGURG);
        let is_refused = libc::fcntl(fd, libc::F_SETLEASE, libc::F_RDLCK) == -1
            && Error::last_os_error().kind() == ErrorKind::WouldBlock;
        libc::fcntl(fd, libc::F_SETLEASE, libc::F_UNLCK);
        is_refused
    }
}

fn recover_file(path: &Path) -> Result<Recovered, BagError> {
    let mut reader = FileReader::open(path)?;
    reader.read(&mut |_| Ok::<_, BagError>(()))?;
    let summary = reader.summary();
    let (damage, damages) = reader.damage();
    let damage = damage.to_vec();
    if damage.is_empty() {
        return Ok(Recovered { summary, damage, damages, before: None });
    }
    let unfinished = path.with_extension("mcap.recovering");
    // Removes what a killed recovery left.
    let _ = fs::remove_file(&unfinished);
    let written = rewrite(path, &unfinished, &summary).and_then(|summary| {
        let before = keep_original(path)?;
        fs::rename(&unfinished, path).map_err(|error| {
            // If the original was moved, it is moved back.
            let _ = rename_to_new(&before, path);
            BagError::write(path)(error)
        })?;
        Ok((summary, before))
    });
    match written {
        Ok((summary, before)) => {
            let summary = FileSummary { path: path.to_owned(), ..summary };
            Ok(Recovered { summary, damage, damages, before: Some(before) })
        }
        Err(error) => {
            let _ = fs::remove_file(&unfinished);
            Err(error)
        }
    }
}

/// Gives the original file a second name, which nothing had. Whenever this process is killed, the file is there.
fn keep_original(path: &Path) -> Result<PathBuf, BagError> {
    for number in 0_u32.. {
        let mut before = path.as_os_str().to_owned();
        before.push(if number == 0 { ".damaged".to_owned() } else { format!(".damaged.{number}") });
        let before = PathBuf::from(before);
        // Without links, as on FAT, it is moved.
        let kept = fs::hard_link(path, &before).or_else(|error| match error.kind() {
            ErrorKind::AlreadyExists => Err(error),
            _ => rename_to_new(path, &before),
        });
        match kept {
            Ok(()) => return Ok(before),
            Err(error) if error.kind() == ErrorKind::AlreadyExists => {}
            Err(error) => return Err(BagError::write(&before)(error)),
        }
    }
    Err(BagError::Exists(path.to_owned()))
}

fn rewrite(path: &Path, to: &Path, summary: &FileSummary) -> Result<FileSummary, BagError> {
    let mut out =
        Open::create(to, Options { compression: summary.compression, ..Options::default() }, Arc::default())?;
    // The ids of topics by their addresses: each topic comes before its messages.
    let (mut ids, mut topics) = (HashMap::<usize, TopicId>::new(), Vec::<Topic>::new());
    FileReader::open(path)?.read(&mut |event| match event {
        Event::Topic(topic) => {
            ids.insert(Arc::as_ptr(topic).addr(), out.add_topic(topic)?);
            topics.push(Topic::clone(topic));
            Ok(())
        }
        Event::Attachment(attachment) => out.attach(&attachment),
        Event::Metadata(name, metadata) => out.write_metadata(&name, metadata),
        Event::Message(message) => {
            out.write(ids[&Arc::as_ptr(message.topic).addr()], message.stamp, message.cdr)
        }
    })?;
    out.finish(&topics)
}
