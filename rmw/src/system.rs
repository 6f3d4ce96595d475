// SPDX-License-Identifier: MIT OR Apache-2.0
//! The system file that `TAUT_SYSTEM` names: which of its callbacks are this process's, and where their statistics lie.

use crate::error::{Error, Result};
use std::path::PathBuf;
use std::time::Duration;
use tautline_analysis::file::{CheckedCallback, Client, SystemFile};
use tautline_executor::{CallbackOptions, ForeignCallback, ProcessInfo, StatisticsFile};

/// A system file as one host's nodes of ROS see it.
pub(crate) struct System {
    callbacks: Vec<CheckedCallback>,
    statistics: StatisticsFile,
}

impl System {
    /// Of the environment; `None` if that names no file.
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
        let highest = callbacks.iter().map(|callback| callback.entry.priority).max();
        let about = ProcessInfo {
            host: host.to_owned(),
            realtime: highest
                .is_some_and(|highest| tautline_rt::permission::realtime_permitted(highest).is_ok()),
            system_path: path,
            system_hash: file.fingerprint(),
            ..ProcessInfo::of_this()
        };
        let statistics = StatisticsFile::create(&StatisticsFile::prefix(domain), &about)
            .map_err(|error| Error::other(format!("the statistics in /dev/shm: {error}")))?;
        Ok(Some(System { callbacks, statistics }))
    }

    /// The statistics of what `node`, a full name, does with messages of `topic`: under the name that the file has for it.
    pub(crate) fn callback(&self, node: &str, topic: &str) -> Result<(String, ForeignCallback)> {
        let is_node = |name: &str| name == node || name == node.rsplit('/').next().unwrap_or(node);
        let of_file = self.callbacks.iter().find(|callback| {
            is_node(&callback.entry.node) && callback.entry.topics.iter().any(|t| t == topic)
        });
        let options = match of_file {
            Some(callback) => CallbackOptions::other()
                .name(&callback.entry.name)
                .period(Duration::from_nanos(callback.period_ns))
                .deadline(Duration::from_nanos(callback.entry.deadline_ns))
                .budget(Duration::from_nanos(callback.charged_ns)),
            None => CallbackOptions::other().name(format!("{node} {topic}")),
        };
        let made = ForeignCallback::new(&self.statistics, &options)
            .map_err(|error| Error::other(format!("the statistics of '{}': {error}", options.name)))?;
        Ok((options.name, made))
    }
}
