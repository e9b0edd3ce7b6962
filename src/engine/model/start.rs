//! The start of training: by default a hybrid begins as its FRF, not at random; a fit that goes on from a
//! model begins as that model's network.
//!
//! The paper starts at random ([`HybridStart::Random`]). It says (section 2.3) that hybrid 2 "can now
//! simply be a copy of the FRF prediction or a modification by the LSTM". Starting from that copy, a fit on few or nearly linear data can
//! only leave it for something that is better on validation data.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::{LstmPart, ModelKind, Scaler};
use crate::lstm::{HybridStart, LstmNet, LstmSettings};

/// Size of the copied signal inside the cells, in standard deviations: `tanh` bends three of them
/// by less than 1 % twice.
const COPY_SCALE: f64 = 0.05;

/// Pre-activation of open gates; the logistic function is 0.982 there.
const OPEN: f32 = 4.0;

/// Pre-activation of a forget gate that lets 0.25 % of the last value through.
const SHUT: f32 = -6.0;

/// The network that training of one seed starts from.
pub(super) fn start(kind: ModelKind, x: &Scaler, y: &Scaler, settings: &LstmSettings, seed: u64) -> LstmNet {
    let (inputs, outputs) = (x.mean.len(), y.mean.len());
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut net = LstmNet::init(inputs, &settings.blocks, outputs, settings.forget_bias, &mut rng);
    if settings.hybrid_start == HybridStart::Random {
        return net;
    }
    match kind {
        ModelKind::Frf | ModelKind::Lstm => {}
        // FRF(x) + 0.
        ModelKind::Hybrid1 => {
            net.fc_weight.fill(0.0);
            for (bias, (mean, std)) in net.fc_bias.iter_mut().zip(y.mean.iter().zip(&y.std)) {
                *bias = (-mean / std) as f32;
            }
        }
        ModelKind::Hybrid2 => copy_linear(&mut net, x, y),
    }
    net
}

/// Makes the first cells of each block a pass-through of the FRF's channels, which are the last inputs,
/// and lets the fully connected layer read nothing else. Networks with fewer cells
/// than outputs stay as they are.
fn copy_linear(net: &mut LstmNet, x: &Scaler, y: &Scaler) {
    let outputs = net.outputs;
    if net.blocks.iter().any(|b| b.cells < outputs) {
        return;
    }
    let first_linear = x.mean.len() - outputs;
    let open = 1.0 / (1.0 + f64::exp(-f64::from(OPEN)));
    let mut scale = 1.0;
    for (b, block) in net.blocks.iter_mut().enumerate() {
        let gain = if b == 0 { COPY_SCALE } else { 1.0 };
        for cell in 0..outputs {
            let source = if b == 0 { first_linear + cell } else { cell };
            for (gate, bias) in [(0, OPEN), (1, SHUT), (2, 0.0), (3, OPEN)] {
                let row = gate * block.cells + cell;
                block.weight_ih[row * block.inputs..(row + 1) * block.inputs].fill(0.0);
                block.weight_hh[row * block.cells..(row + 1) * block.cells].fill(0.0);
                block.bias[row] = bias;
            }
            block.weight_ih[(2 * block.cells + cell) * block.inputs + source] = gain as f32;
        }
        scale *= gain * open * open;
    }
    let cells = net.blocks[net.blocks.len() - 1].cells;
    net.fc_weight.fill(0.0);
    for output in 0..outputs {
        let linear = first_linear + output;
        net.fc_weight[output * cells + output] = (x.std[linear] / y.std[output] / scale) as f32;
        net.fc_bias[output] = ((x.mean[linear] - y.mean[output]) / y.std[output]) as f32;
    }
}

