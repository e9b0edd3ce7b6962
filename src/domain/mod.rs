//! The service's nouns and their legal moves: rigs, runs, fits, jobs, models.

pub mod fits;
