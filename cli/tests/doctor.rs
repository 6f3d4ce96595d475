// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut doctor` on made-up hosts, on this one, and on a domain in which much is wrong.

#[path = "support/schemas.rs"]
mod schemas;

use schemas::Checked;
use serde_json::Value;
use std::fs::{self, OpenOptions};
use std::os::unix::fs::{FileExt, PermissionsExt};
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Command, Output};
use tautline_rt::domain::shared_path;
use tautline_rt::shm::{self, OwnFile};
use tautline_transport::{Limits, Participant, Qos, TopicType};
use tempfile::TempDir;

/// Nobody is ever in the first one.
const EMPTY: &str = "98";
const DOMAIN: u32 = 99;

const CPU: &str = "sys/devices/system/cpu";
const CLOCK: &str = "sys/devices/system/clocksource/clocksource0";

/// Four cores, of which 2 and 3 are isolated, with everything as it should be.
fn good_host() -> TempDir {
    let root = tempfile::tempdir().unwrap();
    for (path, text) in [
        ("proc/sys/kernel/osrelease", "6.6.30-rt30\n"),
        ("proc/sys/kernel/version", "#1 SMP PREEMPT_RT Debian 6.6\n"),
        ("proc/sys/kernel/sched_rt_runtime_us", "-1\n"),
        ("proc/sys/kernel/sched_rt_period_us", "1000000\n"),
        (
            "proc/self/limits",
            "Limit   Soft Limit   Hard Limit   Units\nMax locked memory   unlimited   unlimited   bytes\nMax realtime priority   98   98\n",
        ),
        ("proc/self/status", "Name:\ttaut\nUid:\t1000\t1000\t1000\t1000\nCapEff:\t0000000000000000\n"),
        ("proc/self/cgroup", "0::/user.slice/user-1000.slice\n"),
        ("proc/cpuinfo", "flags\t\t: fpu tsc\n"),
        ("proc/cmdline", "quiet isolcpus=2-3\n"),
        (
            "proc/stat",
            "cpu  4 0 0 0 0 0 0 9 0 0\ncpu0 1 0 0 0 0 0 0 9 0 0\ncpu1 1 0 0 0 0 0 0 0 0 0\ncpu2 1 0 0 5 0 0 0 0 0 0\ncpu3 1 0 0 5 0 0 0 0 0 0\n",
        ),
        ("proc/swaps", "Filename\tType\tSize\tUsed\tPriority\n"),
        ("proc/irq/24/effective_affinity_list", "0\n"),
        ("proc/irq/25/effective_affinity_list", "2\n"),
        // It may come to core 2, and never has.
        ("sys/kernel/irq/25/per_cpu_count", "0,7,0,0\n"),
        ("sys/devices/system/cpu/online", "0-3\n"),
        ("sys/devices/system/cpu/isolated", "2-3\n"),
        ("sys/kernel/mm/transparent_hugepage/enabled", "always [madvise] never\n"),
        ("etc/systemd/logind.conf", "[Login]\n#RemoveIPC=yes\nRemoveIPC=yes\n"),
        ("etc/systemd/logind.conf.d/robot.conf", "[Login]\nRemoveIPC=no\n"),
        ("run/systemd/sessions/1", ""),
        ("dev/cpu_dma_latency", ""),
        ("dev/shm/.keep", ""),
    ] {
        put(&root, path, text);
    }
    put(&root, &format!("{CLOCK}/current_clocksource"), "tsc\n");
    put(&root, &format!("{CLOCK}/available_clocksource"), "tsc hpet acpi_pm\n");
    for core in 0..4 {
        for (file, text) in [
            ("cpufreq/scaling_governor", "performance\n"),
            ("cpuidle/state0/name", "POLL\n"),
            ("cpuidle/state0/latency", "0\n"),
            ("cpuidle/state0/disable", "0\n"),
            ("cpuidle/state1/name", "C6\n"),
            ("cpuidle/state1/latency", "133\n"),
            ("cpuidle/state1/disable", "0\n"),
        ] {
            put(&root, &format!("{CPU}/cpu{core}/{file}"), text);
        }
        put(&root, &format!("{CPU}/cpu{core}/topology/thread_siblings_list"), &format!("{core}\n"));
    }
    root
}

fn put(root: &TempDir, path: &str, text: &str) {
    let path = root.path().join(path);
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    fs::write(path, text).unwrap();
}

