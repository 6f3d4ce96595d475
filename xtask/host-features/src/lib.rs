// SPDX-License-Identifier: MIT OR Apache-2.0
//! Empty: what counts are the features in its manifest.
