// SPDX-License-Identifier: MIT OR Apache-2.0
//! Reduces a line of any length to its picture: four points for each column of pixels, and the gaps.

/// A time in nanoseconds, and a value.
pub type Point = (u64, f64);

/// The greatest absolute value that can be drawn; the difference of two greater values may be infinite.
const MOST: f64 = 1e300;

/// Whether a value can be drawn; others are gaps.
pub fn can_be_drawn(value: f64) -> bool {
    value.abs() <= MOST
}

/// A line, column by column. A column looks as if all of its points were drawn.
pub struct Columns {
    from_ns: u64,
    to_ns: u64,
    columns: Vec<Column>,
}

#[derive(Clone, Copy, Default)]
struct Column {
    /// First, lowest, highest, last.
    points: Option<[Point; 4]>,
    is_broken_before: bool,
    is_broken_behind: bool,
}

impl Columns {
    /// Empty columns for the times of this range.
    pub fn new(from_ns: u64, to_ns: u64, columns: usize) -> Self {
        Columns { from_ns, to_ns, columns: vec![Column::default(); columns.max(1)] }
    }

    /// Adds the next value, in order of time; `None` is a gap.
    pub fn add(&mut self, at_ns: u64, value: Option<f64>) {
        let share = at_ns.saturating_sub(self.from_ns) as f64 / (self.to_ns - self.from_ns).max(1) as f64;
        let last = self.columns.len() - 1;
        let column = &mut self.columns[((share * last as f64) as usize).min(last)];
        let Some(value) = value else {
            match column.points {
                Some(_) => column.is_broken_behind = true,
                None => column.is_broken_before = true,
            }
            return;
        };
        let point = (at_ns, value);
        // A gap within a column is too narrow to be seen.
        column.is_broken_behind = false;
        column.points = Some(match column.points {
            None => [point; 4],
            Some([first, lowest, highest, _]) => [
                first,
                if value < lowest.1 { point } else { lowest },
                if value > highest.1 { point } else { highest },
                point,
            ],
        });
    }

    /// The lowest and the highest value.
    pub fn range(&self) -> Option<(f64, f64)> {
        let points = self.columns.iter().filter_map(|column| column.points);
        points
            .map(|[_, lowest, highest, _]| (lowest.1, highest.1))
            .reduce(|one, other| (one.0.min(other.0), one.1.max(other.1)))
    }

    /// The lines to draw. A line has one point if there is a gap on both sides.
    pub fn lines(&self) -> Vec<Vec<Point>> {
        let (mut lines, mut line) = (Vec::new(), Vec::new());
        for column in &self.columns {
            if column.is_broken_before {
                lines.push(std::mem::take(&mut line));
            }
            if let Some(mut points) = column.points {
                points.sort_by_key(|(at_ns, _)| *at_ns);
                for point in points {
                    if line.last() != Some(&point) {
                        line.push(point);
                    }
                }
            }
            if column.is_broken_behind {
                lines.push(std::mem::take(&mut line));
            }
        }
        lines.push(line);
        lines.retain(|line| !line.is_empty());
        lines
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn columns(values: &[(u64, f64)], columns: usize) -> Columns {
        let mut all = Columns::new(values[0].0, values[values.len() - 1].0, columns);
        for (at_ns, value) in values {
            all.add(*at_ns, Some(*value).filter(|value| can_be_drawn(*value)));
        }
        all
    }

    #[test]
    fn few_points_are_all_there() {
        let points = [(100, 1.0), (200, 3.0), (300, -2.0), (400, 0.5)];
        let few = columns(&points, 50);
        assert_eq!(few.lines(), [points.to_vec()]);
        assert_eq!(few.range(), Some((-2.0, 3.0)));
        assert_eq!(columns(&points[..1], 50).lines(), [points[..1].to_vec()]);
    }

    #[test]
    fn no_spike_is_lost() {
        // A million points, two of which are no noise.
        let mut points: Vec<_> = (0..1_000_000).map(|n| (n, (n % 7) as f64)).collect();
        points[123_456].1 = 1000.0;
        points[777_777].1 = -1000.0;
        let many = columns(&points, 800);
        let lines = many.lines();
        assert_eq!(lines.len(), 1);
        assert!(lines[0].len() <= 4 * 800);
        assert!(lines[0].contains(&(123_456, 1000.0)) && lines[0].contains(&(777_777, -1000.0)));
        assert_eq!(many.range(), Some((-1000.0, 1000.0)));
        assert!(lines[0].is_sorted_by_key(|(at_ns, _)| *at_ns));
    }

    #[test]
    fn what_is_no_number_is_a_gap() {
        let nan = f64::NAN;
        let points = [
            (0, 1.0),
            (10, 2.0),
            (20, nan),
            (30, 3.0),
            (40, f64::INFINITY),
            (50, 4.0),
            (60, 5.0),
            (70, 1e301),
            (80, nan),
        ];
        let lines = columns(&points, 81).lines();
        let expected: [&[Point]; 3] = [&[(0, 1.0), (10, 2.0)], &[(30, 3.0)], &[(50, 4.0), (60, 5.0)]];
        assert_eq!(lines, expected);
        // Wider than a column, with columns of points around it; and one that is narrower.
        let mut many: Vec<_> = (0..10_000).map(|n| (n, 1.0)).collect();
        many[4000..5000].iter_mut().for_each(|point| point.1 = nan);
        many[7001].1 = nan;
        let lines = columns(&many, 100).lines();
        assert_eq!(lines.len(), 2);
        assert_eq!((lines[0].last(), lines[1].first()), (Some(&(3999, 1.0)), Some(&(5000, 1.0))));
        assert!(columns(&[(0, nan), (1, nan)], 10).range().is_none());
    }
}
