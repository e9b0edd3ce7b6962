//! Rigcast: FRF, LSTM and hybrid models of fatigue test rigs behind an HTTP contract.
//!
//! Dependencies point one way: `engine <- domain <- formats, storage, ui <- compute, models <- jobs
//! <- http <- app`. `tests/layout.rs` reads the imports and holds it.

pub mod app;
pub mod client;
pub mod compute;
pub mod config;
pub mod demo;
pub mod domain;
pub mod engine;
pub mod formats;
pub mod http;
pub mod jobs;
pub mod models;
pub mod storage;
pub mod telemetry;
pub mod token;
pub mod ui;
