// SPDX-License-Identifier: MIT OR Apache-2.0
//! The sets of the policies: message_filters' own cases, and all that could have been chosen, looked at one by one.

use rand::{RngExt, rngs::StdRng};
use std::time::Duration;
use tautline_join::{
    ApproximateEpsilonTime, ApproximateTime, Arrival, ExactTime, LatestTime, Policy, RateConfig,
};

/// A policy with the messages it decides on: their stamps.
struct Queues<P> {
    policy: P,
    waiting: Vec<Vec<i64>>,
    dropped: Vec<(usize, i64)>,
    refused: usize,
}

impl<P: Policy> Queues<P> {
    fn new(mut policy: P, inputs: usize) -> Self {
        policy.start(inputs);
        Queues { policy, waiting: vec![Vec::new(); inputs], dropped: Vec::new(), refused: 0 }
    }

    /// The sets that a message completes.
    fn add(&mut self, input: usize, stamp: i64) -> Vec<Vec<i64>> {
        match self.policy.arrived(input, stamp) {
            Arrival::Wait(place) | Arrival::WaitTooClose(place) => self.waiting[input].insert(place, stamp),
            Arrival::Refuse => self.refused += 1,
        }
        let mut sets = Vec::new();
        let (waiting, dropped) = (&mut self.waiting, &mut self.dropped);
        while self.policy.decide(&mut |input| dropped.push((input, waiting[input].remove(0)))) {
            sets.push(waiting.iter_mut().map(|queue| queue.remove(0)).collect());
        }
        assert!(self.waiting.iter().all(|queue| queue.len() <= self.policy.queue_size()));
        sets
    }
}

/// `"a 0 b 1 a 3"`: messages of inputs a, b, ... with their stamps, in the order in which they come.
fn messages(text: &str) -> Vec<(usize, i64)> {
    let words: Vec<&str> = text.split_whitespace().collect();
    words
        .chunks(2)
        .map(|pair| (usize::from(pair[0].as_bytes()[0] - b'a'), pair[1].parse().unwrap()))
        .collect()
}

fn run<P: Policy>(policy: P, inputs: usize, text: &str) -> Vec<Vec<i64>> {
    let mut queues = Queues::new(policy, inputs);
    messages(text).into_iter().flat_map(|(input, stamp)| queues.add(input, stamp)).collect()
}

#[test]
fn approximate_sets_are_those_of_message_filters() {
    // What ros2/message_filters' test_approximate_time_policy.cpp expects: name, queue size, what comes, the sets.
    type Case = (&'static str, usize, usize, &'static str, &'static [&'static [i64]]);
    let cases: [Case; 9] = [
        ("exact match", 2, 10, "a 0 b 0 a 3 b 3 a 6 b 6", &[&[0, 0], &[3, 3], &[6, 6]]),
        ("perfect match", 2, 10, "a 0 b 1 a 3 b 4 a 6 b 7", &[&[0, 1], &[3, 4]]),
        ("imperfect match", 2, 10, "a 0 b 1 a 2 a 3 b 5 a 6 b 7", &[&[0, 1], &[6, 5]]),
        ("acceleration", 2, 10, "a 0 b 7 a 12 b 15 a 17 b 18", &[&[12, 7], &[17, 18]]),
        ("a queue too short", 2, 1, "a 0 b 1 b 3 a 4 b 7 a 8 a 10 b 11 a 13 b 14", &[&[4, 3], &[10, 11]]),
        (
            "a queue just long enough",
            2,
            2,
            "a 0 b 1 b 3 a 4 b 7 a 8 a 10 b 11 a 13 b 14",
            &[&[0, 1], &[4, 3], &[8, 7], &[10, 11]],
        ),
        (
            "a long queue",
            2,
            5,
            "a 0 a 1 a 2 a 3 a 4 a 5 a 6 a 7 a 8 b 3 a 9 a 10 a 11 a 12 b 10 a 13",
            &[&[10, 10]],
        ),
        ("two at once", 2, 10, "a 0 b 1 b 3 a 3", &[&[0, 1], &[3, 3]]),
        (
            "four topics",
            4,
            10,
            "a 0 b 1 c 2 d 3 a 5 d 5 b 6 c 6 a 8 b 9 c 10 d 11 a 10 a 13 b 14",
            &[&[0, 1, 2, 3], &[5, 6, 6, 5], &[10, 9, 10, 11]],
        ),
    ];
    for (name, inputs, queue_size, text, sets) in cases {
        assert_eq!(run(ApproximateTime::new(queue_size), inputs, text), sets, "{name}");
    }
    assert_eq!(run(ApproximateTime::new(10), 4, "a 0 b 1 c 2 d 3 a 7"), [[0, 1, 2, 3]], "early");
}