fn remove(root: &TempDir, path: &str) {
    let path = root.path().join(path);
    if path.is_dir() { fs::remove_dir_all(path).unwrap() } else { fs::remove_file(path).unwrap() }
}

fn doctor(root: &Path, args: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_taut"));
    command.arg("doctor").args(["--domain", EMPTY, "--root"]).arg(root).args(args);
    command.env_remove("TAUT_HOST").checked()
}

fn text(output: &Output) -> String {
    assert!(output.stderr.is_empty(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout.clone()).unwrap()
}

/// The verdict and the value of a check.
fn finding(root: &TempDir, check: &str, args: &[&str]) -> (String, String) {
    let output = doctor(root.path(), &[args, &["--json"]].concat());
    let all: Value = serde_json::from_str(&text(&output)).unwrap();
    let found = all["findings"].as_array().unwrap().iter().find(|finding| finding["check"] == check);
    let found = found.unwrap_or_else(|| panic!("no {check} in {all}"));
    (found["verdict"].as_str().unwrap().to_owned(), found["value"].as_str().unwrap().to_owned())
}

fn expect(root: &TempDir, check: &str, verdict: &str, value: &str) {
    let found = finding(root, check, &[]);
    assert!(found.0 == verdict && found.1.contains(value), "{check}: {found:?}");
}

/// Without the line whose numbers are this machine's.
fn golden(output: &Output) -> String {
    let text = text(output);
    text.lines()
        .filter(|line| !line.starts_with("good     shared memory: "))
        .map(|line| line.to_owned() + "\n")
        .collect()
}

#[test]
fn a_good_host() {
    let root = good_host();
    let output = doctor(root.path(), &[]);
    let expected = "\
good     preemption: PREEMPT_RT, Linux 6.6.30-rt30
good     throttling: none (sched_rt_runtime_us is -1)
good     fair server: off, or a Linux before 6.12
good     priority: limit 98 (RLIMIT_RTPRIO), 90 is needed
good     locked memory: without a limit
good     cgroup: version 2 of cgroups, which has no runtime of groups
good     cores: 2-3
good     isolation: cores 2-3 are isolated
good     interrupts: no device has interrupted cores 2-3
good     governor: performance
good     idle states: down to 'C6', held off while a program spins in real time (/dev/cpu_dma_latency is
         writable)
good     siblings: no real-time core shares its execution units
good     clock: tsc
good     swap: none
good     huge pages: madvise
good     steal: none
good     logout: RemoveIPC=no (/etc/systemd/logind.conf.d/robot.conf)
good     versions: all processes of the domain understand each other
good     node names: 0 nodes in domain 98, each name once
good     qos: the ends of all topics of domain 98 fit each other
good     left behind: nothing of processes that were killed

Fit for real time: 0 bad, 0 unknown, 0 advice, 22 good.
";
    assert_eq!(golden(&output), expected);
    assert_eq!(output.status.code(), Some(0));
}

/// Where no logind.conf is in /etc, systemd reads the vendor's.
#[test]
fn the_vendors_configuration_of_logind_counts() {
    let root = good_host();
    remove(&root, "etc/systemd/logind.conf");
    remove(&root, "etc/systemd/logind.conf.d/robot.conf");
    put(&root, "usr/lib/systemd/logind.conf", "[Login]\nRemoveIPC=yes\n");
    put(&root, "usr/local/lib/systemd/logind.conf.d/site.conf", "[Login]\nRemoveIPC=no\n");
    let expected = "good     logout: RemoveIPC=no (/usr/local/lib/systemd/logind.conf.d/site.conf)\n";
    assert!(golden(&doctor(root.path(), &[])).contains(expected));
    remove(&root, "usr/local/lib/systemd/logind.conf.d/site.conf");
    let expected = "bad      logout: RemoveIPC=yes (/usr/lib/systemd/logind.conf)";
    assert!(golden(&doctor(root.path(), &[])).contains(expected));
}

fn bad_host() -> TempDir {
    let root = good_host();
    for (path, text) in [
        ("proc/sys/kernel/version", "#45-Ubuntu SMP PREEMPT_DYNAMIC Fri\n"),
        ("proc/sys/kernel/osrelease", "6.8.0-45-generic\n"),
        ("proc/sys/kernel/sched_rt_runtime_us", "950000\n"),
        (
            "proc/self/limits",
            "Max locked memory   8388608   8388608   bytes\nMax realtime priority   0   0\n",
        ),
        ("proc/self/cgroup", "4:cpu,cpuacct:/user.slice\n0::/\n"),
        (
            "proc/self/mountinfo",
            "32 31 0:29 / /sys/fs/cgroup/cpu,cpuacct rw shared:8 - cgroup cgroup rw,cpu,cpuacct\n",
        ),
        ("sys/fs/cgroup/cpu,cpuacct/user.slice/cpu.rt_runtime_us", "0\n"),
        ("proc/cpuinfo", "flags\t\t: fpu hypervisor tsc\n"),
        ("proc/stat", "cpu2 90 0 0 0 0 0 0 10 0 0\ncpu3 100 0 0 0 0 0 0 0 0 0\n"),
        ("proc/swaps", "Filename\tType\tSize\tUsed\tPriority\n/dev/sda2 partition 8 0 -2\n"),
        ("proc/irq/25/effective_affinity_list", "\n"),
        ("proc/irq/25/smp_affinity_list", "0-3\n"),
        ("sys/kernel/irq/25/per_cpu_count", "0,7,40,2\n"),
        ("sys/kernel/irq/25/actions", "nvme0q1\n"),
        ("sys/devices/system/cpu/cpu3/cpufreq/scaling_governor", "powersave\n"),
        ("sys/devices/system/cpu/cpu3/cpufreq/cpuinfo_transition_latency", "20000\n"),
        ("sys/devices/system/cpu/cpu2/topology/thread_siblings_list", "0,2\n"),
        ("sys/kernel/mm/transparent_hugepage/enabled", "[always] madvise never\n"),
        ("etc/systemd/logind.conf.d/robot.conf", "[Login]\nRemoveIPC=yes\n"),
    ] {
        put(&root, path, text);
    }
    put(&root, &format!("{CLOCK}/current_clocksource"), "hpet\n");
    remove(&root, "dev/cpu_dma_latency");
    root
}

#[test]
fn a_bad_host() {
    let output = doctor(bad_host().path(), &[]);
    let text = golden(&output);
    for part in [
        "bad      preemption: PREEMPT_DYNAMIC, Linux 6.8.0-45-generic",
        "bad      priority: limit 0 (RLIMIT_RTPRIO), 90 is needed\n         cost: programs do not start in real time\n",
        "bad      locked memory: at most 8.00 MiB (RLIMIT_MEMLOCK)",
        "bad      cgroup: group /user.slice has no real-time runtime",
        "bad      interrupts: devices interrupt real-time cores 2-3: 25 nvme0q1 (42)\n",
        "bad      clock: hpet, of tsc hpet acpi_pm",
        "bad      steal: 10 ticks of 10 ms since booting on cores 2-3, 5.000 % of the time\n",
        "bad      logout: RemoveIPC=yes (/etc/systemd/logind.conf.d/robot.conf)",
        "advice   throttling: real-time threads get 950000 of each 1000000 µs of a core\n         cost: 50000 µs (",
        "advice   governor: powersave on cores 3\n         cost: 20 µs (a change of frequency; cpuinfo_transition_latency;",
        "advice   idle states: down to 'C6', and /dev/cpu_dma_latency is not writable",
        "advice   siblings: these share their execution units: 2 with 0\n",
        "advice   swap: on /dev/sda2\n",
        "advice   huge pages: always",
        "\nNot fit for real time: 8 bad, 0 unknown, 6 advice, 8 good. `taut doctor --fix-script` prints",
    ] {
        assert!(text.contains(part), "{part} in {text}");
    }
    assert_eq!(output.status.code(), Some(1));
}

/// As Linux 6.12 shows them on an emulated aarch64 machine.
#[test]
fn interrupts_that_each_core_has_for_itself_are_no_devices() {
    let root = good_host();
    let irq = |number: u32, chip: &str, id: &str, actions: &str| {
        put(&root, &format!("proc/irq/{number}/effective_affinity_list"), "\n");
        put(&root, &format!("proc/irq/{number}/smp_affinity_list"), "0-3\n");
        for (name, text) in
            [("chip_name", chip), ("hwirq", id), ("actions", actions), ("per_cpu_count", "465,412,400,390")]
        {
            put(&root, &format!("sys/kernel/irq/{number}/{name}"), &format!("{text}\n"));
        }
    };
    for (number, chip, id, actions) in [
        (1, "GICv3", "0", "IPI"),
        (11, "GICv3", "27", "arch_timer"),
        (16, "GIC-0", "23", "arm-pmu"),
        (17, "GICv3", "1056", "arm-spe"),
        (18, "RISC-V INTC", "5", "riscv-timer"),
    ] {
        irq(number, chip, id, actions);
    }
    expect(&root, "interrupts", "good", "no device has interrupted cores 2-3");
    irq(13, "GICv3", "33", "uart-pl011");
    expect(&root, "interrupts", "bad", "devices interrupt real-time cores 2-3: 13 uart-pl011 (790)");
}

#[test]
fn a_hypervisor_is_seen_where_no_flag_of_the_processor_tells() {
    const ARM: &str = "processor\t: 0\nBogoMIPS\t: 125.00\nFeatures\t: fp asimd\nCPU architecture: 8\n";
    let is_seen = |files: &[(&str, &str)]| {
        let root = good_host();
        put(&root, "proc/cpuinfo", ARM);
        files.iter().for_each(|(path, text)| put(&root, path, text));
        finding(&root, "steal", &[]).1.contains("this is a virtual machine")
    };
    let (vendor, product) = ("sys/class/dmi/id/sys_vendor", "sys/class/dmi/id/product_name");
    assert!(!is_seen(&[]));
    assert!(!is_seen(&[("proc/device-tree/compatible", "raspberrypi,5-model-b\0brcm,bcm2712\0")]));
    assert!(is_seen(&[("proc/device-tree/compatible", "linux,dummy-virt\0")]));
    assert!(is_seen(&[("proc/device-tree/fw-cfg@9020000/compatible", "qemu,fw-cfg-mmio\0")]));
    assert!(is_seen(&[("proc/device-tree/hypervisor/compatible", "xen,xen\0")]));
    assert!(is_seen(&[(vendor, "QEMU\n"), (product, "KVM Virtual Machine\n")]));
    assert!(is_seen(&[(vendor, "Amazon EC2\n"), (product, "c7g.large\n")]));
    assert!(!is_seen(&[(vendor, "Amazon EC2\n"), (product, "c7g.metal\n")]));
    assert!(!is_seen(&[(vendor, "NVIDIA\n"), (product, "Jetson AGX Orin\n")]));
}

#[test]
fn the_latency_of_an_idle_state_is_its_cost_unless_a_hypervisor_hides_it() {
    let root = good_host();
    remove(&root, "dev/cpu_dma_latency");
    let cost = || {
        let all: Value = serde_json::from_str(&text(&doctor(root.path(), &["--json"]))).unwrap();
        let found =
            all["findings"].as_array().unwrap().iter().find(|finding| finding["check"] == "idle states");
        found.unwrap()["cost_us"].clone()
    };
    assert_eq!(cost(), 133.0);
    put(&root, "proc/cpuinfo", "flags\t\t: fpu hypervisor\n");
    assert_eq!(cost(), Value::Null);
    for core in [2, 3] {
        put(&root, &format!("{CPU}/cpu{core}/cpuidle/state1/disable"), "1\n");
    }
    expect(&root, "idle states", "advice", "down to 'POLL'");
    put(&root, "proc/cmdline", "idle=poll\n");
    expect(&root, "idle states", "good", "idle=poll");
}

#[test]
fn what_cannot_be_read_is_not_good() {
    let root = tempfile::tempdir().unwrap();
    let output = doctor(root.path(), &["--json"]);
    assert_eq!(output.status.code(), Some(1));
    let all: Value = serde_json::from_str(&text(&output)).unwrap();
    // Those of the domain can be.
    let readable = ["versions", "node names", "qos", "left behind"];
    let findings = all["findings"].as_array().unwrap();
    let found = findings.iter().filter(|finding| !readable.contains(&finding["check"].as_str().unwrap()));
    for finding in found {
        assert_eq!(finding["verdict"], "unknown", "{finding}");
        assert!(finding["value"].as_str().unwrap().contains(": "), "{finding}");
    }
    assert_eq!((findings.len(), &all["cores"], &all["fit"]), (22, &Value::Null, &Value::Bool(false)));

    // One that is there and does not say what it should.
    let root = good_host();
    for (path, text, check) in [
        ("proc/sys/kernel/sched_rt_runtime_us", "much\n", "throttling"),
        ("sys/kernel/mm/transparent_hugepage/enabled", "\n", "huge pages"),
        ("proc/self/status", "Uid:\t1000\n", "locked memory"),
        ("proc/stat", "cpu0 1 0 0 0 0 0 0 9\n", "steal"),
    ] {
        put(&root, path, text);
        assert_eq!(finding(&root, check, &[]).0, "unknown", "{check}");
    }
    remove(&root, "proc/swaps");
    fs::create_dir(root.path().join("proc/swaps")).unwrap();
    expect(&root, "swap", "unknown", "/proc/swaps: Is a directory");
    assert_eq!(doctor(root.path(), &[]).status.code(), Some(1));
}

#[test]
fn virtual_machines_and_versions_of_kernel_and_cgroups() {
    let root = good_host();
    remove(&root, &format!("{CPU}/cpu2/cpufreq"));
    remove(&root, &format!("{CPU}/cpu2/cpuidle"));
    put(&root, "proc/cpuinfo", "flags\t\t: hypervisor\n");
    expect(&root, "governor", "unknown", "core 2 has no cpufreq folder");
    expect(&root, "idle states", "unknown", "core 2 has no cpuidle folder");
    expect(&root, "steal", "unknown", "whose hypervisor may not report it");

    put(&root, "proc/sys/kernel/osrelease", "6.12.1\n");
    put(&root, "proc/sys/kernel/sched_rt_runtime_us", "950000\n");
    // Real-time groups may have been built in, unless it is told that they were not.
    expect(&root, "throttling", "advice", "950000 of each");
    put(&root, "boot/config-6.12.1", "CONFIG_SMP=y\n# CONFIG_RT_GROUP_SCHED is not set\n");
    expect(&root, "throttling", "good", "does not apply");
    expect(&root, "fair server", "unknown", "cpu2/runtime: No such file or directory (debugfs");
    for core in [2, 3] {
        let folder = format!("sys/kernel/debug/sched/fair_server/cpu{core}");
        put(&root, &format!("{folder}/runtime"), "50000000\n");
        put(&root, &format!("{folder}/period"), "1000000000\n");
    }
    expect(&root, "fair server", "advice", "get 50000 of each 1000000 µs");
    // The largest share counts, not the longest time.
    put(&root, "sys/kernel/debug/sched/fair_server/cpu3/runtime", "40000000\n");
    put(&root, "sys/kernel/debug/sched/fair_server/cpu3/period", "100000000\n");
    expect(&root, "fair server", "advice", "get 40000 of each 100000 µs");

    put(&root, "proc/self/cgroup", "1:cpu:/robot\n");
    put(&root, "proc/self/mountinfo", "32 31 0:29 /else /sys/fs/cgroup/cpu rw - cgroup cgroup rw,cpu\n");
    expect(&root, "cgroup", "unknown", "group /robot of the cpu controller");
    put(&root, "proc/self/mountinfo", "32 31 0:29 / /sys/fs/cgroup/cpu rw - cgroup cgroup rw,cpu\n");
    expect(&root, "cgroup", "good", "without runtimes");
    put(&root, "sys/fs/cgroup/cpu/robot/cpu.rt_runtime_us", "950000\n");
    expect(&root, "cgroup", "good", "group /robot has 950000 µs");
    // A container has its own group alone.
    put(&root, "proc/self/mountinfo", "32 31 0:29 /robot /sys/fs/cgroup/cpu ro - cgroup cgroup rw,cpu\n");
    put(&root, "sys/fs/cgroup/cpu/cpu.rt_runtime_us", "0\n");
    expect(&root, "cgroup", "bad", "(/sys/fs/cgroup/cpu/cpu.rt_runtime_us is 0)");
    let said = text(&doctor(root.path(), &[]));
    let said: Vec<_> = said.split_whitespace().collect();
    assert!(said.join(" ").contains("fix: start the container with --cpu-rt-runtime=950000"), "{said:?}");
    put(&root, "boot/config-6.12.1", "CONFIG_RT_GROUP_SCHED=y\n");
    expect(&root, "throttling", "advice", "950000 of each");

    remove(&root, "sys/kernel/mm/transparent_hugepage");
    expect(&root, "huge pages", "good", "not in this kernel");
    remove(&root, "run/systemd");
    expect(&root, "logout", "good", "no systemd-logind");
}

#[test]
fn cores_are_named_or_isolated_or_all() {
    let root = good_host();
    assert_eq!(finding(&root, "interrupts", &["--cores", "0"]).0, "bad");
    assert_eq!(finding(&root, "isolation", &["--cores", "1-2"]).0, "advice");
    let (verdict, value) = finding(&root, "cores", &["--cores", "3,7"]);
    assert!(verdict == "bad" && value.contains("3,7, of which only these are online: 0-3"), "{value}");
    put(&root, &format!("{CPU}/isolated"), "\n");
    expect(&root, "cores", "good", "0-3, all there are");
    expect(&root, "interrupts", "advice", "devices interrupt real-time cores 0-3: 25 (7), 24 (?)");
    put(&root, "sys/fs/cgroup/cpuset.cpus.isolated", "3\n");
    expect(&root, "isolation", "good", "cores 3 are isolated");
}

#[test]
fn json_has_one_shape() {
    let output = doctor(bad_host().path(), &["--json"]);
    let all: Value = serde_json::from_str(&text(&output)).unwrap();
    let keys = |value: &Value| value.as_object().unwrap().keys().cloned().collect::<Vec<_>>();
    assert_eq!(keys(&all), ["cores", "domain", "findings", "fit", "interruptions"]);
    assert_eq!((&all["cores"], &all["domain"]), (&"2-3".into(), &98.into()));
    for finding in all["findings"].as_array().unwrap() {
        assert_eq!(keys(finding), ["check", "cost_source", "cost_us", "fix", "script", "value", "verdict"]);
        // Whoever is told of a fault is told of its cost, where it is one of time, and of what mends it.
        assert!(finding["verdict"] == "good" || finding["fix"] != "", "{finding}");
    }
}

#[test]
fn the_script_is_one_for_sh_and_is_not_run() {
    let root = bad_host();
    let output = doctor(root.path(), &["--fix-script"]);
    assert_eq!(output.status.code(), Some(0));
    let script = text(&output);
    for line in [
        "#!/bin/sh",
        "sysctl -w kernel.sched_rt_runtime_us=-1",
        "echo 0-1 > /proc/irq/25/smp_affinity_list || echo 'interrupt 25 stays' >&2  # nvme0q1",
        "echo performance > /sys/devices/system/cpu/cpu3/cpufreq/scaling_governor",
        "echo 0 > /sys/devices/system/cpu/cpu0/online",
        "echo madvise > /sys/kernel/mm/transparent_hugepage/enabled",
    ] {
        assert!(script.lines().any(|found| found == line), "{line} in {script}");
    }
    let file = root.path().join("fix.sh");
    fs::write(&file, &script).unwrap();
    assert!(Command::new("sh").arg("-n").arg(&file).status().unwrap().success(), "{script}");
    assert_eq!(
        fs::read_to_string(root.path().join(format!("{CPU}/cpu3/cpufreq/scaling_governor"))).unwrap(),
        "powersave\n"
    );
}

#[test]
fn a_system_file_is_checked_against_the_host() {
    let root = good_host();
    let kernel_thread = |pid: u32, name: &str, priority: u32, cores: &str| {
        let stat = format!("{pid} ({name}) S 2 {} {priority} 1 0\n", ["0"; 35].join(" "));
        put(&root, &format!("proc/{pid}/stat"), &stat);
        put(&root, &format!("proc/{pid}/status"), &format!("Cpus_allowed_list:\t{cores}\n"));
    };
    let file = root.path().join("robot.toml");
    let system = |cores: &str, priority: u8| {
        fs::write(&file, format!("[hosts.robot]\ncores = {cores}\nsampler_priority = {priority}\n[nodes.n]\n[callbacks.imu]\ntopic = \"/imu\"\nwcet = \"1ms\"\npriority = 50\ncore = 3\n[topics.\"/imu\"]\nperiod = \"10ms\"\ntype = \"std_msgs/msg/UInt64\"\ndepth = 2\n")).unwrap();
    };
    system("[2, 3]", 90);
    let args = ["--system", file.to_str().unwrap()];
    assert_eq!(finding(&root, "kernel threads", &args).0, "unknown");
    kernel_thread(40, "irq/24-eth0", 50, "0-1");
    assert_eq!(finding(&root, "kernel threads", &args).0, "good");
    kernel_thread(41, "irq/25-nvme0q1", 50, "2");
    let (verdict, value) = finding(&root, "kernel threads", &args);
    assert!(verdict == "advice" && value.contains("up to 90: irq/25-nvme0q1 (50)"), "{value}");
    let (verdict, value) = finding(&root, "memory of the file", &args);
    // Samples of 128 bytes: 2 in the queue, 4 that the callback and 4 that the publisher may hold.
    assert!(verdict == "good" && value.contains("claim 1.25 KiB with one publisher each"), "{value}");
    assert_eq!(finding(&root, "stated throttling", &args).0, "good");
    put(&root, "proc/sys/kernel/sched_rt_runtime_us", "950000\n");
    assert_eq!(finding(&root, "stated throttling", &args).0, "advice");
    let text = fs::read_to_string(&file).unwrap();
    let stated = "[overheads]\nthrottling = { period = \"1000000us\", runtime = \"950000us\" }\n";
    fs::write(&file, text + stated).unwrap();
    assert_eq!(finding(&root, "stated throttling", &args).0, "good");

    system("[3, 7]", 99);
    assert_eq!(
        finding(&root, "cores", &args),
        ("bad".into(), "3,7, of which only these are online: 0-3".into())
    );
    assert_eq!(finding(&root, "kernel threads", &args).0, "bad");
    assert_eq!(finding(&root, "priority", &args).0, "bad", "99 is above the limit");
}

#[test]
fn what_cannot_be_used_is_refused_with_2() {
    let root = good_host();
    let hosts = Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/systems/two-hosts.toml");
    let wrong = root.path().join("proc/cmdline");
    for (args, reason) in [
        (&["--system", hosts.to_str().unwrap()][..], "TAUT_HOST=<"),
        (&["--system", "/none.toml"], "`/none.toml` cannot be read"),
        (&["--system", wrong.to_str().unwrap()], "has 1 problem"),
        (&["--cores", "two"], "a list of cores is 2-3,5"),
        (&["--measure", "1ms"], "--measure watches this host"),
        (&["--json", "--fix-script"], "cannot be used with"),
    ] {
        let output = doctor(root.path(), args);
        let errors = String::from_utf8(output.stderr).unwrap();
        assert!(output.status.code() == Some(2) && output.stdout.is_empty(), "{args:?}: {errors}");
        assert!(errors.contains(reason), "{args:?}: {errors}");
    }
}

#[test]
fn a_domain_in_which_much_is_wrong() {
    let root = good_host();
    let look = || {
        let mut command = Command::new(env!("CARGO_BIN_EXE_taut"));
        command.args(["doctor", "--domain", &DOMAIN.to_string(), "--root"]).arg(root.path());
        let output = command.output().unwrap();
        (output.status.code(), String::from_utf8(output.stdout).unwrap())
    };
    let participant = Participant::new(DOMAIN).unwrap();
    let other = Participant::new(DOMAIN).unwrap();
    let node = |participant: &Participant, name: &str| {
        let node = participant.create_node(name, "/").unwrap();
        (participant.for_node(&node), node)
    };
    let (lidar, _lidar) = node(&participant, "lidar");
    let (map, _map) = node(&participant, "map");
    let scan = TopicType::new("a_msgs/msg/Scan");
    let _publisher = lidar.create_raw_publisher("/scan", &scan, Qos::default(), Limits::default()).unwrap();
    let _fits = map.create_raw_subscription("/scan", &scan, Qos::default(), Limits::default()).unwrap();
    let (code, text) = look();
    assert_eq!(code, Some(0), "{text}");
    assert!(text.contains("good     node names: 2 nodes in domain 99, each name once"), "{text}");

    let pid = std::process::id();
    let (_twice, _node) = node(&other, "map");
    let late = Qos::default().transient_local();
    let _late = map.create_raw_subscription("/scan", &scan, late, Limits::default()).unwrap();
    let odometry = TopicType::new("a_msgs/msg/Odometry");
    let _alien = map.create_raw_subscription("/scan", &odometry, Qos::default(), Limits::default()).unwrap();
    let (code, text) = look();
    assert_eq!(code, Some(1), "{text}");
    for line in [
        &*format!("bad      node names: 2 nodes are called /map: process {pid}, process {pid}\n"),
        "bad      qos: /scan: no message gets from /lidar -> /map: the offered durability does not meet",
        "bad      qos: /scan: no message gets from /lidar -> /map: their types differ\n",
    ] {
        assert!(text.contains(line), "{line} in {text}");
    }
    // As if it was built with another version.
    let file = shared_path(DOMAIN).join(format!("p{:016x}", other.id()));
    OpenOptions::new().write(true).open(&file).unwrap().write_at(&77_u32.to_ne_bytes(), 8).unwrap();
    let (code, text) = look();
    assert!(code == Some(1) && text.contains("bad      versions: /dev/shm/taut_99_"), "{text}");
}

#[test]
fn files_of_killed_processes_are_found() {
    // A scope in which nobody cleans up.
    let scope = format!("doctor-{}", std::process::id());
    let folder = format!("taut_{DOMAIN}_{}.{scope}", rustix::process::geteuid().as_raw());
    shm::make_folder(&folder).unwrap();
    let _living = OwnFile::create(&format!("{folder}/p")).unwrap();
    // Their owner is gone, as after `kill -9`.
    for name in ["p", "s", "trace_p"] {
        drop(OwnFile::create(&format!("{folder}/{name}")).unwrap());
    }
    let root = good_host();
    let mut command = Command::new(env!("CARGO_BIN_EXE_taut"));
    command.args(["doctor", "--domain", &DOMAIN.to_string(), "--root"]).arg(root.path());
    let output = command.env("TAUT_SCOPE", &scope).output().unwrap();
    fs::remove_dir_all(Path::new(shm::DIRECTORY).join(&folder)).unwrap();
    let text = text(&output);
    let line = "advice   left behind: of processes that were killed: 2 files, 0 B, and 1 traces, 0 B, in";
    assert!(text.contains(line), "{text}");
    assert_eq!(output.status.code(), Some(0));
}

#[test]
fn what_a_killed_domain_left_is_named_and_removed() {
    let scope = format!("doctor-dead-{}", std::process::id());
    let user = rustix::process::geteuid().as_raw();
    let folder = Path::new(shm::DIRECTORY).join(format!("taut_{DOMAIN}_{user}.{scope}"));
    let mut command = Command::new(env!("CARGO_BIN_EXE_taut"));
    command.args(["log", "--domain", &DOMAIN.to_string()]).env("TAUT_SCOPE", &scope);
    let mut only =
        command.stdout(std::process::Stdio::null()).stderr(std::process::Stdio::null()).spawn().unwrap();
    let has_joined = || {
        let names = fs::read_dir(&folder).into_iter().flatten().flatten();
        names.map(|entry| entry.file_name()).any(|name| name.to_string_lossy().starts_with('p'))
    };
    let begin = std::time::Instant::now();
    while !has_joined() && begin.elapsed() < std::time::Duration::from_secs(30) {
        std::thread::sleep(std::time::Duration::from_millis(1));
    }
    assert!(has_joined());
    only.kill().unwrap();
    only.wait().unwrap();
    let doctor = |args: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_taut"));
        text(&command.args(["doctor", "--domain", EMPTY]).args(args).output().unwrap())
    };
    // Any other program of this user that starts meanwhile removes it, too.
    let named = doctor(&[]);
    let name = format!("domain {DOMAIN} of scope {scope} (");
    let words = named.split_whitespace().collect::<Vec<_>>().join(" ");
    assert!(words.contains(&name) || !folder.exists(), "{named}");
    let script = doctor(&["--fix-script"]);
    let is_alone = script.lines().any(|line| line == "taut doctor --remove-dead");
    let is_told = script.contains("\n# As the user whose domains they are: taut doctor --remove-dead\n");
    assert!(!is_alone && (is_told || !folder.exists()), "{script}");
    doctor(&["--remove-dead"]);
    assert!(!folder.exists());
}

