//! The field `fallback` of a prediction.

use serde::Deserialize;

use crate::engine::model::RigModel;
use crate::http::codes;
use crate::http::problem::{Answer, FieldError, Problem};

/// What answers where the drive is outside what the model was fitted on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FallbackTo {
    /// The model itself.
    #[default]
    None,
    /// Its FRF.
    Frf,
}

impl FallbackTo {
    /// Whether the FRF of `model` answers; `pointer` is the field's place in the request.
    ///
    /// # Errors
    /// `predict.no_fallback` for a model without an FRF.
    pub fn is_frf_of(self, model: &RigModel, pointer: &str) -> Answer<bool> {
        if self == Self::Frf && model.frf.is_none() {
            let detail =
                format!("A model of kind {} has no FRF to fall back to.", model.version_kind().as_str());
            let place = FieldError::new(pointer, "none, or a model with an FRF");
            return Err(Problem::new(codes::PREDICT_NO_FALLBACK, detail).with(place));
        }
        Ok(self == Self::Frf)
    }
}
