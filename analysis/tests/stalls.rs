// SPDX-License-Identifier: MIT OR Apache-2.0
//! Queues that outlast a stall: hand-computed cases, what is wrong with a file, and random systems on simulated cores, each of which
//! stops once, in which no queue overflows. Joins are in joins.rs.

use std::fmt::Write;
use std::ops::Range;

use rand::{RngExt, SeedableRng, rngs::StdRng};
use tautline_analysis::Order;
use tautline_analysis::file::admission::{Machine, Share};
use tautline_analysis::file::{CheckedSystem, SystemFile};

fn check(text: &str) -> CheckedSystem {
    SystemFile::parse(text).unwrap_or_else(|problems| panic!("{problems}\n{text}")).check()
}

/// Of each callback, with and without stalls.
fn capacities(text: &str) -> Vec<(usize, usize)> {
    let checked = check(text);
    let of = |with: Option<usize>, without: Option<usize>| (with.unwrap(), without.unwrap());
    checked.callbacks.iter().map(|c| of(c.capacity, c.capacity_without_stall)).collect()
}

const LIDAR: &str = "[hosts.robot]\ncores = 1\nstall = \"50ms\"\n[nodes.n]\n[topics]\n\"/scan\" = { period = \"20ms\" }\n\
                     [callbacks.scan]\ntopic = \"/scan\"\nwcet = \"12ms\"\n";

#[test]
fn a_queue_holds_what_comes_while_its_core_stands_still() {
    // 50 + 12 ms after the first message the fourth has come.
    assert_eq!(capacities(LIDAR), [(4, 1)]);
    assert_eq!(capacities(&LIDAR.replace("stall = \"50ms\"\n", "")), [(1, 1)]);
    assert_eq!(capacities(&LIDAR.replace("50ms", "0ms")), [(1, 1)]);
    // Neither bounds nor verdicts contain it.
    let scan = check(LIDAR);
    assert_eq!((scan.schedulable, scan.callbacks[0].response_overhead_ns), (true, Some(12_000_000)));
    assert_eq!((scan.cores[0].stall_ns, scan.cores[0].overheads), (50_000_000, Default::default()));
    // A depth that the file states is held against it.
    let stated = check(&LIDAR.replace("{ period", "{ depth = 2, period"));
    assert!(
        stated.warnings.iter().any(|warning| warning.contains("needs a queue of 4, but its topic keeps 2"))
    );
}

#[test]
fn what_piled_up_above_goes_first() {
    let timer = "[callbacks.timer]\nperiod = \"10ms\"\nwcet = \"5ms\"\npriority = 9\n";
    let low = "[callbacks.scan]\npriority = 1\n";
    let text =
        LIDAR.replace("20ms", "10ms").replace("12ms", "1ms").replace("[callbacks.scan]\n", low) + timer;
    // Not 50 + 6 ms: 50 + 1 ms and eleven runs of the timer, which has half of the core, take 106.
    assert_eq!(capacities(&text)[0], (11, 1));
}

#[test]
fn messages_bunch_while_the_publisher_stands_still() {
    let text = |hosts: &str, nodes: [&str; 2]| {
        let [driver, control] = nodes;
        format!(
            "{hosts}[network]\nlatency = [\"1ms\", \"1ms\"]\n[nodes.driver]\n{driver}\n[nodes.control]\n{control}\n\
             [topics]\n\"/scan\" = {{ remote = true }}\n\
             [callbacks.scan]\nnode = \"driver\"\nperiod = \"20ms\"\nwcet = \"1ms\"\npublishes = \"/scan\"\n\
             [callbacks.plan]\nnode = \"control\"\ntopic = \"/scan\"\nwcet = \"1ms\"\n"
        )
    };
    let robot = "[hosts.robot]\ncores = 2\nstall = \"50ms\"\n";
    // A message comes up to 51 ms late, and waits up to 51 ms: one core may stand still after the other.
    let two_cores = text(robot, ["core = 0", "core = 1"]);
    assert_eq!(capacities(&two_cores), [(3, 1), (6, 1)]);
    // A core that stands still after it has caught up delays both again; the publisher's backlog goes first.
    let one_core = text(robot, ["core = 0", "core = 0"]);
    assert_eq!(capacities(&one_core), [(3, 1), (6, 1)]);
    // Between hosts, the gateways may stand still besides: 51 + 50 + 20 late, 21 waiting.
    let hosts = "[hosts.robot]\ncores = 1\nstall = \"50ms\"\n[hosts.pc]\ncores = 1\nstall = \"20ms\"\n";
    let two_hosts = text(hosts, ["host = \"robot\"", "host = \"pc\""]);
    assert_eq!(capacities(&two_hosts), [(3, 1), (8, 1)]);
    // Only what a stall reaches is deeper.
    let steady = text(&hosts.replace("stall = \"50ms\"\n", ""), ["host = \"robot\"", "host = \"pc\""]);
    assert_eq!(capacities(&steady), [(1, 1), (3, 1)]);
}

