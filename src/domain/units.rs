//! Units of channels as people write them, and the factors between those of one quantity.
//!
//! Units that this table does not have are text: two are the same if they read the same.

use std::borrow::Cow;

/// Quantities with the units that measure them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Dimension {
    Force,
    Length,
    Velocity,
    Acceleration,
    Moment,
    Stress,
    Strain,
    Angle,
    AngularVelocity,
    Voltage,
    Current,
    Time,
    Frequency,
    Mass,
    Stiffness,
    Ratio,
}

/// Standard gravity, m/s² (exact; BIPM, The International System of Units).
const GRAVITY: f64 = 9.806_65;

/// Pound-force, N (exact: 0.45359237 kg times standard gravity).
const POUND_FORCE: f64 = 0.453_592_37 * GRAVITY;

/// Inch, m (exact).
const INCH: f64 = 0.0254;

const DEGREE: f64 = std::f64::consts::PI / 180.0;

/// Each unit with its quantity and its size in SI units. Several spellings of one unit stand side by side.
const UNITS: &[(&[&str], Dimension, f64)] = &[
    (&["N"], Dimension::Force, 1.0),
    (&["mN"], Dimension::Force, 1e-3),
    (&["daN"], Dimension::Force, 10.0),
    (&["kN", "KN"], Dimension::Force, 1e3),
    (&["MN"], Dimension::Force, 1e6),
    (&["kgf", "kp"], Dimension::Force, GRAVITY),
    (&["lbf", "lb", "lbs"], Dimension::Force, POUND_FORCE),
    (&["kip", "kips", "klbf"], Dimension::Force, 1e3 * POUND_FORCE),
    (&["m"], Dimension::Length, 1.0),
    (&["cm"], Dimension::Length, 1e-2),
    (&["mm"], Dimension::Length, 1e-3),
    (&["µm", "um", "micron"], Dimension::Length, 1e-6),
    (&["in", "inch", "\""], Dimension::Length, INCH),
    (&["ft"], Dimension::Length, 12.0 * INCH),
    (&["m/s"], Dimension::Velocity, 1.0),
    (&["cm/s"], Dimension::Velocity, 1e-2),
    (&["mm/s"], Dimension::Velocity, 1e-3),
    (&["km/h", "kph"], Dimension::Velocity, 1.0 / 3.6),
    (&["in/s"], Dimension::Velocity, INCH),
    (&["m/s²", "m/s/s"], Dimension::Acceleration, 1.0),
    (&["mm/s²", "mm/s/s"], Dimension::Acceleration, 1e-3),
    (&["g", "G", "gn"], Dimension::Acceleration, GRAVITY),
    (&["in/s²"], Dimension::Acceleration, INCH),
    (&["Nm"], Dimension::Moment, 1.0),
    (&["Nmm"], Dimension::Moment, 1e-3),
    (&["kNm"], Dimension::Moment, 1e3),
    (&["lbfft", "ftlbf", "lbft", "ftlb"], Dimension::Moment, 12.0 * INCH * POUND_FORCE),
    (&["lbfin", "inlbf", "lbin", "inlb"], Dimension::Moment, INCH * POUND_FORCE),
    (&["Pa"], Dimension::Stress, 1.0),
    (&["kPa"], Dimension::Stress, 1e3),
    (&["MPa", "N/mm²"], Dimension::Stress, 1e6),
    (&["GPa"], Dimension::Stress, 1e9),
    (&["bar"], Dimension::Stress, 1e5),
    (&["mbar"], Dimension::Stress, 1e2),
    (&["psi"], Dimension::Stress, POUND_FORCE / (INCH * INCH)),
    (&["µm/m", "um/m", "µε", "uε", "ustrain", "µstrain", "microstrain", "µD"], Dimension::Strain, 1e-6),
    (&["mm/m"], Dimension::Strain, 1e-3),
    (&["m/m", "strain"], Dimension::Strain, 1.0),
    (&["rad"], Dimension::Angle, 1.0),
    (&["mrad"], Dimension::Angle, 1e-3),
    (&["deg", "°", "Grad"], Dimension::Angle, DEGREE),
    (&["rad/s"], Dimension::AngularVelocity, 1.0),
    (&["deg/s", "°/s"], Dimension::AngularVelocity, DEGREE),
    (&["rpm", "1/min", "U/min"], Dimension::AngularVelocity, std::f64::consts::TAU / 60.0),
    (&["V"], Dimension::Voltage, 1.0),
    (&["mV"], Dimension::Voltage, 1e-3),
    (&["µV", "uV"], Dimension::Voltage, 1e-6),
    (&["A"], Dimension::Current, 1.0),
    (&["mA"], Dimension::Current, 1e-3),
    (&["s", "sec"], Dimension::Time, 1.0),
    (&["ms"], Dimension::Time, 1e-3),
    (&["µs", "us"], Dimension::Time, 1e-6),
    (&["min"], Dimension::Time, 60.0),
    (&["h"], Dimension::Time, 3600.0),
    (&["Hz"], Dimension::Frequency, 1.0),
    (&["kHz"], Dimension::Frequency, 1e3),
    (&["kg"], Dimension::Mass, 1.0),
    (&["t"], Dimension::Mass, 1e3),
    (&["N/m"], Dimension::Stiffness, 1.0),
    (&["N/mm", "kN/m"], Dimension::Stiffness, 1e3),
    (&["kN/mm", "MN/m"], Dimension::Stiffness, 1e6),
    (&["1", "-"], Dimension::Ratio, 1.0),
    (&["%"], Dimension::Ratio, 1e-2),
];

