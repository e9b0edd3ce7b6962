//! Random rigs with flaws: chains of masses, one per axis, integrated by the fourth-order Runge-Kutta method
//! with sixteen steps per sample. Shares no code with the service.

use rand::{Rng, RngExt};

use super::axis::{Axis, MASSES, STATES, actuator};
use super::flaw::{Flaw, Placed};
use super::force::{Moment, changed, law};
use super::runge_kutta;

/// Steps of the integrator per sample of what is recorded.
pub const FINE: usize = 16;
/// Steps that suffice to find a strength.
pub const COARSE: usize = 8;
/// Samples a second.
pub const RATE: f64 = 512.0;
/// Axes side by side. With one axis a second drive acts beside it.
#[derive(Debug, Clone)]
pub struct Rig {
    axes: Vec<Axis>,
    held: bool,
    /// Stiffness between the seen masses of neighbouring axes, relative to theirs.
    link: f64,
}

/// A stretch of time: drives `[drive][sample]`, the programme's time at the first sample and per
/// sample, steps of the integrator per sample.
#[derive(Clone, Copy)]
pub struct Span<'a> {
    pub drives: &'a [Vec<f64>],
    pub time: [f64; 2],
    pub steps: usize,
}

/// Displacement, velocity and force of each axis' seen mass, `[axis][sample]`.
struct Motion {
    y: Vec<Vec<f64>>,
    v: Vec<Vec<f64>>,
    f: Vec<Vec<f64>>,
}

impl Rig {
    /// Draws a rig of `axes` axes, scaled to the levels of `drives`, `[drive][sample]`; `flaws` are those that
    /// it must be able to have.
    pub fn draw(rng: &mut impl Rng, axes: usize, drives: &[Vec<f64>], flaws: &[Flaw]) -> Self {
        let special = |f: &&Flaw| matches!(f, Flaw::Sandwich { .. } | Flaw::CrossLinear);
        let flaw = flaws.iter().find(special).copied().unwrap_or(Flaw::Nothing);
        let mut rig = Self {
            axes: (0..axes).map(|a| Axis::draw(rng, drives.len(), a, flaw)).collect(),
            held: rng.random_bool(0.5),
            link: rng.random_range(0.01..0.05),
        };
        let motion = rig.run(Span { drives, time: [0.0, 0.0], steps: COARSE }, &[]);
        for (a, axis) in rig.axes.iter_mut().enumerate() {
            let y = rms(&motion.y[a]);
            axis.level = [y, rms(&motion.v[a]), axis.stiffness[axis.seen] * y, rms(&motion.f[a])];
        }
        rig
    }

    /// The lowest natural frequency of the first axis, Hz.
    pub fn resonance_hz(&self) -> f64 {
        let (mut low, mut high) = (0.0, RATE / 2.0);
        for _ in 0..40 {
            let mid = 0.5 * (low + high);
            if self.axes[0].modes_below(mid) > 0 { high = mid } else { low = mid }
        }
        high
    }

    /// Number of linear numbers that a fit may move.
    pub fn numbers(&self) -> usize {
        let of = |axis: &Axis| 2 * axis.masses + axis.coupling.len() + usize::from(axis.lag_hz.is_some());
        self.axes.iter().map(of).sum()
    }

    /// The rig with each of its linear numbers moved by so many percent.
    pub fn moved(&self, percent: &[f64]) -> Self {
        let mut rig = self.clone();
        let mut shares = percent.iter().map(|p| 0.01 * p);
        let mut next = || shares.next().unwrap_or(0.0);
        for axis in &mut rig.axes {
            for i in 0..axis.masses {
                axis.stiffness[i] *= 1.0 + next();
                axis.damping[i] *= 1.0 + next();
            }
            for coupling in &mut axis.coupling {
                *coupling += next();
            }
            axis.lag_hz = axis.lag_hz.map(|hz| hz * (1.0 + next()));
        }
        rig
    }

    /// Responses `[response][sample]` in units of the linear rig's: the displacement of each axis, and of
    /// several axes their forces as well.
    pub fn respond(&self, span: Span<'_>, flaws: &[Placed]) -> Vec<Vec<f64>> {
        let motion = self.run(span, flaws);
        let scaled = |x: &Vec<f64>, level: f64| x.iter().map(|x| x / level).collect();
        let mut out: Vec<Vec<f64>> =
            motion.y.iter().zip(&self.axes).map(|(y, axis)| scaled(y, axis.level[0])).collect();
        if self.axes.len() > 1 {
            out.extend(motion.f.iter().zip(&self.axes).map(|(f, axis)| scaled(f, axis.level[3])));
        }
        for placed in flaws {
            placed.flaw.on_sensor(&mut out[placed.sensor], placed.strength, span.time);
        }
        out
    }

