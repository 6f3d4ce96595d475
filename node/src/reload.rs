// SPDX-License-Identifier: MIT OR Apache-2.0
//! Adopts a changed text of the system file while callbacks run: their priorities, reservations, budgets, deadlines.
//!
//! ```text
//!  requester                         each process that has the file
//!   checks the new text against what runs; holds the domain's gate
//!   order: could you?        ->       reads the file again, compares      (janitor's thread, low priority)
//!                            <-       yes, or why not: then nothing is changed anywhere
//!   order: do it             ->       sets policies and limits, or all back
//!                            <-       done
//! ```

use crate::error::{Error, Result};
use std::collections::BTreeSet;
use std::path::Path;
use std::sync::{Arc, PoisonError, RwLock};
use std::time::Duration;
use tautline_analysis::file::SystemFile;
use tautline_analysis::file::admission::{Candidate, Share};
use tautline_executor::{CallbackOptions, CallbackSettings, ForeignStatistics, Order, Orders};
use tautline_rt::Patience;
use tautline_rt::clock::monotonic_ns;
use tautline_rt::domain::shared_path;
use tautline_system::{
    Admission, Gate, LoadedSystem, Running, SystemError, decide, is_one_file, label_of, shared_statistics,
};

/// How long a process may take to answer.
const PATIENCE: Duration = Duration::from_secs(10);

/// The system file as it is in force.
#[derive(Debug)]
pub(crate) struct CurrentSystem(RwLock<Arc<LoadedSystem>>);

impl CurrentSystem {
    pub(crate) fn new(system: LoadedSystem) -> CurrentSystem {
        CurrentSystem(RwLock::new(Arc::new(system)))
    }

    pub(crate) fn get(&self) -> Arc<LoadedSystem> {
        Arc::clone(&self.0.read().unwrap_or_else(PoisonError::into_inner))
    }

    fn set(&self, system: LoadedSystem) {
        *self.0.write().unwrap_or_else(PoisonError::into_inner) = Arc::new(system);
    }
}

/// Serves the orders of requesters in a process that has the file.
#[derive(Debug)]
pub(crate) struct Reload {
    domain: u32,
    orders: Orders,
    settings: CallbackSettings,
    system: Arc<CurrentSystem>,
}

impl Reload {
    pub(crate) fn new(
        domain: u32,
        orders: Orders,
        settings: CallbackSettings,
        system: Arc<CurrentSystem>,
    ) -> Reload {
        Reload { domain, orders, settings, system }
    }

    /// Serves the next order, if there is one.
    pub(crate) fn serve_request(&self) {
        if let Some(order) = self.orders.next() {
            self.orders.answer(&order, self.follow(&order));
        }
    }

    fn follow(&self, order: &Order) -> Result<(), String> {
        let current = self.system.get();
        if current.file.fingerprint() == order.system_hash {
            return Ok(());
        }
        let new = current.again().map_err(|error| error.to_string())?;
        if new.file.fingerprint() != order.system_hash {
            return Err("its text has changed since it was checked".into());
        }
        if let Some(obstacle) = current.obstacle(&new) {
            return Err(format!("{obstacle}, which needs a restart"));
        }
        if !order.is_final {
            return Ok(());
        }
        // A process that was stopped may find an order of one that has reported failure, and has ended.
        if Gate::is_free(self.domain) {
            return Err("whoever ordered it has ended".into());
        }
        let threads =
            |system: &LoadedSystem| system.threads().collect::<Result<Vec<CallbackOptions>, SystemError>>();
        let (former, wanted) =
            threads(&current).and_then(|old| Ok((old, threads(&new)?))).map_err(|e| e.to_string())?;
        for (done, options) in wanted.iter().enumerate() {
            if let Err(error) = self.settings.change(options) {
                let undone =
                    former.iter().filter(|old| wanted[..done].iter().any(|new| new.name == old.name));
                for old in undone {
                    if let Err(error) = self.settings.change(old) {
                        tracing::error!("callback `{}` keeps its new settings: {error}", old.name);
                    }
                }
                return Err(error.to_string());
            }
        }
        self.system.set(new);
        Ok(())
    }
}

