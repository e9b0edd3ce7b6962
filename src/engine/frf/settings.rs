//! How an FRF is estimated.

use serde::{Deserialize, Serialize};

use crate::EngineError;
use crate::spectral::{Detrend, Welch};

/// The estimator of `H` from averaged spectra.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Estimator {
    /// `H = S_yx S_xx^-1` per line: right for correlated drives too.
    #[default]
    H1,
    /// `H_kl = S_kl / S_kk` (Heindel et al., section 2.1): holds for uncorrelated drives only.
    Ratio,
    /// [`Ratio`](Self::Ratio), or [`H1`](Self::H1) with a warning where the drives correlate: what the
    /// paper did with the drives that it had. The settings of an estimate name one of the two.
    Auto,
}

/// Settings of an FRF estimate. What is `None` is chosen by how well a held-out stretch is
/// predicted; the settings stored with a model have none left open.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FrfSettings {
    /// Samples per segment, a power of two.
    pub segment_len: Option<usize>,
    /// Fraction that neighbouring segments share, 0 <= overlap <= [`Welch::MAX_OVERLAP`].
    pub overlap: f64,
    /// Estimator.
    pub estimator: Estimator,
    /// Relative ridge: at every line this share of each input's in-band level (its mean spectral
    /// density over the usable band) is added to the diagonal of `S_xx`:
    /// `H = S_yx (S_xx + ridge * diag(level))^-1`. Lines with little excitation are damped, well
    /// excited ones lose about the share `ridge`.
    pub ridge: Option<f64>,
}

impl Default for FrfSettings {
    /// 75 % overlap, H1; segment and ridge by held-out prediction.
    fn default() -> Self {
        Self { segment_len: None, overlap: 0.75, estimator: Estimator::H1, ridge: None }
    }
}

impl FrfSettings {
    /// Shortest segment: fewer lines cannot show a resonance.
    pub const MIN_SEGMENT_LEN: usize = 8;

    /// Checks what does not depend on the data.
    ///
    /// # Errors
    /// [`EngineError::Setting`] with the field's name and limit.
    pub fn check(&self) -> Result<(), EngineError> {
        let refuse =
            |setting, found: String, limit: String| Err(EngineError::Setting { setting, found, limit });
        if let Some(len) = self.segment_len
            && !(len.is_power_of_two() && len >= Self::MIN_SEGMENT_LEN)
        {
            let limit = format!("a power of two, at least {}", Self::MIN_SEGMENT_LEN);
            return refuse("frf.segment_len", len.to_string(), limit);
        }
        if !(0.0..=Welch::MAX_OVERLAP).contains(&self.overlap) {
            let limit = format!("from 0 to {}", Welch::MAX_OVERLAP);
            return refuse("frf.overlap", self.overlap.to_string(), limit);
        }
        if let Some(ridge) = self.ridge
            && !(0.0..=1.0).contains(&ridge)
        {
            return refuse("frf.ridge", ridge.to_string(), "from 0 to 1".into());
        }
        Ok(())
    }

    /// Segments of one length. The mean stays: only the working point is subtracted, so that the
    /// DC line holds the static gain.
    pub(super) fn welch(&self, segment_len: usize) -> Welch {
        Welch { segment_len, overlap: self.overlap, detrend: Detrend::None }
    }
}
