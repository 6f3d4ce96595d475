// SPDX-License-Identifier: MIT OR Apache-2.0
//! Two hosts: two domains of this machine, each with its gateway, which meet in a third one.

use std::net::TcpListener;
use std::process::Command;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use tautline_benches::Process;

use crate::Result;
use crate::plan::Plan;

/// The near and the far host's. Nobody else measures there, and no test runs there.
pub const DOMAINS: [u32; 2] = [117, 118];
const NETWORK_DOMAIN: u32 = 119;

/// One host's gateway.
#[derive(Clone, Copy)]
pub struct Setting {
    pub core: Option<usize>,
    pub realtime: bool,
}

/// Both gateways; they end with it.
pub struct Gateways<'a> {
    both: Vec<Process<'a, serde_json::Value>>,
}

impl<'a> Gateways<'a> {
    /// Starts them, each with the defaults but for what is set.
    pub fn start(plan: &Plan, settings: [Setting; 2], interrupted: &'a AtomicBool) -> Result<Self> {
        // Free now; that somebody else takes it meanwhile is reported by the gateway.
        let port = TcpListener::bind("127.0.0.1:0")?.local_addr()?.port();
        let endpoint = format!("tcp/127.0.0.1:{port}");
        let mut both = Vec::new();
        for (host, (domain, setting)) in DOMAINS.into_iter().zip(settings).enumerate() {
            let mut command = Command::new(&plan.gateway);
            command.args(["--json", "--interval", "0.5", "--domain", &domain.to_string()]);
            command.args(["--network-domain", &NETWORK_DOMAIN.to_string()]);
            // Listening on any port as well as on this one would find other machines' routers on the default one.
            let (listen, connect) = match host {
                0 => (endpoint.as_str(), "tcp/127.0.0.1:1"),
                _ => ("tcp/127.0.0.1:0", endpoint.as_str()),
            };
            command.args(["--listen", listen, "--connect", connect]);
            if let Some(core) = setting.core {
                command.args(["--cores", &core.to_string()]);
            }
            if !setting.realtime {
                command.arg("--no-rt");
            }
            let name = format!("gateway of domain {domain}");
            let mut process = Process::start(&mut command, name, interrupted)?;
            process.expect(Duration::from_secs(10), Some)?;
            both.push(process);
        }
        let linked = |stats: serde_json::Value| stats["links"].as_u64().is_some_and(|n| n > 0).then_some(());
        both[1].expect(Duration::from_secs(10), linked)?;
        Ok(Gateways { both })
    }

    /// What the gateway of `host` (0 or 1) said last.
    pub fn stats(&mut self, host: usize) -> serde_json::Value {
        self.both[host].latest().unwrap_or_default()
    }
}

/// Not killed: that would leave their files in shared memory behind.
impl Drop for Gateways<'_> {
    fn drop(&mut self) {
        self.both.iter_mut().for_each(Process::terminate);
    }
}
