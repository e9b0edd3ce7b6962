//! The virtual rig: a three-axis servo-hydraulic bench with a suspension hydro-mount, simulated.
//!
//! It stands for the bench of Heindel et al. (arXiv 2107.03645, sec. 3.1): force controlled, 1 kHz, one
//! drive (force command, kN) per axis, three displacements (mm) and three forces (kN) as responses. It
//! is deterministic: a rig seed draws the physical parameters ([`VirtualRig::parameters`]), a run seed the drive
//! ([`drives`]), a sensor seed the sensor noise. Parameters come from data sheets and textbooks, never from
//! the results of a model.
//!
//! # Equations
//!
//! For each axis i = x, y, z with fixture position q, velocity v, load pressure p, spool opening u
//! (1 = rated stroke), drive r. Every effect in brackets \[ \] has a strength in [`Effects`].
//!
//! **Struts** (pendulum kinematics). Each actuator pushes through a hinged strut of length l_i, which
//! tilts when the other axes move:
//! `n_i = (e_i + c_i q) / |e_i + c_i q|`, stroke `s_i = (|e_i + c_i q| - 1) / c_i`, `c_i = [pendulum] / l_i`.
//! Centripetal forces of the struts (a few newtons) are left out.
//!
//! **Actuator** (Merritt 1967, ch. 6): `V/(4 beta) dp_i/dt = Q_i - A n_i.v - C_l p_i`, strut force
//! `S_i = A p_i - B n_i.v`.
//!
//! **Servo-valve** (Merritt ch. 5; Jelali & Kroll 2003, ch. 4): critical-centre spool,
//! `Q = Q_0 u sqrt(1 - [valve] sgn(u) p/p_s)` with `Q_0 = Q_rated sqrt(p_s / 7 MPa)`, and
//! `u'' = w_v^2 (u_c - u) - 2 zeta_v w_v u'`, |u_c| and |u| limited to `1 / [valve]`.
//!
//! **Controller**: PI on the measured force, `u_c = K_p e + K_p w_I integral(e)`, `e = r - f`; the integral
//! rests while the command is limited. Since the actuator is a velocity source below its oil-column
//! resonance, the open loop is an integrator, and K_p sets its crossover at the mount's central stiffness.
//! Where the mount is stiffer, the loop is faster.
//!
//! **Load cell**, inertia compensated as in the paper: `f_i = S_i - m_i dv_i/dt`.
//!
//! **Fixture**: `m_i dv_i/dt = sum_k S_k n_ki + [preload]_i - F_i`.
//!
//! **Mount** along its own, slightly tilted directions (d = R^T q, F = R F_d), per direction:
//! `F_d = K d + [stop](d) + C d' + [friction] F_f z + K_b (d - xi)`.
//! - Stops: slope rises from 0 to a multiple of K over a travel, from the stop's design load on, at both
//!   ends: near-constant stiffness in the middle that rises towards the ends (paper, static characteristics).
//! - Friction (Bouc 1967, Wen 1976, order 1): `x_f z' = d' - (|d'| z + d' |z|)/2`; the same exponential
//!   approach to the slip force as Berg's (1998) for filled rubber.
//! - Oil (Singh 1992; Kim & Singh 1993), referred to the mount by its pumping area A_p:
//!   `m_o xi'' = K_b (d - xi) - K_2 xi - (C_o + [oil] D_o |xi'|) xi'` with `K_b = A_p^2/C_1`,
//!   `K_2 = A_p^2/C_2`, `m_o = A_p^2 rho l/a`, `C_o = A_p^2 R`, `D_o = A_p^3 rho zeta/(2 a^2)`. Above the
//!   track's resonance (about 8 to 15 Hz) the oil stands still and K_b stiffens the mount.
//!
//! **Sensors**: stroke and compensated force, plus \[white noise\] per channel.
//!
//! Integration: Runge-Kutta of order 4, 8 steps per sample, the drive straight between samples. A run
//! starts at rest under its first drive value.
//!
//! With the five non-linear effects off, the bench is exactly linear and time invariant, and
//! [`VirtualRig::linear_response`] gives its FRF in closed form.