#[test]
fn a_promised_distance_lets_sets_go_earlier() {
    // Stamps in tenths, so that 1.5 is a whole number.
    let text = "a 0 b 10 a 30 b 40 a 60 b 70";
    let bound = |tenths| ApproximateTime::new(10).inter_message_lower_bound(0, Duration::from_nanos(tenths));
    assert_eq!(run(bound(15), 2, text), [[0, 10], [30, 40]]);
    assert_eq!(run(bound(20), 2, text), [[0, 10], [30, 40], [60, 70]]);
    let mut queues = Queues::new(bound(20), 2);
    assert_eq!(queues.policy.arrived(0, 0), Arrival::Wait(0));
    assert_eq!(queues.policy.arrived(0, 19), Arrival::WaitTooClose(1));
}

#[test]
fn sets_are_no_longer_than_the_interval() {
    let near = |most| ApproximateTime::new(10).max_interval(Duration::from_nanos(most));
    let text = "a 0 b 5 a 10 b 12 a 20 b 25 a 30 b 40";
    assert_eq!(run(near(2), 2, text), [[10, 12]]);
    assert_eq!(run(near(1), 2, text), Vec::<Vec<i64>>::new());
}

/// Of all sets with the pivot and nothing of the sets before, the shortest span.
fn shortest(all: &[Vec<i64>], from: &[usize], pivot: (usize, i64)) -> i64 {
    let options =
        |i: usize| -> Vec<i64> { if i == pivot.0 { vec![pivot.1] } else { all[i][from[i]..].to_vec() } };
    let mut sets: Vec<(i64, i64)> = vec![(pivot.1, pivot.1)];
    for i in 0..all.len() {
        let extend = |(start, end): (i64, i64)| {
            options(i).into_iter().map(move |stamp| (start.min(stamp), end.max(stamp))).collect::<Vec<_>>()
        };
        sets = sets.into_iter().flat_map(extend).collect();
        sets.sort_unstable();
        sets.dedup();
    }
    sets.into_iter().map(|(start, end)| end - start).min().unwrap()
}

#[test]
fn the_closest_set_with_the_pivot_is_chosen() {
    let mut rng = tautline_seed::random();
    let mut sets_seen = 0;
    for round in 0..2_000 {
        let inputs = rng.random_range(2..=4);
        let all: Vec<Vec<i64>> = (0..inputs)
            .map(|_| {
                let mut stamp = rng.random_range(0..30);
                let (count, gap) = (rng.random_range(2..12), rng.random_range(1..30));
                let next = |stamp: &mut i64, rng: &mut StdRng| {
                    *stamp += rng.random_range(1..=gap);
                    *stamp
                };
                (0..count).map(|_| next(&mut stamp, &mut rng)).collect()
            })
            .collect();
        // In any order in which no input overtakes itself.
        let mut order: Vec<usize> = (0..inputs).flat_map(|i| vec![i; all[i].len()]).collect();
        for i in (1..order.len()).rev() {
            order.swap(i, rng.random_range(0..=i));
        }
        let mut queues = Queues::new(ApproximateTime::new(100).age_penalty(0.0), inputs);
        let (mut next, mut from) = (vec![0; inputs], vec![0; inputs]);
        for input in order {
            let stamp = all[input][next[input]];
            next[input] += 1;
            for set in queues.add(input, stamp) {
                let context = || format!("round {round}: {all:?}, from {from:?}: {set:?}");
                // The latest of the oldest that the set before has left; of equal ones the last.
                let pivot =
                    (0..inputs).map(|i| (all[i][from[i]], i)).max().map(|(stamp, i)| (i, stamp)).unwrap();
                assert_eq!(set[pivot.0], pivot.1, "{}", context());
                let span = set.iter().max().unwrap() - set.iter().min().unwrap();
                assert_eq!(span, shortest(&all, &from, pivot), "{}", context());
                let places: Vec<usize> =
                    (0..inputs).map(|i| all[i].iter().position(|stamp| *stamp == set[i]).unwrap()).collect();
                assert!(places.iter().zip(&from).all(|(place, from)| place >= from), "{}", context());
                from = places.into_iter().map(|place| place + 1).collect();
                sets_seen += 1;
                if from.iter().zip(&all).any(|(from, all)| *from == all.len()) {
                    break;
                }
            }
            if from.iter().zip(&all).any(|(from, all)| *from == all.len()) {
                break;
            }
        }
        assert_eq!(queues.refused, 0);
    }
    assert!(sets_seen > 1_000, "{sets_seen}");
}

