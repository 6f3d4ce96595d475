// SPDX-License-Identifier: MIT OR Apache-2.0
//! Why a bridge could not start.

use crate::rcl::RclError;
use tautline_relay::{InstanceError, RelayError};
use tautline_rt::RtError;
use tautline_transport::TransportError;

/// Why a bridge could not start.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum BridgeError {
    /// Another bridge already joins these domains, or the lock file failed.
    #[error(transparent)]
    Instance(#[from] InstanceError),
    /// The type support for the table that bridges exchange could not be loaded.
    #[error("bridges cannot announce their endpoints to each other: {0}")]
    Table(String),
    /// rcl or the RMW failed.
    #[error("{0}; source ROS 2, and unset RMW_IMPLEMENTATION or set it to an installed RMW")]
    Ros(#[from] RclError),
    /// Shared memory of the domain failed.
    #[error(transparent)]
    Transport(#[from] TransportError),
    /// A thread could not start.
    #[error(transparent)]
    Threads(#[from] RtError),
}

impl From<RelayError> for BridgeError {
    fn from(error: RelayError) -> Self {
        match error {
            RelayError::Transport(error) => error.into(),
            RelayError::Rt(error) => error.into(),
        }
    }
}
