//! Where model and rig disagree, which unmodelled effect causes it, and how far simulating that
//! effect closes the gap.
//!
//! A linear core of each response is fitted to low-level runs; repeats split what the sim leaves
//! into noise and systematic error; every effect of the catalogue is fitted to **free runs** of one
//! forward kernel, which never see a measured response, and is judged by the share of the gap that
//! it leaves on runs it was not fitted to. Errors count in noise floors inside the band in which the
//! core was identified: `chi2 = 1` means that nothing is left.
//!
//! The rooms, from the bottom up; each names those below it only (`tests/layout.rs`):
//!
//! - `numerics`: least squares, noise models, splines, errors counted in noise floors.
//! - `core`: the linear core of a response.
//! - `effects`: the catalogue's names, their laws and maps, and a core with them as a free run.
//! - `data`: a request's runs, prepared: one problem a response, its noise, and where the gap lies.
//! - `fit`: from a candidate to its best free run.
//! - `search`: every effect of the catalogue fitted, scored and ranked, where repeats tell the noise or the model is
//!   from before the change.
//! - `screen`: every law beside a linear part of its own, judged by runs that it was not fitted to.
//! - `augmented`: the sim with an effect in it.
//! - `transfer`: from the screen to a verdict, where the model was fitted on the rig or nothing tells the noise.
//! - `findings`: hypotheses, closure on unseen runs, numbers in the rig's units, a second effect, the next experiment.
//! - `views`: what the report's page draws.
//!
//! [`diagnose`] goes through them.
//!
//! Lengths and velocities inside the laws are in units of the response's own RMS, time in units of
//! the whole programme, frequencies of bands in cycles a sample.

mod augmented;
mod core;
mod data;
mod diagnose;
mod effects;
mod findings;
mod fit;
mod input;
mod numerics;
mod report;
pub mod screen;
mod search;
#[cfg(test)]
pub(crate) mod tests;
mod transfer;
mod verdict;
pub mod views;

pub use augmented::Augmented;
pub(crate) use augmented::sum;
pub use diagnose::{Diagnosis, diagnose};
pub use effects::effect::{Effect, Family};
pub use input::{Channel, Input, Mode, Role, Run};
pub use report::*;
pub use transfer::{Alternative, FEATURES, NAMED, Ranked, Refits, Weights, alternatives, ranked, refits};
pub use views::Views;
