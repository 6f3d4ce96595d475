// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a forked child has of its parent: neither exit handlers nor locks.

use std::sync::atomic::{AtomicBool, AtomicI32, Ordering};
use std::sync::{Barrier, Mutex, mpsc};
use tautline_rt::fork::{ProcessMutex, without_forks};
use tautline_rt::{LockFile, at_exit, exempt_children};

/// The process whose exit handler this is.
static PARENT: AtomicI32 = AtomicI32::new(0);

/// As that of a library whose thread a child does not have: only the parent comes back from it.
extern "C" fn wait_for_a_thread() {
    // SAFETY: no conditions.
    if unsafe { libc::getpid() } != PARENT.load(Ordering::Relaxed) {
        std::process::abort();
    }
}

#[test]
fn a_child_exits_with_its_own_handlers_only() {
    // SAFETY: a function that may be called at any time; no conditions.
    unsafe {
        PARENT.store(libc::getpid(), Ordering::Relaxed);
        libc::atexit(wait_for_a_thread);
    }
    exempt_children();
    let (mut pipe, mut status) = ([0; 2], 0);
    // SAFETY: room for two descriptors; the child has only this thread, and ends here.
    unsafe {
        assert_eq!(libc::pipe(pipe.as_mut_ptr()), 0);
        let child = libc::fork();
        if child == 0 {
            // It ends in any case.
            libc::alarm(60);
            let end = pipe[1];
            let _own = at_exit(move || _ = libc::write(end, [7u8].as_ptr().cast(), 1));
            libc::exit(3);
        }
        assert_eq!(libc::waitpid(child, &mut status, 0), child);
        let mut written = 0u8;
        libc::close(pipe[1]);
        assert_eq!(libc::read(pipe[0], (&raw mut written).cast(), 1), 1, "the child's own handler");
        assert_eq!(written, 7);
        libc::close(pipe[0]);
    }
    assert!(libc::WIFEXITED(status) && libc::WEXITSTATUS(status) == 3, "{status}");
}

/// What a forked child finds; false also if it does not end within a minute.
fn holds_in_a_child(condition: impl Fn() -> bool) -> bool {
    let mut status = 0;
    // SAFETY: the child has only this thread, and ends here; `status` is writable.
    unsafe {
        let child = libc::fork();
        if child == 0 {
            libc::alarm(60);
            libc::_exit(i32::from(!condition()));
        }
        assert_eq!(libc::waitpid(child, &mut status, 0), child);
    }
    libc::WIFEXITED(status) && libc::WEXITSTATUS(status) == 0
}

#[test]
fn a_child_has_the_locks_that_its_parents_threads_hold() {
    static VALUE: ProcessMutex<u32> = ProcessMutex::new(0, || 0);
    static HELD: Barrier = Barrier::new(2);
    let (end, ended) = mpsc::channel::<()>();
    let holder = std::thread::spawn(move || {
        let mut value = VALUE.lock();
        *value = 7;
        HELD.wait();
        let _ = ended.recv();
    });
    HELD.wait();
    assert!(holds_in_a_child(|| *VALUE.lock() == 0));
    assert!(VALUE.try_lock().is_none(), "the parent's is held");
    drop(end);
    holder.join().unwrap();
    assert_eq!(*VALUE.lock(), 7);
}

#[test]
fn a_fork_waits_for_what_takes_locks_of_other_libraries() {
    static OF_ANOTHER: Mutex<()> = Mutex::new(());
    static ENDS: AtomicBool = AtomicBool::new(false);
    let logs = std::thread::spawn(|| {
        while !ENDS.load(Ordering::Relaxed) {
            without_forks(|| {
                let _locked = OF_ANOTHER.lock().unwrap();
                tautline_rt::clock::burn_cpu(std::time::Duration::from_micros(20));
            });
        }
    });
    let free = (0..200).filter(|_| holds_in_a_child(|| OF_ANOTHER.try_lock().is_ok())).count();
    ENDS.store(true, Ordering::Relaxed);
    logs.join().unwrap();
    assert_eq!(free, 200);
}

#[test]
fn a_child_keeps_no_lock_file_whenever_it_is_forked() {
    static IS_OVER: AtomicBool = AtomicBool::new(false);
    let name = format!("taut_lock_forks_{}", std::process::id());
    let of_thread = name.clone();
    let locks = std::thread::spawn(move || {
        while !IS_OVER.load(Ordering::Relaxed) {
            drop(LockFile::lock(&of_thread).unwrap());
        }
    });
    let has_none = || {
        let mut files = std::fs::read_dir("/proc/self/fd").unwrap().flatten();
        let is_lock = |path: std::io::Result<std::path::PathBuf>| {
            path.is_ok_and(|path| path.to_string_lossy().contains(&name))
        };
        files.all(|file| !is_lock(std::fs::read_link(file.path())))
    };
    let kept = (0..200).filter(|_| !holds_in_a_child(has_none)).count();
    IS_OVER.store(true, Ordering::Relaxed);
    locks.join().unwrap();
    assert_eq!(kept, 0, "of 200 children");
}