mod channels;
pub mod drives;
mod effects;
mod equilibrium;
mod integrate;
mod linear;
mod parameters;
mod plant;
mod programme;

pub use channels::{CHANNELS, RigChannel};
pub use effects::{Effects, MAX_STRENGTH};
pub use parameters::{AXES, AxisParameters, BenchParameters, Parameter};
pub use programme::{ProgrammeRun, ProgrammeSettings, programme};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;

use crate::{EngineError, Signal};
use integrate::SUBSTEPS;
use plant::{Plant, Vec3};

/// Sample rate of drives and responses, Hz.
pub const SAMPLE_RATE_HZ: f64 = 1000.0;
/// Largest force command that the bench accepts, kN; beyond it, its interlock would trip.
pub const DRIVE_LIMIT_KN: f64 = 10.0;

const NEWTON_PER_KN: f64 = 1e3;
const MM_PER_M: f64 = 1e3;

/// A bench with drawn parameters.
#[derive(Debug, Clone)]
pub struct VirtualRig {
    bench: BenchParameters,
    axes: [AxisParameters; 3],
    effects: Effects,
    plant: Plant,
}

impl VirtualRig {
    /// A bench whose parameters are drawn from their ranges, all effects at strength 1.
    pub fn draw(seed: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let bench = BenchParameters::draw(&mut rng, 0);
        let axes = std::array::from_fn(|axis| AxisParameters::draw(&mut rng, axis));
        Self::assemble(bench, axes, Effects::default())
    }

    /// The drawn bench without its non-linear effects; sensor noise and preload stay.
    pub fn linear(seed: u64) -> Self {
        let rig = Self::draw(seed);
        Self::assemble(rig.bench, rig.axes, Effects::linear())
    }

    /// The bench with every parameter at its nominal value, all effects at strength 1.
    pub fn nominal() -> Self {
        let axes = std::array::from_fn(AxisParameters::nominal);
        Self::assemble(BenchParameters::nominal(0), axes, Effects::default())
    }

    /// The same bench with other axes: another specimen of the same design, say.
    pub fn with_axes(&self, axes: [AxisParameters; 3]) -> Self {
        Self::assemble(self.bench, axes, self.effects)
    }

    /// The same bench with other effects.
    ///
    /// # Errors
    /// [`EngineError::Setting`] for a strength outside 0..=[`MAX_STRENGTH`].
    pub fn with_effects(&self, effects: Effects) -> Result<Self, EngineError> {
        Ok(Self::assemble(self.bench, self.axes, effects.checked()?))
    }

    fn assemble(bench: BenchParameters, axes: [AxisParameters; 3], effects: Effects) -> Self {
        let plant = Plant::new(&bench, &axes, &effects);
        Self { bench, axes, effects, plant }
    }

    /// Strengths of the effects.
    pub fn effects(&self) -> Effects {
        self.effects
    }

    /// Parameters that the axes share.
    pub fn bench(&self) -> &BenchParameters {
        &self.bench
    }

    /// Parameters of the axes x, y, z.
    pub fn axes(&self) -> &[AxisParameters; 3] {
        &self.axes
    }

    /// Every parameter with value, unit, range and source: first the bench's, then those of x, y, z.
    pub fn parameters(&self) -> Vec<Parameter> {
        let mut list = self.bench.list(0, "");
        for (axis, parameters) in self.axes.iter().enumerate() {
            list.extend(parameters.list(axis, &format!("{}.", AXES[axis])));
        }
        list
    }