#[test]
fn exact_sets_are_those_of_a_table_of_stamps() {
    let mut rng = tautline_seed::random();
    let mut sets_seen = 0;
    for round in 0..2_000 {
        let (inputs, queue_size) = (rng.random_range(2..=4), rng.random_range(1..6));
        let mut queues = Queues::new(ExactTime::new(queue_size), inputs);
        // What message_filters keeps: a row for each stamp, ended by who fills it, the oldest dropped if there are too many.
        let mut table = std::collections::BTreeMap::<i64, Vec<bool>>::new();
        let mut last = i64::MIN;
        for at in 0..60 {
            let (input, stamp) = (rng.random_range(0..inputs), at / 4 + rng.random_range(0..5));
            let row = table.entry(stamp).or_insert_with(|| vec![false; inputs]);
            row[input] = true;
            let mut expected = Vec::new();
            if stamp <= last {
                table.remove(&stamp);
            } else if row.iter().all(|has| *has) {
                expected.push(vec![stamp; inputs]);
                (table, last) = (table.split_off(&(stamp + 1)), stamp);
            }
            while table.len() > queue_size {
                table.pop_first();
            }
            assert_eq!(queues.add(input, stamp), expected, "round {round}, message {at}");
            sets_seen += expected.len();
            let waiting: usize = table.values().flatten().filter(|has| **has).count();
            assert_eq!(queues.waiting.iter().map(Vec::len).sum::<usize>(), waiting, "round {round}");
        }
    }
    assert!(sets_seen > 1_000, "{sets_seen}");
}

#[test]
fn epsilon_sets_are_those_of_message_filters() {
    // What ros2/message_filters' test_approximate_epsilon_time_policy.cpp expects, in tenths of its seconds.
    let run = |epsilon, inputs, text| {
        run(ApproximateEpsilonTime::new(10, Duration::from_nanos(epsilon)), inputs, text)
    };
    assert_eq!(run(5, 2, "a 0 b 0 a 30 b 30 a 60 b 60"), [[0, 0], [30, 30], [60, 60]], "exact match");
    let perfect = "a 0 b 10 a 30 b 40 a 60 b 70";
    assert_eq!(run(15, 2, perfect), [[0, 10], [30, 40], [60, 70]], "perfect match");
    let imperfect = "a 0 b 10 a 20 a 30 b 40 a 60 b 70";
    assert_eq!(run(15, 2, imperfect), [[0, 10], [30, 40], [60, 70]], "imperfect match");
    // At the tolerance, and just beyond it.
    assert_eq!(run(10, 2, "a 0 b 10 a 20 b 31"), [[0, 10]]);
    // Of three, what is near the first is dropped with it: 98 would have been near the next.
    assert_eq!(run(10, 3, "a 89 b 98 c 100 a 93 b 108 a 97 a 101 b 118"), Vec::<Vec<i64>>::new());
}

/// The sets of whole sequences, by the rule as it is said: while all have one, the first are a set or those near the oldest go.
fn epsilon_sets(all: &[Vec<i64>], epsilon: i64) -> Vec<Vec<i64>> {
    let (mut at, mut sets) = (vec![0; all.len()], Vec::new());
    while at.iter().zip(all).all(|(at, all)| *at < all.len()) {
        let fronts: Vec<i64> = at.iter().zip(all).map(|(at, all)| all[*at]).collect();
        let oldest = *fronts.iter().min().unwrap();
        if fronts.iter().max().unwrap() - oldest <= epsilon {
            sets.push(fronts.clone());
        }
        at.iter_mut().zip(fronts).for_each(|(at, front)| *at += usize::from(front - oldest <= epsilon));
    }
    sets
}

#[test]
fn epsilon_sets_do_not_depend_on_the_order_of_inputs() {
    let mut rng = tautline_seed::random();
    let mut sets_seen = 0;
    for round in 0..2_000 {
        let inputs = rng.random_range(2..=4);
        let (epsilon, gap) = (rng.random_range(0..20), rng.random_range(1..20));
        let all: Vec<Vec<i64>> = (0..inputs)
            .map(|_| {
                let mut stamp = 0;
                let next = |_| {
                    stamp += rng.random_range(0..=gap);
                    stamp
                };
                (0..20).map(next).collect()
            })
            .collect();
        let mut order: Vec<usize> = (0..inputs).flat_map(|i| vec![i; 20]).collect();
        for i in (1..order.len()).rev() {
            order.swap(i, rng.random_range(0..=i));
        }
        let policy = ApproximateEpsilonTime::new(100, Duration::from_nanos(epsilon));
        let (mut queues, mut next) = (Queues::new(policy, inputs), vec![0; inputs]);
        let mut sets = Vec::new();
        for input in order {
            sets.extend(queues.add(input, all[input][next[input]]));
            next[input] += 1;
        }
        assert_eq!(sets, epsilon_sets(&all, epsilon as i64), "round {round}: {epsilon} {all:?}");
        // Each message is in a set, dropped, or waits.
        let waiting: usize = queues.waiting.iter().map(Vec::len).sum();
        assert_eq!(sets.len() * inputs + queues.dropped.len() + waiting + queues.refused, inputs * 20);
        assert_eq!(queues.refused, 0);
        sets_seen += sets.len();
    }
    assert!(sets_seen > 1_000, "{sets_seen}");
}

