//! Whole diagnoses of small rigs, integrated by another method than the diagnosis uses.

mod bad_input;
mod leaks;
pub(in crate::engine) mod rig;
mod verdicts;
