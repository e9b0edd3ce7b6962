//! The loop of a free run, linearised about it: one linear run a parameter, all of them side by side.
//!
//! The slopes of the laws along the run are the same for every parameter. They are taken a block of samples at a time,
//! and each group of lanes then runs over the block on the vectors of the machine.

use std::ops::Range;

use crate::diagnosis::core::modes::Pole;
use crate::diagnosis::effects::kernel::{self, MIDWAY, Scales, Window, weigh};
use crate::diagnosis::effects::law::{Instant, Law, Memory};
use crate::diagnosis::effects::plant::{Course, Plant};
use crate::simd::{Isa, Kernel, Simd, dispatch};

/// Step of the slopes of laws and maps, in units of their arguments' RMS or of a parameter's scale.
pub(super) const STEP: f64 = 1e-4;
/// Samples of a block: their slopes and one group's signals stay in the cache.
const BLOCK: usize = 64;

/// How a parameter enters the loop, beside what it adds to the signal outside.
#[derive(Clone, Copy)]
pub(super) enum Entry {
    /// Only from outside.
    Outside,
    /// A state's input from a force.
    Path { force: usize, state: usize },
    /// A shape number of a force.
    Shape { force: usize, number: usize },
}

/// A parameter's place.
pub(super) struct Lane {
    pub entry: Entry,
    /// What it adds outside the loop, per sample; empty for nothing.
    pub ext: Vec<f64>,
}

impl Lane {
    pub fn outside(ext: Vec<f64>) -> Self {
        Self { entry: Entry::Outside, ext }
    }

    pub fn of(entry: Entry) -> Self {
        Self { entry, ext: Vec::new() }
    }
}

/// A law that needs the response, with its numbers.
pub(super) struct Closed<'a> {
    pub law: &'a Law,
    pub shape: &'a [f64],
    pub path: &'a [f64],
    pub other: Vec<f64>,
}

