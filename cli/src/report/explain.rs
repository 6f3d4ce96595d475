// SPDX-License-Identifier: MIT OR Apache-2.0
//! The text of each violated assumption: its name, the measurement, the fix.
use std::fmt;

use tautline::Policy;
use tautline_analysis::file::{CheckedCallback, Client, OverrunPolicy};

use super::host::{Longest, Share};
use super::run::{Callback, Process, Run};
use crate::table::times;

/// Names of violations that `--wcet` reports, too.
pub const INPUT_TOO_LARGE: &str = "input too large";
pub const WCET_EXCEEDED: &str = "wcet exceeded";

/// A violated assumption.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Mark {
    pub name: &'static str,
    /// The measurement and the fix.
    pub explanation: String,
}

/// A time as the system file writes it, to the microsecond or closer.
struct Time(u64);

impl fmt::Display for Time {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (value, unit) = match self.0 {
            ns @ 0..1_000 => (ns as f64, "ns"),
            ns @ 1_000..1_000_000 => (ns as f64 / 1e3, "us"),
            ns @ 1_000_000..10_000_000_000 => (ns as f64 / 1e6, "ms"),
            ns => (ns as f64 / 1e9, "s"),
        };
        let text = format!("{value:.3}");
        write!(f, "{} {unit}", text.trim_end_matches('0').trim_end_matches('.'))
    }
}

/// A time as a value for the file, rounded up to a microsecond.
pub fn quoted(ns: u64) -> String {
    format!("\"{}\"", Time(ns.div_ceil(1_000).saturating_mul(1_000))).replace(' ', "")
}

fn mark(name: &'static str, explanation: String) -> Mark {
    Mark { name, explanation }
}

/// How a callback gets what the file says of its thread; `of_ros` if a client library of ROS runs it.
fn how(predicted: &CheckedCallback, of_ros: impl FnOnce() -> String) -> String {
    match predicted.entry.client {
        Client::Tautline => format!("spawn it with `context.callback(\"{}\")`", predicted.entry.name),
        Client::Rclcpp | Client::Rclpy => of_ros(),
    }
}

pub fn not_running(predicted: &CheckedCallback, run: &Run) -> Mark {
    let node = &predicted.entry.node;
    let how = how(predicted, || {
        let (what, topics) = match &predicted.entry.topics[..] {
            [] => ("publisher", predicted.entry.publishes.get(..1).unwrap_or_default()),
            topics => ("subscription", topics),
        };
        format!("with TAUT_SYSTEM set, and a {what} of {}", topics.join(", "))
    });
    let text = format!(
        "no process of domain {} on host {} has a callback of this name: start node `{node}`, {how}, or take it out of \
         the file",
        run.domain, predicted.host
    );
    mark("not running", text)
}

pub fn ended(predicted: &CheckedCallback, process: &Process, seen: &Callback) -> Mark {
    let (name, process) = (&predicted.entry.name, process.label());
    let text = match predicted.entry.client {
        Client::Tautline if predicted.entry.overrun == OverrunPolicy::End && seen.demotions > 0 => format!(
            "a job used more than its budget and ended it, as `overrun = \"end\"` says, in {process}, which continues without \
             `{name}`: raise its `wcet` and run `taut check`, or make it shorter, and start it again"
        ),
        Client::Tautline => format!(
            "its future has ended in {process}, which continues without `{name}`: it ended by itself, was stopped, or panicked"
        ),
        Client::Rclcpp | Client::Rclpy => {
            format!("its subscription was destroyed in {process}, which continues without `{name}`")
        }
    };
    mark("not running", text)
}

pub fn runs_twice(name: &str, first: &Process, second: &Process) -> Mark {
    let text = format!(
        "`{name}` runs in {} and in {}, and the analysis counts its load once: end one, or give it an entry of its own",
        first.label(),
        second.label()
    );
    mark("runs twice", text)
}

/// A mark of a callback of the same name that is not the one the table shows.
pub fn of_another(process: &Process, of: Mark) -> Mark {
    mark(of.name, format!("in {}: {}", process.label(), of.explanation))
}

