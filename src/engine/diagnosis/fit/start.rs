//! Where fits start: a regression that may use the measured response, as FNSI and NIFO do.
//!
//! With the shape of a law given, its path `E` and the retune are linear in the residual: `y - sim =
//! sum_n E_n basis_n(phi(y, v)) + ...`. Shapes come from a short list; free shapes by alternating
//! between shape and path. The free run then starts near where it should end.

use crate::diagnosis::data::problem::{Problem, Stretch};
use crate::diagnosis::effects::candidate::{Candidate, Other, Part, at_samples, inner_signal, inner_spline};
use crate::diagnosis::effects::input_map::InputMap;
use crate::diagnosis::effects::kernel;
use crate::diagnosis::effects::law::Law;
use crate::diagnosis::effects::output_map::OutputMap;
use crate::diagnosis::numerics::linear::{dot, least_squares, norm, rms};
use crate::diagnosis::numerics::smooth::smooth;

/// Size of a drive's change below which its map is none.
const LEAST_SIZE: f64 = 0.05;
/// Alternations between the shape and the path of a free law.
const ALTERNATIONS: usize = 6;

/// Parameters from which a fit may start.
#[derive(Debug, Clone)]
pub struct Start {
    pub p: Vec<f64>,
    /// Size of a change of each parameter that matters.
    pub scale: Vec<f64>,
    /// What the regression leaves, sum of squares of the rows.
    pub cost: f64,
    /// Which parameters are linear in the residual: shrunk together if the free run runs away.
    pub linear: Vec<bool>,
}

/// What all regressions on one response share.
pub struct Regression<'a> {
    pub problem: &'a Problem,
    /// Smoothed measured response of each fit stretch.
    pub smooth: Vec<Vec<f64>>,
    /// Columns of the retune, in the order of its parameters.
    retune: Vec<Vec<f64>>,
}

impl<'a> Regression<'a> {
    pub fn new(problem: &'a Problem, retune: bool) -> Self {
        let smooth: Vec<Vec<f64>> =
            problem.fit.iter().map(|s| smooth(&s.measured, problem.band_end)).collect();
        let mut this = Self { problem, smooth, retune: Vec::new() };
        if retune {
            this.retune = this.path_columns(&Law::Linear, &[], None);
            for d in 0..problem.drive_peak.len() {
                let moved = |s: &Stretch| -> Vec<f64> {
                    s.drives[d].iter().map(|u| u - problem.core.drive_mean[d]).collect()
                };
                this.retune.extend(this.basis_columns(|i| moved(&problem.fit[i])));
                this.retune.push(problem.rows(&problem.fit, moved));
            }
            // The working point, last: a linear change goes without.
            this.retune.push(problem.rows(&problem.fit, |s| vec![problem.scales.y; s.measured.len()]));
        }
        this
    }

    /// Rows of each state's answer to a signal of each fit stretch.
    fn basis_columns(&self, signal: impl Fn(usize) -> Vec<f64>) -> Vec<Vec<f64>> {
        let modes = &self.problem.core.modes;
        let mut columns = vec![Vec::new(); modes.order()];
        for (i, stretch) in self.problem.fit.iter().enumerate() {
            for (column, answer) in columns.iter_mut().zip(modes.basis(&signal(i))) {
                stretch.extend(&answer, column);
            }
        }
        columns
    }

    /// Columns of the whole retune, none without one.
    pub fn retune(&self, retune: bool) -> Vec<&[f64]> {
        if retune { self.retune.iter().map(Vec::as_slice).collect() } else { Vec::new() }
    }

    /// Columns of the retune that a candidate has.
    fn retune_of(&self, candidate: &Candidate) -> Vec<&[f64]> {
        self.retune.iter().take(candidate.retuned(self.problem)).map(Vec::as_slice).collect()
    }

