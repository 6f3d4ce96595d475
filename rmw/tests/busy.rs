// SPDX-License-Identifier: MIT OR Apache-2.0
//! Random systems of unchanged nodes under `order = "priority"`: a program on rcl alone (`busy.c`), with a thread for each group, gets the
//! messages of the analysis's simulation at their times. Each thread's jobs begin in the order that the simulation's rule gives, none has a page
//! fault, each thread has its group's priority or those of its callbacks, and no job takes longer than its bound, except for what something else
//! took from the core, which is measured beside.
//! `SYSTEMS` says how many (1,000 take seven minutes, for which nextest does not wait, but `cargo test` does), `TAUT_SEED` which.

#[path = "../../analysis/tests/runtime/mod.rs"]
mod runtime;
mod support;

use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use runtime::machine::{Run, Seen, Step, simulate};
use runtime::made_up::{Callback, Model, Order, group_priority};
use runtime::small::{HERE, callback, sensors};
use std::collections::BTreeSet;
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::mpsc;
use support::{Domain, matched, may_be_realtime, publisher, wait_until};
use tautline_analysis::file::SystemFile;
use tautline_executor::{CallbackSnapshot, ForeignStatistics, Moment, MomentKind, StatisticsFile};
use tautline_rt::clock::{monotonic_ns, sleep_until_monotonic};
use tautline_rt::permission::realtime_permitted;
use tautline_rt::{CoreSet, Policy, ThreadBuilder};
use tautline_transport::{Qos, RawPublisher};

/// In ns of CLOCK_MONOTONIC.
type Span = (u64, u64);

/// How long a system runs; its times are in µs.
const UNTIL: u64 = 100_000;
/// What rcl's wait and take may use for a callback, beyond which a job is late.
const EXECUTOR: u64 = 60;
/// By how much the publishing thread may be late, which the file states as jitter: timers of a virtual machine are now and then half as late.
const LATENESS: u64 = 1_000;
/// Of the thread that sees, just above the executors, when the core is had.
const WATCH_PRIORITY: u8 = 20;
/// Of callbacks whose threads have their priorities: for each thread others, and none that a group has.
const OWN_PRIORITIES: [[u8; 4]; 3] = [[2, 8, 11, 17], [3, 9, 14, 18], [4, 6, 12, 15]];

/// One to three executors on a core, each with two to five subscriptions.
fn executors(rng: &mut StdRng) -> Model {
    let mut model = sensors(rng, 2, false);
    let load = rng.random_range(0.3..0.75);
    let sizes: Vec<usize> = (0..rng.random_range(1..=3)).map(|_| rng.random_range(2..=5)).collect();
    let count: usize = sizes.iter().sum();
    let order = |_| if rng.random_bool(0.5) { Order::Lowered } else { Order::Rank };
    let groups: Vec<Order> = sizes.iter().map(order).collect();
    let mut one = |group: usize| {
        let period = [4_000, 5_000, 8_000, 10_000, 20_000, 40_000][rng.random_range(0..6)];
        let jitter = if rng.random_bool(0.3) { rng.random_range(0..period) } else { 0 };
        let share = load * rng.random_range(0.3..1.7) / count as f64;
        let wcet = ((period as f64 * share) as u64).saturating_sub(2 * EXECUTOR).max(50);
        let rank: u8 = rng.random_range(1..=4);
        let is_lowered = groups[group] == Order::Lowered;
        let priority = if is_lowered { OWN_PRIORITIES[group][usize::from(rank) - 1] } else { rank };
        let group = Some(group);
        let own =
            Callback { period, jitter, wcet, bcet: wcet, priority, group, ..callback(HERE, Vec::new()) };
        Callback { is_outside: true, ..own }
    };
    model.callbacks =
        sizes.iter().enumerate().flat_map(|(group, size)| vec![group; *size]).map(&mut one).collect();
    Model {
        hosts: vec![0],
        groups,
        per_message: vec![20],
        switch: 10,
        executors: vec![Some(EXECUTOR)],
        ..model
    }
}

