// SPDX-License-Identifier: MIT OR Apache-2.0
//! Compares predictions with measurements: which assumptions of the analysis held.
use std::borrow::Borrow;
use std::collections::BTreeSet;

use tautline::{HistogramSnapshot, Policy};
use tautline_analysis::file::{CheckedCallback, CheckedChain, CheckedSystem, Client, Executor, SystemFile};

use super::explain::{self, Mark};
use super::host::{Host, Share};
use super::run::{Callback, Process, Run};

/// What a report says of the assumptions and bounds of the analysis; its number is the exit code.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Verdict {
    Kept = 0,
    Violated = 1,
    /// No job has ended.
    Nothing = 2,
}

/// The text of [`Verdict::Nothing`].
pub const NOTHING: &str = "Nothing to compare: no job of a callback of the file was measured";

impl Verdict {
    pub fn of(kept: bool) -> Self {
        if kept { Verdict::Kept } else { Verdict::Violated }
    }
}

pub struct Comparison {
    pub verdict: Verdict,
    /// Whether all processes have real-time policies; without them no bound applies.
    pub realtime: bool,
    /// The callbacks of the hosts that run, in the order of the file.
    pub rows: Vec<Row>,
    /// The chains whose latency the callbacks' responses bound, in the order of the file.
    pub chains: Vec<ChainRow>,
    pub processes: Vec<Running>,
    /// Callbacks that run, but are not in the file.
    pub unknown: Vec<Unknown>,
    pub notes: Vec<String>,
}

pub struct Row {
    pub predicted: CheckedCallback,
    /// The measurement; `None` if the callback does not run.
    pub measured: Option<Measured>,
    pub marks: Vec<Mark>,
}

pub struct Measured {
    pub process: String,
    pub callback: Callback,
    pub response: HistogramSnapshot,
    pub execution: HistogramSnapshot,
    /// Jobs later than the file's deadline.
    pub misses: u64,
    /// The longest response, including earlier and other processes.
    pub longest_ns: Option<u64>,
    /// The effect of the host; `None` if no process accounts for core time.
    pub share: Option<Share>,
}

/// A chain whose callbacks trigger one another and have all run. No message took longer than the sum of their longest responses.
pub struct ChainRow {
    pub predicted: CheckedChain,
    pub callbacks: Vec<String>,
    /// The sum of the callbacks' longest responses.
    pub longest_ns: u64,
    /// The sum of the callbacks' bounds including the time that the host took; `None` if no process accounts for core time.
    pub host_ns: Option<u64>,
}

pub struct Running {
    pub label: String,
    pub host: String,
    pub running: bool,
    pub forced: Option<String>,
    pub mark: Option<Mark>,
}

/// A callback that the file lacks.
pub struct Unknown {
    pub name: String,
    pub process: String,
    pub callback: Callback,
    /// Its real-time priority is not part of the analysis.
    pub mark: Option<Mark>,
}

