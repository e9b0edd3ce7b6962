//! The kernels against vectors that PyTorch made (`scripts/torch_vectors.py` and
//! `scripts/export_torch.py`, committed under `tests/vectors`).

use safetensors::{Dtype, SafeTensors};

use super::bptt::{Backprop, Group, TrainWeights};
use super::forward::{Packed, State};
use super::net::{LstmBlock, LstmNet};
use super::params::{Shape, flatten};
use super::predict::{predict_on, run_windows};
use super::samples::{distance, std_of};
use super::settings::Recombine;
use crate::progress::unwatched;
use crate::simd::Isa;
use crate::simd::{LANES, dispatch};

/// Tolerance relative to an output's standard deviation, for the rounding of `f32` sums of 50 products.
const FORWARD: f64 = 1e-5;
/// Tolerance relative to the largest gradient.
const GRADIENT: f64 = 1e-4;

fn read(name: &str) -> Vec<u8> {
    let path = format!("{}/../../tests/vectors/{name}.safetensors", env!("CARGO_MANIFEST_DIR"));
    std::fs::read(&path).unwrap_or_else(|e| panic!("{path}: {e}"))
}

/// A tensor's shape and values.
fn tensor(file: &SafeTensors<'_>, name: &str) -> (Vec<usize>, Vec<f64>) {
    let view = file.tensor(name).unwrap_or_else(|e| panic!("{name}: {e}"));
    let values = match view.dtype() {
        Dtype::F32 => view.data().as_chunks().0.iter().map(|b| f64::from(f32::from_le_bytes(*b))).collect(),
        Dtype::F64 => view.data().as_chunks().0.iter().map(|b| f64::from_le_bytes(*b)).collect(),
        other => panic!("{name}: {other:?}"),
    };
    (view.shape().to_vec(), values)
}

fn f32s(file: &SafeTensors<'_>, name: &str) -> Vec<f32> {
    tensor(file, name).1.into_iter().map(|v| v as f32).collect()
}

/// The network under PyTorch's names, `prefix` before each; both biases of a gate are added.
fn net(file: &SafeTensors<'_>, prefix: &str) -> LstmNet {
    let get = |name: String| f32s(file, &format!("{prefix}{name}"));
    let mut blocks = Vec::new();
    while file.tensor(&format!("{prefix}lstm.weight_ih_l{}", blocks.len())).is_ok() {
        let l = blocks.len();
        let weight_ih = get(format!("lstm.weight_ih_l{l}"));
        let weight_hh = get(format!("lstm.weight_hh_l{l}"));
        let biases = get(format!("lstm.bias_ih_l{l}")).into_iter().zip(get(format!("lstm.bias_hh_l{l}")));
        let bias: Vec<f32> = biases.map(|(a, b)| a + b).collect();
        let cells = bias.len() / 4;
        blocks.push(LstmBlock { inputs: weight_ih.len() / bias.len(), cells, weight_ih, weight_hh, bias });
    }
    let fc_bias = get("fc.bias".into());
    LstmNet { blocks, outputs: fc_bias.len(), fc_weight: get("fc.weight".into()), fc_bias }
}

/// `[sample, channel]` to planar.
fn planar((shape, values): (Vec<usize>, Vec<f64>)) -> Vec<Vec<f64>> {
    let [_, channels] = shape[..] else { panic!("{shape:?}") };
    (0..channels).map(|c| values[c..].iter().step_by(channels).copied().collect()).collect()
}

/// `[window, step, channel]` to planar windows.
fn windows((shape, values): (Vec<usize>, Vec<f64>)) -> Vec<Vec<Vec<f64>>> {
    let [_, steps, channels] = shape[..] else { panic!("{shape:?}") };
    let window = |w: &[f64]| planar((vec![steps, channels], w.to_vec()));
    values.chunks_exact(steps * channels).map(window).collect()
}

fn to_f32(x: &[Vec<f64>]) -> Vec<Vec<f32>> {
    x.iter().map(|x| x.iter().map(|&x| x as f32).collect()).collect()
}

fn sets() -> Vec<Isa> {
    let (here, missing): (Vec<_>, Vec<_>) = Isa::ALL.into_iter().partition(|i| i.is_available());
    missing.iter().for_each(|i| println!("skipped {}: not on this machine", i.name()));
    here
}

/// All windows from a zero state, sixteen at a time.
fn forward<const R: usize>(isa: Isa, net: &LstmNet, x: &[Vec<Vec<f32>>]) -> Vec<Vec<Vec<f32>>> {
    let packed = Packed::<R>::new(&Shape::of(net), &flatten(net));
    let mut state = State::<1>::new(&packed.shape);
    let steps = x[0][0].len();
    let mut y = vec![vec![Vec::new(); net.outputs]; x.len()];
    for (first, group) in x.chunks(LANES).enumerate() {
        let source = |lane: usize| (&group[lane][..], 0);
        run_windows(isa, &packed, &mut state, steps, group.len(), source, |_, out| {
            for step in out.chunks_exact(net.outputs) {
                for lane in 0..group.len() {
                    for (y, out) in y[first * LANES + lane].iter_mut().zip(step) {
                        y.push(out[0].0[lane]);
                    }
                }
            }
        });
    }
    y
}

