//! The linear response to a drive over short windows: its mean and levels at each output.
//!
//! A line of a window costs as many complex products as the FRF has paths. Eight outputs go side by side, and several
//! windows share each reading of the FRF; every sum keeps the order of one line after another, one input after another.

use realfft::num_complex::Complex64;

use super::short_time::WindowOfInputs;
use crate::frf::Frf;
use crate::model::RigModel;
use crate::simd::{Isa, Kernel, Simd, dispatch};

/// Lines that hold a tone in a Hann window.
const TONE_LINES: usize = 3;

/// First line of a tone: below, a drive that passes from one mean to the next within a window has power too.
const TONE_FROM: usize = 5;

/// Outputs side by side.
const LANES: usize = 8;

/// Windows whose sums stay in registers.
const IN_REGISTERS: usize = 2;

/// Mean, RMS about it, RMS of the rate and largest RMS of the rate of a tone, of an output.
pub(super) type Level = [f64; 4];

/// Real and imaginary parts of some outputs; beyond the last output zero.
type Outputs = [[f64; LANES]; 2];

/// Sums of the squares of the lines of some outputs.
#[derive(Debug, Clone, Copy, Default)]
struct Sums {
    power: [f64; LANES],
    rate: [f64; LANES],
    /// The largest of the rates of adjacent lines.
    tone: [f64; LANES],
    /// The squares of the last lines' rates, of those of a tone.
    last: [[f64; LANES]; TONE_LINES],
}

impl Sums {
    /// Adds a line at the square of an angular frequency.
    #[inline(always)]
    fn add(&mut self, line: usize, squares: &[f64; LANES], omega_squared: f64) {
        for (o, square) in squares.iter().enumerate() {
            self.power[o] += square;
            self.rate[o] += omega_squared * square;
        }
        if line < TONE_FROM {
            return;
        }
        self.last.rotate_left(1);
        self.last[TONE_LINES - 1] = squares.map(|square| omega_squared * square);
        for o in 0..LANES {
            let tone: f64 = self.last.iter().map(|squares| squares[o]).sum();
            self.tone[o] = self.tone[o].max(tone);
        }
    }
}

/// An FRF on the lines of windows.
#[derive(Clone)]
pub(super) struct LinearLevels {
    isa: Isa,
    n_inputs: usize,
    n_outputs: usize,
    /// The lines, those on which it is zero left out.
    lines: std::ops::Range<usize>,
    /// `[outputs, line, input]`; none hands each input on.
    h: Option<Vec<Outputs>>,
    /// At rest, `[output, input]`.
    gain: Vec<f64>,
    x_mean: Vec<f64>,
    y_mean: Vec<f64>,
    /// Distance of lines, rad/s.
    step: f64,
}

impl LinearLevels {
    /// That of a model over windows of so many samples: of its FRF, or of an FRF of one that hands each input on.
    pub fn new(model: &RigModel, window: usize) -> Self {
        match &model.frf {
            Some(frf) => Self::of_frf(frf, window),
            None => Self::of_inputs(model.inputs.len(), model.sample_rate_hz, window),
        }
    }

    fn of_inputs(n: usize, sample_rate_hz: f64, window: usize) -> Self {
        Self {
            isa: Isa::of_plain_loops(),
            n_inputs: n,
            n_outputs: n,
            lines: 1..window / 2 + 1,
            h: None,
            gain: (0..n * n).map(|place| if place / n == place % n { 1.0 } else { 0.0 }).collect(),
            x_mean: vec![0.0; n],
            y_mean: vec![0.0; n],
            step: std::f64::consts::TAU * sample_rate_hz / window as f64,
        }
    }

    fn of_frf(frf: &Frf, window: usize) -> Self {
        let df = frf.sample_rate_hz / window as f64;
        let at = |hz: f64, output: usize, input: usize| {
            let place = hz / frf.df_hz();
            let line = (place.floor() as usize).min(frf.n_lines() - 1);
            let share = place - line as f64;
            let next = (line + 1).min(frf.n_lines() - 1);
            frf.at(line, output, input) * (1.0 - share) + frf.at(next, output, input) * share
        };
        let [from, to] = frf.usable_hz;
        let first = ((from / df).floor() as usize).max(1);
        let last = ((to / df).ceil() as usize).min(window / 2);
        let mut h = Vec::with_capacity(frf.n_outputs.div_ceil(LANES) * (last + 1 - first) * frf.n_inputs);
        for outputs in (0..frf.n_outputs).step_by(LANES) {
            for line in first..=last {
                for input in 0..frf.n_inputs {
                    let mut side_by_side = [[0.0; LANES]; 2];
                    for output in outputs..(outputs + LANES).min(frf.n_outputs) {
                        let h = at(line as f64 * df, output, input);
                        side_by_side[0][output - outputs] = h.re;
                        side_by_side[1][output - outputs] = h.im;
                    }
                    h.push(side_by_side);
                }
            }
        }
        let pairs = (0..frf.n_outputs).flat_map(|o| (0..frf.n_inputs).map(move |i| (o, i)));
        Self {
            isa: Isa::of_plain_loops(),
            n_inputs: frf.n_inputs,
            n_outputs: frf.n_outputs,
            lines: first..last + 1,
            h: Some(h),
            gain: pairs.map(|(o, i)| frf.at(0, o, i).re).collect(),
            x_mean: frf.x_mean.clone(),
            y_mean: frf.y_mean.clone(),
            step: std::f64::consts::TAU * df,
        }
    }