#[test]
fn what_comes_from_a_host_outside_passes_this_ones_gateway() {
    // It may come 50 ms late, at once with two others, and wait for 50 ms and theirs: 86 after 50.
    let text = LIDAR.replace("{ period", "{ remote = true, period");
    assert_eq!(capacities(&text), [(7, 1)]);
}

#[test]
fn a_sampler_on_another_core_may_stand_still_first() {
    let [period, cores] = [("20ms", "1ms"), ("cores = 1", "cores = 2")];
    let text = LIDAR.replace(period.0, period.1).replace(cores.0, cores.1).replace("12ms", "0.1ms");
    let other = "[callbacks.timer]\nperiod = \"10ms\"\nwcet = \"0.1ms\"\n";
    let on = |core: usize| format!("{text}core = 0\n{other}core = {core}\n");
    // Beside it, the timer may run before it; on another core, its sampler may stand still before it does.
    assert!((51..=57).contains(&capacities(&on(0))[0].0), "{:?}", capacities(&on(0)));
    assert!((101..=112).contains(&capacities(&on(1))[0].0), "{:?}", capacities(&on(1)));
}

#[test]
fn a_thread_of_several_callbacks_and_a_join_have_deeper_queues() {
    let group = "[hosts.robot]\ncores = 1\nSTALL[nodes.n]\n[groups.g]\n[topics]\n\"/a\" = { period = \"10ms\" }\n\"/b\" = { period = \"30ms\" }\n\
                 [callbacks.a]\ntopic = \"/a\"\nwcet = \"1ms\"\ngroup = \"g\"\n\
                 [callbacks.b]\ntopic = \"/b\"\nwcet = \"2ms\"\ngroup = \"g\"\n";
    // 50 ms and one job of each.
    assert_eq!(capacities(&group.replace("STALL", "stall = \"50ms\"\n")), [(6, 1), (2, 1)]);
    let join = "[hosts.robot]\ncores = 1\nSTALL[nodes.n]\n[topics]\n\"/a\" = { period = \"10ms\" }\n\"/b\" = { period = \"30ms\" }\n\
                [callbacks.fuse]\nall = [\"/a\", \"/b\"]\nwindow = \"30ms\"\nwcet = \"2ms\"\n";
    let (still, steady) =
        (check(&join.replace("STALL", "stall = \"50ms\"\n")), check(&join.replace("STALL", "")));
    let (still, steady) = (&still.callbacks[0], &steady.callbacks[0]);
    assert_eq!(still.capacity_without_stall, steady.capacity);
    assert!(still.capacity >= Some(6) && steady.capacity == Some(1), "{still:?}");
    let (still, steady) = (still.join.as_ref().unwrap(), steady.join.as_ref().unwrap());
    assert_eq!(still.inputs, steady.inputs);
    assert!(still.queue_size >= steady.queue_size + 5, "{still:?}, {steady:?}");
}

#[test]
fn a_stall_of_many_periods_is_bounded() {
    let mut text = LIDAR.replace("20ms", "1ms").replace("12ms", "10us") + "publishes = \"/0\"\n";
    for stage in 1..=4 {
        let next = stage - 1;
        writeln!(
            text,
            "[callbacks.c{stage}]\ntopic = \"/{next}\"\nwcet = \"10us\"\npublishes = \"/{stage}\""
        )
        .unwrap();
    }
    let found = capacities(&text);
    assert!(found.iter().all(|(with, without)| (51..400).contains(with) && *without == 1), "{found:?}");
}

