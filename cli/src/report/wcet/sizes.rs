// SPDX-License-Identifier: MIT OR Apache-2.0
//! Execution times by the size of the input, and a line that bounds them.

use super::super::run::SizeClass;
use super::tail::{NoTail, Tail, tail_of_longest, words};
use crate::table::{ms, write_table};
use serde_json::{Value, json};
use std::fmt;
use std::io::{self, Write};

/// Jobs with inputs of about one size, and the estimated tail of their execution times.
pub struct Class<'r> {
    seen: &'r SizeClass,
    pub tail: Result<Tail, NoTail>,
}

/// `wcet(size) = fixed + per_unit * size`, with `per_unit >= 0`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Line {
    pub fixed_ns: f64,
    pub per_unit_ns: f64,
}

impl<'r> Class<'r> {
    pub fn new(seen: &'r SizeClass, exceedance: f64) -> Self {
        Class { seen, tail: tail_of_longest(&seen.longest_ns, seen.jobs, seen.max_ns, exceedance) }
    }

    /// The longest measured time, or the estimate for the requested number of jobs if that is longer.
    fn needed_ns(&self) -> f64 {
        let max_ns = self.seen.max_ns as f64;
        self.tail.map_or(max_ns, |tail| max_ns.max(tail.upper_ns))
    }

    fn sizes(&self) -> String {
        match (self.seen.least, self.seen.greatest) {
            (least, greatest) if least == greatest => least.to_string(),
            (least, greatest) => format!("{least} to {greatest}"),
        }
    }

    pub fn to_json(&self) -> Value {
        let (seen, ms) = (self.seen, |ns: f64| ns / 1e6);
        json!({
            "least": seen.least, "greatest": seen.greatest, "jobs": seen.jobs, "max_ms": ms(seen.max_ns as f64),
            "estimate_ms": self.tail.ok().map(|tail| ms(tail.estimate_ns)),
            "upper_ms": self.tail.ok().map(|tail| ms(tail.upper_ns)),
            "no_estimate": self.tail.err().map(words),
        })
    }
}

impl Line {
    /// A line that bounds all jobs. Its slope is that of the lowest line above the longest job of each class: of all lines that bound these
    /// jobs, the one with the least sum of distances to them. That is a linear program in two unknowns. With n classes of mean size m,
    /// the sum is n (fixed + per_unit m) less a constant, so the line is the one that is lowest at m: the edge of the upper convex hull at
    /// m (A. M. Andrew, Information Processing Letters 9(5), 1979). A falling line is replaced by the lowest level one, which is the best of
    /// those that do not fall, because the sum is convex in the slope.
    ///
    /// The sizes of a class's other jobs are unknown. Therefore the line is raised until it is above the class's maximum at its least size,
    /// by at most an eighth of `per_unit * size` while classes are not merged.
    ///
    /// `None` if there are fewer than two sizes.
    pub fn above(classes: &[Class<'_>]) -> Option<Line> {
        let mut points: Vec<(f64, f64)> =
            classes.iter().map(|class| (class.seen.size_of_max as f64, class.needed_ns())).collect();
        points.sort_by(|one, other| one.0.total_cmp(&other.0).then(one.1.total_cmp(&other.1)));
        let mean = points.iter().map(|(size, _)| size).sum::<f64>() / points.len() as f64;
        let slope = |from: (f64, f64), to: (f64, f64)| (to.1 - from.1) / (to.0 - from.0);
        let mut hull = Vec::<(f64, f64)>::new();
        for point in &points {
            // Of several classes of one size, the last one is the highest.
            hull.pop_if(|last| last.0 == point.0);
            while let [.., before, last] = hull[..]
                && slope(before, last) <= slope(last, *point)
            {
                hull.pop();
            }
            hull.push(*point);
        }
        let edge = hull.windows(2).find(|edge| edge[1].0 >= mean)?;
        let per_unit_ns = slope(edge[0], edge[1]).max(0.0);
        let above = classes.iter().map(|class| class.needed_ns() - per_unit_ns * class.seen.least as f64);
        Some(Line { fixed_ns: above.fold(f64::NEG_INFINITY, f64::max), per_unit_ns })
    }

    /// The bound for a size, rounded up.
    pub fn at(self, size: u64) -> u64 {
        (self.fixed_ns + self.per_unit_ns * size as f64).ceil() as u64
    }

    pub fn to_json(self) -> Value {
        json!({ "fixed_ms": self.fixed_ns / 1e6, "per_unit_ms": self.per_unit_ns / 1e6 })
    }
}

/// The numbers are rounded up, so that the printed line bounds all jobs, too.
impl fmt::Display for Line {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let time = |ns: f64| {
            let (value, unit) = match ns.abs() {
                ..1e3 => (ns, "ns"),
                ..1e6 => (ns / 1e3, "us"),
                _ => (ns / 1e6, "ms"),
            };
            // At least four significant digits.
            let decimals = 3_i32.saturating_sub(value.abs().log10().floor() as i32).clamp(3, 12);
            let scale = 10_f64.powi(decimals);
            let text = format!("{:.*}", decimals as usize, (value * scale).ceil() / scale);
            format!("{}{unit}", text.trim_end_matches('0').trim_end_matches('.'))
        };
        write!(f, "{} + {} * size", time(self.fixed_ns), time(self.per_unit_ns))
    }
}

