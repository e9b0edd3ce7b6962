//! A law at a place on top of a linear part, simulated forward: a free run that never sees a measured response.
//!
//! Every output is a sum of impulse responses: of the drives, and of the law's signals. Where the law's argument is
//! a response, or the difference of two, its value follows from the drives and from what the law did before, sample
//! by sample; where it is a drive, nothing is fed back.

use std::borrow::Cow;
use std::ops::Range;

use serde::{Deserialize, Serialize};

use super::band::Thinner;
use super::kernel::{HeldSums, Kernel, RunningSums};
use super::law::{Instant, Law, Scale};
use super::memory::Memory;
use super::motion::{Limits, Motion, motion};
use super::past::Past;
use super::place::{Place, Seen};
use crate::diagnosis::numerics::linear::dot;
use crate::resample::resample;
use crate::{Quantity, Signal};

/// Beyond this many deviations of its argument a run has diverged.
const RUNAWAY: f64 = 300.0;

/// Where an argument comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum Source {
    /// A drive, as it is commanded.
    Drive { channel: usize, quantity: Quantity },
    /// What the linear part alone says of a response.
    Linear(usize),
    /// An output of the free run itself.
    Output(usize),
    /// The same where the output is the rate of the argument.
    LinearRate(usize),
    /// See [`Self::LinearRate`].
    OutputRate(usize),
}

impl Source {
    /// The same by what the linear part alone says.
    pub fn opened(self) -> Self {
        match self {
            Self::Output(output) => Self::Linear(output),
            Self::OutputRate(output) => Self::LinearRate(output),
            known => known,
        }
    }

    /// The output that it is, of the free run or of the linear part.
    fn output(self) -> Option<usize> {
        match self {
            Self::Drive { .. } => None,
            Self::Linear(o) | Self::Output(o) | Self::LinearRate(o) | Self::OutputRate(o) => Some(o),
        }
    }

    /// The same where the outputs stand elsewhere.
    fn moved(self, to: impl Fn(usize) -> usize) -> Self {
        match self {
            Self::Drive { .. } => self,
            Self::Linear(o) => Self::Linear(to(o)),
            Self::Output(o) => Self::Output(to(o)),
            Self::LinearRate(o) => Self::LinearRate(to(o)),
            Self::OutputRate(o) => Self::OutputRate(to(o)),
        }
    }

    fn is_a_drive(self) -> bool {
        self.output().is_none()
    }

    /// Whether it depends on what the law does.
    fn is_fed_back(self) -> bool {
        self.opened() != self
    }
}

/// A signal that the free run makes: a response, or an argument that is none.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Output {
    pub offset: f64,
    /// Offset of the linear part alone.
    pub offset_before: f64,
    /// Of each drive, beside the law.
    pub linear: Vec<Kernel>,
    /// Of each drive, of the linear part alone.
    pub before: Vec<Kernel>,
    /// Of each signal: the law's, then the unbent arguments.
    pub kernels: Vec<Kernel>,
}

impl Output {
    /// That of a response which neither drives nor the law reach.
    fn silent(drives: usize, signals: usize) -> Self {
        let none = |count| vec![Kernel::default(); count];
        Self {
            offset: 0.0,
            offset_before: 0.0,
            linear: none(drives),
            before: none(drives),
            kernels: none(signals),
        }
    }

    /// All of its impulse responses.
    fn all(&self) -> impl Iterator<Item = &Kernel> {
        self.linear.iter().chain(&self.before).chain(&self.kernels)
    }
}

/// A law at a place on top of a linear part.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Forward {
    pub(super) law: Law,
    pub(super) place: Place,
    pub(super) other: Option<Place>,
    pub(super) argument: (Source, Scale),
    pub(super) second: Option<(Source, Scale)>,
    /// Samples a second of the recording, and how many of them make one of the analysis.
    pub(super) rate_hz: f64,
    pub(super) step: usize,
    pub(super) limits: Limits,
    pub(super) drive_mean: Vec<f64>,
    /// Number of responses; further outputs are arguments.
    pub(super) responses: usize,
    pub(super) outputs: Vec<Output>,
    /// How the outputs that are arguments follow from responses, for a law beside known effects.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(super) seen: Vec<Seen>,
}

