//! A candidate: the core with one or more effects, as a function of a parameter vector.

use super::effect::Effect;
use super::input_map::InputMap;
use super::kernel::{self, Force};
use super::law::Law;
use super::output_map::OutputMap;
use super::plant::{Course, Plant};
use crate::diagnosis::numerics::spline::Spline;
use serde::{Deserialize, Serialize};

/// Half range, in units of its RMS, of the inner signal of a sandwich.
const INNER_RANGE: f64 = 4.5;
/// Knots of a sandwich's nonlinearity.
pub const INNER_KNOTS: usize = 9;

/// The signal that a law calls other.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum Other {
    /// A drive, in units of its peak.
    Drive(usize),
    /// What the sim says of another response, in units of its RMS.
    Response(usize),
}

/// One effect at one place.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Part {
    pub effect: Effect,
    /// Drive of an input map or a sandwich.
    pub drive: usize,
    pub other: Option<Other>,
    pub input: Option<InputMap>,
    pub forces: Vec<Law>,
    pub sandwich: bool,
    pub output: Option<OutputMap>,
}

/// Effects on one response, with or without a retune of its linear part.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Candidate {
    pub parts: Vec<Part>,
    /// Feedback of the response, new paths of all drives and a new working point, with all zeros and
    /// poles free.
    pub retune: bool,
}

/// A law that needs the response, its shape, its path and the signal that it calls other.
type Loop<'a> = (&'a Law, &'a [f64], &'a [f64], Vec<f64>);

/// A candidate with its parameters handed out, on one stretch.
#[derive(Default)]
struct Unfolded<'a> {
    /// The core's free run with all that does not depend on the response; without any, the core's.
    ext: Option<Vec<f64>>,
    closed: Vec<Loop<'a>>,
    /// Values of the laws that do not need the response.
    open: Vec<Vec<f64>>,
    outputs: Vec<(OutputMap, &'a [f64])>,
}

impl Unfolded<'_> {
    fn add(&mut self, stretch: &Course, y: &[f64]) {
        let ext = self.ext.get_or_insert_with(|| stretch.core.to_vec());
        ext.iter_mut().zip(y).for_each(|(e, y)| *e += y);
    }

    /// Free run of the augmented core.
    fn free(&self, problem: &Plant, stretch: &Course) -> Option<Vec<f64>> {
        let ext = self.ext.as_deref().unwrap_or(&stretch.core);
        if self.closed.is_empty() {
            return Some(ext.to_vec());
        }
        let forces: Vec<Force<'_>> =
            self.closed.iter().map(|(law, shape, path, other)| Force { law, shape, path, other }).collect();
        kernel::run(&problem.core.modes, &forces, ext, problem.scales, stretch.clock)
    }
}

/// The free function between the two linear parts of a sandwich.
pub fn inner_spline() -> Spline {
    Spline::new(-INNER_RANGE, INNER_RANGE, INNER_KNOTS)
}

impl Part {
    fn bare(effect: Effect) -> Self {
        Self { effect, drive: 0, other: None, input: None, forces: Vec::new(), sandwich: false, output: None }
    }

    /// An effect that maps one drive.
    pub fn input(effect: Effect, drive: usize, map: InputMap) -> Self {
        Self { drive, input: Some(map), ..Self::bare(effect) }
    }

    /// An effect that is a force, with the signal that it needs beside the response.
    pub fn force(effect: Effect, forces: Vec<Law>, other: Option<Other>) -> Self {
        let drive = if let Some(Other::Drive(d)) = other { d } else { 0 };
        Self { forces, other, drive, ..Self::bare(effect) }
    }

    /// An effect of the sensor.
    pub fn output(effect: Effect, map: OutputMap) -> Self {
        Self { output: Some(map), ..Self::bare(effect) }
    }

    /// Linear, static, linear on the way from one drive.
    pub fn sandwich(drive: usize) -> Self {
        Self { drive, sandwich: true, ..Self::bare(Effect::Sandwich) }
    }

    /// No law of its own: all is in the retune.
    pub fn linear_change() -> Self {
        Self::bare(Effect::LinearChange)
    }

