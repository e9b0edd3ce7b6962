//! The `rigcast` program.

fn main() {}
