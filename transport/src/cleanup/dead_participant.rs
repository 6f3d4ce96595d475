// SPDX-License-Identifier: MIT OR Apache-2.0
//! Cleanup of a file whose owner has died.
//!
//! A participant's lock is free only if its process has ended. The samples that it sent remain until the subscriptions that are to
//! take them have mapped them. Then its entry among the members is freed, the other members are called, and finally its file is
//! unlinked. If the process that does this is killed meanwhile, another process starts the cleanup again. If several participants
//! die at once, none waits for the cleanup of another.

use crate::error::TransportError;
use crate::graph::domain::{Domain, has_owner};
use crate::graph::log::{EntryKind, Reader};
use crate::graph::record::{PortKind, PortRecord};
use crate::memory::control::View;
use crate::memory::file;
use crate::memory::file::{PackedRange, Peer};
use crate::memory::header::Gid;
use rustix::fs::FlockOperation;
use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};
use tautline_rt::domain::{shared_folder, shared_path};
use tautline_rt::shm::{self, PeerFile, ShmError};

/// How long a killed publisher's samples wait for subscriptions that have not found them yet: meanwhile others do not see that it died.
const PATIENCE: Duration = Duration::from_millis(20);
/// The same for a participant whose publishers had all ended before, which the other participants have seen.
const PATIENCE_AFTER_END: Duration = Duration::from_secs(10);
/// How often this is checked.
const PERIOD: Duration = Duration::from_millis(1);
const PERIOD_AFTER_END: Duration = Duration::from_millis(10);

pub(super) enum FileState {
    /// Its owner is alive, or is ending right now.
    Owned,
    /// Its owner has died: to be [cleaned up](clean_up).
    Dead(Dead),
    /// Its owner has died, but the file must stay.
    Kept,
    /// The file no longer exists.
    Gone,
}

/// The files of the domain's folder that have owners.
///
/// # Errors
/// The system refuses, for example at its limit of open files.
pub(super) fn names(domain: u32) -> Result<Vec<String>, TransportError> {
    let paths = shm::list(&format!("{}/", shared_folder(domain))).map_err(file::file_error)?;
    let names = paths.iter().filter_map(|path| path.file_name()?.to_str());
    Ok(names.filter(|name| has_owner(name)).map(str::to_owned).collect())
}

/// A participant that has died, or a file without an owner.
pub(super) struct Dead {
    /// Locked until the cleanup is complete: the next process finds either no file, or a free lock.
    file: PeerFile,
    id: Option<u64>,
    sent: Vec<View>,
    /// Its publishers ended before it did.
    has_ended: bool,
    until: Instant,
    /// The participants that are to map its samples have been called.
    has_called: bool,
}

/// Checks whether the owner of the file `name` is alive.
///
/// # Errors
/// The system refuses, for example at its limit of open files.
pub(super) fn check_file(domain: &Domain, name: &str) -> Result<FileState, TransportError> {
    let path = shared_path(domain.number()).join(name);
    let file = match PeerFile::open(path, false) {
        Err(ShmError { source, .. }) if source.kind() == io::ErrorKind::NotFound => {
            return Ok(FileState::Gone);
        }
        file => file.map_err(file::file_error)?,
    };
    if rustix::fs::flock(&file, FlockOperation::NonBlockingLockExclusive).is_err() {
        return Ok(FileState::Owned);
    }
    if tautline_trace::is_trace_file(name) {
        drop(file);
        tautline_trace::remove_dead_files(domain.number());
        // Events that nobody has fetched wait for a recorder.
        return Ok(FileState::Kept);
    }
    let id = file::id_of(name);
    let peer = match id.map(|id| Peer::open(domain.number(), id)) {
        Some(Err(error)) if error.is_passing() => return Err(error),
        // A file that cannot be read belongs to no participant, and its cleanup waits for nobody.
        peer => peer.and_then(|peer| peer.ok().flatten()),
    };
    let (sent, has_ended) = peer.as_ref().map_or((Vec::new(), false), publishers);
    let until = Instant::now() + if has_ended { PATIENCE_AFTER_END } else { PATIENCE };
    Ok(FileState::Dead(Dead { file, id, sent, has_ended, until, has_called: false }))
}

