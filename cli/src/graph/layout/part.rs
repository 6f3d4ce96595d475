// SPDX-License-Identifier: MIT OR Apache-2.0
//! One connected part of a layout.

/// The distance between columns, and between the boxes of a column.
const COLUMN_GAP: f64 = 64.0;
const BOX_GAP: f64 = 18.0;
const LINE_GAP: f64 = 12.0;
/// The distance between lines that end at one box.
const PORT_GAP: f64 = 9.0;
/// The maximum number of places for edges in one part.
const MOST_PLACES: usize = 6_000;
const SWEEPS: usize = 16;
const ROUNDS: usize = 12;

pub type Point = (f64, f64);

/// A box with its least size.
#[derive(Clone, Copy, Debug, Default)]
pub struct Size {
    pub width: f64,
    pub height: f64,
}

/// From one box to another one.
#[derive(Clone, Copy, Debug)]
pub struct Link {
    pub from: usize,
    pub to: usize,
    /// The cost if this link goes from right to left; of several candidates, the link with the least cost does.
    pub weight: i64,
    pub label: Option<Size>,
}

/// A box, a text, or a place through which a line passes.
#[derive(Clone, Default)]
pub(super) struct Spot {
    pub(super) size: Size,
    column: usize,
    is_box: bool,
    y: f64,
    left: Vec<usize>,
    right: Vec<usize>,
}

/// A link in the direction from left to right.
pub(super) struct Chain {
    spots: Vec<usize>,
    pub(super) label: Option<usize>,
    is_turned: bool,
}

pub(super) struct Part {
    pub(super) spots: Vec<Spot>,
    pub(super) chains: Vec<Chain>,
    columns: Vec<Vec<usize>>,
    /// Left edge and width of each column.
    xs: Vec<(f64, f64)>,
    pub(super) size: Size,
}

impl Part {
    pub(super) fn new(boxes: Vec<Size>, links: Vec<Link>) -> Self {
        let spots = boxes.iter().map(|&size| Spot { size, is_box: true, ..Spot::default() }).collect();
        let (columns, xs) = Default::default();
        let mut part = Part { spots, chains: Vec::new(), columns, xs, size: Size::default() };
        let order = order(boxes.len(), &links);
        part.rank(&order, &links);
        part.chain(&order, &links);
        part.sort();
        part.place();
        part
    }

    /// Assigns columns by the longest path from the left. Then boxes with more links to the right move as close to these as possible.
    fn rank(&mut self, order: &[usize], links: &[Link]) {
        let mut by_place: Vec<usize> = (0..order.len()).collect();
        by_place.sort_by_key(|&index| order[index]);
        let (mut left, mut right) = (vec![Vec::new(); order.len()], vec![Vec::new(); order.len()]);
        for link in links {
            let (from, to) =
                if order[link.from] < order[link.to] { (link.from, link.to) } else { (link.to, link.from) };
            // A link with a text needs a column between its boxes.
            let length = 1 + usize::from(link.label.is_some());
            right[from].push((to, length));
            left[to].push((from, length));
        }
        for &index in &by_place {
            let column = left[index].iter().map(|&(from, length)| self.spots[from].column + length).max();
            self.spots[index].column = column.unwrap_or(0);
        }
        for &index in by_place.iter().rev().filter(|&&index| right[index].len() > left[index].len()) {
            let column = right[index].iter().map(|&(to, length)| self.spots[to].column - length).min();
            self.spots[index].column = column.unwrap_or(0);
        }
        let least = self.spots.iter().map(|spot| spot.column).min().unwrap_or(0);
        self.spots.iter_mut().for_each(|spot| spot.column -= least);
    }

    /// Creates places for links, the shortest links first, up to the maximum number.
    fn chain(&mut self, order: &[usize], links: &[Link]) {
        let ends = |link: &Link| match order[link.from] < order[link.to] {
            true => (link.from, link.to, false),
            false => (link.to, link.from, true),
        };
        let span = |spots: &[Spot], link: &Link| spots[link.from].column.abs_diff(spots[link.to].column);
        let spans: Vec<usize> = links.iter().map(|link| span(&self.spots, link)).collect();
        let mut by_span: Vec<usize> = (0..links.len()).collect();
        by_span.sort_by_key(|&index| spans[index]);
        let (mut sum, mut is_straight) = (0, vec![false; links.len()]);
        for index in by_span {
            sum += spans[index];
            is_straight[index] = spans[index] > 2 && sum > MOST_PLACES;
        }
        for (link, is_straight) in links.iter().zip(is_straight) {
            let (from, to, is_turned) = ends(link);
            let (first, last) = (self.spots[from].column, self.spots[to].column);
            let middle = (first + last) / 2;
            let (mut spots, mut label) = (vec![from], None);
            for column in
                (first + 1..last).filter(|&column| !is_straight || (column == middle && link.label.is_some()))
            {
                let text = link.label.filter(|_| column == middle);
                label = text.map(|_| self.spots.len()).or(label);
                spots.push(self.spots.len());
                self.spots.push(Spot { size: text.unwrap_or_default(), column, ..Spot::default() });
            }
            spots.push(to);
            for pair in spots.windows(2) {
                self.spots[pair[0]].right.push(pair[1]);
                self.spots[pair[1]].left.push(pair[0]);
            }
            self.chains.push(Chain { spots, label, is_turned });
        }
        for spot in self.spots.iter_mut().filter(|spot| spot.is_box) {
            let ports = spot.left.len().max(spot.right.len()) as f64;
            spot.size.height = spot.size.height.max(PORT_GAP * (ports + 1.0));
        }
    }

