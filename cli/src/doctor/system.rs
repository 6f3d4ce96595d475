// SPDX-License-Identifier: MIT OR Apache-2.0
//! `--system`: whether a system file fits this host. `taut check` says whether it is schedulable.

use super::domain::free_bytes;
use super::finding::{Checked, Cost, Finding};
use super::host::Host;
use super::kernel::allowance;
use crate::check::{read_file, this_host};
use crate::verb::{Failure, Outcome};
use indicatif::BinaryBytes;
use std::path::Path;
use std::sync::mpsc;
use tautline::{CoreSet, Limits, Policy, topic_memory};
use tautline_analysis::Reservation;
use tautline_analysis::file::{CheckedCallback, CheckedSystem, CoreEntry, SystemFile};
use tautline_definitions::find_schema;
use tautline_rt::{RtError, ThreadBuilder};
use tautline_schema::{Layout, Size};
use tautline_transport::Qos;

/// A system file, and one of its hosts.
pub struct System {
    file: SystemFile,
    checked: CheckedSystem,
    host: String,
}

impl System {
    pub fn read(path: &Path) -> Outcome<Self> {
        let file = read_file(path)?;
        let host = this_host(&file, &path.display().to_string()).map_err(Failure::unusable)?.to_owned();
        Ok(System { checked: file.check(), file, host })
    }

    /// The cores of this host, with their positions in the file.
    fn own(&self) -> impl Iterator<Item = (usize, &CoreEntry)> {
        self.file.cores().iter().enumerate().filter(|(_, core)| core.host == self.host)
    }

    pub fn cores(&self) -> CoreSet {
        self.own().map(|(_, core)| core.number).collect()
    }

    fn callbacks(&self) -> impl Iterator<Item = &CheckedCallback> {
        self.checked.callbacks.iter().filter(|callback| callback.host == self.host)
    }

    /// The highest priority of a thread of this host.
    pub fn priority(&self) -> u8 {
        let samplers = self.own().map(|(_, core)| core.sampler_priority);
        let callbacks = self.callbacks().filter(|callback| callback.entry.reservation.is_none());
        samplers.chain(callbacks.map(|callback| callback.entry.priority)).max().unwrap_or(1)
    }

    pub fn findings(&self, host: &Host) -> Vec<Finding> {
        [
            Finding::of("kernel threads", self.kernel_threads(host)),
            Finding::of("stated throttling", self.throttling(host)),
            Finding::of("memory of the file", self.memory(host)),
        ]
        .into_iter()
        .chain(self.reservations(host).map(|checked| Finding::of("reservations", checked)))
        .collect()
    }

    /// Whether the kernel grants the file's reservations, if there are any.
    fn reservations(&self, host: &Host) -> Option<Checked> {
        let reserved: Vec<_> =
            self.callbacks().filter(|callback| callback.entry.reservation.is_some()).collect();
        if reserved.is_empty() {
            return None;
        }
        if !host.tree.is_here() {
            return Some(Err("SCHED_DEADLINE is tried on the host itself".into()));
        }
        if let Err((name, error)) = try_all(&reserved) {
            let value = format!("SCHED_DEADLINE for `{name}` is refused (tried)");
            let cost = Cost::Unknown("programs do not start in real time");
            return Some(Ok(Finding::bad(value).costs(cost).fix(error.to_string())));
        }
        Some(Ok(Finding::good(format!(
            "SCHED_DEADLINE is granted to all {} of the file (tried)",
            reserved.len()
        ))))
    }

    /// Kernel threads for interrupts, timers and RCU that would wait for the file's threads.
    fn kernel_threads(&self, host: &Host) -> Checked {
        let (highest, cores) = (self.priority(), self.cores());
        let (mut count, mut waiting) = (0, Vec::new());
        let numbers = host.tree.list("/proc")?.into_iter().filter(|name| name.parse::<u32>().is_ok());
        for number in numbers {
            // The thread has ended meanwhile.
            let Ok(stat) = host.tree.read(&format!("/proc/{number}/stat")) else { continue };
            let Some(thread) = KernelThread::parse(&stat) else { continue };
            count += 1;
            if thread.priority.is_none_or(|priority| priority > highest) || !thread.is_service() {
                continue;
            }
            let status = host.tree.read(&format!("/proc/{number}/status"))?;
            let allowed = status.lines().find_map(|line| line.strip_prefix("Cpus_allowed_list:"));
            let allowed = allowed
                .and_then(CoreSet::parse)
                .ok_or_else(|| format!("/proc/{number}/status has no cores"))?;
            // A thread that may also run elsewhere need not wait.
            if allowed.iter().all(|core| cores.contains(core)) {
                waiting.push(format!("{} ({})", thread.name, thread.priority.unwrap_or(0)));
            }
        }
        if count == 0 {
            return Err("/proc shows no thread of the kernel (a container's own PID namespace?)".into());
        }
        if highest == 99 {
            let value = "the file has priority 99, which is that of the kernel's own most urgent threads";
            return Ok(Finding::bad(value).fix("stay at 98 or below"));
        }
        if waiting.is_empty() {
            return Ok(Finding::good(format!(
                "no thread for interrupts, timers and RCU is bound to cores {cores} at priority {highest} or below"
            )));
        }
        let value =
            format!("wait on cores {cores} for threads of the file, up to {highest}: {}", waiting.join(", "));
        Ok(Finding::advice(value)
            .costs(Cost::Unknown("not known: it costs what depends on these, not the file's threads"))
            .fix("send the interrupts to other cores; what callbacks depend on gets a higher priority: chrt -f -p PRIORITY PID"))
    }

