// SPDX-License-Identifier: MIT OR Apache-2.0
//! How kernel and hypervisor affect real-time threads: preemption, throttling, the clock, stolen time.

use super::finding::{Checked, Cost, Finding, MEASURE};
use super::host::Host;
use tautline::CoreSet;
use tautline_rt::clock::monotonic_ns;
use tautline_rt::host::Preemption;
use tautline_rt::{Enforcement, RtError, prove_enforcement_by};

const RUNTIME: &str = "/proc/sys/kernel/sched_rt_runtime_us";
const PERIOD: &str = "/proc/sys/kernel/sched_rt_period_us";
const FAIR_SERVER: &str = "/sys/kernel/debug/sched/fair_server";

pub fn preemption(host: &Host) -> Checked {
    let tree = &host.tree;
    let is_rt = tree.read_if_there("/sys/kernel/realtime")?.is_some_and(|text| text == "1");
    let kind = match is_rt {
        true => Preemption::Rt,
        false => Preemption::of_version(&tree.read("/proc/sys/kernel/version")?),
    };
    let value = format!("{kind}, Linux {}", tree.read("/proc/sys/kernel/osrelease")?);
    if kind == Preemption::Rt {
        return Ok(Finding::good(value));
    }
    Ok(Finding::bad(format!("{value}: how long the kernel delays a thread has no bound"))
        .costs(MEASURE)
        .fix("boot a kernel with CONFIG_PREEMPT_RT (Debian: linux-image-rt-amd64; Ubuntu: pro enable realtime-kernel)")
        .script([
            "# Needs another kernel and a reboot. Debian: apt install linux-image-rt-amd64",
            "# Ubuntu: pro enable realtime-kernel",
        ]))
}

/// Whether a thread that has used its budget is stopped. This is tried, because the kernel's name does not tell which of its threads serves
/// timers, and at which priority.
pub fn budgets(host: &Host) -> Checked {
    let (sampler, highest) = (host.priority, host.priority.saturating_sub(1));
    match prove_enforcement_by(Enforcement::Timer, sampler) {
        Ok(()) => {
            let value =
                format!("a timer stopped a thread at SCHED_FIFO {highest} that had used its budget (tried)");
            return Ok(Finding::good(value));
        }
        Err(RtError::BudgetNotEnforced { .. }) => {}
        Err(error) => return Err(error.to_string()),
    }
    let raise = "for p in $(pgrep ktimers/); do chrt -f -p 98 $p; done";
    let finding = match prove_enforcement_by(Enforcement::Enforcer, sampler) {
        Ok(()) => Finding::advice(format!(
            "timers do not reach a busy thread at SCHED_FIFO {highest}; each process that holds budgets has a thread at {sampler} that \
             does (tried)"
        )),
        Err(error @ RtError::BudgetNotEnforced { .. }) => Finding::bad(error.to_string()),
        Err(error) => return Err(error.to_string()),
    };
    let cost = Cost::Unknown(
        "two runs of that thread for a job with a budget; `cargo xtask bench budgets` measures jobs",
    );
    Ok(finding
        .costs(cost)
        .fix(format!(
            "raise the kernel's timers above the callbacks, which costs whatever else they serve: {raise}"
        ))
        .script([format!("# Timers of all threads then run above real-time threads: {raise}")]))
}

/// The time in µs that real-time threads may use of each period (-1: no limit), the period in µs, and whether the kernel applies the limit.
fn limit(host: &Host) -> Result<(i64, i64, bool), String> {
    let (runtime, period) = (host.tree.parse(RUNTIME)?, host.tree.parse(PERIOD)?);
    // Since Linux 6.12 this limit applies to real-time groups only; the fair server protects other threads.
    let is_applied = host.kernel()? < (6, 12) || has_groups(host)?;
    Ok((runtime, period, is_applied))
}

/// Whether the kernel was built with real-time groups; `true` also if its configuration cannot be read.
fn has_groups(host: &Host) -> Result<bool, String> {
    let config = format!("/boot/config-{}", host.tree.read("/proc/sys/kernel/osrelease")?);
    let is_built = |config: String| config.lines().any(|line| line == "CONFIG_RT_GROUP_SCHED=y");
    Ok(host.tree.read(&config).map_or(true, is_built))
}

/// The time that real-time threads get of each period, and the period, in µs; `None` if they get all of it.
pub fn allowance(host: &Host) -> Result<Option<(i64, i64)>, String> {
    let (runtime, period, is_applied) = limit(host)?;
    if is_applied && (0..period).contains(&runtime) {
        return Ok(Some((runtime, period)));
    }
    Ok(server(host)?.map(|(runtime, period, _)| (period - runtime, period)))
}

pub fn throttling(host: &Host) -> Checked {
    let (runtime, period, is_applied) = limit(host)?;
    if !(0..period).contains(&runtime) {
        return Ok(Finding::good(format!("none (sched_rt_runtime_us is {runtime})")));
    }
    if !is_applied {
        return Ok(Finding::good(format!(
            "sched_rt_runtime_us is {runtime}, which Linux 6.12 and later does not apply without real-time groups"
        )));
    }
    let value = format!("real-time threads get {runtime} of each {period} µs of a core");
    let source = format!("pause in each period that they want more of; {RUNTIME}");
    Ok(Finding::advice(value)
        .costs(Cost::Known((period - runtime) as f64, source))
        .fix("state it in the system file (throttling), or switch it off: sysctl -w kernel.sched_rt_runtime_us=-1; a thread that never sleeps then keeps its core for ever")
        .script([
            "echo 'kernel.sched_rt_runtime_us = -1' > /etc/sysctl.d/90-tautline.conf",
            "sysctl -w kernel.sched_rt_runtime_us=-1",
        ]))
}

