//! The command line of Tautline: demo

fn main() {}