    pub fn path_columns(&self, law: &Law, shape: &[f64], other: Option<Other>) -> Vec<Vec<f64>> {
        let problem = self.problem;
        if let Law::Carried(k) = law {
            let mut columns = self.basis_columns(|i| problem.fit[i].carried[*k].clone());
            columns.push(problem.rows(&problem.fit, |s| at_samples(&s.carried[*k]).collect()));
            return columns;
        }
        self.basis_columns(|i| {
            let stretch = &problem.fit[i];
            let other = problem.other(stretch, other);
            kernel::along(law, shape, &self.smooth[i], &other, problem.scales, stretch.clock)
        })
    }

    /// Starts for the last part of a candidate, best first; `known` are the parameters of the parts
    /// before it, which stay as they are.
    pub fn starts(&self, candidate: &Candidate, known: &[f64]) -> Vec<Start> {
        let Some(part) = candidate.parts.last() else { return Vec::new() };
        let mut starts = if part.sandwich {
            self.sandwich(candidate, part, known)
        } else if part.forces.iter().any(Law::linear_in_shape) {
            self.free(candidate, part, known).into_iter().collect()
        } else {
            let guesses = self.guesses(part);
            guesses.iter().filter_map(|g| self.regress(candidate, part, known, g)).collect()
        };
        starts.sort_by(|a, b| a.cost.total_cmp(&b.cost));
        starts
    }

    /// The start of a propagation (see [`Part::propagated`]) of the last part on top of those whose parameters are
    /// `known`: its input map as `map` has it, its paths by least squares.
    pub fn propagated(&self, candidate: &Candidate, known: &[f64], map: &[f64]) -> Option<Start> {
        let part = candidate.parts.last()?;
        let shapes = vec![Vec::new(); part.forces.len()];
        self.regress(candidate, part, known, &Guess { input: map.to_vec(), shapes, ..Guess::default() })
    }

    /// Nonlinear parameters to try: of the input map, of each force, of the output map.
    pub fn guesses(&self, part: &Part) -> Vec<Guess> {
        let problem = self.problem;
        if let Some(map) = &part.input {
            let starts = map.starts(problem.drive_quantiles[part.drive], problem.drive_slope[part.drive]);
            return starts.into_iter().map(|input| Guess { input, ..Guess::default() }).collect();
        }
        if let Some(map) = part.output {
            let mut starts = map.starts();
            if map == OutputMap::Saturation {
                starts.push(self.extremes());
            }
            return starts.into_iter().map(|output| Guess { output, ..Guess::default() }).collect();
        }
        let lists: Vec<Vec<Vec<f64>>> = part.forces.iter().map(shapes).collect();
        match lists.first() {
            None => vec![Guess::default()],
            Some(first) => first
                .iter()
                .map(|shape| {
                    let mut all = vec![shape.clone()];
                    all.extend(lists[1..].iter().map(|l| l[0].clone()));
                    Guess { shapes: all, ..Guess::default() }
                })
                .collect(),
        }
    }

    /// Where a clipped response would show its limits: its own extremes, less a few spikes of noise.
    fn extremes(&self) -> Vec<f64> {
        let scales = self.problem.scales;
        let mut values: Vec<f64> = self
            .problem
            .fit
            .iter()
            .flat_map(|s| s.measured.iter().map(|y| (y - scales.y_mean) / scales.y))
            .collect();
        values.sort_by(f64::total_cmp);
        let few = values.len() / 500;
        vec![values[few].abs(), values[values.len() - 1 - few].abs()]
    }

    /// Rows that the candidate leaves with every linear parameter of the last part at 0.
    fn target(&self, candidate: &Candidate, p: &[f64]) -> Option<Vec<f64>> {
        candidate.residual_rows(self.problem, &self.problem.fit, p)
    }

