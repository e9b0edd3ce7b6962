//! Request bodies and JSON answers: limits on size and pace, strict JSON, arrays of samples.

mod arrays;
pub mod json;
mod limited;
pub mod signals;

pub use arrays::HoldsSignals;
pub use limited::{Limited, Pace, media_type, unsupported};
