//! The sim of a case: the FRF of a linear rig, as a lab would import it.

use std::collections::HashMap;
use std::io;

use realfft::RealFftPlanner;
use safetensors::tensor::{Dtype, TensorView};
use serde_json::json;

use super::rig::{COARSE, RATE, Rig, Span};

/// Samples of the FRF's segment, 32 s or 64 s. Half of it is the past, half the future, as an FRF's is: in
/// half of it every mode has to ring down.
const SEGMENTS: [usize; 2] = [16_384, 32_768];
/// Share of a pulse response's energy that the shorter one may miss: a fifth of the least noise.
const MISSED: f64 = 6e-7;

/// Responses of a linear rig to a pulse on each drive, `[drive][response][sample]`.
fn pulses(rig: &Rig, n_drives: usize, samples: usize) -> Vec<Vec<Vec<f64>>> {
    (0..n_drives)
        .map(|d| {
            // One sample late: between samples a drive may rise before its pulse.
            let mut pulse = vec![vec![0.0; samples + 1]; n_drives];
            pulse[d][1] = 1.0;
            let heard = rig.respond(Span { drives: &pulse, time: [0.0, 0.0], steps: COARSE }, &[]);
            heard.iter().map(|y| y[1..].to_vec()).collect()
        })
        .collect()
}

/// Whether a pulse's response has ended in its first half.
fn has_rung_down(response: &[f64]) -> bool {
    let energy = |y: &[f64]| y.iter().map(|y| y * y).sum::<f64>();
    energy(&response[response.len() / 2..]) <= MISSED * energy(response)
}

/// `H[line, response, drive]` of a linear rig, real and imaginary, and the samples of its segment.
///
/// # Errors
/// Never: buffers are the plan's own.
fn frf(rig: &Rig, n_drives: usize) -> io::Result<(Vec<[f64; 2]>, usize)> {
    let mut heard = pulses(rig, n_drives, SEGMENTS[0]);
    if !heard.iter().flatten().all(|y| has_rung_down(y)) {
        heard = pulses(rig, n_drives, SEGMENTS[1]);
    }
    let (n_responses, segment) = (heard[0].len(), heard[0][0].len());
    let fft = RealFftPlanner::new().plan_fft_forward(segment);
    let mut h = vec![[0.0; 2]; (segment / 2 + 1) * n_responses * n_drives];
    for (d, heard) in heard.iter_mut().enumerate() {
        for (r, y) in heard.iter_mut().enumerate() {
            let mut spectrum = fft.make_output_vec();
            fft.process(y, &mut spectrum).map_err(io::Error::other)?;
            for (line, value) in spectrum.iter().enumerate() {
                h[(line * n_responses + r) * n_drives + d] = [value.re, value.im];
            }
        }
    }
    Ok((h, segment))
}

/// A safetensors file of the rig's FRF; `y_mean` is its response without a drive.
///
/// # Errors
/// Only for lack of memory.
pub fn safetensors(
    rig: &Rig,
    drives: &[String],
    responses: &[String],
    y_mean: &[f64],
) -> io::Result<Vec<u8>> {
    let (n_drives, n_responses) = (drives.len(), responses.len());
    let (h, segment) = frf(rig, n_drives)?;
    let lines = segment / 2 + 1;
    let bytes =
        |values: &mut dyn Iterator<Item = f64>| values.flat_map(f64::to_le_bytes).collect::<Vec<u8>>();
    let shape = vec![lines, n_responses, n_drives];
    let tensors = [
        ("frf.freq_hz", vec![lines], bytes(&mut (0..lines).map(|l| l as f64 * RATE / segment as f64))),
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
    fn what_still_rings_in_the_second_half_asks_for_a_longer_segment() {
        let decay = |samples: f64| -> Vec<f64> {
            (0..1000).map(|k| (-f64::from(k) / samples).exp() * (0.3 * f64::from(k)).cos()).collect()
        };
        assert!(has_rung_down(&decay(60.0)) && !has_rung_down(&decay(90.0)));
    }

    #[test]
    fn the_frf_answers_like_the_rig() {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let mut long: Vec<Vec<f64>> = (0..2).map(|_| drives::noise(8.0, 30.0, &mut rng)).collect();
        let rig = Rig::draw(&mut rng, 1, &long, &[]);
        for drive in &mut long {
            // A pulse at the very start has no rise before it.
            drive[0] = 0.0;
        }
        let (h, segment) = frf(&rig, 2).unwrap();
        long.iter_mut().for_each(|drive| drive.resize(segment, 0.0));
        let expected = rig.respond(Span { drives: &long, time: [0.0, 0.0], steps: FINE }, &[]);
        let mut planner = RealFftPlanner::new();
        let (there, back) = (planner.plan_fft_forward(segment), planner.plan_fft_inverse(segment));
        let mut sum = there.make_output_vec();
        for (d, drive) in long.iter_mut().enumerate() {
            let mut spectrum = there.make_output_vec();
            there.process(drive, &mut spectrum).unwrap();
            for (line, (s, u)) in sum.iter_mut().zip(&spectrum).enumerate() {
                let [re, im] = h[line * 2 + d];
                *s += Complex64::new(re, im) * u;
            }
        }
        let mut found = vec![0.0; segment];
        back.process(&mut sum, &mut found).unwrap();
        let left: Vec<f64> = found.iter().zip(&expected[0]).map(|(f, e)| f / segment as f64 - e).collect();
        assert!(rms(&left) < 1e-3 * rms(&expected[0]), "{}", rms(&left) / rms(&expected[0]));
    }
}