/// The linearised loop for every lane at once, `[lane][sample]`; `y` is the run and `guesses` the next samples that its
/// laws saw.
pub(super) fn sensitivities(
    problem: &Plant,
    stretch: &Course,
    closed: &[Closed<'_>],
    lanes: &[Lane],
    (y, guesses): (&[f64], &[f64]),
    scale: &[f64],
) -> Vec<Vec<f64>> {
    let isa = Isa::of_plain_loops();
    let modes = &problem.core.modes;
    let structure = Structure {
        poles: modes.poles(),
        shown: modes.output_row().iter().map(|c| *c > 0.0).collect(),
        forces: closed
            .iter()
            .map(|c| Path { path: c.path, reach: modes.read(c.path), memories: c.law.memories() })
            .collect(),
    };
    let mut along = Along::new(problem, stretch, closed, lanes, scale);
    let mut signals: Vec<Vec<f64>> = vec![Vec::with_capacity(y.len()); lanes.len()];
    let (mut wide, mut half, mut narrow) = (Vec::new(), Vec::new(), Vec::new());
    let mut from = 0;
    while from < lanes.len() {
        let left = lanes.len() - from;
        from += if left > 16 {
            wide.push(Group::<32>::new(&structure, lanes, from));
            32
        } else if left > 8 {
            half.push(Group::<16>::new(&structure, lanes, from));
            16
        } else {
            narrow.push(Group::<8>::new(&structure, lanes, from));
            8
        };
    }
    let mut slopes = Vec::new();
    let mut shaped: Vec<Vec<f64>> = vec![Vec::new(); lanes.len()];
    for start in (0..y.len()).step_by(BLOCK) {
        let block = start..(start + BLOCK).min(y.len());
        along.next((y, guesses), block.clone(), &mut slopes, &mut shaped);
        let of = Block { structure: &structure, slopes: &slopes, shaped: &shaped, lanes, block };
        wide.iter_mut().for_each(|group| group.over(isa, &of, &mut signals));
        half.iter_mut().for_each(|group| group.over(isa, &of, &mut signals));
        narrow.iter_mut().for_each(|group| group.over(isa, &of, &mut signals));
    }
    signals
}

/// Slopes of one force at one instant: by the last three samples and the next, and by its memory.
struct Slopes {
    value: f64,
    by: Window,
    memory: Memory,
    /// Of the memory itself: by its own past, and by the change of the response.
    kept: Memory,
    gained: Memory,
}

fn slopes(
    closed: &Closed<'_>,
    memory: &mut Memory,
    instant: impl Fn(f64, f64) -> Instant,
    scales: Scales,
) -> Slopes {
    let at = |y: f64, change: f64, memory: &Memory| {
        let mut memory = *memory;
        let value = closed.law.at(closed.shape, instant(y, change), &mut memory);
        (value, memory)
    };
    let (y_step, change_step) = (STEP * scales.y, STEP * scales.dy);
    let before = *memory;
    let (value, after) = at(0.0, 0.0, &before);
    let by_y = (at(y_step, 0.0, &before).0 - at(-y_step, 0.0, &before).0) / (2.0 * y_step);
    let (up, up_memory) = at(0.0, change_step, &before);
    let (down, down_memory) = at(0.0, -change_step, &before);
    let by_change = (up - down) / (2.0 * change_step);
    let weights = kernel::change(closed.law);
    let mut found = Slopes {
        value,
        by: std::array::from_fn(|i| by_y * MIDWAY[i] + by_change * weights[i]),
        memory: Memory::default(),
        kept: Memory::default(),
        gained: Memory::default(),
    };
    for i in 0..closed.law.memories() {
        let mut moved = before;
        moved[i] += STEP;
        let (there, there_memory) = at(0.0, 0.0, &moved);
        found.memory[i] = (there - value) / STEP;
        found.kept[i] = (there_memory[i] - after[i]) / STEP;
        found.gained[i] = (up_memory[i] - down_memory[i]) / (2.0 * change_step);
    }
    *memory = after;
    found
}

/// A law with one of its shape numbers moved, along the same response.
struct Shaped {
    lane: usize,
    force: usize,
    shape: Vec<f64>,
    step: f64,
    memory: Memory,
}

/// The laws along the run, block by block.
struct Along<'a> {
    closed: &'a [Closed<'a>],
    stretch: &'a Course,
    scales: Scales,
    shaped: Vec<Shaped>,
    states: Vec<Memory>,
    past: Option<[f64; 3]>,
}

impl<'a> Along<'a> {
    fn new(
        problem: &Plant,
        stretch: &'a Course,
        closed: &'a [Closed<'a>],
        lanes: &[Lane],
        scale: &[f64],
    ) -> Self {
        let shaped = |(lane, Lane { entry, .. }): (usize, &Lane)| {
            let Entry::Shape { force, number } = *entry else { return None };
            let (mut shape, step) = (closed[force].shape.to_vec(), STEP * scale[lane]);
            shape[number] += step;
            Some(Shaped { lane, force, shape, step, memory: Memory::default() })
        };
        Self {
            closed,
            stretch,
            scales: problem.scales,
            shaped: lanes.iter().enumerate().filter_map(shaped).collect(),
            states: vec![Memory::default(); closed.len()],
            past: None,
        }
    }

    /// Slopes `[sample][force]` of the samples of a block that have a next one, and what the shape number of each lane
    /// changes of its force there, `[lane][sample]`.
    fn next(
        &mut self,
        (y, guesses): (&[f64], &[f64]),
        block: Range<usize>,
        found: &mut Vec<Slopes>,
        changes: &mut [Vec<f64>],
    ) {
        found.clear();
        self.shaped.iter().for_each(|shaped| changes[shaped.lane].clear());
        let (closed, scales, clock) = (self.closed, self.scales, self.stretch.clock);
        for k in block.start..block.end.min(y.len() - 1) {
            let t = clock.start + clock.step * (k as f64 + 0.5);
            let now = y[k] - scales.y_mean;
            let [_, before, last] = self.past.unwrap_or([now; 3]);
            self.past = Some([before, last, now]);
            let seen = [before, last, now, guesses[k]];
            let instant = |force: &Closed<'_>, y_moved: f64, change_moved: f64| {
                let (y, change) = (weigh(&MIDWAY, &seen), weigh(kernel::change(force.law), &seen));
                scales.instant(y + y_moved, change + change_moved, t, kernel::midway(&force.other, k))
            };
            let at = found.len();
            for (c, memory) in closed.iter().zip(&mut self.states) {
                found.push(slopes(c, memory, |y, change| instant(c, y, change), scales));
            }
            for Shaped { lane, force, shape, step, memory } in &mut self.shaped {
                let c = &closed[*force];
                let value = c.law.at(shape, instant(c, 0.0, 0.0), memory);
                changes[*lane].push((value - found[at + *force].value) / *step);
            }
        }
    }
}