/// The system file, in which the names of topics are ROS's.
fn file(model: &Model) -> String {
    let mut late = model.clone();
    late.callbacks.iter_mut().for_each(|callback| callback.jitter += LATENESS);
    let mut text = late.text();
    for i in 0..model.callbacks.len() {
        text = text.replace(&format!("\"x{i}\""), &format!("\"/x{i}\""));
        text = text.replace(&format!("\nx{i} = "), &format!("\n\"/x{i}\" = "));
    }
    text
}

/// The number of the first message of each topic, before those that count.
const FIRST: u64 = u64::MAX;

/// A message, by when it was released at the earliest and the latest, and how long after it was due.
struct Published {
    callback: usize,
    span: Span,
    late_ns: u64,
}

fn realtime(name: &str, priority: u8, core: usize) -> ThreadBuilder {
    ThreadBuilder::new(name).policy(Policy::Fifo(priority)).cores(CoreSet::one(core))
}

/// Publishes at these times, in µs. Returns besides how long the core of the callbacks took each time to run a thread above them.
fn publish(
    publishers: Vec<RawPublisher>,
    plan: Vec<(u64, usize)>,
) -> (Vec<RawPublisher>, Vec<Published>, Vec<Span>) {
    let (tell, told) = mpsc::channel::<u64>();
    let watch = realtime("watch", WATCH_PRIORITY, 0)
        .spawn(move || move || told.iter().map(|woken_ns| (woken_ns, monotonic_ns())).collect::<Vec<_>>());
    let other = tautline_rt::current_affinity().unwrap().iter().last().unwrap();
    let highest = (50..90).rev().find(|priority| realtime_permitted(*priority).is_ok()).unwrap();
    let source = realtime("source", highest, other).spawn(move || {
        move || {
            let start_ns = monotonic_ns() + 5_000_000;
            let mut numbers = vec![0_u64; publishers.len()];
            let publish = |(at, callback): (u64, usize)| {
                let due_ns = start_ns + at * 1_000;
                sleep_until_monotonic(due_ns);
                let from_ns = monotonic_ns();
                publishers[callback].publish(&numbers[callback].to_le_bytes()).unwrap();
                let to_ns = monotonic_ns();
                numbers[callback] += 1;
                tell.send(to_ns).unwrap();
                Published { callback, span: (from_ns, to_ns), late_ns: to_ns - due_ns }
            };
            let published = plan.into_iter().map(publish).collect();
            (publishers, published)
        }
    });
    let (publishers, published) = source.unwrap().join().unwrap();
    (publishers, published, watch.unwrap().join().unwrap())
}

/// A job as the program saw it.
struct Job {
    /// Of its thread.
    callback: usize,
    number: usize,
    /// Of the thread while it ran.
    priority: u64,
    /// From before the wait that reported it until after that.
    wait: Span,
    ends_ns: u64,
}

/// What a thread of the program did.
#[derive(Default)]
struct Executor {
    fifo_priority: Option<u64>,
    /// Page faults of its jobs.
    faults: u64,
    jobs: Vec<Job>,
    gaps: Vec<Span>,
}

fn parsed(text: &str, threads: usize) -> Vec<Executor> {
    let mut all: Vec<Executor> = (0..threads).map(|_| Executor::default()).collect();
    for line in text.lines() {
        let (kind, numbers) = line.split_once(' ').unwrap();
        let numbers: Vec<u64> = numbers.split(' ').map(|number| number.parse().unwrap()).collect();
        let executor = &mut all[numbers[0] as usize];
        match (kind, &numbers[1..]) {
            ("thread", &[is_fifo, priority, faults]) => {
                (executor.fifo_priority, executor.faults) = ((is_fifo == 1).then_some(priority), faults);
            }
            ("job", &[_, FIRST, ..]) => {}
            ("job", &[callback, number, priority, waits_ns, ready_ns, _, ends_ns]) => {
                let (callback, number, wait) = (callback as usize, number as usize, (waits_ns, ready_ns));
                executor.jobs.push(Job { callback, number, priority, wait, ends_ns });
            }
            ("gap", &[from_ns, to_ns]) => executor.gaps.push((from_ns, to_ns)),
            _ => panic!("{line}"),
        }
    }
    all
}