#[test]
fn windows_and_one_steps_gradients_agree_with_pytorch() {
    for name in ["lstm_39", "lstm_23_23"] {
        let bytes = read(name);
        let file = SafeTensors::deserialize(&bytes).unwrap();
        let net = net(&file, "");
        assert_eq!(net.check(), Ok(()));
        let x: Vec<_> = windows(tensor(&file, "x")).iter().map(|w| to_f32(w)).collect();
        let target: Vec<_> = windows(tensor(&file, "target")).iter().map(|w| to_f32(w)).collect();
        let y = windows(tensor(&file, "y"));
        let std = std_of(&y.concat());
        assert!(std > 0.1, "an output that moves");
        let burn_in = tensor(&file, "burn_in").1[0] as usize;
        let steps = x[0][0].len();
        // The one bias of a gate has the gradient of either of PyTorch's two.
        let mut expected = self::net(&file, "grad.");
        expected.blocks.iter_mut().for_each(|b| b.bias.iter_mut().for_each(|v| *v /= 2.0));
        let expected = flatten(&expected);
        let largest = expected.iter().fold(0.0_f64, |m, g| m.max(f64::from(g.abs())));

        let (shape, row) = (Shape::of(&net), flatten(&net));
        for isa in sets() {
            let found =
                if isa == Isa::Avx512 { forward::<16>(isa, &net, &x) } else { forward::<4>(isa, &net, &x) };
            assert_eq!(found.len(), y.len());
            for (found, y) in found.iter().zip(&y) {
                let error = distance(found, y) / std;
                assert!(error < FORWARD, "{name} {}: {error:e}", isa.name());
            }

            let mut gradient = vec![0.0_f64; row.len()];
            let scale = 2.0 / (x.len() * (steps - burn_in) * net.outputs) as f32;
            let mut group = Group::new(&shape, steps, burn_in);
            for (x, target) in x.chunks(LANES).zip(target.chunks(LANES)) {
                group.set_windows(x.iter().zip(target).map(|(x, y)| (&x[..], &y[..], 0)));
                let group = &mut group;
                if isa == Isa::Avx512 {
                    let weights = &TrainWeights::<16>::new(&shape, &row);
                    dispatch(isa, Backprop::<16, true> { weights, group, scale });
                } else {
                    let weights = &TrainWeights::<4>::new(&shape, &row);
                    dispatch(isa, Backprop::<4, false> { weights, group, scale });
                }
                gradient.iter_mut().zip(&group.gradient).for_each(|(sum, &g)| *sum += f64::from(g));
            }
            assert_eq!(gradient.len(), expected.len());
            for (k, (found, &expected)) in gradient.iter().zip(&expected).enumerate() {
                let error = (found - f64::from(expected)).abs() / largest;
                assert!(error < GRADIENT, "{name} {} weight {k}: {error:e}", isa.name());
            }
        }
    }
}

#[test]
fn whole_signals_agree_with_pytorch_in_both_recombinations() {
    for (name, frf) in [("torch_lstm", false), ("torch_hybrid2", true)] {
        let (model, io) = (read(name), read(&format!("{name}_io")));
        let model = SafeTensors::deserialize(&model).unwrap();
        let io = SafeTensors::deserialize(&io).unwrap();
        let net = net(&model, "");
        let mut x = planar(tensor(&io, "x"));
        if frf {
            x.extend(planar(tensor(&io, "frf_x")));
        }
        let (mean, std) = (tensor(&model, "x.mean").1, tensor(&model, "x.std").1);
        assert_eq!(mean.len(), x.len());
        for ((x, mean), std) in x.iter_mut().zip(&mean).zip(&std) {
            x.iter_mut().for_each(|x| *x = (*x - mean) / std);
        }
        let (mean, std) = (tensor(&model, "y.mean").1, tensor(&model, "y.std").1);
        for (way, recombine) in [("y.welch", Recombine::Welch), ("y.stream", Recombine::Stream)] {
            let mut y = planar(tensor(&io, way));
            for ((y, mean), std) in y.iter_mut().zip(&mean).zip(&std) {
                y.iter_mut().for_each(|y| *y = (*y - mean) / std);
            }
            for isa in sets() {
                let found = predict_on(isa, &net, &to_f32(&x), 64, 32, recombine, &unwatched).unwrap();
                let error = distance(&found, &y) / std_of(&y);
                assert!(error < FORWARD, "{name} {way} {}: {error:e}", isa.name());
            }
        }
    }
}