/// Drives of one record.
pub(super) struct Course<'a> {
    /// At the recording's own rate.
    pub whole: Vec<&'a [f64]>,
    /// At the rate of the analysis.
    pub thin: Vec<&'a [f64]>,
    /// The programme's time of its first and last sample.
    pub clock: [f64; 2],
    /// What known effects add to each output, at the rate of the analysis; empty without any.
    pub added: Vec<Cow<'a, [f64]>>,
}

impl Course<'_> {
    /// Adds what known effects do to an output.
    fn add(&self, output: usize, to: &mut [f64]) {
        if let Some(added) = self.added.get(output) {
            to.iter_mut().zip(added.iter()).for_each(|(x, added)| *x += added);
        }
    }
}

/// A free run at the rate of the analysis.
pub(super) struct Run {
    /// `[output][sample]`.
    pub outputs: Vec<Vec<f64>>,
    /// `[signal][sample]`.
    pub signals: Vec<Vec<f64>>,
}

/// What a forward model makes of drives, at the recording's rate.
#[derive(Debug, Clone)]
pub struct Simulated {
    /// A response with the law.
    pub augmented: Vec<f64>,
    /// The same by the linear part alone.
    pub linear: Vec<f64>,
}

/// A law in terms of a drive: what that drive would have to do instead.
#[derive(Debug, Clone)]
pub struct AsDrive {
    /// The drive.
    pub drive: usize,
    /// Its samples at the rate of the analysis.
    pub samples: Vec<f64>,
    /// Factor of each of the law's signals.
    factors: Vec<f64>,
}

/// What a number of a law counts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NumberOf {
    /// Its argument.
    Argument,
    /// The rate of its argument.
    Rate,
    /// Cycles a second.
    Frequency,
    /// A ratio.
    Ratio,
}

/// A number of a law.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Number {
    /// Its name.
    pub name: &'static str,
    /// Its value.
    pub value: f64,
    /// What it counts.
    pub of: NumberOf,
}

/// Bounds on what is read from a file.
const MOST_TAPS: usize = 1 << 20;
const LARGEST: f64 = 1e15;
const MOST_KINKS: usize = 64;
/// How far a law's curve reaches, in deviations of its argument.
const REACH: f64 = 3.0;

/// One sample after the other of an argument: what is known of it beforehand, and what the law's past adds where it is
/// fed back.
struct Feed {
    known: Vec<f64>,
    past: Option<Past>,
}

impl Feed {
    fn at(&mut self, t: usize, signals: &[Vec<f64>]) -> f64 {
        self.known[t] + self.past.as_mut().map_or(0.0, |past| past.at(t, signals))
    }
}

impl Forward {
    /// Leaves out what no impulse response needs.
    pub(super) fn trimmed(mut self) -> Self {
        for output in &mut self.outputs {
            let lists = [&mut output.linear, &mut output.before, &mut output.kernels];
            lists.into_iter().flatten().for_each(Kernel::trim);
        }
        self
    }

    /// A law on some responses of a rig as one on all `count` of them, the others of which it leaves silent; `kept` says
    /// which they were.
    pub(in crate::diagnosis) fn among(self, kept: &[usize], count: usize) -> Self {
        let (few, signals) = (self.responses, self.signals());
        let place = |output: usize| kept.get(output).copied().unwrap_or_else(|| output - few + count);
        let moved = |(source, scale): (Source, Scale)| (source.moved(place), scale);
        let mut outputs = vec![Output::silent(self.drive_mean.len(), signals); count];
        let mut own = self.outputs.into_iter();
        kept.iter().zip(&mut own).for_each(|(&r, output)| outputs[r] = output);
        outputs.extend(own);
        Self {
            place: self.place.among(kept),
            other: self.other.map(|place| place.among(kept)),
            argument: moved(self.argument),
            second: self.second.map(moved),
            responses: count,
            outputs,
            seen: self.seen.into_iter().map(|seen| seen.among(kept)).collect(),
            ..self
        }
    }

    /// Number of drives and of responses.
    pub(in crate::diagnosis) fn channels(&self) -> (usize, usize) {
        (self.drive_mean.len(), self.responses)
    }

    /// Number of signals: the law's, and an unbent one of each argument.
    pub(super) fn signals(&self) -> usize {
        self.law.count() + 1 + usize::from(self.second.is_some())
    }

    /// Whether the law's argument depends on what the law does.
    pub(super) fn feeds_back(&self) -> bool {
        self.argument.0.is_fed_back() || self.second.is_some_and(|s| s.0.is_fed_back())
    }