    fn run(&self, span: Span<'_>, flaws: &[Placed]) -> Motion {
        match self.axes.len() {
            1 => self.integrate::<STATES>(span, flaws),
            2 => self.integrate::<{ 2 * STATES }>(span, flaws),
            3 => self.integrate::<{ 3 * STATES }>(span, flaws),
            axes => unreachable!("no suite has {axes} axes"),
        }
    }

    /// `N` states, a number known to the compiler: the integrator is what making cases takes.
    fn integrate<const N: usize>(&self, span: Span<'_>, flaws: &[Placed]) -> Motion {
        let h = 1.0 / (RATE * span.steps as f64);
        let n = span.drives[0].len();
        let commands: Vec<Vec<f64>> = (0..span.drives.len())
            .map(|d| {
                let own = flaws.iter().filter(|p| p.axis == d);
                own.fold(span.drives[d].clone(), |u, p| p.flaw.on_drive(u, p.strength))
            })
            .collect();
        let axes = self.axes.len();
        let blank = || vec![Vec::with_capacity(n); axes];
        let mut motion = Motion { y: blank(), v: blank(), f: blank() };
        let mut state = [0.0; N];
        let mut input = Moment { drives: vec![0.0; commands.len()], clock: 0.0, seconds: 0.0 };
        for k in 0..n {
            for (a, axis) in self.axes.iter().enumerate() {
                let q = &state[a * STATES..(a + 1) * STATES];
                motion.y[a].push(q[axis.seen]);
                motion.v[a].push(q[MASSES + axis.seen]);
                motion.f[a].push(axis.below(q, axis.seen));
            }
            let next = (k + 1).min(n - 1);
            for step in 0..span.steps {
                runge_kutta::step(&mut state, h, |q, share, d| {
                    let place = (step as f64 + share) / span.steps as f64;
                    let between = if self.held { 0.0 } else { place };
                    for (u, c) in input.drives.iter_mut().zip(&commands) {
                        *u = c[k] + between * (c[next] - c[k]);
                    }
                    input.clock = span.time[0] + span.time[1] * (k as f64 + place);
                    input.seconds = (k as f64 + place) / RATE;
                    self.slope(q, &input, flaws, d);
                });
            }
        }
        motion
    }

    /// Time derivative of the state.
    fn slope(&self, state: &[f64], input: &Moment, flaws: &[Placed], out: &mut [f64]) {
        out.fill(0.0);
        // Actuators first: what one pushes reaches the other axes too.
        let mut pushed = [0.0; 4];
        pushed[..input.drives.len()].copy_from_slice(&input.drives);
        for (a, axis) in self.axes.iter().enumerate() {
            let place = a * STATES..(a + 1) * STATES;
            let own = flaws.iter().filter(|p| p.axis == a);
            pushed[a] = actuator(axis, &state[place.clone()], &mut out[place], pushed[a], own);
        }
        for (a, axis) in self.axes.iter().enumerate() {
            let q = &state[a * STATES..(a + 1) * STATES];
            let d = &mut out[a * STATES..(a + 1) * STATES];
            let mut force = [0.0; MASSES];
            for i in 0..axis.masses {
                let f = axis.below(q, i);
                force[i] -= f;
                if i > 0 {
                    force[i - 1] += f;
                }
            }
            let push: f64 = axis.coupling.iter().zip(&pushed).map(|(c, u)| c * u).sum();
            force[axis.driven] += axis.stiffness[axis.driven] * push;
            let stiffness = axis.stiffness[axis.seen];
            let other = (a + 1) % self.axes.len();
            let beside = if other == a {
                input.drives[1]
            } else {
                let x = state[other * STATES + self.axes[other].seen];
                force[axis.seen] -= self.link * stiffness * (q[axis.seen] - x);
                x / self.axes[other].level[0]
            };
            for placed in flaws.iter().filter(|p| p.axis == a) {
                if let Flaw::LinearChange { stiffness, damping } = placed.flaw {
                    force[axis.seen] -= changed(axis, q, placed.strength, stiffness, damping);
                    if axis.seen > 0 {
                        force[axis.seen - 1] += changed(axis, q, placed.strength, stiffness, damping);
                    }
                } else {
                    force[axis.seen] -= axis.level[2] * law(axis, q, d, beside, input, placed);
                }
            }
            for i in 0..axis.masses {
                d[i] = q[MASSES + i];
                d[MASSES + i] = force[i] / axis.mass[i];
            }
        }
    }
}

/// Root mean square.
pub fn rms(x: &[f64]) -> f64 {
    (x.iter().map(|x| x * x).sum::<f64>() / x.len().max(1) as f64).sqrt()
}
