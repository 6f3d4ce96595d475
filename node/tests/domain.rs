// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the environment says: `TAUT_DOMAIN`, `ROS_DOMAIN_ID`, `TAUT_REALTIME`, `TAUT_CORE_TIME`, `TAUT_HOLD_IDLE`. Each case in a child process.

mod common;

use common::{realtime, run_again, spin};
use std::time::Duration;
use tautline::{Context, Node, Realtime};

/// In the child.
fn describe() -> String {
    match Context::create() {
        Ok(context) => format!("{} {:?}", context.domain(), context.realtime()),
        Err(error) => error.to_string(),
    }
}

#[test]
fn the_environment_names_the_domain_and_the_policy() {
    let not_a_domain = "is not understood: a domain is a number from 0 to 232";
    let cases: [(&[(&str, &str)], String); 16] = [
        (&[], "0 Required".into()),
        (&[("TAUT_DOMAIN", "217")], "217 Required".into()),
        (&[("ROS_DOMAIN_ID", "218")], "218 Required".into()),
        (&[("TAUT_DOMAIN", "217"), ("ROS_DOMAIN_ID", "218")], "217 Required".into()),
        (&[("TAUT_DOMAIN", ""), ("ROS_DOMAIN_ID", "218")], "218 Required".into()),
        // What is not asked is not judged.
        (&[("TAUT_DOMAIN", "217"), ("ROS_DOMAIN_ID", "x")], "217 Required".into()),
        (&[("TAUT_DOMAIN", "233")], format!("TAUT_DOMAIN=233 {not_a_domain}")),
        (&[("TAUT_DOMAIN", "-1")], format!("TAUT_DOMAIN=-1 {not_a_domain}")),
        (&[("ROS_DOMAIN_ID", "home")], format!("ROS_DOMAIN_ID=home {not_a_domain}")),
        (&[("TAUT_DOMAIN", "217"), ("TAUT_REALTIME", "off")], "217 Off".into()),
        (&[("TAUT_DOMAIN", "217"), ("TAUT_REALTIME", "required")], "217 Required".into()),
        (
            &[("TAUT_DOMAIN", "217"), ("TAUT_REALTIME", "no")],
            "TAUT_REALTIME=no is not understood: it may be 'required' or 'off'".into(),
        ),
        (&[("TAUT_DOMAIN", "217"), ("TAUT_CORE_TIME", "on")], "217 Required".into()),
        (
            &[("TAUT_DOMAIN", "217"), ("TAUT_CORE_TIME", "1")],
            "TAUT_CORE_TIME=1 is not understood: it may be 'on' or 'off'".into(),
        ),
        (&[("TAUT_DOMAIN", "217"), ("TAUT_HOLD_IDLE", "off")], "217 Required".into()),
        (
            &[("TAUT_DOMAIN", "217"), ("TAUT_HOLD_IDLE", "no")],
            "TAUT_HOLD_IDLE=no is not understood: it may be 'on' or 'off'".into(),
        ),
    ];
    for (variables, expected) in cases {
        let Some(output) = run_again("the_environment_names_the_domain_and_the_policy", variables) else {
            return println!("\nchild: {}", describe());
        };
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        let said = text.lines().find_map(|line| line.strip_prefix("child: "));
        assert_eq!(said, Some(expected.as_str()), "{variables:?}: {output:?}");
    }
}

/// How many times this process holds idle states off.
fn holds() -> usize {
    let files = std::fs::read_dir("/proc/self/fd").unwrap();
    let names = files.filter_map(|file| std::fs::read_link(file.ok()?.path()).ok());
    names.filter(|name| name.ends_with("cpu_dma_latency")).count()
}

#[test]
fn idle_states_are_held_off_unless_the_environment_says_otherwise() {
    if !realtime() {
        return;
    }
    // One that may not open the device holds nothing, and says so.
    let most = usize::from(std::fs::OpenOptions::new().write(true).open("/dev/cpu_dma_latency").is_ok());
    for (value, expected) in [("", most), ("on", most), ("off", 0)] {
        let name = "idle_states_are_held_off_unless_the_environment_says_otherwise";
        let Some(output) = run_again(name, &[("TAUT_DOMAIN", "217"), ("TAUT_HOLD_IDLE", value)]) else {
            let context = Context::create().unwrap();
            let spinning = spin(&context);
            // The sampler serves a timer when it holds what it will.
            let mut node = Node::create(context, "idle", "").unwrap();
            let mut timer = node.create_wall_timer(Duration::from_millis(1)).unwrap();
            futures::executor::block_on(timer.tick()).unwrap();
            println!("\nchild: {}", holds());
            drop(spinning);
            return;
        };
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        let said = text.lines().find_map(|line| line.strip_prefix("child: "));
        assert_eq!(said, Some(expected.to_string().as_str()), "'{value}': {output:?}");
    }
}

#[test]
fn the_builder_outranks_the_environment() {
    let variables = [("TAUT_DOMAIN", "nonsense"), ("TAUT_REALTIME", "nonsense")];
    if let Some(output) = run_again("the_builder_outranks_the_environment", &variables) {
        return assert!(output.status.success(), "{output:?}");
    }
    let context = Context::builder().domain(218).realtime(Realtime::Off).build().unwrap();
    assert_eq!((context.domain(), context.realtime()), (218, Realtime::Off));
    let message = Context::builder().domain(233).build().err().unwrap().to_string();
    assert!(message.contains("nonsense"), "the policy comes first: {message}");
    let message = Context::builder().domain(233).realtime(Realtime::Off).build().err().unwrap().to_string();
    assert!(message.contains("domains go from 0 to 232"), "{message}");
}
