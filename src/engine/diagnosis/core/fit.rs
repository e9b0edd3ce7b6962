//! Rational common-denominator fit of one response to all drives. The order is that of the least
//! whitened error on held-out stretches, with a charge for each parameter: on fitted ones spurious
//! modes pay where the rig is not quite linear.
//!
//! Steiglitz and McBride's iteration (IEEE Trans. Autom. Control 10, 1965) in the partial-fraction
//! basis of vector fitting (Gustavsen and Semlyen 1999; in the time domain Grivet-Talocia 2003):
//! with `b_n` the outputs of the present poles, `y + sum c_n b_n(y) = sum_d (D_d u_d + sum r_dn
//! b_n(u_d))` is linear in `c, D, r`, and the zeros of `1 + sum c_n b_n` are the next poles. The
//! basis stays well conditioned where powers of `z` do not. Errors are whitened rows in the band.

use rayon::prelude::*;
use realfft::num_complex::Complex64;

use super::Core;
use super::modes::Modes;
use super::refine::refine;
use super::thin::{FEW_DRIVES, thin};
use crate::EngineError;
use crate::diagnosis::numerics::ar::Ar;
use crate::diagnosis::numerics::linear::{dot, eigenvalues, least_squares, mean};
use crate::diagnosis::numerics::rows::Rows;

/// Orders that are tried.
const ORDERS: [usize; 10] = [1, 2, 3, 4, 5, 6, 7, 8, 10, 12];
/// Orders of the first fits, which only serve to learn the noise's colour.
const FIRST_ORDERS: [usize; 4] = [2, 4, 7, 10];
/// Relocations of the poles per order.
const ROUNDS: usize = 8;
/// Price of a parameter in squared noise floors over a whole stretch: a spurious mode may choose
/// among all lines, but what is missed grows with the drive.
const CHARGE: f64 = 4.0;
/// Share of each stretch that is held out while the order is chosen.
const HELD_OUT: f64 = 0.3;
/// Share of a stretch that its unknown past may colour.
const SETTLING: f64 = 0.1;

/// Simultaneous samples of all drives and one response.
#[derive(Clone)]
pub(in crate::diagnosis) struct Stretch<'a> {
    pub drives: Vec<&'a [f64]>,
    pub response: &'a [f64],
}

/// A core and what it leaves.
#[derive(Debug, Clone)]
pub(in crate::diagnosis) struct CoreFit {
    pub core: Core,
    /// Noise that the core leaves in the stretches, in the response's unit.
    pub noise: Ar,
}

/// Fits the core to low-level stretches inside `band` (cycles a sample). Where they are known to be
/// `linear` the order also answers to the fitted part; else only to the held-out one. `supposed` is the noise that
/// errors are counted in before its own colour is known.
///
/// # Errors
/// Stretches too short for any order.
pub(in crate::diagnosis) fn fit(
    stretches: &[Stretch<'_>],
    sample_rate_hz: f64,
    band: [f64; 2],
    linear: bool,
    supposed: &Ar,
) -> Result<CoreFit, EngineError> {
    let drives = stretches[0].drives.len();
    let centred = Centred::new(stretches, supposed);
    let rows = |of: &Centred<'_>, band| -> usize {
        of.part(0.0, 1.0, band, supposed).iter().map(|s| s.rows.len()).sum()
    };
    let affordable = |rows: usize| rows / (4 * (drives + 1));
    let all = rows(&centred, band);
    if affordable(all) < 2 {
        let samples: usize = stretches.iter().map(|s| s.response.len()).sum();
        let needed = (samples * 8 * (drives + 1)).div_ceil(all.max(1));
        return Err(EngineError::TooShort {
            what: "baseline runs, for the linear core",
            needed,
            found: samples,
        });
    }
    let (fitted, noise) = match thin(stretches, band) {
        None => centred.choose(band, affordable(all), linear),
        Some((thinned, step)) => {
            let few = thinned.iter().map(|t| Stretch {
                drives: t.drives.iter().map(Vec::as_slice).collect(),
                response: &t.response,
            });
            let slow = band.map(|f| f * step as f64);
            let few = Centred::new(&few.collect::<Vec<_>>(), supposed);
            let (found, _) = few.choose(slow, affordable(rows(&few, slow)).max(2), linear);
            centred.fit_at(&found.modes.faster(step), band)
        }
    };
    let Linear { modes, input, direct } = fitted;
    let core = Core {
        sample_rate_hz,
        modes,
        input,
        direct,
        drive_mean: centred.drive_mean,
        response_mean: centred.response_mean,
    };
    Ok(CoreFit { core, noise })
}

