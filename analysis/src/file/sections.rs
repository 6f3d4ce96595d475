// SPDX-License-Identifier: MIT OR Apache-2.0
//! Reads the sections of the file: their keys, and the values allowed for each.
use super::content::{Client, Executor, JoinPolicy, LinkPriority, MOST_DEPTH, OverrunPolicy, ThreadPriority};
use super::declared::{Callback, Chain, Costs, Declared, Group, Host, Node, Policy, Topic};
use super::reader::{At, Section};
use crate::{LockProtocol, Order, Reservation};
use toml::de::DeValue;

pub(super) fn read(mut root: Section<'_>) -> Declared {
    let (mut policy, mut highest, mut protocol) =
        (Policy::RateMonotonic, 80, LockProtocol::PriorityInheritance);
    if let Some(mut section) = root.table("priorities") {
        let policies = [
            ("rate-monotonic", Policy::RateMonotonic),
            ("deadline-monotonic", Policy::DeadlineMonotonic),
            ("audsley", Policy::Audsley),
        ];
        policy = section.choice("policy", &policies).map_or(policy, |choice| choice.value);
        highest = priority(&mut section, "highest").map_or(highest, |highest| highest.value);
        let protocols =
            [("inheritance", LockProtocol::PriorityInheritance), ("ceiling", LockProtocol::PriorityCeiling)];
        protocol = section.choice("locks", &protocols).map_or(protocol, |choice| choice.value);
        section.finish();
    }
    let costs = costs(&mut root);
    let network = root.table("network").and_then(|mut section| {
        let latency = latency(&mut section);
        section.finish();
        latency
    });
    let hosts = root.tables("hosts", "host", host);
    let nodes = root.tables("nodes", "node", node);
    let topics = root.tables("topics", "topic", topic);
    let groups = root.tables("groups", "group", group);
    let callbacks = root.tables("callbacks", "callback", callback);
    let chains = root.array("chains").iter();
    let chains = chains.filter_map(|value| root.inner("chain".into(), value.span().start, value)).map(chain);
    let chains = chains.collect();
    root.finish();
    Declared { policy, highest, protocol, costs, network, hosts, nodes, topics, groups, callbacks, chains }
}

fn costs(section: &mut Section<'_>) -> Costs {
    let Some(mut table) = section.table("overheads") else { return Costs::default() };
    let mut time = |key| table.time(key).map(|time| time.value);
    let (context_switch, per_message, gateway) =
        (time("context_switch"), time("per_message"), time("gateway"));
    let (rclcpp, rclpy, demotion) = (time("rclcpp"), time("rclpy"), time("demotion"));
    let tick = pair(&mut table, "tick", ["period", "wcet"]);
    let throttling = pair(&mut table, "throttling", ["period", "runtime"]);
    if let (Some((_, 0)), Some(at)) = (throttling, table.at("throttling")) {
        table.problem(at).add(
            "`throttling` has a `runtime` of 0, with which no real-time thread runs: leave it out if the kernel sets no limit (-1)",
        );
    }
    table.finish();
    Costs { context_switch, per_message, gateway, rclcpp, rclpy, demotion, tick, throttling }
}

/// Reads a reservation that the kernel accepts: see sched_deadline_period_* in its documentation.
fn reservation(section: &mut Section<'_>) -> Option<At<Reservation>> {
    const RUNTIME_NS: u64 = 1_024;
    const PERIOD_NS: std::ops::RangeInclusive<u64> = 100_000..=4_194_304_000;
    let at = section.at("reservation")?;
    let (period_ns, runtime_ns) = pair(section, "reservation", ["period", "runtime"])?;
    if !PERIOD_NS.contains(&period_ns) || runtime_ns < RUNTIME_NS {
        section.problem(at).add(format!(
            "`reservation` of {} is out of range: the kernel takes a `period` of 100us to 4.194304s and a `runtime` of \
             1.024us at least",
            section.title
        ));
        return None;
    }
    Some(At { value: Reservation { runtime_ns, period_ns }, at })
}

