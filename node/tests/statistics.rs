// SPDX-License-Identifier: MIT OR Apache-2.0
//! Statistics of a process with a system file can be read by others as long as it lives, and by no one after that.

mod common;

use std::path::PathBuf;

use common::{File, Log, Number, run_again, spin};
use futures::StreamExt;
use tautline::{CallbackGroup, Context, Node, Qos, Realtime};
use tautline_executor::{CallbackSnapshot, MomentKind, ProcessSnapshot};
use tautline_rt::clock;
use tautline_system::shared_statistics;

const DOMAIN: u32 = 166;
const KILLED: u32 = 167;
const ACCOUNTED: u32 = 95;

const SYSTEM: &str = r#"
[hosts.robot]
cores = 1
sampler_priority = 40
[overheads]
context_switch = "2us"
per_message = "30us"
[nodes.driver]
[topics]
scan = { period = "10ms" }
[groups.together]
[callbacks.scan]
topic = "scan"
wcet = "4ms"
[callbacks.tick]
period = "20ms"
wcet = "1ms"
group = "together"
[callbacks.tock]
topic = "scan"
wcet = "1ms"
group = "together"
"#;

fn context(domain: u32, name: &str) -> (Context, PathBuf) {
    let file = File::new(name, SYSTEM);
    let context = Context::builder().domain(domain).realtime(Realtime::Off).system(&file.0).build().unwrap();
    (context, file.0.clone())
}

fn snapshots(domain: u32) -> Vec<ProcessSnapshot> {
    let (processes, _) = shared_statistics(domain).unwrap();
    processes.iter().filter_map(|process| process.read().unwrap()).collect()
}

fn find<'s>(snapshot: &'s ProcessSnapshot, name: &str) -> &'s CallbackSnapshot {
    snapshot.callbacks.iter().find(|callback| callback.name == name).unwrap()
}

#[test]
fn what_callbacks_do_is_seen_from_outside() {
    static DONE: Log<u64> = Log::new();
    let (context, path) = context(DOMAIN, "outside");
    let mut node = Node::create(context.clone(), "driver", "").unwrap();
    let numbers = node.subscribe::<Number>("/n", Qos::keep_last(2)).unwrap();
    let also = node.subscribe::<Number>("/n", Qos::keep_last(3)).unwrap();
    let publisher = node.create_publisher::<Number>("/n", Qos::default()).unwrap();
    let first_ns = clock::monotonic_ns();
    for value in 0..5 {
        let mut loan = publisher.loan().unwrap();
        loan.value = value;
        loan.publish_released_at(first_ns + 7_000 * value).unwrap();
    }

    let scan = context.callback("scan").unwrap();
    assert_eq!(scan.budget.unwrap().as_micros(), 4_034, "wcet, two context switches, one message");
    let scan =
        node.spawn_callback(scan, numbers.for_each(|number| async move { DONE.add(number.value) })).unwrap();
    let mut group = CallbackGroup::new();
    group.add(
        context.callback("tock").unwrap(),
        also,
        |number| number.info().released_ns,
        |number| {
            DONE.add(number.value);
            async {}
        },
    );
    let together = node.spawn_group(context.group("together").unwrap(), group).unwrap();
    assert_eq!(together.thread().name, "cb:together");
    let _spinning = spin(&context);
    DONE.wait_for(5);
    scan.stop();
    scan.clone().join().unwrap();
    together.stop();
    together.clone().join().unwrap();

    let snapshots = snapshots(DOMAIN);
    let [snapshot] = snapshots.as_slice() else { panic!("{snapshots:?}") };
    let about = &snapshot.process;
    assert_eq!((about.pid, about.host.as_str(), about.realtime), (std::process::id(), "robot", false));
    assert_eq!((&about.system_path, about.sampler_priority), (&path, Some(40)));
    let file = tautline_analysis::file::SystemFile::parse(SYSTEM).unwrap();
    assert_eq!(about.system_hash, file.fingerprint());

    let callback = find(snapshot, "scan");
    assert_eq!(Some(callback), CallbackSnapshot::of(scan.stats()).as_ref());
    assert_eq!((callback.releases, callback.lost, callback.max_queue, callback.depth), (2, 3, 2, 2));
    assert_eq!((callback.least_distance_ns, callback.first_release_ns), (Some(7_000), first_ns + 21_000));
    assert_eq!((callback.period_ns, callback.budget_ns), (Some(10_000_000), Some(4_034_000)));
    assert!(callback.ended && !callback.is_group && callback.measures_execution);
    assert_eq!((callback.tid, callback.core), (scan.thread().tid, Some(0)));
    let member = find(snapshot, "tock");
    assert_eq!((member.releases, member.lost, member.max_queue, member.depth), (3, 2, 3, 3));
    assert!(find(snapshot, "together").is_group && member.tid == together.thread().tid);

    let (files, killed) = shared_statistics(DOMAIN).unwrap();
    assert_eq!((files.len(), killed), (1, 0));
    drop((node, context, _spinning));
    assert!(!files[0].is_running() && !files[0].path().exists());
    assert_eq!(
        find(&files[0].read().unwrap().unwrap(), "scan").releases,
        2,
        "who looked before sees it still"
    );
    assert_eq!(scan.stats().releases(), 2);
}

