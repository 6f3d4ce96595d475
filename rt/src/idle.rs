// SPDX-License-Identifier: MIT OR Apache-2.0
//! Keeps cores out of idle states.

use std::fs::{File, OpenOptions};
use std::io::Write;

use crate::RtError;

/// Keeps every core of the machine out of idle states until dropped, by holding `/dev/cpu_dma_latency` open at 0 µs.
///
/// The exit from an idle state dominates a wake-up's latency; this avoids it at the cost of power. It affects the
/// whole machine: state it in measurements.
#[derive(Debug)]
#[must_use = "cores may idle again as soon as this is dropped"]
pub struct IdleHold {
    _device: File,
}

impl IdleHold {
    /// Opens the device.
    ///
    /// # Errors
    /// [`RtError::Idle`] names the udev rule that gives a group access to the device.
    pub fn new() -> Result<IdleHold, RtError> {
        let open = || -> std::io::Result<File> {
            let mut device = OpenOptions::new().write(true).open("/dev/cpu_dma_latency")?;
            device.write_all(&0i32.to_ne_bytes())?;
            Ok(device)
        };
        Ok(IdleHold { _device: open().map_err(|source| RtError::Idle { source })? })
    }
}