/// The name of a thread's real-time priority.
pub fn level(priority: u8) -> String {
    if priority < Policy::RESERVATION {
        format!("priority {priority}")
    } else {
        "a reservation (SCHED_DEADLINE)".into()
    }
}

pub fn wrong_priority(predicted: &CheckedCallback, seen: &Callback) -> Mark {
    let has = match seen.reservation {
        Some(policy) => policy.to_string(),
        None => seen.priority.map_or("time sharing".into(), level),
    };
    let priority = predicted.entry.priority;
    let wanted = match predicted.entry.reservation {
        Some(of) => Policy::Deadline { runtime_ns: of.runtime_ns, period_ns: of.period_ns }.to_string(),
        None if predicted.entry.lowest_priority < priority => format!("{} while it waits", level(priority)),
        None => level(priority),
    };
    let of_ros =
        || format!("give SCHED_FIFO {priority} to the thread that spins its executor, before it does");
    let how = how(predicted, of_ros);
    let text = format!("its thread has {has}, the file gives it {wanted}: {how}, or change it in the file");
    mark("wrong priority", text)
}

pub fn wrong_core(predicted: &CheckedCallback, seen: &Callback) -> Mark {
    let has = seen.core.map_or("may run on several cores".into(), |core| format!("runs on core {core}"));
    let how = how(predicted, || "pin the thread that spins its executor, before it does".into());
    let text = format!(
        "its thread {has}, the file says core {}: {how}, or change `core` in the file",
        predicted.core
    );
    mark("wrong core", text)
}

pub fn input_too_large(seen: &Callback, greatest: u64, most: u64) -> Mark {
    // In the class that contains the limit it is unknown which jobs were above it.
    let above = seen
        .inputs
        .iter()
        .filter(|class| class.least > most)
        .fold(0u64, |sum, class| sum.saturating_add(class.jobs));
    let text = format!(
        "the input of a job had the size {greatest}, the file allows `input_max = {most}` (exceeded {} in {} jobs, at least): set \
         `input_max = {greatest}` or more, then `taut report --wcet --write` computes the `wcet` for it, and run `taut check`; or give \
         the callback less at once",
        times(above.max(1)),
        seen.completions
    );
    mark(INPUT_TOO_LARGE, text)
}

pub fn wcet_exceeded(predicted: &CheckedCallback, seen: &Callback, used_ns: u64, how_often: u64) -> Mark {
    let CheckedCallback { wcet_ns, charged_ns, .. } = *predicted;
    let overheads_ns = charged_ns - wcet_ns;
    let allowed = match overheads_ns {
        0 => format!("wcet {}", Time(wcet_ns)),
        _ => format!("wcet {} and {} of overheads", Time(wcet_ns), Time(overheads_ns)),
    };
    let lowered = match predicted.entry.overrun {
        OverrunPolicy::Suspend => "suspended until its next period",
        _ => "below all others, with what waited for it",
    };
    let demoted = match seen.demotions {
        0 => String::new(),
        demotions => format!("; {} {lowered}, so no other bound rests on it", times(demotions)),
    };
    let text = format!(
        "a job used {} of processor time, the file allows {allowed} (exceeded {} in {} jobs{demoted}): set `wcet = {}` or more \
         and run `taut check`, or make the callback shorter",
        Time(used_ns),
        times(how_often),
        seen.completions,
        quoted(used_ns.saturating_sub(overheads_ns)),
    );
    mark(WCET_EXCEEDED, text)
}

pub fn period_not_kept(predicted: &CheckedCallback, distance_ns: u64, least_ns: u64) -> Mark {
    let fix = match predicted.entry.topics.first() {
        // The whole jitter: that of the analysis and what is missing there.
        Some(topic) => {
            let jitter = quoted(predicted.period_ns.saturating_sub(distance_ns));
            format!(
                "make the publisher of `{topic}` keep its period, or state `jitter = {jitter}` or more, or a shorter period, \
                 of the topic or of what triggers its publisher"
            )
        }
        None => "it is a timer of another period than the file's: create it with the file's".into(),
    };
    let text = format!(
        "two releases were {} apart, the file allows no less than {}: {fix}, and run `taut check`",
        Time(distance_ns),
        Time(least_ns)
    );
    mark("period not kept", text)
}

