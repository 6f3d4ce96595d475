// SPDX-License-Identifier: MIT OR Apache-2.0
//! Two hosts: two domains of this machine, each with its gateway, which meet in a third one.

use std::net::TcpListener;
use std::path::Path;
use std::process::Command;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use crate::{Process, Result};

/// A host: a domain of this machine.
#[derive(Clone, Copy, Debug)]
pub struct Host {
    pub domain: u32,
    /// Its gateway's; `None`: any.
    pub core: Option<usize>,
    /// Whether its gateway has its real-time priority.
    pub realtime: bool,
}

/// Both gateways; they end with it.
#[derive(Debug)]
pub struct Gateways<'a> {
    both: Vec<Process<'a, serde_json::Value>>,
}

impl<'a> Gateways<'a> {
    /// Starts `program` for each host, with the defaults but for what is set; `domain` is the one in which they meet.
    ///
    /// # Errors
    /// One does not start, or they do not find each other.
    pub fn start(program: &Path, hosts: [Host; 2], domain: u32, interrupted: &'a AtomicBool) -> Result<Self> {
        // Free now; that somebody else takes it meanwhile is reported by the gateway.
        let port = TcpListener::bind("127.0.0.1:0")?.local_addr()?.port();
        let endpoint = format!("tcp/127.0.0.1:{port}");
        let mut both = Vec::new();
        for (index, host) in hosts.into_iter().enumerate() {
            let mut command = Command::new(program);
            command.args(["--json", "--interval", "0.1", "--domain", &host.domain.to_string()]);
            command.args(["--network-domain", &domain.to_string()]);
            // Listening on any port as well as on this one would find other machines' routers on the default one.
            let (listen, connect) = match index {
                0 => (endpoint.as_str(), "tcp/127.0.0.1:1"),
                _ => ("tcp/127.0.0.1:0", endpoint.as_str()),
            };
            command.args(["--listen", listen, "--connect", connect]);
            if let Some(core) = host.core {
                command.args(["--cores", &core.to_string()]);
            }
            if !host.realtime {
                command.arg("--no-rt");
            }
            let name = format!("gateway of domain {}", host.domain);
            let mut process = Process::start(&mut command, name, interrupted)?;
            process.expect(Duration::from_secs(10), Some)?;
            both.push(process);
        }
        let linked = |stats: serde_json::Value| stats["links"].as_u64().is_some_and(|n| n > 0).then_some(());
        both[1].expect(Duration::from_secs(10), linked)?;
        Ok(Gateways { both })
    }

    /// How often the gateway of `host` (0 or 1) had used up its budget when it last said so.
    pub fn throttled(&mut self, host: usize) -> u64 {
        self.both[host].latest().unwrap_or_default()["throttled"].as_u64().unwrap_or(0)
    }
}

/// Not killed: that would leave their files in shared memory behind.
impl Drop for Gateways<'_> {
    fn drop(&mut self) {
        self.both.iter_mut().for_each(Process::ask_to_end);
        self.both.iter_mut().for_each(Process::terminate);
    }
}
