// SPDX-License-Identifier: MIT OR Apache-2.0
//! The command line.

use clap::{ArgGroup, Parser};
use std::path::PathBuf;
use tautline_analysis::file::{FileError, SystemFile};
use tautline_gateway::{Budget, Filter, GraphLimits, Mode, Network, Options, PatternError, Rule, RuleError};
use tautline_relay::{DomainError, domain_of};
use tautline_rt::{CoreSet, Realtime};
use tautline_transport::MAX_DOMAIN;

/// Mirrors this host's topics and services over the network: one gateway per host and domain.
///
/// Announces publishers and subscriptions of this host to other hosts, and discovers theirs; samples travel only while both
/// exist. Other hosts run a gateway too, or ROS 2 nodes with rmw_zenoh (Jazzy or later). By default the gateway connects to a
/// router on this host (tcp/localhost:7447), like rmw_zenoh, and listens on loopback only.
///
/// Zenoh's configuration is these defaults, changed by what the file of --config states, or that in ZENOH_SESSION_CONFIG_URI (with
/// --router: ZENOH_ROUTER_CONFIG_URI). ZENOH_CONFIG_OVERRIDE (key=json5;key=json5) changes it, and the options below
/// change the result.
#[derive(Parser, Debug)]
#[command(name = "taut-gateway", version)]
#[command(group = ArgGroup::new("mode").args(["peer", "client", "router"]))]
#[command(after_help = "Examples:
  taut gateway --listen tcp/0.0.0.0:7447            on the first host
  taut gateway --connect tcp/first-host:7447        on the second
  taut gateway --router --listen tcp/0.0.0.0:7447   forwards between all hosts that connect to it
  taut gateway --deny '/camera/**' --urgency '/cmd_vel=real_time'
  taut gateway --system system.toml                 with the priorities of the file's topics
  taut gateway --config zenoh.json5 --json | jq .topics
  taut gateway --domain 5 --network-domain 0        topics of domain 5 appear in domain 0 elsewhere")]
pub struct Args {
    /// Accept links here, such as tcp/0.0.0.0:7447, or unixsock-stream/PATH for this user only; may be given several times [default:
    /// loopback only]
    #[arg(long, value_name = "ENDPOINT")]
    listen: Vec<String>,
    /// Link to a gateway, router or ROS 2 node; may be given several times [default: tcp/localhost:7447]
    #[arg(long, value_name = "ENDPOINT")]
    connect: Vec<String>,
    /// A Zenoh configuration file (JSON5 or YAML), for TLS and access control for instance; what it leaves out has the defaults
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Link to every peer that can be reached, and to routers [default]
    #[arg(long)]
    peer: bool,
    /// Have one link, to a router or a peer that forwards
    #[arg(long)]
    client: bool,
    /// Forward between all that connect to this gateway
    #[arg(long)]
    router: bool,
    /// Domain of this host's topics [default: TAUT_DOMAIN, else ROS_DOMAIN_ID, else 0]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(0..=i64::from(MAX_DOMAIN)))]
    domain: Option<u32>,
    /// Domain on the network, if different
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(0..=i64::from(MAX_DOMAIN)))]
    network_domain: Option<u32>,
    /// Mirror only topics that match; may be given several times
    #[arg(long, value_name = "PATTERN")]
    allow: Vec<String>,
    /// Do not mirror topics that match; may be given several times
    #[arg(long, value_name = "PATTERN")]
    deny: Vec<String>,
    /// Priority on a busy link, PATTERN=PRIORITY[,express]: real_time, interactive_high, interactive_low, data_high, data,
    /// data_low, background [default: the smaller the sooner]
    #[arg(long, value_name = "RULE")]
    urgency: Vec<String>,
    /// Take priorities that --urgency does not set from a system file: `priority` and `express` of its topics
    #[arg(long, value_name = "FILE")]
    system: Option<PathBuf>,
    /// SCHED_FIFO priority of the network's threads: below the sampler's (90), above the callbacks'
    #[arg(long, value_name = "N", default_value_t = Options::PRIORITY, value_parser = clap::value_parser!(u8).range(1..=98))]
    priority: u8,
    /// Announce only this domain's own endpoints, not those that bridges announce in it
    #[arg(long)]
    no_transit: bool,
    /// Run without real-time priorities
    #[arg(long)]
    no_rt: bool,
    /// Cores of the network's threads, such as 0 or 0,2 [default: all]
    #[arg(long, value_name = "LIST", value_delimiter = ',')]
    cores: Vec<usize>,
    /// Processor time that the network may use at its priority, in percent of one core
    #[arg(long, value_name = "PERCENT", default_value_t = Budget::default().percent, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    budget: u32,
    /// No processor budget: a flood can starve callbacks
    #[arg(long, conflicts_with = "budget")]
    no_budget: bool,
    /// Longest message accepted from the network, in bytes
    #[arg(long, value_name = "BYTES", default_value_t = tautline_gateway::MAX_MESSAGE_BYTES, value_parser = parse_bytes)]
    max_message: usize,
    /// Maximum of nodes and endpoints of other hosts
    #[arg(long, value_name = "N", default_value_t = GraphLimits::default().tokens)]
    max_tokens: usize,
    /// If the domain already has a gateway, wait and take over when it ends or is killed
    #[arg(long)]
    pub standby: bool,
    /// Print statistics as JSON, one object per line
    #[arg(long)]
    pub json: bool,
    /// Seconds between two prints of the statistics
    #[arg(long, value_name = "SECONDS", default_value_t = 1.0, value_parser = tautline_relay::parse_interval)]
    pub interval: f64,
}

