// SPDX-License-Identifier: MIT OR Apache-2.0
//! What unit tests have in common.

/// Puts this process into a scope of its own: whatever else runs on the host, tests see themselves only.
pub(crate) fn isolated() {
    tautline_rt::domain::set_scope(&format!("unit{}", std::process::id())).unwrap();
}
