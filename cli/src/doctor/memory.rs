// SPDX-License-Identifier: MIT OR Apache-2.0
//! Settings by which the kernel removes or moves the memory of real-time threads: swap, transparent huge pages.

use super::finding::{Checked, Finding, MEASURE};
use super::host::Host;

pub fn swap(host: &Host) -> Checked {
    let text = host.tree.read("/proc/swaps")?;
    let devices: Vec<&str> = text.lines().skip(1).filter_map(|line| line.split_whitespace().next()).collect();
    if devices.is_empty() {
        return Ok(Finding::good("none"));
    }
    Ok(Finding::advice(format!("on {}", devices.join(", ")))
        .costs(MEASURE)
        .fix("Tautline locks its memory; what does not (ContextBuilder::lock_memory(false), shared memory of ordinary programs) may wait for the disk: swapoff -a, and remove it from /etc/fstab")
        .script(["swapoff -a", "# and remove its lines from /etc/fstab"]))
}

pub fn huge_pages(host: &Host) -> Checked {
    let (folder, file) = ("/sys/kernel/mm", "/sys/kernel/mm/transparent_hugepage/enabled");
    let Some(text) = host.tree.read_if_there(file)? else {
        // A kernel without transparent huge pages still has the folder.
        return host.tree.list(folder).map(|_| Finding::good("not in this kernel"));
    };
    let mode = text.split_once('[').and_then(|(_, rest)| rest.split_once(']'));
    let (mode, _) = mode.ok_or_else(|| format!("{file} is '{text}'"))?;
    if mode != "always" {
        return Ok(Finding::good(mode));
    }
    Ok(Finding::advice("always: the kernel merges pages of any process, which stops it for that time")
        .costs(MEASURE)
        .fix(format!("echo madvise > {file}, or boot with transparent_hugepage=madvise"))
        .script([format!("echo madvise > {file}")]))
}
