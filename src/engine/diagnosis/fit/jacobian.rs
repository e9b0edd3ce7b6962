//! Derivatives of a free run by all of its parameters at once.
//!
//! The run is linearised about itself: with the slopes of each law along the run known, every
//! parameter's derivative is one more linear run, and all of them are simulated side by side. What
//! difference quotients cost a free run a parameter costs a few additions here.

use super::sensitivities::{Closed, Entry, Lane, STEP, sensitivities};
use crate::diagnosis::data::problem::{Problem, first_equivalent};
use crate::diagnosis::effects::candidate::{Candidate, INNER_KNOTS, at_samples, inner_signal, inner_spline};
use crate::diagnosis::effects::kernel::{self, Force};
use crate::diagnosis::effects::law::Law;
use crate::diagnosis::effects::plant::{Course, Plant};
use crate::diagnosis::numerics::levmar::Column;
use crate::diagnosis::numerics::linear::norm;

impl Candidate {
    /// Derivatives of the residual's rows by each parameter; `None` if the free run runs away.
    pub fn jacobian(&self, problem: &Problem, p: &[f64], scale: &[f64]) -> Option<Vec<Column>> {
        let mut columns: Vec<Vec<f64>> = vec![Vec::new(); p.len()];
        let mut from = Vec::with_capacity(problem.fit.len());
        let mut end = 0;
        for (stretch, first) in problem.fit.iter().zip(first_equivalent(&problem.fit, self.asks_for_time())) {
            from.push(end);
            end += stretch.rows.len();
            if let Some(at) = from[..from.len() - 1].get(first) {
                let again = *at..*at + stretch.rows.len();
                columns.iter_mut().for_each(|column| column.extend_from_within(again.clone()));
                continue;
            }
            for (column, mut signal) in columns.iter_mut().zip(self.tangents(problem, stretch, p, scale)?) {
                signal.iter_mut().for_each(|x| *x = -*x);
                stretch.extend(&signal, column);
            }
        }
        self.hold(problem, &mut columns);
        Some(
            columns
                .into_iter()
                .map(|mut values| {
                    let length = norm(&values);
                    let unit = if length > 0.0 && length.is_finite() { 1.0 / length } else { 0.0 };
                    values.iter_mut().for_each(|v| *v = if unit > 0.0 { *v * unit } else { 0.0 });
                    Column { values, unit }
                })
                .collect(),
        )
    }

