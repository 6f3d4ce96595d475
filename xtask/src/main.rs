//! What CI runs and what people run: test, bench, stress

fn main() {}