/// Poles and the path of each drive, about the working point.
#[derive(Clone)]
pub(super) struct Linear {
    pub modes: Modes,
    pub input: Vec<Vec<f64>>,
    pub direct: Vec<f64>,
}

/// Stretches about their common working point.
struct Centred<'a> {
    /// `[stretch][drive][sample]`
    drives: Vec<Vec<Vec<f64>>>,
    /// `[stretch][sample]`
    response: Vec<Vec<f64>>,
    drive_mean: Vec<f64>,
    response_mean: f64,
    supposed: &'a Ar,
}

impl<'a> Centred<'a> {
    fn new(stretches: &[Stretch<'_>], supposed: &'a Ar) -> Self {
        let pooled = |of: &dyn Fn(&Stretch<'_>) -> f64| {
            let n: usize = stretches.iter().map(|s| s.response.len()).sum();
            stretches.iter().map(|s| of(s) * s.response.len() as f64).sum::<f64>() / n.max(1) as f64
        };
        let drive_mean: Vec<f64> =
            (0..stretches[0].drives.len()).map(|d| pooled(&|s| mean(s.drives[d]))).collect();
        let response_mean = pooled(&|s| mean(s.response));
        let less = |x: &[f64], mean: f64| x.iter().map(|x| x - mean).collect::<Vec<f64>>();
        Self {
            drives: stretches
                .iter()
                .map(|s| s.drives.iter().zip(&drive_mean).map(|(d, m)| less(d, *m)).collect())
                .collect(),
            response: stretches.iter().map(|s| less(s.response, response_mean)).collect(),
            drive_mean,
            response_mean,
            supposed,
        }
    }

    /// The best model of the best order up to `affordable`, and the noise that it leaves.
    fn choose(&self, band: [f64; 2], affordable: usize, linear: bool) -> (Linear, Ar) {
        let drives = self.drives[0].len();
        let all = self.part(0.0, 1.0, band, self.supposed);
        // The first noise is taken from a model that is rather too rich than too poor: what a poor one
        // leaves at a resonance would pass for noise there and hide that it is poor.
        let noise = FIRST_ORDERS
            .par_iter()
            .filter(|&&order| order <= affordable)
            .map(|&order| {
                let linear = self.searched(&all, order, band);
                (all.iter().map(|s| s.error(&linear)).sum::<f64>(), self.noise(&linear))
            })
            .min_by(|a, b| a.0.total_cmp(&b.0))
            .map_or_else(|| self.supposed.clone(), |first| first.1);

        let early = self.part(0.0, 1.0 - HELD_OUT, band, &noise);
        let held_out = self.part(1.0 - HELD_OUT, 1.0, band, &noise);
        let scored: Vec<(f64, Linear)> = ORDERS
            .par_iter()
            .filter(|&&order| order <= affordable)
            .map(|&order| {
                let model = self.searched(&early, order, band);
                let of = |parts: &[Part<'_>]| parts.iter().map(|s| s.error(&model)).sum::<f64>();
                let (left, share) =
                    if linear { (of(&early) + of(&held_out), 1.0) } else { (of(&held_out), HELD_OUT) };
                let parameters = (drives * (order + 1) + order) as f64;
                let endless = lasting(&early, &model.modes).is_some();
                (if endless { f64::INFINITY } else { left + share * CHARGE * parameters }, model)
            })
            .collect();
        let best = scored.into_iter().min_by(|a, b| a.0.total_cmp(&b.0));
        let all = self.part(0.0, 1.0, band, &noise);
        let linear = match best {
            None => fitted(&all, 2, band),
            Some((_, chosen)) => {
                // The relocation of poles may end elsewhere on more samples.
                let anew = fitted(&all, chosen.modes.order(), band);
                let further = refine(&all, chosen);
                let left = |of: &Linear| all.iter().map(|s| s.error(of)).sum::<f64>();
                if left(&further) < left(&anew) { further } else { anew }
            }
        };
        let noise = self.noise(&linear);
        (linear, noise)
    }

    /// A model of an order that is tried. With many drives it is not refined: that takes most of the time, and orders differ by
    /// more than it gains.
    fn searched(&self, parts: &[Part<'_>], order: usize, band: [f64; 2]) -> Linear {
        if self.drive_mean.len() > FEW_DRIVES {
            settled(parts, order, band)
        } else {
            fitted(parts, order, band)
        }
    }

    /// The best model that has about these poles, and the noise that it leaves.
    fn fit_at(&self, modes: &Modes, band: [f64; 2]) -> (Linear, Ar) {
        let with = |parts: &[Part<'_>]| {
            let target = rows(parts, |part| vec![part.response.to_vec()]).remove(0);
            paths(parts, modes, &target)
        };
        let noise = self.noise(&with(&self.part(0.0, 1.0, band, self.supposed)));
        let all = self.part(0.0, 1.0, band, &noise);
        let linear = refine(&all, with(&all));
        let noise = self.noise(&linear);
        (linear, noise)
    }

    /// A share of each stretch, with a lead-in before it that is simulated and not scored.
    fn part(&self, from: f64, to: f64, band: [f64; 2], noise: &Ar) -> Vec<Part<'_>> {
        self.drives
            .iter()
            .zip(&self.response)
            .map(|(drives, response)| {
                let n = response.len() as f64;
                let lead = (n * SETTLING) as usize;
                let (from, to) = ((n * from) as usize, (n * to) as usize);
                // From the start of the stretch: what rings longest is then as far away as can be.
                let (start, scored) = (0, from.max(lead));
                Part {
                    drives: drives.iter().map(|d| &d[start..to]).collect(),
                    response: &response[start..to],
                    lead: scored - start,
                    rows: Rows::new((to - scored).max(2), band, noise),
                }
            })
            .collect()
    }

    /// Colour and power of what `linear` leaves.
    fn noise(&self, linear: &Linear) -> Ar {
        let left: Vec<Vec<f64>> = self
            .drives
            .iter()
            .zip(&self.response)
            .map(|(drives, response)| {
                let lead = (response.len() as f64 * SETTLING) as usize;
                let drives: Vec<&[f64]> = drives.iter().map(Vec::as_slice).collect();
                linear.residual(&drives, response)[lead..].to_vec()
            })
            .collect();
        let left: Vec<&[f64]> = left.iter().map(Vec::as_slice).collect();
        Ar::fit_beside(self.supposed, &left, 24)
    }
}

/// A share of a stretch, ready to be scored.
pub(super) struct Part<'a> {
    pub drives: Vec<&'a [f64]>,
    pub response: &'a [f64],
    lead: usize,
    rows: Rows,
}

impl Part<'_> {
    pub fn rows_of(&self, signal: &[f64], out: &mut Vec<f64>) {
        self.rows.extend(&signal[self.lead..], out);
    }