    /// Sets the order within columns that has the fewest crossings of the orders that the sweeps produce.
    fn sort(&mut self) {
        let count = self.spots.iter().map(|spot| spot.column + 1).max().unwrap_or(0);
        self.columns = vec![Vec::new(); count];
        (0..self.spots.len()).for_each(|index| self.columns[self.spots[index].column].push(index));
        let mut best = (self.crossings(), self.columns.clone());
        for sweep in 0..SWEEPS {
            let is_forward = sweep % 2 == 0;
            let mut at = self.positions();
            for step in 0..count {
                let column = if is_forward { step } else { count - 1 - step };
                let centre = |&index: &usize| {
                    let spot = &self.spots[index];
                    let beside = if is_forward { &spot.left } else { &spot.right };
                    let sum: f64 = beside.iter().map(|&other| at[other]).sum();
                    if beside.is_empty() { at[index] } else { sum / beside.len() as f64 }
                };
                let mut keyed: Vec<_> =
                    self.columns[column].iter().map(|index| (centre(index), *index)).collect();
                keyed.sort_by(|one, other| one.0.total_cmp(&other.0));
                let n = keyed.len() as f64;
                self.columns[column] = keyed.into_iter().map(|(_, index)| index).collect();
                self.columns[column]
                    .iter()
                    .zip(0..)
                    .for_each(|(&index, i)| at[index] = (f64::from(i) + 0.5) / n);
            }
            let crossings = self.crossings();
            if crossings < best.0 {
                best = (crossings, self.columns.clone());
            }
        }
        self.columns = best.1;
    }

    /// The relative position of each spot within its column, from 0 to 1.
    fn positions(&self) -> Vec<f64> {
        let mut at = vec![0.0; self.spots.len()];
        for column in &self.columns {
            column.iter().zip(0..).for_each(|(&i, n)| at[i] = (f64::from(n) + 0.5) / column.len() as f64);
        }
        at
    }

    /// The number of crossings between neighbouring columns.
    fn crossings(&self) -> usize {
        let at = self.positions();
        let mut sum = 0;
        for column in &self.columns {
            let mut ends: Vec<(f64, f64)> = Vec::new();
            for &index in column {
                ends.extend(self.spots[index].right.iter().map(|&other| (at[index], at[other])));
            }
            ends.sort_by(|one, other| one.0.total_cmp(&other.0).then(one.1.total_cmp(&other.1)));
            // Counts lines that begin above this one and end below it.
            let mut seen: Vec<f64> = Vec::with_capacity(ends.len());
            for (_, end) in ends {
                let place = seen.partition_point(|other| *other <= end);
                sum += seen.len() - place;
                seen.insert(place, end);
            }
        }
        sum
    }

    fn place(&mut self) {
        let mut x = 0.0;
        for column in &self.columns {
            let width = column.iter().map(|&index| self.spots[index].size.width).fold(0.0, f64::max);
            self.xs.push((x, width));
            x += width + COLUMN_GAP;
        }
        self.size.width = x - COLUMN_GAP;
        let count = self.columns.len();
        for round in 0..ROUNDS {
            for step in 0..count {
                let column = if round % 2 == 0 { step } else { count - 1 - step };
                self.place_column(column, round);
            }
        }
        let edge = |spot: &Spot, side: f64| spot.y + side * spot.size.height / 2.0;
        let top = self.spots.iter().map(|spot| edge(spot, -1.0)).fold(f64::INFINITY, f64::min);
        self.spots.iter_mut().for_each(|spot| spot.y -= top);
        self.size.height = self.spots.iter().map(|spot| edge(spot, 1.0)).fold(0.0, f64::max);
    }

