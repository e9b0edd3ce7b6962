//! The sim of a case: the FRF of a linear rig, as a lab brings it from elsewhere.

use std::collections::HashMap;
use std::io;

use realfft::RealFftPlanner;
use safetensors::tensor::{Dtype, TensorView};
use serde_json::json;

use super::rig::{COARSE, RATE, Rig, Span};

/// Samples of the FRF's segment: 32 s, in which every mode rings down.
const SEGMENT: usize = 16_384;
const LINES: usize = SEGMENT / 2 + 1;

/// `H[line, response, drive]` of a linear rig, real and imaginary, from its response to a pulse on each
/// drive.
///
/// # Errors
/// Never: buffers are the plan's own.
fn frf(rig: &Rig, n_drives: usize, n_responses: usize) -> io::Result<Vec<[f64; 2]>> {
    let fft = RealFftPlanner::new().plan_fft_forward(SEGMENT);
    let mut h = vec![[0.0; 2]; LINES * n_responses * n_drives];
    for d in 0..n_drives {
        // One sample late: between samples a drive may rise before its pulse.
        let mut pulse = vec![vec![0.0; SEGMENT + 1]; n_drives];
        pulse[d][1] = 1.0;
        let heard = rig.respond(Span { drives: &pulse, time: [0.0, 0.0], steps: COARSE }, &[]);
        for (r, y) in heard.iter().enumerate() {
            let mut input = y[1..].to_vec();
            let mut spectrum = fft.make_output_vec();
            fft.process(&mut input, &mut spectrum).map_err(io::Error::other)?;
            for (line, value) in spectrum.iter().enumerate() {
                h[(line * n_responses + r) * n_drives + d] = [value.re, value.im];
            }
        }
    }
    Ok(h)
}

/// A safetensors file of the rig's FRF; `y_mean` is what it answers to no drive.
///
/// # Errors
/// Never but for lack of memory.
pub fn safetensors(
    rig: &Rig,
    drives: &[String],
    responses: &[String],
    y_mean: &[f64],
) -> io::Result<Vec<u8>> {
    let (n_drives, n_responses) = (drives.len(), responses.len());
    let h = frf(rig, n_drives, n_responses)?;
    let bytes =
        |values: &mut dyn Iterator<Item = f64>| values.flat_map(f64::to_le_bytes).collect::<Vec<u8>>();
    let shape = vec![LINES, n_responses, n_drives];
    let tensors = [
        ("frf.freq_hz", vec![LINES], bytes(&mut (0..LINES).map(|l| l as f64 * RATE / SEGMENT as f64))),
        ("frf.re", shape.clone(), bytes(&mut h.iter().map(|h| h[0]))),
        ("frf.im", shape, bytes(&mut h.iter().map(|h| h[1]))),
        ("frf.y_mean", vec![n_responses], bytes(&mut y_mean.iter().copied())),
    ];
    let views: Vec<(&str, TensorView<'_>)> = tensors
        .iter()
        .map(|(name, shape, bytes)| {
            TensorView::new(Dtype::F64, shape.clone(), bytes)
                .map(|view| (*name, view))
                .map_err(io::Error::other)
        })
        .collect::<io::Result<_>>()?;
    let about =
        json!({"schema": 1, "kind": "frf", "inputs": drives, "outputs": responses, "sample_rate_hz": RATE});
    let metadata = HashMap::from([("rigcast".to_owned(), about.to_string())]);
    safetensors::serialize(views, Some(metadata)).map_err(io::Error::other)
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use realfft::num_complex::Complex64;

    use super::*;
    use crate::generate::drives;
    use crate::generate::rig::{FINE, rms};

    #[test]
    fn the_frf_answers_like_the_rig() {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let mut long: Vec<Vec<f64>> = (0..2).map(|_| drives::noise(8.0, 30.0, &mut rng)).collect();
        let rig = Rig::draw(&mut rng, 1, &long, &[]);
        for drive in &mut long {
            // A pulse at the very start has no rise before it.
            drive[0] = 0.0;
            drive.resize(SEGMENT, 0.0);
        }
        let expected = rig.respond(Span { drives: &long, time: [0.0, 0.0], steps: FINE }, &[]);
        let h = frf(&rig, 2, 1).unwrap();
        let mut planner = RealFftPlanner::new();
        let (there, back) = (planner.plan_fft_forward(SEGMENT), planner.plan_fft_inverse(SEGMENT));
        let mut sum = there.make_output_vec();
        for (d, drive) in long.iter_mut().enumerate() {
            let mut spectrum = there.make_output_vec();
            there.process(drive, &mut spectrum).unwrap();
            for (line, (s, u)) in sum.iter_mut().zip(&spectrum).enumerate() {
                let [re, im] = h[line * 2 + d];
                *s += Complex64::new(re, im) * u;
            }
        }
        let mut found = vec![0.0; SEGMENT];
        back.process(&mut sum, &mut found).unwrap();
        let left: Vec<f64> = found.iter().zip(&expected[0]).map(|(f, e)| f / SEGMENT as f64 - e).collect();
        assert!(rms(&left) < 1e-3 * rms(&expected[0]), "{}", rms(&left) / rms(&expected[0]));
    }
}
