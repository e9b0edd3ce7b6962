//! How an FRF is estimated.

use serde::{Deserialize, Serialize};

/// The estimator of `H` from averaged spectra.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Estimator {
    /// `H = S_yx S_xx^-1` per line: right for correlated drives too.
    #[default]
    H1,
    /// `H_kl = S_kl / S_kk` (Heindel et al., section 2.1): holds for uncorrelated drives only.
    Ratio,
}

/// Settings of an FRF estimate. What is `None` is chosen by how well a held-out stretch is
/// predicted; the settings stored with a model have none left open.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FrfSettings {
    /// Samples per segment, a power of two.
    pub segment_len: Option<usize>,
    /// Fraction that neighbouring segments share, 0 <= overlap < 1.
    pub overlap: f64,
    /// Estimator.
    pub estimator: Estimator,
    /// Relative ridge: this share of the mean eigenvalue of `S_xx` is added to its diagonal.
    pub ridge: Option<f64>,
}

impl Default for FrfSettings {
    /// 75 % overlap, H1; segment and ridge by held-out prediction.
    fn default() -> Self {
        Self { segment_len: None, overlap: 0.75, estimator: Estimator::H1, ridge: None }
    }
}
