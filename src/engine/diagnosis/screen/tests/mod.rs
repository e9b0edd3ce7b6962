//! The screen on simulated and measured systems.

mod arguments;
mod forward;
mod groups;
mod laws;
mod measured;
pub mod systems;
