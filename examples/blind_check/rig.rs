//! Random rigs with one flaw, integrated with Runge and Kutta's fourth-order rule at sixteen steps
//! a sample. Shares nothing with the service.

use rand::{Rng, RngExt};

/// Steps of the integrator per sample.
const STEPS: usize = 16;
/// Samples a second.
pub const RATE: f64 = 512.0;
/// Most masses in a row.
const MASSES: usize = 3;

/// What is wrong with a rig; numbers are relative to the linear rig's own levels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Flaw {
    Nothing,
    Gain,
    Delay,
    ExtraPole,
    LinearChange { stiffness: f64, damping: f64 },
    CubicStiffness { bend: f64 },
    QuadraticStiffness,
    BumpStop { gap: f64 },
    OneSidedStop { gap: f64, side: f64 },
    Clearance { gap: f64 },
    Coulomb { smooth: f64 },
    Stribeck { smooth: f64, peak: f64, decay: f64 },
    BoucWen { yielding: f64, sharpness: f64 },
    QuadraticDamping,
    DriveSaturation { skew: f64 },
    DrivePolynomial { even: f64, odd: f64 },
    RateLimit,
    ValveFlow,
    DeadZone,
    Backlash,
    CrossLinear,
    CrossKinematic { mixed: f64 },
    StiffnessDrift,
    OffsetDrift,
    Offset,
    SensorGain,
    SensorSaturation { skew: f64 },
    SensorNonlinearity { even: f64, odd: f64 },
    Sandwich { odd: bool },
    // The same physics in another equation.
    Quintic,
    LuGre { smooth: f64 },
    TwoStageStop { gap: f64 },
    SoftSaturation,
    LeakingFlow { leak: f64 },
    // Outside the catalogue.
    Cogging { pitch: f64 },
    DropOuts,
    UnmeasuredForce,
    Parametric { hz: f64 },
    NegativeDamping { width: f64 },
    // Of the recording, not of the rig.
    RaisedNoise,
    Hum { hz: f64 },
    Quantisation,
}

/// A chain of masses with a second axis beside it.
#[derive(Debug, Clone)]
pub struct Rig {
    masses: usize,
    mass: [f64; MASSES],
    stiffness: [f64; MASSES],
    damping: [f64; MASSES],
    driven: usize,
    seen: usize,
    lag_hz: Option<f64>,
    held: bool,
    /// Corner of a second-order filter before the rig, of rigs that may be a sandwich.
    before_hz: Option<f64>,
    side_coupling: f64,
    /// RMS of the seen displacement, its velocity and its elastic force at full level.
    level: [f64; 3],
}

#[derive(Clone, Copy)]
struct State([f64; 2 * MASSES + 6]);

const LAG: usize = 2 * MASSES;
const HYSTERESIS: usize = LAG + 1;
const INNER: usize = HYSTERESIS + 1;
const POLE: usize = INNER + 2;
const TWIST: usize = POLE + 1;

impl Rig {
    /// Draws a rig; its levels are those of `drives`, `[drive][sample]`.
    pub fn draw(rng: &mut impl Rng, drives: &[Vec<f64>], flaw: Flaw) -> Self {
        let filtered = matches!(flaw, Flaw::Sandwich { .. });
        let masses = [1, 2, 2, 3][rng.random_range(0..4)];
        let lowest = rng.random_range(4.0..12.0);
        let mut rig = Self {
            masses,
            mass: [1.0; MASSES],
            stiffness: [0.0; MASSES],
            damping: [0.0; MASSES],
            driven: 0,
            seen: 0,
            lag_hz: rng.random_bool(0.5).then(|| rng.random_range(20.0..80.0)),
            held: rng.random_bool(0.5),
            before_hz: filtered.then(|| rng.random_range(6.0..20.0)),
            // Coupled already, a stronger coupling would be the second drive's gain.
            side_coupling: if flaw == Flaw::CrossLinear { 0.0 } else { rng.random_range(0.0..0.3) },
            level: [1.0; 3],
        };
        for i in 0..masses {
            rig.mass[i] = rng.random_range(0.4..1.6);
            let hz = lowest * if i == 0 { 1.3 } else { rng.random_range(1.0..2.5) };
            let w = std::f64::consts::TAU * hz;
            rig.stiffness[i] = rig.mass[i] * w * w;
            rig.damping[i] = 2.0 * rng.random_range(0.015..0.08) * rig.mass[i] * w;
        }
        rig.driven = rng.random_range(0..masses);
        rig.seen = if rng.random_bool(0.6) { rig.driven } else { rng.random_range(0..masses) };
        let (y, v) = rig.run(drives, Flaw::Nothing, 0.0, [0.0, 0.0]);
        rig.level = [rms(&y), rms(&v), rig.stiffness[rig.seen] * rms(&y)];
        rig
    }

