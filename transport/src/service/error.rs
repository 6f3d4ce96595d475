// SPDX-License-Identifier: MIT OR Apache-2.0
//! Why a request got no response, or a response was not sent.

use crate::error::LoanError;
use crate::service::pending::MAX_PENDING_REQUESTS;
use std::sync::Arc;
use tautline_msgs::cdr::{DecodeError, EncodeError};

/// Why a request got no response, or a response was not sent. Each variant names the service.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
#[allow(missing_docs, reason = "the names of the fields say it")]
pub enum ServiceError {
    /// The service has no server. Nothing was sent.
    #[error("service '{service}' has no server: start one, or wait for one with `wait_for_service`")]
    NoServer { service: Arc<str> },
    /// Every server that got the request has ended or was killed without a response; or the request was relayed to another
    /// host, and no server there responded.
    #[error("service '{service}': its server ended without a response; request again when there is a server")]
    ServerGone { service: Arc<str> },
    /// The queue of a server for this client's requests is full. Nothing was sent.
    #[error(
        "service '{service}': a server's queue of this client's requests is full; wait for a response, or give the server a deeper queue"
    )]
    RequestsFull { service: Arc<str> },
    /// The client's queue of responses is full. Nothing was sent.
    #[error("service '{service}': the client takes no responses, and its queue of responses is full")]
    ResponsesFull { service: Arc<str> },
    /// The client has its maximum number of pending requests. Nothing was sent.
    #[error(
        "service '{service}': {MAX_PENDING_REQUESTS} requests of this client wait already; await or drop one, or make a second client"
    )]
    TooManyPending { service: Arc<str> },
    /// The client has ended.
    #[error("service '{service}': the requesting client has ended")]
    ClientGone { service: Arc<str> },
    /// The client exists and waits, but its subscription to responses cannot be reached: its process's log
    /// has the reason.
    #[error(
        "service '{service}': the client that asked cannot be reached, and waits; is /dev/shm full, or its process stopped or at its limit of open files (ulimit -n)?"
    )]
    ClientUnreachable { service: Arc<str> },
    /// No memory could be loaned.
    #[error("service '{service}': {source}")]
    Loan { service: Arc<str>, source: LoanError },
    /// The message cannot be written: a string or sequence is longer than its bound.
    #[error("service '{service}': {source}")]
    Encode { service: Arc<str>, source: Box<EncodeError> },
    /// The response is not valid for the service's type.
    #[error("service '{service}': the response is not valid: {source}")]
    Invalid { service: Arc<str>, source: Box<DecodeError> },
}
