// SPDX-License-Identifier: MIT OR Apache-2.0
//! The process that the user started: starts the two others, shows the progress, prints the report.

use super::application;
use super::args::{DemoArgs, Role, unusable_core};
use super::losses::losses;
use super::output::Files;
use super::process::{GLANCE, Process};
use super::protocol::{self, Job, Line, Measured, Published};
use super::report::{self, Costs, DemoReport, TopicRun};
use crate::times::{ms, us};
use crate::verb::{Failure, Outcome};
use indicatif::{ProgressBar, ProgressStyle};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::RecvTimeoutError;
use std::time::{Duration, Instant};
use tautline::{CoreSet, Policy};
use tautline_analysis::Task;
use tautline_analysis::taken::{Seen, TakenTimes};
use tautline_rt::{Interruptions, ThreadBuilder, current_affinity, host, permission};

/// The wait after the last release: more than the longest response time of a run within its bounds.
const DRAIN: Duration = Duration::from_millis(400);
/// The time for which interruptions of the core are measured before the run.
const NOISE_WINDOW: Duration = Duration::from_millis(500);

pub fn run(mut args: DemoArgs) -> Outcome<ExitCode> {
    if let Some(value) =
        std::env::var_os("TAUT_REALTIME").filter(|value| !value.is_empty() && value != "required")
    {
        if value != "off" {
            let value = value.to_string_lossy();
            let text = format!("TAUT_REALTIME={value} is not understood: it may be 'required' or 'off'");
            return Err(Failure::unusable(text));
        }
        args.no_rt = true;
    }
    let core = match args.core {
        Some(core) => {
            CoreSet::one(core).check().map_err(unusable_core(core))?;
            core
        }
        None => current_affinity()?.iter().last().unwrap_or(0),
    };
    args.core = Some(core);
    // A separate namespace, so that two demos at once do not receive each other's messages.
    args.namespace = format!("/demo_{}", std::process::id());
    if !args.no_rt
        && let Err(error) = permission::realtime_permitted(application::PUBLISHER_SAMPLER_PRIORITY)
    {
        print_banner(&error.to_string());
        args.no_rt = true;
    }
    let interrupted = Arc::new(AtomicBool::new(false));
    for signal in tautline_rt::termination_signals() {
        let _ = signal_hook::flag::register(signal, interrupted.clone());
    }

    let mut files = Files::open(&args)?;
    // Without real-time priorities this would measure other programs, not the machine.
    let interruptions = if args.no_rt { Interruptions::default() } else { watch_core(&args, core)? };
    let steal_before = host::steal_ticks(Some(core));
    let mut subscriber = Process::start(Role::Subscriber, &args)?;
    subscriber.wait_until_ready()?;
    let mut publisher = Process::start(Role::Publisher, &args)?;
    publisher.wait_until_ready()?;
    let started = Instant::now();
    let published = conduct(&args, &mut publisher, &mut subscriber, &interrupted, started)?;
    let seconds = started.elapsed().as_secs_f64().min(args.seconds as f64);
    std::thread::sleep(DRAIN);
    let measured = subscriber.end()?;
    let steal_ticks = host::steal_ticks(Some(core)).saturating_sub(steal_before);

    let run = Run { core, seconds, steal_ticks, interruptions };
    let report = assemble(&args, &run, &published, measured)?;
    files.write(&report, args.verbose)?;
    if published.missed > 0 {
        println!("The publisher itself missed {} releases: the core was taken from it.", published.missed);
    }
    if interrupted.load(Ordering::Relaxed) {
        println!("Interrupted after {seconds:.1} of {} seconds.", args.seconds);
        return Ok(ExitCode::from(130));
    }
    Ok(ExitCode::SUCCESS)
}

/// The child processes end when this process closes their input, not by signals that the terminal sends to all processes.
pub fn ignore_terminal_signals() {
    for signal in [signal_hook::consts::SIGINT, signal_hook::consts::SIGHUP] {
        let _ = signal_hook::flag::register(signal, Arc::new(AtomicBool::new(false)));
    }
}

fn print_banner(reason: &str) {
    let rule = "=".repeat(78);
    eprintln!(
        "{rule}\nRunning WITHOUT real-time priorities: no bound applies to what follows.\n{reason}\n{rule}"
    );
}

