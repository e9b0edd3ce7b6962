//! The weights of a network: blocks of memory cells and one fully connected layer.

/// One block of memory cells (Heindel et al., section 2.2.1). Gate order in the first axis of
/// every tensor is PyTorch's: input (the paper's *store*), forget, cell (*in*), output.
#[derive(Debug, Clone, PartialEq)]
pub struct LstmBlock {
    /// Channels that go in.
    pub inputs: usize,
    /// Memory cells, and channels that come out.
    pub cells: usize,
    /// `[4 * cells, inputs]`, row-major.
    pub weight_ih: Vec<f32>,
    /// `[4 * cells, cells]`, row-major.
    pub weight_hh: Vec<f32>,
    /// `[4 * cells]`, one bias a gate.
    pub bias: Vec<f32>,
}

/// Blocks in a row, then one fully connected layer without activation.
#[derive(Debug, Clone, PartialEq)]
pub struct LstmNet {
    /// At least one block; each takes the outputs of the one before.
    pub blocks: Vec<LstmBlock>,
    /// Output channels.
    pub outputs: usize,
    /// `[outputs, cells of the last block]`, row-major.
    pub fc_weight: Vec<f32>,
    /// `[outputs]`.
    pub fc_bias: Vec<f32>,
}
