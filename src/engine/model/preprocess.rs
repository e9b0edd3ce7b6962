//! The filter stored with a model: the same for fit and prediction.

use serde::{Deserialize, Serialize};

/// Zero-phase filters over a whole signal, by FFT. Both may be set.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Preprocess {
    /// Everything above is removed (the paper's 80 Hz).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub low_pass_hz: Option<f64>,
    /// Everything outside is removed, the mean too.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub band_pass_hz: Option<[f64; 2]>,
}
