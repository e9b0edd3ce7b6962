//! Rigcast: FRF, LSTM and hybrid models of fatigue test rigs behind an HTTP contract.
//!
//! Dependencies point one way: `engine <- domain <- formats, storage <- compute, models <- jobs
//! <- http <- app`. `tests/layout.rs` reads the imports and holds it.

pub mod compute;
pub mod domain;
pub mod engine;
pub mod jobs;
pub mod models;
pub mod storage;