/// Sorted, and those that overlap joined.
fn union(mut spans: Vec<Span>) -> Vec<Span> {
    spans.sort_unstable();
    let mut joined: Vec<Span> = Vec::new();
    for (from_ns, to_ns) in spans {
        match joined.last_mut() {
            Some(last) if from_ns <= last.1 => last.1 = last.1.max(to_ns),
            _ => joined.push((from_ns, to_ns)),
        }
    }
    joined
}

/// What is left of `spans` without `others`, which are a union.
fn without(spans: &[Span], others: &[Span]) -> Vec<Span> {
    let mut left = Vec::new();
    for &(mut from_ns, to_ns) in spans {
        for other in others.iter().filter(|other| other.0 < to_ns) {
            if from_ns < other.0 {
                left.push((from_ns, other.0));
            }
            from_ns = from_ns.max(other.1);
        }
        if from_ns < to_ns {
            left.push((from_ns, to_ns));
        }
    }
    left
}

/// A run of a system.
struct Observed {
    model: Model,
    /// The callbacks of each thread.
    members: Vec<Vec<usize>>,
    /// The messages of each callback.
    released: Vec<Vec<Span>>,
    executors: Vec<Executor>,
    statistics: Vec<CallbackSnapshot>,
    /// How long the core took to wake up.
    wakes: Vec<Span>,
}

impl Observed {
    /// What the threads began, one after the other.
    fn order(&self, thread: usize) -> impl Iterator<Item = usize> {
        self.executors[thread].jobs.iter().map(move |job| self.members[thread][job.callback])
    }

    /// Each wait reports of what is there the highest rank, and all of that, and each message is taken that no newer one took the place of.
    fn check_order(&self) {
        for (executor, members) in self.executors.iter().zip(&self.members) {
            let rank = |member: usize| self.model.callbacks[members[member]].priority;
            let mut begun = vec![0; members.len()];
            for round in executor.jobs.chunk_by(|one, other| one.wait == other.wait) {
                let (waits_ns, ready_ns) = round[0].wait;
                let highest = rank(round[0].callback);
                for member in 0..members.len() {
                    let next = self.released[members[member]].get(begun[member]);
                    let told = || format!("{:?} of {} at {waits_ns}", members[member], begun[member]);
                    if let Some(job) = round.iter().find(|job| job.callback == member) {
                        assert!(job.number >= begun[member] && rank(member) == highest, "{}", told());
                        let released = self.released[members[member]][job.number];
                        assert!(released.0 < ready_ns, "{}: not published yet", told());
                        begun[member] = job.number + 1;
                    } else if next.is_some_and(|next| next.1 < waits_ns) {
                        assert!(rank(member) < highest, "{}: rank {highest} was reported", told());
                    }
                }
            }
            let all: Vec<usize> = members.iter().map(|callback| self.released[*callback].len()).collect();
            assert_eq!(begun, all, "the last message of each has a job");
        }
    }

    /// When something else had the core: no thread of the program.
    fn taken(&self) -> Vec<Span> {
        let ran = self.executors.iter().flat_map(|executor| {
            let jobs = executor.jobs.iter().map(|job| (job.wait.1, job.ends_ns));
            without(&jobs.collect::<Vec<_>>(), &union(executor.gaps.clone()))
        });
        let ran = union(ran.collect());
        let gaps = self.executors.iter().flat_map(|executor| without(&executor.gaps, &ran));
        union(gaps.chain(self.wakes.iter().copied()).collect())
    }

    /// What waited in vain, for a newer message took its place: from its release until then.
    fn lost(&self, callback: usize, depth: usize) -> Vec<Span> {
        let thread = self.model.callbacks[callback].group.unwrap();
        let jobs = self.executors[thread].jobs.iter();
        let jobs = jobs.filter(|job| self.members[thread][job.callback] == callback);
        let taken: BTreeSet<usize> = jobs.map(|job| job.number).collect();
        let released = &self.released[callback];
        let lost = (0..released.len()).filter(|number| !taken.contains(number));
        lost.map(|number| (released[number].1, released[number + depth].0)).collect()
    }

