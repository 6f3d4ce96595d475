// SPDX-License-Identifier: MIT OR Apache-2.0
//! `--measure`: the interruptions of a spinning real-time thread on each core.

use super::finding::{Checked, Cost, Finding, Verdict};
use crate::table::write_table;
use crate::times::us;
use crate::verb::{End, Outcome};
use indicatif::{ProgressBar, ProgressStyle};
use serde_json::{Value, json};
use std::io::{self, Write};
use std::time::Duration;
use tautline::{CoreSet, Policy};
use tautline_rt::{Interruptions, RtError, ThreadBuilder};

/// The length of a measurement. Other threads run between two of them, so that the kernel does not throttle this thread.
const SLICE: Duration = Duration::from_millis(100);
const PAUSE: Duration = Duration::from_millis(10);

/// Limits of the verdicts: a whole period of a 1 kHz loop, and a tenth of it.
const BAD_NS: u64 = 1_000_000;
const LONG_NS: u64 = 100_000;

/// The measurement of one core.
pub struct Seen {
    core: usize,
    policy: Policy,
    sum: Interruptions,
}

impl Seen {
    fn add(&mut self, slice: &Interruptions) {
        self.sum.window_ns += slice.window_ns;
        self.sum.count += slice.count;
        self.sum.total_ns += slice.total_ns;
        self.sum.regular_ns = self.sum.regular_ns.max(slice.regular_ns);
        self.sum.longest_ns = self.sum.longest_ns.max(slice.longest_ns);
    }

    fn share(&self) -> f64 {
        self.sum.total_ns as f64 / self.sum.window_ns.max(1) as f64
    }

    pub fn to_json(&self) -> Value {
        json!({
            "core": self.core, "policy": self.policy.to_string(), "window_s": self.sum.window_ns as f64 / 1e9,
            "interruptions": self.sum.count, "regular_us": us(self.sum.regular_ns),
            "longest_us": us(self.sum.longest_ns), "share": self.share(),
        })
    }
}

/// Measures each core in turn for `window`, at `priority` if that is granted. A core that was not measured, because this process may not use
/// it or was interrupted, has a window of 0.
pub fn watch(cores: CoreSet, window: Duration, priority: u8, end: &End) -> Outcome<Vec<Seen>> {
    let slices = window.as_nanos().div_ceil(SLICE.as_nanos()).max(1) as u64;
    let style = ProgressStyle::with_template("{msg} {wide_bar} {eta}").ok();
    let progress = ProgressBar::new(slices * cores.len() as u64);
    progress.set_style(style.unwrap_or_else(ProgressStyle::default_bar));
    let mut all = Vec::new();
    for core in cores.iter() {
        progress.set_message(format!("core {core}"));
        let mut policy = Policy::Fifo(priority);
        let mut seen = Seen { core, policy, sum: Interruptions::default() };
        for _ in 0..slices {
            if end.is_reached() {
                break;
            }
            let slice = match slice(core, policy, window) {
                Err(error) if policy == Policy::Fifo(priority) && !is_about_cores(&error) => {
                    policy = Policy::Other { nice: 0 };
                    slice(core, policy, window)?
                }
                Err(error) if is_about_cores(&error) => {
                    progress.println(format!("taut: {error}"));
                    break;
                }
                slice => slice?,
            };
            seen.policy = policy;
            seen.add(&slice);
            progress.inc(1);
            end.pause(PAUSE);
        }
        all.push(seen);
    }
    progress.finish_and_clear();
    Ok(all)
}

fn slice(core: usize, policy: Policy, window: Duration) -> Result<Interruptions, RtError> {
    let thread = ThreadBuilder::new("doctor").policy(policy).cores(CoreSet::one(core));
    thread.spawn(move || move || Interruptions::watch(SLICE.min(window)))?.join()
}

fn is_about_cores(error: &RtError) -> bool {
    matches!(
        error,
        RtError::UnknownCore { .. } | RtError::CoreNotAllowed { .. } | RtError::CoresNotKept { .. }
    )
}

pub fn finding(seen: &[Seen]) -> Checked {
    let worst = seen.iter().max_by_key(|seen| seen.sum.longest_ns).ok_or("no core was watched")?;
    let unseen: CoreSet = seen.iter().filter(|seen| seen.sum.window_ns == 0).map(|seen| seen.core).collect();
    if !unseen.is_empty() && worst.sum.longest_ns < BAD_NS {
        let value = format!("cores {unseen} were not watched: they are withheld, or the end came first");
        return Ok(Finding::unknown(value).fix("give this process those cores, and --measure its time"));
    }
    let (core, longest_ns) = (worst.core, worst.sum.longest_ns);
    let value = format!(
        "the longest is {:.1} µs, on core {core}, in {:.1} s at {}",
        us(longest_ns),
        us(worst.sum.window_ns) / 1e6,
        worst.policy
    );
    if worst.policy.realtime_priority().is_none() {
        let value = format!("{value}: not in real time, so other threads are among what interrupted");
        return Ok(Finding::unknown(value).fix("measure with the right to real-time priorities"));
    }
    let verdict = match longest_ns {
        BAD_NS.. => Verdict::Bad,
        LONG_NS.. => Verdict::Advice,
        _ => return Ok(Finding::good(value)),
    };
    Ok(Finding::new(verdict, value)
        .costs(Cost::Known(us(longest_ns), "measured now".into()))
        .fix("what the other findings say; what remains is firmware (SMI: `hwlat` of the kernel's tracer) or a hypervisor"))
}

pub fn write(seen: &[Seen], out: &mut impl Write) -> io::Result<()> {
    let head = ["core", "seconds", "interruptions", "regular µs", "longest µs", "share %"];
    let row = |seen: &Seen| {
        let sum = &seen.sum;
        let cells = vec![
            seen.core.to_string(),
            format!("{:.1}", us(sum.window_ns) / 1e6),
            sum.count.to_string(),
            format!("{:.1}", us(sum.regular_ns)),
            format!("{:.1}", us(sum.longest_ns)),
            format!("{:.3}", seen.share() * 100.0),
        ];
        (sum.longest_ns < BAD_NS, cells)
    };
    let watched = seen.iter().filter(|seen| seen.sum.window_ns > 0);
    write_table(&head, 0, watched.map(row).collect(), out)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn seen(longest_ns: u64, policy: Policy) -> Seen {
        let mut seen = Seen { core: 3, policy, sum: Interruptions::default() };
        let slice = Interruptions {
            window_ns: 1_000_000_000,
            count: 2,
            total_ns: 5_000,
            regular_ns: 3_000,
            longest_ns,
        };
        seen.add(&slice);
        seen.add(&Interruptions { longest_ns: 10, ..slice });
        seen
    }

    #[test]
    fn slices_add_up_and_the_longest_decides() {
        let one = seen(40_000, Policy::Fifo(90));
        assert_eq!((one.sum.window_ns, one.sum.count, one.sum.longest_ns), (2_000_000_000, 4, 40_000));
        for (longest_ns, verdict) in
            [(40_000, Verdict::Good), (150_000, Verdict::Advice), (1_000_000, Verdict::Bad)]
        {
            let seen = [seen(1, Policy::Fifo(90)), seen(longest_ns, Policy::Fifo(90))];
            assert_eq!(finding(&seen).unwrap().verdict, verdict);
        }
        // A measurement without real-time priority, or of no core, proves nothing.
        assert_eq!(finding(&[seen(5, Policy::Other { nice: 0 })]).unwrap().verdict, Verdict::Unknown);
        assert!(finding(&[]).is_err());
    }
}
