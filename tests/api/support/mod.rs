//! Helpers of the tests.

mod app;
mod contract;
mod fixtures;
mod further;
mod postgres;
mod program;
mod raw;
mod reply;
mod setting;
mod storage;
mod vectors;
mod weather;

pub use app::TestApp;
pub use contract::{Contract, OPENAPI};
pub use fixtures::*;
pub use further::further;
pub use postgres::Postgres;
pub use program::{Program, lives, refused_start, rigcast, signal, try_signal};
pub use raw::{exchange, read_all};
pub use reply::{Call, Reply};
pub use setting::setting;
pub use storage::Storage;
pub use vectors::{columns, vector_file, vector_rig};
pub use weather::{Way, Weather};