impl Comparison {
    pub fn new(file: &SystemFile, checked: &CheckedSystem, run: &Run) -> Comparison {
        let hosts: BTreeSet<&str> = run.processes.iter().map(|process| process.host.as_str()).collect();
        let (here, elsewhere): (Vec<_>, Vec<_>) =
            checked.callbacks.iter().partition(|callback| hosts.contains(callback.host.as_str()));
        // An RMW records takes, waits and publications, but no timers.
        let (unseen, seen): (Vec<_>, Vec<_>) = here.iter().partition(|callback| {
            is_timer_of_ros(callback)
                && !callbacks(run, &callback.host).any(|(_, of)| of.name == callback.entry.name)
        });
        let host = Host::new(checked, run);
        let rows: Vec<Row> = seen.into_iter().map(|predicted| row(predicted, run, &host)).collect();
        let chains: Vec<_> = checked.chains.iter().filter_map(|of| chain(of, checked, &rows)).collect();
        let mut unknown = unknown(&here, run);
        let mut notes = notes(file, checked, run, &rows, &host);
        let mut fold = |why: &str, is_folded: fn(&Unknown) -> bool| {
            let names: Vec<_> = unknown.extract_if(.., |one| is_folded(one)).map(|one| one.name).collect();
            notes.extend(note_of(&names, &format!("not in the file, {why}: {{}}")));
        };
        fold("and not run yet", |one| {
            one.callback.response.max_ns().is_none() && one.callback.unfinished_ns.is_none()
        });
        fold("as every node of ROS has it", |one| one.name.ends_with(" /parameter_events"));
        let played: BTreeSet<_> = rows
            .iter()
            .filter(|row| row.measured.is_none())
            .filter_map(|row| Some((&row.predicted.entry.node, stand_in(&row.predicted, run)?.label())))
            .collect();
        for (node, process) in played {
            notes.push(format!(
                "{node} is played from a bag by {process}: the others' bounds are looked at, with its input; its own callbacks are not"
            ));
        }
        let unseen: Vec<&str> = unseen.iter().map(|callback| &*callback.entry.name).collect();
        notes.extend(note_of(
            &unseen,
            "timers of ROS's client libraries are seen only if they alone publish the first of their `publishes` in their node, not: {}",
        ));
        notes.extend(
            rows.iter()
                .filter_map(|row| explain::published(&row.predicted, &row.measured.as_ref()?.callback)),
        );
        let other_hosts: BTreeSet<&str> = elsewhere.iter().map(|callback| callback.host.as_str()).collect();
        notes.extend(note_of(
            &other_hosts.into_iter().collect::<Vec<_>>(),
            "callbacks of {} are not looked at: only this host's processes are seen",
        ));
        let others = checked.chains.iter().filter(|chain| chain.stages.is_none());
        let others: Vec<&str> = others.map(|chain| &*chain.name).collect();
        notes.extend(note_of(
            &others,
            "chains of which a callback reads at its own pace, waits for several topics or is on another host are not looked at: {}; `taut trace` \
             measures them",
        ));
        let processes = run.processes.iter().map(|process| Running {
            label: process.label(),
            host: process.host.clone(),
            running: process.running,
            forced: process.forced.clone(),
            mark: sampler_too_low(process),
        });
        let realtime = run.processes.iter().all(|process| process.realtime);
        let mut comparison = Comparison {
            verdict: Verdict::Nothing,
            realtime,
            rows,
            chains,
            processes: processes.collect(),
            unknown,
            notes,
        };
        let is_kept = comparison.marks().next().is_none();
        if !is_kept || comparison.jobs() > 0 {
            comparison.verdict = Verdict::of(is_kept);
        }
        comparison
    }

    /// Jobs that have ended, of all callbacks of the file.
    pub fn jobs(&self) -> u64 {
        self.rows.iter().filter_map(|row| Some(row.measured.as_ref()?.callback.completions)).sum()
    }

    /// All violations with their callbacks and processes.
    pub fn marks(&self) -> impl Iterator<Item = (&str, &Mark)> {
        let processes =
            self.processes.iter().filter_map(|process| Some((&*process.label, process.mark.as_ref()?)));
        let rows =
            self.rows.iter().flat_map(|row| row.marks.iter().map(|mark| (&*row.predicted.entry.name, mark)));
        let unknown =
            self.unknown.iter().filter_map(|unknown| Some((&*unknown.name, unknown.mark.as_ref()?)));
        processes.chain(rows).chain(unknown)
    }
}

fn is_timer_of_ros(callback: &CheckedCallback) -> bool {
    callback.entry.client != Client::Tautline && callback.entry.topics.is_empty()
}

fn sampler_too_low(process: &Process) -> Option<Mark> {
    // A reservation is above this priority for its runtime.
    let below = |callback: &&Callback| callback.priority < Some(Policy::RESERVATION);
    let highest = process.callbacks.iter().filter(below).max_by_key(|callback| callback.priority)?;
    let (sampler, callback) = (process.sampler_priority?, highest.priority?);
    (process.realtime && sampler <= callback)
        .then(|| explain::sampler_too_low(sampler, &highest.name, callback))
}

/// All callbacks of a host's processes, except the sums over groups.
fn callbacks<'r>(run: &'r Run, host: &'r str) -> impl Iterator<Item = (&'r Process, &'r Callback)> {
    run.processes
        .iter()
        .filter(move |process| process.host == host)
        .flat_map(|process| process.callbacks.iter().map(move |callback| (process, callback)))
        .filter(|(_, callback)| !callback.is_group)
}

