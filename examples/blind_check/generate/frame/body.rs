//! A row of masses with what is not linear in it, integrated by the fourth-order Runge-Kutta method.

use super::super::rig::{COARSE, RATE, rms};
use super::super::runge_kutta;
use super::law::{Law, MEMORY};

/// Most masses in a row, and most drives.
pub const MASSES: usize = 3;
const DRIVES: usize = 2;
/// States: displacements, velocities, what each drive's lag has, the actuator's place and its loop's integral, a play,
/// inner states of the law, those of the weak friction.
const PLACE: usize = 2 * MASSES + DRIVES;
const INTEGRAL: usize = PLACE + 1;
const PLAY: usize = INTEGRAL + 1;
const LAW: usize = PLAY + 1;
const STATES: usize = LAW + MEMORY;

/// How a frame is driven.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Control {
    /// Forces on masses.
    Force,
    /// A servo-hydraulic position loop: its gain and its integral's, 1/s, and the spring between actuator and frame,
    /// relative to the spring below the driven mass.
    Loop { gain: f64, integral: f64, spring: f64 },
    /// The actuator moves one end of a specimen, the other end stands on a load cell with a small mass.
    Specimen,
}

/// What a sensor measures.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Quantity {
    Displacement,
    Acceleration,
    Force,
}

/// A sensor at a mass.
#[derive(Debug, Clone, Copy)]
pub struct Sensor {
    pub mass: usize,
    pub quantity: Quantity,
}

/// Where a force acts: between a mass and the one below it (ground below the first), or between a mass and ground.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Site {
    pub mass: usize,
    pub joint: bool,
}

/// A row of masses. With a specimen there is one mass, the load cell's, and the specimen lies between it and the drive.
#[derive(Debug, Clone)]
pub struct Frame {
    pub control: Control,
    pub masses: usize,
    pub mass: [f64; MASSES],
    pub stiffness: [f64; MASSES],
    pub damping: [f64; MASSES],
    /// Mass that each drive acts on.
    pub driven: Vec<usize>,
    pub lag_hz: Option<f64>,
    pub sensors: Vec<Sensor>,
    pub site: Site,
    /// Stiffness and damping of a specimen.
    pub specimen: [f64; 2],
    /// Deviations of a linear run: displacement, velocity and elastic force at the site, and each sensor's.
    pub level: [f64; 3],
    pub levels: Vec<f64>,
}

/// What is not linear, with its strength.
#[derive(Debug, Clone, Copy)]
pub struct Beyond {
    pub law: Law,
    pub strength: f64,
    /// Of a cubic spring and of friction in every joint.
    pub background: f64,
}

impl Beyond {
    pub const NONE: Self = Self { law: Law::Nothing, strength: 0.0, background: 0.0 };
}

/// A stretch: drives `[drive][sample]`, a force on the last mass, steps of the integrator a sample.
#[derive(Clone, Copy)]
pub struct Stretch<'a> {
    pub drives: &'a [Vec<f64>],
    pub process: Option<&'a [f64]>,
    pub steps: usize,
}

impl Frame {
    /// Responses `[sensor][sample]`, each in units of its own deviation in the linear frame.
    pub fn respond(&self, stretch: Stretch<'_>, beyond: &Beyond) -> Vec<Vec<f64>> {
        let mut out = self.run(stretch, beyond).0;
        for (y, level) in out.iter_mut().zip(&self.levels) {
            y.iter_mut().for_each(|y| *y /= level);
        }
        // The first sensor is the one that may err.
        out[0].iter_mut().for_each(|y| *y = beyond.law.sensed(*y, beyond.strength));
        out
    }

    /// Each sensor's deviation relative to the largest: what [`Self::respond`] has to be multiplied by, so that all
    /// sensors have one unit and their differences are motions.
    pub fn shares(&self) -> Vec<f64> {
        let most = self.levels.iter().copied().fold(f64::MIN_POSITIVE, f64::max);
        self.levels.iter().map(|level| level / most).collect()
    }

    /// Takes the units from a linear run.
    pub fn scaled(mut self, drives: &[Vec<f64>]) -> Self {
        let stretch = Stretch { drives, process: None, steps: COARSE };
        let (out, at_site) = self.run(stretch, &Beyond::NONE);
        self.levels = out.iter().map(|y| rms(y).max(f64::MIN_POSITIVE)).collect();
        self.level = at_site.map(|x| rms(&x).max(f64::MIN_POSITIVE));
        self
    }

