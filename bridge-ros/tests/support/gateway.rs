// SPDX-License-Identifier: MIT OR Apache-2.0
//! Hosts: each a domain of its own on this machine, with a gateway in a process of its own.

use super::{Program, built, reserve, scope, wait_until};
use std::ops::Deref;
use std::path::{Path, PathBuf};
use std::process::Command;

/// `taut-gateway`.
pub struct GatewayProcess {
    running: Program,
    program: PathBuf,
    domains: [u32; 2],
    arguments: Vec<String>,
}

impl Deref for GatewayProcess {
    type Target = Program;

    fn deref(&self) -> &Program {
        &self.running
    }
}

impl GatewayProcess {
    /// Without real-time priorities.
    fn start(program: &Path, domains: [u32; 2], arguments: &[&str]) -> Self {
        let [domain, network_domain] = domains;
        reserve(domain);
        let mut command = Command::new(program);
        let (domain, network_domain) = (domain.to_string(), network_domain.to_string());
        command.args(["--domain", &domain, "--network-domain", &network_domain, "--no-rt"]);
        command.args(["--json", "--interval", "0.1"]).args(arguments).env("TAUT_SCOPE", scope());
        // What may be said on the terminal that runs the tests is no concern of theirs.
        let variables =
            ["RUST_LOG", "ROS_DOMAIN_ID", "TAUT_DOMAIN", "ZENOH_SESSION_CONFIG_URI", "ZENOH_CONFIG_OVERRIDE"];
        for variable in variables {
            command.env_remove(variable);
        }
        let arguments = arguments.iter().map(|&argument| argument.to_owned()).collect();
        let running = Program::start("gateway", command);
        GatewayProcess { running, program: program.to_owned(), domains, arguments }
    }

    /// Ends it, without a word or as a user does, and starts it again where it was, after what is to happen `meanwhile`.
    pub fn again(self, is_killed: bool, meanwhile: impl FnOnce()) -> Self {
        let endpoint = endpoint_in(&self.said());
        let GatewayProcess { running, program, domains, arguments } = self;
        if is_killed {
            running.kill();
        } else {
            drop(running);
        }
        meanwhile();
        let same = |argument: &String| match &**argument {
            "tcp/127.0.0.1:0" => endpoint.clone().unwrap(),
            argument => argument.to_owned(),
        };
        let arguments: Vec<String> = arguments.iter().map(same).collect();
        let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
        GatewayProcess::start(&program, domains, &arguments)
    }

    /// Where it listens on loopback.
    pub fn endpoint(&self) -> String {
        let mut found = None;
        wait_until("where the gateway listens", || {
            found = endpoint_in(&self.said());
            found.is_some()
        });
        found.unwrap()
    }
}

/// As a gateway says it when it starts.
fn endpoint_in(said: &str) -> Option<String> {
    const HERE: &str = "tcp/127.0.0.1:";
    let lines = said.lines().filter_map(|line| line.strip_prefix("listening on "));
    let port = lines.flat_map(str::split_whitespace).find_map(|word| word.strip_prefix(HERE))?;
    let digits = port.find(|character: char| !character.is_ascii_digit()).unwrap_or(port.len());
    Some(format!("{HERE}{}", &port[..digits]))
}

/// A domain's gateway, which looks for no router; prints why a test is skipped without the program.
pub fn listen(domain: u32) -> Option<GatewayProcess> {
    let program = built("taut-gateway", "tautline-gateway")?;
    let alone = ["--listen", "tcp/127.0.0.1:0", "--connect", "tcp/127.0.0.1:1"];
    Some(GatewayProcess::start(&program, [domain, domain], &alone))
}

/// The gateways of two domains, which are linked, and one domain on the network; as [`listen`].
pub fn link(first: u32, second: u32) -> Option<[GatewayProcess; 2]> {
    let listening = listen(first)?;
    let connect = ["--connect", &listening.endpoint()];
    let connecting = GatewayProcess::start(&listening.program, [second, first], &connect);
    for gateway in [&listening, &connecting] {
        gateway.wait_for("a link", |stats| stats["links"].as_u64().is_some_and(|links| links > 0));
    }
    Some([listening, connecting])
}