    /// Channels: three drives, then the responses in the order of [`Self::simulate`]'s answer.
    pub fn channels(&self) -> &'static [RigChannel] {
        &CHANNELS
    }

    /// The responses to `drive` (three channels, kN, [`SAMPLE_RATE_HZ`]): displacements x, y, z (mm), then
    /// forces x, y, z (kN), as long as the drive.
    ///
    /// Runs are independent of each other; a caller may simulate several at once. The same drive with
    /// another `sensor_seed` is a repeat: only the sensor noise differs.
    ///
    /// # Errors
    /// Another number of channels or sample rate, no sample, a command beyond [`DRIVE_LIMIT_KN`], and
    /// [`EngineError::NonFiniteResult`] should the simulation diverge.
    pub fn simulate(&self, drive: &Signal, sensor_seed: u64) -> Result<Signal, EngineError> {
        let mut responses = self.simulate_exact(drive, SUBSTEPS)?;
        self.add_sensor_noise(&mut responses, sensor_seed);
        Signal::new(SAMPLE_RATE_HZ, responses)
    }

    /// The responses without sensor noise, `substeps` integration steps per sample.
    fn simulate_exact(&self, drive: &Signal, substeps: usize) -> Result<Vec<Vec<f64>>, EngineError> {
        check_drive(drive)?;
        let n = drive.n_samples();
        let command =
            |k: usize| -> Vec3 { std::array::from_fn(|axis| drive.channel(axis)[k] * NEWTON_PER_KN) };
        let mut responses: Vec<Vec<f64>> = (0..6).map(|_| Vec::with_capacity(n)).collect();
        let mut now = command(0);
        let mut state = self.plant.equilibrium(&now).ok_or(EngineError::NonFiniteResult {
            what: "virtual rig's rest position",
            channel: 0,
            sample: 0,
        })?;
        for k in 0..n {
            let (stroke, force) = self.plant.measured(&state);
            for axis in 0..3 {
                responses[axis].push(stroke[axis] * MM_PER_M);
                responses[3 + axis].push(force[axis] / NEWTON_PER_KN);
            }
            if let Some(channel) = responses.iter().position(|r| !r[k].is_finite()) {
                let what = "virtual rig's response";
                return Err(EngineError::NonFiniteResult { what, channel, sample: k });
            }
            if k + 1 < n {
                let next = command(k + 1);
                state = self.plant.next_sample(&state, &now, &next, 1.0 / SAMPLE_RATE_HZ, substeps);
                now = next;
            }
        }
        Ok(responses)
    }

    /// White noise of each sensor, from a stream of its own.
    fn add_sensor_noise(&self, responses: &mut [Vec<f64>], sensor_seed: u64) {
        if self.effects.sensor_noise == 0.0 {
            return;
        }
        for (channel, samples) in responses.iter_mut().enumerate() {
            let axis = &self.axes[channel % 3];
            let in_channel_units = if channel < 3 {
                axis.displacement_noise_um * 1e-3
            } else {
                axis.force_noise_n / NEWTON_PER_KN
            };
            let deviation = self.effects.sensor_noise * in_channel_units;
            let mut rng = ChaCha8Rng::seed_from_u64(sensor_seed);
            rng.set_stream(channel as u64);
            for sample in samples {
                *sample += deviation * rng.sample::<f64, _>(StandardNormal);
            }
        }
    }
}

fn check_drive(drive: &Signal) -> Result<(), EngineError> {
    let what = "drive of the virtual rig";
    if drive.n_channels() != 3 {
        return Err(EngineError::ChannelCount { what, expected: 3, found: drive.n_channels() });
    }
    if !Signal::same_rate(drive.sample_rate_hz(), SAMPLE_RATE_HZ) {
        return Err(EngineError::SampleRate {
            what,
            expected_hz: SAMPLE_RATE_HZ,
            found_hz: drive.sample_rate_hz(),
        });
    }
    if drive.n_samples() == 0 {
        return Err(EngineError::TooShort { what, needed: 1, found: 0 });
    }
    for (channel, samples) in drive.channels().iter().enumerate() {
        if let Some(sample) = samples.iter().position(|v| v.abs() > DRIVE_LIMIT_KN) {
            let found = samples[sample];
            return Err(EngineError::OutOfRange { what, channel, sample, found, limit: DRIVE_LIMIT_KN });
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests;
