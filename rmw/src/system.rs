// SPDX-License-Identifier: MIT OR Apache-2.0
//! Statistics of this process's callbacks, and their entries in the system file of `TAUT_SYSTEM`.

use crate::error::{Error, Result};
use crate::thread::ThreadPlan;
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::time::Duration;
use tautline_analysis::file::{CheckedCallback, Client, SystemFile};
use tautline_executor::{CallbackOptions, ForeignCallback, ProcessInfo, StatisticsFile};

/// A system file's entries for the ROS nodes of one host, if there is a file, and this process's callback statistics.
pub(crate) struct System {
    callbacks: Vec<CheckedCallback>,
    /// The threads of these callbacks, each once; none with `TAUT_REALTIME=off`.
    threads: Vec<Option<Arc<ThreadPlan>>>,
    /// Whether there is a file, so that processor time is measured.
    is_named: bool,
    /// `None`: it could not be created, and there is no file.
    statistics: Option<StatisticsFile>,
    /// By name.
    made: Mutex<BTreeMap<String, Weak<ForeignCallback>>>,
}

impl System {
    /// From the environment.
    pub(crate) fn of_environment(domain: u32) -> Result<Self> {
        let path = std::env::var_os("TAUT_SYSTEM").filter(|path| !path.is_empty());
        let named = path.map(|path| Self::read(std::path::absolute(&path).unwrap_or_else(|_| path.into())));
        let (callbacks, about) = named.transpose()?.flatten().unwrap_or_else(|| {
            let realtime = tautline_rt::permission::realtime_permitted(1).is_ok();
            (Vec::new(), ProcessInfo { realtime, ..ProcessInfo::of_this() })
        });
        let is_named = !callbacks.is_empty();
        let is_governed = is_named && is_realtime_wanted()?;
        let threads = if is_governed { plans(&callbacks) } else { vec![None; callbacks.len()] };
        let statistics = match StatisticsFile::create(&StatisticsFile::prefix(domain), &about) {
            Ok(file) => Some(file),
            Err(error) if is_named => {
                return Err(Error::other(format!("statistics in /dev/shm: {error}")));
            }
            Err(error) => {
                tracing::warn!("`taut top` will not show this process's callbacks: /dev/shm: {error}");
                None
            }
        };
        Ok(System { is_named, callbacks, threads, statistics, made: Mutex::default() })
    }

    /// This host's ROS callbacks in a system file; `None` if there are none.
    fn read(path: PathBuf) -> Result<Option<(Vec<CheckedCallback>, ProcessInfo)>> {
        let refuse = |reason: String| Error::other(format!("TAUT_SYSTEM: {reason}"));
        let file = SystemFile::read(&path).map_err(|error| refuse(error.to_string()))?;
        let wanted = std::env::var("TAUT_HOST").ok().filter(|host| !host.is_empty());
        let host = file.host(wanted.as_deref()).map_err(|hosts| {
            let (path, hosts) = (path.display(), hosts.join(", "));
            refuse(match &wanted {
                Some(wanted) => format!("`{path}` has no host `{wanted}`: set TAUT_HOST to one of {hosts}"),
                None => format!("`{path}` has several hosts: set TAUT_HOST to one of {hosts}"),
            })
        })?;
        let of_ros =
            |callback: &CheckedCallback| callback.host == host && callback.entry.client != Client::Tautline;
        let callbacks: Vec<_> = file.check().callbacks.into_iter().filter(of_ros).collect();
        let Some(highest) = callbacks.iter().map(|callback| callback.entry.priority).max() else {
            tracing::warn!(
                "TAUT_SYSTEM: `{}` has no callback of host `{host}` whose node has `client = \"rclcpp\"` or \"rclpy\"",
                path.display()
            );
            return Ok(None);
        };
        let about = ProcessInfo {
            host: host.to_owned(),
            realtime: tautline_rt::permission::realtime_permitted(highest).is_ok(),
            system_path: path,
            system_hash: file.fingerprint(),
            ..ProcessInfo::of_this()
        };
        Ok(Some((callbacks, about)))
    }