    /// No response is longer than its bound and what was taken from the core since it was idle. A message that was lost waited for longer than
    /// its bound, for which the queue has room. Returns how many were late.
    fn check_responses(&self) -> usize {
        let (taken, mut late) = (self.taken(), 0);
        let jobs = self.executors.iter().zip(&self.members).flat_map(|(executor, members)| {
            executor.jobs.iter().map(|job| (self.released[members[job.callback]][job.number].0, job.ends_ns))
        });
        let busy = union(jobs.collect());
        let length_ns = |spans: &[Span]| spans.iter().map(|span| span.1 - span.0).sum::<u64>();
        for of in &self.statistics {
            let bound_ns = of.bound_ns.unwrap();
            let lost = self.lost(of.name[1..].parse().unwrap(), of.depth as usize);
            assert_eq!((of.lost, of.older_moments), (lost.len() as u64, 0), "{}", of.name);
            let of_run = |moment: &&Moment| moment.kind == MomentKind::Late && moment.from_ns >= busy[0].0;
            let moments = of.moments.iter().filter(of_run);
            for (from_ns, to_ns) in moments.map(|moment| (moment.from_ns, moment.to_ns)).chain(lost) {
                let since_ns = busy.iter().rfind(|span| span.0 <= from_ns).unwrap().0;
                let taken_ns = to_ns - since_ns - length_ns(&without(&[(since_ns, to_ns)], &taken));
                println!("{}: {} ns, bound {bound_ns}, taken {taken_ns}", of.name, to_ns - from_ns);
                assert!((bound_ns..=bound_ns + taken_ns).contains(&(to_ns - from_ns)), "{} is late", of.name);
                late += 1;
            }
        }
        late
    }
}