#[test]
fn files_of_one_machine_have_its_longest_stall() {
    let (short, long) = (LIDAR.replace("50ms", "30ms"), LIDAR.replace("robot", "pc").replace("scan", "map"));
    let files = [short, long].map(|text| SystemFile::parse(&text).unwrap());
    let mut machine = Machine::default();
    for (file, host) in files.iter().zip(["robot", "pc"]) {
        machine.add_file(Share { file, host, label: host });
    }
    let checked = machine.check();
    assert_eq!(checked.cores.iter().map(|core| core.stall_ns).collect::<Vec<_>>(), [50_000_000]);
    assert_eq!(checked.callbacks.len(), 2);
}

#[test]
fn what_is_wrong_with_a_stall_is_said_with_its_line() {
    for (wrong, what) in [
        ("\"-5ms\"", "`stall` is not a time: \"-5ms\"; write one such as \"1.5ms\""),
        ("\"50\"", "`stall` is not a time: \"50\""),
        ("50", "`stall` must be a time with its unit, such as \"1.5ms\", not a number"),
        ("\"99999999999999999999s\"", "`stall` is not a time"),
        ("\"50s\"", "`stall` of host `robot` is 50 s, out of range: set it to 10s at most"),
    ] {
        let problems = SystemFile::parse(&LIDAR.replace("\"50ms\"", wrong)).unwrap_err().to_string();
        assert!(problems.starts_with("3:9: ") && problems.contains(what), "{problems}");
    }
    assert!(SystemFile::parse(&LIDAR.replace("50ms", "10s")).is_ok());
}

/// Two cores of one host, in half of the files one of another; chains of callbacks over all of them, some in one thread.
fn random_file(rng: &mut StdRng) -> String {
    let two_hosts = rng.random_bool(0.5);
    let mut text = String::new();
    for host in if two_hosts { &["a", "b"][..] } else { &["a"] } {
        let stall = rng.random_range(1..=120);
        writeln!(text, "[hosts.{host}]\ncores = 2\nstall = \"{stall}ns\"").unwrap();
    }
    let (least, more) = (rng.random_range(0..=9), rng.random_range(0..=20));
    writeln!(text, "[network]\nlatency = [\"{least}ns\", \"{}ns\"]", least + more).unwrap();
    let nodes = if two_hosts { 4 } else { 2 };
    for node in 0..nodes {
        let host = if node < 2 { "a" } else { "b" };
        writeln!(text, "[nodes.n{node}]\nhost = \"{host}\"\ncore = {}", node % 2).unwrap();
    }
    let (mut callbacks, mut topics) = (String::new(), Vec::new());
    for chain in 0..rng.random_range(2..=4) {
        let period = rng.random_range(20..=150);
        let mut last = None;
        for stage in 0..rng.random_range(1..=4) {
            let (node, name) = (rng.random_range(0..nodes), format!("c{chain}_{stage}"));
            let wcet = rng.random_range(1..=period / 7);
            let bcet = rng.random_range(0..=wcet);
            let jitter = rng.random_range(0..=period);
            writeln!(
                callbacks,
                "[callbacks.{name}]\nnode = \"n{node}\"\nwcet = \"{wcet}ns\"\nbcet = \"{bcet}ns\""
            )
            .unwrap();
            match &last {
                // In some cases with messages of another chain.
                Some(topic) if rng.random_bool(0.1) && !topics.is_empty() => {
                    let other: &String = &topics[rng.random_range(0..topics.len())];
                    writeln!(callbacks, "topic = [\"{topic}\", \"{other}\"]").unwrap();
                }
                Some(topic) => writeln!(callbacks, "topic = \"{topic}\"").unwrap(),
                None if rng.random_bool(0.5) => {
                    writeln!(
                        text,
                        "[topics.\"/in{chain}\"]\nperiod = \"{period}ns\"\njitter = \"{jitter}ns\""
                    )
                    .unwrap();
                    writeln!(callbacks, "topic = \"/in{chain}\"").unwrap();
                }
                None => writeln!(callbacks, "period = \"{period}ns\"\njitter = \"{jitter}ns\"").unwrap(),
            }
            if rng.random_bool(0.3) {
                writeln!(callbacks, "group = \"g{node}\"").unwrap();
            }
            let topic = format!("/{name}");
            writeln!(callbacks, "publishes = \"{topic}\"").unwrap();
            writeln!(text, "[topics.\"{topic}\"]\nremote = true").unwrap();
            last = Some(topic);
        }
        topics.extend(last);
    }
    for node in (0..nodes).filter(|node| callbacks.contains(&format!("group = \"g{node}\""))) {
        let order = if rng.random_bool(0.5) { "fifo" } else { "any" };
        writeln!(text, "[groups.g{node}]\norder = \"{order}\"").unwrap();
    }
    text + &callbacks
}