/// Shows the progress until the publisher has ended; if the user interrupts, ends the publisher.
fn conduct(
    args: &DemoArgs,
    publisher: &mut Process,
    subscriber: &mut Process,
    interrupted: &AtomicBool,
    started: Instant,
) -> Outcome<Published> {
    let bar = ProgressBar::new(args.seconds * 10);
    let style = ProgressStyle::with_template("{elapsed:>4} [{bar:40}] {msg}");
    bar.set_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()));
    let mut handled = 0;
    loop {
        if interrupted.load(Ordering::Relaxed) {
            publisher.request_end();
        }
        while let Ok(line) = subscriber.lines.try_recv() {
            if let Line::Progress(messages) = line {
                handled = messages;
            }
        }
        bar.set_position((started.elapsed().as_millis() / 100) as u64);
        bar.set_message(format!("{handled} callbacks on core {}", args.core.unwrap_or(0)));
        match publisher.lines.recv_timeout(GLANCE) {
            Ok(Line::Published(published)) => {
                bar.finish_and_clear();
                publisher.wait()?;
                return Ok(published);
            }
            Ok(_) | Err(RecvTimeoutError::Timeout) => subscriber.must_live()?,
            Err(RecvTimeoutError::Disconnected) => {
                bar.finish_and_clear();
                return Err(publisher.ended_early());
            }
        }
    }
}

/// Measures the interruptions of the core before the run, at a priority above all threads of the demo.
fn watch_core(args: &DemoArgs, core: usize) -> Outcome<Interruptions> {
    let thread = ThreadBuilder::new("noise")
        .policy(Policy::Fifo(application::PUBLISHER_SAMPLER_PRIORITY + 1))
        .cores(CoreSet::one(core))
        .realtime(application::realtime(args))
        .spawn(|| || Interruptions::watch(NOISE_WINDOW))?;
    Ok(thread.join()?)
}

struct Run {
    core: usize,
    seconds: f64,
    steal_ticks: u64,
    interruptions: Interruptions,
}

fn assemble(args: &DemoArgs, run: &Run, published: &Published, measured: Measured) -> Outcome<DemoReport> {
    let tasks = application::tasks()?;
    let handled: u64 = measured.topics.iter().map(|topic| topic.jobs.len() as u64).sum();
    // The processor time of both processes without the callbacks' own work, divided by the number of messages.
    // A run that was interrupted before its first message has no overhead.
    let share = |cpu_ns: u64, messages| cpu_ns.checked_div(messages).unwrap_or(0);
    let overhead_ns = match handled {
        0 => 0,
        handled => share(published.cpu_ns, published.messages) + share(measured.overhead_cpu_ns, handled),
    };
    let moments_overwritten = published.seen.overwritten + measured.seen.overwritten;
    let sampler_priority = application::sampler_priority(args)?;
    let sampler_first = tasks.iter().all(|task| task.priority < sampler_priority);
    let losses = losses(&published.seen, &measured, sampler_first);
    // The last topic has the lowest priority, so its list contains everything.
    let all = losses.last().cloned().unwrap_or_default();
    let taken = all.seen(&[Seen::Running, Seen::WokenLate]);
    let lost_ms = |way| ms(all.seen(&[way]).total_ns());
    let longest_taken_ms = ms(taken.longest_ns());
    let (per_message, interruptions) = (Duration::from_nanos(overhead_ns), run.interruptions);
    let costs = Costs { per_message, interruptions, taken };
    let pair = |((task, measured), lost_time): ((Task, protocol::TopicMeasured), TakenTimes)| TopicRun {
        lost_time,
        task,
        releases_ns: measured.jobs.iter().map(|job| job.release_ns).collect(),
        latencies_ns: measured.jobs.iter().map(Job::latency_ns).collect(),
        lost: measured.lost,
        max_queue: measured.max_queue,
    };
    let runs = tasks.into_iter().zip(measured.topics).zip(losses).map(pair).collect();
    let info = host::HostInfo::read();
    let mode = info.preempt_mode.as_deref().map_or(String::new(), |mode| format!(" ({mode})"));
    let Interruptions { total_ns, window_ns, regular_ns, longest_ns, .. } = run.interruptions;
    Ok(DemoReport {
        realtime: !args.no_rt,
        core: run.core,
        seconds: (run.seconds * 1e3).round() / 1e3,
        steal_ticks: run.steal_ticks,
        kernel: info.kernel,
        topics: report::topic_reports(runs, &costs),
        preemption: format!("{}{mode}", info.preemption),
        overhead_us: us(overhead_ns),
        sampler_priority,
        interruption_us: us(regular_ns),
        interrupted_percent: 100.0 * total_ns as f64 / window_ns.max(1) as f64,
        longest_interruption_us: us(longest_ns),
        taken_running_ms: lost_ms(Seen::Running),
        taken_late_ms: lost_ms(Seen::WokenLate),
        longest_taken_ms,
        others_ms: lost_ms(Seen::Waited),
        longest_use_us: us(all.seen(&[Seen::Overran]).longest_ns()),
        moments_overwritten,
    })
}
