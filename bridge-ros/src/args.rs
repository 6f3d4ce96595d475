// SPDX-License-Identifier: MIT OR Apache-2.0
//! The command line.

use clap::Parser;
use std::path::PathBuf;
use tautline_bridge_ros::{Budget, Config, ConfigError, Filter, Options, PatternError};
use tautline_relay::{DomainError, domain_of};
use tautline_rt::Realtime;
use tautline_transport::MAX_DOMAIN;

/// Joins Tautline's topics, services and actions with those of a ROS 2 graph.
///
/// Forwards messages that one side publishes and the other subscribes to, as CDR, with the publishers' QoS. ROS's tools list
/// Tautline's nodes and topics, and Tautline's tools those of ROS. Clients on each side reach the services of the other; actions
/// and parameters consist of services and topics. Types come from the sourced ROS 2 (AMENT_PREFIX_PATH). Without --config
/// everything is bridged.
#[derive(Parser, Debug)]
#[command(name = "taut-bridge-ros", version)]
#[command(after_help = "Examples:
  taut bridge-ros                                   every topic, by discovery
  taut bridge-ros --deny '/camera/**'               except these
  taut bridge-ros --allow /cmd_vel --allow /tf      only these
  taut bridge-ros --config bridge.toml              the topics of a file, with names, directions, QoS, rates
  taut bridge-ros --config bridge.toml --auto       and all topics that it does not mention
  taut bridge-ros --domain 5 --ros-domain 0         Tautline's domain 5 and ROS's domain 0
  taut bridge-ros --standby                         takes over when the running bridge ends or is killed
  taut bridge-ros --json | jq .topics
  taut bridge-ros --json | jq .services

A file:
  [[topic]]
  topic = \"/robot/**\"            # Tautline's names; * is a part, ** any number of parts
  ros_topic = \"/r1/**\"           # their names in ROS
  direction = \"to_ros\"           # or \"from_ros\"; default: both
  type = \"nav_msgs/msg/Odometry\" # the expected type
  qos = { reliability = \"best_effort\", durability = \"volatile\", depth = 5 }
  max_rate_hz = 10.0
  [[service]]
  service = \"/set_mode\"
  ros_service = \"/r1/set_mode\"  # its name in ROS
  direction = \"to_ros\"           # the server is in Tautline; \"from_ros\": in ROS
  type = \"std_srvs/srv/SetBool\"
  [[action]]
  action = \"/dock\"               # its services and topics; also ros_action, direction")]
