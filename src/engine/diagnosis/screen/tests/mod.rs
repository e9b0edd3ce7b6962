//! The screen on simulated and measured systems.

mod groups;
mod laws;
mod measured;
mod systems;