struct Job {
    task: usize,
    arrival: i64,
    work: i64,
    begun: bool,
}

/// Each core and each gateway stops once, for as long as its host may stall, at about the same time.
struct Stops {
    cores: Vec<Range<i64>>,
    /// Of each core's host.
    gateways: Vec<Range<i64>>,
}

impl Stops {
    fn new(file: &SystemFile, rng: &mut StdRng) -> Stops {
        let mut next = rng.random_range(200..800);
        let mut stop = |stall: u64| {
            // After the last one, or at any time about then.
            let from = if rng.random_bool(0.5) { next } else { rng.random_range(next - 150..next + 150) };
            next = from + stall as i64;
            from..next
        };
        let cores: Vec<_> = file.cores().iter().map(|core| stop(core.stall_ns)).collect();
        let mut gateways: Vec<Range<i64>> = Vec::new();
        for (i, core) in file.cores().iter().enumerate() {
            let same = file.cores()[..i].iter().position(|other| other.host == core.host);
            gateways.push(same.map_or_else(|| stop(core.stall_ns), |same| gateways[same].clone()));
        }
        Stops { cores, gateways }
    }

    /// When a gateway passes on what comes at `at`.
    fn passed(&self, core: usize, at: i64) -> i64 {
        let stop = &self.gateways[core];
        if stop.contains(&at) { stop.end } else { at }
    }
}