pub struct Args {
    /// File that lists the topics to bridge, and how
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Also bridge what the file does not mention
    #[arg(long)]
    auto: bool,
    /// Of the discovered topics and services, bridge only those that match; may be given several times
    #[arg(long, value_name = "PATTERN")]
    allow: Vec<String>,
    /// Do not bridge topics and services that match; may be given several times
    #[arg(long, value_name = "PATTERN")]
    deny: Vec<String>,
    /// Tautline's domain [default: TAUT_DOMAIN, else ROS_DOMAIN_ID, else 0]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(0..=i64::from(MAX_DOMAIN)))]
    domain: Option<u32>,
    /// ROS's domain [default: ROS_DOMAIN_ID, else 0]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(0..=i64::from(MAX_DOMAIN)))]
    ros_domain: Option<u32>,
    /// SCHED_FIFO priority of the threads that carry messages; the RMW's threads run one below
    #[arg(long, value_name = "N", default_value_t = Options::PRIORITY, value_parser = clap::value_parser!(u8).range(3..=98))]
    priority: u8,
    /// Put into ROS only this domain's own endpoints, not those that gateways and other bridges announce in it
    #[arg(long)]
    no_transit: bool,
    /// Run without real-time priorities
    #[arg(long)]
    no_rt: bool,
    /// Processor time that the bridge may use at its priority, in percent of one core
    #[arg(long, value_name = "PERCENT", default_value_t = Options::BUDGET.percent, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    budget: u32,
    /// No processor budget: a flood can starve callbacks
    #[arg(long, conflicts_with = "budget")]
    no_budget: bool,
    /// If these domains already have a bridge, wait and take over when it ends or is killed
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
    Config(#[from] ConfigError),
}

impl Args {
    pub fn options(&self) -> Result<Options, ArgsError> {
        let config = self.config.as_ref().map(Config::read).transpose()?.unwrap_or_default();
        let (mut rules, mut services) = (config.rules, config.services);
        for rules in [&mut rules, &mut services] {
            rules.auto |= self.auto || self.config.is_none();
            let also = Filter::new(&self.allow, &self.deny)?;
            rules.filter.allow.extend(also.allow);
            rules.filter.deny.extend(also.deny);
        }
        let domain = match self.domain.or(config.domain) {
            Some(domain) => domain,
            None => domain_of(&["TAUT_DOMAIN", "ROS_DOMAIN_ID"])?.unwrap_or(0),
        };
        let ros_domain = match self.ros_domain.or(config.ros_domain) {
            Some(domain) => Some(domain),
            None => domain_of(&["ROS_DOMAIN_ID"])?,
        };
        let realtime = if self.no_rt { Realtime::Off } else { Realtime::Required };
        let transit = config.transit.unwrap_or(true) && !self.no_transit;
        let budget = (!self.no_budget).then_some(Budget { percent: self.budget });
        let priority = self.priority;
        Ok(Options { domain, ros_domain, rules, services, transit, priority, realtime, budget })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn args(args: &[&str]) -> Args {
        Args::parse_from([&["taut-bridge-ros", "--domain", "7"], args].concat())
    }

    #[test]
    fn options_reach_the_bridge() {
        let options =
            args(&["--ros-domain", "3", "--deny", "/x/**", "--allow", "/a", "--no-rt", "--priority", "40"]);
        let options = options.options().unwrap();
        assert_eq!((options.domain, options.ros_domain, options.priority), (7, Some(3), 40));
        assert_eq!(options.realtime, Realtime::Off);
        let bridged = ["/a", "/b", "/x/y"].map(|topic| options.rules.choice(topic).is_some());
        assert_eq!(bridged, [true, false, false]);
    }

    #[test]
    fn examples_are_understood() {
        let help = <Args as clap::CommandFactory>::command().render_help().to_string();
        let examples = help.lines().filter_map(|line| line.trim_start().strip_prefix("taut bridge-ros "));
        let mut count = 0;
        for example in examples {
            // The explanation follows after two spaces.
            let command = example.split("  ").next().unwrap().split(" |").next().unwrap().replace('\'', "");
            let args =
                Args::try_parse_from(["taut-bridge-ros"].into_iter().chain(command.split_whitespace()))
                    .unwrap();
            for pattern in [&args.allow, &args.deny].into_iter().flatten() {
                pattern.parse::<tautline_bridge_ros::Pattern>().unwrap();
            }
            count += 1;
        }
        assert!(count >= 6, "{help}");
    }

    #[test]
    fn a_file_is_all_unless_auto_is_said() {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), "ros_domain = 9\n[[topic]]\ntopic = \"/a\"\n").unwrap();
        let path = file.path().to_str().unwrap();
        let options = args(&["--config", path]).options().unwrap();
        assert_eq!(options.ros_domain, Some(9));
        assert!(options.rules.choice("/a").is_some() && options.rules.choice("/b").is_none());
        let options = args(&["--config", path, "--auto"]).options().unwrap();
        assert!(options.rules.choice("/b").is_some());
        assert!(args(&[]).options().unwrap().rules.choice("/b").is_some());
        assert!(args(&[]).options().unwrap().transit && !args(&["--no-transit"]).options().unwrap().transit);
        std::fs::write(file.path(), "transit = false\n").unwrap();
        assert!(!args(&["--config", path]).options().unwrap().transit);
    }

    #[test]
    fn what_cannot_be_is_refused() {
        for wrong in [["--domain", "233"], ["--ros-domain", "x"], ["--priority", "99"], ["--interval", "0"]] {
            assert!(
                Args::try_parse_from([["taut-bridge-ros"].as_slice(), &wrong].concat()).is_err(),
                "{wrong:?}"
            );
        }
        for wrong in [["--allow", "x"], ["--config", "/nowhere.toml"]] {
            assert!(args(&wrong).options().unwrap_err().to_string().contains(wrong[1]));
        }
    }
}