fn row(predicted: &CheckedCallback, run: &Run, host: &Host) -> Row {
    let name = &predicted.entry.name;
    let mut found: Vec<_> =
        callbacks(run, &predicted.host).filter(|(_, callback)| callback.name == *name).collect();
    // The running one, else the ended one with the latest release.
    found.sort_by_key(|(_, callback)| (callback.ended, std::cmp::Reverse(callback.last_release_ns)));
    let mut marks = Vec::new();
    let Some(&(process, callback)) = found.first() else {
        if stand_in(predicted, run).is_none() {
            marks.push(explain::not_running(predicted, run));
        }
        return Row { predicted: predicted.clone(), measured: None, marks };
    };
    let running: Vec<_> = found.iter().filter(|(_, callback)| !callback.ended).collect();
    if let [(first, _), (second, _), ..] = running.as_slice() {
        marks.push(explain::runs_twice(name, first, second));
    } else if running.is_empty() && process.running {
        marks.push(explain::ended(predicted, process, callback));
    }
    let (misses, share) = (misses(predicted, callback), host.share(predicted, callback));
    marks.extend(violations(predicted, process, callback, misses, share.as_ref()));
    // Measurements of earlier or other processes count as well.
    for (process, callback) in found.iter().skip(1) {
        let (misses, share) = (self::misses(predicted, callback), host.share(predicted, callback));
        let theirs = violations(predicted, process, callback, misses, share.as_ref());
        marks.extend(theirs.into_iter().map(|mark| explain::of_another(process, mark)));
    }
    let measured = Measured {
        process: process.label(),
        response: callback.response.histogram(),
        execution: callback.execution.histogram(),
        misses,
        longest_ns: found.iter().filter_map(|(_, callback)| callback.longest_response_ns()).max(),
        share,
        callback: callback.clone(),
    };
    Row { predicted: predicted.clone(), measured: Some(measured), marks }
}

fn chain(predicted: &CheckedChain, checked: &CheckedSystem, rows: &[Row]) -> Option<ChainRow> {
    let measured = |stage: &usize| {
        let name = &checked.callbacks.get(*stage)?.entry.name;
        rows.iter().find(|row| row.predicted.entry.name == *name)?.measured.as_ref()
    };
    let stages: Vec<&Measured> =
        predicted.stages.as_ref()?.iter().map(measured).collect::<Option<Vec<_>>>()?;
    let together = |times: &dyn Fn(&Measured) -> Option<u64>| {
        stages.iter().try_fold(0u64, |sum, stage| Some(sum.saturating_add(times(stage)?)))
    };
    Some(ChainRow {
        predicted: predicted.clone(),
        callbacks: stages.iter().map(|stage| stage.callback.name.clone()).collect(),
        longest_ns: together(&|stage| stage.longest_ns)?,
        host_ns: together(&|stage| stage.share.as_ref()?.bound_ns),
    })
}

/// The process that plays a node's topics from a bag.
fn stand_in<'r>(predicted: &CheckedCallback, run: &'r Run) -> Option<&'r Process> {
    let is_it = |process: &&Process| {
        process.running && process.host == predicted.host && process.stands_in == predicted.entry.node
    };
    run.processes.iter().find(is_it)
}

/// Jobs later than the file's deadline, including one that has not ended. The histogram counts jobs in the bucket of the deadline as on
/// time; the longest job is known exactly.
fn misses(predicted: &CheckedCallback, callback: &Callback) -> u64 {
    let deadline_ns = predicted.entry.deadline_ns;
    let is_past = |time_ns: Option<u64>| u64::from(time_ns.is_some_and(|time_ns| time_ns > deadline_ns));
    let ended = match callback.deadline_ns {
        Some(counted) if counted == deadline_ns => callback.deadline_misses,
        _ => callback.response.longer_than(deadline_ns).max(is_past(callback.response.max_ns())),
    };
    ended + is_past(callback.unfinished_ns)
}

