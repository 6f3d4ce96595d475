// SPDX-License-Identifier: MIT OR Apache-2.0
use std::time::Duration;

/// The number of messages a subscription must be able to hold so that none is overwritten, the one its callback is
/// working on included: the most that can arrive within one response time, ceil((R + J) / T), and at least 1.
///
/// `response` counts from the actual arrival; if it counts from the nominal one, jitter is charged twice, which is safe.
/// Holds only if `response` is a bound, that is for a real-time thread on a core that is not full:
/// [`Response::queue_capacity`](crate::Response::queue_capacity) checks the latter. `None` if `period` is zero or the
/// number exceeds `usize`.
///
/// ```
/// use std::time::Duration;
/// let ms = Duration::from_millis;
/// assert_eq!(tautline_analysis::queue_capacity(ms(170), ms(200), ms(0)), Some(1));
/// assert_eq!(tautline_analysis::queue_capacity(ms(76), ms(10), ms(0)), Some(8));
/// ```
pub fn queue_capacity(response: Duration, period: Duration, jitter: Duration) -> Option<usize> {
    if period.is_zero() {
        return None;
    }
    // Each term is below 2^94, so the sum cannot overflow.
    let arrivals = (response.as_nanos() + jitter.as_nanos()).div_ceil(period.as_nanos());
    usize::try_from(arrivals.max(1)).ok()
}

#[cfg(test)]
mod tests {
    use super::queue_capacity;
    use std::time::Duration;

    #[test]
    fn counts_arrivals_in_the_response_time() {
        let ms = Duration::from_millis;
        // One first-in, first-out thread for the five topics: R = 76 for each.
        let capacities = [10, 20, 50, 100, 200].map(|period| queue_capacity(ms(76), ms(period), ms(0)));
        assert_eq!(capacities, [8, 4, 2, 1, 1].map(Some));
        assert_eq!(queue_capacity(ms(10), ms(10), ms(0)), Some(1));
        assert_eq!(queue_capacity(ms(10), ms(10), ms(1)), Some(2));
        assert_eq!(queue_capacity(ms(0), ms(10), ms(0)), Some(1));
    }

    #[test]
    fn refuses_what_it_cannot_count() {
        let ns = Duration::from_nanos;
        assert_eq!(queue_capacity(ns(1), Duration::ZERO, ns(0)), None);
        assert_eq!(queue_capacity(Duration::MAX, ns(1), Duration::MAX), None);
    }
}