    /// Whether processor time of callbacks is measured, which costs a system call for each.
    pub(crate) fn measures_execution(&self) -> bool {
        self.is_named
    }

    /// The file's entry for what `node`, a full name, does with messages of `topic`.
    fn entry(&self, node: &str, topic: &str) -> Option<usize> {
        let short = node.rsplit('/').next().unwrap_or(node);
        let of = |name: &str| {
            let is_it = |callback: &CheckedCallback| {
                callback.entry.node == name && callback.entry.topics.iter().any(|of| of == topic)
            };
            self.callbacks.iter().position(is_it)
        };
        of(node).or_else(|| of(short))
    }

    /// The thread that is to run a callback, and the callback's rank if that runs the highest first.
    pub(crate) fn place(&self, node: &str, topic: &str) -> (Option<Arc<ThreadPlan>>, Option<u8>) {
        match self.entry(node, topic) {
            Some(index) => (self.threads[index].clone(), self.callbacks[index].entry.rank),
            None => (None, None),
        }
    }

    /// Whether threads get what the file states.
    pub(crate) fn is_governing(&self) -> bool {
        self.threads.iter().any(Option::is_some)
    }

    /// The statistics of what `node`, a full name, does with messages of `topic`, under its name in the file. Equal names there
    /// are one callback, even with several topics.
    ///
    /// Without a file, services and clients are not measured, because that takes memory and most nodes have seven unused ones;
    /// and failures to measure are not errors.
    pub(crate) fn callback(
        &self,
        node: &str,
        topic: &str,
        is_topic: bool,
    ) -> Result<(String, Option<Arc<ForeignCallback>>)> {
        let options = match self.entry(node, topic).map(|index| &self.callbacks[index]) {
            Some(callback) => CallbackOptions {
                bound: callback.response_overhead_ns.map(Duration::from_nanos),
                ..CallbackOptions::other()
                    .name(&callback.entry.name)
                    .period(Duration::from_nanos(callback.period_ns))
                    .deadline(Duration::from_nanos(callback.entry.deadline_ns))
                    .budget(Duration::from_nanos(callback.charged_ns))
            },
            None => CallbackOptions::other().name(format!("{node} {topic}")),
        }
        .execution_time(self.is_named);
        let Some(statistics) = self.statistics.as_ref().filter(|_| self.is_named || is_topic) else {
            return Ok((options.name, None));
        };
        let mut made = self.made.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(callback) = made.get(&options.name).and_then(Weak::upgrade) {
            return Ok((options.name, Some(callback)));
        }
        made.retain(|_, callback| callback.strong_count() > 0);
        let callback = match ForeignCallback::new(statistics, &options) {
            Ok(callback) => Arc::new(callback),
            Err(error) if self.is_named => {
                return Err(Error::other(format!("statistics of '{}': {error}", options.name)));
            }
            Err(error) => {
                tracing::warn!("`taut top` will not show '{}': /dev/shm: {error}", options.name);
                return Ok((options.name, None));
            }
        };
        made.insert(options.name.clone(), Arc::downgrade(&callback));
        Ok((options.name, Some(callback)))
    }
}

/// As Tautline's own nodes read it.
fn is_realtime_wanted() -> Result<bool> {
    match std::env::var("TAUT_REALTIME").ok().as_deref() {
        None | Some("" | "required") => Ok(true),
        Some("off") => Ok(false),
        Some(other) => {
            Err(Error::other(format!("TAUT_REALTIME is '{other}': it may be 'required' or 'off'")))
        }
    }
}

/// The thread of each callback: those of a group share it.
fn plans(callbacks: &[CheckedCallback]) -> Vec<Option<Arc<ThreadPlan>>> {
    let mut plans: Vec<Option<Arc<ThreadPlan>>> = Vec::new();
    for callback in callbacks {
        let plan = ThreadPlan::of(callback);
        let known = plans.iter().flatten().find(|known| ***known == plan).cloned();
        plans.push(Some(known.unwrap_or_else(|| Arc::new(plan))));
    }
    plans
}