/// Cleans up the participants whose samples no subscription still has to map; the others stay in the list.
pub(super) fn clean_up(domain: &Domain, dead: &mut Vec<Dead>) {
    if dead.is_empty() {
        return;
    }
    let mut places: BTreeMap<u64, usize> = domain.members().map(|member| (member.id, member.place)).collect();
    // Dead participants do not map anything any more.
    places.retain(|id, _| dead.iter().all(|dead| dead.id != Some(*id)));
    let mut has_changed = false;
    let mut removed = Vec::new();
    for mut one in std::mem::take(dead) {
        let awaited = one.awaited(&places);
        let is_over = one.until <= Instant::now();
        if awaited.is_empty() || is_over {
            if one.has_ended && !awaited.is_empty() {
                tracing::warn!(
                    "{} processes of domain {} have not fetched within {PATIENCE_AFTER_END:?} what publishers had sent them that have \
                     ended, which is lost: are they stopped, or without processor time?",
                    awaited.len(),
                    domain.number()
                );
            }
            has_changed |= one.id.is_some_and(|id| domain.remove(id));
            removed.push(one.file);
            continue;
        }
        if !std::mem::replace(&mut one.has_called, true) {
            awaited.into_iter().for_each(|place| domain.call(place));
        }
        dead.push(one);
    }
    if has_changed {
        domain.call_all();
    }
    for file in removed {
        // A file that this user may not remove stays.
        let _ = rustix::fs::unlink(file.path());
    }
}

impl Dead {
    /// The time until the next check.
    pub(super) fn period(&self) -> Duration {
        if self.has_ended { PERIOD_AFTER_END } else { PERIOD }
    }

    /// Whether a participant that becomes the warden, or stops being it, waits until this cleanup is complete.
    pub(super) fn is_urgent(&self) -> bool {
        !self.has_ended
    }

    /// Shortens the patience: after this process there may be no other one to complete the cleanup.
    pub(super) fn hurry(&mut self) {
        self.has_ended = false;
        self.until = self.until.min(Instant::now() + PATIENCE);
    }

    /// The entries of the participants that have not mapped yet all samples that were sent to them.
    fn awaited(&self, places: &BTreeMap<u64, usize>) -> BTreeSet<usize> {
        let behind = self.sent.iter().flat_map(|view| {
            let grown = view.head().grown.load(Ordering::Acquire);
            let open = view.connections().into_iter();
            open.filter(move |connection| connection.block().back.is_behind(grown))
        });
        let of = behind.map(|connection| connection.subscription().participant());
        of.filter_map(|id| places.get(&id).copied()).collect()
    }
}

/// The memory of each publisher in the record of `peer`, and whether all of them have ended.
fn publishers(peer: &Peer) -> (Vec<View>, bool) {
    let news = Reader::default().read(peer);
    let mut places = BTreeMap::new();
    let mut live = BTreeSet::new();
    for (entry, _) in news.map(|news| news.entries).unwrap_or_default() {
        match entry.kind {
            EntryKind::Port | EntryKind::Ended => {
                let port = PortRecord::parse(&entry.body).filter(|port| port.kind == PortKind::Publisher);
                if port.is_some() && entry.kind == EntryKind::Port {
                    live.insert(entry.number);
                } else {
                    live.remove(&entry.number);
                }
                places.extend(port.map(|port| (entry.number, port.at)));
            }
            EntryKind::Gone => {
                live.remove(&entry.number);
                places.remove(&entry.number);
            }
            _ => {}
        }
    }
    let view = |(number, at): (&u64, &u64)| {
        let first = PackedRange::from_word(*at)?;
        let mut view = View::open(first, peer.map(first, true).ok()??, Gid::of(peer.id, *number))?;
        for range in view.missing() {
            view.add(range, peer.map(range, true).ok()??);
        }
        Some(view)
    };
    (places.iter().filter_map(view).collect(), live.is_empty())
}