fn violations(
    predicted: &CheckedCallback,
    process: &Process,
    seen: &Callback,
    misses: u64,
    share: Option<&Share>,
) -> Vec<Mark> {
    let mut marks = Vec::new();
    // A thread without a number is just starting; its policy is not known yet.
    if process.realtime && seen.tid != 0 {
        let wanted = predicted.entry.reservation;
        let wanted = wanted.map(|of| Policy::Deadline { runtime_ns: of.runtime_ns, period_ns: of.period_ns });
        // Reservations are known only of live threads.
        let other = seen.reservation.is_some_and(|policy| Some(policy) != wanted);
        if seen.priority != Some(predicted.entry.priority) || other {
            marks.push(explain::wrong_priority(predicted, seen));
        }
        if !predicted.entry.floats && seen.core != Some(predicted.core) {
            marks.push(explain::wrong_core(predicted, seen));
        }
    }
    if let (Some(most), Some(greatest)) = (predicted.entry.input_max, seen.greatest_input())
        && greatest > most
    {
        marks.push(explain::input_too_large(seen, greatest, most));
    }
    if let Some(used_ns) = seen.execution.max_ns().filter(|used| *used > predicted.charged_ns) {
        let times = match seen.budget_ns {
            Some(budget_ns) if budget_ns == predicted.charged_ns => seen.overruns,
            _ => seen.execution.longer_than(predicted.charged_ns),
        };
        marks.push(explain::wcet_exceeded(predicted, seen, used_ns, times.max(1)));
    }
    // A publication follows its release by at most a response time.
    let late_ns = match seen.is_by_publications {
        true => predicted.response_overhead_ns.unwrap_or(u64::MAX),
        false => 0,
    };
    let least_ns = least_distance(predicted).saturating_sub(late_ns);
    if let Some(distance_ns) = seen.least_distance_ns.filter(|distance| *distance < least_ns) {
        marks.push(explain::period_not_kept(predicted, distance_ns, least_ns));
    } else if let Some(window_ns) = seen.last_release_ns.checked_sub(seen.first_release_ns) {
        let most = predicted.releases.iter().fold(0u64, |sum, release| {
            sum.saturating_add(release.most_within(window_ns.saturating_add(late_ns).saturating_add(1)))
        });
        // Other executors' distances are counted from the second release on.
        let first = u64::from(predicted.entry.client != Client::Tautline);
        if seen.releases > most.saturating_add(first) {
            marks.push(explain::rate_not_kept(predicted, seen.releases, most, window_ns));
        }
    }
    // A distance between publications implies a response of at least its excess over period and jitter, unless a release was missed.
    let beyond_period = seen.greatest_distance_ns.filter(|_| seen.is_by_publications && seen.lost == 0);
    let jitter_ns = predicted.releases.iter().map(|release| release.jitter_ns()).max().unwrap_or(0);
    let beyond_period = beyond_period
        .map(|distance_ns| distance_ns.saturating_sub(predicted.period_ns).saturating_sub(jitter_ns));
    let longest_ns = seen.longest_response_ns().or(beyond_period);
    if let (Some(longest_ns), Some(bound_ns)) = (longest_ns, predicted.response_overhead_ns)
        && longest_ns > bound_ns
        && !is_explained(seen, share)
    {
        marks.push(explain::bound_exceeded(
            predicted,
            process,
            seen,
            longest_ns,
            bound_ns,
            share,
            !marks.is_empty(),
        ));
    }
    if let Some(capacity) = predicted.capacity
        && seen.max_queue > capacity as u64
    {
        marks.push(explain::queue_over_capacity(predicted, seen.max_queue, capacity));
    }
    if seen.lost > 0 {
        marks.push(explain::messages_lost(predicted, seen));
    }
    if misses > 0 {
        marks.push(explain::deadline_missed(predicted, misses, longest_ns.unwrap_or(0)));
    }
    marks
}

/// Whether the host explains every response above the bound. A wait is no such explanation, because it may have been for another thread.
fn is_explained(seen: &Callback, share: Option<&Share>) -> bool {
    let is_running = seen.unfinished_ns > seen.response.max_ns();
    let by_host = |share: &Share| share.beyond > 0 && share.waited + share.unexplained == 0 && share.complete;
    !is_running && share.is_some_and(by_host)
}

/// The shortest time that the analysis assumes between two releases; several streams may coincide.
pub fn least_distance(predicted: &CheckedCallback) -> u64 {
    match predicted.releases.as_slice() {
        [only] => only.shortest_span(1),
        _ => 0,
    }
}

