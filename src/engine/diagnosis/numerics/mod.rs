//! What the steps of a diagnosis compute with.

pub mod ar;
pub mod hann;
pub mod levmar;
pub mod linear;
pub mod rows;
pub mod smooth;
pub mod spline;
