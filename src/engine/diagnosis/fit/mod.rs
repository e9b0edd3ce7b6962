//! From a candidate to its best free run.

pub mod fitting;
pub mod jacobian;
pub mod predict;
mod sensitivities;
pub mod start;
pub mod twins;