    /// The levels of all outputs over each of some windows.
    pub fn of(&self, windows: &[WindowOfInputs<'_>]) -> Vec<Vec<Level>> {
        // [outputs, window]
        let mut sums = vec![Sums::default(); self.n_outputs.div_ceil(LANES) * windows.len()];
        let omega_squared: Vec<f64> =
            self.lines.clone().map(|line| (self.step * line as f64).powi(2)).collect();
        match &self.h {
            Some(h) => dispatch(
                self.isa,
                AddLines { of: self, h, windows, omega_squared: &omega_squared, sums: &mut sums },
            ),
            None => self.add_inputs(windows, &omega_squared, &mut sums),
        }
        let of_window = |(place, window): (usize, &WindowOfInputs<'_>)| {
            let level = |output: usize| {
                let (sums, lane) = (&sums[output / LANES * windows.len() + place], output % LANES);
                let rms = |squares: &[f64; LANES]| window.mean_square(squares[lane]).sqrt();
                [self.mean(window, output), rms(&sums.power), rms(&sums.rate), rms(&sums.tone)]
            };
            (0..self.n_outputs).map(level).collect()
        };
        windows.iter().enumerate().map(of_window).collect()
    }

    /// Adds the lines of the inputs themselves.
    fn add_inputs(&self, windows: &[WindowOfInputs<'_>], omega_squared: &[f64], sums: &mut [Sums]) {
        for (outputs, sums) in (0..).step_by(LANES).zip(sums.chunks_mut(windows.len().max(1))) {
            for (window, sums) in windows.iter().zip(sums) {
                let inputs = &window.lines[outputs..(outputs + LANES).min(self.n_inputs)];
                for (line, omega_squared) in self.lines.clone().zip(omega_squared) {
                    let mut squares = [0.0; LANES];
                    for (square, lines) in squares.iter_mut().zip(inputs) {
                        *square = lines[line].norm_sqr();
                    }
                    sums.add(line, &squares, *omega_squared);
                }
            }
        }
    }

    fn mean(&self, window: &WindowOfInputs<'_>, output: usize) -> f64 {
        let gain = &self.gain[output * self.n_inputs..(output + 1) * self.n_inputs];
        let moved =
            gain.iter().zip(window.means.iter().zip(&self.x_mean)).map(|(g, (x, mean))| g * (x - mean));
        self.y_mean[output] + moved.sum::<f64>()
    }
}

/// Adds all lines of all windows to the sums; bit-identical on every instruction set.
struct AddLines<'a> {
    of: &'a LinearLevels,
    h: &'a [Outputs],
    windows: &'a [WindowOfInputs<'a>],
    omega_squared: &'a [f64],
    /// `[outputs, window]`
    sums: &'a mut [Sums],
}

impl Kernel for AddLines<'_> {
    type Out = ();
    const WIDE: bool = false;

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let Self { of: LinearLevels { n_inputs, lines, .. }, h, windows, omega_squared, sums } = self;
        let mut of_line = h.chunks_exact(*n_inputs);
        for sums in sums.chunks_exact_mut(windows.len()) {
            for (line, omega_squared) in lines.clone().zip(omega_squared) {
                let Some(h) = of_line.next() else { return };
                let groups = windows.chunks(IN_REGISTERS).zip(sums.chunks_mut(IN_REGISTERS));
                for (windows, sums) in groups {
                    // Of an odd number the last window is computed twice, and counts once.
                    let of_inputs: [&[Vec<Complex64>]; IN_REGISTERS] =
                        std::array::from_fn(|w| windows[w.min(windows.len() - 1)].lines);
                    let squares = squares(h, of_inputs, line);
                    for (sums, squares) in sums.iter_mut().zip(&squares) {
                        sums.add(line, squares, *omega_squared);
                    }
                }
            }
        }
    }
}

