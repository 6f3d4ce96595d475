// SPDX-License-Identifier: MIT OR Apache-2.0
//! Random trees against a reference that keeps all samples, searches them one by one, and multiplies matrices.

mod support;

use std::time::Duration;

use support::{Matrix, Random, assert_near, identity, interpolate, inverse, matrix, times};
use tautline_tf::{Buffer, Kind, Limits, LookupError, SetError, Stamped, Time, TransformStamped};

const FRAMES: usize = 9;
const CACHE_NS: i64 = 60;

#[derive(Clone, Copy)]
struct Sample {
    stamp_ns: i64,
    parent: usize,
    matrix: Matrix,
}

/// The samples of a frame since it was cleared or changed its kind, in the order in which they were set.
#[derive(Clone)]
struct Frame {
    ring: usize,
    kind: Option<Kind>,
    set: Vec<Sample>,
}

#[derive(Debug, PartialEq)]
enum Missing {
    Connectivity,
    Extrapolation { frame: usize, oldest_ns: i64, newest_ns: i64 },
}

impl Frame {
    fn newest_ns(&self) -> i64 {
        self.set.iter().map(|sample| sample.stamp_ns).max().unwrap()
    }

    /// The newest stamp that has left a ring.
    fn gone_ns(&self, ring: usize) -> i64 {
        let gone = &self.set[..self.set.len().saturating_sub(ring)];
        gone.iter().map(|sample| sample.stamp_ns).max().unwrap_or(i64::MIN)
    }

    /// What can be found, by stamp.
    fn kept(&self) -> Vec<Sample> {
        let (gone_ns, kept_ns) = (self.gone_ns(self.ring), self.newest_ns() - CACHE_NS);
        let mut kept = self.set.clone();
        kept.retain(|sample| sample.stamp_ns > gone_ns && sample.stamp_ns >= kept_ns);
        kept.sort_by_key(|sample| sample.stamp_ns);
        kept
    }

    fn set(&mut self, sample: Sample, kind: Kind) -> Result<(), &'static str> {
        if self.kind != Some(kind) {
            *self = Frame { kind: Some(kind), set: Vec::new(), ..*self };
        }
        if kind == Kind::Dynamic && !self.set.is_empty() && sample.stamp_ns <= self.newest_ns() {
            let above_ns = self.gone_ns(self.ring - 1).max(self.newest_ns() - CACHE_NS - 1);
            if sample.stamp_ns == self.newest_ns() {
                return Err("repeated");
            } else if sample.stamp_ns <= above_ns {
                return Err("old");
            } else if self.set.iter().any(|other| other.stamp_ns == sample.stamp_ns) {
                return Err("repeated");
            }
        }
        self.set.push(sample);
        Ok(())
    }

    fn at(&self, frame: usize, time: Time) -> Result<Option<(usize, Matrix, Option<i64>)>, Missing> {
        let Some(last) = self.set.last() else { return Ok(None) };
        if self.kind == Some(Kind::Static) {
            return Ok(Some((last.parent, last.matrix, None)));
        }
        let kept = self.kept();
        let (oldest_ns, newest) = (kept[0].stamp_ns, kept[kept.len() - 1]);
        let stamp_ns = match time {
            Time::Latest => newest.stamp_ns,
            Time::At(stamp_ns) => stamp_ns,
        };
        if !(oldest_ns..=newest.stamp_ns).contains(&stamp_ns) {
            return Err(Missing::Extrapolation { frame, oldest_ns, newest_ns: newest.stamp_ns });
        }
        let older = kept.iter().rfind(|sample| sample.stamp_ns <= stamp_ns).unwrap();
        let newer = kept.iter().find(|sample| sample.stamp_ns >= stamp_ns).unwrap();
        let mut found = older.matrix;
        if older.stamp_ns != newer.stamp_ns && older.parent == newer.parent {
            let ratio = (stamp_ns - older.stamp_ns) as f64 / (newer.stamp_ns - older.stamp_ns) as f64;
            found = interpolate(&older.matrix, &newer.matrix, ratio);
        }
        Ok(Some((older.parent, found, Some(stamp_ns))))
    }
}