    /// The start of a guess: by least squares of all that is linear, and of how large the change of a drive is.
    fn regress(&self, candidate: &Candidate, part: &Part, known: &[f64], guess: &Guess) -> Option<Start> {
        let order = self.problem.core.modes.order();
        let mut columns: Vec<Vec<f64>> = Vec::new();
        let mut start = Builder::new(known);
        start.nonlinear(&guess.input, map_scale(part));
        if let Some(map @ InputMap::Scaled(_)) = &part.input {
            start.last_is_a_size();
            columns.push(self.problem.rows(&self.problem.fit, |s| {
                let drive = self.problem.drive(s, part.drive);
                self.problem.path(part.drive, map.change(&guess.input, &drive))
            }));
        }
        for (law, shape) in part.forces.iter().zip(&guess.shapes) {
            start.nonlinear(shape, 0.3);
            start.linear(law.path(order));
            columns.extend(self.path_columns(law, shape, part.other));
        }
        start.nonlinear(&guess.output, 0.1);
        if candidate.retune {
            start.linear(candidate.retuned(self.problem));
        }
        let target = self.target(candidate, &start.p)?;
        let mut all: Vec<&[f64]> = columns.iter().map(Vec::as_slice).collect();
        if candidate.retune {
            all.extend(self.retune_of(candidate));
        }
        Some(start.solve(&all, &target))
    }

    /// A law that is linear in its shape: path and shape in turn.
    fn free(&self, candidate: &Candidate, part: &Part, known: &[f64]) -> Option<Start> {
        let order = self.problem.core.modes.order();
        let law = &part.forces[0];
        let shapes = law.shapes();
        let blocks: Vec<Vec<Vec<f64>>> = (0..shapes)
            .map(|q| {
                let unit: Vec<f64> = (0..shapes).map(|i| f64::from(u8::from(i == q))).collect();
                self.path_columns(law, &unit, part.other)
            })
            .collect();
        let first = match law {
            Law::FreeStiffness(s) | Law::FreeDamping(s) => vec![
                s.places().iter().map(|x| x.powi(3) / (1.0 + x * x)).collect(),
                s.places().iter().map(|x| x * x).collect(),
                s.places().clone(),
            ],
            _ => vec![vec![1.0; shapes]],
        };
        let mut zero = known.to_vec();
        zero.resize(candidate.parameters(self.problem), 0.0);
        let target = self.target(candidate, &zero)?;
        let retune = self.retune_of(candidate);
        let tried =
            first.into_iter().map(|shape| alternate(&blocks, &retune, candidate.retune, shape, &target));
        let best = tried.min_by(|a, b| a.cost.total_cmp(&b.cost))?;
        let mut start = Builder::new(known);
        let size = best.shape.iter().fold(0.0_f64, |m, c| m.max(c.abs())).max(1e-12);
        start.nonlinear(&best.shape, 0.3 * size);
        start.linear(order);
        if candidate.retune {
            start.linear(candidate.retuned(self.problem));
        }
        let path: Vec<Vec<f64>> = combine(&blocks, &best.shape);
        let mut all: Vec<&[f64]> = path.iter().map(Vec::as_slice).collect();
        if candidate.retune {
            all.extend(retune);
        }
        Some(start.solve(&all, &target))
    }

