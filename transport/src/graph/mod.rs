// SPDX-License-Identifier: MIT OR Apache-2.0
//! Graph: what exists in a domain, in this process, on this host and on other hosts. It is maintained state, not the result of a query.
//!
//! In: the nodes and ports that this participant writes to its [record](own). Out: the participants ([`domain`]), their records, read
//! from the last position on ([`log`], [`record`]), and the whole graph ([`model`]). Reading opens no topic, occupies nothing and waits
//! for no process. A gateway announces the entities of other hosts in its record ([`remote`], [`origin`]).
//! Who may touch it: each process writes only its own record; all members write the domain's file. No thread that publishes or takes.

pub(crate) mod domain;
pub(crate) mod entities;
pub(crate) mod events;
pub(crate) mod log;
mod log_part;
pub(crate) mod model;
pub(crate) mod origin;
pub(crate) mod own;
pub(crate) mod record;
pub(crate) mod remote;
pub(crate) mod schema_store;
pub(crate) mod topic_type;
