// SPDX-License-Identifier: MIT OR Apache-2.0
//! Permissions of this user: real-time priorities, locked memory, real-time threads in its cpu cgroup, files in /dev/shm after logout.

use super::finding::{Checked, Cost, Finding};
use super::host::{Host, Tree};
use indicatif::BinaryBytes;
use std::collections::BTreeMap;
use tautline_rt::RtError;
use tautline_rt::permission::{cpu_group, cpu_group_folder, realtime_permitted};

const REFUSED: Cost = Cost::Unknown("programs do not start in real time");
/// Numbers of capabilities: see capability.h.
const SYS_NICE: u32 = 23;
const IPC_LOCK: u32 = 14;

const LIMITS: &str = "/etc/security/limits.d/90-tautline.conf";

/// The script lines that grant these limits to a group of users.
fn allow(limits: &[&str]) -> Vec<String> {
    let lines = limits.iter().map(|limit| {
        format!("grep -qs '^@realtime - {limit}$' {LIMITS} || echo '@realtime - {limit}' >> {LIMITS}")
    });
    let group =
        ["groupadd -f realtime".to_owned(), "# usermod -aG realtime USER, who then logs in again".into()];
    group.into_iter().chain(lines).collect()
}

pub fn priority(host: &Host) -> Checked {
    let wanted = host.priority;
    let fix = format!(
        "add the line `@realtime - rtprio 98` to {LIMITS}, join the group realtime and log in again; for a unit of systemd LimitRTPRIO=98"
    );
    let bad = |value: String, fix: String| {
        Finding::bad(value).costs(REFUSED).fix(fix).script(allow(&["rtprio 98"]))
    };
    if host.tree.is_here() {
        return Ok(match realtime_permitted(wanted) {
            Ok(()) => Finding::good(format!("SCHED_FIFO {wanted} is granted to this user (tried)")),
            Err(error) => {
                let value = format!("SCHED_FIFO {wanted} is refused (tried)");
                match error {
                    // The error's text names this program, but the robot's program needs the permission.
                    RtError::MissingCapability { .. } | RtError::PriorityLimit { .. } => bad(value, fix),
                    error => bad(value, error.to_string()).script::<String>([]),
                }
            }
        });
    }
    let limit = limit(&host.tree, "Max realtime priority")?;
    if has_capability(&host.tree, SYS_NICE)? {
        return Ok(Finding::good("CAP_SYS_NICE"));
    }
    let is_enough = limit.is_none_or(|limit| limit >= wanted.into());
    let limit = limit.map_or("none".into(), |limit| limit.to_string());
    let value = format!("limit {limit} (RLIMIT_RTPRIO), {wanted} is needed");
    Ok(if is_enough { Finding::good(value) } else { bad(value, fix) })
}

pub fn locked_memory(host: &Host) -> Checked {
    let limit = limit(&host.tree, "Max locked memory")?;
    if has_capability(&host.tree, IPC_LOCK)? {
        return Ok(Finding::good("CAP_IPC_LOCK"));
    }
    Ok(match limit {
        None => Finding::good("without a limit"),
        Some(bytes) => Finding::bad(format!("at most {} (RLIMIT_MEMLOCK)", BinaryBytes(bytes)))
            .costs(REFUSED)
            .fix(format!(
                "add the line `@realtime - memlock unlimited` to {LIMITS}, join the group realtime and log in again; for a unit of systemd LimitMEMLOCK=infinity"
            ))
            .script(allow(&["memlock unlimited"])),
    })
}

/// The soft limit of this process; `None`: unlimited.
fn limit(tree: &Tree, name: &str) -> Result<Option<u64>, String> {
    let text = tree.read("/proc/self/limits")?;
    let soft = text.lines().find_map(|line| line.strip_prefix(name)?.split_whitespace().next());
    match soft {
        Some("unlimited") => Ok(None),
        Some(soft) if soft.parse::<u64>().is_ok() => Ok(soft.parse().ok()),
        _ => Err(format!("/proc/self/limits says nothing of '{name}'")),
    }
}

/// The value of `name` in /proc/self/status.
fn status(tree: &Tree, name: &str) -> Result<String, String> {
    let text = tree.read("/proc/self/status")?;
    let value = text.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(':'));
    value.map(|value| value.trim().to_owned()).ok_or_else(|| format!("/proc/self/status has no {name}"))
}

fn has_capability(tree: &Tree, number: u32) -> Result<bool, String> {
    let text = status(tree, "CapEff")?;
    let set =
        u64::from_str_radix(&text, 16).map_err(|_| format!("CapEff of /proc/self/status is '{text}'"))?;
    Ok(set & 1 << number != 0)
}

