//! Spectra of a response, of its systematic gap and of its noise floor.

use rigcast_numerics::fft::RealFftPlanner;
use serde::{Deserialize, Serialize};

use super::shorten;
use crate::diagnosis::data::prepare::Prepared;
use crate::diagnosis::data::problem::Stretch;
use crate::diagnosis::input::Input;
use crate::diagnosis::numerics::ar::Ar;
use crate::diagnosis::numerics::rows::fast_len;

/// Lines that the core's band is resolved into.
const LINES: f64 = 160.0;
/// Responses that are kept.
const KEPT: usize = 24;
/// Lines nearer than this share of their frequency are averaged.
const NEAR: f64 = 0.012;

/// One-sided densities of one response over the fit and select stretches.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ResponseSpectra {
    /// Response.
    pub channel: String,
    /// Its unit; densities are in unit^2/Hz.
    pub unit: String,
    /// Frequencies up to half the sample rate, denser at the lower end.
    pub frequency_hz: Vec<f64>,
    /// The response as measured, without its mean.
    pub measured: Vec<f64>,
    /// All that the sim leaves: gap and noise.
    pub error: Vec<f64>,
    /// What repeats agree on that the sim leaves; 0 where they agree on nothing.
    pub gap: Vec<f64>,
    /// The noise floor.
    pub noise: Vec<f64>,
}

/// Spectra of the responses with the largest gaps relative to their own power, in the order of the
/// request.
pub(super) fn all(input: &Input, prepared: &Prepared) -> Vec<ResponseSpectra> {
    let rate = input.sample_rate_hz();
    let mut all: Vec<ResponseSpectra> = prepared
        .problems
        .iter()
        .zip(&prepared.noises)
        .enumerate()
        .map(|(r, (problem, noise))| {
            let sets = [&problem.fit, &problem.select];
            let stretches: Vec<&Stretch> = sets.iter().flat_map(|set| set.iter()).collect();
            let welch = Welch::new(&stretches, prepared.band);
            let measured: Vec<&[f64]> = stretches.iter().map(|s| &s.measured[s.lead..]).collect();
            let gaps: Vec<Vec<f64>> = stretches.iter().map(|s| s.gap(problem.response)).collect();
            let errors: Vec<&[f64]> = gaps.iter().zip(&stretches).map(|(g, s)| &g[s.lead..]).collect();
            let error = welch.auto(&errors, rate);
            let floor = welch.noise(&noise.ar, rate);
            let twins = twins(&stretches);
            let gap = if twins.is_empty() {
                error.iter().zip(&floor).map(|(e, n)| e - n).collect()
            } else {
                welch.cross(twins.iter().map(|&(a, b)| (errors[a], errors[b])), rate)
            };
            let [frequency_hz, measured, error, gap, noise] =
                welch.thinned(rate, [welch.auto(&measured, rate), error, gap, floor]);
            ResponseSpectra {
                channel: input.responses[r].name.clone(),
                unit: input.responses[r].unit.clone(),
                frequency_hz,
                measured,
                error,
                gap: gap.into_iter().map(|g| g.max(0.0)).collect(),
                noise,
            }
        })
        .collect();
    if all.len() > KEPT {
        let share = |s: &ResponseSpectra| {
            s.gap.iter().sum::<f64>() / s.measured.iter().sum::<f64>().max(f64::MIN_POSITIVE)
        };
        let mut shares: Vec<f64> = all.iter().map(share).collect();
        shares.sort_by(|a, b| b.total_cmp(a));
        let least = shares[KEPT - 1];
        all.retain(|s| share(s) >= least);
    }
    all
}

/// Pairs of stretches with the same drives.
fn twins(stretches: &[&Stretch]) -> Vec<(usize, usize)> {
    let mut used = vec![false; stretches.len()];
    let mut out = Vec::new();
    for a in 0..stretches.len() {
        let twin = (a + 1..stretches.len()).find(|&b| !used[b] && stretches[b].group == stretches[a].group);
        if let Some(b) = twin.filter(|_| !used[a]) {
            used[b] = true;
            out.push((a, b));
        }
    }
    out
}

/// Welch's averages with Hann windows that overlap by half.
pub(super) struct Welch {
    n: usize,
}

