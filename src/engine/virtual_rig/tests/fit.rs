//! A plain three-drive H1 estimate, only to see how linear the bench is.

use faer::Mat;
use realfft::num_complex::Complex64;
use rigcast_numerics::decompose;
use rigcast_numerics::fft::RealFftPlanner;

use crate::Signal;

const SEGMENT: usize = 4096;

/// `[line][response][drive]`, with the means of drive and response.
pub struct Fit {
    pub lines: Vec<[[Complex64; 3]; 6]>,
    pub drive_mean: [f64; 3],
    pub response_mean: [f64; 6],
}

pub fn mean(x: &[f64]) -> f64 {
    x.iter().sum::<f64>() / x.len() as f64
}

/// Hann, three quarters overlap, S_yx S_xx^-1 per line.
pub fn h1(runs: &[(Signal, Signal)]) -> Fit {
    let plan = RealFftPlanner::new().plan_fft_forward(SEGMENT);
    let total: f64 = runs.iter().map(|(d, _)| d.n_samples() as f64).sum();
    let pooled = |of: &dyn Fn(&(Signal, Signal)) -> Vec<f64>| {
        runs.iter().map(|run| of(run).iter().sum::<f64>()).sum::<f64>() / total
    };
    let drive_mean: [f64; 3] = std::array::from_fn(|c| pooled(&|run| run.0.channel(c).to_vec()));
    let response_mean: [f64; 6] = std::array::from_fn(|c| pooled(&|run| run.1.channel(c).to_vec()));
    let n_lines = SEGMENT / 2 + 1;
    let mut sxx = vec![Mat::<Complex64>::zeros(3, 3); n_lines];
    let mut syx = vec![Mat::<Complex64>::zeros(6, 3); n_lines];
    for (drive, response) in runs {
        for start in (0..=drive.n_samples() - SEGMENT).step_by(SEGMENT / 4) {
            let transform = |samples: &[f64], mean: f64| {
                let mut input: Vec<f64> = (0..SEGMENT)
                    .map(|k| {
                        let hann = 0.5 - 0.5 * (std::f64::consts::TAU * k as f64 / SEGMENT as f64).cos();
                        (samples[start + k] - mean) * hann
                    })
                    .collect();
                let mut output = plan.make_output_vec();
                plan.process(&mut input, &mut output).unwrap();
                output
            };
            let x: Vec<_> = (0..3).map(|c| transform(drive.channel(c), drive_mean[c])).collect();
            let y: Vec<_> = (0..6).map(|c| transform(response.channel(c), response_mean[c])).collect();
            for line in 0..n_lines {
                for j in 0..3 {
                    (0..3).for_each(|i| sxx[line][(i, j)] += x[i][line] * x[j][line].conj());
                    (0..6).for_each(|i| syx[line][(i, j)] += y[i][line] * x[j][line].conj());
                }
            }
        }
    }
    let df = 1000.0 / SEGMENT as f64;
    let lines = (0..n_lines)
        .map(|line| {
            if line as f64 * df > 50.0 {
                return [[Complex64::ZERO; 3]; 6];
            }
            // H Sxx = Syx, solved as Sxx^T H^T = Syx^T.
            let h = decompose::solve(&sxx[line].transpose().to_owned(), &syx[line].transpose().to_owned());
            std::array::from_fn(|i| std::array::from_fn(|j| h[(j, i)]))
        })
        .collect();
    Fit { lines, drive_mean, response_mean }
}

impl Fit {
    /// Prediction for a drive, its history held at its first value.
    pub fn predict(&self, drive: &Signal) -> Vec<Vec<f64>> {
        let n = drive.n_samples();
        let padded = (n + 3 * SEGMENT).next_power_of_two();
        let mut planner = RealFftPlanner::new();
        let (forward, inverse) = (planner.plan_fft_forward(padded), planner.plan_fft_inverse(padded));
        let short = planner.plan_fft_inverse(SEGMENT);
        let x: Vec<_> = (0..3)
            .map(|c| {
                let d = drive.channel(c);
                let mut input = vec![d[0] - self.drive_mean[c]; padded];
                for k in 0..n {
                    input[2 * SEGMENT + k] = d[k] - self.drive_mean[c];
                }
                let mut output = forward.make_output_vec();
                forward.process(&mut input, &mut output).unwrap();
                output
            })
            .collect();
        (0..6)
            .map(|r| {
                let mut sum = forward.make_output_vec();
                for c in 0..3 {
                    let mut lines: Vec<_> = self.lines.iter().map(|h| h[r][c]).collect();
                    lines[0].im = 0.0;
                    let mut impulse = vec![0.0; SEGMENT];
                    short.process(&mut lines, &mut impulse).unwrap();
                    // First three quarters are causal taps, the rest lie before zero.
                    let mut long = vec![0.0; padded];
                    for (k, tap) in impulse.iter().enumerate() {
                        let at = if k < 3 * SEGMENT / 4 { k } else { padded - SEGMENT + k };
                        long[at] = tap / SEGMENT as f64;
                    }
                    let mut h = forward.make_output_vec();
                    forward.process(&mut long, &mut h).unwrap();
                    for (s, (h, x)) in sum.iter_mut().zip(h.iter().zip(&x[c])) {
                        *s += h * x;
                    }
                }
                let last = sum.len() - 1;
                sum[0].im = 0.0;
                sum[last].im = 0.0;
                let mut y = vec![0.0; padded];
                inverse.process(&mut sum, &mut y).unwrap();
                (0..n).map(|k| y[2 * SEGMENT + k] / padded as f64 + self.response_mean[r]).collect()
            })
            .collect()
    }
}

/// The paper's RMS error of one channel.
pub fn rms_error(predicted: &[f64], measured: &[f64]) -> f64 {
    assert_eq!(predicted.len(), measured.len());
    let error: f64 = predicted.iter().zip(measured).map(|(p, m)| (p - m).powi(2)).sum();
    (error / measured.iter().map(|m| m * m).sum::<f64>()).sqrt()
}