/// Whether the table has this unit.
pub fn known(unit: &str) -> bool {
    find(&normal(unit)).is_some()
}

/// The number that turns values in the unit `from` into values in the unit `to`: 1 for the same unit, `None` where
/// they measure different quantities or one is not known.
pub fn factor(from: &str, to: &str) -> Option<f64> {
    let (from, to) = (normal(from), normal(to));
    if from == to {
        return Some(1.0);
    }
    let ((from, from_size), (to, to_size)) = (find(&from)?, find(&to)?);
    (from == to).then(|| exact(from_size / to_size))
}

/// Size of a unit in SI units; `None` of one that is not known.
pub fn size(unit: &str) -> Option<f64> {
    find(&normal(unit)).map(|(_, size)| size)
}

/// The number of few digits that a ratio is but for its last bits: 0.001 for 1e-6 / 1e-3.
fn exact(ratio: f64) -> f64 {
    let short: f64 = format!("{ratio:.11e}").parse().unwrap_or(ratio);
    if (short / ratio - 1.0).abs() < 1e-15 { short } else { ratio }
}

fn find(unit: &str) -> Option<(Dimension, f64)> {
    UNITS.iter().find(|(names, ..)| names.contains(&unit)).map(|&(_, dimension, size)| (dimension, size))
}

/// One spelling of signs: no blanks and product signs, `²` for `^2` and `**2`, the micro sign for the Greek letter.
fn normal(unit: &str) -> Cow<'_, str> {
    if unit.is_ascii() && !unit.contains([' ', '*', '^', '.', '2']) {
        return unit.into();
    }
    let unit = unit.replace("**2", "²").replace("^2", "²").replace('\u{3bc}', "µ").replace("s2", "s²");
    let unit = unit.replace("mm2", "mm²");
    unit.replace([' ', '*', '·', '⋅', '.', '\u{a0}'], "").into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn units_of_one_quantity_convert() {
        for (from, to, expected) in [
            ("kN", "kN", 1.0),
            ("N", "kN", 1e-3),
            ("kN", "N", 1e3),
            ("mm", "m", 1e-3),
            ("µm", "\u{3bc}m", 1.0),
            ("g", "m/s^2", 9.80665),
            ("m/s2", "m/s²", 1.0),
            ("N m", "Nm", 1.0),
            ("N·m", "kNm", 1e-3),
            ("N/mm2", "MPa", 1.0),
            ("deg", "rad", 0.017_453_292_519_943_295),
            ("kip", "kN", 4.448_221_615_260_5),
            ("in", "mm", 25.4),
            ("psi", "kPa", 6.894_757_293_168_361),
            ("counts", "counts", 1.0),
        ] {
            let found = factor(from, to).unwrap();
            assert!((found / expected - 1.0).abs() < 1e-15, "{from} -> {to}: {found}");
        }
    }

    #[test]
    fn other_quantities_and_unknown_units_do_not() {
        for (from, to) in
            [("kN", "mm"), ("V", "kN"), ("counts", "kN"), ("MN", "mm"), ("kn", "kN"), ("", "kN")]
        {
            assert_eq!(factor(from, to), None, "{from} -> {to}");
        }
        assert_eq!([size("mm"), size("m/s^2"), size("counts")], [Some(1e-3), Some(1.0), None]);
        assert!(known("m/s^2") && known("kN") && !known("force_x") && !known(""));
    }

    #[test]
    fn every_spelling_is_listed_once_and_normal() {
        let all: Vec<&str> = UNITS.iter().flat_map(|(names, ..)| names.iter().copied()).collect();
        for (i, name) in all.iter().enumerate() {
            assert!(!all[..i].contains(name), "{name}");
            assert_eq!(normal(name), *name, "{name}");
        }
    }
}
