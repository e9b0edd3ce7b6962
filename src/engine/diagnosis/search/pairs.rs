//! Two effects at once. Either alone may fit no better than a third that mimics both, so pairs are
//! regressed jointly: with shapes given, what two effects add to the response is linear in the paths of
//! both. The pairs that leave least are then fitted as free runs.

use rayon::prelude::*;

use super::decide::charged;
use super::naming::{not_collocated, passivity};
use super::score::remaining;
use crate::diagnosis::data::problem::{Stretch, scored_rows};
use crate::diagnosis::effects::candidate::{Candidate, Part};
use crate::diagnosis::effects::effect::{Effect, Tier};
use crate::diagnosis::effects::input_map::InputMap;
use crate::diagnosis::effects::output_map::OutputMap;
use crate::diagnosis::fit::fitting::{Effort, Fitted, finish, improve, tolerant};
use crate::diagnosis::fit::start::{Guess, Regression, Start, map_scale};
use crate::diagnosis::numerics::linear::{dot, least_squares, norm, solve_spd};

/// Pairs whose free runs are fitted, those that go on, those that are fitted to their end; each with the
/// Jacobians that it may take.
const ROUNDS: [(usize, usize); 3] = [(16, 4), (6, 8), (2, 25)];
/// Share of a unit column's square that keeps parallel columns harmless.
const RIDGE: f64 = 1e-9;

/// A fitted pair.
pub struct Pair {
    pub fitted: Fitted,
    /// Mean square in noise floors on the select stretches.
    pub chi2: f64,
    /// Whether one of its forces is none of this response's.
    pub not_collocated: bool,
}

/// How one effect may begin: its parameters, and the rows that each number which is linear moves.
struct Beginning<'p> {
    part: &'p Part,
    /// Parameters, the linear ones at 0, and the size of a change of each that matters.
    p: Vec<f64>,
    scale: Vec<f64>,
    /// Parameter that each column is of; none for a map that is no sum of its numbers, whose column
    /// only tells what it closes.
    of: Vec<Option<usize>>,
    columns: Vec<Vec<f64>>,
}

impl<'p> Beginning<'p> {
    fn nonlinear(part: &'p Part, p: Vec<f64>, scale: f64) -> Self {
        Self { part, scale: vec![scale; p.len()], p, of: Vec::new(), columns: Vec::new() }
    }

    /// A further linear parameter that moves the rows by `column`.
    fn linear(&mut self, column: Vec<f64>) {
        self.of.push(Some(self.p.len()));
        self.p.push(0.0);
        self.scale.push(0.0);
        self.columns.push(column);
    }
}