fn unknown(here: &[&CheckedCallback], run: &Run) -> Vec<Unknown> {
    let mut unknown = Vec::new();
    for process in &run.processes {
        let known = |name: &str| {
            here.iter().any(|callback| callback.entry.name == name && callback.host == process.host)
        };
        // All callbacks of a process end with it; in a running process only running callbacks count.
        let gone = |callback: &Callback| callback.tid == 0 || (callback.ended && process.running);
        let stray = |callback: &&Callback| !callback.is_group && !gone(callback) && !known(&callback.name);
        for callback in process.callbacks.iter().filter(stray) {
            unknown.push(Unknown {
                name: callback.name.clone(),
                process: process.label(),
                mark: callback.priority.map(|priority| explain::not_in_the_file(process, callback, priority)),
                callback: callback.clone(),
            });
        }
    }
    unknown
}

fn notes(file: &SystemFile, checked: &CheckedSystem, run: &Run, rows: &[Row], host: &Host) -> Vec<String> {
    let mut notes = Vec::new();
    let labels = |which: &dyn Fn(&Process) -> bool| -> Vec<String> {
        run.processes.iter().filter(|process| which(process)).map(Process::label).collect()
    };
    notes.extend(note_of(
        &labels(&|process| !process.realtime),
        "{} runs without real-time priorities: no bound applies to it; start it with the right to them, and without TAUT_REALTIME=off",
    ));
    for process in &run.processes {
        if let Some(why) = &process.forced {
            notes.push(format!("{} was admitted by force: {why}", process.label()));
        }
    }
    notes.extend(note_of(
        &labels(&|process| process.system_hash != file.fingerprint()),
        "{} was started with another text of the system file: its priorities and depths may be others; restart it",
    ));
    notes.extend(host.notes());
    for row in rows {
        let Some(measured) = &row.measured else { continue };
        let Some(share) = measured.share.as_ref().filter(|share| share.beyond > 0) else { continue };
        if is_explained(&measured.callback, Some(share)) {
            notes.push(explain::host_took(&row.predicted, share));
        }
    }
    let steal_ticks = run.processes.iter().map(|process| process.steal_ticks).max().unwrap_or(0);
    if steal_ticks > 0 {
        let more = match host.is_known() {
            true => "the lines above contain what callbacks measured of it",
            false => {
                "outliers of about 10 ms go with that, and no analysis knows of them; with TAUT_CORE_TIME=on in the processes' \
                 environment it is known which"
            }
        };
        notes.push(format!(
            "steal: the hypervisor gave {} ms of processor time to others since the first process started; {more}",
            steal_ticks.saturating_mul(10)
        ));
    }
    if !checked.schedulable {
        notes.push(
            "by analysis this system may miss deadlines, whatever was measured: see `taut check`".into(),
        );
    }
    let names = |which: &dyn Fn(&Row) -> bool| -> Vec<String> {
        rows.iter().filter(|row| which(row)).map(|row| row.predicted.entry.name.clone()).collect()
    };
    let is_idle = |row: &Row| row.measured.as_ref().is_some_and(|seen| seen.callback.completions == 0);
    let is_unseen = |row: &Row| row.predicted.entry.executor == Executor::Events;
    let idle = names(&|row| is_idle(row) && !is_unseen(row));
    notes.extend(note_of(&idle, "no job has ended yet of {}: nothing is known of it"));
    notes.extend(note_of(
        &names(&|row| is_idle(row) && is_unseen(row)),
        "nothing is measured of {}: an EventsExecutor does not wait in the RMW, which sees no end of its callbacks; measure in another executor",
    ));
    let unmeasured = names(&|row| {
        let is_it = |seen: &Measured| !seen.callback.measures_execution && !seen.callback.is_by_publications;
        row.measured.as_ref().is_some_and(is_it)
    });
    notes.extend(note_of(
        &unmeasured,
        "execution times are not measured of {}: its wcet is not verified; drop `.execution_time(false)`",
    ));
    notes
}

/// The note with these names in place of its braces; `None` without a name.
fn note_of(names: &[impl Borrow<str>], note: &str) -> Option<String> {
    (!names.is_empty()).then(|| note.replacen("{}", &names.join(", "), 1))
}
