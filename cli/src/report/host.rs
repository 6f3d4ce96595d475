// SPDX-License-Identifier: MIT OR Apache-2.0
//! Explains responses above their bounds: by time that the host took from the cores, by jobs that used more than their wcet, and by
//! waits for the core that the analysis does not contain.
use std::collections::{BTreeMap, BTreeSet};

use tautline_analysis::file::{CheckedCallback, CheckedSystem};
use tautline_analysis::taken::{Seen, Sight, Taken, TakenTimes, response_time_with};

use super::run::{Callback, Process, Run};
use crate::moment::{ACCOUNTED_TO_NS, Kind, Moment};
use crate::times::ms;

/// The time that was taken from each core on which a process accounts for it.
pub struct Host<'c> {
    checked: &'c CheckedSystem,
    /// The cores, by host and number.
    cores: BTreeMap<(String, usize), CoreTimes>,
}

#[derive(Default)]
struct CoreTimes {
    host: TakenTimes,
    overran: TakenTimes,
    known: TakenTimes,
    /// All recorded intervals, including waits longer than in the analysis.
    seen: Vec<Sight>,
}

/// The effect of the host on a callback.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Share {
    /// The bound plus the most that the host took in any window of this length; `None` without a bound.
    pub bound_ns: Option<u64>,
    /// Responses above the bound whose times are known.
    pub beyond: u64,
    /// Those that are explained only together with waits, in which no callback of the file can have had the core.
    pub waited: u64,
    /// Those without an explanation.
    pub unexplained: u64,
    /// The longest one; unexplained ones first, then those that waited.
    pub longest: Option<Longest>,
    /// Whether these include the longest measured response, and none was overwritten.
    pub complete: bool,
}

/// A response, and the time that was taken while it lasted and in the period before.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Longest {
    pub response_ns: u64,
    /// Time that the host took.
    pub taken_ns: u64,
    /// Time that jobs used beyond their wcet.
    pub overran_ns: u64,
    /// The time that threads waited for the core, less the time that other callbacks may have had it.
    pub waited_ns: u64,
}