/// The table of a callback.
pub fn write(name: &str, estimate: &str, classes: &[Class<'_>], out: &mut impl Write) -> io::Result<()> {
    let head = [&*format!("{name}\nby input size"), "jobs", "used max\nms", estimate, "95 %: at most\nms"];
    let cells = |class: &Class<'_>| {
        let of_tail =
            |of: fn(&Tail) -> f64| class.tail.map_or("-".to_owned(), |tail| ms(Some(of(&tail) as u64)));
        let (jobs, max) = (class.seen.jobs.to_string(), ms(Some(class.seen.max_ns)));
        vec![class.sizes(), jobs, max, of_tail(|tail| tail.estimate_ns), of_tail(|tail| tail.upper_ns)]
    };
    write_table(&head, 1, classes.iter().map(|class| (true, cells(class))).collect(), out)?;
    writeln!(out)
}

#[cfg(test)]
mod tests {
    use super::super::tail::Random;
    use super::*;

    fn class(least: u64, greatest: u64, max_ns: u64) -> SizeClass {
        SizeClass { jobs: 1, least, greatest, max_ns, size_of_max: least, longest_ns: vec![max_ns] }
    }

    fn line(classes: &[(u64, u64)]) -> Option<Line> {
        let seen: Vec<_> = classes.iter().map(|(size, max_ns)| class(*size, *size, *max_ns)).collect();
        Line::above(&seen.iter().map(|seen| Class::new(seen, 1e-6)).collect::<Vec<_>>())
    }

    #[test]
    fn the_line_is_the_lowest_that_bounds_all_classes() {
        // On a line; below and above it, where the edge at the mean decides; with an outlier; falling; two classes of one size.
        for (classes, expected) in [
            (&[(0, 100), (10, 120), (20, 140)][..], Some((100.0, 2.0))),
            (&[(0, 0), (10, 100), (20, 150), (30, 160)], Some((50.0, 5.0))),
            (&[(0, 0), (10, 10), (20, 40)], Some((0.0, 2.0))),
            (&[(10, 100), (20, 900), (30, 100), (40, 100), (50, 100)], Some((900.0, 0.0))),
            (&[(1, 50), (2, 40), (3, 30)], Some((50.0, 0.0))),
            (&[(10, 5), (20, 30), (10, 10)], Some((-10.0, 2.0))),
            (&[(7, 50), (7, 40)], None),
            (&[], None),
        ] {
            let found = line(classes).map(|line| (line.fixed_ns, line.per_unit_ns));
            assert_eq!(found, expected, "{classes:?}");
        }
        // Classes whose width is large beside their distance: 100 + size, measured at the upper end of one and in the next one.
        let seen =
            [SizeClass { size_of_max: 1_151, ..class(1_024, 1_151, 1_251) }, class(1_152, 1_152, 1_252)];
        let wide = Line::above(&seen.each_ref().map(|seen| Class::new(seen, 1e-6)));
        assert_eq!(wide, Some(Line { fixed_ns: 227.0, per_unit_ns: 1.0 }));
        let shown = Line { fixed_ns: 120_500.0, per_unit_ns: 34.25 };
        assert_eq!((shown.to_string(), shown.at(10)), ("120.5us + 34.25ns * size".to_owned(), 120_843));
        let shown = |fixed_ns, per_unit_ns| Line { fixed_ns, per_unit_ns }.to_string();
        assert_eq!(shown(1_234_567.1, 0.123_41), "1.235ms + 0.1235ns * size");
        assert_eq!(shown(-10.000_9, 0.000_012_341), "-10ns + 0.00001235ns * size");
        assert_eq!(shown(0.0, 0.0), "0ns + 0ns * size");
    }

