// SPDX-License-Identifier: MIT OR Apache-2.0
//! Opens Zenoh with threads of the required priority. Zenoh has no setting for that: its threads inherit the policy of the thread
//! that starts them. So a thread of that policy opens the session, and policies are read back.

use crate::config::{SessionConfig, socket_path};
use std::fs::Permissions;
use std::io;
use std::os::unix::fs::PermissionsExt;
use std::path::PathBuf;
use std::sync::mpsc::{self, RecvTimeoutError};
use std::time::Duration;
use tautline_rt::{CoreSet, Policy, Realtime, RtError, ThreadBuilder, ThreadInfo};
use zenoh::{Session, Wait};

/// Why the session could not open.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[allow(missing_docs, reason = "the names of the fields say it")]
pub enum SessionError {
    /// The opening thread could not get its priority.
    #[error("threads of the network: {0}")]
    Threads(#[from] RtError),
    /// Zenoh failed.
    #[error("Zenoh does not start: {reason}; listening on {listen:?}")]
    Open { reason: String, listen: Vec<String> },
    /// The socket may be open to other users.
    #[error("{} cannot be given mode 600, so that only this user reaches it: {source}", path.display())]
    Socket { path: PathBuf, source: io::Error },
    /// The caller gave up.
    #[error("opening the session was given up before there was a link to any of {connect:?}")]
    GivenUp { connect: Vec<String> },
}

/// Interval of calls to `go_on`.
const POLL: Duration = Duration::from_millis(50);

/// Opens a session whose threads have `policy`. Gives up when `go_on` returns false: a client's session opens only once it has its link.
/// A session that opens after that is closed at once.
pub(crate) fn open(
    config: SessionConfig,
    policy: Policy,
    realtime: Realtime,
    cores: Option<CoreSet>,
    mut go_on: impl FnMut() -> bool,
) -> Result<Session, SessionError> {
    let SessionConfig { zenoh: zenoh_config, listen, connect, .. } = config;
    let open = move || -> Result<Session, SessionError> {
        let session = zenoh::open(zenoh_config)
            .wait()
            .map_err(|error| SessionError::Open { reason: error.to_string(), listen: listen.clone() })?;
        // Zenoh creates a socket with the mode that the umask leaves.
        for path in listen.iter().filter_map(|endpoint| socket_path(endpoint)) {
            let only_user = Permissions::from_mode(0o600);
            std::fs::set_permissions(path, only_user)
                .map_err(|source| SessionError::Socket { path: path.into(), source })?;
        }
        Ok(session)
    };
    // Zenoh's builders need a deep stack.
    let builder = ThreadBuilder { cores, ..ThreadBuilder::new("gw-open") }
        .policy(policy)
        .realtime(realtime)
        .stack_bytes(4 << 20);
    let (running, ended) = mpsc::channel::<()>();
    let opening = builder.spawn(move || {
        move || {
            let _running = running;
            open()
        }
    })?;
    while ended.recv_timeout(POLL) == Err(RecvTimeoutError::Timeout) {
        if !go_on() {
            return Err(SessionError::GivenUp { connect });
        }
    }
    opening.join()?
}

/// Zenoh's threads in this process, as reported by the kernel.
///
/// # Errors
/// [`RtError`] if `/proc` cannot be read.
pub fn network_threads() -> Result<Vec<ThreadInfo>, RtError> {
    let mut threads = tautline_rt::threads()?;
    threads.retain(|thread| is_network_thread(&thread.name));
    Ok(threads)
}

/// `app-0`, `acc-0`, `net-1`, `rx-0`, `tx-0`: the names of Zenoh's runtimes.
fn is_network_thread(name: &str) -> bool {
    let Some((runtime, number)) = name.split_once('-') else { return false };
    let is_number = !number.is_empty() && number.bytes().all(|byte| byte.is_ascii_digit());
    matches!(runtime, "app" | "acc" | "net" | "rx" | "tx") && is_number
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{MAX_MESSAGE_BYTES, Network};
    use tautline_rt::permission::{realtime_permitted, test_needs};

    fn config(listen: &str, connect: &str) -> SessionConfig {
        let network =
            Network { listen: vec![listen.into()], connect: vec![connect.into()], ..Network::default() };
        network.session_config(|_| None, MAX_MESSAGE_BYTES).unwrap()
    }

    #[test]
    fn names() {
        assert!(["app-0", "acc-1", "rx-12"].into_iter().all(is_network_thread));
        assert!(!["app", "rx-", "rx-x", "gw-open", "main"].into_iter().any(is_network_thread));
    }

    /// The thread pool is per process: one test for all its properties.
    #[test]
    fn threads_have_the_policy_asked_for() {
        if test_needs(realtime_permitted(40)).is_none() {
            return;
        }
        let open = |config| open(config, Policy::Fifo(40), Realtime::Required, None, || true);
        let refused = open(config("tcp/192.0.2.1:1", "tcp/127.0.0.1:1"));
        assert!(refused.unwrap_err().to_string().contains("192.0.2.1"));
        let first = open(config("tcp/127.0.0.1:17460", "tcp/127.0.0.1:1")).unwrap();
        // Threads for links appear with the first link.
        let second = open(config("tcp/127.0.0.1:0", "tcp/127.0.0.1:17460")).unwrap();
        while second.info().peers_zid().wait().count() == 0 {
            std::thread::sleep(Duration::from_millis(5));
        }
        let threads = network_threads().unwrap();
        assert!(threads.iter().any(|thread| thread.name.starts_with("rx-")), "{threads:?}");
        assert!(threads.iter().all(|thread| thread.policy == Policy::Fifo(40)), "{threads:?}");
        second.close().wait().unwrap();
        first.close().wait().unwrap();
    }
}