/// A model's network between other scalers: for the same inputs, in their units, it has the same outputs but
/// for rounding.
///
/// With z = (v - mean) / std on both sides, the first block's input weights become `w * std_new / std_old`, its
/// bias takes the shift of the means, and the fully connected layer is scaled back.
pub(super) fn continued(part: &LstmPart, x: &Scaler, y: &Scaler) -> LstmNet {
    let mut net = part.net.clone();
    let first = &mut net.blocks[0];
    for (row, bias) in first.bias.iter_mut().enumerate() {
        let weights = &mut first.weight_ih[row * first.inputs..(row + 1) * first.inputs];
        let mut shifted = f64::from(*bias);
        for (channel, weight) in weights.iter_mut().enumerate() {
            let old = f64::from(*weight) / part.x.std[channel];
            shifted += old * (x.mean[channel] - part.x.mean[channel]);
            *weight = (old * x.std[channel]) as f32;
        }
        *bias = shifted as f32;
    }
    let cells = net.blocks[net.blocks.len() - 1].cells;
    for output in 0..net.outputs {
        let scale = part.y.std[output] / y.std[output];
        for weight in &mut net.fc_weight[output * cells..(output + 1) * cells] {
            *weight = (f64::from(*weight) * scale) as f32;
        }
        let shift = (part.y.mean[output] - y.mean[output]) / y.std[output];
        net.fc_bias[output] = (f64::from(net.fc_bias[output]) * scale + shift) as f32;
    }
    net
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lstm::{Recombine, predict};
    use crate::model::{LstmOptions, Preset, Task};

    fn settings(blocks: Vec<usize>, kind: ModelKind) -> LstmSettings {
        let options = LstmOptions { blocks: Some(blocks), ..LstmOptions::default() };
        options.resolve(Preset::Default, kind, Task::Forward, &[1000]).unwrap()
    }

    fn wave(n: usize, f: f64) -> Vec<f64> {
        (0..n).map(|t| (t as f64 * f).sin() * 1.4).collect()
    }

    #[test]
    fn hybrid_2_starts_as_a_copy_of_its_frf() {
        let x = Scaler { mean: vec![0.0, 3.0, -1.0], std: vec![1.0, 2.0, 0.5] };
        let y = Scaler { mean: vec![2.5, -1.2], std: vec![2.2, 0.4] };
        for blocks in [vec![8], vec![8, 8]] {
            let net = start(ModelKind::Hybrid2, &x, &y, &settings(blocks, ModelKind::Hybrid2), 1);
            let z: Vec<Vec<f32>> = [0.9, 0.05, 0.02]
                .iter()
                .map(|f| wave(600, *f).into_iter().map(|v| v as f32).collect())
                .collect();
            let out = predict(&net, &z, 64, 32, Recombine::Stream).unwrap();
            for output in 0..2 {
                let got = y.restore(output, &out[output]);
                let linear = x.restore(1 + output, &z[1 + output]);
                let std = x.std[1 + output];
                let error = got.iter().zip(&linear).map(|(a, b)| (a - b).powi(2)).sum::<f64>() / 600.0;
                assert!(error.sqrt() < 0.015 * std, "output {output}: {}", error.sqrt() / std);
            }
        }
    }

    #[test]
    fn a_network_between_other_scalers_predicts_the_same_in_the_channels_units() {
        let old = |mean: [f64; 2], std: [f64; 2]| Scaler { mean: mean.to_vec(), std: std.to_vec() };
        let (x_old, y_old) = (old([0.5, -3.0], [2.0, 0.3]), old([10.0, 0.0], [4.0, 0.01]));
        let (x, y) = (old([-0.2, -2.0], [1.1, 0.9]), old([7.0, 0.02], [9.0, 0.02]));
        let blocks = settings(vec![6, 5], ModelKind::Lstm);
        let net = LstmNet::init(2, &blocks.blocks, 2, 1.0, &mut ChaCha8Rng::seed_from_u64(3));
        let part = LstmPart {
            net: net.clone(),
            x: x_old.clone(),
            y: y_old.clone(),
            window_len: 64,
            hop: 32,
            recombine: Recombine::Stream,
        };
        let signals = [wave(400, 0.11), wave(400, 0.31).into_iter().map(|v| v * 0.4 - 2.5).collect()];
        let run = |net: &LstmNet, x: &Scaler, y: &Scaler| -> Vec<Vec<f64>> {
            let z: Vec<Vec<f32>> = signals.iter().enumerate().map(|(c, s)| x.standardise(c, s)).collect();
            let out = predict(net, &z, 64, 32, Recombine::Stream).unwrap();
            out.iter().enumerate().map(|(c, z)| y.restore(c, z)).collect()
        };
        let (before, after) = (run(&net, &x_old, &y_old), run(&continued(&part, &x, &y), &x, &y));
        for output in 0..2 {
            let size = y_old.std[output];
            for (a, b) in before[output].iter().zip(&after[output]) {
                assert!((a - b).abs() < 1e-4 * size, "{a} {b}");
            }
        }
        assert_ne!(continued(&part, &x, &y), net, "the scalers differ");
        assert_eq!(continued(&part, &x_old, &y_old).fc_weight, net.fc_weight);
    }

    #[test]
    fn hybrid_1_starts_as_no_correction_at_all() {
        let x = Scaler { mean: vec![0.0], std: vec![1.0] };
        let y = Scaler { mean: vec![0.3], std: vec![0.2] };
        let net = start(ModelKind::Hybrid1, &x, &y, &settings(vec![5], ModelKind::Hybrid1), 1);
        let z = vec![wave(300, 0.3).into_iter().map(|v| v as f32).collect()];
        let out = predict(&net, &z, 64, 32, Recombine::Welch).unwrap();
        assert!(y.restore(0, &out[0]).iter().all(|v| v.abs() < 1e-6));
    }

    #[test]
    fn a_hybrid_of_the_paper_starts_at_random_like_a_network_without_an_frf() {
        let x = Scaler { mean: vec![0.0, 3.0], std: vec![1.0, 2.0] };
        let y = Scaler { mean: vec![2.5], std: vec![2.2] };
        for kind in [ModelKind::Hybrid1, ModelKind::Hybrid2] {
            let paper = LstmOptions::default().resolve(Preset::Paper, kind, Task::Forward, &[1000]).unwrap();
            let random = start(ModelKind::Lstm, &x, &y, &paper, 1);
            assert_eq!(start(kind, &x, &y, &paper, 1), random);
            assert_ne!(start(kind, &x, &y, &paper, 2), random);
            let copy = LstmSettings { hybrid_start: HybridStart::Copy, ..paper };
            assert_ne!(start(kind, &x, &y, &copy, 1), random);
        }
    }
}
