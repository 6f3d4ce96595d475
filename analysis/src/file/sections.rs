// SPDX-License-Identifier: MIT OR Apache-2.0
//! Reads the sections of the file: their keys, and the values allowed for each.
use super::declared::{Callback, Chain, Costs, Declared, Group, Host, Node, Policy, Topic};
use super::problem::Collector;
use super::reader::{At, Section, integer, time};
use super::{Client, JoinPolicy, LinkPriority, OverrunPolicy};
use crate::{LockProtocol, Order, Reservation};
use toml::de::DeValue;

pub(super) fn read(mut root: Section<'_>, problems: &mut Collector) -> Declared {
    let (mut policy, mut highest, mut protocol) =
        (Policy::RateMonotonic, 80, LockProtocol::PriorityInheritance);
    if let Some(mut section) = root.table("priorities", problems) {
        let policies = [
            ("rate-monotonic", Policy::RateMonotonic),
            ("deadline-monotonic", Policy::DeadlineMonotonic),
            ("audsley", Policy::Audsley),
        ];
        policy = choice(&mut section, "policy", &policies, problems).unwrap_or(policy);
        highest = priority(&mut section, "highest", problems).map_or(highest, |highest| highest.value);
        let protocols =
            [("inheritance", LockProtocol::PriorityInheritance), ("ceiling", LockProtocol::PriorityCeiling)];
        protocol = choice(&mut section, "locks", &protocols, problems).unwrap_or(protocol);
        section.finish(problems);
    }
    let costs = costs(&mut root, problems);
    let network = root.table("network", problems).and_then(|mut section| {
        let latency = latency(&mut section, problems);
        section.finish(problems);
        latency
    });
    let hosts =
        root.tables("hosts", "host", problems).into_iter().map(|(n, s)| host(n, s, problems)).collect();
    let nodes =
        root.tables("nodes", "node", problems).into_iter().map(|(n, s)| node(n, s, problems)).collect();
    let topics =
        root.tables("topics", "topic", problems).into_iter().map(|(n, s)| topic(n, s, problems)).collect();
    let groups =
        root.tables("groups", "group", problems).into_iter().map(|(n, s)| group(n, s, problems)).collect();
    let callbacks = root.tables("callbacks", "callback", problems);
    let callbacks = callbacks.into_iter().map(|(n, s)| callback(n, s, problems)).collect();
    let mut chains = Vec::new();
    for value in root.array("chains", problems) {
        let section = Section::of("chain".into(), value.span().start, value, problems);
        chains.extend(section.map(|section| chain(section, problems)));
    }
    root.finish(problems);
    Declared { policy, highest, protocol, costs, network, hosts, nodes, topics, groups, callbacks, chains }
}

fn costs(section: &mut Section<'_>, problems: &mut Collector) -> Costs {
    let Some(mut table) = section.table("overheads", problems) else { return Costs::default() };
    let mut time = |key| table.time(key, problems).map(|time| time.value);
    let (context_switch, per_message, gateway) =
        (time("context_switch"), time("per_message"), time("gateway"));
    let (rclcpp, rclpy, demotion) = (time("rclcpp"), time("rclpy"), time("demotion"));
    let tick = pair(&mut table, "tick", ["period", "wcet"], problems);
    let throttling = pair(&mut table, "throttling", ["period", "runtime"], problems);
    table.finish(problems);
    Costs { context_switch, per_message, gateway, rclcpp, rclpy, demotion, tick, throttling }
}

/// What the kernel takes: see sched_deadline_period_* in its documentation.
fn reservation(section: &mut Section<'_>, problems: &mut Collector) -> Option<At<Reservation>> {
    const RUNTIME_NS: u64 = 1_024;
    const PERIOD_NS: std::ops::RangeInclusive<u64> = 100_000..=4_194_304_000;
    let at = section.raw("reservation")?.span().start;
    let (period_ns, runtime_ns) = pair(section, "reservation", ["period", "runtime"], problems)?;
    if !PERIOD_NS.contains(&period_ns) || runtime_ns < RUNTIME_NS {
        let message = format!(
            "`reservation` of {} is out of range: the kernel takes a `period` of 100us to 4.194304s and a `runtime` of 1.024us at least",
            section.title
        );
        problems.add(at, message);
        return None;
    }
    Some(At { value: Reservation { runtime_ns, period_ns }, at })
}