    /// Compares with all lines through two classes and all level ones, one of which is the optimum of the program.
    #[test]
    fn no_other_line_is_lower() {
        let mut random = Random(3);
        for _ in 0..300 {
            let mut number = |most: f64| (random.unit() * most) as u64;
            let count = 2 + number(9.0);
            let classes: Vec<_> = (0..count).map(|_| (number(40.0), number(1000.0))).collect();
            let Some(found) = line(&classes) else { continue };
            let points: Vec<_> = classes.iter().map(|(size, ns)| (*size as f64, *ns as f64)).collect();
            let mean = points.iter().map(|point| point.0).sum::<f64>() / points.len() as f64;
            let height = |per_unit: f64| {
                points.iter().map(|point| point.1 - per_unit * (point.0 - mean)).fold(f64::MIN, f64::max)
            };
            let pairs = points.iter().flat_map(|one| points.iter().map(move |other| (one, other)));
            let slopes = pairs
                .filter(|(one, other)| one.0 < other.0)
                .map(|(one, other)| (other.1 - one.1) / (other.0 - one.0));
            let lowest = slopes.filter(|slope| *slope > 0.0).map(height).fold(height(0.0), f64::min);
            let at_mean = found.fixed_ns + found.per_unit_ns * mean;
            assert!((at_mean - lowest).abs() < 1e-6, "{classes:?}: {at_mean} for {lowest}");
            assert!(classes.iter().all(|(size, ns)| found.at(*size) >= *ns), "{classes:?}");
        }
    }

    /// The jobs lie at or below a known line. The line that is found bounds all of them, also at larger sizes, and is too high by at most the
    /// width of a class.
    #[test]
    fn a_known_line_is_found_again() {
        let (fixed, per_unit) = (50_000.0, 30.0);
        let (mut random, mut jobs) = (Random(11), Vec::new());
        let mut seen = std::collections::BTreeMap::<u64, SizeClass>::new();
        for _ in 0..50_000 {
            let size = (10_000.0 + 50_000.0 * random.unit()) as u64;
            let ns = ((fixed + per_unit * size as f64) * (1.0 - 0.3 * random.unit())) as u64;
            jobs.push((size, ns));
            let shift = size.ilog2() - 3;
            let of = seen.entry(size >> shift << shift).or_insert_with(|| SizeClass {
                jobs: 0,
                longest_ns: vec![],
                ..class(size, 0, 0)
            });
            of.jobs += 1;
            (of.least, of.greatest) = (of.least.min(size), of.greatest.max(size));
            if ns > of.max_ns {
                (of.max_ns, of.size_of_max) = (ns, size);
            }
            of.longest_ns.push(ns);
        }
        for of in seen.values_mut() {
            of.longest_ns.sort_unstable();
            of.longest_ns.drain(..of.longest_ns.len().saturating_sub(64));
        }
        // The line bounds the upper limits of the estimates where there are any.
        for (exceedance, estimated, most) in [(1e-6, false, 0.11), (1e-5, true, 0.17)] {
            let classes: Vec<_> = seen.values().map(|seen| Class::new(seen, exceedance)).collect();
            let line = Line::above(&classes).unwrap();
            println!(
                "{} classes, {} estimates: {line}",
                classes.len(),
                classes.iter().filter(|of| of.tail.is_ok()).count()
            );
            assert_eq!(classes.iter().any(|of| of.tail.is_ok()), estimated);
            assert!(jobs.iter().all(|(size, ns)| line.at(*size) >= *ns));
            for size in [10_000, 60_000, 120_000] {
                let (truth, largest) = (fixed + per_unit * size as f64, per_unit * size.max(60_000) as f64);
                let ratio = (line.at(size) as f64 - truth) / largest;
                assert!((-0.01..most).contains(&ratio), "{line} at {size}: {ratio}");
            }
        }
    }

    #[test]
    fn hostile_classes_are_no_trouble() {
        let seen = [
            SizeClass {
                jobs: u64::MAX,
                least: u64::MAX,
                greatest: 0,
                max_ns: u64::MAX,
                size_of_max: 7,
                longest_ns: vec![u64::MAX; 70],
            },
            SizeClass { jobs: 1_000_000, longest_ns: vec![], ..class(0, u64::MAX, 0) },
        ];
        let classes: Vec<_> = seen.iter().map(|seen| Class::new(seen, 1e-6)).collect();
        assert_eq!(Line::above(&classes).unwrap().at(u64::MAX), u64::MAX);
    }
}
