// SPDX-License-Identifier: MIT OR Apache-2.0
//! A gateway that only its user reaches: it listens on a Unix socket.

mod support;

use std::os::unix::fs::PermissionsExt;
use support::{Host, connect, string_type, until};
use tautline_transport::Qos;

#[test]
fn a_unix_socket_is_its_users_only_and_carries_messages() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("gateway");
    let endpoint = format!("unixsock-stream/{}", path.display());
    let a = Host::new(85, 85, |options| options.network.listen = vec![endpoint.clone()]);
    let metadata = std::fs::metadata(&path).unwrap();
    assert_eq!(metadata.permissions().mode() & 0o777, 0o600);
    assert!(!a.gateway().is_reachable(), "{:?}", a.gateway().locators());
    let b = Host::new(86, 85, |options| options.network.connect = vec![endpoint]);
    let publisher = a.publisher("/chatter", &string_type(), Qos::keep_last(10));
    let subscription = b.subscription("/chatter", &string_type(), Qos::keep_last(10));
    connect(&publisher, &[&subscription], b"probe");
    drop(a);
    until("the socket's end", || !path.exists());
}
