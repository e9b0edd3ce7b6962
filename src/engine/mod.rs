//! Pure numerics: arrays in, values out. No async, SQL, HTTP, clock or global randomness.
//!
//! Arrays are `[channel, sample]`; spectra and damage are `f64`, the LSTM is `f32`.

// For the test rig, which the service's tests take in too.
#[cfg(test)]
extern crate self as rigcast_engine;

pub mod checkpoint;
pub mod diagnosis;
pub mod envelope;
pub mod error;
pub mod evaluation;
pub mod fatigue;
pub mod frf;
pub mod iteration;
pub mod lstm;
#[cfg(test)]
pub(crate) mod measured;
pub mod metrics;
pub mod model;
pub mod progress;
pub mod quality;
pub mod quantity;
pub mod resample;
mod rounding;
pub mod run_kind;
pub mod samples;
pub mod signal;
pub mod simd;
pub mod spectral;
pub mod study;
pub mod virtual_rig;
pub mod windowing;
pub mod wording;

pub use error::EngineError;
pub use progress::{Loss, Progress, Watch};
pub use quantity::Quantity;
pub use rounding::rounded;
pub use run_kind::{RunKind, Split};
pub use samples::Samples;
pub use signal::{Signal, first_not_finite};