/// The pair of effects that leaves least of the select stretches, simpler ones preferred; `with` must be
/// one of the two, if it is given. None where no pair's free run stays finite.
pub fn best_pair(
    regression: &Regression<'_>,
    parts: &[Part],
    retune: bool,
    with: Option<Effect>,
) -> Option<Pair> {
    let problem = regression.problem;
    let target = problem.rows(&problem.fit, |s| s.gap(problem.response));
    let beginnings = beginnings(regression, parts);
    let bare = regression.retune(retune);
    let table = Table::new(&beginnings, &bare, &target);
    let mut pairs: Vec<(f64, usize, usize)> = Vec::new();
    for (i, a) in beginnings.iter().enumerate() {
        for (j, b) in beginnings.iter().enumerate().skip(i + 1) {
            let named = with.is_none_or(|effect| a.part.effect == effect || b.part.effect == effect);
            if a.part.effect != b.part.effect && named {
                pairs.push((table.left(i, j), i, j));
            }
        }
    }
    pairs.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut chosen: Vec<(usize, usize)> = Vec::new();
    for &(_, i, j) in &pairs {
        let same = |a: usize, b: usize| std::ptr::eq(beginnings[a].part, beginnings[b].part);
        if chosen.iter().all(|&(a, b)| !(same(a, i) && same(b, j))) {
            chosen.push((i, j));
        }
        if chosen.len() == ROUNDS[0].0 {
            break;
        }
    }
    let mut tried: Vec<Fitted> = chosen
        .par_iter()
        .filter_map(|&(i, j)| {
            let (a, b) = (&beginnings[i], &beginnings[j]);
            let candidate = Candidate { parts: vec![a.part.clone(), b.part.clone()], retune };
            let effort = Effort { rounds: ROUNDS[0].1 };
            improve(problem, &candidate, &joint(a, b, &bare, &target), effort)
        })
        .collect();
    for (count, rounds) in &ROUNDS[1..] {
        tried.sort_by(|a, b| a.chi2_fit.total_cmp(&b.chi2_fit));
        tried.truncate(*count);
        tried = tried.into_par_iter().map(|f| finish(problem, f, Effort { rounds: *rounds })).collect();
    }
    let least = tried.iter().map(|f| f.chi2_fit).fold(f64::INFINITY, f64::min);
    tried = tried.into_par_iter().map(|f| tolerant(problem, f, least)).collect();
    let none = problem.chi2_none(&problem.select);
    let rows = scored_rows(&problem.select);
    let charged = |pair: &Pair| charged(&pair.fitted.candidate.parts, remaining(pair.chi2, none), none, rows);
    let finished: Vec<Pair> = tried
        .into_iter()
        .filter_map(|fitted| {
            let predictions = fitted.candidate.predictions(problem, &problem.select, &fitted.p)?;
            let chi2 = problem.chi2(&problem.select, &predictions);
            let not_collocated =
                not_collocated(problem, &fitted.candidate, passivity(problem, &fitted, &predictions));
            Some(Pair { chi2, not_collocated, fitted })
        })
        .collect();
    finished.into_iter().min_by(|a, b| charged(a).total_cmp(&charged(b)))
}

/// Every beginning of each effect: which is best alone says little of which is best beside another.
fn beginnings<'p>(regression: &Regression<'_>, parts: &'p [Part]) -> Vec<Beginning<'p>> {
    let pairs_up = |part: &&Part| {
        part.effect.tier() != Tier::Free && !part.sandwich && part.effect != Effect::LinearChange
    };
    parts
        .par_iter()
        .filter(pairs_up)
        .flat_map_iter(|part| {
            let mut guesses = regression.guesses(part);
            if is_sum(part) {
                // Its numbers are solved for: every guess begins alike.
                guesses.truncate(1);
            }
            guesses.into_iter().map(move |guess| begin(regression, part, &guess))
        })
        .collect()
}

fn begin<'p>(regression: &Regression<'_>, part: &'p Part, guess: &Guess) -> Beginning<'p> {
    let problem = regression.problem;
    if let Some(map) = &part.input {
        let column = |p: &[f64]| {
            problem.rows(&problem.fit, |s| {
                problem.path(part.drive, map.change(p, &problem.drive(s, part.drive)))
            })
        };
        return by_numbers(part, &guess.input, map_scale(part), column);
    }
    if let Some(map) = part.output {
        let change = |s: &Stretch, p: &[f64]| -> Vec<f64> {
            let now = &s.simulated[problem.response];
            let mut there = now.clone();
            problem.sense(map, p, s, &mut there);
            there.iter().zip(now).map(|(a, b)| a - b).collect()
        };
        let column = |p: &[f64]| problem.rows(&problem.fit, |s| change(s, p));
        return by_numbers(part, &guess.output, 0.1, column);
    }
    let mut beginning = Beginning::nonlinear(part, Vec::new(), 0.0);
    for (law, shape) in part.forces.iter().zip(&guess.shapes) {
        beginning.p.extend(shape);
        beginning.scale.extend(shape.iter().map(|_| 0.3));
        for column in regression.path_columns(law, shape, part.other) {
            beginning.linear(column);
        }
    }
    beginning
}

/// Whether an effect is a map of a drive or a response that is a sum over its numbers.
fn is_sum(part: &Part) -> bool {
    matches!(part.input, Some(InputMap::Gain | InputMap::Polynomial))
        || matches!(part.output, Some(OutputMap::Offset | OutputMap::Gain | OutputMap::Polynomial))
}

