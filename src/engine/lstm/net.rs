//! The weights of a network: blocks of memory cells and one fully connected layer.

use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use crate::EngineError;

/// One block of memory cells (Heindel et al., section 2.2.1). Gate order in the first axis of
/// every tensor is PyTorch's: input (the paper's *store*), forget, cell (*in*), output.
#[derive(Debug, Clone, PartialEq)]
pub struct LstmBlock {
    /// Input channels.
    pub inputs: usize,
    /// Memory cells, which are also the output channels.
    pub cells: usize,
    /// `[4 * cells, inputs]`, row-major.
    pub weight_ih: Vec<f32>,
    /// `[4 * cells, cells]`, row-major.
    pub weight_hh: Vec<f32>,
    /// `[4 * cells]`, one bias a gate.
    pub bias: Vec<f32>,
}

/// Blocks in series, then one fully connected layer without activation.
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

impl LstmNet {
    /// A network to start training from, initialised as in Keras: Glorot-uniform input and output
    /// weights, an orthogonal recurrent start, biases zero but `forget_bias` at the forget gates.
    ///
    /// `blocks` holds the cells of each block. The same numbers come from the same `rng` state on
    /// every machine.
    ///
    /// # Panics
    /// If a count is zero ([`LstmSettings::check`](super::LstmSettings::check) refuses that).
    pub fn init(
        inputs: usize,
        blocks: &[usize],
        outputs: usize,
        forget_bias: f64,
        rng: &mut ChaCha8Rng,
    ) -> Self {
        assert!(inputs > 0 && outputs > 0 && !blocks.is_empty() && blocks.iter().all(|&c| c > 0));
        let mut made = Vec::with_capacity(blocks.len());
        let mut from = inputs;
        for &cells in blocks {
            let mut bias = vec![0.0; 4 * cells];
            bias[cells..2 * cells].fill(forget_bias as f32);
            made.push(LstmBlock {
                inputs: from,
                cells,
                weight_ih: glorot_uniform(4 * cells, from, rng),
                weight_hh: orthogonal_columns(4 * cells, cells, rng),
                bias,
            });
            from = cells;
        }
        Self {
            blocks: made,
            outputs,
            fc_weight: glorot_uniform(outputs, from, rng),
            fc_bias: vec![0.0; outputs],
        }
    }

    /// Trainable numbers, one bias a gate (Heindel et al., section 3.5: {39} with 3 inputs and 3
    /// outputs has 6,828).
    pub fn n_parameters(&self) -> usize {
        let blocks: usize =
            self.blocks.iter().map(|b| b.weight_ih.len() + b.weight_hh.len() + b.bias.len()).sum();
        blocks + self.fc_weight.len() + self.fc_bias.len()
    }

    /// Input channels.
    pub fn inputs(&self) -> usize {
        self.blocks.first().map_or(0, |b| b.inputs)
    }

    /// Cells of each block.
    pub fn cells(&self) -> Vec<usize> {
        self.blocks.iter().map(|b| b.cells).collect()
    }

    /// Checks that the shapes fit together and that all weights are finite.
    ///
    /// # Errors
    /// [`EngineError::TensorShape`] with the tensor's name, [`EngineError::Weights`] for a network
    /// without blocks, cells, inputs or outputs and for weights that are not finite.
    pub fn check(&self) -> Result<(), EngineError> {
        let mut inputs = self.inputs();
        if inputs == 0 || self.outputs == 0 || self.blocks.iter().any(|b| b.cells == 0) {
            return Err(EngineError::Weights(
                "a network needs at least one block, and each block inputs and cells, and outputs".into(),
            ));
        }
        for (i, block) in self.blocks.iter().enumerate() {
            let gates = 4 * block.cells;
            if block.inputs != inputs {
                return Err(EngineError::TensorShape {
                    tensor: format!("lstm.{i}.weight_ih"),
                    found: vec![gates, block.inputs],
                    expected: vec![gates, inputs],
                });
            }
            tensor(&format!("lstm.{i}.weight_ih"), &block.weight_ih, &[gates, inputs])?;
            tensor(&format!("lstm.{i}.weight_hh"), &block.weight_hh, &[gates, block.cells])?;
            tensor(&format!("lstm.{i}.bias"), &block.bias, &[gates])?;
            inputs = block.cells;
        }
        tensor("fc.weight", &self.fc_weight, &[self.outputs, inputs])?;
        tensor("fc.bias", &self.fc_bias, &[self.outputs])
    }
}

/// Checks the count and finiteness of one tensor.
fn tensor(name: &str, values: &[f32], shape: &[usize]) -> Result<(), EngineError> {
    if values.len() != shape.iter().product::<usize>() {
        return Err(EngineError::TensorShape {
            tensor: name.to_owned(),
            expected: shape.to_vec(),
            found: vec![values.len()],
        });
    }
    match values.iter().position(|v| !v.is_finite()) {
        Some(at) => Err(EngineError::Weights(format!("{name} is not finite at element {at}"))),
        None => Ok(()),
    }
}