/// The time that the fair server reserves for ordinary threads, its period, both in µs, and the core with the largest share; `None`: nothing.
fn server(host: &Host) -> Result<Option<(i64, i64, usize)>, String> {
    if host.kernel()? < (6, 12) {
        return Ok(None);
    }
    let mut most: Option<(i64, i64, usize)> = None;
    for core in host.cores()?.iter() {
        let us = |name| {
            let ns = host.tree.parse::<i64>(&format!("{FAIR_SERVER}/cpu{core}/{name}"));
            ns.map(|ns| ns / 1000).map_err(|error| {
                format!("{error} (debugfs: root, and `mount -t debugfs none /sys/kernel/debug`)")
            })
        };
        let (runtime, period) = (us("runtime")?, us("period")?);
        // Shares are compared as cross products, which are exact.
        let product = |runtime: i64, period: i64| i128::from(runtime) * i128::from(period);
        if most.is_none_or(|(most, of, _)| product(runtime, of) >= product(most, period)) {
            most = Some((runtime, period, core));
        }
    }
    Ok(most.filter(|(runtime, ..)| *runtime > 0))
}

pub fn fair_server(host: &Host) -> Checked {
    let Some((runtime, period, core)) = server(host)? else {
        return Ok(Finding::good("off, or a Linux before 6.12"));
    };
    let off = |core: usize| format!("echo 0 > {FAIR_SERVER}/cpu{core}/runtime");
    Ok(Finding::advice(format!("ordinary threads that starve get {runtime} of each {period} µs"))
        .costs(Cost::Known(runtime as f64, format!("{FAIR_SERVER}/cpu{core}/runtime")))
        .fix(format!("state it in the system file (throttling), or on each real-time core: {}", off(core)))
        .script(host.cores()?.iter().map(off)))
}

pub fn clock(host: &Host) -> Checked {
    let folder = "/sys/devices/system/clocksource/clocksource0";
    let name = host.tree.read(&format!("{folder}/current_clocksource"))?;
    // Processes read these clock sources without a system call.
    let is_mapped = [
        "tsc",
        "timebase",
        "arch_sys_counter",
        "riscv_clocksource",
        "kvm-clock",
        "hyperv_clocksource_tsc_page",
    ]
    .contains(&&*name);
    let read_us = host.tree.is_here().then(read_us);
    let measured = read_us.map(|us| format!(", {us:.2} µs a reading")).unwrap_or_default();
    if is_mapped {
        return Ok(Finding::good(format!("{name}{measured}")));
    }
    let available = host.tree.read(&format!("{folder}/available_clocksource"))?;
    let cost = match read_us {
        Some(us) => Cost::Known((us * 100.0).round() / 100.0, "a reading, measured now".into()),
        None => Cost::Unknown("not known; it is measured when this runs on that host"),
    };
    let value = format!("{name}, of {available}: each reading is a system call and an access to a device");
    let finding = Finding::bad(value).costs(cost);
    if available.split_whitespace().any(|other| other == "tsc") {
        let line = format!("echo tsc > {folder}/current_clocksource");
        return Ok(finding.fix(format!("{line}; if it goes back, boot with tsc=reliable")).script([line]));
    }
    Ok(finding.fix("the kernel took the better one away: `dmesg | grep -i clocksource` says why; boot with tsc=reliable if the firmware is at fault"))
}

/// The duration of reading the clock, in µs.
fn read_us() -> f64 {
    const READINGS: u32 = 10_000;
    let start_ns = monotonic_ns();
    let mut end_ns = start_ns;
    for _ in 0..READINGS {
        end_ns = monotonic_ns();
    }
    (end_ns - start_ns) as f64 / 1e3 / f64::from(READINGS)
}

pub fn steal(host: &Host) -> Checked {
    let stat = host.tree.read("/proc/stat")?;
    let cores = host.cores()?;
    let (stolen, all) =
        ticks(&stat, cores).ok_or_else(|| format!("/proc/stat has no lines of all cores {cores}"))?;
    let share = stolen as f64 / all.max(1) as f64 * 100.0;
    match (stolen, host.is_virtual()?) {
        (0, false) => Ok(Finding::good("none")),
        (0, true) => {
            let value = "none is reported, but this is a virtual machine, whose hypervisor may not report it";
            let fix = "--measure; give each virtual processor a physical one of its own";
            Ok(Finding::unknown(value).costs(MEASURE).fix(fix))
        }
        _ => {
            let value =
                format!("{stolen} ticks of 10 ms since booting on cores {cores}, {share:.3} % of the time");
            let fix = "the hypervisor gives these cores to others: give each virtual processor a physical one of its own, or use no virtual machine; if it has a quota, TAUT_HOLD_IDLE=off uses less of it";
            Ok(Finding::bad(value).costs(MEASURE).fix(fix))
        }
    }
}

/// The stolen time and the whole time of the real-time cores, in ticks.
fn ticks(stat: &str, cores: CoreSet) -> Option<(u64, u64)> {
    let mut sum = (0, 0);
    for core in cores.iter() {
        let label = format!("cpu{core}");
        let line = stat.lines().find(|line| line.split_whitespace().next() == Some(&label))?;
        // user nice system idle iowait irq softirq steal; guest time after them is in user's already.
        let numbers: Vec<u64> =
            line.split_whitespace().skip(1).take(8).map(|number| number.parse().unwrap_or(0)).collect();
        sum = (sum.0 + numbers.get(7)?, sum.1 + numbers.iter().sum::<u64>());
    }
    Some(sum)
}
