// SPDX-License-Identifier: MIT OR Apache-2.0
//! Every interleaving of a writer that laps a ring of two samples, and a reader. Run by `cargo xtask test`.

use std::future::Future;
use std::pin::pin;
use std::task::{Context, Poll, Wake, Waker};

use loom::sync::{Arc, Notify};
use loom::thread;

use crate::buffer::{Buffer, Time};

use crate::limits::Limits;
use crate::names::FrameId;
use crate::ring::{Edge, FrameHead, Miss, New, Refused, Ring};
use crate::slot::{Kind, Slot};
use crate::sync::AtomicU64;
use crate::transform::Transform;
use crate::tree::{PathError, TransformTree};
use crate::writer::TransformStamped;

const CACHE_NS: i64 = 1_000;

struct Memory {
    newest: AtomicU64,
    slots: Vec<Slot>,
}

impl Memory {
    fn new(slots: usize) -> Arc<Memory> {
        Arc::new(Memory { newest: AtomicU64::new(0), slots: (0..slots).map(|_| Slot::new()).collect() })
    }

    fn ring(&self) -> Ring<'_> {
        Ring { newest: &self.newest, slots: &self.slots }
    }

    /// Each sample's x is its stamp, and so is what is interpolated.
    fn set(&self, head: &mut FrameHead, stamp_ns: i64) -> Result<(), Refused> {
        let transform = Transform::new([stamp_ns as f64, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]);
        let new = New { stamp_ns, parent: 1, kind: Kind::Dynamic, transform };
        self.ring().set(head, &new, CACHE_NS).map(|_| ())
    }
}

fn model(check: impl Fn() + Send + Sync + 'static) {
    let mut builder = loom::model::Builder::new();
    builder.preemption_bound = Some(3);
    builder.check(check);
}

/// A ring of `slots` samples that holds some, for a reader and for a writer, which goes on from the head.
fn filled(slots: usize, stamps_ns: &[i64]) -> (Arc<Memory>, Arc<Memory>, FrameHead) {
    let memory = Memory::new(slots);
    let mut head = FrameHead::default();
    for stamp_ns in stamps_ns {
        memory.set(&mut head, *stamp_ns).unwrap();
    }
    (memory.clone(), memory, head)
}

fn assert_whole(found: Result<Option<Edge>, Miss>, asked_ns: i64) {
    match found {
        Ok(Some(edge)) => {
            assert_eq!((edge.parent, edge.stamp_ns), (1, Some(asked_ns)), "torn");
            assert_eq!(edge.transform.translation[0], asked_ns as f64, "torn");
        }
        Err(Miss::Extrapolation { oldest_ns, newest_ns }) => {
            assert!(oldest_ns <= newest_ns && !(oldest_ns..=newest_ns).contains(&asked_ns));
        }
        Ok(None) | Err(Miss::Overtaken) => panic!("{found:?}"),
    }
}

#[test]
fn loom_no_sample_is_torn_when_the_ring_wraps() {
    model(|| {
        let (memory, writer, mut head) = filled(2, &[10, 20]);
        let writing = thread::spawn(move || writer.set(&mut head, 30).unwrap());
        // Between 10 and 20, which has left the ring sooner or later.
        assert_whole(memory.ring().at(15, CACHE_NS), 15);
        writing.join().unwrap();
        assert_whole(memory.ring().at(25, CACHE_NS), 25);
        assert_eq!(memory.ring().at(15, CACHE_NS), Err(Miss::Extrapolation { oldest_ns: 20, newest_ns: 30 }));
    });
}

#[test]
fn loom_the_newest_sample_is_found_though_it_is_replaced() {
    model(|| {
        let (memory, writer, mut head) = filled(2, &[10]);
        let writing =
            thread::spawn(move || [20, 30].map(|stamp_ns| writer.set(&mut head, stamp_ns).unwrap()));
        let newest = memory.ring().newest().unwrap().unwrap();
        assert_eq!(newest.transform.translation[0], newest.stamp_ns as f64, "torn");
        writing.join().unwrap();
        assert_eq!(memory.ring().newest().unwrap().unwrap().stamp_ns, 30);
    });
}

/// The late sample takes the place of one that the reader may be looking at.
#[test]
fn loom_a_late_sample_is_seen_whole_or_not_at_all() {
    model(|| {
        let (memory, writer, mut head) = filled(2, &[10, 30]);
        let writing = thread::spawn(move || writer.set(&mut head, 20).unwrap());
        // Between 10 and 30, then between 20 and 30.
        assert_whole(memory.ring().at(25, CACHE_NS), 25);
        writing.join().unwrap();
        assert_whole(memory.ring().at(25, CACHE_NS), 25);
    });
}

