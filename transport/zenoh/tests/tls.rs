// SPDX-License-Identifier: MIT OR Apache-2.0
//! The configuration for TLS and access control in docs/deployment.md does what is said there.

mod support;

use std::path::{Path, PathBuf};
use std::process::Command;
use support::{Host, connect, string_type, until};
use tautline_transport::Qos;
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;
use zenoh::Wait;

const DOMAIN: u32 = 214;

/// Makes an authority, and keys and certificates of `hosts` that it signed.
fn authority(directory: &Path, hosts: &[&str]) {
    std::fs::create_dir_all(directory).unwrap();
    let openssl = |arguments: &str| {
        let output =
            Command::new("openssl").args(arguments.split(' ')).current_dir(directory).output().unwrap();
        assert!(output.status.success(), "openssl {arguments}: {}", String::from_utf8_lossy(&output.stderr));
    };
    let key = "-newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes";
    openssl(&format!("req -x509 {key} -keyout ca.key -out ca.pem -days 2 -subj /CN=authority"));
    for host in hosts {
        openssl(&format!(
            "req -x509 {key} -keyout {host}.key -out {host}.pem -days 2 -subj /CN={host}.robot -CA ca.pem -CAkey ca.key \
             -addext subjectAltName=IP:127.0.0.1,DNS:{host}.robot -addext basicConstraints=critical,CA:FALSE"
        ));
    }
}

/// What the guide shows for the host `me`, whose neighbour is `other`, with files in `directory`.
fn guide(directory: &Path, me: &str, other: &str) -> PathBuf {
    let text = include_str!("../../../docs/deployment.md");
    let block = text.lines().skip_while(|line| *line != "    {").take_while(|line| line.starts_with("    "));
    let block = block.collect::<Vec<_>>().join("\n");
    assert!(block.contains("access_control") && block.trim_end().ends_with('}'), "{block}");
    let own = block
        .replace("second.robot\"]", "OTHER\"]")
        .replace("/etc/tautline/first", &directory.join(me).display().to_string())
        .replace("/etc/tautline", &directory.display().to_string())
        .replace("OTHER", &format!("{other}.robot"))
        .replace("0/camera", &format!("{DOMAIN}/camera"))
        .replace("@ros2_lv/0/", &format!("@ros2_lv/{DOMAIN}/"));
    let path = directory.join(format!("{me}.json5"));
    std::fs::write(&path, own).unwrap();
    path
}

#[test]
fn certificates_and_access_as_in_the_guide() {
    if let Err(error) = Command::new("openssl").arg("version").output() {
        assert!(std::env::var_os("CI").is_none(), "openssl: {error}");
        println!("skipped: openssl: {error}");
        return;
    }
    tracing_subscriber::registry().with(tautline_gateway::access_layer()).init();
    let directory = tempfile::tempdir().unwrap();
    let (good, rogue) = (directory.path().join("good"), directory.path().join("rogue"));
    authority(&good, &["first", "second"]);
    authority(&rogue, &["second"]);

    let first = guide(&good, "first", "second");
    let a = Host::new(DOMAIN, DOMAIN, |options| {
        options.network.file = Some(first);
        options.network.listen = vec!["tls/127.0.0.1:0".into()];
    });
    let locator = a.gateway().locators().into_iter().find(|locator| locator.starts_with("tls/")).unwrap();
    let second = guide(&good, "second", "first");
    let b = Host::new(DOMAIN + 1, DOMAIN, |options| {
        options.network.file = Some(second);
        options.network.listen = vec!["tls/127.0.0.1:0".into()];
        options.network.connect = vec![locator.clone()];
    });

    // What is allowed, both ways; what is not, never.
    let qos = Qos::keep_last(100);
    let ends = |from: &Host, to: &Host, topic: &str| {
        (from.publisher(topic, &string_type(), qos), to.subscription(topic, &string_type(), qos))
    };
    let (secret, ear) = ends(&b, &a, "/secret");
    let (other_secret, other_ear) = ends(&a, &b, "/secret");
    let (image, viewer) = ends(&b, &a, "/camera/image");
    connect(&image, &[&viewer], b"probe");
    let (other_image, other_viewer) = ends(&a, &b, "/camera/other");
    connect(&other_image, &[&other_viewer], b"probe");
    for publisher in [&secret, &other_secret] {
        publisher.publish(b"secret").unwrap();
    }
    connect(&image, &[&viewer], b"probe");
    connect(&other_image, &[&other_viewer], b"probe");
    for subscription in [&ear, &other_ear] {
        // Its own host's, and nothing else.
        assert_eq!(support::take(subscription).body(), b"secret");
        assert!(subscription.try_take().unwrap().is_none());
    }

    // What was published before somebody listened.
    let kept = Qos::keep_last(2).transient_local();
    let calibration = b.publisher("/camera/calibration", &string_type(), kept);
    for n in 0..3u8 {
        calibration.publish(&[n]).unwrap();
    }
    until("what is kept", || {
        let stats = b.stats().topics.into_iter();
        stats
            .filter(|topic| topic.name.topic == "/camera/calibration")
            .any(|topic| topic.reading.messages >= 2)
    });
    let late = a.subscription("/camera/calibration", &string_type(), kept);
    for n in 1..3u8 {
        assert_eq!(support::take(&late).body(), [n]);
    }

    until("the refusal to be reported", || {
        a.stats()
            .unauthorized
            .iter()
            .any(|(what, count)| what.starts_with("Put") && what.ends_with("/secret") && *count > 0)
    });

    // A certificate of another authority, and none at all: no link.
    let tls = |keys: Option<&Path>| {
        let keys = keys.map_or_else(String::new, |keys| {
            format!(
                "connect_private_key: \"{0}/second.key\", connect_certificate: \"{0}/second.pem\", enable_mtls: true,",
                keys.display()
            )
        });
        let text = format!(
            r#"{{ mode: "client", scouting: {{ multicast: {{ enabled: false }} }},
                connect: {{ endpoints: ["{locator}"], timeout_ms: 3000, exit_on_failure: true }},
                transport: {{ link: {{ tls: {{ {keys} root_ca_certificate: "{}/ca.pem" }} }} }} }}"#,
            good.display()
        );
        zenoh::open(zenoh::Config::from_json5(&text).unwrap()).wait()
    };
    let session = tls(Some(&good)).expect("a certificate of the authority");
    session.close().wait().unwrap();
    assert!(tls(Some(&rogue)).is_err(), "a certificate of another authority");
    assert!(tls(None).is_err(), "no certificate");
}