    /// Seen displacement, in units of the linear rig's, for drives `[drive][sample]`; `time` is the
    /// programme's at the first sample and per sample.
    pub fn respond(&self, drives: &[Vec<f64>], flaw: Flaw, strength: f64, time: [f64; 2]) -> Vec<f64> {
        let (y, _) = self.run(drives, flaw, strength, time);
        let mut y: Vec<f64> = y.iter().map(|y| y / self.level[0]).collect();
        let s = strength;
        match flaw {
            Flaw::Offset => y.iter_mut().for_each(|y| *y += s),
            Flaw::OffsetDrift => {
                y.iter_mut().enumerate().for_each(|(k, y)| *y += s * (time[0] + time[1] * k as f64));
            }
            Flaw::SensorGain => y.iter_mut().for_each(|y| *y *= 1.0 + s),
            Flaw::SensorSaturation { skew } => {
                let limit = 3.5 / (1.0 + 4.0 * s);
                y.iter_mut().for_each(|y| *y = y.min(limit).max(-limit * skew));
            }
            Flaw::SensorNonlinearity { even, odd } => {
                y.iter_mut().for_each(|y| *y += s * (even * *y * *y + odd * *y * *y * *y));
            }
            Flaw::DropOuts => {
                let mut held = 0.0;
                for (k, y) in y.iter_mut().enumerate() {
                    let phase = (k as f64 * 0.61803 / 60.0 + time[0] * 977.0).fract();
                    if phase < 0.3 * s.min(3.0) {
                        *y = held;
                    }
                    held = *y;
                }
            }
            _ => {}
        }
        y
    }

    /// Displacement and velocity of the seen mass.
    fn run(&self, drives: &[Vec<f64>], flaw: Flaw, s: f64, time: [f64; 2]) -> (Vec<f64>, Vec<f64>) {
        let h = 1.0 / (RATE * STEPS as f64);
        let n = drives[0].len();
        let mut state = State([0.0; 2 * MASSES + 6]);
        let main = self.command(&drives[0], flaw, s);
        let (mut y, mut v) = (Vec::with_capacity(n), Vec::with_capacity(n));
        for k in 0..n {
            y.push(state.0[self.seen]);
            v.push(state.0[MASSES + self.seen]);
            let next = (k + 1).min(n - 1);
            let t0 = time[0] + time[1] * k as f64;
            for step in 0..STEPS {
                let at = |share: f64| {
                    let place = if self.held { 0.0 } else { (step as f64 + share) / STEPS as f64 };
                    let mix = |u: &[f64]| u[k] + place * (u[next] - u[k]);
                    let clock = t0 + time[1] * (step as f64 + share) / STEPS as f64;
                    let seconds = (k as f64 + (step as f64 + share) / STEPS as f64) / RATE;
                    [mix(&main), mix(&drives[1]), clock, seconds]
                };
                let (now, half, then) = (at(0.0), at(0.5), at(1.0));
                let a = self.derivative(&state, now, flaw, s);
                let b = self.derivative(&state.moved(&a, 0.5 * h), half, flaw, s);
                let c = self.derivative(&state.moved(&b, 0.5 * h), half, flaw, s);
                let d = self.derivative(&state.moved(&c, h), then, flaw, s);
                for i in 0..state.0.len() {
                    state.0[i] += h / 6.0 * (a.0[i] + 2.0 * b.0[i] + 2.0 * c.0[i] + d.0[i]);
                }
            }
        }
        (y, v)
    }

