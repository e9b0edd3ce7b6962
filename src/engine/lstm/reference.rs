//! A slow and simple `f64` implementation of the network, the reference in the tests of the kernels.

use super::net::LstmNet;
use super::params::{GATES, Shape, flatten};
use super::settings::Recombine;
use crate::windowing::welch10;

/// `[step][channel]`.
pub(super) type Steps = Vec<Vec<f64>>;

/// A network with `f64` weights in the order of [`flatten`].
pub(super) struct Twin {
    pub shape: Shape,
    pub row: Vec<f64>,
}

/// The values of one block in one step.
#[derive(Clone)]
struct Step {
    /// `[x, 1, h before]`.
    z: Vec<f64>,
    /// Gates i, f, g, o of each cell.
    gates: Vec<[f64; GATES]>,
    /// Cell states before and after.
    c_before: Vec<f64>,
    c: Vec<f64>,
    h: Vec<f64>,
}

fn sigmoid(a: f64) -> f64 {
    1.0 / (1.0 + (-a).exp())
}

impl Twin {
    pub(super) fn of(net: &LstmNet) -> Self {
        Self { shape: Shape::of(net), row: flatten(net).into_iter().map(f64::from).collect() }
    }

    /// All blocks from a zero state: `[block][step]`.
    fn steps(&self, x: &[Vec<f64>]) -> Vec<Vec<Step>> {
        let mut below: Vec<Vec<f64>> = x.to_vec();
        let mut all = Vec::new();
        for block in &self.shape.blocks {
            let (mut h, mut c) = (vec![0.0; block.cells], vec![0.0; block.cells]);
            let mut steps = Vec::new();
            for x in &below {
                let z: Vec<f64> = x.iter().copied().chain([1.0]).chain(h.iter().copied()).collect();
                let c_before = c.clone();
                let mut gates = Vec::new();
                for cell in 0..block.cells {
                    let mut a = [0.0; GATES];
                    for (gate, a) in a.iter_mut().enumerate() {
                        let at = block.at + (GATES * cell + gate) * block.columns();
                        *a = z.iter().zip(&self.row[at..]).map(|(z, w)| z * w).sum();
                    }
                    let gate = [sigmoid(a[0]), sigmoid(a[1]), a[2].tanh(), sigmoid(a[3])];
                    c[cell] = gate[1] * c[cell] + gate[0] * gate[2];
                    h[cell] = gate[3] * c[cell].tanh();
                    gates.push(gate);
                }
                steps.push(Step { z, gates, c_before, c: c.clone(), h: h.clone() });
            }
            below = steps.iter().map(|s| s.h.clone()).collect();
            all.push(steps);
        }
        all
    }

    fn connect(&self, h: &[f64]) -> Vec<f64> {
        let fc = self.row[self.shape.fc_at()..].chunks_exact(self.shape.fc_columns());
        fc.map(|w| w[0] + w[1..].iter().zip(h).map(|(w, h)| w * h).sum::<f64>()).collect()
    }

    /// `[step][input]` to `[step][output]`.
    pub(super) fn forward(&self, x: &[Vec<f64>]) -> Vec<Vec<f64>> {
        let steps = self.steps(x);
        steps[steps.len() - 1].iter().map(|s| self.connect(&s.h)).collect()
    }

    /// Sum of squared errors from step `burn_in` on, over several windows `([step][input],
    /// [step][output])`, and its gradient with respect to the row of weights.
    pub(super) fn squared_error(&self, windows: &[(Steps, Steps)], burn_in: usize) -> (f64, Vec<f64>) {
        let (mut loss, mut gradient) = (0.0, vec![0.0; self.row.len()]);
        for (x, y) in windows {
            let steps = self.steps(x);
            let last = &steps[steps.len() - 1];
            // Error of the block's h that comes from the block above, [step][cell].
            let cells = self.shape.last().cells;
            let mut from_above = vec![vec![0.0; cells]; x.len()];
            for t in burn_in..x.len() {
                for (o, (found, wanted)) in self.connect(&last[t].h).iter().zip(&y[t]).enumerate() {
                    let e = found - wanted;
                    loss += e * e;
                    let at = self.shape.fc_at() + o * self.shape.fc_columns();
                    gradient[at] += 2.0 * e;
                    for cell in 0..cells {
                        gradient[at + 1 + cell] += 2.0 * e * last[t].h[cell];
                        from_above[t][cell] += 2.0 * e * self.row[at + 1 + cell];
                    }
                }
            }
            for (block, steps) in self.shape.blocks.iter().zip(&steps).rev() {
                let mut dh_next = vec![0.0; block.cells];
                let mut dc_next = vec![0.0; block.cells];
                let mut below = vec![vec![0.0; block.inputs]; x.len()];
                for t in (0..x.len()).rev() {
                    let step = &steps[t];
                    let mut dz = vec![0.0; block.columns()];
                    for cell in 0..block.cells {
                        let dh = from_above[t][cell] + dh_next[cell];
                        let [i, f, g, o] = step.gates[cell];
                        let tc = step.c[cell].tanh();
                        let dc = dc_next[cell] + dh * o * (1.0 - tc * tc);
                        let d = [
                            dc * g * i * (1.0 - i),
                            dc * step.c_before[cell] * f * (1.0 - f),
                            dc * i * (1.0 - g * g),
                            dh * tc * o * (1.0 - o),
                        ];
                        dc_next[cell] = dc * f;
                        for (gate, d) in d.into_iter().enumerate() {
                            let at = block.at + (GATES * cell + gate) * block.columns();
                            for k in 0..block.columns() {
                                gradient[at + k] += d * step.z[k];
                                dz[k] += d * self.row[at + k];
                            }
                        }
                    }
                    below[t].copy_from_slice(&dz[..block.inputs]);
                    dh_next.copy_from_slice(&dz[block.inputs + 1..]);
                }
                from_above = below;
            }
        }
        (loss, gradient)
    }

