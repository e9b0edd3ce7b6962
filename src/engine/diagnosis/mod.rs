//! Where model and rig disagree, which unmodelled effect causes it, and how far simulating that
//! effect closes the gap.
//!
//! A linear core of each response is fitted to low-level runs; repeats split what the sim leaves
//! into noise and systematic error; every effect of the catalogue is fitted to **free runs** of one
//! forward kernel, which never see a measured response, and is judged by the share of the gap that
//! it leaves on runs it was not fitted to. Errors count in noise floors inside the band in which the
//! core was identified: `chi2 = 1` means that nothing is left.
//!
//! Lengths and velocities inside the laws are in units of the response's own RMS, time in units of
//! the whole programme, frequencies of bands in cycles a sample.

mod adopted;
mod ar;
mod augmented;
mod beside;
mod candidate;
mod catalogue;
mod contest;
mod core;
mod decide;
mod diagnose;
mod disturbance;
mod echo;
mod effect;
mod fingerprint;
mod fitting;
mod held_out;
mod hosts;
mod hypothesis;
mod input;
mod input_map;
mod kernel;
mod law;
mod levmar;
mod linear;
mod locate;
mod modes;
mod naming;
mod next;
mod noise;
mod output_map;
mod overview;
mod pairs;
mod parameters;
mod prepare;
mod problem;
mod report;
mod rows;
mod score;
pub mod screen;
mod second;
mod seldom;
mod spline;
mod split;
mod start;
mod tangent;
#[cfg(test)]
pub(crate) mod tests;
mod tolerance;
mod transfer;
mod twins;
mod verdict;
pub mod views;
mod whereabouts;

pub use augmented::Augmented;
pub use diagnose::{Diagnosis, diagnose};
pub use effect::{Effect, Family};
pub use input::{Channel, Input, Mode, Role, Run};
pub use report::*;
pub use transfer::{Alternative, FEATURES, NAMED, Ranked, Weights, alternatives, ranked};
pub use views::Views;
