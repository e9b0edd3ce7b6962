//! Effects of the catalogue fitted to free runs, scored and ranked together.

pub mod beside;
pub mod catalogue;
pub mod contest;
pub mod decide;
pub mod echo;
pub mod hosts;
pub mod naming;
pub mod pairs;
pub mod score;