    /// Whether the law's argument is a motion of the structure.
    pub(super) fn is_over_a_motion(&self) -> bool {
        let motion = |source: Source| {
            source.is_fed_back() || source.output().is_some_and(|output| output >= self.responses)
        };
        motion(self.argument.0) || self.second.is_some_and(|s| motion(s.0))
    }

    /// Free run of a record; `None` where it diverges.
    pub(super) fn run(&self, course: &Course<'_>) -> Option<Run> {
        let signals = if self.feeds_back() { self.in_loop(course)? } else { self.open(course) };
        let outputs = self.outputs_of(course, &signals);
        outputs.iter().flatten().all(|y| y.is_finite()).then_some(Run { outputs, signals })
    }

    /// Samples a second of the analysis.
    fn analysis_hz(&self) -> f64 {
        self.rate_hz / self.step as f64
    }

    /// Outputs that follow from drives and signals, at the rate of the analysis.
    pub(super) fn outputs_of(&self, course: &Course<'_>, signals: &[Vec<f64>]) -> Vec<Vec<f64>> {
        let output = |output: &Output| {
            let mut y = self.linear(&output.linear, course);
            for (kernel, signal) in output.kernels.iter().zip(signals) {
                y.iter_mut().zip(kernel.apply(signal)).for_each(|(y, more)| *y += more);
            }
            y.iter_mut().for_each(|y| *y += output.offset);
            y
        };
        self.outputs.iter().map(output).collect()
    }

    /// Sum over rows of what drives and signals make of each output, and of what the linear part alone does, both without
    /// their offsets.
    pub(super) fn sums_over(
        &self,
        drives: &[HeldSums],
        signals: &[RunningSums],
        rows: &Range<usize>,
    ) -> Vec<[f64; 2]> {
        let of_drives = |kernels: &[Kernel]| -> f64 {
            let held = kernels.iter().zip(drives).zip(&self.drive_mean);
            held.map(|((kernel, u), mean)| kernel.sum_over_held(u, *mean, rows)).sum()
        };
        let of_output = |output: &Output| {
            let law: f64 =
                output.kernels.iter().zip(signals).map(|(kernel, x)| kernel.sum_over(x, rows)).sum();
            [of_drives(&output.linear) + law, of_drives(&output.before)]
        };
        self.outputs.iter().map(of_output).collect()
    }

    /// What the drives alone do.
    pub(super) fn linear(&self, kernels: &[Kernel], course: &Course<'_>) -> Vec<f64> {
        let n = course.thin.first().map_or(0, |u| u.len());
        let mut y = vec![0.0; n];
        for ((kernel, u), mean) in kernels.iter().zip(&course.thin).zip(&self.drive_mean) {
            y.iter_mut().zip(kernel.apply_held(u, *mean)).for_each(|(y, more)| *y += more);
        }
        y
    }

    /// What the linear part alone makes of an output, with what known effects add to it.
    fn linear_output(&self, output: usize, course: &Course<'_>) -> Vec<f64> {
        let of = &self.outputs[output];
        let mut y = self.linear(&of.before, course);
        y.iter_mut().for_each(|y| *y += of.offset_before);
        course.add(output, &mut y);
        y
    }

    /// The motion of an argument that is known beforehand, at the recording's rate or, of the linear part's output, at that of
    /// the analysis. Where the output is a rate, the displacement is not known, and the rate stands for it.
    fn known(&self, source: Source, course: &Course<'_>) -> Motion {
        match source {
            Source::Drive { channel, quantity } => {
                motion(course.whole[channel], quantity, self.rate_hz, self.limits)
            }
            Source::LinearRate(output) | Source::OutputRate(output) => {
                let v = self.linear_output(output, course);
                Motion { d: v.clone(), v }
            }
            // Of an argument that is no response.
            Source::Linear(output) | Source::Output(output) if output >= self.responses => {
                let d = self.linear_output(output, course);
                let limits = Limits { low_hz: 0.0, high_hz: self.analysis_hz() };
                motion(&d, Quantity::Displacement, self.analysis_hz(), limits)
            }
            Source::Linear(response) | Source::Output(response) => {
                let level: f64 = self.outputs[response]
                    .before
                    .iter()
                    .zip(&course.thin)
                    .zip(&self.drive_mean)
                    .map(|((h, u), mean)| (u.first().copied().unwrap_or(*mean) - mean) * h.sum())
                    .sum();
                let mut d = self.linear(&self.outputs[response].before, course);
                d.iter_mut().for_each(|d| *d -= level);
                course.add(response, &mut d);
                let v = std::iter::once(0.0).chain(d.windows(2).map(|w| w[1] - w[0])).collect();
                Motion { d, v }
            }
        }
    }

