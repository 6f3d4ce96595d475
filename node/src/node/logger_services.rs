// SPDX-License-Identifier: MIT OR Apache-2.0
//! The two services of a node for the levels of its process's loggers.

use super::Node;
use crate::error::Result;
use crate::logging::services;
use futures::FutureExt;
use futures::future::join;
use std::future::Future;
use tautline_ros_msgs::rcl_interfaces::srv::{GetLoggerLevels, SetLoggerLevels};

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
        let get =
            self.answer::<GetLoggerLevels::Service>("get_logger_levels", |request| services::get(&request))?;
        let set =
            self.answer::<SetLoggerLevels::Service>("set_logger_levels", |request| services::set(&request))?;
        Ok(join(get, set).map(drop))
    }
}
