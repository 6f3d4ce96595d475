// SPDX-License-Identifier: MIT OR Apache-2.0
//! Keeping cores out of idle states.

use std::fs::{File, OpenOptions};
use std::io::Write;

use crate::RtError;

/// Keeps every core of the machine out of idle states until dropped, by holding `/dev/cpu_dma_latency` open at 0 µs.
///
/// Waking from an idle core dominates a wake-up's latency; this trades power for it. It acts on the whole machine:
/// say so in measurements.
#[derive(Debug)]
#[must_use = "cores may idle again as soon as this is dropped"]
pub struct IdleHold {
    _device: File,
}

impl IdleHold {
    /// Takes hold.
    ///
    /// # Errors
    /// [`RtError::Idle`] names the udev rule that admits a group to the device.
    pub fn new() -> Result<IdleHold, RtError> {
        let open = || -> std::io::Result<File> {
            let mut device = OpenOptions::new().write(true).open("/dev/cpu_dma_latency")?;
            device.write_all(&0i32.to_ne_bytes())?;
            Ok(device)
        };
        Ok(IdleHold { _device: open().map_err(|source| RtError::Idle { source })? })
    }
}
