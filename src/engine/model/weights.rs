//! Models as safetensors files (names and shapes: README, "Weights").

use super::RigModel;
use crate::engine::EngineError;

/// Serialises a model; the same model always gives the same bytes.
pub fn to_safetensors(_model: &RigModel) -> Vec<u8> {
    todo!()
}

/// Reads a model, ours or made elsewhere with PyTorch's tensor names.
///
/// # Errors
/// [`EngineError::Weights`] and [`EngineError::TensorShape`] for anything that does not fit.
pub fn from_safetensors(_bytes: &[u8]) -> Result<RigModel, EngineError> {
    todo!()
}