/// `|sum_i h_i x_i|^2` on one line, for some outputs and windows.
#[inline(always)]
fn squares(
    h: &[Outputs],
    windows: [&[Vec<Complex64>]; IN_REGISTERS],
    line: usize,
) -> [[f64; LANES]; IN_REGISTERS] {
    let mut y = [[[0.0; LANES]; 2]; IN_REGISTERS];
    for (i, [re, im]) in h.iter().enumerate() {
        for (y, inputs) in y.iter_mut().zip(&windows) {
            let x = inputs[i][line];
            for o in 0..LANES {
                y[0][o] += re[o] * x.re - im[o] * x.im;
                y[1][o] += re[o] * x.im + im[o] * x.re;
            }
        }
    }
    y.map(|[re, im]| std::array::from_fn(|o| re[o] * re[o] + im[o] * im[o]))
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::model::trust::short_time::ShortTime;

    const WINDOW: usize = 256;

    fn frf(n_outputs: usize, n_inputs: usize, usable_hz: [f64; 2]) -> Frf {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let mut one = || rng.random_range(-1.0..1.0);
        let segment_len = 200;
        let n = (segment_len / 2 + 1) * n_outputs * n_inputs;
        Frf {
            sample_rate_hz: 1000.0,
            segment_len,
            n_inputs,
            n_outputs,
            h: (0..n).map(|_| Complex64::new(one(), one())).collect(),
            usable_hz,
            x_mean: (0..n_inputs).map(|_| one()).collect(),
            y_mean: (0..n_outputs).map(|_| one()).collect(),
        }
    }

    fn drive(n_inputs: usize, n: usize) -> Vec<Vec<f64>> {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        (0..n_inputs).map(|_| (0..n).map(|_| rng.random_range(-1.0..1.0)).collect()).collect()
    }

    /// One output after another, one line after another, one input after another.
    fn one_by_one(levels: &LinearLevels, frf: Option<&Frf>, window: &WindowOfInputs<'_>) -> Vec<Level> {
        let df = 1000.0 / WINDOW as f64;
        let at = |line: usize, output: usize, input: usize| match frf {
            None => Complex64::from(if output == input { 1.0 } else { 0.0 }),
            Some(frf) => {
                let place = line as f64 * df / frf.df_hz();
                let from = (place.floor() as usize).min(frf.n_lines() - 1);
                let (share, next) = (place - from as f64, (from + 1).min(frf.n_lines() - 1));
                frf.at(from, output, input) * (1.0 - share) + frf.at(next, output, input) * share
            }
        };
        let of_output = |output: usize| {
            let (mut power, mut rate, mut tone, mut last) = (0.0, 0.0, 0.0_f64, [0.0; TONE_LINES]);
            for line in levels.lines.clone() {
                let products = (0..levels.n_inputs).map(|i| at(line, output, i) * window.lines[i][line]);
                let square = products.sum::<Complex64>().norm_sqr();
                power += square;
                let of_rate = (levels.step * line as f64).powi(2) * square;
                rate += of_rate;
                if line >= TONE_FROM {
                    last.rotate_left(1);
                    last[TONE_LINES - 1] = of_rate;
                    tone = tone.max(last.iter().sum());
                }
            }
            let rms = |squares| window.mean_square(squares).sqrt();
            [levels.mean(window, output), rms(power), rms(rate), rms(tone)]
        };
        (0..levels.n_outputs).map(of_output).collect()
    }

    #[test]
    fn levels_side_by_side_are_bit_equal_to_those_one_by_one() {
        let fft = ShortTime::new(WINDOW);
        for (outputs, inputs, samples) in [(1, 1, 300), (6, 3, 4000), (9, 5, 2500), (32, 17, 2000)] {
            let frf = frf(outputs, inputs, [30.0, 410.0]);
            let x = drive(inputs, samples);
            let x: Vec<&[f64]> = x.iter().map(Vec::as_slice).collect();
            let of_frf = LinearLevels::of_frf(&frf, WINDOW);
            assert!(of_frf.lines.start > 5 && of_frf.lines.end < WINDOW / 2, "{:?}", of_frf.lines);
            let of_inputs = LinearLevels::of_inputs(inputs, 1000.0, WINDOW);
            for isa in Isa::ALL.into_iter().filter(|isa| isa.is_available()) {
                for (levels, frf) in [(of_frf.clone(), Some(&frf)), (of_inputs.clone(), None)] {
                    let levels = LinearLevels { isa, ..levels };
                    let found = fft.each_batch(&x, |windows| levels.of(windows));
                    let expected = fft.each(&x, |window| one_by_one(&levels, frf, window));
                    assert_eq!(found, expected, "{outputs} x {inputs} on {}", isa.name());
                }
            }
        }
    }
}