/// How a force enters the states.
struct Path<'a> {
    path: &'a [f64],
    reach: f64,
    memories: usize,
}

/// What all lanes share of the loop.
struct Structure<'a> {
    poles: &'a [Pole],
    /// Whether the response shows a state, `[state]`.
    shown: Vec<bool>,
    forces: Vec<Path<'a>>,
}

/// A block of the run.
struct Block<'a> {
    structure: &'a Structure<'a>,
    slopes: &'a [Slopes],
    shaped: &'a [Vec<f64>],
    lanes: &'a [Lane],
    block: Range<usize>,
}

/// A lane of a group that is a state's input from a force.
struct Input {
    lane: usize,
    force: usize,
    state: usize,
    /// Whether the response shows the state.
    shown: bool,
}

/// Some lanes side by side: where they are in the run. Those beyond the last stay at rest.
struct Group<const W: usize> {
    /// The lanes.
    range: Range<usize>,
    /// `[state]`
    x: Vec<[f64; W]>,
    /// Memories of all forces.
    z: Vec<[f64; W]>,
    /// The last two samples, and this one; oldest first.
    past: [[f64; W]; 3],
    /// What each force does.
    pushes: Vec<[f64; W]>,
    /// Those that are a state's input from a force.
    inputs: Vec<Input>,
    /// Those that are a shape number: lane of the group, lane of all, force.
    shapes: Vec<[usize; 3]>,
    /// Signals from outside of a block and the sample after it, `[sample]`.
    ext: Vec<[f64; W]>,
    /// The lanes' signals of a block, `[sample]`.
    out: Vec<[f64; W]>,
}

impl<const W: usize> Group<W> {
    fn new(structure: &Structure<'_>, lanes: &[Lane], from: usize) -> Self {
        let range = from..(from + W).min(lanes.len());
        let of = range.clone().map(|lane| (lane - from, lanes[lane].entry));
        let inputs = of.clone().filter_map(|(lane, entry)| match entry {
            Entry::Path { force, state } => Some(Input { lane, force, state, shown: structure.shown[state] }),
            _ => None,
        });
        let shapes = of.clone().filter_map(|(lane, entry)| match entry {
            Entry::Shape { force, .. } => Some([lane, from + lane, force]),
            _ => None,
        });
        let memories = structure.forces.iter().map(|force| force.memories).sum();
        Self {
            x: vec![[0.0; W]; structure.shown.len()],
            z: vec![[0.0; W]; memories],
            past: [[0.0; W]; 3],
            pushes: vec![[0.0; W]; structure.forces.len()],
            inputs: inputs.collect(),
            shapes: shapes.collect(),
            ext: vec![[0.0; W]; BLOCK + 1],
            out: vec![[0.0; W]; BLOCK],
            range,
        }
    }

    /// Runs over a block, and adds what the lanes say there to their signals.
    fn over(&mut self, isa: Isa, of: &Block<'_>, signals: &mut [Vec<f64>]) {
        for (lane, at) in self.range.clone().zip(0..W) {
            let ext = of.lanes[lane].ext.iter().skip(of.block.start);
            self.ext.iter_mut().zip(ext).for_each(|(row, e)| row[at] = *e);
        }
        dispatch(isa, Steps { of, group: self });
        for (lane, at) in self.range.clone().zip(0..W) {
            signals[lane].extend(self.out[..of.block.len()].iter().map(|row| row[at]));
        }
    }
}