    /// The same at the rate of the analysis.
    fn known_thinned(&self, source: Source, course: &Course<'_>) -> Motion {
        let known = self.known(source, course);
        if !source.is_a_drive() {
            return known;
        }
        let thinner = Thinner::new(self.step);
        Motion { d: thinner.thin(&known.d), v: thinner.thin(&known.v) }
    }

    /// Signals of a law that nothing is fed back to.
    fn open(&self, course: &Course<'_>) -> Vec<Vec<f64>> {
        let (source, scale) = self.argument;
        // A law is taken at the recording's rate where all that it sees is known there.
        let whole = source.is_a_drive() && self.second.is_none_or(|s| s.0.is_a_drive());
        let motion_of =
            |source| if whole { self.known(source, course) } else { self.known_thinned(source, course) };
        let thinner = Thinner::new(self.step);
        let thin = |x: &[f64]| if whole { thinner.thin(x) } else { x.to_vec() };
        let argument = motion_of(source);
        let second = self.second.map(|(source, scale)| (scale, motion_of(source)));
        let beside: Option<Vec<f64>> =
            second.as_ref().map(|(scale, m)| m.d.iter().map(|d| (d - scale.centre) / scale.d).collect());
        let rate = if whole { self.rate_hz } else { self.analysis_hz() };
        let signals = self.law.signals(&argument, scale, rate, course.clock, beside.as_deref());
        let mut out: Vec<Vec<f64>> = signals.iter().map(|x| thin(x)).collect();
        out.push(thin(&argument.d));
        out.extend(second.map(|(_, m)| thin(&m.d)));
        out
    }

    fn feed(&self, source: Source, course: &Course<'_>) -> Feed {
        let (true, Some(output)) = (source.is_fed_back(), source.output()) else {
            return Feed { known: self.known_thinned(source, course).d, past: None };
        };
        let of = &self.outputs[output];
        let mut linear = self.linear(&of.linear, course);
        linear.iter_mut().for_each(|y| *y += of.offset);
        course.add(output, &mut linear);
        Feed { known: linear, past: Some(Past::new(of.kernels.iter().map(Kernel::past))) }
    }

    /// Signals of a law whose argument depends on them.
    fn in_loop(&self, course: &Course<'_>) -> Option<Vec<Vec<f64>>> {
        let n = course.thin.first().map_or(0, |u| u.len());
        let rate = self.analysis_hz();
        let scale = self.argument.1;
        let mut argument = self.feed(self.argument.0, course);
        let mut second = self.second.map(|(source, scale)| (self.feed(source, course), scale));
        let of_rate = matches!(self.argument.0, Source::OutputRate(_));
        let law_signals = self.law.count();
        let mut signals: Vec<Vec<f64>> = vec![vec![0.0; n]; self.signals()];
        let mut now = vec![0.0; law_signals];
        let mut memory = Memory::new(scale, rate);
        let pace = (course.clock[1] - course.clock[0]) / n.max(1) as f64;
        let mut past: [Option<f64>; 2] = [None, None];
        for t in 0..n {
            let d = argument.at(t, &signals);
            let x = second.as_mut().map(|(feed, scale)| (feed.at(t, &signals), *scale));
            let far = |x: f64, scale: Scale| (x - scale.centre).abs() > RUNAWAY * scale.d || x.is_nan();
            let runs_away = if of_rate { d.abs() > RUNAWAY * scale.v || d.is_nan() } else { far(d, scale) };
            if runs_away || x.is_some_and(|(x, scale)| far(x, scale)) {
                return None;
            }
            // Backward differences of second order.
            let v = match past {
                _ if of_rate => d / rate,
                [Some(before), Some(earlier)] => 1.5 * d - 2.0 * before + 0.5 * earlier,
                [Some(before), None] => d - before,
                _ => 0.0,
            };
            past = [Some(d), past[0]];
            let instant = Instant {
                // A law over a rate asks for no displacement.
                d: if of_rate { 0.0 } else { (d - scale.centre) / scale.d },
                v: v * rate / scale.v,
                x: x.map_or(0.0, |(x, scale)| (x - scale.centre) / scale.d),
                t: course.clock[0] + pace * t as f64,
            };
            self.law.at(instant, &mut memory, &mut now);
            signals.iter_mut().zip(&now).for_each(|(signal, now)| signal[t] = *now);
            signals[law_signals][t] = d;
            if let Some((x, _)) = x {
                signals[law_signals + 1][t] = x;
            }
        }
        Some(signals)
    }

