// SPDX-License-Identifier: MIT OR Apache-2.0
//! Finds the owners of a domain's files, and measures how long files of dead processes stay.

use crate::Result;
use crate::place::entries;
use crate::process::lock;
use std::collections::BTreeMap;
use std::fs::File;
use std::mem::MaybeUninit;
use std::os::unix::fs::{FileExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::inotify::{self, CreateFlags, ReadFlags, WatchFlags};
use tautline_rt::ThreadTime;
use tautline_rt::domain::shared_path;
use tautline_rt::host::steal_ticks;

/// Files that belong to all participants together.
const COMMON: [&str; 2] = ["domain", "warden"];

/// The process that a file names as its owner.
fn owner(path: &Path) -> Option<u32> {
    // Opening a pipe would block.
    if !std::fs::symlink_metadata(path).is_ok_and(|data| data.is_file()) {
        return None;
    }
    let mut head = [0; 40];
    let read = File::open(path).and_then(|file| file.read_at(&mut head, 0)).unwrap_or(0);
    // The first bytes of the files of participants, of traces and of statistics.
    let at = match &head[..8] {
        b"tautpart" => 12,
        b"tauttrac" => 16,
        b"tautstat" => 32,
        _ => return None,
    };
    let pid = u32::from_ne_bytes(head.get(at..at + 4)?.try_into().ok()?);
    (read >= at + 4 && pid != 0).then_some(pid)
}

/// The locked inodes, each with the process that holds the lock.
fn locks() -> BTreeMap<u64, u32> {
    let text = std::fs::read_to_string("/proc/locks").unwrap_or_default();
    let lock = |line: &str| {
        let words: Vec<_> = line.split_whitespace().collect();
        // Lines of waiting processes, with `->`, are filtered below.
        let place = words.iter().position(|word| *word == "FLOCK")?;
        let inode = words.get(place + 4)?.rsplit(':').next()?.parse().ok()?;
        Some((inode, words.get(place + 3)?.parse().ok()?))
    };
    text.lines().filter(|line| !line.contains("->")).filter_map(lock).collect()
}

fn files(domain: u32) -> impl Iterator<Item = PathBuf> {
    let is_owned =
        |path: &PathBuf| path.file_name().is_some_and(|name| !COMMON.iter().any(|common| *common == name));
    entries(&shared_path(domain)).into_iter().filter(is_owned)
}

pub fn warden(domain: u32) -> Option<u32> {
    let inode = std::fs::metadata(shared_path(domain).join("warden")).ok()?.ino();
    locks().get(&inode).copied()
}

/// Files that belong to this process, which has died, or to no living process, because theirs was killed while it created them.
pub fn of_dead(domain: u32, pid: u32) -> Vec<PathBuf> {
    let locks = locks();
    let inode = |path: &Path| std::fs::metadata(path).map(|data| data.ino()).ok();
    let is_of_dead = |path: &PathBuf| match owner(path) {
        Some(owner) => owner == pid,
        None => inode(path).is_some_and(|inode| !locks.contains_key(&inode)),
    };
    files(domain).filter(is_of_dead).collect()
}

/// Files that belong to none of these processes.
pub fn of_none(domain: u32, pids: &[u32]) -> Vec<PathBuf> {
    files(domain).filter(|path| owner(path).is_none_or(|pid| !pids.contains(&pid))).collect()
}

fn lives(pid: u32) -> bool {
    Path::new(&format!("/proc/{pid}")).exists()
}

fn is_of_living(path: &Path) -> bool {
    match owner(path) {
        Some(pid) => lives(pid),
        None => std::fs::metadata(path).is_ok_and(|data| locks().contains_key(&data.ino())),
    }
}

/// Checks that the folder was removed with the last process of its domain.
///
/// # Errors
/// The folder still exists; the error lists its content.
pub fn has_gone(domain: u32) -> Result<()> {
    match shared_path(domain).exists() {
        true => Err(format!("all have left or died, and the folder stays, {}", listing(domain)).into()),
        false => Ok(()),
    }
}

/// The content of a domain's folder, to find the cause of a failure.
pub fn listing(domain: u32) -> String {
    let locks = locks();
    let mut paths = entries(&shared_path(domain));
    paths.sort();
    let mut text = format!("{}:\n", shared_path(domain).display());
    for path in paths {
        let Ok(data) = std::fs::symlink_metadata(&path) else { continue };
        let lock = locks.get(&data.ino()).map_or("not locked".to_owned(), |pid| format!("locked by {pid}"));
        let owner = owner(&path).map_or("says nothing".to_owned(), |pid| {
            format!("of {pid}, {}", if lives(pid) { "lives" } else { "dead" })
        });
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        text += &format!("  {name} {} bytes, mode {:o}, {lock}, {owner}\n", data.len(), data.mode());
    }
    text
}

/// Steal of all cores together.
pub fn stolen() -> Duration {
    Duration::from_millis(10 * steal_ticks(None))
}

/// The time for which a thread was ready to run, and others ran.
pub fn waited(tid: u32) -> Duration {
    Duration::from_nanos(ThreadTime::of(tid).unwrap_or_default().waited_ns)
}

/// The time, up to some moment, for which a cleanup, or the detection of it by this program, did not get a core.
#[derive(Clone, Copy, Debug)]
struct Delays {
    stolen: Duration,
    /// The warden's process, and the time for which its thread has waited.
    warden: Option<(u32, Duration)>,
    watch: Duration,
}

impl Delays {
    /// `watch`: the thread that watches the folder.
    fn read(domain: u32, watch: u32) -> Self {
        let waited_by = |pid| {
            let threads = tautline_rt::threads_of(pid).unwrap_or_default();
            let warden = threads.iter().find(|thread| thread.name == "warden");
            (pid, warden.map_or(Duration::ZERO, |thread| waited(thread.tid)))
        };
        Delays { stolen: stolen(), warden: warden(domain).map(waited_by), watch: waited(watch) }
    }

    /// The delays since an earlier moment. A process that has become the warden since then may have waited before, too.
    fn since(&self, before: &Self) -> Duration {
        let warden = match (self.warden, before.warden) {
            (Some((pid, now)), Some((same, before))) if pid == same => now.saturating_sub(before),
            (now, _) => now.map_or(Duration::ZERO, |(_, waited)| waited),
        };
        let stolen = self.stolen.saturating_sub(before.stolen);
        stolen + warden + self.watch.saturating_sub(before.watch)
    }
}

#[derive(Clone, Debug, Default)]
pub struct Stay {
    pub worst: Duration,
    pub files: usize,
    /// Files that stayed longer than the limit, and the time for which their cleanup had a core, or could have had one.
    pub late: Vec<(PathBuf, Duration)>,
}

#[derive(Default)]
struct State {
    /// Files of dead processes, with the time of death, and the delays by then.
    dead: BTreeMap<PathBuf, (Instant, Delays)>,
    stay: Stay,
}

/// Watches the folder of a domain, which exists.
pub struct Watch {
    domain: u32,
    limit: Duration,
    state: Arc<Mutex<State>>,
    stop: Arc<AtomicBool>,
    tid: u32,
    thread: Option<std::thread::JoinHandle<()>>,
}

impl Watch {
    pub fn start(domain: u32, limit: Duration) -> Result<Self> {
        let watch = inotify::init(CreateFlags::NONBLOCK | CreateFlags::CLOEXEC)?;
        inotify::add_watch(&watch, shared_path(domain), WatchFlags::DELETE)?;
        let (state, stop) = (Arc::<Mutex<State>>::default(), Arc::<AtomicBool>::default());
        let (sender, tid) = std::sync::mpsc::channel();
        let thread = {
            let (state, stop) = (state.clone(), stop.clone());
            std::thread::spawn(move || {
                let tid = tautline_rt::current_tid();
                let _ = sender.send(tid);
                let gone = |name: &str| {
                    let delays = || Delays::read(domain, tid);
                    lock(&state).gone(&shared_path(domain).join(name), limit, delays);
                };
                let mut buffer = [MaybeUninit::uninit(); 4096];
                while !stop.load(Ordering::Relaxed) {
                    let pause = Timespec { tv_sec: 0, tv_nsec: 10_000_000 };
                    let _ = poll(&mut [PollFd::new(&watch, PollFlags::IN)], Some(&pause));
                    let mut reader = inotify::Reader::new(&watch, &mut buffer);
                    while let Ok(event) = reader.next() {
                        let name = event.file_name().and_then(|name| name.to_str().ok());
                        name.filter(|_| event.events().contains(ReadFlags::DELETE))
                            .inspect(|name| gone(name));
                    }
                }
            })
        };
        Ok(Watch { domain, limit, state, stop, tid: tid.recv()?, thread: Some(thread) })
    }

    /// Records a process's death: when `kill` returns it is dead, and its files are unlocked. Files that are removed by then count, too.
    pub fn dies(&self, pid: u32, kill: impl FnOnce() -> Result<()>) -> Result<()> {
        let now = || (Instant::now(), Delays::read(self.domain, self.tid));
        let own: Vec<PathBuf> = files(self.domain).filter(|path| owner(path) == Some(pid)).collect();
        let before = now();
        lock(&self.state).dead.extend(own.iter().map(|path| (path.clone(), before)));
        kill()?;
        let since = now();
        let mut state = lock(&self.state);
        for path in of_dead(self.domain, pid) {
            if own.contains(&path) {
                state.dead.insert(path, since);
            } else {
                state.dead.entry(path).or_insert(since);
            }
        }
        Ok(())
    }

    pub fn check(&self, patience: Duration) -> Result<()> {
        let mut state = lock(&self.state);
        let limit = self.limit;
        let mut hanging = Vec::new();
        state.dead.retain(|path, (since, _)| {
            if since.elapsed() <= limit {
                return true;
            }
            if !path.exists() {
                // The event of its removal is about to arrive.
                return since.elapsed() <= patience;
            }
            // Not a file that was taken for a dead process's while its owner created it.
            let stays = !is_of_living(path);
            if stays && since.elapsed() > patience {
                hanging.push(path.clone());
            }
            stays
        });
        if hanging.is_empty() {
            return Ok(());
        }
        Err(format!("files of dead processes stay: {hanging:?}").into())
    }

    pub fn is_clean(&self) -> bool {
        lock(&self.state).dead.is_empty()
    }

    /// Returns and resets the counts.
    pub fn take(&self) -> Stay {
        std::mem::take(&mut lock(&self.state).stay)
    }
}

impl State {
    fn gone(&mut self, path: &Path, limit: Duration, delays: impl FnOnce() -> Delays) {
        let Some((since, before)) = self.dead.remove(path) else { return };
        let stayed = since.elapsed();
        self.stay.files += 1;
        self.stay.worst = self.stay.worst.max(stayed);
        if stayed > limit {
            let had_core = stayed.saturating_sub(delays().since(&before));
            self.stay.late.extend((had_core > limit).then(|| (path.to_owned(), had_core)));
        }
    }
}

impl Drop for Watch {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}