/// The steps of one group over a block.
struct Steps<'a, const W: usize> {
    of: &'a Block<'a>,
    group: &'a mut Group<W>,
}

impl<const W: usize> Kernel for Steps<'_, W> {
    type Out = ();
    const WIDE: bool = false;

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let Block { structure, slopes, shaped, ref block, .. } = *self.of;
        let Group { x, z, past, pushes, inputs, shapes, ext, out, .. } = self.group;
        let Structure { poles, shown, forces } = structure;
        for k in 0..block.len() {
            let mut now = ext[k];
            read(shown, x, &mut now);
            *past = [past[1], past[2], now];
            out[k] = now;
            let found = &slopes[(k * forces.len()).min(slopes.len())..];
            if found.is_empty() {
                break;
            }
            turn(poles, x);
            let mut next = ext[k + 1];
            read(shown, x, &mut next);
            // First pass: the next sample from the last three.
            let mut guess = [0.0; W];
            for l in 0..W {
                guess[l] = kernel::extrapolate([past[0][l], past[1][l], past[2][l]]);
            }
            let mut row = 0;
            for q in 0..forces.len() {
                let ([a, b, d, e], push) = (found[q].by, &mut pushes[q]);
                for l in 0..W {
                    push[l] = a * past[0][l] + b * past[1][l] + d * past[2][l] + e * guess[l];
                }
                for i in 0..forces[q].memories {
                    add(found[q].memory[i], &z[row], push);
                    row += 1;
                }
            }
            for &[lane, of_all, force] in shapes.iter() {
                pushes[force][lane] += shaped[of_all][k];
            }
            for q in 0..forces.len() {
                add(forces[q].reach, &pushes[q], &mut next);
            }
            for Input { lane, force, state, shown } in inputs.iter() {
                x[*state][*lane] += found[*force].value;
                if *shown {
                    next[*lane] += found[*force].value;
                }
            }
            // Second pass: the forces midway, into the states.
            let mut row = 0;
            for q in 0..forces.len() {
                let (slope, push) = (found[q].by[3], &mut pushes[q]);
                for l in 0..W {
                    push[l] += slope * (next[l] - guess[l]);
                }
                for (x, e) in x.iter_mut().zip(forces[q].path) {
                    add(*e, push, x);
                }
                for i in 0..forces[q].memories {
                    let (kept, gained) = (found[q].kept[i], found[q].gained[i]);
                    for l in 0..W {
                        z[row][l] = kept * z[row][l] + gained * (next[l] - past[2][l]);
                    }
                    row += 1;
                }
            }
        }
    }
}

/// `to += factor * of` of every lane.
#[inline(always)]
fn add<const W: usize>(factor: f64, of: &[f64; W], to: &mut [f64; W]) {
    for l in 0..W {
        to[l] += factor * of[l];
    }
}

/// `to += C x` of every lane.
#[inline(always)]
fn read<const W: usize>(shown: &[bool], x: &[[f64; W]], to: &mut [f64; W]) {
    for (x, shown) in x.iter().zip(shown) {
        if *shown {
            add(1.0, x, to);
        }
    }
}

/// `x <- A x` of every lane.
#[inline(always)]
fn turn<const W: usize>(poles: &[Pole], x: &mut [[f64; W]]) {
    let mut at = 0;
    for pole in poles {
        match *pole {
            Pole::Real(p) => {
                for x in &mut x[at] {
                    *x *= p;
                }
                at += 1;
            }
            Pole::Pair(p) => {
                let (a, b) = (x[at], x[at + 1]);
                for l in 0..W {
                    x[at][l] = p.re * a[l] - p.im * b[l];
                    x[at + 1][l] = p.im * a[l] + p.re * b[l];
                }
                at += 2;
            }
        }
    }
}
