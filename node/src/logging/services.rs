// SPDX-License-Identifier: MIT OR Apache-2.0
//! The two services with which other nodes read and set the levels of loggers.

use super::severity::{LEVELS, LogSeverity};
use crate::error::Result;
use crate::node::Node;
use futures::FutureExt;
use futures::future::join;
use std::future::Future;
use tautline_ros_msgs::rcl_interfaces::msg::{LoggerLevel, SetLoggerLevelsResult};
use tautline_ros_msgs::rcl_interfaces::srv::{GetLoggerLevels, SetLoggerLevels};

/// How many loggers of a process may have a level of their own before requests for more are refused.
const MOST: usize = 128;

impl Node {
    /// Serves the levels of this process's loggers to other nodes, as rclcpp's nodes with `enable_logger_service` do:
    /// `get_logger_levels` and `set_logger_levels` below the node's name, which `taut log level` calls. The future responds,
    /// on whatever executor it is spawned. Call it once per node.
    ///
    /// Requests can set the levels of at most 128 loggers of the process, because each one makes every log
    /// statement compare one more name.
    ///
    /// # Errors
    /// [`Error::Transport`](crate::Error::Transport) if a service cannot be created.
    pub fn make_logger_handler(&mut self) -> Result<impl Future<Output = ()> + Send + use<>> {
        let get = self.answer::<GetLoggerLevels::Service>("get_logger_levels", |request| get(&request))?;
        let set = self.answer::<SetLoggerLevels::Service>("set_logger_levels", |request| set(&request))?;
        Ok(join(get, set).map(drop))
    }
}

fn get(request: &GetLoggerLevels::Request) -> GetLoggerLevels::Response {
    let level = |name: &String| LoggerLevel { name: name.clone(), level: LEVELS.own(name) as u32 };
    GetLoggerLevels::Response { levels: request.names.iter().map(level).collect() }
}

fn set(request: &SetLoggerLevels::Request) -> SetLoggerLevels::Response {
    let result = |LoggerLevel { name, level }: &LoggerLevel| {
        let reason = match LogSeverity::of_number(*level) {
            None => format!("{level} is no level: 0 unset, 10 debug, 20 info, 30 warn, 40 error, 50 fatal"),
            Some(level) if LEVELS.set_one_of(MOST, name, level) => String::new(),
            Some(_) => format!("{MOST} loggers of this process have levels of their own, and no more may"),
        };
        SetLoggerLevelsResult { successful: reason.is_empty(), reason }
    };
    SetLoggerLevels::Response { results: request.levels.iter().map(result).collect() }
}