#[test]
fn this_host_as_anybody() {
    let temporary = tempfile::tempdir().unwrap();
    let copy = temporary.path().join("taut");
    fs::copy(env!("CARGO_BIN_EXE_taut"), &copy).unwrap();
    for path in [&copy, temporary.path()] {
        fs::set_permissions(path, fs::Permissions::from_mode(0o755)).unwrap();
    }
    let is_root = rustix::process::geteuid().is_root();
    for user in [None, is_root.then_some(65_534)].into_iter().take(1 + usize::from(is_root)) {
        for args in [&[][..], &["--fix-script"], &["--measure", "1ms", "--cores", "0", "--json"]] {
            let mut command = Command::new(&copy);
            command.arg("doctor").args(["--domain", EMPTY]).args(args).current_dir("/");
            if let Some(user) = user {
                command.uid(user).gid(user);
            }
            let output = command.output().unwrap();
            let errors = String::from_utf8(output.stderr).unwrap();
            assert!(
                matches!(output.status.code(), Some(0 | 1)) && errors.is_empty(),
                "{user:?} {args:?}: {errors}"
            );
            let text = String::from_utf8(output.stdout).unwrap();
            assert!(text.contains("preemption"), "{text}");
            if args.contains(&"--measure") {
                let all: Value = serde_json::from_str(&text).unwrap();
                assert_eq!(
                    (&all["interruptions"][0]["core"], all["interruptions"].as_array().unwrap().len()),
                    (&0.into(), 1)
                );
            }
        }
    }
}