/// The program, of `busy.c`.
fn compiled(venv: &Path, folder: &Path) -> PathBuf {
    let (prefix, program) = (venv.with_file_name("prefix"), folder.join("busy"));
    let packages = std::fs::read_dir(prefix.join("include")).unwrap().map(|entry| entry.unwrap().path());
    let mut command = Command::new("cc");
    command.args(["-O1", "-Wall", "-Werror", "-pthread", "-o"]).arg(&program);
    command.arg(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/busy.c"));
    packages.for_each(|package| _ = command.arg("-isystem").arg(package));
    command
        .arg("-L")
        .arg(prefix.join("lib"))
        .arg(format!("-Wl,--disable-new-dtags,-rpath,{}/lib", prefix.display()));
    command.args(["-lrcl", "-lrcutils", "-lstd_msgs__rosidl_typesupport_c"]);
    assert!(command.status().unwrap().success(), "cc and the headers of rcl are needed");
    program
}

/// The statistics of the program's callbacks, once they have had so many messages.
fn finished(domain: &Domain, messages: usize) -> Vec<CallbackSnapshot> {
    let mut statistics = Vec::new();
    wait_until("all jobs", || {
        let files = ForeignStatistics::list(&StatisticsFile::prefix(domain.number)).unwrap();
        let processes = files.iter().filter_map(|file| file.read().unwrap());
        statistics =
            processes.flat_map(|process| process.callbacks).filter(|of| of.name.starts_with('c')).collect();
        statistics.iter().map(|of| of.completions + of.lost).sum::<u64>() == messages as u64
    });
    statistics
}

/// Runs the program under the system's file. `None` if the host kept the publishing thread waiting for longer than the file allows.
fn observed(domain: &Domain, program: &Path, model: &Model, seen: &Seen) -> Option<Observed> {
    let path = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(path.path(), file(model)).unwrap();
    let (count, threads) = (model.callbacks.len(), model.groups.len());
    let of = |thread: usize| (0..count).filter(|i| model.callbacks[*i].group == Some(thread)).collect();
    let members: Vec<Vec<usize>> = (0..threads).map(of).collect();
    let mut command = domain.command(program);
    command.arg("n0").env("TAUT_SYSTEM", path.path());
    for members in &members {
        command.arg("--");
        members
            .iter()
            .for_each(|i| _ = command.args([format!("/x{i}"), model.callbacks[*i].wcet.to_string()]));
    }
    let mut process = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
    let (mut output, mut said) = (BufReader::new(process.stdout.take().unwrap()), String::new());
    output.read_line(&mut said).unwrap();
    assert_eq!(said, "runs\n");
    let end = |i: usize| {
        publisher(&domain.participant, &format!("/x{i}"), "std_msgs/msg/UInt64", Qos::keep_last(100))
    };
    let publishers: Vec<_> = (0..count).map(end).collect();
    publishers.iter().for_each(|publisher| matched(publisher, 1));
    // Until the first message of each has come, its threads may still learn of the publishers.
    publishers.iter().for_each(|publisher| publisher.publish(&FIRST.to_le_bytes()).unwrap());
    finished(domain, count);
    let plan = seen.steps.iter().filter_map(|(at, step)| match step {
        Step::Arrived { callback, .. } => Some((*at, *callback)),
        _ => None,
    });
    let (publishers, published, wakes) = publish(publishers, plan.collect());
    let mut released = vec![Vec::new(); count];
    published.iter().for_each(|one| released[one.callback].push(one.span));
    let statistics = finished(domain, count + published.len());
    drop(process.stdin.take());
    said.clear();
    output.read_to_string(&mut said).unwrap();
    assert!(process.wait().unwrap().success());
    drop(publishers);
    let is_late = published.iter().any(|one| one.late_ns > LATENESS * 1_000);
    let executors = parsed(&said, threads);
    (!is_late).then_some(Observed { model: model.clone(), members, released, executors, statistics, wakes })
}

#[test]
fn a_program_on_rcl_keeps_order_and_bounds() {
    let Some(domain) = Domain::new(118).filter(|_| may_be_realtime()) else { return };
    let number = |name: &str| std::env::var(name).ok().and_then(|text| text.parse().ok());
    let systems = number("SYSTEMS").unwrap_or(5);
    let seed = number("TAUT_SEED").unwrap_or_else(|| rand::random::<u32>().into());
    let folder = tempfile::tempdir().unwrap();
    let program = compiled(&domain.venv, folder.path());
    let (mut threads, mut lowered, mut jobs, mut alike, mut late, mut repeated) = (0, 0, 0, 0, 0, 0);
    for seed in (0..systems).map(|system| seed + system) {
        println!("TAUT_SEED={seed} SYSTEMS=1");
        let mut rng = StdRng::seed_from_u64(seed);
        let model = loop {
            let model = executors(&mut rng);
            if SystemFile::parse(&file(&model)).unwrap().check().schedulable {
                break model;
            }
        };
        let silent_until = vec![0; model.callbacks.len()];
        let run = Run { until: UNTIL, silent_until, ..Run::random(&model, &mut rng) };
        let seen = simulate(&model, &run);
        let runs = (0..20).map(|_| observed(&domain, &program, &model, &seen));
        let (runs, seen_here) =
            (runs.enumerate()).find_map(|(n, run)| Some((n, run?))).expect("a core to publish on");
        repeated += runs;
        late += seen_here.check_responses();
        seen_here.check_order();
        for of in &seen_here.statistics {
            let i: usize = of.name[1..].parse().unwrap();
            assert!(seen.responses[i] * 1_000 <= of.bound_ns.unwrap(), "{}: the simulation is late", of.name);
        }
        for (thread, members) in seen_here.members.iter().enumerate() {
            let ceiling = model.ceiling(thread);
            let executor = &seen_here.executors[thread];
            let waits = ceiling.unwrap_or(group_priority(thread));
            assert_eq!(executor.fifo_priority, Some(u64::from(waits)));
            for job in &executor.jobs {
                let own = ceiling.map_or(waits, |_| model.callbacks[members[job.callback]].priority);
                assert_eq!(job.priority, u64::from(own), "of thread {thread}");
            }
            lowered += usize::from(ceiling.is_some());
            // A page of code may be read as it first runs, such as when a job is late.
            assert!(executor.faults <= 3, "{} page faults in {} jobs", executor.faults, executor.jobs.len());
            let simulated = seen.steps.iter().filter_map(|(_, step)| match step {
                Step::Begun { callback, .. } if members.contains(callback) => Some(*callback),
                _ => None,
            });
            alike += usize::from(simulated.zip(seen_here.order(thread)).all(|(one, other)| one == other));
            jobs += executor.jobs.len();
            threads += 1;
        }
    }
    println!(
        "{systems} systems, {jobs} jobs; {lowered} of {threads} threads have their callbacks' priorities, {alike} are all in the order of the simulation; {late} jobs late for something else; {repeated} runs repeated"
    );
}
