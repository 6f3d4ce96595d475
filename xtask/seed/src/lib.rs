// SPDX-License-Identifier: MIT OR Apache-2.0
//! The seed of a random test.

use rand::SeedableRng;
use rand::rngs::StdRng;

/// That of `TAUT_SEED`, a number, else a fresh one; printed, for a failure to be repeated.
///
/// # Panics
/// `TAUT_SEED` is not a number of 64 bits.
pub fn seed() -> u64 {
    let told = std::env::var("TAUT_SEED").ok();
    let seed = told.map_or_else(rand::random, |told| {
        told.parse().unwrap_or_else(|error| panic!("TAUT_SEED='{told}': {error}"))
    });
    println!("TAUT_SEED={seed}");
    seed
}

/// A generator with that [`seed`].
pub fn random() -> StdRng {
    StdRng::seed_from_u64(seed())
}
