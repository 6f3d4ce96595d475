// SPDX-License-Identifier: MIT OR Apache-2.0
//! A doorbell that cannot be opened for a while: what was not rung then is rung later, without anybody's next message.

mod support;

use futures::task::ArcWake;
use std::future::Future;
use std::path::{Path, PathBuf};
use std::pin::pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::task::{Context, Poll};
use std::time::{Duration, Instant};
use support::{Count, domain, shared_memory, wait_for};
use tautline_transport::{Limits, Participant, Qos, SamplerSeat};

/// A participant, and the file of its doorbell.
fn participant(number: u32) -> (Participant, PathBuf) {
    let number = domain(number);
    let arenas =
        || shared_memory(number).into_keys().filter(|name| name.contains("_arena_")).collect::<Vec<_>>();
    let before = arenas();
    let participant = Participant::new(number).unwrap();
    let mut files = arenas().into_iter().filter(|name| !before.contains(name));
    (participant, Path::new("/dev/shm").join(files.next().unwrap()))
}

/// In the place of a file that cannot be opened, as at the limit of open files: a link, which is not followed. The file comes back
/// when this is dropped.
struct Hidden {
    file: PathBuf,
    aside: PathBuf,
}

impl Hidden {
    fn new(file: &Path) -> Self {
        // Under a name that no janitor looks for.
        let aside = file.with_file_name(format!("aside_{}", file.file_name().unwrap().to_string_lossy()));
        std::fs::rename(file, &aside).unwrap();
        std::os::unix::fs::symlink(&aside, file).unwrap();
        Hidden { file: file.to_owned(), aside }
    }
}

impl Drop for Hidden {
    fn drop(&mut self) {
        // Takes the link's place.
        std::fs::rename(&self.aside, &self.file).unwrap();
    }
}

/// Until the janitors have told of the new ports, which they do within 250 ms, once.
fn settle(seat: &SamplerSeat) {
    let mut quiet_since = Instant::now();
    wait_for("the janitors' word on the new ports", || {
        if seat.drain(|_| {}) != 0 {
            quiet_since = Instant::now();
        }
        quiet_since.elapsed() > Duration::from_millis(600)
    });
}

#[test]
fn a_subscription_is_rung_for_what_was_sent_meanwhile() {
    let (here, _) = participant(203);
    let (there, doorbell) = participant(203);
    let (qos, limits) = (Qos::default(), Limits::default());
    let subscription = there.create_subscription::<Count>("/unreached", qos, limits).unwrap();
    let seat = there.doorbell().claim_sampler().unwrap();
    let hidden = Hidden::new(&doorbell);
    let publisher = here.create_publisher::<Count>("/unreached", qos, limits).unwrap();
    assert_eq!(publisher.subscription_count(), 0, "it cannot be rung");
    settle(&seat);
    publisher.publish(&Count { n: 1 }).unwrap();
    assert!(!there.doorbell().is_pending());
    drop(hidden);
    wait_for("a ring", || seat.drain(|_| {}) != 0);
    assert_eq!(subscription.try_take().unwrap().unwrap().n, 1);
    assert_eq!(publisher.subscription_count(), 1);
    publisher.publish(&Count { n: 2 }).unwrap();
    assert!(there.doorbell().is_pending(), "by the publisher itself");
}

/// Counts the wakes of a task.
struct Wakes(AtomicUsize);

impl ArcWake for Wakes {
    fn wake_by_ref(arc_self: &Arc<Self>) {
        arc_self.0.fetch_add(1, Ordering::SeqCst);
    }
}

#[test]
fn a_publisher_that_waits_for_room_is_rung_for_what_was_taken_meanwhile() {
    let (here, doorbell) = participant(204);
    let (there, _) = participant(204);
    let (qos, limits) = (Qos::keep_all(1), Limits::default());
    let subscription = there.create_subscription::<Count>("/unreached", qos, limits).unwrap();
    let publisher = here.create_publisher::<Count>("/unreached", qos, limits).unwrap();
    let seat = here.doorbell().claim_sampler().unwrap();
    settle(&seat);
    publisher.publish(&Count { n: 1 }).unwrap();
    let mut loan = publisher.loan().unwrap();
    loan.n = 2;
    let mut ready = pin!(loan.publish_when_ready());
    let wakes = Arc::new(Wakes(AtomicUsize::new(0)));
    let waker = futures::task::waker(wakes.clone());
    let mut context = Context::from_waker(&waker);
    assert!(ready.as_mut().poll(&mut context).is_pending());

    let hidden = Hidden::new(&doorbell);
    assert_eq!(subscription.try_take().unwrap().unwrap().n, 1);
    assert!(subscription.try_take().unwrap().is_none());
    assert_eq!((seat.drain(|_| {}), wakes.0.load(Ordering::SeqCst)), (0, 0), "it cannot be rung");
    drop(hidden);
    wait_for("a ring", || {
        seat.drain(|_| {});
        wakes.0.load(Ordering::SeqCst) != 0
    });
    assert!(matches!(ready.as_mut().poll(&mut context), Poll::Ready(Ok(()))));
    assert_eq!(subscription.try_take().unwrap().unwrap().n, 2);
}
