//! How much a test does, which longer checks set by the environment.

use std::fmt::Debug;
use std::str::FromStr;

/// The number that the environment sets for a test, or its own.
pub fn setting<T: FromStr<Err: Debug>>(name: &str, default: T) -> T {
    std::env::var(name).map_or(default, |value| value.parse().expect("a number"))
}
