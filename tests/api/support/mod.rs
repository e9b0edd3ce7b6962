//! What the tests share.

mod app;
mod contract;
mod fixtures;
mod raw;
mod reply;

pub use app::TestApp;
pub use contract::{Contract, OPENAPI};
pub use fixtures::*;
pub use raw::exchange;
pub use reply::Reply;