    /// The first drive after what is static or has a memory of samples.
    fn command(&self, drive: &[f64], flaw: Flaw, s: f64) -> Vec<f64> {
        match flaw {
            Flaw::Gain => drive.iter().map(|u| u * (1.0 + s)).collect(),
            Flaw::Delay => {
                let shift = 40.0 * s;
                (0..drive.len())
                    .map(|k| {
                        let at = (k as f64 - shift).max(0.0);
                        windowed_sinc(drive, at)
                    })
                    .collect()
            }
            Flaw::DriveSaturation { skew } => {
                let limit = 3.5 / (1.0 + 4.0 * s);
                drive.iter().map(|u| u.min(limit).max(-limit * skew)).collect()
            }
            Flaw::SoftSaturation => drive.iter().map(|u| (s * u).tanh() / s.max(1e-9)).collect(),
            Flaw::DrivePolynomial { even, odd } => {
                drive.iter().map(|u| u + s * (even * u * u + odd * u * u * u)).collect()
            }
            Flaw::RateLimit => {
                let limit = 0.9 / (1.0 + 6.0 * s);
                let mut w = 0.0;
                drive
                    .iter()
                    .map(|u| {
                        w += (u - w).max(-limit).min(limit);
                        w
                    })
                    .collect()
            }
            Flaw::DeadZone => drive.iter().map(|u| u.signum() * (u.abs() - s).max(0.0)).collect(),
            Flaw::Backlash => {
                let mut w = 0.0;
                drive
                    .iter()
                    .map(|u| {
                        if u - w > s {
                            w = u - s;
                        } else if w - u > s {
                            w = u + s;
                        }
                        w
                    })
                    .collect()
            }
            _ => drive.to_vec(),
        }
    }

