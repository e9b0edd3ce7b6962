//! Effects of the catalogue fitted to free runs, scored and ranked together.

pub mod catalogue;
pub mod contest;
pub mod decide;
pub mod naming;
pub mod pairs;
pub mod placement;
pub mod propagation;
pub mod score;
pub mod with_linear_change;
