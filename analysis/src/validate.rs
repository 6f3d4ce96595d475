// SPDX-License-Identifier: MIT OR Apache-2.0
use crate::{AnalysisError, Task};

/// Refuses tasks that the arithmetic cannot bound.
pub(crate) fn validate(task: &Task) -> Result<(), AnalysisError> {
    let name = || task.name.clone();
    if task.period_ns == 0 {
        return Err(AnalysisError::ZeroPeriod { task: name() });
    }
    if task.wcet_ns == 0 {
        return Err(AnalysisError::ZeroWcet { task: name() });
    }
    let fields = [
        ("period", task.period_ns),
        ("wcet", task.wcet_ns),
        ("deadline", task.deadline_ns),
        ("jitter", task.jitter_ns),
        ("blocking", task.blocking_ns),
        ("message overhead", task.message_overhead_ns.unwrap_or(0)),
        ("executor overhead", task.executor_overhead_ns),
    ];
    if let Some((field, _)) = fields.into_iter().find(|(_, ns)| *ns == u64::MAX) {
        return Err(AnalysisError::TooLong { task: name(), field });
    }
    if let Some(reservation) = &task.reservation {
        let problem = match reservation {
            _ if task.group.is_some() => {
                "it shares its thread with others, which has no bound: give it one of its own"
            }
            of if of.runtime_ns == 0 || of.period_ns == 0 => "it is empty: give it a runtime and a period",
            of if of.runtime_ns > of.period_ns => "its runtime is longer than its period: shorten it",
            of if of.period_ns == u64::MAX => "its period is too long: shorten it",
            _ => "",
        };
        if !problem.is_empty() {
            return Err(AnalysisError::BadReservation { task: name(), problem });
        }
    }
    let parts = [
        ("minimum distance", task.min_distance_ns, "period", task.period_ns),
        ("bcet", task.bcet_ns, "wcet", task.wcet_ns),
        ("non-preemptive section", task.non_preemptive_ns, "wcet", task.wcet_ns),
    ];
    match parts.into_iter().find(|(_, part, _, whole)| part > whole) {
        Some((field, _, limit, _)) => Err(AnalysisError::TooLarge { task: name(), field, limit }),
        None => Ok(()),
    }
}
