//! The bench's physical parameters: unit, range, source, and the draw from a rig seed.
//!
//! Each parameter is written once, below, with its range; struct, draw and display list follow from
//! that. Values are in the units a data sheet uses; [`super::plant`] converts to SI.
//!
//! Sources by short name:
//! - *Merritt*: H. E. Merritt, Hydraulic Control Systems, Wiley 1967.
//! - *Jelali & Kroll*: M. Jelali, A. Kroll, Hydraulic Servo-systems, Springer 2003.
//! - *Singh 1992*: R. Singh, G. Kim, P. V. Ravindra, Linear analysis of automotive hydro-mechanical mount
//!   with emphasis on decoupler characteristics, J. Sound Vib. 158 (1992).
//! - *Kim & Singh 1993*: G. Kim, R. Singh, Nonlinear analysis of automotive hydraulic engine mount,
//!   J. Dyn. Sys. Meas. Control 115 (1993).
//! - *Berg 1998*: M. Berg, A non-linear rubber spring model for rail vehicle dynamics analysis, Vehicle
//!   System Dynamics 30 (1998).

use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use serde::Serialize;

/// Names of the axes, in the order of all `[f64; 3]`.
pub const AXES: [&str; 3] = ["x", "y", "z"];

/// Interval from which a parameter is drawn, evenly.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Range {
    low: f64,
    nominal: f64,
    high: f64,
}

impl Range {
    fn draw(self, rng: &mut ChaCha8Rng) -> f64 {
        rng.random_range(self.low..=self.high)
    }
}

const fn range(low: f64, nominal: f64, high: f64) -> Range {
    Range { low, nominal, high }
}

const fn all_axes(low: f64, nominal: f64, high: f64) -> [Range; 3] {
    [range(low, nominal, high); 3]
}

/// One parameter of a drawn bench, for people.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Parameter {
    /// `x.piston_area_cm2`, or without axis where the bench has one such value.
    pub name: String,
    /// Value of this bench.
    pub value: f64,
    /// Unit of value and range; `1` for a pure number.
    pub unit: &'static str,
    /// Lower end of the range that seeds draw from.
    pub low: f64,
    /// The usual value.
    pub nominal: f64,
    /// Upper end of the range.
    pub high: f64,
    /// Meaning of the parameter.
    pub meaning: &'static str,
    /// Source of value and range.
    pub source: &'static str,
}

