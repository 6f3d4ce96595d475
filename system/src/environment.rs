// SPDX-License-Identifier: MIT OR Apache-2.0
//! The variables that every process of Tautline reads.

use crate::admission::Admission;
use crate::error::{Result, SystemError};
use std::time::Duration;
use tautline_executor::Realtime;

/// The shortest time taken from one job that `TAUT_CORE_TIME=on` records.
pub const CORE_TIME_PIECE: Duration = Duration::from_micros(100);

/// `TAUT_REALTIME`: whether threads get their real-time policies.
///
/// # Errors
/// [`SystemError::Environment`].
pub fn realtime_of_environment() -> Result<Realtime> {
    let (variable, expected) = ("TAUT_REALTIME", "it may be 'required' or 'off'");
    match environment(variable) {
        None => Ok(Realtime::Required),
        Some(value) if value == "required" => Ok(Realtime::Required),
        Some(value) if value == "off" => Ok(Realtime::Off),
        Some(value) => Err(SystemError::Environment { variable, value, expected }),
    }
}

/// `TAUT_ADMISSION`: whether load is checked, by default if there is a system file.
///
/// # Errors
/// [`SystemError::Environment`].
pub fn admission_of_environment(has_system: bool) -> Result<Admission> {
    let (variable, expected) = ("TAUT_ADMISSION", "it may be 'check', 'force' or 'off'");
    match environment(variable).as_deref() {
        None if has_system => Ok(Admission::Check),
        None | Some("off") => Ok(Admission::Off),
        Some("check") => Ok(Admission::Check),
        Some("force") => Ok(Admission::Force),
        Some(value) => Err(SystemError::Environment { variable, value: value.to_owned(), expected }),
    }
}

/// `TAUT_CORE_TIME`: whether time taken from jobs by the host is recorded, and the shortest time that is.
///
/// # Errors
/// [`SystemError::Environment`].
pub fn core_time_of_environment() -> Result<Option<Duration>> {
    Ok(switch_of_environment("TAUT_CORE_TIME")?.unwrap_or(false).then_some(CORE_TIME_PIECE))
}

/// A switch; `None` if it is not set.
///
/// # Errors
/// [`SystemError::Environment`] if it is neither `on` nor `off`.
pub fn switch_of_environment(variable: &'static str) -> Result<Option<bool>> {
    match environment(variable).as_deref() {
        None => Ok(None),
        Some("off") => Ok(Some(false)),
        Some("on") => Ok(Some(true)),
        Some(value) => Err(SystemError::Environment {
            variable,
            value: value.to_owned(),
            expected: "it may be 'on' or 'off'",
        }),
    }
}

/// Returns a variable that is set and not empty. Invalid UTF-8 is replaced: such a value will not be understood.
pub fn environment(variable: &str) -> Option<String> {
    let value = std::env::var_os(variable)?.to_string_lossy().into_owned();
    (!value.is_empty()).then_some(value)
}