struct Reference(Vec<Frame>);

impl Reference {
    /// All frames up to the root, with the way there from `frame` and the oldest stamp on it; and why it ends.
    #[allow(clippy::type_complexity)]
    fn up(&self, frame: usize, time: Time) -> (Vec<(usize, Matrix, Option<i64>)>, Option<Missing>) {
        let mut way = vec![(frame, identity(), None)];
        loop {
            let (frame, matrix, stamp_ns) = *way.last().unwrap();
            match self.0[frame].at(frame, time) {
                Ok(None) => return (way, None),
                Err(missing) => return (way, Some(missing)),
                Ok(Some((parent, edge, edge_ns))) => {
                    way.push((parent, times(&edge, &matrix), edge_ns.into_iter().chain(stamp_ns).min()));
                }
            }
        }
    }

    fn lookup(&self, target: usize, source: usize, time: Time) -> Result<(Matrix, Option<i64>), Missing> {
        if target == source && time == Time::Latest {
            let newest = self.0[source].at(source, time)?;
            return Ok((identity(), newest.and_then(|(.., stamp_ns)| stamp_ns)));
        }
        let (from_source, why_source) = self.up(source, time);
        let (from_target, why_target) = self.up(target, time);
        let common = from_target.iter().find_map(|target| {
            from_source.iter().find(|source| source.0 == target.0).map(|source| (target, source))
        });
        let Some((target_way, source_way)) = common else {
            return Err(why_target.or(why_source).unwrap_or(Missing::Connectivity));
        };
        let matrix = times(&inverse(&target_way.1), &source_way.1);
        match (time, target_way.2.into_iter().chain(source_way.2).min()) {
            (Time::At(stamp_ns), _) => Ok((matrix, Some(stamp_ns))),
            (Time::Latest, None) => Ok((matrix, None)),
            (Time::Latest, Some(common_ns)) => self.lookup(target, source, Time::At(common_ns)),
        }
    }
}

fn name(frame: usize) -> String {
    format!("frame_{frame}")
}

fn check(got: &Result<Stamped, LookupError>, wanted: &Result<(Matrix, Option<i64>), Missing>) {
    match (got, wanted) {
        (Ok(got), Ok((wanted, stamp_ns))) => {
            assert_eq!(got.stamp_ns, *stamp_ns);
            assert_near(&matrix(&got.transform), wanted);
        }
        (Err(LookupError::Connectivity { .. }), Err(Missing::Connectivity)) => (),
        (
            Err(LookupError::Extrapolation { frame: got, oldest_ns, newest_ns, .. }),
            Err(Missing::Extrapolation { frame, oldest_ns: oldest, newest_ns: newest }),
        ) => assert_eq!((got.name().as_str(), oldest_ns, newest_ns), (&*name(*frame), oldest, newest)),
        other => panic!("{other:?}"),
    }
}