impl Welch {
    /// Segments that resolve the band, or the shortest stretch where that is shorter.
    pub fn new(stretches: &[&Stretch], band: [f64; 2]) -> Self {
        let shortest = stretches.iter().map(|s| s.measured.len() - s.lead).min().unwrap_or(64);
        let wanted = (LINES / (band[1] - band[0]).max(1e-6)) as usize;
        Self { n: fast_len(wanted.clamp(16, shortest.max(16))) }
    }

    /// Densities of one signal over several stretches.
    pub fn auto(&self, stretches: &[&[f64]], rate_hz: f64) -> Vec<f64> {
        self.cross(stretches.iter().map(|s| (*s, *s)), rate_hz)
    }

    /// Real part of the cross density of pairs of signals.
    pub fn cross<'a>(&self, pairs: impl Iterator<Item = (&'a [f64], &'a [f64])>, rate_hz: f64) -> Vec<f64> {
        let fft = RealFftPlanner::new().plan_fft_forward(self.n);
        let window: Vec<f64> = (0..self.n)
            .map(|i| 0.5 - 0.5 * (std::f64::consts::TAU * (i as f64 + 0.5) / self.n as f64).cos())
            .collect();
        let lines = |x: &[f64]| {
            let mean = x.iter().sum::<f64>() / x.len() as f64;
            let mut input: Vec<f64> = x.iter().zip(&window).map(|(x, w)| (x - mean) * w).collect();
            let mut lines = fft.make_output_vec();
            fft.process(&mut input, &mut lines).expect("buffers are the plan's own");
            lines
        };
        let (mut sum, mut count) = (vec![0.0; self.n / 2 + 1], 0.0);
        for (a, b) in pairs {
            let len = a.len().min(b.len());
            let mut from = 0;
            while from + self.n <= len {
                let (za, zb) = (lines(&a[from..from + self.n]), lines(&b[from..from + self.n]));
                for (s, (a, b)) in sum.iter_mut().zip(za.iter().zip(&zb)) {
                    *s += (a * b.conj()).re;
                }
                count += 1.0;
                from += self.n / 2;
            }
        }
        let power: f64 = window.iter().map(|w| w * w).sum();
        let scale = 2.0 / (f64::max(count, 1.0) * power * rate_hz);
        sum.iter_mut().for_each(|s| *s *= scale);
        sum
    }

    /// The noise floor on the same lines.
    pub fn noise(&self, noise: &Ar, rate_hz: f64) -> Vec<f64> {
        (0..=self.n / 2).map(|line| 2.0 * noise.power(line as f64 / self.n as f64) / rate_hz).collect()
    }

    /// Frequencies and series without the line at 0, whose lines come ever wider apart.
    pub fn thinned<const N: usize, const M: usize>(
        &self,
        rate_hz: f64,
        series: [Vec<f64>; N],
    ) -> [Vec<f64>; M] {
        const { assert!(M == N + 1, "one more list than series: the frequencies") };
        let mut out: [Vec<f64>; M] = std::array::from_fn(|_| Vec::new());
        let last = self.n / 2;
        let mut from = 1;
        while from <= last {
            let to = (from + ((from as f64 * NEAR) as usize).max(1)).min(last + 1);
            let count = (to - from) as f64;
            out[0].push((from + to - 1) as f64 / 2.0 / self.n as f64 * rate_hz);
            for (out, series) in out[1..].iter_mut().zip(&series) {
                out.push(series[from..to].iter().sum::<f64>() / count);
            }
            from = to;
        }
        out.map(shorten)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_density_of_a_sine_holds_its_power_and_thinning_keeps_it() {
        let (rate, n) = (200.0, 4000);
        let sine: Vec<f64> =
            (0..n).map(|k| 3.0 * (std::f64::consts::TAU * 40.0 * f64::from(k) / rate).sin()).collect();
        let welch = Welch { n: 500 };
        let density = welch.auto(&[&sine], rate);
        let power = density.iter().sum::<f64>() * rate / 500.0;
        assert!((power - 4.5).abs() < 0.01, "{power}");
        let [frequency, thin] = welch.thinned(rate, [density]);
        let mut edges: Vec<f64> = frequency.windows(2).map(|f| 0.5 * (f[0] + f[1])).collect();
        edges.insert(0, 0.2);
        edges.push(100.2);
        let kept: f64 = thin.iter().zip(edges.windows(2)).map(|(d, e)| d * (e[1] - e[0])).sum();
        assert!((kept - 4.5).abs() < 0.2, "{kept}");
        assert!(frequency.len() < 230 && *frequency.last().unwrap() <= 100.0);
    }
}
