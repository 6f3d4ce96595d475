// SPDX-License-Identifier: MIT OR Apache-2.0
//! Programs for r2r 0.9.7, in the idioms of its examples. The very same files run on Tautline, whose test this is, and on r2r
//! (`node/r2r`, by `cargo xtask r2r`). Each ends by itself, and fails if what it heard is not what was said.

use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

/// Set in the process that runs the program.
const PROGRAM: &str = "R2R_PROGRAM";
/// Discovery included.
const PATIENCE: Duration = Duration::from_secs(60);

macro_rules! programs {
    ($($name:ident in $domain:literal;)+) => {
        $(
            mod $name;

            #[test]
            fn $name() {
                if std::env::var_os(PROGRAM).is_some() {
                    return $name::main().unwrap();
                }
                run(concat!(module_path!(), "::", stringify!($name)), $domain);
            }
        )+
    };
}

programs! {
    actions in 15;
    clocks in 16;
    logging in 17;
    parameters in 18;
    parameters_derive in 19;
    pub_sub in 20;
    publisher_threads in 21;
    raw in 22;
    serialization in 23;
    services in 24;
    tokio_node in 25;
    tokio_tasks in 26;
    untyped in 27;
    untyped_client in 28;
    wall_timer in 29;
}

/// The program in a process of its own: what it is given by the environment is for whole processes.
fn run(path: &str, domain: u32) {
    let (_package, name) = path.split_once("::").expect("a path in a module");
    let mut child = Command::new(std::env::current_exe().unwrap())
        .args(["--exact", name, "--nocapture", "--test-threads=1"])
        .envs([(PROGRAM, name), ("TAUT_REALTIME", "off"), ("ROS_DOMAIN_ID", &domain.to_string())])
        .env_remove("TAUT_DOMAIN")
        .stdin(Stdio::null())
        .spawn()
        .unwrap();
    let end = Instant::now() + PATIENCE;
    let status = loop {
        if let Some(status) = child.try_wait().unwrap() {
            break status;
        }
        if Instant::now() > end {
            child.kill().unwrap();
            child.wait().unwrap();
            panic!("'{name}' has not come to its end in {PATIENCE:?}");
        }
        std::thread::sleep(Duration::from_millis(10));
    };
    assert!(status.success(), "'{name}': {status}");
}
