// SPDX-License-Identifier: MIT OR Apache-2.0
//! The two services with which other nodes read and set the levels of loggers.

use super::severity::{LEVELS, LogSeverity};
use tautline_ros_msgs::rcl_interfaces::msg::{LoggerLevel, SetLoggerLevelsResult};
use tautline_ros_msgs::rcl_interfaces::srv::{GetLoggerLevels, SetLoggerLevels};

/// How many loggers of a process may have a level of their own before requests for more are refused.
const MOST: usize = 128;

pub(crate) fn get(request: &GetLoggerLevels::Request) -> GetLoggerLevels::Response {
    let level = |name: &String| LoggerLevel { name: name.clone(), level: LEVELS.own(name) as u32 };
    GetLoggerLevels::Response { levels: request.names.iter().map(level).collect() }
}

pub(crate) fn set(request: &SetLoggerLevels::Request) -> SetLoggerLevels::Response {
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