    /// The responses to drives at the recording's rate, `[drive][sample]`, at the programme's end; `None` where the
    /// free run diverges. `before`, `[response][sample]`, is what known effects add: the law sees it, and it is no part
    /// of what is returned.
    pub fn simulate(&self, drives: &[Vec<f64>], before: Option<&[Vec<f64>]>) -> Option<Vec<Simulated>> {
        let thin = self.thinned(drives);
        let course = self.at_the_end(drives, &thin, before);
        let run = self.run(&course)?;
        let n = drives.first().map_or(0, Vec::len);
        let responses = run.outputs.into_iter().zip(&self.outputs).take(self.responses);
        responses
            .map(|(augmented, output)| {
                let mut linear = self.linear(&output.before, &course);
                linear.iter_mut().for_each(|y| *y += output.offset_before);
                Some(Simulated {
                    augmented: self.at_full_rate(augmented, n)?,
                    linear: self.at_full_rate(linear, n)?,
                })
            })
            .collect()
    }

    /// Drives at the programme's end, with the same at the rate of the analysis.
    fn at_the_end<'a>(
        &self,
        drives: &'a [Vec<f64>],
        thin: &'a [Vec<f64>],
        before: Option<&[Vec<f64>]>,
    ) -> Course<'a> {
        let added = before.map_or_else(Vec::new, |before| {
            let responses: Vec<&[f64]> = before.iter().map(Vec::as_slice).collect();
            let fed = self.seen.iter().map(|seen| seen.displacement(&responses, self.rate_hz));
            let all: Vec<Vec<f64>> = before.iter().cloned().chain(fed).collect();
            self.thinned(&all).into_iter().map(Cow::Owned).collect()
        });
        Course {
            whole: drives.iter().map(Vec::as_slice).collect(),
            thin: thin.iter().map(Vec::as_slice).collect(),
            clock: [1.0, 1.0],
            added,
        }
    }

    /// Drives at the rate of the analysis.
    fn thinned(&self, drives: &[Vec<f64>]) -> Vec<Vec<f64>> {
        let thinner = Thinner::new(self.step);
        drives.iter().map(|u| thinner.thin(u)).collect()
    }

    /// A signal of the analysis at the recording's rate, `n` samples.
    fn at_full_rate(&self, x: Vec<f64>, n: usize) -> Option<Vec<f64>> {
        if self.step == 1 {
            return Some(x);
        }
        let signal = Signal::new(self.analysis_hz(), vec![x]).ok()?;
        let mut out = resample(&signal, self.rate_hz).ok()?.channel(0).to_vec();
        let last = out.last().copied().unwrap_or(0.0);
        out.resize(n, last);
        Some(out)
    }

    /// What the law does in terms of the drive that moves a response most: its signals, each by the gain with which
    /// it goes the drive's way. `None` where it diverges.
    pub fn as_drive(
        &self,
        response: usize,
        drives: &[Vec<f64>],
        before: Option<&[Vec<f64>]>,
    ) -> Option<AsDrive> {
        let thin = self.thinned(drives);
        let course = self.at_the_end(drives, &thin, before);
        let output = &self.outputs[response];
        let power = |h: &Kernel| dot(&h.taps, &h.taps);
        let drive = match self.place {
            Place::Drive(d) | Place::Error(d, _) | Place::OnTable(d, _) => d,
            _ => (0..output.linear.len())
                .max_by(|&a, &b| power(&output.linear[a]).total_cmp(&power(&output.linear[b])))?,
        };
        let way = &output.linear[drive];
        let size = power(way).max(f64::MIN_POSITIVE);
        let factors: Vec<f64> =
            output.kernels[..self.law.count()].iter().map(|kernel| kernel.along(way) / size).collect();
        let signals = self.run(&course)?.signals;
        let n = signals.first().map_or(0, Vec::len);
        let mut samples = vec![0.0; n];
        for (signal, factor) in signals.iter().zip(&factors) {
            let mean = signal.iter().sum::<f64>() / n.max(1) as f64;
            samples.iter_mut().zip(signal).for_each(|(f, s)| *f += factor * (s - mean));
        }
        samples.iter().all(|f| f.is_finite()).then_some(AsDrive { drive, samples, factors })
    }

    /// The law over its argument in terms of a drive: whether the argument is a rate, its values in its unit, and the
    /// law there. `None` of a law that remembers or that has two arguments.
    pub fn curve(&self, force: &AsDrive, points: usize) -> Option<(bool, Vec<f64>, Vec<f64>)> {
        let over_rate = match self.law {
            Law::Cubic | Law::Quadratic | Law::Polynomial | Law::Kink { .. } | Law::Gap { .. } => false,
            Law::OneSided { .. } | Law::OneSidedBelow { .. } | Law::FreeStiffness => false,
            law if law.is_over_rate() => true,
            _ => return None,
        };
        let scale = self.argument.1;
        let mut out = vec![0.0; self.law.count()];
        let (x, y) = (0..points)
            .map(|k| {
                let at = REACH * (2.0 * k as f64 / (points.max(2) - 1) as f64 - 1.0);
                let instant = Instant { d: at, v: at, x: 0.0, t: 1.0 };
                self.law.at(instant, &mut Memory::new(scale, self.rate_hz), &mut out);
                let value: f64 = out.iter().zip(&force.factors).map(|(o, f)| o * f).sum();
                (if over_rate { at * scale.v } else { scale.centre + at * scale.d }, value)
            })
            .unzip();
        Some((over_rate, x, y))
    }

    fn kernels(&mut self) -> impl Iterator<Item = &mut Kernel> {
        self.outputs.iter_mut().flat_map(|o| o.linear.iter_mut().chain(&mut o.before).chain(&mut o.kernels))
    }

    /// Takes the taps out, all in one row, and leaves how many each impulse response has: they are too many for text.
    pub fn detach_taps(&mut self) -> Vec<f64> {
        let mut all = Vec::new();
        for kernel in self.kernels() {
            kernel.apart = kernel.taps.len();
            all.append(&mut kernel.taps);
        }
        all
    }

    /// Whether taps were taken out.
    pub fn lacks_taps(&self) -> bool {
        self.outputs.iter().flat_map(Output::all).any(|kernel| kernel.apart > 0)
    }

    /// Puts the taps back.
    ///
    /// # Errors
    /// Another number of them than were taken out, in words.
    pub fn attach_taps(&mut self, taps: &[f64]) -> Result<(), String> {
        let mut rest = taps;
        for kernel in self.kernels() {
            let apart = std::mem::take(&mut kernel.apart);
            let (own, others) =
                rest.split_at_checked(apart).ok_or_else(|| format!("taps: {} are too few", taps.len()))?;
            kernel.taps.extend(own);
            rest = others;
        }
        if rest.is_empty() { Ok(()) } else { Err(format!("taps: {} are too many", taps.len())) }
    }

    /// The law's numbers.
    pub fn numbers(&self) -> Vec<Number> {
        let Scale { centre, d, v } = self.argument.1;
        let length = |name, value| Number { name, value, of: NumberOf::Argument };
        let rate = |name, value| Number { name, value, of: NumberOf::Rate };
        match self.law {
            Law::Kink { at } | Law::Gap { at } => vec![length("kink", at * d)],
            Law::OneSided { at } | Law::OneSidedBelow { at } => vec![length("kink", centre + at * d)],
            Law::Coulomb { smooth } => vec![rate("sliding_velocity", smooth * v)],
            Law::Stribeck { smooth, decay } => {
                vec![rate("sliding_velocity", smooth * v), rate("stribeck_velocity", decay * v)]
            }
            Law::Slider { limit } => vec![length("yield_displacement", limit * d)],
            Law::BoucWen { limit, unloading } => vec![
                length("yield_displacement", limit * d),
                Number { name: "unloading", value: unloading, of: NumberOf::Ratio },
            ],
            Law::OneSidedDamping { at } | Law::OneSidedDampingBelow { at } => vec![rate("kink", at * v)],
            Law::KinkedDamping { at } | Law::DampingBeyond { at } => vec![rate("kink", at * v)],
            Law::PowerDamping { exponent } => {
                vec![Number { name: "exponent", value: exponent, of: NumberOf::Ratio }]
            }
            Law::RateLimit { limit } => vec![rate("rate", limit * v)],
            Law::Block { front, .. } | Law::Bent { front, .. } => front.numbers(self.rate_hz),
            _ => Vec::new(),
        }
    }

    /// Checks a model that came out of a file: that it can be simulated on so many drives and responses at this
    /// rate, and that no number of it is out of bounds.
    ///
    /// # Errors
    /// What is wrong, in words.
    pub fn check(&self, drives: usize, responses: usize, rate_hz: f64) -> Result<(), String> {
        let counted = |what: &str, found: usize, expected: usize| {
            if found == expected {
                Ok(())
            } else {
                Err(format!("{what}: {found} entries, expected {expected}"))
            }
        };
        if !Signal::same_rate(self.rate_hz, rate_hz) {
            return Err(format!("it runs at {} Hz, the model at {rate_hz} Hz", self.rate_hz));
        }
        if !(1..=1000).contains(&self.step) {
            return Err(format!("step: {}, 1 to 1000", self.step));
        }
        counted("responses", self.responses, responses)?;
        counted("drive_mean", self.drive_mean.len(), drives)?;
        if !(responses..=responses + 2).contains(&self.outputs.len()) {
            return Err(format!("outputs: {}", self.outputs.len()));
        }
        if !self.seen.is_empty() && self.seen.len() != self.outputs.len() - responses {
            return Err(format!("seen: {} entries", self.seen.len()));
        }
        if !self.seen.iter().all(|seen| seen.is_among(drives, responses)) {
            return Err("seen: responses of the model".into());
        }
        let source = |source: Source| match source {
            Source::Drive { channel, .. } => channel < drives,
            _ => source.output().is_some_and(|output| output < self.outputs.len()),
        };
        // What has no displacement is for laws that ask for none, and known effects add displacements.
        let of_rate = |source: Source| matches!(source, Source::LinearRate(_) | Source::OutputRate(_));
        let known = self.law.is_over_rate() && self.seen.is_empty();
        if of_rate(self.argument.0) && !known || self.second.is_some_and(|s| of_rate(s.0)) {
            return Err("argument: the rate of a displacement".into());
        }
        let arguments = || std::iter::once(self.argument).chain(self.second);
        let two = matches!(self.law, Law::ValveFlow | Law::CrossAxisKinematic);
        let all =
            std::iter::once(self.place).chain(self.other).all(|place| place.is_among(drives, responses))
                && arguments().all(|a| source(a.0));
        if !all || self.other.is_some() != two || self.second.is_some() != two {
            return Err("place: channels of the model".into());
        }
        for output in &self.outputs {
            counted("linear", output.linear.len(), drives)?;
            counted("before", output.before.len(), drives)?;
            counted("kernels", output.kernels.len(), self.signals())?;
            if output.all().any(|k| k.taps.len() > MOST_TAPS || k.from.unsigned_abs() > MOST_TAPS) {
                return Err(format!("taps: at most {MOST_TAPS}"));
            }
            let numbers = output.all().flat_map(|k| &k.taps).chain([&output.offset, &output.offset_before]);
            finite(numbers)?;
        }
        for (_, Scale { centre, d, v }) in arguments() {
            finite([&centre, &d, &v])?;
            if d <= 0.0 || v <= 0.0 {
                return Err("scale: positive deviations".into());
            }
        }
        finite(&self.drive_mean)?;
        finite([&self.limits.low_hz, &self.limits.high_hz])?;
        if let Law::Block { front, .. } | Law::Bent { front, .. } = self.law
            && !front.is_stable()
        {
            return Err("law: a filter that does not come to rest".into());
        }
        if let Law::Block { kinks, .. } = self.law
            && !(2..=MOST_KINKS).contains(&kinks)
        {
            return Err(format!("law: {kinks} kinks, 2 to {MOST_KINKS}"));
        }
        finite(&self.law.values())
    }
}

fn finite<'a>(numbers: impl IntoIterator<Item = &'a f64>) -> Result<(), String> {
    match numbers.into_iter().find(|x| x.is_nan() || x.abs() > LARGEST) {
        Some(x) => Err(format!("{x}: magnitudes up to {LARGEST:e} are read")),
        None => Ok(()),
    }
}