/// A table of a period and a part of it.
fn pair(
    section: &mut Section<'_>,
    key: &'static str,
    keys: [&'static str; 2],
    problems: &mut Collector,
) -> Option<(u64, u64)> {
    let mut table = section.table(key, problems)?;
    let whole = table.positive_time(keys[0], problems);
    let part = table.time(keys[1], problems);
    if let (Some(whole), Some(part)) = (&whole, &part)
        && part.value > whole.value
    {
        problems.add(part.at, format!("`{}` of `{key}` exceeds its `{}`: lower it", keys[1], keys[0]));
    }
    for key_missing in keys.into_iter().filter(|name| !table.has(name)) {
        problems.add(table.at, format!("`{key}` lacks `{key_missing}`: add it"));
    }
    table.finish(problems);
    Some((whole?.value, part?.value))
}

fn latency(section: &mut Section<'_>, problems: &mut Collector) -> Option<(u64, u64)> {
    let at = section.raw("latency")?.span().start;
    let times: Vec<_> = section.array("latency", problems).into_iter().collect();
    let count = times.len();
    let times: Vec<_> = times.into_iter().filter_map(|value| time("latency", value, problems)).collect();
    match times[..] {
        [ref least, ref most] if least.value <= most.value => Some((least.value, most.value)),
        _ => {
            if times.len() == count {
                problems.add(at, "`latency` must be [shortest, longest], such as [\"0.2ms\", \"1ms\"]");
            }
            None
        }
    }
}

/// As many as Linux allows.
const MOST_CORES: usize = 4_096;

fn host(name: String, mut section: Section<'_>, problems: &mut Collector) -> Host {
    let cores = match section.raw("cores").map(|value| (value, value.get_ref())) {
        Some((_, toml::de::DeValue::Array(_))) => {
            let values = section.array("cores", problems);
            let numbers: Vec<_> =
                values.into_iter().filter_map(|value| integer("cores", value, problems)).collect();
            let mut cores = Vec::with_capacity(numbers.len());
            for number in numbers {
                let core = usize::try_from(number.value)
                    .ok()
                    .filter(|core| *core < MOST_CORES && !cores.contains(core));
                if core.is_none() {
                    problems.add(
                        number.at,
                        format!(
                            "`cores` of host `{name}` lists {}: list each core once, 0 to {}",
                            number.value,
                            MOST_CORES - 1
                        ),
                    );
                }
                cores.extend(core);
            }
            if section
                .raw("cores")
                .is_some_and(|value| matches!(value.get_ref(), DeValue::Array(array) if array.is_empty()))
            {
                problems
                    .add(section.at, format!("`cores` of host `{name}` is empty: list at least one core"));
            }
            cores
        }
        Some((value, _)) => {
            let count = integer("cores", value, problems);
            let known = count.as_ref().and_then(|count| usize::try_from(count.value).ok());
            let known = known.filter(|count| (1..=MOST_CORES).contains(count));
            if let (Some(count), None) = (&count, known) {
                problems.add(
                    count.at,
                    format!(
                        "`cores` of host `{name}` is {}: set it to 1 to {MOST_CORES}, or list those to use",
                        count.value
                    ),
                );
            }
            (0..known.unwrap_or(0)).collect()
        }
        None => {
            problems.add(
                section.at,
                format!("host `{name}` lacks `cores`: add their number, or the list of those to use"),
            );
            Vec::new()
        }
    };
    let sampler_priority = priority(&mut section, "sampler_priority", problems).map_or(90, |p| p.value);
    let stall = stall(&mut section, problems);
    let costs = costs(&mut section, problems);
    section.finish(problems);
    Host { name, cores, costs, sampler_priority, stall }
}

/// No queue is made to outlast more than 10 s: that is no stall, but a machine that is off.
fn stall(section: &mut Section<'_>, problems: &mut Collector) -> u64 {
    const MOST_NS: u64 = 10_000_000_000;
    let Some(stall) = section.time("stall", problems) else { return 0 };
    if stall.value > MOST_NS {
        let message = format!(
            "`stall` of {} is {} s, out of range: set it to 10s at most, the longest time for which the machine may stand still",
            section.title,
            stall.value as f64 / 1e9
        );
        problems.add(stall.at, message);
    }
    stall.value
}

fn node(name: String, mut section: Section<'_>, problems: &mut Collector) -> Node {
    let (host, core) = (section.text("host", problems), section.integer("core", problems));
    let clients = [("tautline", Client::Tautline), ("rclcpp", Client::Rclcpp), ("rclpy", Client::Rclpy)];
    let client = choice(&mut section, "client", &clients, problems).unwrap_or(Client::Tautline);
    let at = section.at;
    section.finish(problems);
    Node { name, client, host, core, at }
}

fn topic(name: String, mut section: Section<'_>, problems: &mut Collector) -> Topic {
    let type_name = section.text("type", problems).map(|text| text.value);
    let mut is_auto = false;
    let depth = match section.raw("depth").map(|value| (value, value.get_ref())) {
        Some((_, toml::de::DeValue::String(text))) if text == "auto" => {
            is_auto = true;
            None
        }
        Some((value, _)) => integer("depth", value, problems).and_then(|depth| {
            let value = u64::try_from(depth.value).ok().filter(|depth| *depth > 0);
            if value.is_none() {
                problems.add(
                    depth.at,
                    format!(
                        "`depth` of topic `{name}` is {}: set it to \"auto\" or 1 and above",
                        depth.value
                    ),
                );
            }
            Some(At { value: value?, at: depth.at })
        }),
        None => None,
    };
    let priorities = LinkPriority::ALL.map(|priority| (priority.as_str(), priority));
    let link_priority = choice(&mut section, "priority", &priorities, problems);
    let express = section.flag("express", problems);
    if express && !section.has("priority") {
        problems.add(
            section.at,
            format!("topic `{name}` is `express` without a `priority`: add one, such as \"real_time\""),
        );
    }
    let topic = Topic {
        type_name,
        depth,
        is_auto,
        remote: section.flag("remote", problems),
        priority: link_priority,
        express,
        period: section.positive_time("period", problems),
        jitter: section.time("jitter", problems).map_or(0, |jitter| jitter.value),
        min_distance: section.time("min_distance", problems),
        name,
    };
    section.finish(problems);
    topic
}

fn group(name: String, mut section: Section<'_>, problems: &mut Collector) -> Group {
    let orders = [("fifo", Order::Fifo), ("any", Order::Any), ("priority", Order::Priority)];
    let order_at = section.raw("order").map(|value| value.span().start);
    let order = choice(&mut section, "order", &orders, problems);
    let order = order.zip(order_at).map(|(value, at)| At { value, at });
    let priority = priority(&mut section, "priority", problems);
    let at = section.at;
    section.finish(problems);
    Group { name, at, order, priority }
}

fn callback(name: String, mut section: Section<'_>, problems: &mut Collector) -> Callback {
    let mut locks = Vec::new();
    for value in section.array("locks", problems) {
        let title = format!("lock of callback `{name}`");
        let Some(mut lock) = Section::of(title, value.span().start, value, problems) else { continue };
        let (resource, length) = (lock.text("resource", problems), lock.time("length", problems));
        for key in ["resource", "length"].into_iter().filter(|key| !lock.has(key)) {
            problems.add(lock.at, format!("a lock of callback `{name}` lacks `{key}`: add it"));
        }
        lock.finish(problems);
        locks.extend(resource.zip(length).map(|(resource, length)| (resource.value, length.value)));
    }
    if !section.has("wcet") {
        problems.add(section.at, format!("callback `{name}` lacks `wcet`: add its longest execution time"));
    }
    for key in ["topic", "all"] {
        if let Some(value) = section.raw(key)
            && matches!(value.get_ref(), DeValue::Array(topics) if topics.is_empty())
        {
            problems.add(
                value.span().start,
                format!("`{key}` of callback `{name}` is empty: name a topic, or use `period`"),
            );
        }
    }
    let (mut topics, together) = (section.texts("topic", problems), section.texts("all", problems));
    let all = section.has("all").then(|| together.first().map_or(section.at, |topic| topic.at));
    topics.extend(together);
    let overrun_at = section.raw("overrun").map(|value| value.span().start);
    let overruns = OverrunPolicy::ALL.map(|policy| (policy.as_str(), policy));
    let overrun = choice(&mut section, "overrun", &overruns, problems);
    let overrun = overrun.zip(overrun_at).map(|(value, at)| At { value, at });
    let policy_at = section.raw("policy").map(|value| value.span().start);
    let policies = JoinPolicy::NAMED.map(|policy| (policy.as_str(), policy));
    let policy = choice(&mut section, "policy", &policies, problems);
    let policy = policy.zip(policy_at).map(|(value, at)| At { value, at });
    let any =
        section.raw("core").filter(|value| matches!(value.get_ref(), DeValue::String(text) if text == "any"));
    let floats = any.map(|value| value.span().start);
    let callback = Callback {
        reservation: reservation(&mut section, problems),
        overrun,
        node: section.text("node", problems),
        topics,
        all,
        has_topic: section.has("topic"),
        window: section.time("window", problems),
        policy,
        take: section.positive_time("take", problems),
        period: section.positive_time("period", problems),
        triggered: section.has("topic") || section.has("all") || section.has("period"),
        wcet: section.positive_time("wcet", problems),
        input_max: input_max(&mut section, problems),
        bcet: section.time("bcet", problems),
        deadline: section.positive_time("deadline", problems),
        jitter: section.time("jitter", problems),
        min_distance: section.time("min_distance", problems),
        non_preemptive: section.time("non_preemptive", problems),
        priority: priority(&mut section, "priority", problems),
        shares_priority: section.flag("shares_priority", problems),
        core: if floats.is_none() { section.integer("core", problems) } else { None },
        floats,
        group: section.text("group", problems),
        publishes: section.texts("publishes", problems),
        reads: section.texts("reads", problems),
        locks,
        at: section.at,
        name,
    };
    section.finish(problems);
    callback
}

fn input_max(section: &mut Section<'_>, problems: &mut Collector) -> Option<u64> {
    let size = section.integer("input_max", problems)?;
    let value = u64::try_from(size.value).ok().filter(|size| *size > 0);
    if value.is_none() {
        let message = format!(
            "`input_max` of {} is {}, out of range: set it to 1 or more, the greatest size that the callback states of its input",
            section.title, size.value
        );
        problems.add(size.at, message);
    }
    value
}

fn chain(mut section: Section<'_>, problems: &mut Collector) -> Chain {
    let name = section.text("name", problems);
    let name = name.map_or_else(|| "chain".into(), |name| name.value);
    section.title = format!("chain `{name}`");
    let path = section.texts("path", problems);
    let deadline = section.positive_time("deadline", problems).map(|deadline| deadline.value);
    for (key, what) in
        [("name", "its name"), ("path", "the callbacks it passes"), ("deadline", "its end-to-end deadline")]
    {
        if !section.has(key) {
            problems.add(section.at, format!("chain `{name}` lacks `{key}`: add {what}"));
        }
    }
    let at = section.at;
    section.finish(problems);
    Chain { name, at, path, deadline }
}

fn priority(section: &mut Section<'_>, key: &'static str, problems: &mut Collector) -> Option<At<u8>> {
    let number = section.integer(key, problems)?;
    let value = u8::try_from(number.value).ok().filter(|priority| (1..=99).contains(priority));
    if value.is_none() {
        let title = &section.title;
        problems.add(
            number.at,
            format!("`{key}` of {title} is {}, out of range: set it to 1 (lowest) to 99", number.value),
        );
    }
    Some(At { value: value?, at: number.at })
}

fn choice<T: Copy>(
    section: &mut Section<'_>,
    key: &'static str,
    choices: &[(&str, T)],
    problems: &mut Collector,
) -> Option<T> {
    let text = section.text(key, problems)?;
    let found = choices.iter().find(|(name, _)| *name == text.value);
    if found.is_none() {
        let names = || choices.iter().map(|(name, _)| *name);
        let hint = problems.suggestion(&text.value, names());
        let hint = if hint.is_empty() {
            format!(" (known: {})", names().collect::<Vec<_>>().join(", "))
        } else {
            hint
        };
        problems.add(text.at, format!("unknown `{key}` \"{}\" in {}{hint}", text.value, section.title));
    }
    found.map(|(_, value)| *value)
}
