// SPDX-License-Identifier: MIT OR Apache-2.0
//! r2r's `logging.rs`.

use tautline as r2r;

/// As `node.logger()` is handed to functions.
fn helper(logger: &str) {
    r2r::log_info!(logger, "from a function");
}

#[test]
fn every_severity_and_any_name() -> Result<(), Box<dyn std::error::Error>> {
    r2r::log_debug!("before_init", "debug msg");
    let ctx = super::context(165, "--ros-args --log-level DEBUG --disable-rosout-logs");
    let node = r2r::Node::create(ctx, "logger_node", "")?;
    let nl = node.logger();
    for i in 0..5 {
        match i % 5 {
            0 => r2r::log_debug!(nl, "debug msg: {}", i as f64 / 2.5),
            1 => r2r::log_info!(nl, "info msg {}", i % 2),
            2 => r2r::log_warn!(nl, "warn msg {:?}", i.to_string()),
            3 => r2r::log_error!(nl, "error msg {:?}", i.to_string().as_bytes()),
            _ => r2r::log_fatal!(nl, "fatal msg {:#X}", i),
        }
        r2r::log_debug!("other_logger", "i = {}", i);
    }
    r2r::log_info!(node.logger(), "no arguments");
    let owned: String = node.logger().to_string();
    r2r::log_info!(&owned, "with an owned name");
    helper(nl);
    Ok(())
}