/// A table of a period and a part of it.
fn pair(section: &mut Section<'_>, key: &'static str, keys: [&'static str; 2]) -> Option<(u64, u64)> {
    let mut table = section.table(key)?;
    let whole = table.positive_time(keys[0]);
    let part = table.time(keys[1]);
    if let (Some(whole), Some(part)) = (&whole, &part)
        && part.value > whole.value
    {
        section.problem(part.at).add(format!("`{}` of `{key}` exceeds its `{}`: lower it", keys[1], keys[0]));
    }
    for key_missing in keys.into_iter().filter(|name| !table.has(name)) {
        section.problem(table.at).add(format!("`{key}` lacks `{key_missing}`: add it"));
    }
    table.finish();
    Some((whole?.value, part?.value))
}

fn latency(section: &mut Section<'_>) -> Option<(u64, u64)> {
    let at = section.at("latency")?;
    let values = section.array("latency").iter();
    let times: Vec<_> = values.map(|value| section.time_of("latency", value)).collect();
    let times = times.into_iter().map(|time| Some(time?.value)).collect::<Option<Vec<_>>>()?;
    match times[..] {
        [least, most] if least <= most => Some((least, most)),
        _ => {
            section.problem(at).add("`latency` must be [shortest, longest], such as [\"0.2ms\", \"1ms\"]");
            None
        }
    }
}

/// The number of cores that Linux allows.
const MOST_CORES: usize = 4_096;

fn host(name: String, mut section: Section<'_>) -> Host {
    let cores = cores(&name, &mut section);
    let sampler_priority = priority(&mut section, "sampler_priority").map_or(90, |p| p.value);
    let stall = stall(&mut section);
    let unlisted = section.choice("unlisted", &[("warn", false), ("refuse", true)]);
    let refuses_unlisted = unlisted.is_some_and(|choice| choice.value);
    let costs = costs(&mut section);
    section.finish();
    Host { name, cores, costs, sampler_priority, stall, refuses_unlisted }
}

fn cores(name: &str, section: &mut Section<'_>) -> Vec<usize> {
    match section.raw("cores") {
        Some(DeValue::Array(values)) => {
            let mut cores = Vec::with_capacity(values.len());
            for At { value, at } in values.iter().filter_map(|value| section.integer_of("cores", value)) {
                match usize::try_from(value) {
                    Ok(core) if core < MOST_CORES && !cores.contains(&core) => cores.push(core),
                    _ => section.problem(at).add(format!(
                        "`cores` of host `{name}` lists {value}: list each core once, 0 to {}",
                        MOST_CORES - 1
                    )),
                }
            }
            if values.is_empty() {
                section
                    .problem(section.at)
                    .add(format!("`cores` of host `{name}` is empty: list at least one core"));
            }
            cores
        }
        Some(_) => {
            let Some(At { value, at }) = section.integer("cores") else { return Vec::new() };
            let count = usize::try_from(value).ok().filter(|count| (1..=MOST_CORES).contains(count));
            if count.is_none() {
                let fix = format!("set it to 1 to {MOST_CORES}, or list those to use");
                section.problem(at).add(format!("`cores` of host `{name}` is {value}: {fix}"));
            }
            (0..count.unwrap_or(0)).collect()
        }
        None => {
            let fix = "add their number, or the list of those to use";
            section.problem(section.at).add(format!("host `{name}` lacks `cores`: {fix}"));
            Vec::new()
        }
    }
}

/// Reads the longest stall. Queues are sized for at most 10 s: a longer stall is a machine that is off.
fn stall(section: &mut Section<'_>) -> u64 {
    const MOST_NS: u64 = 10_000_000_000;
    let Some(stall) = section.time("stall") else { return 0 };
    if stall.value > MOST_NS {
        section.problem(stall.at).add(format!(
            "`stall` of {} is {} s, out of range: set it to 10s at most, the longest time for which the machine may \
             stand still",
            section.title, stall.value as f64 / 1e9
        ));
    }
    stall.value
}

fn node(name: String, mut section: Section<'_>) -> Node {
    let (host, core) = (section.text("host"), section.integer("core"));
    let clients = [("tautline", Client::Tautline), ("rclcpp", Client::Rclcpp), ("rclpy", Client::Rclpy)];
    let client = section.choice("client", &clients).map_or(Client::Tautline, |choice| choice.value);
    let executor = section.choice("executor", &Executor::ALL.map(|executor| (executor.as_str(), executor)));
    if let (Client::Tautline, Some(executor)) = (client, &executor) {
        section.problem(executor.at).add(format!(
            "node `{name}` has an `executor`, but Tautline runs its callbacks: state its `client`, \"rclcpp\" or \"rclpy\", too, or leave \
             out `executor`"
        ));
    }
    let at = section.at;
    section.finish();
    Node { name, client, executor, host, core, at }
}

fn topic(name: String, mut section: Section<'_>) -> Topic {
    let type_name = section.text("type").map(|text| text.value);
    let is_auto = section.raw("depth").is_some_and(|depth| depth.as_str() == Some("auto"));
    let depth = if is_auto { None } else { section.integer("depth") };
    let depth = depth.and_then(|At { value, at }| {
        let depth = u64::try_from(value).ok().filter(|depth| (1..=MOST_DEPTH).contains(depth));
        if depth.is_none() {
            let fix = format!("set it to \"auto\", or to 1 to {MOST_DEPTH}");
            section.problem(at).add(format!("`depth` of topic `{name}` is {value}: {fix}"));
        }
        depth.map(|value| At { value, at })
    });
    let priorities = LinkPriority::ALL.map(|priority| (priority.as_str(), priority));
    let link_priority = section.choice("priority", &priorities).map(|priority| priority.value);
    let express = section.flag("express");
    if express && !section.has("priority") {
        section
            .problem(section.at)
            .add(format!("topic `{name}` is `express` without a `priority`: add one, such as \"real_time\""));
    }
    for key in ["jitter", "min_distance"] {
        if let Some(at) = section.at(key).filter(|_| !section.has("period")) {
            section.problem(at).add(format!(
                "`{key}` of topic `{name}` needs a `period`: without one a callback of the file publishes it, and it is computed"
            ));
        }
    }
    let topic = Topic {
        type_name,
        depth,
        is_auto,
        remote: section.flag("remote"),
        priority: link_priority,
        express,
        period: section.positive_time("period"),
        jitter: section.time("jitter").map_or(0, |jitter| jitter.value),
        min_distance: section.time("min_distance"),
        name,
    };
    section.finish();
    topic
}

fn group(name: String, mut section: Section<'_>) -> Group {
    let orders = [("fifo", Order::Fifo), ("any", Order::Any), ("priority", Order::Priority)];
    let order = section.choice("order", &orders);
    let priority = priority(&mut section, "priority");
    let thread_priorities = ThreadPriority::ALL.map(|priority| (priority.as_str(), priority));
    let thread_priority = section.choice("thread_priority", &thread_priorities);
    let (direct_wake, at) = (direct_wake(&mut section), section.at);
    section.finish();
    Group { name, at, order, priority, thread_priority, direct_wake }
}

fn callback(name: String, mut section: Section<'_>) -> Callback {
    let mut locks = Vec::new();
    for value in section.array("locks") {
        let title = format!("lock of callback `{name}`");
        let Some(mut lock) = section.inner(title, value.span().start, value) else { continue };
        let (resource, length) = (lock.text("resource"), lock.time("length"));
        for key in ["resource", "length"].into_iter().filter(|key| !lock.has(key)) {
            section.problem(lock.at).add(format!("a lock of callback `{name}` lacks `{key}`: add it"));
        }
        lock.finish();
        locks.extend(resource.zip(length).map(|(resource, length)| (resource.value, length.value)));
    }
    if !section.has("wcet") {
        section
            .problem(section.at)
            .add(format!("callback `{name}` lacks `wcet`: add its longest execution time"));
    }
    for key in ["topic", "all"] {
        if section.raw(key).and_then(DeValue::as_array).is_some_and(|topics| topics.is_empty()) {
            let at = section.at(key).unwrap_or(section.at);
            section
                .problem(at)
                .add(format!("`{key}` of callback `{name}` is empty: name a topic, or use `period`"));
        }
    }
    let (mut topics, together) = (section.texts("topic"), section.texts("all"));
    let all = section.has("all").then(|| together.first().map_or(section.at, |topic| topic.at));
    topics.extend(together);
    let overruns = OverrunPolicy::ALL.map(|policy| (policy.as_str(), policy));
    let overrun = section.choice("overrun", &overruns);
    let policies = JoinPolicy::NAMED.map(|policy| (policy.as_str(), policy));
    let policy = section.choice("policy", &policies);
    let is_any = |value: &&DeValue<'_>| value.as_str() == Some("any");
    let floats = section.raw("core").filter(is_any).and_then(|_| section.at("core"));
    let direct_wake = direct_wake(&mut section);
    let callback = Callback {
        reservation: reservation(&mut section),
        overrun,
        node: section.text("node"),
        topics,
        all,
        has_topic: section.has("topic"),
        window: section.time("window"),
        policy,
        take: section.positive_time("take"),
        period: section.positive_time("period"),
        triggered: section.has("topic") || section.has("all") || section.has("period"),
        wcet: section.positive_time("wcet"),
        input_max: input_max(&mut section),
        bcet: section.time("bcet"),
        deadline: section.positive_time("deadline"),
        jitter: section.time("jitter"),
        min_distance: section.time("min_distance"),
        non_preemptive: section.time("non_preemptive"),
        priority: priority(&mut section, "priority"),
        shares_priority: section.flag("shares_priority"),
        direct_wake,
        core: if floats.is_none() { section.integer("core") } else { None },
        floats,
        group: section.text("group"),
        publishes: section.texts("publishes"),
        reads: section.texts("reads"),
        locks,
        at: section.at,
        name,
    };
    section.finish();
    callback
}

fn direct_wake(section: &mut Section<'_>) -> Option<At<bool>> {
    let at = section.at("direct_wake")?;
    let value = section.optional_flag("direct_wake")?;
    if section.has("group") {
        section.problem(at).add(format!(
            "{} shares its thread: say `direct_wake` in [groups], of all of them",
            section.title
        ));
    }
    Some(At { value, at })
}

fn input_max(section: &mut Section<'_>) -> Option<u64> {
    let size = section.integer("input_max")?;
    let value = u64::try_from(size.value).ok().filter(|size| *size > 0);
    if value.is_none() {
        section.problem(size.at).add(format!(
            "`input_max` of {} is {}, out of range: set it to 1 or more, the greatest size that the callback states of \
             its input",
            section.title, size.value
        ));
    }
    value
}

fn chain(mut section: Section<'_>) -> Chain {
    let name = section.text("name");
    let name = name.map_or_else(|| "chain".into(), |name| name.value);
    section.title = format!("chain `{name}`");
    let path = section.texts("path");
    let deadline = section.positive_time("deadline").map(|deadline| deadline.value);
    for (key, what) in
        [("name", "its name"), ("path", "the callbacks it passes"), ("deadline", "its end-to-end deadline")]
    {
        if !section.has(key) {
            section.problem(section.at).add(format!("chain `{name}` lacks `{key}`: add {what}"));
        }
    }
    if section.raw("path").and_then(DeValue::as_array).is_some_and(|path| path.is_empty()) {
        let at = section.at("path").unwrap_or(section.at);
        section.problem(at).add(format!("`path` of chain `{name}` is empty: list the callbacks it passes"));
    }
    let at = section.at;
    section.finish();
    Chain { name, at, path, deadline }
}

fn priority(section: &mut Section<'_>, key: &'static str) -> Option<At<u8>> {
    let number = section.integer(key)?;
    let value = u8::try_from(number.value).ok().filter(|priority| (1..=99).contains(priority));
    if value.is_none() {
        let title = &section.title;
        section
            .problem(number.at)
            .add(format!("`{key}` of {title} is {}, out of range: set it to 1 (lowest) to 99", number.value));
    }
    Some(At { value: value?, at: number.at })
}