pub fn rate_not_kept(predicted: &CheckedCallback, releases: u64, most: u64, window_ns: u64) -> Mark {
    let text = format!(
        "it was released {releases} times in {}, the file allows {most}: lower the rate of its {}, or state a shorter \
         period, and run `taut check`",
        Time(window_ns),
        if predicted.entry.topics.is_empty() { "timer" } else { "topics" }
    );
    mark("period not kept", text)
}

pub fn bound_exceeded(
    predicted: &CheckedCallback,
    process: &Process,
    seen: &Callback,
    longest_ns: u64,
    bound_ns: u64,
    share: Option<&Share>,
    explained: bool,
) -> Mark {
    let why = if !process.realtime {
        "its process runs without real-time priorities, where no bound holds".into()
    } else if explained {
        "the marks before this one may be why: mend them first".into()
    } else {
        format!(
            "if no callback of core {} has another mark, something ran there that the file lacks: interrupts, other \
             threads of {} or more, a lock, throttling, {}or [overheads] that are too small; \
             `taut demo` measures them{}",
            predicted.core,
            level(predicted.entry.lowest_priority),
            if share.is_some() { "" } else { "a hypervisor (TAUT_CORE_TIME=on shows it), " },
            if predicted.entry.client == Client::Tautline {
                ""
            } else {
                ", `taut report --overheads` the executor's"
            }
        )
    };
    let so_far =
        if seen.unfinished_ns == Some(longest_ns) { " so far, for its job has not ended" } else { "" };
    let host = match share {
        Some(Share { beyond, waited, unexplained, longest: Some(longest), .. }) => {
            let mut text = String::new();
            if *waited > 0 {
                text += &format!(
                    ", {waited} of {beyond} such responses by waits for the core beyond the analysis: for threads that the file lacks, or \
                     for a host that does not run a core when it is woken"
                );
            }
            if *unexplained > 0 {
                let jobs = if longest.overran_ns > 0 { " and by jobs beyond their wcet" } else { "" };
                text += &format!(
                    ", {unexplained} of {beyond} such responses with less taken by the host{jobs} than that explains"
                );
            }
            if text.is_empty() {
                text = format!(
                    ", {beyond} such responses are explained, but not all are recorded, or one still runs"
                );
            }
            format!("{text} (before the end of one of {}, {})", Time(longest.response_ns), took(longest))
        }
        _ => String::new(),
    };
    let (longest, bound) = (Time(longest_ns), Time(bound_ns));
    mark("bound exceeded", format!("a response took {longest}{so_far}, the bound is {bound}{host}: {why}"))
}

fn took(longest: &Longest) -> String {
    let Longest { taken_ns, overran_ns, waited_ns, .. } = *longest;
    let more = [
        (overran_ns, "jobs", "more than their wcet"),
        (waited_ns, "waits for the core were", "longer than by analysis"),
    ];
    let more = more.iter().filter(|(ns, ..)| *ns > 0);
    let more: String = more.map(|(ns, who, what)| format!(" and {who} {} {what}", Time(*ns))).collect();
    format!("the host took {}{more}", Time(taken_ns))
}

/// A note, not a violation: every response above the bound is within it if the time that was taken before its end is added to the bound. A
/// job that took this time has a violation of its own.
pub fn host_took(predicted: &CheckedCallback, share: &Share) -> String {
    let longest = share.longest.unwrap_or_default();
    let [by, rest] = match longest.overran_ns {
        0 => ["what the host took", "no assumption on the system was violated"],
        _ => ["what was taken", "mend the wcet that was exceeded"],
    };
    format!(
        "{}: {} beyond its bound, by {by}: the longest was {}, before whose end {}; {rest}",
        predicted.entry.name,
        times(share.beyond),
        Time(longest.response_ns),
        took(&longest)
    )
}

pub fn queue_over_capacity(predicted: &CheckedCallback, max_queue: u64, capacity: usize) -> Mark {
    let text = format!(
        "{max_queue} messages waited at once, by analysis at most {capacity} do: messages of {} came faster, or the \
         callback ended later, than the file says",
        predicted.entry.topics.join(", ")
    );
    mark("queue over capacity", text)
}

