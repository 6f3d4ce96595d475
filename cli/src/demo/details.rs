// SPDX-License-Identifier: MIT OR Apache-2.0
//! The part of the report that `--verbose` adds: each excess, the circumstances of the run, and the explanation of anything unusual.

use super::report::DemoReport;

/// The kernel needs some microseconds per job to switch between threads: a fifth of a millisecond for forty jobs.
const SWITCHES_MS: f64 = 0.5;

/// The responses above the prediction, and what had the core during the worst of them; empty if there are none, or if no bound applies.
pub fn excesses(report: &DemoReport) -> String {
    let excesses = report.list(|topic| topic.beyond_prediction().filter(|_| report.realtime));
    if excesses.is_empty() { excesses } else { format!("Above RTA+overhead: {excesses}.") }
}

/// The circumstances of the run, and the measurements other than responses.
pub fn circumstances(report: &DemoReport) -> String {
    format!(
        "{:.1} s on core {}, sampler at priority {}. Measured overhead: {:.1} µs of middleware per message (most at once: {:.0} µs), \
         interruptions of {:.0} µs that take {:.2} % of the core (longest before the run: {:.0} µs). The host took {:.2} ms while \
         threads ran and {:.2} ms before timers were served. Kernel {}, preemption {}.",
        report.seconds,
        report.core,
        report.sampler_priority,
        report.overhead_us,
        report.longest_use_us,
        report.interruption_us,
        report.interrupted_percent,
        report.longest_interruption_us,
        report.taken_running_ms,
        report.taken_late_ms,
        report.kernel,
        report.preemption
    )
}

/// A sentence for each circumstance that explains an unusual table, the gravest first.
pub fn explanations(report: &DemoReport) -> Vec<String> {
    let mut texts = Vec::new();
    if !report.realtime {
        texts.push(
            "Not real-time: no bound applies, and the RTA columns show what real-time priorities would give. Leave out --no-rt; if the \
             system refuses real-time priorities, the banner above names the fix."
                .into(),
        );
    }
    let highest = report.topics.iter().map(|t| t.priority).max().unwrap_or(0);
    let sampler_below = report.realtime && report.sampler_priority <= highest;
    if sampler_below {
        texts.push(format!(
            "The sampler has priority {}, the callbacks have up to {highest}: while a callback runs, the sampler does not, and no \
             other callback is woken. The prediction assumes a sampler above all callbacks.",
            report.sampler_priority
        ));
    }
    let unbounded = report.list(|t| t.rta_overhead_ms.is_none().then(|| t.topic.clone()));
    if !unbounded.is_empty() {
        texts.push(format!(
            "No prediction for {unbounded}: with the overhead, the work at that priority and above needs more than the core; lower a \
             rate or a wcet."
        ));
    }
    let silent = report.list(|t| (t.n == 0).then(|| t.topic.clone()));
    if !silent.is_empty() {
        texts.push(format!(
            "Nothing arrived on {silent}: the run was shorter than its period, its publisher did not run, or its callback never got \
             the core."
        ));
    }
    let lossy = report.list(|t| (t.lost > 0).then(|| t.topic.clone()));
    if !lossy.is_empty() {
        texts.push(format!(
            "Lost on {lossy}: messages were overwritten while their callback was busy; its queue is too short for its response time."
        ));
    }
    let unexplained = report.topics.iter().any(|t| t.unexplained > 0);
    if report.realtime && unexplained && !sampler_below {
        texts.push(
            "Neither the host, nor other threads, nor the middleware used the time by which the prediction was exceeded, as far as the \
             threads could measure it: look for interrupts, and for a callback whose priority is not its own."
                .into(),
        );
    }
    let others_ms = report.topics.iter().filter_map(|t| t.worst).map(|worst| worst.others_had_ms);
    if report.realtime && others_ms.fold(0.0, f64::max) > SWITCHES_MS {
        texts.push(
            "Other threads had the core while jobs waited for it, or the host had it between two threads. These are real-time threads \
             of other programs, or ordinary ones in the 5 % that Linux reserves for them (/sys/kernel/debug/sched/fair_server since \
             6.12, kernel.sched_rt_runtime_us before): move them to another core."
                .into(),
        );
    }
    if report.moments_overwritten > 0 {
        texts.push(format!(
            "{} records of time that was taken or used were overwritten before they could be read; responses that they would explain \
             count as unexplained. Leave the other cores some time.",
            report.moments_overwritten
        ));
    }
    if report.steal_ticks > 0 {
        texts.push(format!(
            "Steal: by its own account the hypervisor gave {} ms of processor time to other guests during the run; RTA+host contains \
             what the threads measured of it. Repeat the run on an idle host, or on hardware of your own.",
            report.steal_ticks * 10
        ));
    }
    let preemption = report.preemption.to_lowercase();
    if preemption.contains("voluntary") || preemption.contains("none") {
        texts.push(format!(
            "A kernel with preemption {} may finish a system call of any thread first; boot with preempt=full, or use a PREEMPT_RT \
             kernel.",
            report.preemption
        ));
    }
    texts
}