    /// Sensors' signals in the frame's own units, and displacement, velocity and elastic force at the site.
    fn run(&self, stretch: Stretch<'_>, beyond: &Beyond) -> (Vec<Vec<f64>>, [Vec<f64>; 3]) {
        let n = stretch.drives[0].len();
        let h = 1.0 / (RATE * stretch.steps as f64);
        let mut out = vec![Vec::with_capacity(n); self.sensors.len()];
        let mut at_site = [const { Vec::new() }; 3];
        let mut state = [0.0; STATES];
        let mut slope = [0.0; STATES];
        for k in 0..n {
            let next = (k + 1).min(n - 1);
            let input = |share: f64| -> [f64; DRIVES + 1] {
                let between = |x: &[f64]| x[k] + share * (x[next] - x[k]);
                let mut now = [0.0; DRIVES + 1];
                now.iter_mut().zip(stretch.drives).for_each(|(now, drive)| *now = between(drive));
                now[DRIVES] = stretch.process.map_or(0.0, between);
                now
            };
            self.slope(&state, input(0.0), beyond, &mut slope);
            for (sensor, out) in self.sensors.iter().zip(&mut out) {
                out.push(match sensor.quantity {
                    Quantity::Displacement => state[sensor.mass],
                    Quantity::Acceleration => slope[MASSES + sensor.mass],
                    Quantity::Force => self.stiffness[0] * state[0] + self.damping[0] * state[MASSES],
                });
            }
            let (y, v) = self.motion(&state, &slope);
            let all = [y, v, self.spring() * y];
            at_site.iter_mut().zip(all).for_each(|(to, x)| to.push(x));
            for step in 0..stretch.steps {
                runge_kutta::step(&mut state, h, |q, share, d| {
                    let at = (step as f64 + share) / stretch.steps as f64;
                    self.slope(q, input(at), beyond, d);
                });
            }
        }
        (out, at_site)
    }

    /// Stiffness at the site.
    fn spring(&self) -> f64 {
        if self.control == Control::Specimen { self.specimen[0] } else { self.stiffness[self.site.mass] }
    }

    /// Displacement and velocity at the site.
    fn motion(&self, q: &[f64; STATES], slope: &[f64; STATES]) -> (f64, f64) {
        let i = self.site.mass;
        match self.control {
            Control::Specimen => (q[2 * MASSES] - q[0], slope[2 * MASSES] - q[MASSES]),
            _ if self.site.joint && i > 0 => (q[i] - q[i - 1], q[MASSES + i] - q[MASSES + i - 1]),
            _ => (q[i], q[MASSES + i]),
        }
    }

    /// Time derivative of the state.
    fn slope(&self, q: &[f64; STATES], input: [f64; DRIVES + 1], beyond: &Beyond, out: &mut [f64; STATES]) {
        let tau = std::f64::consts::TAU;
        let Beyond { law, strength: s, background } = *beyond;
        let mut force = [0.0; MASSES];
        for i in 0..self.masses {
            let (xp, vp) = if i == 0 { (0.0, 0.0) } else { (q[i - 1], q[MASSES + i - 1]) };
            let (y, v) = (q[i] - xp, q[MASSES + i] - vp);
            let mut f = self.stiffness[i] * y + self.damping[i] * v;
            if background > 0.0 {
                let (ly, lv) = (self.level[0], self.level[1]);
                f += background * self.stiffness[i] * ly * (0.5 * (y / ly).powi(3) + (4.0 * v / lv).tanh());
            }
            force[i] -= f;
            if i > 0 {
                force[i - 1] += f;
            }
        }
        // The first drive's command, through its play and its bend.
        let mut u = law.command(input[0], s);
        if let Some(slope) = law.follows(input[0], q[PLAY], s, RATE) {
            out[PLAY] = slope;
            u = q[PLAY];
        }
        for (d, &mass) in self.driven.iter().enumerate() {
            let mut pushed = if d == 0 { u } else { input[d] };
            let lag = 2 * MASSES + d;
            let elastic = (self.stiffness[mass] * q[mass]) / self.level[2];
            if d == 0 && law.is_of_flow() && self.control == Control::Force {
                pushed = law.flow(pushed, elastic, s);
            }
            if let Some(hz) = self.lag_hz {
                out[lag] = tau * hz * (pushed - q[lag]);
                pushed = q[lag];
            }
            match self.control {
                Control::Force => force[mass] += self.stiffness[mass] * pushed,
                Control::Loop { gain, integral, spring } if d == 0 => {
                    let k = spring * self.stiffness[mass];
                    let load = k * (q[PLACE] - q[mass]);
                    let error = pushed - q[PLACE];
                    out[INTEGRAL] = integral * error;
                    out[PLACE] = gain * law.flow(error + q[INTEGRAL], load / self.level[2], s);
                    force[mass] += load;
                }
                Control::Loop { .. } => force[mass] += self.stiffness[mass] * pushed,
                Control::Specimen => {
                    let (y, v) = (q[lag] - q[0], out[lag] - q[MASSES]);
                    force[0] += self.specimen[0] * y + self.specimen[1] * v;
                }
            }
        }
        if law.is_force() {
            let (y, v) = self.motion(q, out);
            let mut z = [0.0; MEMORY];
            let mut dz = [0.0; MEMORY];
            z.copy_from_slice(&q[LAW..LAW + MEMORY]);
            let scaled = [y / self.level[0], v / self.level[1], v / self.level[0]];
            let f = s * self.level[2] * law.force(scaled[0], scaled[1], scaled[2], &z, &mut dz);
            out[LAW..LAW + MEMORY].copy_from_slice(&dz);
            let i = self.site.mass;
            if self.control == Control::Specimen {
                force[0] += f;
            } else {
                force[i] -= f;
                if self.site.joint && i > 0 {
                    force[i - 1] += f;
                }
            }
        }
        force[self.masses - 1] += self.level[2] * input[DRIVES];
        for i in 0..self.masses {
            out[i] = q[MASSES + i];
            out[MASSES + i] = force[i] / self.mass[i];
        }
    }
}