pub fn cgroup(host: &Host) -> Checked {
    let tree = &host.tree;
    let groups = tree.read("/proc/self/cgroup")?;
    let Some(group) = cpu_group(&groups) else {
        return Ok(Finding::good("version 2 of cgroups, which has no runtime of groups"));
    };
    let Some(folder) = cpu_group_folder(group, &tree.read("/proc/self/mountinfo")?) else {
        return Err(format!(
            "/proc/self/mountinfo does not say where group {group} of the cpu controller is"
        ));
    };
    let file = folder.join("cpu.rt_runtime_us").display().to_string();
    let Some(runtime) = tree.read_if_there(&file)? else {
        return Ok(Finding::good("version 1 of cgroups, without runtimes of groups"));
    };
    if runtime != "0" {
        return Ok(Finding::good(format!("group {group} has {runtime} µs of each period")));
    }
    // A container shows only its own group, not the groups above it.
    let leave = folder.to_str().and_then(|folder| folder.strip_suffix(group));
    let leave = leave.map(|mount| format!("echo $$ > {mount}/cgroup.procs"));
    let fix = match &leave {
        Some(leave) => format!(
            "start the programs in the root group: {leave}; or give each group down to this one a runtime"
        ),
        None => {
            "start the container with --cpu-rt-runtime=950000; each group above it needs as much".to_owned()
        }
    };
    let script = leave.map(|leave| format!("# In the shell that starts the programs: {leave}"));
    Ok(Finding::bad(format!("group {group} has no real-time runtime ({file} is 0)"))
        .costs(REFUSED)
        .fix(fix)
        .script(script))
}

/// Users below this number are system users, whose files logind does not remove (SYS_UID_MAX).
const FIRST_USER: u32 = 1000;

pub fn remove_ipc(host: &Host) -> Checked {
    let tree = &host.tree;
    tree.list("/run")?;
    if !tree.has("/run/systemd/sessions") {
        return Ok(Finding::good("no systemd-logind runs"));
    }
    let uids = status(tree, "Uid")?;
    let uid: u32 = uids.split_whitespace().next().and_then(|uid| uid.parse().ok()).ok_or("no Uid")?;
    if uid < FIRST_USER {
        return Ok(Finding::good(format!("user {uid} is the system's, whose files stay")));
    }
    let (value, file) = setting(tree, "RemoveIPC")?;
    let is_no = ["no", "false", "off", "0", "n", "f"].contains(&&*value.to_lowercase());
    if is_no {
        return Ok(Finding::good(format!("RemoveIPC={value} ({file})")));
    }
    let value = format!(
        "RemoveIPC={value} ({file}): at the last logout of user {uid} its files in /dev/shm go, also from under what still runs"
    );
    Ok(Finding::bad(value)
        .fix("set RemoveIPC=no in a drop-in of logind.conf and restart systemd-logind, or run the programs as a system user's service")
        .script([
            "mkdir -p /etc/systemd/logind.conf.d",
            "printf '[Login]\\nRemoveIPC=no\\n' > /etc/systemd/logind.conf.d/90-tautline.conf",
            "systemctl restart systemd-logind",
        ]))
}

/// Folders of systemd's configuration. Of files of one name that of the last folder is used (systemd's logind.conf(5)).
const FOLDERS: [&str; 4] = ["/usr/lib/systemd", "/usr/local/lib/systemd", "/run/systemd", "/etc/systemd"];

/// The value that logind uses, and its file: the last drop-in by name, else logind.conf.
fn setting(tree: &Tree, key: &str) -> Result<(String, String), String> {
    let mut drop_ins = BTreeMap::new();
    for folder in FOLDERS {
        let folder = format!("{folder}/logind.conf.d");
        if tree.has(&folder) {
            let names = tree.list(&folder)?.into_iter().filter(|name| name.ends_with(".conf"));
            drop_ins.extend(names.map(|name| (name.clone(), format!("{folder}/{name}"))));
        }
    }
    let mut found = ("yes".to_owned(), "the default".to_owned());
    let main = FOLDERS.iter().rev().map(|folder| format!("{folder}/logind.conf")).find(|file| tree.has(file));
    for file in main.into_iter().chain(drop_ins.into_values()) {
        let text = tree.read_if_there(&file)?.unwrap_or_default();
        let mut assigned =
            text.lines().filter_map(|line| line.trim().strip_prefix(key)?.trim().strip_prefix('='));
        if let Some(value) = assigned.next_back() {
            found = (value.trim().to_owned(), file);
        }
    }
    Ok(found)
}
