//! Where model and rig disagree, which unmodelled effect causes it, and how far simulating that
//! effect closes the gap.

mod ar;
mod core;
mod linear;
mod modes;
mod rows;

pub use self::core::Core;
pub use ar::Ar;
pub use modes::{Modes, Pole};
