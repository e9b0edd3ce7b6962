//! The shares that an answer's headers tell.

use super::Begun;

/// The shares of samples inside and of the FRF that an answer's headers tell.
#[derive(Debug, Clone, Copy)]
pub(super) struct Shares {
    pub inside: f64,
    pub fallback: Option<f64>,
}

impl Shares {
    pub(super) fn of(begun: &Begun) -> Self {
        let fallback = begun.fallback.as_ref().map(|used| used.fallback_share);
        Self { inside: begun.trust.inside, fallback }
    }

    /// The worst of two drives of a batch.
    pub(super) fn or_worse(self, other: Self) -> Self {
        let fallback = self.fallback.zip(other.fallback).map(|(a, b)| a.max(b));
        Self { inside: self.inside.min(other.inside), fallback }
    }
}