#[test]
fn loom_a_late_sample_that_takes_no_place_hides_nothing() {
    model(|| {
        let (memory, writer, mut head) = filled(4, &[10, 30]);
        let writing = thread::spawn(move || writer.set(&mut head, 20).unwrap());
        let found = memory.ring().at(15, CACHE_NS);
        assert!(matches!(found, Ok(Some(edge)) if edge.transform.translation[0] == 15.0), "{found:?}");
        writing.join().unwrap();
    });
}

#[test]
fn loom_a_cleared_ring_gives_nothing_or_what_was_there() {
    model(|| {
        let (memory, writer, mut head) = filled(2, &[10, 20]);
        let writing = thread::spawn(move || {
            writer.ring().clear(&mut head);
            writer.set(&mut head, 5).unwrap();
        });
        match memory.ring().at(15, CACHE_NS) {
            Ok(None) => (),
            found => assert_whole(found, 15),
        }
        writing.join().unwrap();
        assert_whole(memory.ring().at(5, CACHE_NS), 5);
    });
}

/// Frames 1 and 2 move alike in each run, so that nothing is ever between them.
#[test]
fn loom_no_path_is_half_from_before_a_clear() {
    let mut builder = loom::model::Builder::new();
    builder.preemption_bound = Some(2);
    builder.check(|| {
        let limits = Limits { frames: 3, samples: 2, waiters: 0, ..Limits::default() };
        let tree = Arc::new(TransformTree::new(limits));
        let mut heads = [FrameHead::default(); 3];
        let set = |tree: &TransformTree, heads: &mut [FrameHead; 3], child: u32, x: f64| {
            let transform = Transform::new([x, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]);
            let new = New { stamp_ns: 10, parent: 0, kind: Kind::Dynamic, transform };
            let ring = tree.ring(FrameId(child)).unwrap();
            ring.set(&mut heads[child as usize], &new, CACHE_NS).unwrap();
        };
        [1, 2].iter().for_each(|child| set(&tree, &mut heads, *child, 1.0));
        let writer = tree.clone();
        let writing = thread::spawn(move || {
            writer.clear(&mut heads);
            [1, 2].iter().for_each(|child| set(&writer, &mut heads, *child, 2.0));
        });
        match tree.in_one_epoch(|| tree.path(FrameId(1), FrameId(2), Some(10))) {
            Ok(path) => assert_eq!(path.transform.translation[0], 0.0, "of two runs"),
            Err(error) => assert_eq!(error, PathError::Connectivity),
        }
        writing.join().unwrap();
    });
}

struct NotifyWaker(Notify);

impl Wake for NotifyWaker {
    fn wake(self: std::sync::Arc<NotifyWaker>) {
        self.0.notify();
    }
}

/// A wait that is not woken would sleep for ever, which loom finds. The two sets make it wait for one frame, then for another.
fn wait_beside_two_sets(sets: [(&'static str, &'static str); 2]) {
    let mut builder = loom::model::Builder::new();
    builder.preemption_bound = Some(2);
    builder.check(move || {
        let limits = Limits { frames: 3, samples: 2, waiters: 1, ..Limits::default() };
        let (mut writer, buffer) = Buffer::new(limits).unwrap();
        let set = |parent, child, stamp_ns| TransformStamped {
            parent,
            child,
            stamp_ns,
            transform: Transform::IDENTITY,
        };
        for (parent, child) in [("a", "b"), ("b", "c")] {
            writer.set(&set(parent, child, 10), Kind::Dynamic).unwrap();
        }
        let writing = thread::spawn(move || {
            for (parent, child) in sets {
                writer.set(&set(parent, child, 20), Kind::Dynamic).unwrap();
            }
        });
        let mut wait = pin!(buffer.wait_for("a", "c", Time::At(20)).unwrap());
        let notify = std::sync::Arc::new(NotifyWaker(Notify::new()));
        let waker = Waker::from(notify.clone());
        while let Poll::Pending = wait.as_mut().poll(&mut Context::from_waker(&waker)) {
            notify.0.wait();
        }
        writing.join().unwrap();
    });
}

#[test]
fn loom_a_wait_is_woken_by_the_frames_in_the_order_of_its_way() {
    wait_beside_two_sets([("b", "c"), ("a", "b")]);
}

#[test]
fn loom_a_wait_is_woken_by_the_frames_in_the_other_order() {
    wait_beside_two_sets([("a", "b"), ("b", "c")]);
}
