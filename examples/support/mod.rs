//! Helpers of the example.

pub mod dataset;
pub mod progress;
pub mod table;