/// How many messages of each task were there at once, the one it works on included.
fn simulate(file: &SystemFile, rng: &mut StdRng) -> Vec<usize> {
    const UNTIL: i64 = 2_500;
    let (system, stops) = (file.system(), Stops::new(file, rng));
    let work = |task: usize, rng: &mut StdRng| {
        let task = &system.callbacks[task].task;
        let longest = rng.random_bool(0.7);
        if longest { task.wcet_ns } else { rng.random_range(task.bcet_ns.max(1)..=task.wcet_ns) }
    };
    let mut pending: Vec<Job> = Vec::new();
    for (task, callback) in system.callbacks.iter().enumerate().filter(|(_, c)| !c.is_triggered()) {
        let (period, jitter) = (callback.task.period_ns as i64, callback.task.jitter_ns as i64);
        let (mut nominal, mut last, late) = (rng.random_range(0..=period), 0, rng.random_bool(0.5));
        while nominal < UNTIL {
            // All as late as they can come until some point, then early: bursts.
            let delay = if late && nominal < UNTIL / 5 { jitter } else { rng.random_range(0..=jitter) };
            last = last.max(nominal + delay);
            pending.push(Job { task, arrival: last, work: work(task, rng) as i64, begun: false });
            nominal += period;
        }
    }
    let edges: Vec<i64> = stops.cores.iter().flat_map(|stop| [stop.start, stop.end]).collect();
    let mut most = vec![0; system.callbacks.len()];
    let mut waiting = most.clone();
    let mut delivered = vec![0; system.callbacks.len()];
    let mut ready: Vec<Job> = Vec::new();
    let mut now = 0;
    while !(pending.is_empty() && ready.is_empty()) {
        let arrived = pending.extract_if(.., |job| job.arrival <= now);
        for job in arrived {
            waiting[job.task] += 1;
            most[job.task] = waiting[job.task].max(most[job.task]);
            ready.push(job);
        }
        let running: Vec<usize> = (0..system.cores.len())
            .filter(|core| !stops.cores[*core].contains(&now))
            .filter_map(|core| {
                let here = (0..ready.len()).filter(|job| system.callbacks[ready[*job].task].core == core);
                // A thread in any order serves one task before the other.
                let rank = |job: &usize| {
                    let Job { task, arrival, begun, .. } = ready[*job];
                    let of = &system.callbacks[task].task;
                    let any = of.group.is_some_and(|group| group.order == Order::Any);
                    (of.priority, begun && of.group.is_some(), if any { task } else { 0 }, -arrival)
                };
                here.rev().max_by_key(rank)
            })
            .collect();
        let works = running.iter().map(|job| now + ready[*job].work);
        let arrivals = pending.iter().map(|job| job.arrival);
        let edges = edges.iter().copied().filter(|edge| *edge > now);
        let Some(next) = works.chain(arrivals).chain(edges).min() else { break };
        for job in running {
            ready[job].work -= next - now;
            ready[job].begun = true;
        }
        now = next;
        for job in ready.extract_if(.., |job| job.work == 0) {
            waiting[job.task] -= 1;
            let from = system.callbacks[job.task].core;
            for (task, callback) in system.callbacks.iter().enumerate() {
                let Some((_, way)) = callback.trigger.filter(|(source, _)| *source == job.task) else {
                    continue;
                };
                let latency = rng.random_range(way.least_ns..=way.most_ns) as i64;
                let arrival = match file.cores()[from].host == file.cores()[callback.core].host {
                    true => now + latency,
                    false => stops.passed(callback.core, stops.passed(from, now) + latency),
                };
                delivered[task] = arrival.max(delivered[task]);
                pending.push(Job {
                    task,
                    arrival: delivered[task],
                    work: work(task, rng) as i64,
                    begun: false,
                });
            }
        }
    }
    most
}

#[test]
fn no_queue_overflows_when_cores_stand_still() {
    let seed = tautline_seed::seed();
    let count = std::env::var("SYSTEMS").ok().and_then(|count| count.parse().ok()).unwrap_or(3_000);
    let mut rng = StdRng::seed_from_u64(seed);
    let (mut checked, mut full, mut deeper, mut unbounded) = (0, 0, 0, 0);
    for round in 0..count {
        let text = random_file(&mut rng);
        let file = SystemFile::parse(&text).unwrap_or_else(|problems| panic!("{problems}\n{text}"));
        let verdict = file.check();
        let most = simulate(&file, &mut rng);
        for callback in &verdict.callbacks {
            let name = &callback.entry.name;
            let Some(without) = callback.capacity_without_stall else { continue };
            let Some(capacity) = callback.capacity else {
                let what = format!("callback `{name}` has no capacity");
                assert!(verdict.warnings.iter().any(|warning| warning.starts_with(&what)), "{text}");
                unbounded += 1;
                continue;
            };
            let seen: usize = most[callback.entry.tasks.clone()].iter().sum();
            assert!(seen <= capacity, "seed {seed}, system {round}, {name}: {seen} > {capacity}:\n{text}");
            checked += 1;
            full += usize::from(seen == capacity);
            deeper += usize::from(seen > without);
        }
        let running: Vec<&str> = text.lines().filter(|line| !line.starts_with("stall")).collect();
        let running = check(&running.join("\n"));
        assert_eq!((running.schedulable, &running.chains), (verdict.schedulable, &verdict.chains));
        for (a, b) in running.callbacks.iter().zip(&verdict.callbacks) {
            assert_eq!(
                (a.response_ns, a.response_overhead_ns, a.met),
                (b.response_ns, b.response_overhead_ns, b.met)
            );
            assert_eq!(a.capacity, b.capacity_without_stall);
            assert!(b.capacity.is_none() || a.capacity <= b.capacity);
        }
    }
    println!(
        "{checked} queues: {full} were full, {deeper} needed more than without stalls; {unbounded} have no bound"
    );
    assert!(checked > count && full > checked / 100 && deeper > checked / 10);
}
