// SPDX-License-Identifier: MIT OR Apache-2.0
//! Tests that use utilisations only.
use crate::Task;

/// The share of the core the tasks need: the sum of wcet / period, 1.0 being the whole core. Infinite (or NaN) if a
/// period is 0. For display; the analysis compares exactly.
pub fn utilisation(tasks: &[Task]) -> f64 {
    tasks.iter().map(|task| task.wcet_ns as f64 / task.period_ns as f64).sum()
}

/// The utilisation up to which any `count` tasks meet their deadlines under rate-monotonic priorities, n (2^(1/n) - 1)
/// (Liu & Layland 1973), provided that deadlines are periods and there is no jitter or blocking. 1.0 for no task.
pub fn liu_layland_bound(count: usize) -> f64 {
    if count == 0 { 1.0 } else { count as f64 * ((1.0 / count as f64).exp2() - 1.0) }
}

/// Whether the hyperbolic test passes: the product of all (utilisation + 1) is at most 2 (Bini & Buttazzo 2003). If so,
/// the tasks meet their deadlines under rate-monotonic priorities, provided that deadlines are periods and there is no
/// jitter or blocking; if not, nothing is known. Rounded up, so that it never passes wrongly; `false` if a period is 0.
///
/// ```
/// use std::time::Duration;
/// use tautline_analysis::{Task, hyperbolic_test, liu_layland_bound, utilisation};
/// let ms = Duration::from_millis;
/// let tasks = [Task::new("fast", ms(2), ms(1), 2), Task::new("slow", ms(6), ms(2), 1)];
/// assert!(utilisation(&tasks) > liu_layland_bound(2)); // 0.833 > 0.828
/// assert!(hyperbolic_test(&tasks)); // 3/2 * 4/3 = 2
/// ```
pub fn hyperbolic_test(tasks: &[Task]) -> bool {
    const ONE: u128 = 1 << 60;
    let mut product = ONE;
    for task in tasks {
        if task.period_ns == 0 || task.wcet_ns > task.period_ns {
            return false;
        }
        let (wcet, period) = (u128::from(task.wcet_ns), u128::from(task.period_ns));
        // At most 2^61 times 2^64: multiplied before divided, so that exact products stay exact.
        product = match product.checked_mul(period + wcet) {
            Some(product) => product.div_ceil(period),
            None => return false,
        };
        if product > 2 * ONE {
            return false;
        }
    }
    true
}
