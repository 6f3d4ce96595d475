// SPDX-License-Identifier: MIT OR Apache-2.0
//! Zenoh's configuration: rmw_zenoh's defaults, files, environment variables, command line options.

use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use zenoh::Config;

/// The session's role on the network.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Default)]
pub enum Mode {
    /// Links to every peer that it discovers, and to routers.
    #[default]
    Peer,
    /// Has one link, to a router or a peer that forwards.
    Client,
    /// Forwards between all that connect to it.
    Router,
}

tautline_rt::names!(Mode: const ALL: [Mode; 3]; const fn as_str(self) -> &'static str { Peer: "peer", Client: "client", Router: "router" });

impl Mode {
    fn named(name: &str) -> Option<Mode> {
        Mode::ALL.into_iter().find(|mode| mode.as_str() == name)
    }
}

/// Network options. Every field has a default.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Network {
    /// `None`: the mode of the file, else peer.
    pub mode: Option<Mode>,
    /// Endpoints to listen on, such as `tcp/0.0.0.0:7447`. Empty: those of the file, else loopback only.
    pub listen: Vec<String>,
    /// Endpoints to connect to, such as `tcp/host:7447`. Empty: those of the file, else a router on this host.
    pub connect: Vec<String>,
    /// A Zenoh configuration file, JSON5 or YAML. `None`: the file that the environment names.
    pub file: Option<PathBuf>,
}

/// Default maximum of a message from the network, encapsulation included: 64 MiB.
pub const MAX_MESSAGE_BYTES: usize = 64 << 20;

/// A configuration for Zenoh, and its description for the user.
#[derive(Clone, Debug)]
pub struct SessionConfig {
    pub(crate) zenoh: Config,
    /// Where the configuration comes from.
    pub source: String,
    /// Endpoints that the session listens on.
    pub listen: Vec<String>,
    /// Endpoints that the session connects to.
    pub connect: Vec<String>,
}

/// Why there is no configuration.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[allow(missing_docs, reason = "the names of the fields say it")]
pub enum ConfigError {
    /// A file that cannot be read or is invalid.
    #[error("{} (from {origin}) is not a valid Zenoh configuration: {reason}", path.display())]
    File {
        path: PathBuf,
        /// The option or variable that names it.
        origin: &'static str,
        reason: String,
    },
    /// A part of `ZENOH_CONFIG_OVERRIDE`.
    #[error(
        "ZENOH_CONFIG_OVERRIDE: '{part}' cannot be set: {reason}; write key/of/setting=json5 and ';' between settings"
    )]
    Override { part: String, reason: String },
    /// An endpoint or another option that Zenoh rejects.
    #[error("{option} {value}: {reason}; write endpoints like tcp/192.168.1.2:7447")]
    Option { option: &'static str, value: String, reason: String },
}

impl Network {
    /// Builds the configuration: rmw_zenoh's defaults, then what the file states, then `ZENOH_CONFIG_OVERRIDE`, then the options.
    /// `variable` reads the environment.
    ///
    /// # Errors
    /// [`ConfigError`] names the file, variable or option, and the error.
    pub fn session_config(
        &self,
        variable: impl Fn(&str) -> Option<String>,
        max_message_bytes: usize,
    ) -> Result<SessionConfig, ConfigError> {
        let overrides = variable("ZENOH_CONFIG_OVERRIDE").filter(|text| !text.trim().is_empty());
        let overrides = overrides.as_deref().map(overrides_in).transpose()?;
        let mode = overrides.iter().flatten().rfind(|(key, _)| *key == "mode");
        let mode = mode.and_then(|(_, value)| Mode::named(value.trim_matches(['"', '\''])));
        let (mut config, mut source) = self.base(&variable, mode, max_message_bytes)?;
        if let Some(overrides) = &overrides {
            apply(&mut config, overrides)?;
            source.push_str(" and ZENOH_CONFIG_OVERRIDE");
        }
        let mut set = |option, key: &str, value: String| {
            let reason = |error: zenoh::Error| error.to_string();
            let refuse = |reason| ConfigError::Option { option, value: value.clone(), reason };
            config.insert_json5(key, &value).map_err(|error| refuse(reason(error)))
        };
        if let Some(mode) = self.mode {
            set("mode", "mode", format!("\"{}\"", mode.as_str()))?;
        }
        for (option, key, endpoints) in [
            ("--listen", "listen/endpoints", &self.listen),
            ("--connect", "connect/endpoints", &self.connect),
        ] {
            if !endpoints.is_empty() {
                set(option, key, json!(endpoints).to_string())?;
            }
        }
        // Serving late joiners needs time stamps.
        set("timestamping", "timestamping/enabled", "true".into())?;
        let (listen, connect) = (endpoints(&config, "listen"), endpoints(&config, "connect"));
        Ok(SessionConfig { zenoh: config, source, listen, connect })
    }