/// A note on a timer of which only the publications are seen; `None` for other callbacks.
pub fn published(predicted: &CheckedCallback, callback: &Callback) -> Option<String> {
    if !callback.is_by_publications {
        return None;
    }
    let distances = match (callback.least_distance_ns, callback.greatest_distance_ns) {
        (Some(least), Some(greatest)) => format!(", {} to {} apart", Time(least), Time(greatest)),
        _ => String::new(),
    };
    let entry = &predicted.entry;
    // If this is not the file of the saved run, the entry may publish nothing.
    let (name, topic) = (&entry.name, entry.publishes.first()?);
    Some(format!(
        "`{name}` is a timer, of which an RMW sees only what it publishes: {} messages on {topic}{distances}, of a period of {}; its response \
         times are not known",
        callback.releases,
        Time(predicted.period_ns)
    ))
}

pub fn messages_lost(predicted: &CheckedCallback, seen: &Callback) -> Mark {
    let lost = seen.lost;
    if seen.is_by_publications {
        let topic = predicted.entry.publishes.join(", ");
        let text = format!(
            "{lost} periods passed in which nothing was published on {topic}: its executor ran other callbacks, or the callback does not \
             publish each time; give the timer an executor of its own, or a longer period"
        );
        return mark("releases missed", text);
    }
    if predicted.entry.topics.is_empty() {
        let text = format!(
            "{lost} releases of its timer passed while a job ran: the response must be shorter than the period; lower \
             the load, or raise the period"
        );
        return mark("messages lost", text);
    }
    let depth = seen.depth;
    let needs = match predicted.capacity {
        Some(capacity) if capacity as u64 > depth => {
            let how = match predicted.entry.client {
                Client::Tautline => {
                    format!("subscribe with `context.callback_qos(\"{}\")`", predicted.entry.name)
                }
                Client::Rclcpp | Client::Rclpy => "subscribe with that depth".into(),
            };
            format!("by analysis it needs {capacity}: {how}")
        }
        Some(_) => {
            "by analysis that is enough, if the marks of this callback and of those above it are mended; \
                    messages from before it was spawned count, too"
                .into()
        }
        None => "and by analysis no depth is enough: see `taut check`".into(),
    };
    mark("messages lost", format!("{lost} messages were overwritten in a queue of {depth}; {needs}"))
}

pub fn deadline_missed(predicted: &CheckedCallback, misses: u64, longest_ns: u64) -> Mark {
    let deadline_ns = predicted.entry.deadline_ns;
    let predictable = predicted.response_overhead_ns.is_none_or(|bound| bound > deadline_ns);
    let why = if predictable {
        "as the analysis says it may: shorten what runs at this priority and above, raise the priority, or move it to \
         another core"
    } else {
        "the bound is within the deadline: mend the marks before this one"
    };
    let text = format!(
        "{} later than the deadline of {}, the latest {} after its release; {why}",
        if misses == 1 { "a job was".into() } else { format!("{misses} jobs were") },
        Time(deadline_ns),
        Time(longest_ns)
    );
    mark("deadline missed", text)
}

pub fn sampler_too_low(sampler: u8, callback: &str, priority: u8) -> Mark {
    let text = format!(
        "its sampler has priority {sampler}, not above `{callback}` with {priority}: while that runs, messages wake no \
         callback; leave `sampler_priority` to the file, or lower the callback's priority there"
    );
    mark("sampler too low", text)
}

pub fn not_in_the_file(process: &Process, callback: &Callback, priority: u8) -> Mark {
    let core = callback.core.map_or("several cores".into(), |core| format!("core {core}"));
    let text = format!(
        "{} runs it on {core} at {}, where the analysis does not count its load: add it to the file, or \
         run it without real-time priority",
        process.label(),
        level(priority)
    );
    mark("not in the file", text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_are_short_and_fit_into_the_file() {
        let shown =
            [0, 999, 1_000, 1_500, 2_000_000, 2_003_456, 12_000_000_000].map(|ns| Time(ns).to_string());
        assert_eq!(shown, ["0 ns", "999 ns", "1 us", "1.5 us", "2 ms", "2.003 ms", "12 s"]);
        assert_eq!([quoted(1), quoted(2_000_001)], ["\"1us\"", "\"2.001ms\""]);
    }
}
