// SPDX-License-Identifier: MIT OR Apache-2.0
//! Without the privilege, each refusal names its fix. The test runs itself again as the user `nobody`.

use std::os::unix::process::CommandExt;
use std::process::Command;

use rustix::process::{Resource, Rlimit, geteuid, setrlimit};
use tautline_rt::permission::realtime_permitted;
use tautline_rt::{IdleHold, MemoryLock, Policy, Realtime, ThreadBuilder, lock_memory, set_policy};

const NOBODY: u32 = 65_534;

/// The child's part: prints one line per refusal.
#[test]
fn child() {
    if std::env::var_os("TAUTLINE_UNPRIVILEGED").is_none() {
        return;
    }
    assert_eq!(geteuid().as_raw(), NOBODY);
    let say = |what: &str, result: Result<(), tautline_rt::RtError>| match result {
        Ok(()) => println!("{what}: ok"),
        Err(error) => println!("{what}: {error}"),
    };
    say("fifo 20", realtime_permitted(20));
    say("fifo 5", realtime_permitted(5));
    say("spawn", ThreadBuilder::new("t").policy(Policy::Fifo(20)).spawn(|| || ()).map(drop));
    say(
        "off",
        ThreadBuilder::new("t").policy(Policy::Fifo(20)).realtime(Realtime::Off).spawn(|| || ()).map(drop),
    );
    let reserved = Policy::Deadline { runtime_ns: 1_000_000, period_ns: 20_000_000 };
    say("reserved", ThreadBuilder::new("t").policy(reserved).spawn(|| || ()).map(drop));
    say("nice", set_policy(Policy::Other { nice: -5 }));
    say("nicer", set_policy(Policy::Other { nice: 5 }));
    say("idle", IdleHold::new().map(drop));
    say("lock", lock_memory(MemoryLock::OnFault));
}

fn lines_of_child(rtprio_limit: u64) -> Option<String> {
    if !geteuid().is_root() {
        println!("skipped: only root can become another user");
        return None;
    }
    // A copy: the build's own directory may be closed to others.
    let exe = tempfile::NamedTempFile::new().unwrap().into_temp_path();
    std::fs::copy(std::env::current_exe().unwrap(), &exe).unwrap();
    Command::new("chmod").arg("755").arg(&exe).status().unwrap();
    let mut command = Command::new(&exe);
    command.args(["--exact", "child", "--nocapture", "--test-threads=1"]);
    command.env("TAUTLINE_UNPRIVILEGED", "1").uid(NOBODY).gid(NOBODY).current_dir("/");
    let limit = |value| Rlimit { current: Some(value), maximum: Some(value) };
    // SAFETY: between fork and exec the closure makes two system calls and allocates nothing.
    unsafe {
        command.pre_exec(move || {
            setrlimit(Resource::Memlock, limit(65_536))?;
            Ok(setrlimit(Resource::Rtprio, limit(rtprio_limit))?)
        });
    }
    let output = match command.output() {
        Ok(output) => output,
        Err(error) if error.kind() == std::io::ErrorKind::PermissionDenied => {
            println!("skipped: the temporary directory does not allow programs: {error}");
            return None;
        }
        Err(error) => panic!("{error}"),
    };
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(output.status.success(), "{text}");
    Some(text)
}

/// The text after `what: `, wherever the test harness put it on its line.
fn line<'a>(text: &'a str, what: &str) -> &'a str {
    let found = text.lines().find_map(|line| Some(line.split_once(&format!("{what}: "))?.1));
    found.unwrap_or_else(|| panic!("no line for {what} in {text}"))
}

#[test]
fn without_any_privilege_each_error_names_its_fix() {
    let Some(text) = lines_of_child(0) else { return };
    for what in ["fifo 20", "fifo 5", "spawn"] {
        assert!(line(&text, what).contains("`sudo setcap cap_sys_nice,cap_ipc_lock+ep /"), "{text}");
        assert!(line(&text, what).contains("/etc/security/limits.d/90-tautline.conf"), "{text}");
    }
    assert!(line(&text, "nice").contains("`@realtime - nice -5`"), "{text}");
    assert!(line(&text, "idle").contains("/etc/udev/rules.d/90-tautline.rules"), "{text}");
    assert!(
        line(&text, "lock").contains("64 KiB") && text.contains("`@realtime - memlock unlimited`"),
        "{text}"
    );
    assert_eq!((line(&text, "off"), line(&text, "nicer")), ("ok", "ok"));
}

#[test]
fn a_limit_that_is_too_low_is_named() {
    let Some(text) = lines_of_child(10) else { return };
    assert_eq!(line(&text, "fifo 5"), "ok");
    let reserved = line(&text, "reserved");
    assert!(
        reserved.contains("SCHED_DEADLINE needs CAP_SYS_NICE") && reserved.contains("is not enough"),
        "{text}"
    );
    let refusal = line(&text, "fifo 20");
    assert!(refusal.contains("limit of 10") && refusal.contains("`@realtime - rtprio 20`"), "{text}");
}
