// SPDX-License-Identifier: MIT OR Apache-2.0
//! How much work is released within a time.
use crate::release::Release;

/// Utilisations are compared as fixed-point numbers with 64 fractional bits, rounded down.
pub(super) const WHOLE_CORE: u128 = 1 << 64;

/// Work that recurs.
#[derive(Debug, Clone)]
pub(super) struct Demand {
    pub release: Release,
    pub cost_ns: u64,
}

impl Demand {
    /// Work released within a window that starts at a critical instant, or `None` on overflow.
    pub fn within(&self, window: u64) -> Option<u64> {
        self.release.most_within(window).checked_mul(self.cost_ns)
    }

    /// Share of the core, in units of 1 / [`WHOLE_CORE`], rounded down.
    pub fn utilisation(&self) -> Option<u128> {
        let (releases, time) = self.release.rate();
        Some(
            u128::from(self.cost_ns).checked_mul(u128::from(releases))?.checked_mul(WHOLE_CORE)?
                / u128::from(time),
        )
    }
}

/// The demand of several tasks together. Demands with one period are added up once, so that a window costs one search for each period,
/// however many tasks have it.
#[derive(Debug, Default)]
pub(super) struct Curve {
    classes: Vec<Class>,
    /// Demands with a least distance or a trace.
    others: Vec<Demand>,
    /// In units of 1 / [`WHOLE_CORE`], each part rounded down.
    pub utilisation: u128,
    pub parts: usize,
    /// Whether any demand has jitter, or comes from a trace.
    pub is_irregular: bool,
}

/// Demands of one period. A jitter is a periods and an offset b: in a window of c periods and d, each has c + a releases, one more if
/// d + b > 0, and another one if d + b > T.
#[derive(Debug)]
struct Class {
    period_ns: u64,
    /// The sum of all costs, and of a times the cost.
    cost_ns: u64,
    before_ns: u64,
    /// The offsets, descending, each with the cost of those down to it.
    offsets: Vec<(u64, u64)>,
}

impl Curve {
    /// `None` on overflow.
    pub fn new(demands: impl IntoIterator<Item = Demand>) -> Option<Self> {
        let mut curve = Self::default();
        let (mut plain, mut others) = (Vec::new(), Vec::new());
        for demand in demands.into_iter().filter(|demand| demand.cost_ns > 0) {
            let release = &demand.release;
            curve.utilisation = curve.utilisation.checked_add(demand.utilisation()?)?;
            curve.parts += 1;
            curve.is_irregular |= release.jitter_ns > 0 || release.distances.is_some();
            match release.min_distance_ns == 0 && release.distances.is_none() && release.period_ns > 0 {
                true => plain.push((release.period_ns, release.jitter_ns % release.period_ns, demand)),
                false => others.push(demand),
            }
        }
        plain.sort_unstable_by_key(|(period_ns, offset_ns, _)| (*period_ns, std::cmp::Reverse(*offset_ns)));
        for alike in plain.chunk_by(|one, other| one.0 == other.0) {
            let mut class = Class {
                period_ns: alike[0].0,
                cost_ns: 0,
                before_ns: 0,
                offsets: Vec::with_capacity(alike.len()),
            };
            for (period_ns, offset_ns, Demand { release, cost_ns }) in alike {
                class.cost_ns = class.cost_ns.checked_add(*cost_ns)?;
                let before_ns = (release.jitter_ns / period_ns).checked_mul(*cost_ns)?;
                class.before_ns = class.before_ns.checked_add(before_ns)?;
                match class.offsets.last_mut().filter(|(last_ns, _)| last_ns == offset_ns) {
                    Some((_, sum_ns)) => *sum_ns = class.cost_ns,
                    None => class.offsets.push((*offset_ns, class.cost_ns)),
                }
            }
            curve.classes.push(class);
        }
        curve.others = merge(others);
        Some(curve)
    }

    /// Work released within a window that starts at a critical instant, or `None` on overflow.
    pub fn within(&self, window: u64) -> Option<u64> {
        if window == 0 {
            return Some(0);
        }
        let mut sum = 0_u64;
        for class in &self.classes {
            let (whole, rest) = (window / class.period_ns, window % class.period_ns);
            let of = |least: u64| match class.offsets.partition_point(|(offset_ns, _)| *offset_ns > least) {
                0 => 0,
                count => class.offsets[count - 1].1,
            };
            let once = if rest > 0 { class.cost_ns } else { of(0) };
            let twice = of(class.period_ns - rest);
            sum = sum.checked_add(whole.checked_mul(class.cost_ns)?)?.checked_add(class.before_ns)?;
            sum = sum.checked_add(once)?.checked_add(twice)?;
        }
        self.others.iter().try_fold(sum, |sum, demand| sum.checked_add(demand.within(window)?))
    }
}

/// Drops demands without a cost and joins those that are released alike: systems have fewer rates than callbacks.
pub(super) fn merge(mut demands: Vec<Demand>) -> Vec<Demand> {
    demands.retain(|demand| demand.cost_ns > 0);
    let key = |d: &Demand| (d.release.period_ns, d.release.jitter_ns, d.release.min_distance_ns);
    demands.sort_by_key(key);
    demands.dedup_by(|next, kept| {
        let joint = kept.cost_ns.checked_add(next.cost_ns).filter(|_| kept.release == next.release);
        kept.cost_ns = joint.unwrap_or(kept.cost_ns);
        joint.is_some()
    });
    demands
}
