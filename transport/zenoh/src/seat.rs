// SPDX-License-Identifier: MIT OR Apache-2.0
//! One gateway per host, domain and user: who holds the lock on a file is it. The kernel drops the lock of one that
//! dies, however it dies, so that the next can take over at once.

use std::time::Duration;

/// Being the gateway; dropping it makes room for another.
#[derive(Debug)]
pub struct Seat {
    _seat: tautline_rt::Seat,
}

/// Why this is not the gateway.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SeatError {
    /// There is one.
    #[error(
        "domain {domain} of this host has a gateway already{}: stop that one, or wait for its end with --standby", holder(*.pid)
    )]
    Taken {
        /// The domain.
        domain: u32,
        /// Process id of the other, if it wrote it.
        pid: Option<u32>,
    },
    /// The file cannot be made or locked.
    #[error("the gateway's lock: {0}")]
    File(#[source] tautline_rt::SeatError),
}

fn holder(pid: Option<u32>) -> String {
    pid.map_or_else(String::new, |pid| format!(" (process {pid})"))
}

impl Seat {
    /// Becomes the gateway of `domain`.
    ///
    /// # Errors
    /// [`SeatError::Taken`] while another lives.
    pub fn take(domain: u32) -> Result<Self, SeatError> {
        // Beside the domain's shared memory, which is the user's own.
        match tautline_rt::Seat::take(&format!("{}gateway", tautline_transport::file_prefix(domain))) {
            Ok(seat) => Ok(Seat { _seat: seat }),
            Err(tautline_rt::SeatError::Taken { pid, .. }) => Err(SeatError::Taken { domain, pid }),
            Err(error) => Err(SeatError::File(error)),
        }
    }

    /// Becomes the gateway of `domain` as soon as there is no other; `None` if `stop` says so first.
    ///
    /// # Errors
    /// As [`Seat::take`], but for [`SeatError::Taken`].
    pub fn wait(domain: u32, stop: impl Fn() -> bool) -> Result<Option<Self>, SeatError> {
        const PERIOD: Duration = Duration::from_millis(50);
        while !stop() {
            match Seat::take(domain) {
                Err(SeatError::Taken { .. }) => std::thread::sleep(PERIOD),
                outcome => return outcome.map(Some),
            }
        }
        Ok(None)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_at_a_time() {
        let seat = Seat::take(178).unwrap();
        let refusal = Seat::take(178).unwrap_err().to_string();
        let me = format!("process {}", std::process::id());
        assert!(refusal.contains("domain 178") && refusal.contains(&me), "{refusal}");
        assert!(Seat::wait(178, || true).unwrap().is_none());
        drop(Seat::take(177).unwrap());
        drop(seat);
        drop(Seat::wait(178, || false).unwrap().unwrap());
    }
}
