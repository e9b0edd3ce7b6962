//! Where something acts, in the words of the contract.

use serde_json::{Value, json};

/// A channel, or two channels between which it lies.
#[derive(Debug, Clone, PartialEq)]
pub enum Place {
    At(String),
    Between(String, String),
}

impl Place {
    /// As a verdict has it: `at` or `between`.
    pub fn label(&self) -> Value {
        match self {
            Self::At(channel) => json!({"at": channel}),
            Self::Between(a, b) => json!({"between": [a, b]}),
        }
    }
}
