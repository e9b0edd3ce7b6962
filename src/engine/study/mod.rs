//! Studies: which settings, and how much data, are worth their time.
//!
//! A search draws settings from a [`Space`] and gives each the epochs of its rung ([`rungs`]); the numbers of a trial
//! depend on the seed of the study and the number of the trial alone. A learning curve fits random subsets of the data
//! ([`Pool`]) and continues their errors ([`Curve`]).

mod curve;
mod halving;
mod linear;
mod space;
mod subsets;

pub use curve::{Curve, CurvePoint, Estimate};
pub use halving::{Rung, rungs, survivors};
pub use linear::{FixedNet, NoiseFiles, mean_rms};
pub use space::{MAX_CHOICES, RangeOf, Space, TrialSettings};
pub use subsets::Pool;