    fn base(
        &self,
        variable: &impl Fn(&str) -> Option<String>,
        overridden: Option<Mode>,
        max_message_bytes: usize,
    ) -> Result<(Config, String), ConfigError> {
        let by_mode = match self.mode {
            Some(Mode::Router) => "ZENOH_ROUTER_CONFIG_URI",
            _ => "ZENOH_SESSION_CONFIG_URI",
        };
        let from_environment = || {
            let uri = variable(by_mode).filter(|uri| !uri.is_empty())?;
            Some((PathBuf::from(uri.strip_prefix("file://").unwrap_or(&uri)), by_mode))
        };
        let mode = self.mode.or(overridden);
        match self.file.clone().map(|file| (file, "--config")).or_else(from_environment) {
            Some((path, origin)) => {
                let stated = read_file(&path, origin)?;
                let mode = mode.or_else(|| Mode::named(stated["mode"].as_str()?)).unwrap_or_default();
                let mut merged = defaults(mode, max_message_bytes);
                merge(&mut merged, stated);
                Ok((config_of(&merged)?, format!("{} ({origin}) over the defaults", path.display())))
            }
            None => {
                Ok((config_of(&defaults(mode.unwrap_or_default(), max_message_bytes))?, "defaults".into()))
            }
        }
    }
}

impl SessionConfig {
    /// Whether other hosts can open a link to this host.
    pub fn is_reachable(&self) -> bool {
        self.listen.iter().any(|endpoint| !is_loopback(endpoint))
    }

    /// Whether hosts that reach this one may connect without a certificate, and use topics without a rule that permits it.
    pub fn is_unguarded(&self) -> bool {
        let is = |key: &str, value: &str| self.zenoh.get_json(key).is_ok_and(|text| text == value);
        let denies =
            is("access_control/enabled", "true") && is("access_control/default_permission", "\"deny\"");
        let by_default = is("transport/link/tls/enable_mtls", "true");
        let is_guarded =
            |endpoint: &String| is_loopback(endpoint) || requires_client_certificate(endpoint, by_default);
        !(denies || self.listen.iter().all(is_guarded))
    }

    /// Whether all links stay on this host.
    pub fn stays_on_host(&self) -> bool {
        !self.is_reachable() && self.connect.iter().all(|endpoint| is_loopback(endpoint))
    }
}

/// The settings that a file states, without Zenoh's defaults. Refuses a file that is not a valid Zenoh configuration.
fn read_file(path: &Path, origin: &'static str) -> Result<Value, ConfigError> {
    let refuse = |reason| ConfigError::File { path: path.into(), origin, reason };
    Config::from_file(path).map_err(|error| refuse(error.to_string()))?;
    let text = std::fs::read_to_string(path).map_err(|error| refuse(error.to_string()))?;
    match path.extension().and_then(|extension| extension.to_str()) {
        Some("json" | "json5") => json5::from_str(&text).map_err(|error| refuse(error.to_string())),
        Some("yaml" | "yml") => serde_saphyr::from_str(&text).map_err(|error| refuse(error.to_string())),
        _ => Err(refuse("write it as JSON5 or YAML, in a file of that ending".into())),
    }
}

/// Replaces defaults by stated settings, one by one. A stated value per mode replaces a default for all modes.
fn merge(defaults: &mut Value, stated: Value) {
    match (defaults, stated) {
        (Value::Object(defaults), Value::Object(stated)) => {
            for (key, value) in stated {
                merge(defaults.entry(key).or_insert(Value::Null), value);
            }
        }
        (default, stated) => *default = stated,
    }
}

fn config_of(settings: &Value) -> Result<Config, ConfigError> {
    let text = settings.to_string();
    Config::from_json5(&text).map_err(|error| ConfigError::Option {
        option: "the configuration",
        reason: error.to_string(),
        value: text,
    })
}