    /// The same effect as another response sees it: drives are mapped alike, forces arrive by a path
    /// of its own. `None` where the effect is the first response's sensor's.
    pub fn propagated(&self, laws_before: usize) -> Option<Self> {
        let carried = self.forces.len() + usize::from(self.sandwich);
        let forces = (laws_before..laws_before + carried).map(Law::Carried).collect();
        (self.output.is_none()).then(|| Self { forces, sandwich: false, other: None, ..self.clone() })
    }

    /// Whether its force is that of an effect at another response.
    pub fn is_carried(&self) -> bool {
        self.forces.iter().any(|law| matches!(law, Law::Carried(_)))
    }

    /// Whether the other is the same effect of the same drive.
    pub fn is_alike(&self, other: &Self) -> bool {
        self.effect == other.effect && self.drive == other.drive && self.other == other.other
    }

    /// Numbers that shape the effect, the paths of forces apart; a second path counts as one.
    pub fn shapes(&self) -> usize {
        let laws: usize = self.forces.iter().map(Law::shapes).sum();
        self.input.as_ref().map_or(0, |map| map.bare().parameters())
            + laws
            + self.forces.len().saturating_sub(1)
            + self.output.map_or(0, OutputMap::parameters)
    }

    pub fn parameters(&self, order: usize) -> usize {
        let forces: usize = self.forces.iter().map(|law| law.shapes() + law.path(order)).sum();
        let sandwich = if self.sandwich { 2 * order + 1 + INNER_KNOTS } else { 0 };
        self.input.as_ref().map_or(0, InputMap::parameters)
            + forces
            + sandwich
            + self.output.map_or(0, OutputMap::parameters)
    }
}

impl Candidate {
    /// Number of parameters.
    pub fn parameters(&self, problem: &Plant) -> usize {
        let order = problem.core.modes.order();
        let own: usize = self.parts.iter().map(|p| p.parameters(order)).sum();
        own + self.retuned(problem)
    }

    /// Whether the retune moves the working point: where an even law acts, the response's mean moves
    /// with its level. A linear change has none to move.
    pub fn working_point(&self) -> bool {
        self.retune && self.parts.iter().any(|part| part.effect != Effect::LinearChange)
    }

    /// Parameters of the retune: feedback, then per drive its path and its direct part, then the
    /// working point.
    pub fn retuned(&self, problem: &Plant) -> usize {
        let order = problem.core.modes.order();
        let linear = order + problem.drive_peak.len() * (order + 1);
        if self.retune { linear + usize::from(self.working_point()) } else { 0 }
    }

    /// Response to a stretch's drives, `sim(u) + [augmented(u) - core(u)]`, from rest; never sees a
    /// measured response. `None` if the free run runs away.
    ///
    /// Parameters: per part those of the input map, per force its shape and its path `E`, the
    /// sandwich's (first path, direct part, knot values, second path), those of the output map;
    /// then the retune's.
    pub fn predict(&self, problem: &Plant, stretch: &Course, p: &[f64]) -> Option<Vec<f64>> {
        let run = self.unfold(problem, stretch, p);
        let y = run.free(problem, stretch)?;
        let simulated = &stretch.simulated[problem.response];
        let mut out: Vec<f64> =
            simulated.iter().zip(y.iter().zip(stretch.core.iter())).map(|(s, (y, c))| s + y - c).collect();
        for (map, p) in run.outputs {
            problem.sense(map, p, stretch, &mut out);
        }
        out.iter().all(|y| y.is_finite()).then_some(out)
    }

    /// What the laws of the parts do along the free run, midway to the next sample, `[law][sample]`
    /// in the order of the parts: what other responses are fed with. `None` if it runs away.
    pub fn carry(&self, problem: &Plant, stretch: &Course, p: &[f64]) -> Option<Vec<Vec<f64>>> {
        let run = self.unfold(problem, stretch, p);
        let y = run.free(problem, stretch)?;
        let along = |l: &Loop<'_>| kernel::along(l.0, l.1, &y, &l.3, problem.scales, stretch.clock);
        let closed: Vec<Vec<f64>> = run.closed.iter().filter(|l| *l.0 != Law::Linear).map(along).collect();
        let mut closed = closed.into_iter();
        let mut open = run.open.into_iter();
        let laws = self
            .parts
            .iter()
            .flat_map(|part| part.forces.iter().map(Law::closed).chain(part.sandwich.then_some(false)));
        laws.map(|is_closed| if is_closed { closed.next() } else { open.next() }).collect()
    }

