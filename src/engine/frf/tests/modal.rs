//! A linear system whose FRF is known in closed form: modes in parallel, each a second-order
//! recursion (impulse invariance), so that simulation and FRF are exact in discrete time.

use realfft::num_complex::Complex64;

pub struct Mode {
    pub hz: f64,
    pub damping: f64,
    /// Mode shape at the outputs, its static gain included.
    pub outputs: Vec<f64>,
    /// Mode shape at the inputs.
    pub inputs: Vec<f64>,
}

pub struct Modal {
    pub fs: f64,
    pub modes: Vec<Mode>,
}

impl Modal {
    /// Three well damped modes, three inputs, two outputs, 200 Hz.
    pub fn bench() -> Self {
        let mode = |hz, damping, outputs: [f64; 2], inputs: [f64; 3]| Mode {
            hz,
            damping,
            outputs: outputs.to_vec(),
            inputs: inputs.to_vec(),
        };
        Self {
            fs: 200.0,
            modes: vec![
                mode(7.0, 0.12, [1.0, 0.4], [1.0, 0.3, -0.2]),
                mode(16.0, 0.1, [-0.5, 0.8], [0.2, 1.0, 0.4]),
                mode(33.0, 0.08, [0.3, 0.3], [-0.4, 0.3, 1.0]),
            ],
        }
    }

    /// Recursion coefficients `y[n] = b x[n-1] - a1 y[n-1] - a2 y[n-2]`, static gain 1.
    fn recursion(&self, mode: &Mode) -> (f64, f64, f64) {
        let w = std::f64::consts::TAU * mode.hz / self.fs;
        let radius = (-mode.damping * w).exp();
        let angle = w * (1.0 - mode.damping * mode.damping).sqrt();
        let (a1, a2) = (-2.0 * radius * angle.cos(), radius * radius);
        (1.0 + a1 + a2, a1, a2)
    }

    /// Response from rest, `[output][sample]`.
    pub fn simulate(&self, x: &[Vec<f64>]) -> Vec<Vec<f64>> {
        let n = x[0].len();
        let mut y = vec![vec![0.0; n]; self.modes[0].outputs.len()];
        for mode in &self.modes {
            let (b, a1, a2) = self.recursion(mode);
            let force = |t: usize| -> f64 { mode.inputs.iter().zip(x).map(|(g, x)| g * x[t]).sum() };
            let (mut q1, mut q2) = (0.0, 0.0);
            for t in 0..n {
                let q = b * if t > 0 { force(t - 1) } else { 0.0 } - a1 * q1 - a2 * q2;
                (q2, q1) = (q1, q);
                for (y, g) in y.iter_mut().zip(&mode.outputs) {
                    y[t] += g * q;
                }
            }
        }
        y
    }

    /// `H[output, input]` at a frequency.
    pub fn frf(&self, hz: f64, output: usize, input: usize) -> Complex64 {
        let delay = Complex64::from_polar(1.0, -std::f64::consts::TAU * hz / self.fs);
        self.modes
            .iter()
            .map(|mode| {
                let (b, a1, a2) = self.recursion(mode);
                let shape = mode.outputs[output] * mode.inputs[input];
                shape * b * delay / (1.0 + a1 * delay + a2 * delay * delay)
            })
            .sum()
    }
}