    /// Whether the file states the kernel's pauses of real-time threads.
    fn throttling(&self, host: &Host) -> Checked {
        let good = Ok(Finding::good("the file allows for all that the kernel does"));
        let Some((runtime, period)) = allowance(host)? else { return good };
        // The file states the same share, or a smaller one.
        let allows = |place: usize| {
            let stated = self.file.system().cores.get(place).and_then(|core| core.overheads.throttling);
            stated.is_some_and(|stated| {
                stated.runtime_ns as f64 / stated.period_ns as f64 <= runtime as f64 / period as f64
            })
        };
        if self.own().all(|(place, _)| allows(place)) {
            return good;
        }
        let line = format!("throttling = {{ period = \"{period}us\", runtime = \"{runtime}us\" }}");
        let value = format!(
            "the kernel keeps real-time threads to {runtime} of {period} µs, which the file does not say"
        );
        Ok(Finding::advice(value)
            .costs(Cost::Known(
                (period - runtime) as f64,
                "in each period with more work; as `throttling` and `fair server`".into(),
            ))
            .fix(format!("put into [overheads]: {line}")))
    }

    /// Compares the memory that the file's topics will claim, with one publisher each and default limits, with the free memory.
    fn memory(&self, host: &Host) -> Checked {
        let (mut bytes, mut unknown, mut variable) = (0_u64, Vec::new(), 0);
        let limits = Limits::default();
        for topic in self.file.topics() {
            let takers = || self.callbacks().filter(|callback| callback.entry.topics.contains(&topic.name));
            let size = topic.type_name.as_deref().and_then(|name| body_size(&topic.name, name));
            let Some(size) = size else {
                unknown.push(topic.name.as_str());
                continue;
            };
            let body = match size {
                Size::Fixed(bytes) => bytes,
                Size::Formula(_) => {
                    variable += 1;
                    limits.message_bytes
                }
            };
            let computed = takers().filter_map(|callback| callback.capacity).max();
            let stated = topic.depth.and_then(|depth| usize::try_from(depth).ok());
            let depth = stated.or(computed).unwrap_or(Qos::default().depth);
            let memory = topic_memory(body, Qos::keep_last(depth), limits, takers().count(), depth);
            bytes = bytes.saturating_add(memory.claimed_bytes as u64);
        }
        let free = free_bytes(&host.tree)?;
        let mut value = format!(
            "its topics claim {} with one publisher each, {} are free",
            BinaryBytes(bytes),
            BinaryBytes(free)
        );
        if variable > 0 {
            value += &format!(
                "; {variable} of no fixed size are counted with {} a message",
                BinaryBytes(limits.message_bytes as u64)
            );
        }
        let grow = "mount -o remount,size=4G /dev/shm, or lower depths (docs/memory.md)";
        if bytes > free {
            return Ok(Finding::bad(value).fix(grow));
        }
        if !unknown.is_empty() {
            value += &format!(
                "; without these, whose type is not stated or not known here: {}",
                unknown.join(", ")
            );
            return Ok(Finding::unknown(value)
                .fix("state `type` in [topics], and source the workspace that defines it"));
        }
        Ok(Finding::good(value))
    }
}

