// SPDX-License-Identifier: MIT OR Apache-2.0
//! The log macros, with a node's logger and with a name.

pub fn main() -> Result<(), Box<dyn std::error::Error>> {
    let ctx = r2r::Context::create()?;
    let node = r2r::Node::create(ctx, "testnode", "")?;
    let nl = node.logger();
    r2r::log_debug!(nl, "debug msg");
    r2r::log_info!(nl, "info msg {}", 1);
    r2r::log_warn!(nl, "warn msg {:?}", "two");
    r2r::log_error!(nl, "error msg {x}", x = 3);
    r2r::log_fatal!(nl, "fatal msg {:#X}", 4);
    r2r::log_info!("other_logger", "i = {}", 5);
    r2r::log_info!(&format!("{}_{}", node.name()?, 6), "with an owned name");
    Ok(())
}