/// Each job beyond the bound of the file is there with its instants, beside what was taken from its core.
#[test]
fn late_jobs_are_kept_with_their_instants() {
    static DONE: Log<u64> = Log::new();
    let file = File::new("accounted", SYSTEM);
    let builder = Context::builder().domain(ACCOUNTED).realtime(Realtime::Off).system(&file.0);
    let context = builder.account_core_time(Some(std::time::Duration::from_millis(1))).build().unwrap();
    drop(file);
    let mut node = Node::create(context.clone(), "driver", "").unwrap();
    let numbers = node.subscribe::<Number>("/n", Qos::keep_last(2)).unwrap();
    let publisher = node.create_publisher::<Number>("/n", Qos::default()).unwrap();
    // An hour ago, and not yet.
    let (hour_ns, now_ns) = (3_600_000_000_000, clock::monotonic_ns());
    let releases = [now_ns.saturating_sub(hour_ns), now_ns + hour_ns];
    for (value, released_ns) in releases.into_iter().enumerate() {
        let mut loan = publisher.loan().unwrap();
        loan.value = value as u64;
        loan.publish_released_at(released_ns).unwrap();
    }
    let options = context.callback("scan").unwrap();
    let bound = options.bound.unwrap();
    assert!(bound > options.budget.unwrap(), "{bound:?}");
    let scan = node
        .spawn_callback(options, numbers.for_each(|number| async move { DONE.add(number.value) }))
        .unwrap();
    let _spinning = spin(&context);
    DONE.wait_for(2);
    scan.stop();
    scan.clone().join().unwrap();
    let snapshot = &snapshots(ACCOUNTED)[0];
    let seen = find(snapshot, "scan");
    assert_eq!((seen.bound_ns, seen.accounts_core_time), (Some(bound.as_nanos() as u64), true));
    let sampler = snapshot.sampler.as_ref().expect("it is accounted for, too");
    assert_eq!((sampler.name.as_str(), sampler.accounts_core_time), ("sampler", true));
    assert!(snapshot.callbacks.iter().all(|callback| callback.name != "sampler"), "it is no callback");
    let late: Vec<_> = seen.moments.iter().filter(|moment| moment.kind == MomentKind::Late).collect();
    let [late] = late.as_slice() else { panic!("{late:?}") };
    assert_eq!((late.from_ns, late.length_ns), (releases[0], late.to_ns - late.from_ns));
    assert_eq!(u128::from(late.length_ns), seen.response.max().as_nanos());
    // It was there before the callback was: that is no wait for the core.
    let mut waited = seen.moments.iter().filter(|moment| moment.kind == MomentKind::Waited);
    assert!(waited.all(|wait| wait.from_ns > now_ns), "{:?}", seen.moments);
}

#[test]
fn a_killed_process_leaves_nothing_for_long() {
    let Some(output) = run_again("a_killed_process_leaves_nothing_for_long", &[]) else {
        let (_context, _) = context(KILLED, "killed");
        assert_eq!(snapshots(KILLED).len(), 1);
        std::process::abort();
    };
    assert_eq!(std::os::unix::process::ExitStatusExt::signal(&output.status), Some(6), "{output:?}");
    let (files, killed) = shared_statistics(KILLED).unwrap();
    assert_eq!((files.len(), killed), (0, 1));
    assert_eq!(shared_statistics(KILLED).unwrap().1, 0);
    // Removes what else the child left.
    drop(Context::builder().domain(KILLED).realtime(Realtime::Off).build().unwrap());
}
