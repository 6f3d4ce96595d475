// SPDX-License-Identifier: MIT OR Apache-2.0
//! Locking acts on the whole process, so it has a process of its own.

use tautline_rt::permission::test_needs;
use tautline_rt::{IdleHold, MemoryLock, lock_memory, tune_malloc};

fn status_kib(key: &str) -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find(|line| line.starts_with(key)).unwrap();
    line.split_whitespace().nth(1).unwrap().parse().unwrap()
}

#[test]
fn locked_on_fault_a_sparse_mapping_stays_sparse() {
    if test_needs(lock_memory(MemoryLock::default())).is_none() {
        return;
    }
    assert!(status_kib("VmLck") > 0);
    const SPARSE: usize = 256 << 20;
    let before = status_kib("VmRSS");
    let mut sparse: Vec<u8> = Vec::with_capacity(SPARSE);
    sparse.push(1);
    assert!(status_kib("VmRSS") - before < 64 * 1024, "reserving must not make pages resident");
    drop(sparse);

    assert_eq!(tune_malloc(), cfg!(target_env = "gnu"));
    // From the heap, and not given back.
    let large = vec![1u8; 8 << 20];
    let resident = status_kib("VmRSS");
    drop(large);
    if cfg!(target_env = "gnu") {
        assert!(status_kib("VmRSS") + 1024 > resident, "freed memory stays");
    }
}

#[test]
fn idle_states_can_be_held_off_or_the_fix_is_named() {
    match IdleHold::new() {
        Ok(hold) => drop(hold),
        Err(error) => assert!(error.to_string().contains("udevadm trigger"), "{error}"),
    }
}
