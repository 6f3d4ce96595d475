// SPDX-License-Identifier: MIT OR Apache-2.0
//! The real-time cores: isolation, interrupts, frequency, idle states, hardware threads that share one.

use super::finding::{Checked, Cost, Finding, MEASURE, plain};
use super::host::{Host, isolated};
use rustix::fs::{Access, access};
use std::collections::BTreeSet;
use tautline::CoreSet;

const CPU: &str = "/sys/devices/system/cpu";

pub fn online(host: &Host) -> Checked {
    let (cores, online) = (host.cores()?, host.online()?);
    if cores.iter().all(|core| online.contains(core)) {
        let how = if host.is_chosen() { "" } else { ", all there are: none is named or isolated" };
        return Ok(Finding::good(format!("{cores}{how}")));
    }
    Ok(Finding::bad(format!("{cores}, of which only these are online: {online}"))
        .costs(Cost::Unknown("threads bound to such a core do not start"))
        .fix("name others (--cores, the system file), or bring them online"))
}

pub fn isolation(host: &Host) -> Checked {
    let (isolated, cores) = (isolated(&host.tree)?, host.cores()?);
    if cores.iter().all(|core| isolated.contains(core)) {
        return Ok(Finding::good(format!("cores {cores} are isolated")));
    }
    let others = host.others()?;
    let value = match host.is_chosen() {
        true => format!("of the real-time cores {cores} these are isolated: {isolated}"),
        false => format!("no core is isolated: real-time threads share cores {cores} with everything else"),
    };
    let finding = Finding::advice(value).costs(MEASURE);
    if others.is_empty() {
        return Ok(finding.fix("say which cores are for real-time threads (--cores, --system) and leave others to the rest; or isolate some (isolcpus)"));
    }
    let line = format!("isolcpus=managed_irq,domain,{cores} irqaffinity={others} rcu_nocbs={cores}");
    Ok(finding
        .fix(format!(
            "boot with `{line}`, or make a cpuset partition of them (cpuset.cpus.partition = isolated)"
        ))
        .script([format!("# Kernel command line, such as GRUB_CMDLINE_LINUX of /etc/default/grub: {line}")]))
}

pub fn interrupts(host: &Host) -> Checked {
    let cores = host.cores()?;
    let mut hits: Vec<(Option<u64>, u32, String)> = Vec::new();
    let names = host.tree.list("/proc/irq")?;
    let numbers: Vec<u32> = names.iter().filter_map(|name| name.parse().ok()).collect();
    if numbers.is_empty() {
        return Err("/proc/irq has no interrupts".into());
    }
    for number in numbers {
        // The present target of the interrupt; not every architecture reports it.
        let file = |name| format!("/proc/irq/{number}/{name}");
        let goes = host.tree.cores(&file("effective_affinity_list")).ok().filter(|cores| !cores.is_empty());
        let goes = match goes {
            Some(goes) => goes,
            None => host.tree.cores(&file("smp_affinity_list"))?,
        };
        let count = count_on(host, number, cores);
        if is_of_each_core(host, number) {
            continue;
        }
        if goes.iter().any(|core| cores.contains(core)) && count != Some(0) {
            let actions = host.tree.read(&format!("/sys/kernel/irq/{number}/actions")).unwrap_or_default();
            hits.push((count, number, plain(&actions)));
        }
    }
    hits.sort_by_key(|(count, number, _)| (std::cmp::Reverse(*count), *number));
    if hits.is_empty() {
        return Ok(Finding::good(format!("no device has interrupted cores {cores}")));
    }
    let first = hits.iter().take(4).map(|(count, number, actions)| {
        let count = count.map_or("?".into(), |count| count.to_string());
        let gap = if actions.is_empty() { "" } else { " " };
        format!("{number}{gap}{actions} ({count})")
    });
    let first = first.collect::<Vec<_>>().join(", ");
    let rest = if hits.len() > 4 { format!(", and {} more", hits.len() - 4) } else { String::new() };
    let value = format!("devices interrupt real-time cores {cores}: {first}{rest}");
    let others = host.others()?;
    if others.is_empty() {
        let fix = "say which cores are for real-time threads (--cores, --system), so that interrupts can go to the others";
        return Ok(Finding::advice(value).costs(MEASURE).fix(fix));
    }
    let away = |number: u32| format!("echo {others} > /proc/irq/{number}/smp_affinity_list");
    Ok(Finding::bad(value)
        .costs(MEASURE)
        .fix(format!("{}, likewise the others, and keep irqbalance from these cores (IRQBALANCE_BANNED_CPULIST={cores})", away(hits[0].1)))
        .script(hits.iter().map(|(_, number, actions)| {
            format!("{} || echo 'interrupt {number} stays' >&2  # {actions}", away(*number))
        })))
}