    fn unfold<'a>(&'a self, problem: &Plant, stretch: &Course, p: &'a [f64]) -> Unfolded<'a> {
        let core = &problem.core;
        let (modes, order) = (&core.modes, core.modes.order());
        let mut run = Unfolded::default();
        let mut rest = p;
        let mut take = |n: usize| {
            let (now, later) = rest.split_at(n);
            rest = later;
            now
        };
        for part in &self.parts {
            if let Some(map) = &part.input {
                let p = take(map.parameters());
                let change = map.change(p, &problem.drive(stretch, part.drive));
                run.add(stretch, &problem.path(part.drive, change));
            }
            for law in &part.forces {
                let (shape, path) = (take(law.shapes()), take(law.path(order)));
                if let Law::Carried(k) = law {
                    let carried = &stretch.carried[*k];
                    run.add(stretch, &modes.filter(&path[..order], carried));
                    run.add(stretch, &at_samples(carried).map(|x| path[order] * x).collect::<Vec<f64>>());
                    continue;
                }
                let other = problem.other(stretch, part.other);
                if law.closed() {
                    run.closed.push((law, shape, path, other));
                } else {
                    let values =
                        kernel::along(law, shape, &stretch.core, &other, problem.scales, stretch.clock);
                    run.add(stretch, &modes.filter(path, &values));
                    run.open.push(values);
                }
            }
            if part.sandwich {
                let (first, direct, knots, second) = (take(order), take(1), take(INNER_KNOTS), take(order));
                let inner = inner_signal(problem, stretch, part.drive, first, direct[0]);
                let spline = inner_spline();
                let values: Vec<f64> = inner.iter().map(|s| spline.at(knots, *s)).collect();
                run.add(stretch, &modes.filter(second, &values));
                run.open.push(values);
            }
            if let Some(map) = part.output {
                run.outputs.push((map, take(map.parameters())));
            }
        }
        if self.retune {
            run.closed.push((&Law::Linear, &[], take(order), Vec::new()));
            for (d, drive) in stretch.drives.iter().enumerate() {
                let (path, direct) = (take(order), take(1)[0]);
                let moved: Vec<f64> = drive.iter().map(|u| u - core.drive_mean[d]).collect();
                let mut y = modes.filter(path, &moved);
                y.iter_mut().zip(&moved).for_each(|(y, u)| *y += direct * u);
                run.add(stretch, &y);
            }
            if self.working_point() {
                let offset = take(1)[0] * problem.scales.y;
                run.add(stretch, &vec![offset; stretch.core.len()]);
            }
        }
        run
    }

    /// Whether it acts otherwise in the same run at another time.
    pub fn asks_for_time(&self) -> bool {
        let drifts =
            |part: &Part| part.forces.contains(&Law::StiffnessDrift) || part.output == Some(OutputMap::Drift);
        self.parts.iter().any(drifts)
    }
}

/// Values midway to the next sample as values at the samples.
pub fn at_samples(mid: &[f64]) -> impl Iterator<Item = f64> {
    (0..mid.len()).map(|k| kernel::midway(mid, k.saturating_sub(1)))
}

/// First linear part of a sandwich: the drive, in units of its peak, through its path.
pub fn inner_signal(problem: &Plant, stretch: &Course, drive: usize, path: &[f64], direct: f64) -> Vec<f64> {
    let (peak, mean) = (problem.drive_peak[drive], problem.core.drive_mean[drive]);
    let moved: Vec<f64> = stretch.drives[drive].iter().map(|u| (u - mean) / peak).collect();
    let mut inner = problem.core.modes.filter(path, &moved);
    inner.iter_mut().zip(&moved).for_each(|(s, u)| *s += direct * u);
    inner
}