    /// A whole planar signal, straight from the definitions in section 2.2.2.
    pub(super) fn predict(
        &self,
        x: &[Vec<f32>],
        len: usize,
        hop: usize,
        recombine: Recombine,
    ) -> Vec<Vec<f64>> {
        let n = x[0].len() as isize;
        let at =
            |s: isize| -> Vec<f64> { x.iter().map(|x| f64::from(x[s.clamp(0, n - 1) as usize])).collect() };
        let mut y = vec![vec![0.0; n as usize]; self.shape.outputs];
        match recombine {
            Recombine::Stream => {
                let pre_roll = 2 * len as isize;
                let out = self.forward(&(-pre_roll..n).map(at).collect::<Vec<_>>());
                for (s, out) in out[pre_roll as usize..].iter().enumerate() {
                    y.iter_mut().zip(out).for_each(|(y, &out)| y[s] = out);
                }
            }
            Recombine::Welch => {
                let mut sum = vec![0.0; n as usize];
                let regular = (0..n + len as isize).step_by(hop);
                for start in std::iter::once(-((len / 2) as isize)).chain(regular) {
                    let out = self.forward(&(start..start + len as isize).map(at).collect::<Vec<_>>());
                    for (t, out) in out.iter().enumerate() {
                        let s = start + t as isize;
                        if (0..n).contains(&s) {
                            let w = welch10(t, len);
                            sum[s as usize] += w;
                            y.iter_mut().zip(out).for_each(|(y, out)| y[s as usize] += w * out);
                        }
                    }
                }
                for y in &mut y {
                    y.iter_mut().zip(&sum).for_each(|(y, sum)| *y /= sum);
                }
            }
        }
        y
    }
}

mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use super::super::samples;
    use super::*;

    #[test]
    fn the_twins_gradient_equals_central_differences() {
        for (inputs, blocks, outputs) in [(2, &[5][..], 3), (3, &[4, 3], 2)] {
            let mut rng = ChaCha8Rng::seed_from_u64(5);
            let mut twin = Twin::of(&LstmNet::init(inputs, blocks, outputs, 1.0, &mut rng));
            let planar = |n, seed| samples::noise(n, 20, seed);
            let steps = |x: Vec<Vec<f32>>| -> Vec<Vec<f64>> {
                (0..20).map(|t| x.iter().map(|x| f64::from(x[t])).collect()).collect()
            };
            let windows: Vec<_> =
                (0..3).map(|w| (steps(planar(inputs, w)), steps(planar(outputs, 10 + w)))).collect();
            let (_, gradient) = twin.squared_error(&windows, 5);
            let largest = gradient.iter().fold(0.0_f64, |m, g| m.max(g.abs()));
            for (k, gradient) in gradient.iter().enumerate() {
                let (w, h) = (twin.row[k], 1e-4);
                // Fourth-order central difference: rounding and truncation both stay below 1e-9.
                let mut at = |d: f64| {
                    twin.row[k] = w + d;
                    twin.squared_error(&windows, 5).0
                };
                let slope = (8.0 * (at(h) - at(-h)) - (at(2.0 * h) - at(-2.0 * h))) / (12.0 * h);
                twin.row[k] = w;
                let error = (slope - gradient).abs() / gradient.abs().max(1e-3 * largest);
                assert!(error < 1e-6, "{blocks:?} weight {k}: {slope} {gradient}");
            }
        }
    }
}
