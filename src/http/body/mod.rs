//! Request bodies and JSON answers: limits on size and pace, strict JSON, arrays of samples, and the pieces of
//! large answers.

mod arrays;
pub mod json;
mod limited;
pub mod pieces;
pub mod signal_pieces;
pub mod signals;
pub mod source;

pub use arrays::HoldsSignals;
pub use limited::{Limited, Pace, media_type, unsupported};