    /// A sandwich: inner signals to try are the core's own answer, the drive and each mode's answer.
    fn sandwich(&self, candidate: &Candidate, part: &Part, known: &[f64]) -> Vec<Start> {
        let problem = self.problem;
        let core = &problem.core;
        let order = core.modes.order();
        let spline = inner_spline();
        let mut paths =
            vec![(core.input[part.drive].clone(), core.direct[part.drive]), (vec![0.0; order], 1.0)];
        for n in 0..order {
            let mut only = vec![0.0; order];
            only[n] = 1.0;
            paths.push((only, 0.0));
        }
        let mut zero = known.to_vec();
        zero.resize(candidate.parameters(problem), 0.0);
        let Some(target) = self.target(candidate, &zero) else { return Vec::new() };
        let retune = self.retune_of(candidate);
        let mut starts = Vec::new();
        for (path, direct) in paths {
            let inner: Vec<Vec<f64>> =
                problem.fit.iter().map(|s| inner_signal(problem, s, part.drive, &path, direct)).collect();
            let level = rms(&inner.concat());
            if level.is_nan() || level <= 0.0 {
                continue;
            }
            let blocks: Vec<Vec<Vec<f64>>> = [2_i32, 3]
                .iter()
                .map(|&power| {
                    self.basis_columns(|i| inner[i].iter().map(|s| (s / level).powi(power)).collect())
                })
                .collect();
            let best = [vec![0.0, 1.0], vec![1.0, 0.0]]
                .into_iter()
                .map(|shape| alternate(&blocks, &retune, candidate.retune, shape, &target))
                .min_by(|a, b| a.cost.total_cmp(&b.cost));
            let Some(best) = best else { continue };
            let knots: Vec<f64> =
                spline.places().iter().map(|s| best.shape[0] * s * s + best.shape[1] * s * s * s).collect();
            let size = knots.iter().fold(0.0_f64, |m, c| m.max(c.abs())).max(1e-12);
            let mut start = Builder::new(known);
            let scaled: Vec<f64> = path.iter().map(|g| g / level).collect();
            let reach = norm(&scaled).max((direct / level).abs());
            start.nonlinear(&scaled, 0.1 * reach);
            start.nonlinear(&[direct / level], 0.1 * reach);
            start.nonlinear(&knots, 0.1 * size);
            start.linear(order);
            if candidate.retune {
                start.linear(candidate.retuned(self.problem));
            }
            let columns =
                self.basis_columns(|i| inner[i].iter().map(|s| spline.at(&knots, s / level)).collect());
            let mut all: Vec<&[f64]> = columns.iter().map(Vec::as_slice).collect();
            if candidate.retune {
                all.extend(retune.iter());
            }
            starts.push(start.solve(&all, &target));
        }
        starts
    }
}

/// Nonlinear parameters from which a fit may start.
#[derive(Default)]
pub struct Guess {
    pub input: Vec<f64>,
    /// Of each force.
    pub shapes: Vec<Vec<f64>>,
    pub output: Vec<f64>,
}

/// Size of a change of an input map's numbers that matters.
pub fn map_scale(part: &Part) -> f64 {
    match part.input.as_ref().map(InputMap::bare) {
        Some(InputMap::Delay) => 1.0,
        Some(InputMap::Free(_)) => 0.03,
        _ => 0.1,
    }
}

/// Shapes to try of one law.
fn shapes(law: &Law) -> Vec<Vec<f64>> {
    let each = |values: &[f64]| values.iter().map(|&v| vec![v]).collect::<Vec<_>>();
    match law {
        Law::Cubic => each(&[0.05, 0.7]),
        Law::BumpStop | Law::OneSided(_) | Law::Clearance => each(&[0.15, 0.4, 0.8, 1.2, 1.7, 2.3]),
        Law::Coulomb => each(&[-3.5, -2.3, -1.2]),
        Law::Hysteretic => {
            let of = |unloading: f64| [-3.0, -1.8, -0.7, 0.3].map(|limit| vec![limit, 0.3, unloading]);
            [0.0, -0.5, -1.2].into_iter().flat_map(of).collect()
        }
        Law::StiffnessDrift => each(&[0.0]),
        Law::Valve => each(&[0.05, 0.2, 0.4]),
        Law::Stribeck => {
            let mut all = Vec::new();
            for ve in [-3.5, -2.3] {
                for vs in [-1.5, 0.0] {
                    all.push(vec![ve, 1.0, vs]);
                }
            }
            all
        }
        _ => vec![Vec::new()],
    }
}

/// Collects parameters in their order.
struct Builder {
    p: Vec<f64>,
    scale: Vec<f64>,
    linear: Vec<bool>,
    known: usize,
    /// The logarithm of a size that least squares find a factor of.
    size: Option<usize>,
}

impl Builder {
    fn new(known: &[f64]) -> Self {
        Self {
            p: known.to_vec(),
            // A relative change of what is known already.
            scale: known.iter().map(|p| 0.3 * p.abs().max(1e-9)).collect(),
            linear: vec![false; known.len()],
            known: known.len(),
            size: None,
        }
    }

    /// The number before is the logarithm of the size of what was guessed so far.
    fn last_is_a_size(&mut self) {
        self.size = self.p.len().checked_sub(1);
    }

