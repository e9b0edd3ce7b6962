//! The trainable numbers in one row, in the order that kernels and optimisers use.
//!
//! A block's weights are `[cell][gate][column]` with the columns inputs, bias, hidden, so that a
//! step's vector `[x(t), 1, h(t-1)]` gives all gates in one product; the fully connected layer's
//! are `[output][column]` with the columns bias, hidden: the end of the next step's vector.

use super::net::{LstmBlock, LstmNet};

/// Gates of a cell.
pub(super) const GATES: usize = 4;

/// Sizes of one block and where its weights begin.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct BlockShape {
    /// Input channels.
    pub inputs: usize,
    /// Memory cells.
    pub cells: usize,
    /// Index of its first weight in the row.
    pub at: usize,
}

impl BlockShape {
    /// Length of the step vector `[x, 1, h]`.
    pub(super) fn columns(self) -> usize {
        self.inputs + 1 + self.cells
    }

    /// Number of cells, padded to whole groups of any blocking, so that kernels have no remainder. Padding
    /// cells have weights, states and outputs of zero.
    pub(super) fn padded_cells(self) -> usize {
        self.cells.next_multiple_of(GATES)
    }

    /// Room for a step vector with padded cells.
    pub(super) fn stride(self) -> usize {
        self.inputs + 1 + self.padded_cells()
    }

    /// Gate rows.
    pub(super) fn rows(self) -> usize {
        GATES * self.cells
    }

    /// One past its last weight in the row.
    pub(super) fn end(self) -> usize {
        self.at + self.rows() * self.columns()
    }
}

/// Sizes of a network.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Shape {
    /// Blocks, first to last.
    pub blocks: Vec<BlockShape>,
    /// Output channels.
    pub outputs: usize,
}

impl Shape {
    /// The shape of a network with `inputs`, the cells of each block, and `outputs`.
    pub(super) fn new(inputs: usize, cells: &[usize], outputs: usize) -> Self {
        let (mut from, mut at) = (inputs, 0);
        let mut blocks = Vec::with_capacity(cells.len());
        for &cells in cells {
            let block = BlockShape { inputs: from, cells, at };
            (from, at) = (cells, block.end());
            blocks.push(block);
        }
        Self { blocks, outputs }
    }

    /// The shape of `net`.
    pub(super) fn of(net: &LstmNet) -> Self {
        Self::new(net.inputs(), &net.cells(), net.outputs)
    }

    /// The last block.
    pub(super) fn last(&self) -> BlockShape {
        *self.blocks.last().expect("a network has at least one block")
    }

    /// Index of the fully connected layer's first weight.
    pub(super) fn fc_at(&self) -> usize {
        self.last().end()
    }

    /// Columns of the fully connected layer, bias first.
    pub(super) fn fc_columns(&self) -> usize {
        1 + self.last().cells
    }

    /// Trainable numbers.
    pub(super) fn len(&self) -> usize {
        self.fc_at() + self.outputs * self.fc_columns()
    }
}

/// The weights of `net` in one row.
pub(super) fn flatten(net: &LstmNet) -> Vec<f32> {
    let shape = Shape::of(net);
    let mut row = Vec::with_capacity(shape.len());
    for block in &net.blocks {
        for cell in 0..block.cells {
            for gate in 0..GATES {
                let r = gate * block.cells + cell;
                row.extend_from_slice(&block.weight_ih[r * block.inputs..][..block.inputs]);
                row.push(block.bias[r]);
                row.extend_from_slice(&block.weight_hh[r * block.cells..][..block.cells]);
            }
        }
    }
    let cells = shape.last().cells;
    for output in 0..net.outputs {
        row.push(net.fc_bias[output]);
        row.extend_from_slice(&net.fc_weight[output * cells..][..cells]);
    }
    row
}

/// The network of a row of weights.
pub(super) fn unflatten(shape: &Shape, row: &[f32]) -> LstmNet {
    assert_eq!(row.len(), shape.len(), "the row belongs to the shape");
    let blocks = shape
        .blocks
        .iter()
        .map(|b| {
            let mut block = LstmBlock {
                inputs: b.inputs,
                cells: b.cells,
                weight_ih: vec![0.0; b.rows() * b.inputs],
                weight_hh: vec![0.0; b.rows() * b.cells],
                bias: vec![0.0; b.rows()],
            };
            for (i, weights) in row[b.at..b.end()].chunks_exact(b.columns()).enumerate() {
                let r = i % GATES * b.cells + i / GATES;
                block.weight_ih[r * b.inputs..][..b.inputs].copy_from_slice(&weights[..b.inputs]);
                block.bias[r] = weights[b.inputs];
                block.weight_hh[r * b.cells..][..b.cells].copy_from_slice(&weights[b.inputs + 1..]);
            }
            block
        })
        .collect();
    let (mut fc_weight, mut fc_bias) = (Vec::new(), Vec::new());
    for weights in row[shape.fc_at()..].chunks_exact(shape.fc_columns()) {
        fc_bias.push(weights[0]);
        fc_weight.extend_from_slice(&weights[1..]);
    }
    LstmNet { blocks, outputs: shape.outputs, fc_weight, fc_bias }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use super::*;

    #[test]
    fn a_network_survives_the_way_into_a_row_and_back() {
        let mut net = LstmNet::init(3, &[4, 5], 2, 1.0, &mut ChaCha8Rng::seed_from_u64(3));
        net.fc_bias = vec![0.25, -0.5];
        net.blocks[1].bias[7] = 9.0;
        let row = flatten(&net);
        assert_eq!(row.len(), net.n_parameters());
        assert_eq!(unflatten(&Shape::of(&net), &row), net);
        // Cell 2, forget gate of block 0: its bias comes after three inputs.
        let columns = 3 + 1 + 4;
        assert_eq!(row[(2 * 4 + 1) * columns + 3], net.blocks[0].bias[4 + 2]);
    }
}
