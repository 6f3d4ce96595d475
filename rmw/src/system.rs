// SPDX-License-Identifier: MIT OR Apache-2.0
//! The system file that `TAUT_SYSTEM` names: which of its callbacks are this process's, and where their statistics lie.

use crate::error::{Error, Result};
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::time::Duration;
use tautline_analysis::file::{CheckedCallback, Client, SystemFile};
use tautline_executor::{CallbackOptions, ForeignCallback, ProcessInfo, StatisticsFile};

/// A system file as one host's nodes of ROS see it.
pub(crate) struct System {
    callbacks: Vec<CheckedCallback>,
    statistics: StatisticsFile,
    /// By their names.
    made: Mutex<BTreeMap<String, Weak<ForeignCallback>>>,
}

impl System {
    /// Of the environment; `None` if that names no file, or one without callbacks of ROS's on this host.
    pub(crate) fn of_environment(domain: u32) -> Result<Option<Self>> {
        let Some(path) = std::env::var_os("TAUT_SYSTEM").filter(|path| !path.is_empty()) else {
            return Ok(None);
        };
        let path = std::path::absolute(&path).unwrap_or_else(|_| PathBuf::from(path));
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
        let statistics = StatisticsFile::create(&StatisticsFile::prefix(domain), &about)
            .map_err(|error| Error::other(format!("the statistics in /dev/shm: {error}")))?;
        Ok(Some(System { callbacks, statistics, made: Mutex::default() }))
    }

    /// The statistics of what `node`, a full name, does with messages of `topic`: under the name that the file has for it. What has one
    /// name there is one callback, however many topics trigger it.
    pub(crate) fn callback(&self, node: &str, topic: &str) -> Result<(String, Arc<ForeignCallback>)> {
        let short = node.rsplit('/').next().unwrap_or(node);
        let of = |name: &str| {
            let is_it = |callback: &&CheckedCallback| {
                callback.entry.node == name && callback.entry.topics.iter().any(|of| of == topic)
            };
            self.callbacks.iter().find(is_it)
        };
        let options = match of(node).or_else(|| of(short)) {
            Some(callback) => CallbackOptions::other()
                .name(&callback.entry.name)
                .period(Duration::from_nanos(callback.period_ns))
                .deadline(Duration::from_nanos(callback.entry.deadline_ns))
                .budget(Duration::from_nanos(callback.charged_ns)),
            None => CallbackOptions::other().name(format!("{node} {topic}")),
        };
        let mut made = self.made.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(callback) = made.get(&options.name).and_then(Weak::upgrade) {
            return Ok((options.name, callback));
        }
        made.retain(|_, callback| callback.strong_count() > 0);
        let callback = ForeignCallback::new(&self.statistics, &options)
            .map_err(|error| Error::other(format!("the statistics of '{}': {error}", options.name)))?;
        let callback = Arc::new(callback);
        made.insert(options.name.clone(), Arc::downgrade(&callback));
        Ok((options.name, callback))
    }
}
