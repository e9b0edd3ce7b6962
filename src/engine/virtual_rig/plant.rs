//! The bench's differential equations in SI units; sources and symbols are in the [module docs](super).

use std::f64::consts::PI;

use super::effects::Effects;
use super::parameters::{AxisParameters, BenchParameters};

/// One value per axis: x, y, z.
pub(super) type Vec3 = [f64; 3];

/// Rows of [`State`]; each holds one value per axis.
pub(super) mod row {
    /// Fixture position, m.
    pub const Q: usize = 0;
    /// Fixture velocity, m/s.
    pub const V: usize = 1;
    /// Load pressure, Pa.
    pub const P: usize = 2;
    /// Spool opening, 1 = rated stroke.
    pub const SPOOL: usize = 3;
    /// Rate of the spool opening, 1/s.
    pub const SPOOL_RATE: usize = 4;
    /// Integral part of the valve command, 1 = rated stroke.
    pub const INTEGRAL: usize = 5;
    /// Oil displacement in the inertia track, referred to the mount's motion, m.
    pub const OIL: usize = 6;
    /// Its rate, m/s.
    pub const OIL_RATE: usize = 7;
    /// Friction state, -1..1 (last: it does not belong to the linear bench).
    pub const FRICTION: usize = 8;
    /// Number of rows.
    pub const N: usize = 9;
}

/// State of the bench, `[row][axis]`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct State(pub [Vec3; row::N]);

impl State {
    pub const ZERO: Self = Self([[0.0; 3]; row::N]);

    /// `self + factor * rate`.
    pub fn advanced(&self, rate: &Self, factor: f64) -> Self {
        let mut next = *self;
        for (to, from) in next.0.as_flattened_mut().iter_mut().zip(rate.0.as_flattened()) {
            *to += factor * from;
        }
        next
    }
}

/// Coefficients of the equations, SI, one value per axis (mount values: per mount direction).
#[derive(Debug, Clone)]
pub(super) struct Plant {
    // Actuator.
    pub area: Vec3,
    /// 4 x bulk modulus / oil volume.
    oil_column: Vec3,
    pub leakage: Vec3,
    seal_damping: Vec3,
    inverse_mass: Vec3,
    /// 1 / strut length.
    pub strut_curvature: Vec3,
    // Valve.
    /// Flow at full opening without load.
    pub full_flow: Vec3,
    /// 1 / supply pressure in the orifice law; 0 makes it linear.
    pub pressure_sensitivity: f64,
    /// Limit of the spool opening.
    pub opening_limit: f64,
    valve_omega_squared: Vec3,
    /// 2 x damping ratio x angular frequency.
    valve_drag: Vec3,
    // Controller.
    proportional: Vec3,
    integral: Vec3,
    // Mount; `rotation[i][j]`: rig axis i, mount direction j.
    pub rotation: [Vec3; 3],
    pub stiffness: Vec3,
    stop_stiffness: Vec3,
    stop_plus: Vec3,
    stop_minus: Vec3,
    stop_travel: Vec3,
    rubber_damping: Vec3,
    friction_force: Vec3,
    inverse_friction_travel: Vec3,
    /// Working chamber's stiffness at the mount.
    pub bulge: Vec3,
    /// Compensating chamber's stiffness at the mount.
    pub bellows: Vec3,
    inverse_oil_mass: Vec3,
    oil_drag: Vec3,
    oil_quadratic_drag: Vec3,
    pub preload: Vec3,
}

/// Density of the mount's glycol mixture, kg/m^3.
const OIL_DENSITY: f64 = 1060.0;
/// Pressure drop at which valves are rated, Pa.
const RATED_DROP: f64 = 7e6;

