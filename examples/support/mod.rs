//! What the example needs beside its own story.

pub mod dataset;
pub mod progress;
pub mod table;