/// Uniform in +-sqrt(6 / (fan in + fan out)), `[rows, columns]`.
fn glorot_uniform(rows: usize, columns: usize, rng: &mut ChaCha8Rng) -> Vec<f32> {
    let limit = (6.0 / (rows + columns) as f64).sqrt();
    (0..rows * columns).map(|_| rng.random_range(-limit..limit) as f32).collect()
}

/// A matrix `[rows, columns]` with orthonormal columns, `rows >= columns`: Keras' orthogonal
/// initialisation of the four gates of a block together.
///
/// Gram-Schmidt, done twice, in plain `f64`. A matrix library chooses its kernels by the machine, so that
/// the same seed would give other bits elsewhere.
fn orthogonal_columns(rows: usize, columns: usize, rng: &mut ChaCha8Rng) -> Vec<f32> {
    let mut basis: Vec<Vec<f64>> = Vec::with_capacity(columns);
    while basis.len() < columns {
        let mut v: Vec<f64> = (0..rows).map(|_| StandardNormal.sample(rng)).collect();
        for _ in 0..2 {
            for b in &basis {
                let along: f64 = b.iter().zip(&v).map(|(b, v)| b * v).sum();
                v.iter_mut().zip(b).for_each(|(v, b)| *v -= along * b);
            }
        }
        let norm = v.iter().map(|v| v * v).sum::<f64>().sqrt();
        v.iter_mut().for_each(|v| *v /= norm);
        basis.push(v);
    }
    let mut out = vec![0.0; rows * columns];
    for (j, column) in basis.iter().enumerate() {
        for (i, &v) in column.iter().enumerate() {
            out[i * columns + j] = v as f32;
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;

    use super::*;

    fn net(inputs: usize, blocks: &[usize], outputs: usize) -> LstmNet {
        LstmNet::init(inputs, blocks, outputs, 1.0, &mut ChaCha8Rng::seed_from_u64(1))
    }

    #[test]
    fn parameter_counts_are_those_of_the_paper() {
        for (blocks, count) in
            [(&[10][..], 593), (&[39][..], 6_828), (&[23, 23][..], 6_880), (&[39, 39][..], 19_152)]
        {
            let net = net(3, blocks, 3);
            assert_eq!(net.n_parameters(), count);
            assert_eq!(net.check(), Ok(()));
            assert_eq!((net.inputs(), net.cells()), (3, blocks.to_vec()));
        }
    }

    #[test]
    fn a_start_is_orthogonal_bounded_and_the_same_for_the_same_seed() {
        let a = net(9, &[39], 6);
        assert_eq!(a, net(9, &[39], 6));
        assert_ne!(a, LstmNet::init(9, &[39], 6, 1.0, &mut ChaCha8Rng::seed_from_u64(2)));
        let block = &a.blocks[0];
        for j in 0..39 {
            for k in 0..39 {
                let dot: f64 = (0..156)
                    .map(|i| f64::from(block.weight_hh[i * 39 + j]) * f64::from(block.weight_hh[i * 39 + k]))
                    .sum();
                assert!((dot - f64::from(u8::from(j == k))).abs() < 1e-6, "{j} {k}: {dot}");
            }
        }
        let limit = (6.0_f32 / (156.0 + 9.0)).sqrt();
        assert!(block.weight_ih.iter().all(|w| w.abs() <= limit));
        assert!(block.weight_ih.iter().any(|w| w.abs() > 0.9 * limit));
        assert!(block.bias[39..78].iter().all(|&b| b == 1.0));
        assert!(block.bias[..39].iter().chain(&block.bias[78..]).all(|&b| b == 0.0));
    }

    #[test]
    fn wrong_shapes_and_weights_that_are_not_finite_are_refused_by_name() {
        let mut wrong = net(3, &[4, 5], 2);
        wrong.blocks[1].weight_hh.pop();
        assert_eq!(
            wrong.check(),
            Err(EngineError::TensorShape {
                tensor: "lstm.1.weight_hh".into(),
                expected: vec![20, 5],
                found: vec![99]
            })
        );
        let mut wrong = net(3, &[4, 5], 2);
        wrong.blocks[1].inputs = 3;
        assert!(
            matches!(wrong.check(), Err(EngineError::TensorShape { tensor, .. }) if tensor == "lstm.1.weight_ih")
        );
        let mut wrong = net(3, &[4], 2);
        wrong.fc_bias[1] = f32::NAN;
        assert_eq!(wrong.check(), Err(EngineError::Weights("fc.bias is not finite at element 1".into())));
        let empty = LstmNet { blocks: vec![], outputs: 1, fc_weight: vec![], fc_bias: vec![0.0] };
        assert!(matches!(empty.check(), Err(EngineError::Weights(_))));
    }
}