    pub fn error(&self, linear: &Linear) -> f64 {
        let mut rows = Vec::new();
        self.rows_of(&linear.residual(&self.drives, self.response), &mut rows);
        dot(&rows, &rows)
    }
}

impl Linear {
    pub fn residual(&self, drives: &[&[f64]], response: &[f64]) -> Vec<f64> {
        let mut left = response.to_vec();
        for (d, drive) in drives.iter().enumerate() {
            let y = self.modes.filter(&self.input[d], drive);
            for ((left, y), u) in left.iter_mut().zip(&y).zip(*drive) {
                *left -= y + self.direct[d] * u;
            }
        }
        left
    }
}

/// A model of at most this order: relocated, freed of endless modes, refined.
fn fitted(parts: &[Part<'_>], order: usize, band: [f64; 2]) -> Linear {
    refine(parts, settled(parts, order, band))
}

/// The same before it is refined.
fn settled(parts: &[Part<'_>], order: usize, band: [f64; 2]) -> Linear {
    let linear = relocate(parts, order, band);
    let Some(modes) = lasting(parts, &linear.modes) else { return linear };
    let target = rows(parts, |part| vec![part.response.to_vec()]).remove(0);
    paths(parts, &modes, &target)
}

/// The modes without those that ring for longer than they were watched, which are noise with a name;
/// `None` where there are none such.
fn lasting(parts: &[Part<'_>], modes: &Modes) -> Option<Modes> {
    let longest = parts.iter().map(|part| part.response.len()).max().unwrap_or(0);
    let kept = modes.only(|pole| pole.ring_down(0.05) <= longest);
    (kept.order() < modes.order()).then_some(kept)
}

/// Poles by Steiglitz and McBride's iteration, then the paths with those poles; of all rounds the
/// one with the smallest error.
fn relocate(parts: &[Part<'_>], order: usize, band: [f64; 2]) -> Linear {
    let target = rows(parts, |part| vec![part.response.to_vec()]).remove(0);
    let mut modes = spread(order, band);
    let mut best: Option<(f64, Linear)> = None;
    let mut inputs = input_columns(parts, &modes);
    for _ in 0..ROUNDS {
        let outputs = rows(parts, |part| modes.basis(part.response));
        let mut columns: Vec<&[f64]> = inputs.iter().map(Vec::as_slice).collect();
        columns.extend(outputs.iter().map(Vec::as_slice));
        let solution = least_squares(&columns, &target);
        let feedback: Vec<f64> = solution[inputs.len()..].to_vec();
        let Some(values) = eigenvalues(&modes.fed_back(&feedback)) else { break };
        let moved = Modes::of_values(&values);
        // Lost a pole to rounding: the pairing below would not be of this order.
        if moved.order() != order {
            break;
        }
        modes = moved;
        inputs = input_columns(parts, &modes);
        let linear = beside(&inputs, &modes, &target);
        let error: f64 = parts.iter().map(|part| part.error(&linear)).sum();
        let better = best.as_ref().is_none_or(|(least, _)| error < *least);
        let settled = best.as_ref().is_some_and(|(least, _)| (error / least - 1.0).abs() < 1e-7);
        if better {
            best = Some((error, linear));
        }
        if settled {
            break;
        }
    }
    best.map_or_else(|| paths(parts, &spread(order, band), &target), |(_, linear)| linear)
}

/// `D_d` and `B_d` for given poles by linear least squares.
fn paths(parts: &[Part<'_>], modes: &Modes, target: &[f64]) -> Linear {
    beside(&input_columns(parts, modes), modes, target)
}

/// The same by what the modes make of the drives.
fn beside(inputs: &[Vec<f64>], modes: &Modes, target: &[f64]) -> Linear {
    let columns: Vec<&[f64]> = inputs.iter().map(Vec::as_slice).collect();
    let solution = least_squares(&columns, target);
    let per_drive = modes.order() + 1;
    Linear {
        modes: modes.clone(),
        direct: solution.chunks(per_drive).map(|c| c[0]).collect(),
        input: solution.chunks(per_drive).map(|c| c[1..].to_vec()).collect(),
    }
}

/// Per drive its own rows, then those of each state's output.
fn input_columns(parts: &[Part<'_>], modes: &Modes) -> Vec<Vec<f64>> {
    rows(parts, |part| {
        part.drives
            .iter()
            .flat_map(|drive| std::iter::once(drive.to_vec()).chain(modes.basis(drive)))
            .collect()
    })
}

/// Rows of several signals of each part, `[signal][row]`.
fn rows(parts: &[Part<'_>], signals: impl Fn(&Part<'_>) -> Vec<Vec<f64>>) -> Vec<Vec<f64>> {
    let mut out: Vec<Vec<f64>> = Vec::new();
    for part in parts {
        let signals = signals(part);
        out.resize(signals.len(), Vec::new());
        for (out, signal) in out.iter_mut().zip(&signals) {
            part.rows_of(signal, out);
        }
    }
    out
}

/// Start: lightly damped pairs spread over the band by the logarithm of frequency, and for an odd
/// order one real pole in its middle.
fn spread(order: usize, band: [f64; 2]) -> Modes {
    let (low, high) = (band[0].max(0.03 * band[1]), 0.9 * band[1]);
    let pairs = order / 2;
    let mut values = Vec::new();
    for i in 0..pairs {
        let share = (i as f64 + 0.5) / pairs as f64;
        let w = std::f64::consts::TAU * low * (high / low).powf(share);
        let z = Complex64::from_polar((-0.03 * w).exp(), w);
        values.extend([z, z.conj()]);
    }
    if order % 2 == 1 {
        values.push(Complex64::new((-std::f64::consts::TAU * 0.5 * band[1]).exp(), 0.0));
    }
    Modes::of_values(&values)
}