/// rmw_zenoh's defaults: a peer without multicast that connects to a router on its own host. Different from rmw_zenoh: a router
/// too listens on loopback only, connecting never gives up, a silent link is closed after 10 s, and the memory per peer is
/// bounded. Queues are as long as Zenoh permits: a message that finds its queue full for a millisecond is dropped, and on a busy machine
/// the thread that empties the queue may not run for longer than that.
fn defaults(mode: Mode, max_message_bytes: usize) -> Value {
    let (listen, connect) = match mode {
        Mode::Peer => (json!(["tcp/localhost:0"]), json!(["tcp/localhost:7447"])),
        Mode::Client => (json!([]), json!(["tcp/localhost:7447"])),
        Mode::Router => (json!(["tcp/localhost:7447"]), json!([])),
    };
    // The limit applies to bodies; headers and attachment are added to it.
    let max_message_bytes = max_message_bytes.saturating_add(64 << 10);
    json!({
        "mode": mode.as_str(),
        "listen": { "endpoints": listen, "exit_on_failure": true },
        "connect": {
            "endpoints": connect, "timeout_ms": -1, "exit_on_failure": false,
            "retry": { "period_init_ms": 500, "period_max_ms": 2000, "period_increase_factor": 2 },
        },
        "scouting": { "multicast": { "enabled": false }, "gossip": { "enabled": true } },
        "timestamping": { "enabled": true, "drop_future_timestamp": false },
        "routing": { "router": { "peers_failover_brokering": true } },
        "transport": {
            "unicast": { "max_sessions": 1000 },
            "link": {
                "tx": { "queue": {
                    "size": {
                        "control": 4, "real_time": 16, "interactive_high": 16, "interactive_low": 16,
                        "data_high": 16, "data": 16, "data_low": 16, "background": 16,
                    },
                    "congestion_control": {
                        "drop": { "wait_before_drop": 1000, "max_wait_before_drop_fragments": 50000 },
                        "block": { "wait_before_close": 20_000_000 },
                    },
                } },
                "rx": { "max_message_size": max_message_bytes },
            },
            "shared_memory": { "enabled": false },
        },
        "adminspace": { "enabled": false },
    })
}

/// The settings of `ZENOH_CONFIG_OVERRIDE`.
fn overrides_in(text: &str) -> Result<Vec<(&str, &str)>, ConfigError> {
    let setting = |part: &str| ConfigError::Override { part: part.into(), reason: "it has no '='".into() };
    let parts = text.split(';').map(str::trim).filter(|part| !part.is_empty());
    parts
        .map(|part| {
            part.split_once('=').map(|(key, value)| (key.trim(), value.trim())).ok_or_else(|| setting(part))
        })
        .collect()
}

fn apply(config: &mut Config, overrides: &[(&str, &str)]) -> Result<(), ConfigError> {
    for (key, value) in overrides {
        config.insert_json5(key, value).map_err(|error| ConfigError::Override {
            part: format!("{key}={value}"),
            reason: error.to_string(),
        })?;
    }
    Ok(())
}

/// The endpoints of the configured mode.
fn endpoints(config: &Config, which: &str) -> Vec<String> {
    let read = |key: &str| config.get_json(key).ok().and_then(|text| serde_json::from_str(&text).ok());
    let mode: String = read("mode").and_then(|mode: Value| Some(mode.as_str()?.into())).unwrap_or_default();
    let value: Value = read(&format!("{which}/endpoints")).unwrap_or_default();
    let list = value.get(&mode).unwrap_or(&value).as_array().cloned().unwrap_or_default();
    // An endpoint with alternatives is a nested array.
    let text = |endpoint: Value| endpoint.as_str().map_or_else(|| endpoint.to_string(), String::from);
    list.into_iter().map(text).collect()
}

pub(crate) fn socket_path(endpoint: &str) -> Option<&Path> {
    let rest = endpoint.strip_prefix("unixsock-stream/")?;
    rest.split(['?', '#']).next().map(Path::new)
}

pub(crate) fn is_loopback(endpoint: &str) -> bool {
    let Some((protocol, rest)) = endpoint.split_once('/') else { return false };
    let address = rest.split(['?', '#']).next().unwrap_or(rest);
    if protocol.starts_with("unixsock") || protocol == "unixpipe" {
        return true;
    }
    let host = address.rsplit_once(':').map_or(address, |(host, _)| host).trim_matches(['[', ']']);
    host == "localhost" || host.parse().is_ok_and(|ip: std::net::IpAddr| ip.is_loopback())
}