/// Whether each core has its own interrupt of this number, for its timer or for other cores' calls: no device's, and not to be moved.
/// Where such interrupts have numbers, as on ARM and RISC-V, the interrupt controller's own number identifies them.
fn is_of_each_core(host: &Host, number: u32) -> bool {
    let read = |name| host.tree.read(&format!("/sys/kernel/irq/{number}/{name}")).unwrap_or_default();
    match &*read("chip_name") {
        chip if chip.starts_with("GIC") => {
            read("hwirq").parse().is_ok_and(|id: u32| id < 32 || (1056..1120).contains(&id))
        }
        chip => chip.starts_with("RISC-V INTC"),
    }
}

/// How often an interrupt has occurred on these cores since booting, if the kernel reports it.
fn count_on(host: &Host, number: u32, cores: CoreSet) -> Option<u64> {
    let text = host.tree.read(&format!("/sys/kernel/irq/{number}/per_cpu_count")).ok()?;
    let of_core = text.split(',').enumerate().filter(|(core, _)| cores.contains(*core));
    of_core.map(|(_, count)| count.parse::<u64>().ok()).sum()
}

pub fn governor(host: &Host) -> Checked {
    let mut others = CoreSet::empty();
    let (mut names, mut latency_ns) = (BTreeSet::new(), None);
    for core in host.cores()?.iter() {
        let file = |name| format!("{CPU}/cpu{core}/cpufreq/{name}");
        let Some(name) = host.tree.read_if_there(&file("scaling_governor"))? else {
            let value =
                format!("core {core} has no cpufreq folder: firmware or hypervisor choose its frequency");
            let fix = "choose the highest performance there, or load the processor's cpufreq driver";
            return Ok(Finding::unknown(value).costs(MEASURE).fix(fix));
        };
        if name != "performance" {
            others = others.with(core);
            names.insert(name);
            let latency = host.tree.parse::<u32>(&file("cpuinfo_transition_latency")).ok();
            // The greatest number means that the driver does not know the value.
            latency_ns = latency_ns.max(latency.filter(|ns| *ns != u32::MAX && *ns != 0));
        }
    }
    if others.is_empty() {
        return Ok(Finding::good("performance"));
    }
    let names = names.into_iter().collect::<Vec<_>>().join(", ");
    let cost = match latency_ns {
        Some(ns) => Cost::Known(
            f64::from(ns) / 1e3,
            "a change of frequency; cpuinfo_transition_latency; slower execution until then is not in it"
                .into(),
        ),
        None => MEASURE,
    };
    let line = |core: usize| format!("echo performance > {CPU}/cpu{core}/cpufreq/scaling_governor");
    Ok(Finding::advice(format!("{names} on cores {others}"))
        .costs(cost)
        .fix("cpupower frequency-set -g performance, or write it to scaling_governor of these cores")
        .script(others.iter().map(line)))
}

const LATENCY_DEVICE: &str = "/dev/cpu_dma_latency";