/// A map whose numbers are either linear, each with a column of its own, or guessed.
fn by_numbers<'p>(
    part: &'p Part,
    guess: &[f64],
    scale: f64,
    column: impl Fn(&[f64]) -> Vec<f64>,
) -> Beginning<'p> {
    if !is_sum(part) {
        let mut beginning = Beginning::nonlinear(part, guess.to_vec(), scale);
        beginning.columns.push(column(guess));
        beginning.of.push(None);
        return beginning;
    }
    let mut beginning = Beginning::nonlinear(part, Vec::new(), scale);
    for i in 0..guess.len() {
        let mut unit = vec![0.0; guess.len()];
        unit[i] = 1.0;
        beginning.linear(column(&unit));
    }
    beginning
}

/// Inner products of all columns with each other and with the target, each of unit length.
struct Table {
    products: Vec<Vec<f64>>,
    with_target: Vec<f64>,
    target: f64,
    /// Where the columns of each beginning stand; those that go with all come last.
    spans: Vec<std::ops::Range<usize>>,
    always: std::ops::Range<usize>,
}

impl Table {
    fn new(beginnings: &[Beginning<'_>], always: &[&[f64]], target: &[f64]) -> Self {
        let mut spans = Vec::with_capacity(beginnings.len());
        let mut columns: Vec<Vec<f64>> = Vec::new();
        let mut add = |of: &[f64]| {
            let length = norm(of);
            let unit = if length > 0.0 && length.is_finite() { 1.0 / length } else { 0.0 };
            columns.push(of.iter().map(|x| if unit > 0.0 { x * unit } else { 0.0 }).collect());
            columns.len()
        };
        let mut end = 0;
        for beginning in beginnings {
            let from = end;
            for column in &beginning.columns {
                end = add(column);
            }
            spans.push(from..end);
        }
        let first = end;
        for column in always {
            end = add(column);
        }
        let products = columns
            .par_iter()
            .enumerate()
            .map(|(i, a)| columns[..=i].iter().map(|b| dot(a, b)).collect())
            .collect();
        let with_target = columns.iter().map(|c| dot(c, target)).collect();
        Self { products, with_target, target: dot(target, target), spans, always: first..end }
    }

    /// Sum of squares that two beginnings together leave of the target.
    fn left(&self, i: usize, j: usize) -> f64 {
        let (i, j) = (self.spans[i].clone(), self.spans[j].clone());
        let places: Vec<usize> = i.chain(j).chain(self.always.clone()).collect();
        let product = |a: usize, b: usize| self.products[a.max(b)][a.min(b)];
        let matrix: Vec<Vec<f64>> = places
            .iter()
            .map(|&a| places.iter().map(|&b| product(a, b) + if a == b { RIDGE } else { 0.0 }).collect())
            .collect();
        let rhs: Vec<f64> = places.iter().map(|&a| self.with_target[a]).collect();
        match solve_spd(&matrix, &rhs) {
            Some(x) => self.target - dot(&x, &rhs),
            None => self.target,
        }
    }
}

/// Parameters of both with their linear numbers by least squares.
fn joint(a: &Beginning<'_>, b: &Beginning<'_>, bare: &[&[f64]], target: &[f64]) -> Start {
    let columns: Vec<&[f64]> =
        a.columns.iter().chain(&b.columns).map(Vec::as_slice).chain(bare.iter().copied()).collect();
    let x = least_squares(&columns, target);
    let count = a.p.len() + b.p.len();
    let mut p: Vec<f64> = a.p.iter().chain(&b.p).copied().collect();
    let mut scale: Vec<f64> = a.scale.iter().chain(&b.scale).copied().collect();
    let mut linear = vec![false; count];
    p.resize(count + bare.len(), 0.0);
    scale.resize(count + bare.len(), 0.0);
    linear.resize(count + bare.len(), true);
    let of_b = b.of.iter().map(|place| place.map(|i| i + a.p.len()));
    let of_bare = (count..count + bare.len()).map(Some);
    let size = norm(target);
    for ((place, column), x) in a.of.iter().copied().chain(of_b).chain(of_bare).zip(&columns).zip(&x) {
        if let Some(i) = place {
            p[i] = *x;
            scale[i] = size / norm(column).max(f64::MIN_POSITIVE);
            linear[i] = true;
        }
    }
    Start { p, scale, cost: f64::NAN, linear }
}