/// Whether a client of this endpoint must have a certificate. TLS alone does not require one: `enable_mtls` does, as set for the
/// endpoint or else, `by_default`, in the configuration.
fn requires_client_certificate(endpoint: &str, by_default: bool) -> bool {
    let own = endpoint.split_once('#').map_or("", |(_, own)| own);
    let own = own.split(';').find_map(|setting| setting.strip_prefix("enable_mtls="));
    let is_tls = endpoint.starts_with("tls/") || endpoint.starts_with("quic/");
    is_tls && own.map_or(by_default, |value| value == "true")
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::HashMap;

    fn config(network: &Network, variables: &[(&str, &str)]) -> Result<SessionConfig, ConfigError> {
        let variables: HashMap<_, _> = variables.iter().copied().collect();
        network.session_config(|name| variables.get(name).map(|value| (*value).into()), MAX_MESSAGE_BYTES)
    }

    fn value(config: &SessionConfig, key: &str) -> String {
        config.zenoh.get_json(key).unwrap()
    }

    #[test]
    fn defaults_are_rmw_zenohs_and_stay_on_the_host() {
        for (mode, listen, connect) in [
            (None, vec!["tcp/localhost:0"], vec!["tcp/localhost:7447"]),
            (Some(Mode::Peer), vec!["tcp/localhost:0"], vec!["tcp/localhost:7447"]),
            (Some(Mode::Client), vec![], vec!["tcp/localhost:7447"]),
            (Some(Mode::Router), vec!["tcp/localhost:7447"], vec![]),
        ] {
            let config = config(&Network { mode, ..Network::default() }, &[]).unwrap();
            assert_eq!(
                (&config.listen[..], &config.connect[..]),
                (&to_strings(&listen)[..], &to_strings(&connect)[..])
            );
            assert_eq!(value(&config, "mode"), format!("\"{}\"", mode.unwrap_or_default().as_str()));
            assert_eq!(value(&config, "scouting/multicast/enabled"), "false");
            assert_eq!(value(&config, "scouting/gossip/enabled"), "true");
            assert_eq!(value(&config, "timestamping/enabled"), "true");
            assert_eq!(
                value(&config, "transport/link/rx/max_message_size"),
                ((64 << 20) + (64 << 10)).to_string()
            );
            assert!(config.stays_on_host() && config.source == "defaults");
        }
    }

    fn to_strings(texts: &[&str]) -> Vec<String> {
        texts.iter().map(|text| (*text).into()).collect()
    }

    #[test]
    fn options_win_over_overrides_and_those_over_the_file() {
        let file = tempfile::NamedTempFile::with_suffix(".json5").unwrap();
        let text = r#"{ mode: "client", connect: { endpoints: ["tcp/10.0.0.1:1"] }, timestamping: { enabled: false } }"#;
        std::fs::write(file.path(), text).unwrap();
        let uri = file.path().to_str().unwrap();

        let from_file = config(&Network::default(), &[("ZENOH_SESSION_CONFIG_URI", uri)]).unwrap();
        assert_eq!(
            (value(&from_file, "mode"), &from_file.connect[..]),
            ("\"client\"".into(), &to_strings(&["tcp/10.0.0.1:1"])[..])
        );
        assert_eq!(value(&from_file, "timestamping/enabled"), "true", "late joiners need it");
        assert!(from_file.source.contains("ZENOH_SESSION_CONFIG_URI") && !from_file.stays_on_host());

        let router = Network { mode: Some(Mode::Router), ..Network::default() };
        let uri = format!("file://{uri}");
        let router =
            config(&router, &[("ZENOH_ROUTER_CONFIG_URI", &uri), ("ZENOH_SESSION_CONFIG_URI", "/no")])
                .unwrap();
        assert_eq!(value(&router, "mode"), "\"router\"");

        let overrides = ("ZENOH_CONFIG_OVERRIDE", r#"mode="router"; connect/endpoints=["tcp/10.0.0.2:2"];"#);
        let network = Network { file: Some(file.path().into()), ..Network::default() };
        let overridden = config(&network, &[overrides, ("ZENOH_SESSION_CONFIG_URI", "/nowhere")]).unwrap();
        assert_eq!(
            (value(&overridden, "mode"), &overridden.connect[..]),
            ("\"router\"".into(), &to_strings(&["tcp/10.0.0.2:2"])[..])
        );

        let network = Network {
            mode: Some(Mode::Peer),
            listen: to_strings(&["tcp/0.0.0.0:7447", "udp/[::1]:5"]),
            connect: to_strings(&["tls/robot.local:7447"]),
            ..network
        };
        let options = config(&network, &[overrides]).unwrap();
        assert_eq!((&options.listen, &options.connect), (&network.listen, &network.connect));
        assert_eq!(value(&options, "mode"), "\"peer\"");
        assert!(options.is_reachable());
    }

    #[test]
    fn what_a_file_leaves_out_is_as_without_it() {
        for (ending, text) in [
            (".json5", "{ access_control: { enabled: false }, scouting: { gossip: { enabled: false } } }"),
            (".yaml", "access_control: { enabled: false }\nscouting: { gossip: { enabled: false } }\n"),
        ] {
            let file = tempfile::NamedTempFile::with_suffix(ending).unwrap();
            std::fs::write(file.path(), text).unwrap();
            let network = Network { file: Some(file.path().into()), ..Network::default() };
            let merged = config(&network, &[]).unwrap();
            assert_eq!(merged.listen, ["tcp/localhost:0"], "{ending}");
            assert!(merged.stays_on_host() && !merged.is_unguarded());
            for (key, expected) in [
                ("mode", "\"peer\""),
                ("scouting/multicast/enabled", "false"),
                ("scouting/gossip/enabled", "false"),
                ("transport/shared_memory/enabled", "false"),
            ] {
                assert_eq!(value(&merged, key), expected, "{ending}: {key}");
            }
            // The mode of another source has the defaults of that mode.
            let router = config(&network, &[("ZENOH_CONFIG_OVERRIDE", "mode=\"router\"")]).unwrap();
            assert_eq!(
                (&router.listen[..], &router.connect[..]),
                (&to_strings(&["tcp/localhost:7447"])[..], &[][..])
            );
        }
    }

    #[test]
    fn who_can_be_reached_without_a_certificate_or_a_rule_is_told_so() {
        let open = |listen: &str, more: &str| {
            let file = tempfile::NamedTempFile::with_suffix(".json5").unwrap();
            std::fs::write(file.path(), format!("{{ listen: {{ endpoints: [\"{listen}\"] }}, {more} }}"))
                .unwrap();
            let config =
                config(&Network { file: Some(file.path().into()), ..Network::default() }, &[]).unwrap();
            (config.is_reachable(), config.is_unguarded())
        };
        let certificates = "transport: { link: { tls: { enable_mtls: true } } }";
        let denied = "access_control: { enabled: true, default_permission: \"deny\" }";
        for (listen, more, expected) in [
            ("tcp/0.0.0.0:7447", "", (true, true)),
            ("tcp/0.0.0.0:7447", certificates, (true, true)),
            // TLS without certificates of those that connect lets everyone in.
            ("tls/0.0.0.0:7447", "", (true, true)),
            ("tls/0.0.0.0:7447", certificates, (true, false)),
            ("tls/0.0.0.0:7447#enable_mtls=true", "", (true, false)),
            ("tls/0.0.0.0:7447#enable_mtls=false", certificates, (true, true)),
            ("tcp/[::]:7447", denied, (true, false)),
            ("tcp/[::]:7447", &*denied.replace("deny", "allow"), (true, true)),
            ("tcp/[::]:7447", &*denied.replace("true", "false"), (true, true)),
            ("tcp/127.0.0.1:7447", "", (false, false)),
        ] {
            assert_eq!(open(listen, more), expected, "{listen} {more}");
        }
    }

    #[test]
    fn what_cannot_be_is_named() {
        let message = |network: &Network, variables: &[(&str, &str)]| {
            config(network, variables).unwrap_err().to_string()
        };
        let nothing = Network::default();
        assert!(
            message(&nothing, &[("ZENOH_SESSION_CONFIG_URI", "/no/such.json5")]).contains("/no/such.json5")
        );
        assert!(message(&nothing, &[("ZENOH_CONFIG_OVERRIDE", "mode")]).contains("'mode'"));
        assert!(message(&nothing, &[("ZENOH_CONFIG_OVERRIDE", "no/such/key=1")]).contains("no/such/key=1"));
        let network = Network { listen: to_strings(&["tcp"]), ..Network::default() };
        assert!(message(&network, &[]).contains("--listen"));
    }

    #[test]
    fn loopback() {
        for endpoint in [
            "tcp/localhost:0",
            "tcp/127.0.0.1:7447",
            "tcp/127.1.2.3:1",
            "udp/[::1]:7447",
            "unixsock-stream//tmp/x",
            "tcp/127.0.0.1:1?prio=1",
            "tls/localhost:1#root=x",
        ] {
            assert!(is_loopback(endpoint), "{endpoint}");
        }
        for endpoint in [
            "tcp/0.0.0.0:7447",
            "tcp/[::]:7447",
            "tcp/192.168.1.2:7447",
            "tls/robot:1",
            "",
            "tcp/localhost.evil.org:1",
        ] {
            assert!(!is_loopback(endpoint), "{endpoint}");
        }
    }
}
