// SPDX-License-Identifier: MIT OR Apache-2.0
//! What must not compile, and the words with which it does not. `TRYBUILD=overwrite` renews the words.

#[test]
#[cfg_attr(miri, ignore = "runs cargo")]
fn errors_name_the_cure() {
    trybuild::TestCases::new().compile_fail("tests/ui/*.rs");
}
