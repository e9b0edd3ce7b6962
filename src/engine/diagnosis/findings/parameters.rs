//! The fitted numbers of an effect, in the rig's units.

use crate::diagnosis::core::modes::{Modes, natural};
use crate::diagnosis::data::problem::Problem;
use crate::diagnosis::effects::candidate::Part;
use crate::diagnosis::effects::input_map::InputMap;
use crate::diagnosis::effects::law::Law;
use crate::diagnosis::effects::output_map::OutputMap;
use crate::diagnosis::fit::fitting::Fitted;
use crate::diagnosis::numerics::levmar::standard_errors;
use crate::diagnosis::numerics::linear::eigenvalues;
use crate::diagnosis::report::Parameter;

/// How a raw parameter becomes one with a unit: `factor * raw`, or `factor * exp(raw)`.
struct Reading {
    name: String,
    factor: f64,
    exponential: bool,
    unit: String,
}

/// Named parameters of one of the candidate's parts with standard errors, which hold only as far as
/// the linearisation does.
pub fn named(problem: &Problem, fitted: &Fitted, part: usize, units: (&str, &[String])) -> Vec<Parameter> {
    let (before, part) = (&fitted.candidate.parts[..part], &fitted.candidate.parts[part]);
    let from: usize = before.iter().map(|part| part.parameters(problem.core.modes.order())).sum();
    let rows = |p: &[f64]| fitted.candidate.fit_rows(problem, p);
    let se = standard_errors(rows, &fitted.p, &fitted.scale, fitted.chi2_fit.max(1.0));
    let mut out = Vec::new();
    for (at, reading) in readings(problem, part, units) {
        let at = from + at;
        let raw = fitted.p[at];
        let value = reading.factor * if reading.exponential { raw.exp() } else { raw };
        let slope = if reading.exponential { value.abs() } else { reading.factor.abs() };
        out.push(Parameter {
            name: reading.name,
            value,
            se: Some(slope * se[at]).filter(|s| s.is_finite()),
            unit: reading.unit,
        });
    }
    out.retain(|p| p.value.is_finite());
    out
}

/// Natural frequency and damping of each mode before and after a retune of the linear part, if there is one.
pub fn modes(problem: &Problem, fitted: &Fitted) -> Vec<Parameter> {
    let retuned = problem.retunes_freely(&fitted.candidate);
    let mut out = if retuned { modes_after(problem, fitted) } else { Vec::new() };
    out.retain(|p| p.value.is_finite());
    out
}