/// Makes every process of `domain` that runs with the system file at `path` adopt the file's present text: priorities, reservations,
/// budgets and deadlines of running callbacks, and of callbacks that are spawned later. Returns the programs, with their process ids.
///
/// The new text is first checked against the other load in the domain, as if it were just started. While the processes change, for some
/// milliseconds, the bounds of neither text hold.
///
/// # Errors
/// [`Error::System`] with all errors of the file, [`Error::NobodyHas`], [`SystemError::NotAdmitted`] with the response times that would be too
/// long; [`Error::NotTakenUp`] for differences that cannot be adopted at run time: callbacks, nodes, cores, threads, topics, periods,
/// deeper queues.
pub fn apply_system(domain: u32, path: impl AsRef<Path>) -> Result<Vec<String>> {
    let path = std::path::absolute(&path).unwrap_or_else(|_| path.as_ref().to_path_buf());
    let file = SystemFile::read(&path).map_err(SystemError::from)?;
    if !shared_path(domain).exists() {
        return Err(Error::NobodyHas { path, domain });
    }
    let _gate = Gate::enter(domain, Admission::Check)?;
    let mut members = Vec::new();
    for statistics in shared_statistics(domain)?.0 {
        // A process of another version cannot get an order; a process that is ending need not.
        let Ok(Some(snapshot)) = statistics.read() else { continue };
        let process = snapshot.process;
        // A process that is played from a bag has no callbacks.
        let is_member = is_one_file(&process.system_path, &path) && process.stands_in.is_empty();
        if !is_member || !statistics.is_running() {
            continue;
        }
        if !process.takes_orders {
            let why = "its threads are its own, as rclcpp's and rclpy's: restart it".to_owned();
            return Err(Error::NotTakenUp { process: label_of(&process), path, why, changed: false });
        }
        members.push((statistics, process));
    }
    if members.is_empty() {
        return Err(Error::NobodyHas { path, domain });
    }
    let label = path.display().to_string();
    let hosts: BTreeSet<&str> = members.iter().map(|(_, process)| process.host.as_str()).collect();
    for host in hosts {
        let running = Running::beside(domain, Some((&path, &file)))?;
        let candidate = Candidate::File(Share { file: &file, host, label: &label });
        decide(domain, Admission::Check, &running, &candidate, &label, Some(&label)).map_err(|error| {
            match error {
                SystemError::NotAdmitted { what, domain, late, beside, .. } => {
                    let table = "nothing was changed".to_owned();
                    SystemError::NotAdmitted { what, domain, late, beside, table }
                }
                error => error,
            }
        })?;
    }
    for is_final in [false, true] {
        let mut changed = false;
        for (statistics, process) in &members {
            let refused = |why: String| Error::NotTakenUp {
                process: label_of(process),
                path: path.clone(),
                why,
                changed,
            };
            request_reload(domain, statistics, file.fingerprint(), is_final).map_err(refused)?;
            changed = is_final;
        }
    }
    Ok(members.iter().map(|(_, process)| label_of(process)).collect())
}

/// Sends one order and waits for its answer. A process that ends meanwhile needs no settings any more.
fn request_reload(
    domain: u32,
    process: &ForeignStatistics,
    system_hash: u64,
    is_final: bool,
) -> Result<(), String> {
    let number = monotonic_ns().max(1);
    process.order(number, system_hash, is_final).map_err(|error| error.to_string())?;
    let mut patience = Patience::new(PATIENCE);
    tautline_transport::call_all(domain).map_err(|error| error.to_string())?;
    while process.is_running() {
        if let Some(answer) = process.answer(number).map_err(|error| error.to_string())? {
            return answer;
        }
        if patience.is_over() {
            // Once it runs again, it must not follow an order that has failed.
            let _ = process.order(0, 0, false);
            return Err(format!("it has not answered for {PATIENCE:?}; is it stopped?"));
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    Ok(())
}
