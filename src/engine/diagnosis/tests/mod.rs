//! Whole diagnoses of small rigs, integrated by another method than the diagnosis uses.

mod again;
mod axes;
mod bad_input;
mod bench;
mod leaks;
pub(crate) mod many;
mod measured;
pub(crate) mod recorded;
mod repeats;
pub(crate) mod rig;
mod together;
mod transfer;
mod verdicts;
mod views;