/// Starts threads with these reservations, which the kernel grants only as far as all together leave something for others. Returns the first
/// callback whose thread is refused, and why.
fn try_all<'c>(reserved: &[&'c CheckedCallback]) -> Result<(), (&'c str, RtError)> {
    let mut threads = Vec::new();
    let mut tried = Ok(());
    for callback in reserved {
        let Some(Reservation { runtime_ns, period_ns }) = callback.entry.reservation else { continue };
        let probe = ThreadBuilder::new("rt-probe").policy(Policy::Deadline { runtime_ns, period_ns });
        let probe = if callback.entry.floats { probe } else { probe.cores(CoreSet::one(callback.core)) };
        // The thread sleeps until all are there, or one is refused.
        let (stop, stopped) = mpsc::channel::<()>();
        match probe.spawn(move || move || stopped.recv().unwrap_or(())) {
            Ok(thread) => threads.push((stop, thread)),
            Err(error) => {
                tried = Err((callback.entry.name.as_str(), error));
                break;
            }
        }
    }
    for (stop, thread) in threads {
        drop(stop);
        let _ = thread.join();
    }
    tried
}

fn body_size(topic: &str, type_name: &str) -> Option<Size> {
    let schema = find_schema(topic, &type_name.parse().ok()?, None).ok()?;
    Some(Layout::of(&schema).size)
}

/// A kernel thread, from /proc/PID/stat.
#[derive(Debug, PartialEq)]
struct KernelThread {
    name: String,
    /// The priority under SCHED_FIFO or SCHED_RR.
    priority: Option<u8>,
}

impl KernelThread {
    /// `None` if it is not a kernel thread.
    fn parse(stat: &str) -> Option<Self> {
        // The name is in parentheses and may contain parentheses.
        let (front, rest) = stat.rsplit_once(')')?;
        let name = front.split_once('(')?.1.to_owned();
        let fields: Vec<&str> = rest.split_whitespace().collect();
        // proc(5) counts fields from 1, and two were split off: ppid is 4, rt_priority 40, policy 41. kthreadd is process 2.
        let field = |number: usize| fields.get(number - 3).and_then(|field| field.parse::<u32>().ok());
        if field(4)? != 2 {
            return None;
        }
        let is_real_time = matches!(field(41)?, 1 | 2);
        Some(KernelThread {
            name,
            priority: field(40).filter(|_| is_real_time).and_then(|p| p.try_into().ok()),
        })
    }

    /// Whether other threads wait for its work.
    fn is_service(&self) -> bool {
        ["irq/", "ktimers/", "ksoftirqd/", "rcu", "irq_work/"]
            .iter()
            .any(|prefix| self.name.starts_with(prefix))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tautline_rt::permission::test_needs;

    /// Each alone is granted where there is more than one core.
    #[test]
    fn reservations_that_the_kernel_does_not_grant_together_are_refused() {
        let limit = std::fs::read_to_string("/proc/sys/kernel/sched_rt_runtime_us").unwrap_or_default();
        let online = std::fs::read_to_string("/sys/devices/system/cpu/online").unwrap_or_default();
        let cores = CoreSet::parse(&online).map_or(0, |cores| cores.iter().count());
        let probe = ThreadBuilder::new("rt-probe")
            .policy(Policy::Deadline { runtime_ns: 1_000_000, period_ns: 100_000_000 });
        let granted = probe.spawn(|| || ()).and_then(|thread| thread.join());
        if test_needs(granted).is_none() || limit.trim() == "-1" || cores < 2 {
            return;
        }
        let mut text = format!("[hosts.h]\ncores = {cores}\n[nodes.n]\n");
        for n in 0..cores {
            text += &format!(
                "[callbacks.c{n}]\nperiod = \"10ms\"\nwcet = \"1ms\"\ncore = \"any\"\n\
                 reservation = {{ runtime = \"9.95ms\", period = \"10ms\" }}\n"
            );
        }
        let checked = SystemFile::parse(&text).unwrap().check();
        let all: Vec<_> = checked.callbacks.iter().collect();
        assert!(try_all(&all[..1]).is_ok() && try_all(&all).is_err());
    }

    #[test]
    fn threads_of_the_kernel_are_read() {
        let stat = |name: &str, parent: u32, priority: u32, policy: u32| {
            format!("77 ({name}) S {parent} {} {priority} {policy} 0 0", ["0"; 35].join(" "))
        };
        let irq = KernelThread::parse(&stat("irq/36-(nvme) 0", 2, 50, 1)).unwrap();
        assert_eq!((&*irq.name, irq.priority, irq.is_service()), ("irq/36-(nvme) 0", Some(50), true));
        let worker = KernelThread::parse(&stat("kworker/0:1", 2, 0, 0)).unwrap();
        assert_eq!((worker.priority, worker.is_service()), (None, false));
        assert_eq!(KernelThread::parse(&stat("irq/1", 1, 50, 1)), None, "somebody's process");
        assert_eq!(KernelThread::parse("garbage"), None);
    }
}