pub fn idle(host: &Host) -> Checked {
    let command_line = host.tree.read("/proc/cmdline")?;
    if command_line.split_whitespace().any(|word| word == "idle=poll") {
        return Ok(Finding::good("idle=poll"));
    }
    // The state that takes longest to leave, among those in use.
    let mut deepest: Option<(u64, String, usize)> = None;
    for core in host.cores()?.iter() {
        let folder = format!("{CPU}/cpu{core}/cpuidle");
        if !host.tree.has(&folder) {
            let value = format!("core {core} has no cpuidle folder: how it idles, the kernel does not tell");
            let fix = "boot with idle=poll if the wake-ups of `cargo xtask bench wake` are too slow";
            return Ok(Finding::unknown(value).costs(Cost::Unknown("not known")).fix(fix));
        }
        for state in host.tree.list(&folder)? {
            let file = |name| format!("{folder}/{state}/{name}");
            let latency_us = host.tree.parse(&file("latency"))?;
            let found = (latency_us, host.tree.read(&file("name"))?, core);
            if host.tree.read(&file("disable"))? != "1"
                && deepest.as_ref().is_none_or(|deepest| found > *deepest)
            {
                deepest = Some(found);
            }
        }
    }
    let Some((us, name, core)) = deepest else { return Ok(Finding::good("all are disabled")) };
    // If the guest polls before it halts, the figure does not include the hypervisor.
    let driver = host.tree.read(&format!("{CPU}/cpuidle/current_driver")).unwrap_or_default();
    let cost = match driver == "haltpoll" || host.is_virtual()? {
        true => Cost::Unknown(
            "not known: the hypervisor's way back from a halt is not in the kernel's figures; `cargo xtask bench wake` measures it",
        ),
        false => Cost::Known(us as f64, format!("to leave it; {CPU}/cpu{core}/cpuidle/*/latency")),
    };
    let value = format!("down to '{name}'");
    if access(host.tree.path(LATENCY_DEVICE), Access::WRITE_OK).is_ok() {
        let value =
            format!("{value}, held off while a program spins in real time ({LATENCY_DEVICE} is writable)");
        return Ok(Finding::good(value));
    }
    Ok(Finding::advice(format!("{value}, and {LATENCY_DEVICE} is not writable for this user"))
        .costs(cost)
        .fix("open it to the group realtime by a udev rule: programs then hold idle states off while they spin; or boot with idle=poll")
        .script([
            "groupadd -f realtime",
            "echo 'KERNEL==\"cpu_dma_latency\", GROUP=\"realtime\", MODE=\"0660\"' > /etc/udev/rules.d/90-tautline.rules",
            "udevadm control --reload && udevadm trigger --name-match=cpu_dma_latency",
        ]))
}

pub fn siblings(host: &Host) -> Checked {
    let (cores, online) = (host.cores()?, host.online()?);
    let mut shared = Vec::new();
    for core in cores.iter() {
        let all = host.tree.cores(&format!("{CPU}/cpu{core}/topology/thread_siblings_list"))?;
        let siblings: CoreSet =
            all.iter().filter(|other| *other != core && online.contains(*other)).collect();
        if !siblings.is_empty() {
            shared.push((core, siblings));
        }
    }
    if shared.is_empty() {
        return Ok(Finding::good("no real-time core shares its execution units"));
    }
    let pairs = shared.iter().map(|(core, siblings)| format!("{core} with {siblings}"));
    let value = format!("these share their execution units: {}", pairs.collect::<Vec<_>>().join(", "));
    let off: BTreeSet<usize> = shared
        .iter()
        .flat_map(|(_, siblings)| siblings.iter())
        .filter(|sibling| !cores.contains(*sibling))
        .collect();
    Ok(Finding::advice(value)
        .costs(Cost::Unknown("not known; --measure shows it while the sibling is busy"))
        .fix("use one of each pair for real-time threads and take the other offline, or switch SMT off (firmware, nosmt)")
        .script(off.into_iter().map(|core| format!("echo 0 > {CPU}/cpu{core}/online"))))
}
