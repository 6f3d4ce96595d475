// SPDX-License-Identifier: MIT OR Apache-2.0
//! Determines the fastest input.

/// Forms sets by the rates of the inputs: message_filters' `LatestTime`.
///
/// Each message of the *pivot* makes a set of the newest messages of all inputs. The pivot is the input with the highest rate among
/// those that are not late. So another input takes over if the pivot slows down or stops. A rate is known from an input's second
/// message on.
///
/// A rate is a moving average of 1 / (time between two messages), and its error is a moving average of the distances from this average.
/// If a new value is more than [`margin_factor`](RateConfig::margin_factor) errors away, the average restarts. An input is late if a
/// message that arrived now would be too slow by that much. If the clock goes back, the rate of an input restarts with its next
/// message.
///
/// # Real-time
/// For each message one step for each input; no allocation.
#[derive(Clone, Debug)]
pub struct LatestTime {
    rates: [Rate; crate::MAX_INPUTS],
}

/// How rates are estimated, and when a rate counts as changed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RateConfig {
    /// The weight of the newest value in a rate, 0 to 1.
    pub rate_ema_alpha: f64,
    /// The weight of the newest value in a rate's error, 0 to 1.
    pub error_ema_alpha: f64,
    /// The distance from the rate, in errors, that counts as a change.
    pub margin_factor: f64,
}

impl Default for RateConfig {
    fn default() -> Self {
        RateConfig { rate_ema_alpha: 0.9, error_ema_alpha: 0.3, margin_factor: 10.0 }
    }
}

/// Relative error of the arithmetic that is no change of a rate.
const ROUNDING: f64 = 1e-9;

#[derive(Clone, Copy, Debug, Default)]
struct Rate {
    config: RateConfig,
    last_ns: Option<i64>,
    hz: Option<f64>,
    /// `None` before the third message.
    error_hz: Option<f64>,
}

impl Default for LatestTime {
    fn default() -> Self {
        Self::new()
    }
}

impl LatestTime {
    /// With message_filters' weights.
    #[must_use = "give it to a Synchronizer"]
    pub fn new() -> Self {
        LatestTime { rates: [Rate::default(); crate::MAX_INPUTS] }
    }

    /// How the rates of all inputs are estimated (`setRateConfig`). A weight outside of 0 to 1, or a factor below 0, is replaced by the
    /// default.
    #[must_use = "it returns the changed policy"]
    pub fn rate_config(mut self, config: RateConfig) -> Self {
        self.rates.iter_mut().for_each(|rate| rate.config = config.checked());
        self
    }

    /// The same for input `input` (from 0) only (`setRateConfigPerMessage`). An input that does not exist is
    /// ignored.
    #[must_use = "it returns the changed policy"]
    pub fn rate_config_of(mut self, input: usize, config: RateConfig) -> Self {
        if let Some(rate) = self.rates.get_mut(input) {
            rate.config = config.checked();
        }
        self
    }

    /// Records that a message of an input has arrived at this time. Returns whether it makes a set, provided
    /// that each input has a message.
    pub fn arrived(&mut self, input: usize, now_ns: i64) -> bool {
        let Some(hz) = self.rates.get_mut(input).and_then(|rate| rate.update(now_ns)) else { return false };
        let is_faster = |(i, other): (usize, &Rate)| {
            // Of equal rates, the first input counts.
            let comes_first = other.hz.is_some_and(|other| if i < input { other >= hz } else { other > hz });
            i != input && comes_first && !other.is_late(now_ns)
        };
        !self.rates.iter().enumerate().any(is_faster)
    }
}

impl RateConfig {
    fn checked(self) -> Self {
        let default = RateConfig::default();
        let weight = |alpha: f64, default: f64| if (0.0..=1.0).contains(&alpha) { alpha } else { default };
        RateConfig {
            rate_ema_alpha: weight(self.rate_ema_alpha, default.rate_ema_alpha),
            error_ema_alpha: weight(self.error_ema_alpha, default.error_ema_alpha),
            margin_factor: if self.margin_factor >= 0.0 { self.margin_factor } else { default.margin_factor },
        }
    }
}

impl Rate {
    /// Updates the rate with a message that arrives now; `None` if the rate is not known.
    fn update(&mut self, now_ns: i64) -> Option<f64> {
        let period_ns = now_ns.saturating_sub(self.last_ns.replace(now_ns)?);
        if period_ns < 0 {
            (self.hz, self.error_hz) = (None, None);
        }
        if period_ns <= 0 {
            return None;
        }
        let now_hz = 1e9 / period_ns as f64;
        // In this form a value that does not change is not rounded: inputs of one rate have exactly equal rates.
        let mix = |alpha: f64, new: f64, old: f64| old + alpha * (new - old);
        let hz = match (self.hz, self.error_hz) {
            (Some(hz), Some(error_hz)) if (hz - now_hz).abs() > self.margin(hz, error_hz) => {
                self.error_hz = None;
                now_hz
            }
            (Some(hz), error_hz) => {
                let error = (hz - now_hz).abs();
                self.error_hz =
                    Some(error_hz.map_or(error, |old| mix(self.config.error_ema_alpha, error, old)));
                mix(self.config.rate_ema_alpha, now_hz, hz)
            }
            (None, _) => now_hz,
        };
        self.hz = Some(hz);
        self.hz
    }

    fn margin(&self, hz: f64, error_hz: f64) -> f64 {
        self.config.margin_factor * error_hz + ROUNDING * hz
    }

    /// Whether a message that came now would be too late for the rate.
    fn is_late(&self, now_ns: i64) -> bool {
        let (Some(last_ns), Some(hz), Some(error_hz)) = (self.last_ns, self.hz, self.error_hz) else {
            return false;
        };
        let period_ns = now_ns.saturating_sub(last_ns);
        period_ns > 0 && hz - 1e9 / period_ns as f64 > self.margin(hz, error_hz)
    }
}