    /// Derivatives of the prediction on one stretch, `[parameter][sample]`.
    fn tangents(&self, problem: &Plant, stretch: &Course, p: &[f64], scale: &[f64]) -> Option<Vec<Vec<f64>>> {
        let core = &problem.core;
        let (modes, order) = (&core.modes, core.modes.order());
        let samples = stretch.core.len();
        let mut ext = stretch.core.to_vec();
        let add = |ext: &mut Vec<f64>, y: &[f64]| ext.iter_mut().zip(y).for_each(|(e, y)| *e += y);
        let mut closed: Vec<Closed<'_>> = Vec::new();
        let mut lanes: Vec<Lane> = Vec::with_capacity(p.len());
        let mut outputs = Vec::new();
        let paths = |lanes: &mut Vec<Lane>, force: usize| {
            lanes.extend((0..order).map(|state| Lane::of(Entry::Path { force, state })));
        };
        for part in &self.parts {
            if let Some(map) = &part.input {
                let at = lanes.len();
                let own = &p[at..at + map.parameters()];
                let drive = problem.drive(stretch, part.drive);
                let now = map.change(own, &drive);
                for i in 0..own.len() {
                    let h = STEP * scale[at + i];
                    let mut moved = own.to_vec();
                    moved[i] += h;
                    let there = map.change(&moved, &drive);
                    let slope = there.iter().zip(&now).map(|(a, b)| (a - b) / h).collect();
                    lanes.push(Lane::outside(problem.path(part.drive, slope)));
                }
                add(&mut ext, &problem.path(part.drive, now));
            }
            for law in &part.forces {
                let at = lanes.len();
                let (shape, path) = p[at..at + law.shapes() + law.path(order)].split_at(law.shapes());
                if let Law::Carried(k) = law {
                    let carried = &stretch.carried[*k];
                    let at_once: Vec<f64> = at_samples(carried).collect();
                    lanes.extend(modes.basis(carried).into_iter().map(Lane::outside));
                    add(&mut ext, &modes.filter(&path[..order], carried));
                    add(&mut ext, &at_once.iter().map(|x| path[order] * x).collect::<Vec<f64>>());
                    lanes.push(Lane::outside(at_once));
                    continue;
                }
                let other = problem.other(stretch, part.other);
                if law.closed() {
                    let force = closed.len();
                    lanes.extend((0..law.shapes()).map(|number| Lane::of(Entry::Shape { force, number })));
                    paths(&mut lanes, force);
                    closed.push(Closed { law, shape, path, other });
                } else {
                    let values =
                        kernel::along(law, shape, &stretch.core, &other, problem.scales, stretch.clock);
                    lanes.extend(modes.basis(&values).into_iter().map(Lane::outside));
                    add(&mut ext, &modes.filter(path, &values));
                }
            }
            if part.sandwich {
                let at = lanes.len();
                let (first, rest) = p[at..].split_at(order);
                let (direct, rest) = (rest[0], &rest[1..]);
                let (knots, second) = (&rest[..INNER_KNOTS], &rest[INNER_KNOTS..INNER_KNOTS + order]);
                let inner = inner_signal(problem, stretch, part.drive, first, direct);
                let spline = inner_spline();
                let (peak, mean) = (problem.drive_peak[part.drive], core.drive_mean[part.drive]);
                let moved: Vec<f64> = stretch.drives[part.drive].iter().map(|u| (u - mean) / peak).collect();
                let slope: Vec<f64> = inner
                    .iter()
                    .map(|s| (spline.at(knots, s + STEP) - spline.at(knots, s - STEP)) / (2.0 * STEP))
                    .collect();
                let through = |inner: &[f64]| {
                    let values: Vec<f64> = inner.iter().zip(&slope).map(|(i, s)| i * s).collect();
                    Lane::outside(modes.filter(second, &values))
                };
                lanes.extend(modes.basis(&moved).iter().map(|b| through(b)));
                lanes.push(through(&moved));
                for k in 0..INNER_KNOTS {
                    let mut unit = vec![0.0; INNER_KNOTS];
                    unit[k] = 1.0;
                    let values: Vec<f64> = inner.iter().map(|s| spline.at(&unit, *s)).collect();
                    lanes.push(Lane::outside(modes.filter(second, &values)));
                }
                let values: Vec<f64> = inner.iter().map(|s| spline.at(knots, *s)).collect();
                lanes.extend(modes.basis(&values).into_iter().map(Lane::outside));
                add(&mut ext, &modes.filter(second, &values));
            }
            if let Some(map) = part.output {
                outputs.push((map, lanes.len()));
                lanes.extend((0..map.parameters()).map(|_| Lane::of(Entry::Outside)));
            }
        }
        if self.retune {
            let at = lanes.len();
            paths(&mut lanes, closed.len());
            closed.push(Closed {
                law: &Law::Linear,
                shape: &[],
                path: &p[at..at + order],
                other: Vec::new(),
            });
            for (d, drive) in stretch.drives.iter().enumerate() {
                let at = lanes.len();
                let (path, direct) = (&p[at..at + order], p[at + order]);
                let moved: Vec<f64> = drive.iter().map(|u| u - core.drive_mean[d]).collect();
                lanes.extend(modes.basis(&moved).into_iter().map(Lane::outside));
                let mut y = modes.filter(path, &moved);
                y.iter_mut().zip(&moved).for_each(|(y, u)| *y += direct * u);
                add(&mut ext, &y);
                lanes.push(Lane::outside(moved));
            }
            if self.working_point() {
                let offset = p[lanes.len()] * problem.scales.y;
                ext.iter_mut().for_each(|e| *e += offset);
                lanes.push(Lane::outside(vec![problem.scales.y; samples]));
            }
        }
        let (y, mut out) = if closed.is_empty() {
            (ext, lanes.into_iter().map(|lane| lane.ext).collect())
        } else {
            let forces: Vec<Force<'_>> = closed
                .iter()
                .map(|c| Force { law: c.law, shape: c.shape, path: c.path, other: &c.other })
                .collect();
            let (y, guesses) = kernel::trace(modes, &forces, &ext, problem.scales, stretch.clock)?;
            let out = sensitivities(problem, stretch, &closed, &lanes, (&y, &guesses), scale);
            (y, out)
        };
        for signal in &mut out {
            signal.resize(samples, 0.0);
        }
        let simulated = &stretch.simulated[problem.response];
        let (mean, unit) = (problem.scales.y_mean, problem.scales.y);
        let mut now: Vec<f64> =
            (0..samples).map(|k| (simulated[k] + y[k] - stretch.core[k] - mean) / unit).collect();
        let time = |k: usize| stretch.clock.start + stretch.clock.step * k as f64;
        for (map, at) in outputs {
            let own = &p[at..at + map.parameters()];
            let (mut up, mut down) = (now.clone(), now.clone());
            up.iter_mut().for_each(|y| *y += STEP);
            down.iter_mut().for_each(|y| *y -= STEP);
            map.apply(own, &mut up, time);
            map.apply(own, &mut down, time);
            for signal in &mut out {
                for (x, (a, b)) in signal.iter_mut().zip(up.iter().zip(&down)) {
                    *x *= (a - b) / (2.0 * STEP);
                }
            }
            for i in 0..own.len() {
                let h = STEP * scale[at + i];
                let (mut there, mut here) = (now.clone(), now.clone());
                let mut moved = own.to_vec();
                moved[i] += h;
                map.apply(&moved, &mut there, time);
                map.apply(own, &mut here, time);
                out[at + i] = there.iter().zip(&here).map(|(a, b)| (a - b) / h * unit).collect();
            }
            map.apply(own, &mut now, time);
        }
        Some(out)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use realfft::num_complex::Complex64;

    use super::*;
    use crate::diagnosis::core::Core;
    use crate::diagnosis::core::modes::Modes;
    use crate::diagnosis::effects::candidate::{Other, Part};
    use crate::diagnosis::effects::effect::Effect;
    use crate::diagnosis::effects::input_map::InputMap;
    use crate::diagnosis::effects::kernel::{Clock, Scales};
    use crate::diagnosis::effects::output_map::OutputMap;

    /// A rig of order three with two drives and a run of it.
    fn rig() -> (Plant, Course) {
        let pair = Complex64::from_polar(0.98, 0.15);
        let core = Core {
            sample_rate_hz: 256.0,
            modes: Modes::of_values(&[pair, pair.conj(), Complex64::new(0.8, 0.0)]),
            input: vec![vec![0.02, 0.05, 0.01], vec![0.01, 0.0, 0.02]],
            direct: vec![0.1, 0.0],
            drive_mean: vec![0.0, 0.05],
            response_mean: 0.1,
        };
        let wave = |w: f64, v: f64| -> Vec<f64> {
            (0..400).map(|k| (w * f64::from(k)).sin() + 0.6 * (v * f64::from(k) + 1.0).cos()).collect()
        };
        let drives = vec![wave(0.14, 0.037), wave(0.09, 0.21)];
        let y = core.simulate(&drives);
        let plant = Plant {
            response: 0,
            core,
            scales: Scales { y_mean: 0.1, y: 0.5, dy: 0.05 },
            other_scale: vec![0.5],
            other_mean: vec![0.1],
            drive_peak: vec![1.5, 1.5],
        };
        let course = Course {
            drives: Arc::new(drives),
            simulated: Arc::new(vec![y.clone()]),
            core: Arc::new(y),
            clock: Clock { start: 0.2, step: 1e-3 },
            carried: Arc::default(),
        };
        (plant, course)
    }

    // Nearly: both passes of the kernel get the slopes of the second.
    #[test]
    fn derivatives_are_those_of_difference_quotients() {
        let (plant, course) = rig();
        let parts = [
            (Part::force(Effect::CubicStiffness, vec![Law::Cubic], None), vec![0.3]),
            (Part::force(Effect::CoulombFriction, vec![Law::Coulomb], None), vec![-1.5]),
            (Part::force(Effect::BoucWenHysteresis, vec![Law::Hysteretic], None), vec![-0.7, 0.3, -0.4]),
            (Part::force(Effect::BoucWenHysteresis, vec![Law::BoucWen], None), vec![-0.7, 0.3]),
            (Part::force(Effect::FreeHysteresis, vec![Law::FreeHysteresis], None), vec![0.3; 6]),
            (Part::force(Effect::ValveFlow, vec![Law::Valve], Some(Other::Drive(0))), vec![0.2]),
            (Part::input(Effect::DrivePolynomial, 0, InputMap::Polynomial), vec![0.1, -0.2]),
            (Part::output(Effect::SensorNonlinearity, OutputMap::Polynomial), vec![0.05, -0.03]),
            (Part::sandwich(1), vec![0.1, 0.2, 0.3]),
        ];
        for (part, shape) in parts {
            let candidate = Candidate { parts: vec![part], retune: true };
            let count = candidate.parameters(&plant);
            let mut p: Vec<f64> = (0..count).map(|i| 2e-3 * (1.7 * i as f64).sin()).collect();
            p[..shape.len()].copy_from_slice(&shape);
            let scale = vec![1.0; count];
            let found = candidate.tangents(&plant, &course, &p, &scale).unwrap();
            assert_eq!(found.len(), count);
            for (i, found) in found.iter().enumerate() {
                let at = |h: f64| {
                    let mut moved = p.clone();
                    moved[i] += h;
                    candidate.predict(&plant, &course, &moved).unwrap()
                };
                let slope: Vec<f64> = at(1e-5).iter().zip(at(-1e-5)).map(|(a, b)| (a - b) / 2e-5).collect();
                let miss: Vec<f64> = slope.iter().zip(found).map(|(a, b)| a - b).collect();
                let effect = candidate.parts[0].effect;
                assert!(
                    norm(&miss) < 0.1 * norm(&slope) + 1e-9,
                    "{effect:?} {i}: {} {}",
                    norm(&miss),
                    norm(&slope)
                );
            }
        }
    }
}
