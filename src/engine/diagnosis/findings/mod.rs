//! What follows from the ranked effects: hypotheses, closure on unseen runs, numbers, a second effect, the next run.

pub mod fingerprint;
pub mod further;
pub mod held_out;
pub mod hypothesis;
pub mod next;
pub mod parameters;
pub mod refit;
pub mod second;
pub mod whereabouts;
