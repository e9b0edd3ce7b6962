//! Rigcast: FRF, LSTM and hybrid models of fatigue test rigs behind an HTTP contract.
//!
//! Dependencies point one way: `engine <- domain <- formats, storage, ui <- compute, models <- jobs
//! <- http <- config <- app <- demo`. `tests/layout.rs` reads the imports and holds it.

pub mod app;
pub mod client;
pub mod compute;
pub mod config;
pub mod demo;
pub mod domain;
pub mod formats;
pub mod health;
pub mod http;
pub mod jobs;
pub mod models;
pub mod program;
pub mod storage;
pub mod telemetry;
pub mod token;
pub mod ui;

pub use rigcast_engine as engine;

#[cfg(test)]
#[path = "engine/measured.rs"]
mod measured;

/// Version of the program: the package's and, in optimised builds, the commit that it was built from, as
/// `0.1.0+f8d4022c1a2b` (`-dirty` if the sources differ from the commit). Builds for tests say `+debug`.
pub const VERSION: &str = env!("RIGCAST_VERSION");