impl<'c> Host<'c> {
    pub fn new(checked: &'c CheckedSystem, run: &Run) -> Host<'c> {
        let mut cores: BTreeMap<(String, usize), CoreTimes> = BTreeMap::new();
        for process in &run.processes {
            let is_served = is_served_first(process, run);
            let mut note = |core, sights: &mut dyn Iterator<Item = Sight>| {
                cores.entry((process.host.clone(), core)).or_default().seen.extend(sights);
            };
            for callback in process.callbacks.iter().filter(|callback| callback.accounts_core_time) {
                if let Some(core) = callback.core {
                    let others_ns = waits_at_most(checked, &process.host, &callback.name);
                    let beyond = |taken: Taken| match taken.seen {
                        Seen::Waited => {
                            Taken { length_ns: taken.length_ns.saturating_sub(others_ns), ..taken }
                        }
                        _ => taken,
                    };
                    let thread = thread_of(process, callback.tid);
                    let priority = running_priority(checked, &process.host, callback);
                    let sight = |taken| Sight { taken: beyond(taken), thread, priority };
                    // A demoted or suspended job took nothing from others, and its wait was its own.
                    let counts = |of: &&Moment| {
                        callback.demotions == 0 || !matches!(of.kind, Kind::Overran | Kind::Waited)
                    };
                    note(
                        core,
                        &mut callback.moments.iter().filter(counts).filter_map(Moment::taken).map(sight),
                    );
                }
            }
            let Some(sampler) = &process.sampler else { continue };
            // The sampler's core, and the cores of the callbacks that it wakes.
            let woken = process.callbacks.iter().filter_map(|callback| callback.core);
            for core in woken.chain(sampler.core).collect::<BTreeSet<_>>() {
                // On another core the threads there may have recorded this time, too.
                let as_seen = |taken: Taken| match taken.seen {
                    Seen::Running if sampler.core != Some(core) => Taken { seen: Seen::WokenLate, ..taken },
                    _ => taken,
                };
                let counts = |of: &&Moment| match of.kind {
                    // The sampler waits for no callback of the file.
                    Kind::WokenLate | Kind::Waited => is_served,
                    // The file's overheads contain this time.
                    Kind::Served => false,
                    _ => true,
                };
                // The sampler has number 0, which no callback uses.
                let (thread, priority) = (thread_of(process, 0), process.sampler_priority);
                let sight = |taken| Sight { taken: as_seen(taken), thread, priority };
                note(core, &mut sampler.moments.iter().filter(counts).filter_map(Moment::taken).map(sight));
            }
        }
        for times in cores.values_mut() {
            let known = times.seen.iter().map(|sight| sight.taken).filter(|taken| taken.seen != Seen::Waited);
            times.known = TakenTimes::new(known);
            times.host = times.known.seen(&[Seen::Running, Seen::WokenLate]);
            times.overran = times.known.seen(&[Seen::Overran]);
        }
        Host { checked, cores }
    }

    /// Whether any process accounts for core time.
    pub fn is_known(&self) -> bool {
        !self.cores.is_empty()
    }

    /// The effect on a callback; `None` if no process accounts for its core.
    pub fn share(&self, predicted: &CheckedCallback, seen: &Callback) -> Option<Share> {
        let taken = self.cores.get(&(predicted.host.clone(), predicted.core))?;
        let bound_ns = self.bound_ns(predicted, |window_ns| taken.host.most_within(window_ns));
        let mut share =
            Share { bound_ns, beyond: 0, waited: 0, unexplained: 0, longest: None, complete: false };
        let predicted_ns = predicted.response_overhead_ns?;
        let is_beyond = |moment: &&Moment| moment.kind == Kind::Late && moment.length_ns > predicted_ns;
        let mut longest = (false, false, 0);
        let mut with_waits = None;
        // In a thread that lowers itself it may wait for others above the lowest priority.
        let entry = &predicted.entry;
        let priority =
            if entry.lowest_priority < entry.priority { Some(entry.lowest_priority) } else { seen.priority };
        for late in seen.moments.iter().filter(is_beyond) {
            let is_explained_by = |times: &TakenTimes| {
                let allowed_ns = self.bound_ns(predicted, |window_ns| times.before(late.to_ns, window_ns));
                allowed_ns.is_some_and(|ns| late.length_ns <= ns.saturating_add(ACCOUNTED_TO_NS))
            };
            let waited = !is_explained_by(&taken.known);
            let all = match waited {
                true => with_waits.get_or_insert_with(|| TakenTimes::with_waits(&taken.seen, priority)),
                false => &taken.known,
            };
            let unexplained = waited && !is_explained_by(all);
            share.beyond += 1;
            share.waited += u64::from(waited && !unexplained);
            share.unexplained += u64::from(unexplained);
            share.complete |= Some(late.length_ns) == seen.response.max_ns();
            if (unexplained, waited, late.length_ns) > longest {
                longest = (unexplained, waited, late.length_ns);
                // Time that was taken before the release may also have delayed the job.
                let window_ns = late.length_ns.saturating_add(predicted.period_ns);
                let before = |ways: &[Seen]| all.seen(ways).before(late.to_ns, window_ns);
                share.longest = Some(Longest {
                    response_ns: late.length_ns,
                    taken_ns: before(&[Seen::Running, Seen::WokenLate]),
                    overran_ns: before(&[Seen::Overran]),
                    waited_ns: before(&[Seen::Waited]),
                });
            }
        }
        share.complete &= seen.older_moments == 0;
        Some(share)
    }

    /// The bound if a window of the core loses at most this time.
    fn bound_ns(&self, predicted: &CheckedCallback, taken_within: impl Fn(u64) -> u64) -> Option<u64> {
        let of_core = |core: &&tautline_analysis::file::CheckedCore| {
            core.host == predicted.host && core.number == predicted.core
        };
        let core = self.checked.cores.iter().find(of_core)?;
        let name = &predicted.entry.name;
        // A callback with several streams is a task for each.
        let is_of_it = |task: &str| {
            task.strip_prefix(name.as_str()).is_some_and(|rest| rest.is_empty() || rest.starts_with(" ("))
        };
        let mut more_ns = 0;
        for (index, _) in core.tasks.iter().enumerate().filter(|(_, task)| is_of_it(&task.name)) {
            let response_ns = |taken_within: &dyn Fn(u64) -> u64| {
                let response = response_time_with(&core.tasks, &core.overheads, index, taken_within);
                Some(response.ok()?.response_ns)
            };
            more_ns = more_ns.max(response_ns(&taken_within)?.saturating_sub(response_ns(&|_| 0)?));
        }
        Some(predicted.response_overhead_ns?.saturating_add(more_ns))
    }

    pub fn notes(&self) -> Vec<String> {
        let line = |((host, core), times): (&(String, usize), &CoreTimes)| {
            let taken = &times.host;
            format!(
                "the host took {:.2} ms of core {core} of `{host}` while callbacks ran and {:.2} ms before timers were served, at most \
                 {:.2} ms at once",
                ms(taken.seen(&[Seen::Running]).total_ns()),
                ms(taken.seen(&[Seen::WokenLate]).total_ns()),
                ms(taken.longest_ns())
            )
        };
        self.cores.iter().filter(|(_, times)| !times.host.pieces().is_empty()).map(line).collect()
    }
}

/// A distinct number for each thread of a host.
fn thread_of(process: &Process, tid: u32) -> u64 {
    u64::from(process.pid) << 32 | u64::from(tid)
}

/// The priority at which a callback runs, which is below that of its waiting thread if the file says so.
fn running_priority(checked: &CheckedSystem, host: &str, seen: &Callback) -> Option<u8> {
    let is_it = |of: &&CheckedCallback| of.host == host && of.entry.name == seen.name;
    let entry = checked.callbacks.iter().find(is_it).map(|of| &of.entry);
    entry.filter(|of| Some(of.priority) == seen.priority).map(|of| of.running_priority()).or(seen.priority)
}

/// How long a job may wait for the core according to the analysis; `u64::MAX` if it has no bound, or is not in the file.
fn waits_at_most(checked: &CheckedSystem, host: &str, callback: &str) -> u64 {
    let is_it = |of: &&CheckedCallback| of.host == host && of.entry.name == callback;
    let bound_ns = |of: &CheckedCallback| Some(of.response_overhead_ns?.saturating_sub(of.charged_ns));
    checked.callbacks.iter().find(is_it).and_then(bound_ns).unwrap_or(u64::MAX)
}

/// Whether no thread of the domain can delay a process's timers. Otherwise late timers need not be due to the host.
fn is_served_first(process: &Process, run: &Run) -> bool {
    let others = run.processes.iter().filter(|other| other.host == process.host);
    let highest = others.flat_map(|other| &other.callbacks).filter_map(|callback| callback.priority).max();
    process.realtime && process.sampler_priority > highest
}