#[test]
fn an_epsilon_queue_drops_its_oldest_and_refuses_what_is_late() {
    let mut queues = Queues::new(ApproximateEpsilonTime::new(2, Duration::from_nanos(1)), 2);
    for stamp in [1, 2, 3] {
        assert!(queues.add(0, stamp).is_empty());
    }
    assert_eq!(queues.dropped, [(0, 1)]);
    assert!(queues.add(0, 2).is_empty());
    assert_eq!(queues.refused, 1);
    assert_eq!(queues.add(1, 2), [[2, 2]]);
    queues.policy.clear();
    queues.waiting.iter_mut().for_each(Vec::clear);
    assert!(queues.add(0, 1).is_empty());
    assert_eq!(queues.add(1, 1), [[1, 1]]);
}

/// `"0 qrp 20 p"`: when which inputs (p, q, r) get a message; those that make a set once all have come, each with the numbers of the
/// messages that it consists of.
fn rate_sets(text: &str) -> Vec<(i64, [usize; 3])> {
    let (mut policy, mut newest, mut sets) = (LatestTime::new(), [0; 3], Vec::new());
    let words: Vec<&str> = text.split_whitespace().collect();
    for pair in words.chunks(2) {
        let ms: i64 = pair[0].parse().unwrap();
        for input in pair[1].bytes().map(|name| usize::from(name - b'p')) {
            newest[input] += 1;
            if policy.arrived(input, ms * 1_000_000) && newest.iter().all(|newest| *newest > 0) {
                sets.push((ms, newest.map(|newest| newest - 1)));
            }
        }
    }
    sets
}

#[test]
fn latest_sets_are_those_of_message_filters() {
    // The cases of ros2/message_filters' test_latest_time_policy.cpp: p every 20 ms, q every 40, r every 80.
    assert_eq!(
        rate_sets("0 qrp 20 p 40 qp 60 p 80 qrp 100 p 120 qp 140 p"),
        (1..8).map(|i| (i as i64 * 20, [i, i / 2, i / 4])).collect::<Vec<_>>(),
        "leading"
    );
    assert_eq!(
        rate_sets("0 p 20 qp 40 p 60 qrp 80 p 100 qp 120 p 140 qrp"),
        (3..8).map(|i| (i as i64 * 20, [i, (i - 1) / 2, (i - 3) / 4])).collect::<Vec<_>>(),
        "trailing"
    );
    // p slows down to one in 60 ms: q takes over once p is late.
    assert_eq!(
        rate_sets("0 qrp 20 p 40 qp 60 p 80 qr 120 qp 160 qr 180 p 200 q"),
        [
            (20, [1, 0, 0]),
            (40, [2, 1, 0]),
            (60, [3, 1, 0]),
            (120, [3, 3, 1]),
            (160, [4, 4, 1]),
            (200, [5, 5, 2])
        ],
        "slower, leading"
    );
    assert_eq!(
        rate_sets("0 p 20 qp 40 p 60 qrp 80 p 100 q 140 qrp 180 q 200 p 220 qr"),
        [(60, [3, 1, 0]), (80, [4, 1, 0]), (140, [4, 3, 0]), (180, [5, 4, 1]), (220, [6, 5, 1])],
        "slower, trailing"
    );
}