    fn derivative(&self, state: &State, input: [f64; 4], flaw: Flaw, s: f64) -> State {
        let q = &state.0;
        let mut d = [0.0; 2 * MASSES + 6];
        let (x, v) = (|i: usize| q[i], |i: usize| q[MASSES + i]);
        let y = q[self.seen] / self.level[0];
        let yv = q[MASSES + self.seen] / self.level[1];
        let unit = self.level[2];
        let mut u = input[0];
        let tau = std::f64::consts::TAU;
        if flaw == Flaw::ExtraPole {
            let w = tau * 200.0 / (1.0 + 100.0 * s);
            d[POLE] = w * (u - q[POLE]);
            u = q[POLE];
        }
        if let Some(hz) = self.before_hz {
            let w = tau * hz;
            d[INNER] = q[INNER + 1];
            d[INNER + 1] = w * w * (u - q[INNER]) - 2.0 * 0.4 * w * q[INNER + 1];
            u = q[INNER];
            if let Flaw::Sandwich { odd } = flaw {
                u += if odd { -s * u.powi(3) / (1.0 + u * u) } else { s * u * u };
            }
        }
        match flaw {
            Flaw::ValveFlow => u *= (1.0 - (s * y * u.signum()).clamp(-3.0, 0.98)).sqrt(),
            Flaw::LeakingFlow { leak } => {
                u = u * (1.0 - (s * y * u.signum()).clamp(-3.0, 0.98)).sqrt() - leak * s * y;
            }
            _ => {}
        }
        if let Some(hz) = self.lag_hz {
            d[LAG] = tau * hz * (u - q[LAG]);
            u = q[LAG];
        }
        let x2 = input[1];
        let clock = input[2];
        let mut force = [0.0; MASSES];
        for i in 0..self.masses {
            let (xp, vp) = if i == 0 { (0.0, 0.0) } else { (x(i - 1), v(i - 1)) };
            let (mut k, mut c) = (self.stiffness[i], self.damping[i]);
            if let (true, Flaw::LinearChange { stiffness, damping }) = (i == self.seen, flaw) {
                k *= 1.0 + s * stiffness;
                c *= (1.0 + 2.0 * s * damping).max(0.2);
            }
            let f = k * (x(i) - xp) + c * (v(i) - vp);
            force[i] -= f;
            if i > 0 {
                force[i - 1] += f;
            }
        }
        force[self.driven] += self.stiffness[self.driven] * (u + self.side_coupling * input[1]);
        let extra = match flaw {
            Flaw::CubicStiffness { bend } => s * y.powi(3) / (1.0 + bend * y * y),
            Flaw::QuadraticStiffness => s * y * y,
            Flaw::BumpStop { gap } => 3.0 * s * (y.abs() - gap).max(0.0) * y.signum(),
            Flaw::OneSidedStop { gap, side } => 3.0 * s * side * (side * y - gap).max(0.0),
            Flaw::Clearance { gap } => -s * y.max(-gap).min(gap),
            Flaw::Coulomb { smooth } => s * yv / (yv * yv + smooth * smooth).sqrt(),
            Flaw::Stribeck { smooth, peak, decay } => {
                s * yv / (yv * yv + smooth * smooth).sqrt() * (1.0 + peak * (-yv.abs() / decay).exp())
            }
            Flaw::BoucWen { yielding, sharpness } => {
                let (z, rate) = (q[HYSTERESIS], q[MASSES + self.seen] / self.level[0] / yielding);
                d[HYSTERESIS] = rate
                    - 0.5 * rate.abs() * z * z.abs().powf(sharpness - 1.0)
                    - 0.5 * rate * z.abs().powf(sharpness);
                s * z
            }
            Flaw::LuGre { smooth } => {
                let rate = q[MASSES + self.seen] / self.level[0];
                let z = q[TWIST];
                let limit = smooth * (1.0 + 0.3 * (-(yv / 0.3).powi(2)).exp());
                d[TWIST] = rate - rate.abs() * z / limit;
                s * (z / smooth + 0.003 * d[TWIST] / smooth)
            }
            Flaw::QuadraticDamping => s * yv * yv.abs(),
            Flaw::CrossLinear => -s * input[1],
            Flaw::CrossKinematic { mixed } => s * (x2 * x2 + mixed * y * x2),
            Flaw::StiffnessDrift => s * clock * y,
            Flaw::Quintic => s * y.powi(5) / 5.0,
            Flaw::TwoStageStop { gap } => {
                3.0 * s * y.signum() * ((y.abs() - gap).max(0.0) + 2.0 * (y.abs() - 1.6 * gap).max(0.0))
            }
            Flaw::Cogging { pitch } => s * (tau * y / pitch).sin(),
            Flaw::UnmeasuredForce => {
                let t = input[3] + 1000.0 * clock;
                s * ((tau * 5.3 * t).sin() + (tau * 9.1 * t + 3.0 * (0.7 * t).sin()).sin())
            }
            Flaw::Parametric { hz } => s * (tau * hz * input[3]).sin() * y,
            Flaw::NegativeDamping { width } => -s * yv / (1.0 + (yv / width).powi(4)),
            _ => 0.0,
        };
        force[self.seen] -= unit * extra;
        for i in 0..self.masses {
            d[i] = v(i);
            d[MASSES + i] = force[i] / self.mass[i];
        }
        State(d)
    }
}

impl State {
    fn moved(&self, by: &State, h: f64) -> State {
        State(std::array::from_fn(|i| self.0[i] + h * by.0[i]))
    }
}

/// Band-limited value between samples.
fn windowed_sinc(x: &[f64], at: f64) -> f64 {
    let centre = at.floor() as isize;
    let mut sum = 0.0;
    for k in -15..=16 {
        let i = centre + k;
        let d = at - i as f64;
        let sinc =
            if d.abs() < 1e-12 { 1.0 } else { (std::f64::consts::PI * d).sin() / (std::f64::consts::PI * d) };
        let window = (0.5 * std::f64::consts::PI * d / 17.0).cos().powi(2);
        sum += sinc * window * x[i.clamp(0, x.len() as isize - 1) as usize];
    }
    sum
}

/// Root mean square.
pub fn rms(x: &[f64]) -> f64 {
    (x.iter().map(|x| x * x).sum::<f64>() / x.len().max(1) as f64).sqrt()
}