    fn nonlinear(&mut self, values: &[f64], scale: f64) {
        self.p.extend(values);
        self.scale.extend(values.iter().map(|_| scale));
        self.linear.extend(values.iter().map(|_| false));
    }

    fn linear(&mut self, count: usize) {
        self.p.extend(std::iter::repeat_n(0.0, count));
        self.scale.extend(std::iter::repeat_n(0.0, count));
        self.linear.extend(std::iter::repeat_n(true, count));
    }

    /// Fills the linear parameters by least squares; `columns` in their order, before them that of a size. A size that
    /// would go against its sign stays as it was guessed.
    fn solve(mut self, columns: &[&[f64]], target: &[f64]) -> Start {
        let mut x = least_squares(columns, target);
        if let Some(size) = self.size {
            let factor = 1.0 + x[0];
            if factor > LEAST_SIZE {
                self.p[size] += factor.ln();
            } else {
                x = least_squares(&columns[1..], target);
                x.insert(0, 0.0);
            }
        }
        let norm_of_target = norm(target);
        let mut left = target.to_vec();
        for (column, x) in columns.iter().zip(&x) {
            left.iter_mut().zip(*column).for_each(|(l, c)| *l -= x * c);
        }
        let of_size = usize::from(self.size.is_some());
        let places: Vec<usize> = (self.known..self.p.len()).filter(|&i| self.linear[i]).collect();
        for ((place, column), x) in places.iter().zip(&columns[of_size..]).zip(&x[of_size..]) {
            self.p[*place] = *x;
            self.scale[*place] = norm_of_target / norm(column).max(f64::MIN_POSITIVE);
        }
        Start { cost: dot(&left, &left), p: self.p, scale: self.scale, linear: self.linear }
    }
}

struct Alternated {
    shape: Vec<f64>,
    cost: f64,
}

/// `[state]` columns of a weighted sum of blocks.
fn combine(blocks: &[Vec<Vec<f64>>], shape: &[f64]) -> Vec<Vec<f64>> {
    let states = blocks[0].len();
    (0..states)
        .map(|n| {
            let mut sum = vec![0.0; blocks[0][n].len()];
            for (block, weight) in blocks.iter().zip(shape) {
                sum.iter_mut().zip(&block[n]).for_each(|(s, b)| *s += weight * b);
            }
            sum
        })
        .collect()
}

/// Rank-one fit `sum_q sum_n shape_q path_n block_qn` by least squares in turn.
fn alternate(
    blocks: &[Vec<Vec<f64>>],
    retune: &[&[f64]],
    with_retune: bool,
    mut shape: Vec<f64>,
    target: &[f64],
) -> Alternated {
    let extra: &[&[f64]] = if with_retune { retune } else { &[] };
    let mut cost = f64::INFINITY;
    for _ in 0..ALTERNATIONS {
        let by_state = combine(blocks, &shape);
        let mut columns: Vec<&[f64]> = by_state.iter().map(Vec::as_slice).collect();
        columns.extend(extra);
        let path = least_squares(&columns, target);
        let by_shape: Vec<Vec<f64>> = blocks
            .iter()
            .map(|block| {
                let mut sum = vec![0.0; target.len()];
                for (column, e) in block.iter().zip(&path) {
                    sum.iter_mut().zip(column).for_each(|(s, c)| *s += e * c);
                }
                sum
            })
            .collect();
        let mut columns: Vec<&[f64]> = by_shape.iter().map(Vec::as_slice).collect();
        columns.extend(extra);
        let x = least_squares(&columns, target);
        let next = x[..blocks.len()].to_vec();
        let mut left = target.to_vec();
        for (column, x) in columns.iter().zip(&x) {
            left.iter_mut().zip(*column).for_each(|(l, c)| *l -= x * c);
        }
        let size = norm(&next);
        if size.is_nan() || size <= 0.0 {
            break;
        }
        shape = next.iter().map(|c| c / size).collect();
        cost = dot(&left, &left);
    }
    Alternated { shape, cost }
}