impl Plant {
    pub fn new(bench: &BenchParameters, axes: &[AxisParameters; 3], effects: &Effects) -> Self {
        let each = |f: &dyn Fn(&AxisParameters) -> f64| -> Vec3 { [f(&axes[0]), f(&axes[1]), f(&axes[2])] };
        let supply = bench.supply_pressure_mpa * 1e6;
        let area = |a: &AxisParameters| a.piston_area_cm2 * 1e-4;
        let full_flow =
            |a: &AxisParameters| a.rated_flow_l_per_min * 1e-3 / 60.0 * (supply / RATED_DROP).sqrt();
        let valve_omega = |a: &AxisParameters| 2.0 * PI * a.valve_frequency_hz;
        let stiffness = |a: &AxisParameters| a.stiffness_n_per_mm * 1e3;
        let pumping_area = |a: &AxisParameters| a.pumping_area_cm2 * 1e-4;
        let bulge = |a: &AxisParameters| pumping_area(a).powi(2) / (a.chamber_compliance_cm3_per_mpa * 1e-12);
        let section = |a: &AxisParameters| a.track_section_mm2 * 1e-6;
        // Above the inertia track's resonance, where the loop crosses over, the oil column stands
        // still and the bulge stiffness adds to the rubber's.
        let proportional = |a: &AxisParameters| {
            2.0 * PI * a.crossover_hz * area(a) / (full_flow(a) * (stiffness(a) + bulge(a)))
        };
        Self {
            area: each(&area),
            oil_column: each(&|a| 4.0 * a.bulk_modulus_mpa * 1e6 / (a.oil_volume_cm3 * 1e-6)),
            leakage: each(&|a| a.leakage_cm3_per_s_mpa * 1e-12),
            seal_damping: each(&|a| a.seal_damping_n_s_per_m),
            inverse_mass: each(&|a| 1.0 / a.moving_mass_kg),
            strut_curvature: each(&|a| effects.pendulum / (a.strut_length_mm * 1e-3)),
            full_flow: each(&full_flow),
            pressure_sensitivity: effects.valve / supply,
            opening_limit: 1.0 / effects.valve,
            valve_omega_squared: each(&|a| valve_omega(a).powi(2)),
            valve_drag: each(&|a| 2.0 * a.valve_damping * valve_omega(a)),
            proportional: each(&proportional),
            integral: each(&|a| proportional(a) * 2.0 * PI * a.integral_corner_hz),
            rotation: rotation(bench.tilt_x_deg.to_radians(), bench.tilt_y_deg.to_radians()),
            stiffness: each(&stiffness),
            stop_stiffness: each(&|a| effects.progressive_stiffness * a.stop_stiffness_ratio * stiffness(a)),
            stop_plus: each(&|a| a.stop_load_plus_kn * 1e3 / stiffness(a)),
            stop_minus: each(&|a| a.stop_load_minus_kn * 1e3 / stiffness(a)),
            stop_travel: each(&|a| a.stop_travel_mm * 1e-3),
            rubber_damping: each(&|a| a.rubber_damping_n_s_per_m),
            friction_force: each(&|a| effects.friction * a.friction_force_n),
            inverse_friction_travel: each(&|a| 1e3 / a.friction_travel_mm),
            bulge: each(&bulge),
            bellows: each(&|a| pumping_area(a).powi(2) / (a.bellows_compliance_cm3_per_mpa * 1e-12)),
            inverse_oil_mass: each(&|a| {
                section(a) / (pumping_area(a).powi(2) * OIL_DENSITY * a.track_length_mm * 1e-3)
            }),
            oil_drag: each(&|a| pumping_area(a).powi(2) * a.track_resistance_kpa_s_per_l * 1e6),
            oil_quadratic_drag: each(&|a| {
                let loss = 0.5 * OIL_DENSITY * a.track_loss / section(a).powi(2);
                effects.oil_damping * pumping_area(a).powi(3) * loss
            }),
            preload: each(&|a| effects.preload * a.preload_n),
        }
    }

    /// Direction cosines of each strut, `[strut][axis]`, with the fixture at `q`.
    #[inline]
    pub fn struts(&self, q: &Vec3) -> [Vec3; 3] {
        let square = dot(q, q);
        std::array::from_fn(|i| {
            let c = self.strut_curvature[i];
            let inverse_length = 1.0 / (1.0 + 2.0 * c * q[i] + c * c * square).sqrt();
            std::array::from_fn(|j| (c * q[j] + if i == j { 1.0 } else { 0.0 }) * inverse_length)
        })
    }

    /// Change of each strut's actuator stroke, m; written without a division by the curvature, which may be 0.
    #[inline]
    pub fn strokes(&self, q: &Vec3) -> Vec3 {
        let square = dot(q, q);
        std::array::from_fn(|i| {
            let c = self.strut_curvature[i];
            let length = (1.0 + 2.0 * c * q[i] + c * c * square).sqrt();
            (2.0 * q[i] + c * square) / (length + 1.0)
        })
    }

    /// Force of both stops in one mount direction: slope rises from 0 to full over the stop's travel.
    #[inline]
    pub fn stop_force(&self, direction: usize, d: f64) -> f64 {
        let travel = self.stop_travel[direction];
        self.stop_stiffness[direction]
            * (engaged(d - self.stop_plus[direction], travel)
                - engaged(-d - self.stop_minus[direction], travel))
    }

    /// Forces at the fixture in one state.
    #[inline(always)]
    fn forces(&self, s: &State) -> Forces {
        let [q, v, p] = [&s.0[row::Q], &s.0[row::V], &s.0[row::P]];
        let struts = self.struts(q);
        let (d, w) = (self.mount_components(q), self.mount_components(v));
        let stroke_rate: Vec3 = std::array::from_fn(|i| dot(&struts[i], v));
        let strut_force: Vec3 =
            std::array::from_fn(|i| self.area[i] * p[i] - self.seal_damping[i] * stroke_rate[i]);
        let along_mount: Vec3 = std::array::from_fn(|k| {
            self.stiffness[k] * d[k]
                + self.stop_force(k, d[k])
                + self.rubber_damping[k] * w[k]
                + self.friction_force[k] * s.0[row::FRICTION][k]
                + self.bulge[k] * (d[k] - s.0[row::OIL][k])
        });
        let net: Vec3 = std::array::from_fn(|j| {
            let push: f64 = (0..3).map(|i| strut_force[i] * struts[i][j]).sum();
            push + self.preload[j] - dot(&self.rotation[j], &along_mount)
        });
        // The load cell's reading is inertia compensated: strut force - mass x acceleration.
        let measured = std::array::from_fn(|i| strut_force[i] - net[i]);
        Forces { mount_travel: d, mount_rate: w, stroke_rate, net, measured }
    }