    /// Positions each spot as close as possible to its connected spots, in the given order and without overlap. This is a least-squares
    /// problem, solved by pooling neighbours whose wanted positions conflict.
    fn place_column(&mut self, column: usize, round: usize) {
        let members = self.columns[column].clone();
        let (mut offset, mut before) = (0.0, None::<usize>);
        let mut pools: Vec<(f64, f64, usize)> = Vec::new();
        let mut offsets = Vec::with_capacity(members.len());
        for &index in &members {
            let spot = &self.spots[index];
            if let Some(above) = before.map(|before| &self.spots[before]) {
                let gap = if spot.is_box && above.is_box { BOX_GAP } else { LINE_GAP };
                offset += (above.size.height + spot.size.height) / 2.0 + gap;
            }
            before = Some(index);
            offsets.push(offset);
            // Straight lines count more than centred boxes.
            let (mut sum, mut weight) = (0.0, 0.0);
            let is_forward = round.is_multiple_of(2);
            let sides = [(&spot.left, is_forward), (&spot.right, !is_forward)];
            for (beside, _) in sides.iter().filter(|(_, is_turn)| *is_turn || round + 4 >= ROUNDS) {
                for &other in *beside {
                    let share = if spot.is_box || self.spots[other].is_box { 1.0 } else { 6.0 };
                    (sum, weight) = (sum + share * self.spots[other].y, weight + share);
                }
            }
            let (wanted, weight) = if weight > 0.0 { (sum / weight, weight) } else { (spot.y, 0.1) };
            pools.push(((wanted - offset) * weight, weight, 1));
            while let [.., one, other] = pools[..]
                && one.0 / one.1 > other.0 / other.1
            {
                pools.truncate(pools.len() - 2);
                pools.push((one.0 + other.0, one.1 + other.1, one.2 + other.2));
            }
        }
        let ys = pools.iter().flat_map(|&(sum, weight, n)| std::iter::repeat_n(sum / weight, n));
        for ((&index, offset), y) in members.iter().zip(offsets).zip(ys) {
            self.spots[index].y = y + offset;
        }
    }

    pub(super) fn centre(&self, index: usize) -> Point {
        let spot = &self.spots[index];
        let (x, width) = self.xs[spot.column];
        (x + width / 2.0, spot.y)
    }

    /// The point where a link leaves a box. Lines to higher spots leave above lines to lower ones.
    fn port(&self, index: usize, other: usize, nth: usize, is_right: bool) -> Point {
        let spot = &self.spots[index];
        let beside = if is_right { &spot.right } else { &spot.left };
        let mut ends: Vec<(f64, usize, usize)> = Vec::new();
        beside.iter().enumerate().for_each(|(i, &end)| ends.push((self.spots[end].y, end, i)));
        ends.sort_by(|one, other| one.0.total_cmp(&other.0).then((one.1, one.2).cmp(&(other.1, other.2))));
        let mut same = ends.iter().enumerate().filter(|(_, end)| end.1 == other);
        let place = same.nth(nth).map_or(0, |(place, _)| place);
        let shift = (place as f64 - (ends.len() as f64 - 1.0) / 2.0) * PORT_GAP;
        let (x, y) = self.centre(index);
        let half = spot.size.width / 2.0;
        (if is_right { x + half } else { x - half }, y + shift)
    }

    pub(super) fn line(&self, chain: usize) -> Vec<Point> {
        let Chain { spots, is_turned, .. } = &self.chains[chain];
        let [first, .., last] = spots[..] else { return Vec::new() };
        let (second, last_but_one) = (spots[1], spots[spots.len() - 2]);
        // The number of this link among direct links between the same boxes.
        let nth =
            self.chains[..chain].iter().filter(|other| spots.len() == 2 && other.spots == *spots).count();
        let (from, to) = (self.port(first, second, nth, true), self.port(last, last_but_one, nth, false));
        let edge = |index: usize| {
            let (x, width) = self.xs[self.spots[index].column];
            (x, x + width)
        };
        let mut points = vec![from, (edge(first).1, from.1)];
        for &index in &spots[1..spots.len() - 1] {
            let ((left, right), y) = (edge(index), self.spots[index].y);
            points.extend([(left, y), (right, y)]);
        }
        points.extend([(edge(last).0, to.1), to]);
        // A box as wide as its column begins and ends where its line does, so points repeat.
        points.dedup();
        if *is_turned {
            points.reverse();
        }
        points
    }
}

/// An order in which few links go back: sources first, sinks last, the others by outgoing less incoming links (Eades, Lin and Smyth).
fn order(n: usize, links: &[Link]) -> Vec<usize> {
    let (mut gives, mut takes) = (vec![0_i64; n], vec![0_i64; n]);
    let mut beside: Vec<Vec<(usize, bool, i64)>> = vec![Vec::new(); n];
    for link in links {
        gives[link.from] += link.weight;
        takes[link.to] += link.weight;
        beside[link.from].push((link.to, true, link.weight));
        beside[link.to].push((link.from, false, link.weight));
    }
    let (mut order, mut first, mut last) = (vec![usize::MAX; n], 0, n);
    while first < last {
        let left = (0..n).filter(|&index| order[index] == usize::MAX);
        let rank = |&index: &usize| match (takes[index], gives[index]) {
            (0, _) => (2, 0),
            (_, 0) => (1, 0),
            (takes, gives) => (0, gives - takes),
        };
        // Reversed, because `max_by_key` returns the last of equal boxes.
        let Some(next) = left.rev().max_by_key(rank) else { break };
        if takes[next] > 0 && gives[next] == 0 {
            last -= 1;
            order[next] = last;
        } else {
            order[next] = first;
            first += 1;
        }
        for &(other, is_to, weight) in &beside[next] {
            if is_to { takes[other] -= weight } else { gives[other] -= weight }
        }
    }
    order
}
