//! What the example needs beside its own story.

#[expect(dead_code, reason = "the blind check cuts runs out of a file")]
pub mod dataset;
pub mod progress;
pub mod table;