    /// Vector along the rig axes -> along the mount's directions.
    #[inline]
    pub fn mount_components(&self, v: &Vec3) -> Vec3 {
        std::array::from_fn(|k| (0..3).map(|i| self.rotation[i][k] * v[i]).sum())
    }

    /// Time derivative of the state under the drive `command` (N).
    #[inline(always)]
    pub fn derivative(&self, s: &State, command: &Vec3) -> State {
        let mut rate = State::ZERO;
        let at = self.forces(s);
        for (i, &commanded) in command.iter().enumerate() {
            let error = commanded - at.measured[i];
            let wanted = self.proportional[i] * error + s.0[row::INTEGRAL][i];
            let opening = s.0[row::SPOOL][i].clamp(-self.opening_limit, self.opening_limit);
            let pressure = s.0[row::P][i];
            let drop = (1.0 - self.pressure_sensitivity * pressure * opening.signum()).max(0.0);
            let flow = self.full_flow[i] * opening * drop.sqrt();

            rate.0[row::Q][i] = s.0[row::V][i];
            rate.0[row::V][i] = at.net[i] * self.inverse_mass[i];
            rate.0[row::P][i] =
                self.oil_column[i] * (flow - self.area[i] * at.stroke_rate[i] - self.leakage[i] * pressure);
            rate.0[row::SPOOL][i] = s.0[row::SPOOL_RATE][i];
            rate.0[row::SPOOL_RATE][i] = self.valve_omega_squared[i]
                * (wanted.clamp(-self.opening_limit, self.opening_limit) - s.0[row::SPOOL][i])
                - self.valve_drag[i] * s.0[row::SPOOL_RATE][i];
            // Anti-windup: the integral rests while the command is limited and the error pushes on.
            let winding_up = wanted.abs() > self.opening_limit && wanted * error > 0.0;
            rate.0[row::INTEGRAL][i] = if winding_up { 0.0 } else { self.integral[i] * error };

            let (oil, oil_rate) = (s.0[row::OIL][i], s.0[row::OIL_RATE][i]);
            rate.0[row::OIL][i] = oil_rate;
            rate.0[row::OIL_RATE][i] = self.inverse_oil_mass[i]
                * (self.bulge[i] * (at.mount_travel[i] - oil)
                    - self.bellows[i] * oil
                    - (self.oil_drag[i] + self.oil_quadratic_drag[i] * oil_rate.abs()) * oil_rate);
            let (w, z) = (at.mount_rate[i], s.0[row::FRICTION][i]);
            rate.0[row::FRICTION][i] =
                (w - 0.5 * (w.abs() * z + w * z.abs())) * self.inverse_friction_travel[i];
        }
        rate
    }

    /// Sensor readings without noise: strokes (m), then inertia-compensated strut forces (N).
    #[inline]
    pub fn measured(&self, s: &State) -> (Vec3, Vec3) {
        (self.strokes(&s.0[row::Q]), self.forces(s).measured)
    }
}

/// Forces and motions that one state implies.
struct Forces {
    /// Travel along the mount's directions, m.
    mount_travel: Vec3,
    /// Its rate, m/s.
    mount_rate: Vec3,
    /// Rate of each actuator's stroke, m/s.
    stroke_rate: Vec3,
    /// Force that accelerates the fixture, N.
    net: Vec3,
    /// Inertia-compensated strut forces, N.
    measured: Vec3,
}

/// Compression of a stop times its relative stiffness: quadratic over `travel`, then straight.
#[inline]
fn engaged(compression: f64, travel: f64) -> f64 {
    if compression <= 0.0 {
        0.0
    } else if compression < travel {
        compression * compression / (2.0 * travel)
    } else {
        compression - 0.5 * travel
    }
}

#[inline]
pub(super) fn dot(a: &Vec3, b: &Vec3) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// Mount directions in rig axes: turned about x, then about y; `[rig axis][mount direction]`.
fn rotation(about_x: f64, about_y: f64) -> [Vec3; 3] {
    let (sx, cx) = about_x.sin_cos();
    let (sy, cy) = about_y.sin_cos();
    [[cy, sy * sx, sy * cx], [0.0, cx, -sx], [-sy, cy * sx, cy * cx]]
}
