//! The bench at rest under a constant drive.

use super::plant::{Plant, State, Vec3, dot, row};

/// Relative step below which an iteration has converged; far below any sensor, far above rounding.
const TOLERANCE: f64 = 1e-13;

impl Plant {
    /// State in which every derivative is zero under the constant drive `command` (N), friction at zero
    /// force (the middle of its hysteresis).
    ///
    /// `None` when the iterations do not settle, which takes forces far beyond the bench's.
    pub fn equilibrium(&self, command: &Vec3) -> Option<State> {
        // At rest nothing accelerates and integral action leaves no error: each strut carries its command.
        let mut q = [0.0; 3];
        let mut settled = false;
        for _ in 0..200 {
            let struts = self.struts(&q);
            let load: Vec3 = std::array::from_fn(|j| {
                (0..3).map(|i| command[i] * struts[i][j]).sum::<f64>() + self.preload[j]
            });
            let along_mount = self.mount_components(&load);
            let mut d = [0.0; 3];
            for k in 0..3 {
                d[k] = self.static_travel(k, along_mount[k])?;
            }
            let next: Vec3 = std::array::from_fn(|i| dot(&self.rotation[i], &d));
            let step = (0..3).map(|i| (next[i] - q[i]).abs()).fold(0.0, f64::max);
            q = next;
            if step <= TOLERANCE * 1e-2 {
                settled = true;
                break;
            }
        }
        if !settled {
            return None;
        }
        let mut state = State::ZERO;
        let d = self.mount_components(&q);
        for i in 0..3 {
            let pressure = command[i] / self.area[i];
            let drop = 1.0 - self.pressure_sensitivity * pressure.abs();
            if drop <= 0.0 {
                return None;
            }
            let opening = self.leakage[i] * pressure / (self.full_flow[i] * drop.sqrt());
            state.0[row::Q][i] = q[i];
            state.0[row::P][i] = pressure;
            state.0[row::SPOOL][i] = opening;
            state.0[row::INTEGRAL][i] = opening;
            state.0[row::OIL][i] = self.bulge[i] * d[i] / (self.bulge[i] + self.bellows[i]);
        }
        Some(state)
    }

    /// Static stiffness of one mount direction without stops, N/m.
    fn static_stiffness(&self, direction: usize) -> f64 {
        let (bulge, bellows) = (self.bulge[direction], self.bellows[direction]);
        self.stiffness[direction] + bulge * bellows / (bulge + bellows)
    }

    /// Travel (m) of one mount direction under `load` (N).
    ///
    /// Newton's method from the travel without stops: it lies beyond the true one, and from there a
    /// rising curve that bends away from zero is descended without overshoot.
    fn static_travel(&self, direction: usize, load: f64) -> Option<f64> {
        let linear = self.static_stiffness(direction);
        let mut d = load / linear;
        for _ in 0..100 {
            let step_width = 1e-9;
            let excess = linear * d + self.stop_force(direction, d) - load;
            let slope = linear
                + (self.stop_force(direction, d + step_width) - self.stop_force(direction, d - step_width))
                    / (2.0 * step_width);
            let step = excess / slope;
            d -= step;
            if step.abs() <= TOLERANCE * (1e-3 + d.abs()) {
                return Some(d);
            }
        }
        None
    }
}