#[test]
fn random_trees() {
    let mut random = Random::new();
    let (mut found, mut late, mut old, mut repeated) = (0, 0, 0, 0);
    for _ in 0..60 {
        let ring = [4, 16][random.below(2) as usize];
        // Rounded up to the ring.
        let samples = ring - ring / 8;
        let cache_time = Duration::from_nanos(CACHE_NS as u64);
        let limits = Limits { frames: FRAMES, samples, cache_time, waiters: 0 };
        let (mut writer, buffer) = Buffer::new(limits).unwrap();
        let mut reference = Reference(vec![Frame { ring, kind: None, set: Vec::new() }; FRAMES]);
        // All named, so that what is missing is samples.
        for frame in 1..FRAMES {
            let transform = TransformStamped {
                parent: &name(0),
                child: &name(frame),
                stamp_ns: 0,
                transform: random.transform(),
            };
            writer.set(&transform, Kind::Dynamic).unwrap();
        }
        writer.clear();
        let mut now_ns = 0;
        let mut parents: Vec<usize> =
            (0..FRAMES).map(|frame| random.below(frame.max(1) as u64) as usize).collect();
        // Some trees are fed in order, some by one that is late every other time.
        let lateness = [1, 20, 150][random.below(3) as usize];
        let statics = random.below(3);
        for _ in 0..300 {
            now_ns += random.below(4) as i64;
            let child = 1 + random.below(FRAMES as u64 - 1) as usize;
            if random.below(40) == 0 {
                parents[child] = random.below(child as u64) as usize;
            }
            if random.below(150) == 0 {
                writer.clear();
                let dynamic = reference.0.iter_mut().filter(|frame| frame.kind == Some(Kind::Dynamic));
                dynamic.for_each(|frame| frame.set.clear());
                now_ns -= random.below(30) as i64;
            }
            let is_static = (child as u64) < statics || random.below(200) == 0;
            let kind = if is_static { Kind::Static } else { Kind::Dynamic };
            let stamp_ns = now_ns - random.below(lateness) as i64;
            let (parent, transform) = (parents[child], random.transform());
            let set = writer.set(
                &TransformStamped { parent: &name(parent), child: &name(child), stamp_ns, transform },
                kind,
            );
            let wanted =
                reference.0[child].set(Sample { stamp_ns, parent, matrix: matrix(&transform) }, kind);
            match (set, wanted) {
                (Ok(()), Ok(())) => (),
                (Err(SetError::Old { .. }), Err("old")) => old += 1,
                (Err(SetError::Repeated { .. }), Err("repeated")) => repeated += 1,
                other => panic!("{other:?}"),
            }
            for _ in 0..4 {
                let mut frame = || random.below(FRAMES as u64) as usize;
                let (target, source, fixed) = (frame(), frame(), frame());
                let mut time = || match random.below(4) {
                    0 => Time::Latest,
                    _ => Time::At(now_ns + 3 - random.below(CACHE_NS as u64 + 15) as i64),
                };
                let (time, other_time) = (time(), time());
                let got = buffer.lookup(&*name(target), &*name(source), time);
                check(&got, &reference.lookup(target, source, time));
                assert_eq!(got.is_ok(), buffer.can_transform(&*name(target), &*name(source), time));
                if let Ok(there) = got {
                    found += 1;
                    let back = buffer.lookup(&*name(source), &*name(target), time).unwrap();
                    assert_near(&matrix(&(there.transform * back.transform)), &identity());
                }
                let full = buffer.lookup_full(
                    buffer.frame(&name(target)).unwrap(),
                    time,
                    buffer.frame(&name(source)).unwrap(),
                    other_time,
                    &*name(fixed),
                );
                let wanted = reference.lookup(fixed, source, other_time).and_then(|(first, _)| {
                    let (second, stamp_ns) = reference.lookup(target, fixed, time)?;
                    Ok((times(&second, &first), stamp_ns))
                });
                check(&full, &wanted);
            }
        }
        for (frame, info) in buffer.frames().iter().enumerate() {
            let of = &reference.0[buffer_number(&info.name.to_string())];
            assert_eq!(info.stamps_ns.is_some(), !of.set.is_empty(), "{frame}");
            if of.kind == Some(Kind::Dynamic) && !of.set.is_empty() {
                let kept = of.kept();
                assert_eq!(info.samples, kept.len());
                assert_eq!(info.stamps_ns, Some((kept[0].stamp_ns, of.newest_ns())));
            }
        }
        late += buffer.counters().out_of_order;
    }
    println!("{found} found; {late} late, {old} old, {repeated} repeated");
    assert!(found > 10_000 && late > 1_000 && old > 300 && repeated > 200, "the test tests little");
}

fn buffer_number(name: &str) -> usize {
    name.strip_prefix("frame_").unwrap().parse().unwrap()
}