/// Writes a struct of parameters together with its draw, its nominal values and its display list.
macro_rules! parameters {
    ($(#[$attr:meta])* $name:ident, $n:literal {
        $( $(#[doc = $doc:literal])+ $field:ident [$unit:literal] = $ranges:expr, $source:literal; )+
    }) => {
        $(#[$attr])*
        #[derive(Debug, Clone, Copy, PartialEq)]
        pub struct $name {
            $( $(#[doc = $doc])+ #[doc = concat!(" Unit: ", $unit, ". Source: ", $source, ".")] pub $field: f64, )+
        }

        impl $name {
            /// Drawn in the order of the fields, so that a seed always means the same bench.
            pub(super) fn draw(rng: &mut ChaCha8Rng, axis: usize) -> Self {
                $( let $field: [Range; $n] = $ranges; )+
                Self { $( $field: $field[axis].draw(rng), )+ }
            }

            /// Every value at its nominal.
            pub(super) fn nominal(axis: usize) -> Self {
                $( let $field: [Range; $n] = $ranges; )+
                Self { $( $field: $field[axis].nominal, )+ }
            }

            pub(super) fn list(&self, axis: usize, prefix: &str) -> Vec<Parameter> {
                vec![$( {
                    let ranges: [Range; $n] = $ranges;
                    let range = ranges[axis];
                    Parameter {
                        name: format!("{prefix}{}", stringify!($field)),
                        value: self.$field,
                        unit: $unit,
                        low: range.low,
                        nominal: range.nominal,
                        high: range.high,
                        meaning: concat!($($doc),+).trim_ascii(),
                        source: $source,
                    }
                } ),+]
            }
        }
    };
}

parameters! {
    /// Parameters that the three axes share.
    BenchParameters, 1 {
        /// Supply pressure.
        supply_pressure_mpa ["MPa"] = [range(20.5, 21.0, 21.5)],
            "standard 21 MPa test-hall supply, held by accumulators to about 2 %";
        /// Tilt of the mount about the x axis.
        tilt_x_deg ["deg"] = [range(-5.0, 2.0, 5.0)],
            "suspension mounts sit inclined by a few degrees in the vehicle and so on the bench";
        /// Tilt of the mount about the y axis, after that about x.
        tilt_y_deg ["deg"] = [range(-5.0, -2.0, 5.0)],
            "suspension mounts sit inclined by a few degrees in the vehicle and so on the bench";
    }
}

parameters! {
    /// One axis: actuator, valve, controller, strut, its direction of the mount, its sensors.
    AxisParameters, 3 {
        /// Piston area of the symmetric actuator.
        piston_area_cm2 ["cm^2"] = all_axes(7.0, 8.5, 10.0),
            "15 to 20 kN fatigue-rated double-rod actuators at 21 MPa";
        /// Oil volume of both chambers, ports and manifold.
        oil_volume_cm3 ["cm^3"] = all_axes(90.0, 110.0, 130.0),
            "piston area times 100 mm stroke plus a close-mounted manifold";
        /// Effective bulk modulus of oil, entrained air and walls.
        bulk_modulus_mpa ["MPa"] = all_axes(800.0, 1000.0, 1200.0),
            "Merritt ch. 2: about 700 MPa in practice, twice that for oil without air in rigid cylinders";
        /// Leakage across the piston with its damping orifice, flow per load pressure.
        leakage_cm3_per_s_mpa ["cm^3/(s MPa)"] = all_axes(5.0, 7.0, 9.0),
            "Merritt ch. 6: cross-port leakage added to damp the oil column, here 1.5 to 3 l/min at 5 MPa";
        /// Viscous friction of piston and rod seals.
        seal_damping_n_s_per_m ["N s/m"] = all_axes(300.0, 600.0, 900.0),
            "Jelali & Kroll ch. 4: low-friction seals or hydrostatic bearings, 10^2 to 10^3 N s/m";
        /// Mass that moves on this axis: piston, rod, swivels, fixture.
        moving_mass_kg ["kg"] = all_axes(8.0, 11.0, 14.0),
            "piston rod of 5 kg class plus a light fixture plate";
        /// Rated flow at 7 MPa drop over both lands.
        rated_flow_l_per_min ["l/min"] = all_axes(57.0, 63.0, 69.0),
            "63 l/min class two-stage servo-valve, data-sheet tolerance 10 %";
        /// Natural frequency of the spool loop, second order.
        valve_frequency_hz ["Hz"] = all_axes(130.0, 150.0, 170.0),
            "high-response two-stage servo-valve, 90 degrees lag between 120 and 180 Hz";
        /// Damping ratio of the spool loop.
        valve_damping ["1"] = all_axes(0.75, 0.85, 0.95),
            "Jelali & Kroll ch. 4: second-order valve models, 0.7 to 1";
        /// Crossover of the open force loop, for which the gain is set at the mount's central stiffness.
        crossover_hz ["Hz"] = all_axes(28.0, 31.0, 34.0),
            "a fifth of the valve's frequency, so that the loop stays stable where the mount is 2 to 4 times as stiff";
        /// Corner frequency between integral and proportional action.
        integral_corner_hz ["Hz"] = all_axes(0.8, 1.2, 1.6),
            "common PI practice: a decade and more below crossover";
        /// Length of the strut between actuator and fixture, hinged at both ends.
        strut_length_mm ["mm"] = all_axes(350.0, 450.0, 550.0),
            "size of a pendulum strut on multi-axis elastomer benches";
        /// Stiffness of the mount's rubber near the middle.
        stiffness_n_per_mm ["N/mm"] = [range(350.0, 450.0, 550.0), range(500.0, 620.0, 740.0), range(400.0, 500.0, 600.0)],
            "engine and suspension hydro-mounts: 100 to 1000 N/mm (Singh 1992 and data sheets)";
        /// Load at which the stop in positive direction engages.
        stop_load_plus_kn ["kN"] = all_axes(1.7, 2.1, 2.5),
            "design load of a suspension mount; the stop takes the loads above it";
        /// Load at which the stop in negative direction engages.
        stop_load_minus_kn ["kN"] = all_axes(1.7, 2.1, 2.5),
            "design load of a suspension mount; the stop takes the loads above it";
        /// Stiffness of the fully engaged stop, as a multiple of the stiffness near the middle.
        stop_stiffness_ratio ["1"] = all_axes(1.5, 2.2, 3.0),
            "rubber stops: slope of the static characteristic 2.5 to 4 times that of the middle";
        /// Travel over which the stop comes to full stiffness.
        stop_travel_mm ["mm"] = all_axes(1.5, 2.2, 3.0),
            "contoured rubber stops of 5 to 10 mm height, fully in contact within a third of it";
        /// Viscous damping of the rubber.
        rubber_damping_n_s_per_m ["N s/m"] = all_axes(250.0, 400.0, 550.0),
            "filled natural rubber: loss factor about 0.1 at 15 Hz";
        /// Friction force of the filled rubber when fully slipping.
        friction_force_n ["N"] = all_axes(50.0, 80.0, 110.0),
            "Berg 1998: friction share of a filled-rubber spring, here 1 to 2 % of its load range";
        /// Travel in which the friction force builds up.
        friction_travel_mm ["mm"] = all_axes(0.7, 1.0, 1.3),
            "Berg 1998: travel to half the friction force, some tenths of a millimetre to 1 mm";
        /// Area with which the mount pumps oil in this direction.
        pumping_area_cm2 ["cm^2"] = [range(30.0, 35.0, 40.0), range(15.0, 18.5, 22.0), range(36.0, 41.0, 46.0)],
            "order of engine mounts (Singh 1992), some 25 to 50 cm^2; less across the damped directions";
        /// Volumetric compliance of the working chamber.
        chamber_compliance_cm3_per_mpa ["cm^3/MPa"] = all_axes(50.0, 65.0, 80.0),
            "order of Singh 1992, 3e-11 m^5/N for an engine mount; here a larger mount";
        /// Volumetric compliance of the compensating chamber.
        bellows_compliance_cm3_per_mpa ["cm^3/MPa"] = all_axes(1800.0, 2400.0, 3000.0),
            "order of Singh 1992: some 1e-9 m^5/N, a bellows that hardly resists";
        /// Length of the inertia track.
        track_length_mm ["mm"] = all_axes(160.0, 200.0, 240.0),
            "Kim & Singh 1993 and cut-open mounts: one turn around the insert";
        /// Cross-section of the inertia track.
        track_section_mm2 ["mm^2"] = all_axes(60.0, 75.0, 90.0),
            "Kim & Singh 1993 and cut-open mounts";
        /// Linear flow resistance of the inertia track.
        track_resistance_kpa_s_per_l ["kPa s/l"] = all_axes(70.0, 100.0, 130.0),
            "order of Singh 1992: 1e8 N s/m^5, far above laminar theory";
        /// Loss coefficient of the track for dynamic pressure: entry, exit, bends, turbulent wall friction.
        track_loss ["1"] = all_axes(2.0, 2.5, 3.0),
            "Merritt ch. 3: entry 0.5, exit 1, wall friction 0.04 length / diameter; Kim & Singh 1993 for the quadratic law";
        /// Static load on the mount at zero drive: clamping, and in z the fixture's weight.
        preload_n ["N"] = [range(-60.0, 20.0, 60.0), range(-60.0, -20.0, 60.0), range(80.0, 130.0, 180.0)],
            "weight of fixture and rod, and clamping without load control";
        /// Standard deviation of the displacement sensor's noise.
        displacement_noise_um ["um"] = all_axes(2.0, 4.0, 6.0),
            "LVDT of +-50 mm: 0.005 % of full scale over the recorded band";
        /// Standard deviation of the force sensor's noise, inertia compensation included.
        force_noise_n ["N"] = all_axes(2.0, 3.5, 5.0),
            "25 kN load cell: 0.01 to 0.02 % of full scale over the recorded band";
    }
}