#[test]
fn a_pivot_that_stops_is_replaced_and_one_that_returns_takes_over() {
    let mut policy = LatestTime::new();
    let mut sets = |input: usize, times: &[i64]| -> Vec<bool> {
        times.iter().map(|ms| policy.arrived(input, ms * 1_000_000)).collect()
    };
    assert_eq!(sets(1, &[0, 50]), [false, true]);
    assert_eq!(sets(0, &[60, 70, 80, 90]), [false, true, true, true]);
    assert_eq!(sets(1, &[95, 100, 150]), [false, true, true]);
    assert_eq!(sets(0, &[160]), [false], "its gap makes it slow");
    assert_eq!(sets(0, &[170, 180]), [true, true]);
    // Time that stands still or goes back makes no set.
    assert_eq!(sets(0, &[180, 5, 15]), [false, false, true]);
    // Weights that are none are not taken.
    let odd = RateConfig { rate_ema_alpha: f64::NAN, error_ema_alpha: 2.0, margin_factor: -1.0 };
    let mut odd = LatestTime::new().rate_config(odd).rate_config_of(9, odd);
    assert_eq!([0, 10, 20].map(|ms| odd.arrived(0, ms * 1_000_000)), [false, true, true]);
    assert!(!odd.arrived(9, 0));
}

#[test]
fn of_equal_rates_the_first_makes_all_sets() {
    // With any weight, by which the arithmetic rounds each period's rate in another way.
    for weight in 1..=1000 {
        let config = RateConfig { rate_ema_alpha: f64::from(weight) / 1000.0, ..RateConfig::default() };
        let mut policy = LatestTime::new().rate_config(config);
        for period in 0..20 {
            let now = period * 11_000_000;
            let made = [policy.arrived(0, now), policy.arrived(1, now + 4_000_000)];
            assert_eq!(made, [period > 0, false], "weight {weight}, period {period}");
        }
    }
}

#[test]
fn the_fastest_that_is_not_late_makes_sets() {
    let mut rng = tautline_seed::random();
    let (mut made, mut not_made) = (0, 0);
    for round in 0..2_000 {
        let inputs = rng.random_range(2..=4);
        let (alpha, beta, factor) =
            (rng.random_range(0.0..1.0), rng.random_range(0.0..1.0), rng.random_range(0.0..10.0));
        let config = RateConfig { rate_ema_alpha: alpha, error_ema_alpha: beta, margin_factor: factor };
        let mut policy = LatestTime::new().rate_config(config);
        // All messages of each input so far, from which everything is computed anew.
        let mut seen: Vec<Vec<i64>> = vec![Vec::new(); inputs];
        let mut now = 0;
        for _ in 0..60 {
            now += rng.random_range(0..20) * 1_000_000;
            let input = rng.random_range(0..inputs);
            let is_same = seen[input].last() == Some(&now);
            seen[input].push(now);
            let estimate = |seen: &[i64]| -> (Option<f64>, Option<f64>) {
                let mut state: (Option<f64>, Option<f64>) = (None, None);
                let mix = |alpha: f64, new: f64, old: f64| old + alpha * (new - old);
                for period_ns in seen.windows(2).map(|pair| pair[1] - pair[0]).filter(|period| *period != 0) {
                    let hz = 1e9 / period_ns as f64;
                    state = match state {
                        (None, _) => (Some(hz), None),
                        (Some(old), Some(error)) if (old - hz).abs() > factor * error + 1e-9 * old => {
                            (Some(hz), None)
                        }
                        (Some(old), error) => {
                            let found = (old - hz).abs();
                            (
                                Some(mix(alpha, hz, old)),
                                Some(error.map_or(found, |error| mix(beta, found, error))),
                            )
                        }
                    };
                }
                state
            };
            let mut ranks: Vec<(usize, f64, Option<f64>, i64)> = (0..inputs)
                .filter_map(|i| {
                    let (hz, error) = estimate(&seen[i]);
                    Some((i, hz?, error, *seen[i].last()?))
                })
                .collect();
            ranks.sort_by(|a, b| b.1.total_cmp(&a.1));
            let pivot = ranks.iter().find(|(_, hz, error, last)| {
                let late = |error: f64| hz - 1e9 / (now - last) as f64 > factor * error + 1e-9 * hz;
                now == *last || !error.is_some_and(late)
            });
            let expected = !is_same && pivot.is_some_and(|pivot| pivot.0 == input);
            assert_eq!(policy.arrived(input, now), expected, "round {round}: {seen:?} {config:?}");
            made += usize::from(expected);
            not_made += usize::from(!expected);
        }
    }
    assert!(made > 1_000 && not_made > 1_000, "{made} {not_made}");
}

#[test]
fn what_waits_can_be_forgotten() {
    let mut queues = Queues::new(ApproximateTime::new(3), 2);
    assert!(queues.add(0, 100).is_empty() && queues.add(0, 110).is_empty());
    queues.policy.clear();
    queues.waiting.iter_mut().for_each(Vec::clear);
    // Out of order if it was not forgotten.
    assert_eq!(queues.add(0, 1), Vec::<Vec<i64>>::new());
    assert_eq!(queues.add(1, 1), [[1, 1]]);
    assert_eq!(queues.refused, 0);
}
