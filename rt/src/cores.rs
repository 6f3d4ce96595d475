// SPDX-License-Identifier: MIT OR Apache-2.0
//! Sets of cores, and binding threads to them.

use std::sync::OnceLock;
use std::{fmt, fs, io};

use rustix::thread::{CpuSet, Pid, sched_getaffinity, sched_setaffinity};

use crate::tid::pid;
use crate::{RtError, current_tid};

/// A set of cores: a fixed bit mask, plain data.
///
/// Building a set checks nothing. [`CoreSet::check`] and the functions that use the set check whether its
/// cores exist.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct CoreSet {
    bits: [u64; CoreSet::MAX / 64],
    /// The first core that does not fit into the mask, plus one: kept so that the error can name it.
    beyond: usize,
}

impl CoreSet {
    /// Cores 0..1024 can be named, as in the kernel's fixed-size mask.
    pub const MAX: usize = 1024;

    /// The empty set.
    pub const fn empty() -> CoreSet {
        CoreSet { bits: [0; Self::MAX / 64], beyond: 0 }
    }

    /// One core.
    pub const fn one(core: usize) -> CoreSet {
        CoreSet::empty().with(core)
    }

    /// This set and `core`.
    #[must_use = "it returns the changed set"]
    pub const fn with(mut self, core: usize) -> CoreSet {
        if core < Self::MAX {
            self.bits[core / 64] |= 1 << (core % 64);
        } else if self.beyond == 0 {
            self.beyond = core.saturating_add(1);
        }
        self
    }

    /// Parses a list in the kernel's format, `0-3,8`, or an empty text for no cores; `None` if it is not a
    /// list.
    pub fn parse(list: &str) -> Option<CoreSet> {
        let parts = list.trim().split(',').filter(|part| !part.is_empty());
        let ranges = parts.map(|part| {
            let (first, last) = part.split_once('-').unwrap_or((part, part));
            let (first, last) = (first.parse::<usize>().ok()?, last.parse::<usize>().ok()?);
            (first <= last).then(|| first..=last.min(first.max(Self::MAX)))
        });
        Some(ranges.collect::<Option<Vec<_>>>()?.into_iter().flatten().collect())
    }

    /// All cores to which this process may be bound: the online cores that its cpuset allows, independent of
    /// its present binding.
    ///
    /// # Errors
    /// [`RtError::Spawn`] or [`RtError::Kernel`] if the short-lived thread that queries the kernel fails.
    pub fn allowed() -> Result<CoreSet, RtError> {
        // The kernel reduces the requested cores to the cpuset: request all of them and read back.
        let probe = || {
            let online = online_cores()?;
            bind(None, online).map_err(|source| RtError::Kernel { what: "sched_setaffinity", source })?;
            current_affinity()
        };
        std::thread::scope(|scope| {
            let name = "core-probe".to_owned();
            let thread = std::thread::Builder::new().name(name.clone()).spawn_scoped(scope, probe);
            let thread = thread.map_err(|source| RtError::Spawn { name: name.clone(), source })?;
            thread.join().map_err(|_| RtError::Panicked { name, message: "probing cores".to_owned() })?
        })
    }

    /// Whether `core` is in the set.
    pub const fn contains(&self, core: usize) -> bool {
        core < Self::MAX && self.bits[core / 64] & (1 << (core % 64)) != 0
    }

    fn is_within(&self, other: &CoreSet) -> bool {
        self.bits.iter().zip(&other.bits).all(|(bits, others)| bits & !others == 0)
    }

    /// The number of cores in the set.
    pub fn len(&self) -> usize {
        self.bits.iter().map(|word| word.count_ones() as usize).sum()
    }

    /// Whether the set has no core.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The cores in ascending order.
    pub fn iter(&self) -> impl Iterator<Item = usize> + use<> {
        let set = *self;
        (0..Self::MAX).filter(move |core| set.contains(*core))
    }

    /// Checks whether a thread could be bound to this set: it is not empty, and each core is online.
    ///
    /// # Errors
    /// [`RtError::NoCores`] and [`RtError::UnknownCore`], which name the cores that exist.
    pub fn check(&self) -> Result<(), RtError> {
        /// The online cores at the first check. The kernel refuses cores that went offline since, when a thread is bound to them.
        static ONLINE: OnceLock<CoreSet> = OnceLock::new();
        if self.beyond == 0 && !self.is_empty() && ONLINE.get().is_some_and(|online| self.is_within(online)) {
            return Ok(());
        }
        let online = online_cores()?;
        ONLINE.get_or_init(|| online);
        if let Some(core) =
            self.beyond.checked_sub(1).or_else(|| self.iter().find(|core| !online.contains(*core)))
        {
            return Err(RtError::UnknownCore { core, online: online.to_string() });
        }
        if self.is_empty() { Err(RtError::NoCores { online: online.to_string() }) } else { Ok(()) }
    }
}

impl FromIterator<usize> for CoreSet {
    fn from_iter<I: IntoIterator<Item = usize>>(cores: I) -> CoreSet {
        cores.into_iter().fold(CoreSet::empty(), CoreSet::with)
    }
}