/// Index of each parameter that means something, and how to read it.
fn readings(problem: &Problem, part: &Part, units: (&str, &[String])) -> Vec<(usize, Reading)> {
    let rate = problem.core.sample_rate_hz;
    let (y, v) = (problem.scales.y, problem.scales.dy * rate);
    let (unit_y, unit_u) = (units.0.to_owned(), units.1[part.drive].clone());
    let unit_v = format!("{unit_y}/s");
    let peak = problem.drive_peak[part.drive];
    let read = |name: &str, factor: f64, exponential: bool, unit: &str| Reading {
        name: name.into(),
        factor,
        exponential,
        unit: unit.into(),
    };
    let mut out = Vec::new();
    let mut at = 0;
    if let Some(map) = &part.input {
        let list = match map.bare() {
            // How large it is beside a fitted linear part says nothing of the rig.
            InputMap::Scaled(_) => Vec::new(),
            InputMap::Gain => vec![read("relative_gain", 1.0, false, "1")],
            InputMap::Delay => vec![read("delay", 1.0 / rate, false, "s")],
            InputMap::ExtraPole => {
                vec![read("corner", rate / std::f64::consts::TAU, true, "Hz")]
            }
            InputMap::Saturation => {
                vec![read("lower_limit", -peak, false, &unit_u), read("upper_limit", peak, false, &unit_u)]
            }
            InputMap::Polynomial => vec![
                read("c2", 1.0 / peak, false, &format!("1/{unit_u}")),
                read("c3", 1.0 / (peak * peak), false, &format!("1/{unit_u}^2")),
            ],
            InputMap::RateLimit => vec![read("rate", peak * rate, true, &format!("{unit_u}/s"))],
            InputMap::DeadZone | InputMap::Backlash => vec![read("half_width", peak, false, &unit_u)],
            InputMap::Free(spline) => spline
                .places()
                .iter()
                .map(|u| read(&format!("change_at_{:.3}", u * peak), peak, false, &unit_u))
                .collect(),
        };
        for (k, reading) in list.into_iter().enumerate() {
            out.push((at + k, reading));
        }
        at += map.parameters();
    }
    for law in &part.forces {
        let list = match law {
            Law::BumpStop | Law::OneSided(_) | Law::Clearance => vec![read("gap", y, false, &unit_y)],
            Law::Cubic => vec![read("bend", 1.0 / y, false, &format!("1/{unit_y}"))],
            Law::Coulomb => vec![read("transition_velocity", v, true, &unit_v)],
            Law::Stribeck => vec![
                read("transition_velocity", v, true, &unit_v),
                read("peak_over_sliding", 1.0, false, "1"),
                read("stribeck_velocity", v, true, &unit_v),
            ],
            Law::BoucWen => {
                vec![read("yield_displacement", y, true, &unit_y), read("sharpness", 1.0, true, "1")]
            }
            Law::Hysteretic => vec![
                read("yield_displacement", y, true, &unit_y),
                read("sharpness", 1.0, true, "1"),
                read("unloading", 1.0, false, "1"),
            ],
            Law::Valve => vec![read("load_share_of_supply", 1.0 / y, false, &format!("1/{unit_y}"))],
            _ => Vec::new(),
        };
        for (k, reading) in list.into_iter().enumerate() {
            out.push((at + k, reading));
        }
        at += law.shapes() + problem.core.modes.order();
    }
    if let Some(map) = part.output {
        let list = match map {
            OutputMap::Offset => vec![read("offset", y, false, &unit_y)],
            OutputMap::Gain => vec![read("relative_gain", 1.0, false, "1")],
            OutputMap::Saturation => {
                vec![read("lower_limit", -y, false, &unit_y), read("upper_limit", y, false, &unit_y)]
            }
            OutputMap::Polynomial => vec![
                read("c2", 1.0 / y, false, &format!("1/{unit_y}")),
                read("c3", 1.0 / (y * y), false, &format!("1/{unit_y}^2")),
            ],
            OutputMap::Drift => {
                vec![read("drift_over_programme", y, false, &unit_y), read("began_before", 1.0, false, "1")]
            }
            OutputMap::Round => vec![read("step", y, true, &unit_y)],
        };
        for (k, reading) in list.into_iter().enumerate() {
            out.push((at + k, reading));
        }
    }
    out
}

/// Natural frequency and damping of each mode before and after the retune.
fn modes_after(problem: &Problem, fitted: &Fitted) -> Vec<Parameter> {
    let order = problem.core.modes.order();
    let from = fitted.p.len() - fitted.candidate.retuned(problem);
    let rate = problem.core.sample_rate_hz;
    // Feedback acts midway between samples: y_mid = (y_k + y_(k+1)) / 2, so E c'(x+A x)/2 with C E small.
    let feedback = &fitted.p[from..from + order];
    let matrix = problem.core.modes.matrix();
    let c = problem.core.modes.output_row();
    let scale = 1.0 / problem.scales.y;
    let reach: f64 = c.iter().zip(feedback).map(|(c, e)| c * e * scale).sum();
    let mid: Vec<f64> = (0..order)
        .map(|j| {
            let through: f64 = (0..order).map(|i| c[i] * matrix[i][j]).sum();
            0.5 * (c[j] + through) / (1.0 - 0.5 * reach)
        })
        .collect();
    let moved: Vec<Vec<f64>> = (0..order)
        .map(|i| (0..order).map(|j| matrix[i][j] + feedback[i] * scale * mid[j]).collect())
        .collect();
    let mut after: Vec<(f64, f64)> = eigenvalues(&moved)
        .map(|values| Modes::of_values(&values).poles().iter().filter_map(|&p| natural(p, rate)).collect())
        .unwrap_or_default();
    after.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut out = Vec::new();
    for (when, list) in [("before", problem.core.natural()), ("after", after)] {
        for (k, (f, zeta)) in list.iter().enumerate() {
            for (what, value, unit) in [("frequency", *f, "Hz"), ("damping", *zeta, "1")] {
                out.push(Parameter {
                    name: format!("mode_{}_{what}_{when}", k + 1),
                    value,
                    se: None,
                    unit: unit.into(),
                });
            }
        }
    }
    out
}
