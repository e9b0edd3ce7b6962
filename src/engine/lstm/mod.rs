//! Long short-term memory networks: inference, training, windows and their recombination.

mod net;
mod settings;

pub use net::{LstmBlock, LstmNet};
pub use settings::{LstmSettings, Optimizer, Recombine, RecombineChoice, Schedule};