/// As the kernel writes lists of cores: `0-3,8`.
impl fmt::Display for CoreSet {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut separator = "";
        let mut core = 0;
        while core < Self::MAX {
            let first = core;
            while self.contains(core) {
                core += 1;
            }
            match core - first {
                0 => core += 1,
                1 => write!(f, "{separator}{first}")?,
                _ => write!(f, "{separator}{first}-{}", core - 1)?,
            }
            if self.contains(first) {
                separator = ",";
            }
        }
        if separator.is_empty() { f.write_str("none") } else { Ok(()) }
    }
}

impl fmt::Debug for CoreSet {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "CoreSet({self})")
    }
}

/// The cores that are online.
///
/// # Errors
/// [`RtError::Kernel`] if `/sys/devices/system/cpu/online` cannot be read.
pub fn online_cores() -> Result<CoreSet, RtError> {
    let text = fs::read_to_string("/sys/devices/system/cpu/online")
        .map_err(|source| RtError::Kernel { what: "reading /sys/devices/system/cpu/online", source })?;
    Ok(CoreSet::parse(&text).unwrap_or_default())
}

/// Binds the current thread to `cores` and reads the binding back.
///
/// # Errors
/// [`RtError::UnknownCore`] or [`RtError::CoreNotAllowed`], which name the cores to choose from;
/// [`RtError::CoresNotKept`] if the kernel then reports other cores.
pub fn set_affinity(cores: CoreSet) -> Result<(), RtError> {
    set_affinity_of(current_tid(), cores)
}

/// Binds thread `tid` to `cores` and reads the binding back.
///
/// # Errors
/// As [`set_affinity`]; [`RtError::NoSuchThread`] when the thread has ended.
pub fn set_affinity_of(tid: u32, cores: CoreSet) -> Result<(), RtError> {
    cores.check()?;
    let thread = pid(tid)?;
    if let Err(source) = bind(Some(thread), cores) {
        return Err(match source.raw_os_error() {
            Some(libc::EINVAL) => not_allowed(cores)?,
            // A SCHED_DEADLINE thread.
            Some(libc::EBUSY) => RtError::ReservationBound { cores: cores.to_string() },
            _ => RtError::of_thread("sched_setaffinity", tid, source),
        });
    }
    let reported = affinity_of(tid)?;
    if reported == cores {
        Ok(())
    } else if cores.iter().all(|core| reported.contains(core)) {
        Err(RtError::CoresNotKept { tid, asked: cores.to_string(), reported: reported.to_string() })
    } else {
        Err(not_allowed(cores)?)
    }
}

/// The cores the current thread may run on, as the kernel reports them.
///
/// # Errors
/// [`RtError::Kernel`] if the kernel does not answer.
pub fn current_affinity() -> Result<CoreSet, RtError> {
    affinity_of(current_tid())
}

/// The cores thread `tid` may run on, as the kernel reports them.
///
/// # Errors
/// [`RtError::NoSuchThread`] when the thread has ended.
pub fn affinity_of(tid: u32) -> Result<CoreSet, RtError> {
    let mask = sched_getaffinity(Some(pid(tid)?))
        .map_err(|errno| RtError::of_thread("sched_getaffinity", tid, errno.into()))?;
    let cores = (0..CpuSet::MAX_CPU).filter(|core| mask.is_set(*core));
    Ok(cores.take(mask.count() as usize).collect())
}

fn bind(thread: Option<Pid>, cores: CoreSet) -> io::Result<()> {
    let mut mask = CpuSet::new();
    cores.iter().for_each(|core| mask.set(core));
    Ok(sched_setaffinity(thread, &mask)?)
}

fn not_allowed(asked: CoreSet) -> Result<RtError, RtError> {
    Ok(RtError::CoreNotAllowed { asked: asked.to_string(), allowed: CoreSet::allowed()?.to_string() })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sets_print_as_the_kernel_writes_them() {
        for (cores, text) in [
            (&[][..], "none"),
            (&[0], "0"),
            (&[0, 1, 2, 3, 8], "0-3,8"),
            (&[63, 64, 200, 1023], "63-64,200,1023"),
        ] {
            let set: CoreSet = cores.iter().copied().collect();
            assert_eq!(set.to_string(), text);
            assert_eq!(set.iter().collect::<Vec<_>>(), cores);
            assert_eq!(set.len(), cores.len());
        }
    }

    #[test]
    fn lists_of_the_kernel_are_read() {
        for list in ["0-3,8,10-11\n", "5", "1023"] {
            assert_eq!(CoreSet::parse(list).unwrap().to_string(), list.trim());
        }
        assert!(CoreSet::parse("\n").unwrap().is_empty());
        for beyond in ["0-99999", "99999"] {
            assert!(CoreSet::parse(beyond).unwrap().check().is_err(), "{beyond}");
        }
        for wrong in ["garbage", "1-", "3-1", "a-b", "0;3"] {
            assert_eq!(CoreSet::parse(wrong), None, "{wrong}");
        }
    }

    #[test]
    fn an_unknown_core_is_named_with_those_that_exist() {
        let online = online_cores().unwrap();
        for core in [1023, 1024, 70_000, usize::MAX - 1] {
            if online.contains(core) {
                continue;
            }
            let message = set_affinity(CoreSet::one(core)).unwrap_err().to_string();
            assert_eq!(message, format!("core {core} does not exist here: choose from {online}"));
        }
        assert!(matches!(set_affinity(CoreSet::empty()), Err(RtError::NoCores { .. })));
    }
}