/// Invalid arguments.
#[derive(Debug, thiserror::Error)]
pub enum ArgsError {
    #[error(transparent)]
    Domain(#[from] DomainError),
    #[error(transparent)]
    Pattern(#[from] PatternError),
    #[error(transparent)]
    Rule(#[from] RuleError),
    #[error("--system: {0}")]
    System(#[from] FileError),
    #[error("--cores: {0}")]
    Cores(#[from] tautline_rt::RtError),
    #[error("--cores {core}: write core numbers from 0 to 1023")]
    Core { core: usize },
}

impl Args {
    pub fn options(&self) -> Result<Options, ArgsError> {
        let mode = match (self.peer, self.client, self.router) {
            (true, ..) => Some(Mode::Peer),
            (_, true, _) => Some(Mode::Client),
            (_, _, true) => Some(Mode::Router),
            _ => None,
        };
        let (listen, connect) = (self.listen.clone(), self.connect.clone());
        Ok(Options {
            domain: match self.domain {
                Some(domain) => domain,
                None => domain_of(&["TAUT_DOMAIN", "ROS_DOMAIN_ID"])?.unwrap_or(0),
            },
            network_domain: self.network_domain,
            network: Network { mode, listen, connect, file: self.config.clone() },
            filter: Filter::new(&self.allow, &self.deny)?,
            rules: self.rules()?,
            transit: !self.no_transit,
            priority: self.priority,
            realtime: if self.no_rt { Realtime::Off } else { Realtime::Required },
            cores: cores(&self.cores)?,
            budget: (!self.no_budget).then_some(Budget { percent: self.budget }),
            max_message_bytes: self.max_message,
            limits: GraphLimits { tokens: self.max_tokens, ..GraphLimits::default() },
        })
    }

    /// The rules of the command line, then those of the system file: the first match counts.
    fn rules(&self) -> Result<Vec<Rule>, ArgsError> {
        let mut rules = self.urgency.iter().map(|text| text.parse()).collect::<Result<Vec<Rule>, _>>()?;
        if let Some(path) = &self.system {
            rules.extend(Rule::of_system(&SystemFile::read(path)?)?);
        }
        Ok(rules)
    }
}

fn cores(list: &[usize]) -> Result<Option<CoreSet>, ArgsError> {
    if list.is_empty() {
        return Ok(None);
    }
    if let Some(&core) = list.iter().find(|core| **core > 1023) {
        return Err(ArgsError::Core { core });
    }
    let set: CoreSet = list.iter().copied().collect();
    set.check()?;
    Ok(Some(set))
}

fn parse_bytes(text: &str) -> Result<usize, String> {
    const MOST: usize = 1 << 30;
    let number = text.strip_suffix("iB").unwrap_or(text);
    let units = [('K', 1 << 10), ('M', 1 << 20), ('G', 1 << 30)];
    let (digits, unit) = units
        .iter()
        .find_map(|(letter, unit)| Some((number.strip_suffix(*letter)?, *unit)))
        .unwrap_or((text, 1));
    let bytes = digits.parse().ok().and_then(|number: usize| number.checked_mul(unit));
    bytes
        .filter(|bytes| (1024..=MOST).contains(bytes))
        .ok_or_else(|| "from 1024 to 1073741824 (1 GiB, Zenoh's maximum); K, M, G are powers of 1024".into())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn options(args: &[&str]) -> Options {
        Args::parse_from([&["taut-gateway"], args].concat()).options().unwrap()
    }

    #[test]
    fn options_reach_the_gateway() {
        let args = [
            "--client",
            "--connect",
            "tcp/h:1",
            "--connect",
            "tcp/i:1",
            "--domain",
            "7",
            "--network-domain",
            "0",
            "--deny",
            "/x/**",
            "--urgency",
            "/y=data_high",
            "--no-transit",
            "--no-rt",
            "--cores",
            "0",
            "--budget",
            "50",
            "--max-message",
            "16M",
            "--max-tokens",
            "100",
        ];
        let options = options(&args);
        assert_eq!(
            (options.domain, options.network_domain, options.network.mode),
            (7, Some(0), Some(Mode::Client))
        );
        assert_eq!(options.network.connect, ["tcp/h:1", "tcp/i:1"]);
        assert!(!options.filter.allows("/x/y") && options.rules.len() == 1);
        assert_eq!((options.realtime, options.cores), (Realtime::Off, Some(CoreSet::one(0))));
        assert_eq!((options.budget, options.max_message_bytes), (Some(Budget { percent: 50 }), 16 << 20));
        assert_eq!(options.limits.tokens, 100);
    }

    #[test]
    fn defaults_need_nothing() {
        let options = options(&["--domain", "0"]);
        assert_eq!(
            (options.priority, options.realtime, options.budget),
            (80, Realtime::Required, Some(Budget::default()))
        );
    }

    #[test]
    fn what_cannot_be_is_refused() {
        for args in [
            ["--domain", "233"],
            ["--priority", "99"],
            ["--max-message", "2G"],
            ["--max-message", "x"],
            ["--interval", "0"],
            ["--budget", "0"],
            ["--client", "--router"],
        ] {
            assert!(Args::try_parse_from([["taut-gateway"].as_slice(), &args].concat()).is_err(), "{args:?}");
        }
        for args in [["--allow", "x"], ["--urgency", "/x"], ["--cores", "5000"]] {
            let args = Args::parse_from([["taut-gateway", "--domain", "0"].as_slice(), &args].concat());
            assert!(args.options().is_err(), "{args:?}");
        }
    }

    #[test]
    fn a_system_file_says_what_the_command_line_does_not() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let text = "[hosts.h]\ncores = 1\n[nodes.n]\n[callbacks.c]\nperiod = \"10ms\"\nwcet = \"1ms\"\n[topics]\n\"/a\" = { priority = \"data\" }\n";
        std::fs::write(&file, text).unwrap();
        let path = file.path().to_str().unwrap();
        let options = options(&["--domain", "0", "--urgency", "/b=background", "--system", path]);
        assert_eq!(options.rules, ["/b=background", "/a=data"].map(|rule| rule.parse().unwrap()));
        let missing = Args::parse_from(["taut-gateway", "--system", "/nowhere.toml"]).options();
        assert!(missing.unwrap_err().to_string().contains("/nowhere.toml"));
    }

    #[test]
    fn bytes() {
        assert_eq!(parse_bytes("4096"), Ok(4096));
        assert_eq!(parse_bytes("64K"), Ok(64 << 10));
        assert_eq!(parse_bytes("64KiB"), Ok(64 << 10));
        assert_eq!(parse_bytes("1G"), Ok(1 << 30));
        assert!(["", "K", "1023", "é", "1T", "iB"].into_iter().all(|text| parse_bytes(text).is_err()));
    }
}
