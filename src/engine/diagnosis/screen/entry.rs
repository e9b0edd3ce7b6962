//! How a law's signal enters a response: through the linear part's own impulse responses, as a force that acts
//! where a drive does, and over drives also directly.

use std::ops::Range;

use super::correlate::Filter;
use super::judge::Base;
use super::kernel::Kernel;
use super::law::Way;
use super::linear_part::Setting;
use super::place::Place;
use super::track::{Segment, Track, delayed};
use crate::diagnosis::numerics::linear::squares_about_mean;

/// Lags of a drive's signal that enter directly, of a law of one or two signals and of one of more.
const DIRECT: [usize; 2] = [8, 4];
/// Lags of a signal behind an impulse response.
const BEHIND: usize = 2;
/// Drives at most whose impulse responses let a response's signal in.
const THROUGH: usize = 3;
/// Lags of a signal behind an impulse response that has the filter ahead of the signal in it: they take it away.
const BEYOND: usize = 5;
/// Lags of a static law's output behind the linear part.
const AFTER: usize = 12;

/// The ways into one response.
pub(super) struct Entry {
    lead: usize,
    /// How the filter behind a bend is set.
    back: Setting,
    /// Samples of the longest record.
    longest: usize,
    /// Impulse responses from the lead on, by drive.
    impulses: Vec<Vec<f64>>,
    /// The filters of them, by drive.
    whole: Vec<Filter>,
    /// Those from lag 0 on, and from lag 1 on: what a response does to itself takes a sample.
    causal: Vec<Filter>,
    delayed: Vec<Filter>,
    /// Drives by what they contribute, most first.
    order: Vec<usize>,
    /// The linear part's prediction.
    pub output: Track,
}

impl Entry {
    /// The ways into the first responses of a linear part.
    pub fn all(base: &Base<'_>, responses: usize, drives: &[Track]) -> Vec<Self> {
        (0..responses).map(|response| Self::new(base, response, drives)).collect()
    }

    pub fn new(base: &Base<'_>, response: usize, drives: &[Track]) -> Self {
        let impulses = (0..drives.len()).map(|d| base.impulse(response, d, longest(drives))).collect();
        Self::of(impulses, base.setting(), drives)
    }

    /// By impulse responses of the drives, from the lead of the linear part on.
    pub fn of(impulses: Vec<Vec<f64>>, setting: &Setting, drives: &[Track]) -> Self {
        let lead = setting.lags.lead;
        let samples = longest(drives) + lead;
        let filters = |of: &dyn Fn(&[f64]) -> Vec<f64>| -> Vec<Filter> {
            impulses.iter().map(|h| Filter::new(of(h), samples)).collect()
        };
        let whole = filters(&|h| h.to_vec());
        let parts: Vec<Track> = drives.iter().zip(&whole).map(|(d, h)| ahead(d, h, lead)).collect();
        let power = |track: &Track| -> f64 { track.iter().map(|x| squares_about_mean(x)).sum() };
        let powers: Vec<f64> = parts.iter().map(power).collect();
        let mut order: Vec<usize> = (0..drives.len()).filter(|&d| powers[d] > 0.0).collect();
        order.sort_by(|&a, &b| powers[b].total_cmp(&powers[a]));
        let most = order.first().map_or(0.0, |&d| powers[d]);
        order.retain(|&d| powers[d] > 0.01 * most);
        if order.is_empty() {
            // A response that no drive moves: its columns are zero.
            order.push(0);
        }
        let output = (0..drives[0].len())
            .map(|record| {
                (0..drives[0][record].len()).map(|t| parts.iter().map(|p| p[record][t]).sum()).collect()
            })
            .collect();
        let (causal, delayed) = (filters(&|h| h[lead..].to_vec()), filters(&|h| late(&h[lead..])));
        Self {
            lead,
            back: setting.clone(),
            longest: longest(drives),
            impulses,
            whole,
            causal,
            delayed,
            order,
            output,
        }
    }

    /// What the columns of `signals` signals at a place do together, with these coefficients: of each signal the
    /// lag at which it begins, and its impulse response from there on.
    pub fn kernels(
        &self,
        place: Place,
        own: bool,
        way: Way,
        signals: usize,
        coefficients: &[f64],
    ) -> Vec<Kernel> {
        let direct = DIRECT[usize::from(signals > 2)];
        let mut rest = coefficients.iter().copied();
        let mut kernels = Vec::with_capacity(signals);
        for _ in 0..signals {
            let mut kernel = Kernel::default();
            if let (Way::Modal, Some(poles)) = (way, &self.back.poles) {
                let theta: Vec<f64> = rest.by_ref().take(1 + poles.states()).collect();
                kernel.add(&[theta[0]], isize::from(own), 1.0);
                kernel.add(&poles.impulse(&theta[1..], poles.memory(self.longest)), 0, 1.0);
                kernels.push(kernel);
                continue;
            }
            if way == Way::Free {
                let theta: Vec<f64> = rest.by_ref().take(self.back.width()).collect();
                kernel.add(&self.back.impulse(&theta, self.longest), -(self.lead as isize), 1.0);
                kernels.push(kernel);
                continue;
            }
            let mut add = |impulse: &[f64], lags: Range<isize>| {
                for lag in lags {
                    kernel.add(impulse, lag, rest.next().unwrap_or(0.0));
                }
            };
            match place {
                Place::Drive(d) if way == Way::Loaded => add(&late(&self.impulses[d][self.lead..]), behind()),
                Place::Drive(d) if way == Way::Behind => {
                    let lead = self.lead as isize;
                    add(&self.impulses[d], -lead..BEYOND as isize - lead);
                }
                Place::Drive(d) => {
                    let before = -(self.lead.min(direct / 2) as isize);
                    add(&[1.0], before..before + direct as isize);
                    let lead = self.lead as isize;
                    add(&self.impulses[d], -lead..BEHIND as isize - lead);
                }
                Place::Output(_) => add(&[1.0], 0..if signals > 2 { AFTER as isize } else { 1 }),
                Place::Response(_) | Place::Between(..) | Place::Error(..) | Place::OnTable(..) => {
                    for d in self.through(place, signals) {
                        let h = &self.impulses[d][self.lead..];
                        if own { add(&late(h), behind()) } else { add(h, behind()) }
                    }
                }
            }
            kernels.push(kernel);
        }
        kernels
    }

    /// Number of columns of so many signals at a place.
    pub fn width(&self, place: Place, way: Way, signals: usize) -> usize {
        let of_one = match place {
            _ if way == Way::Free => self.back.width(),
            _ if let (Way::Modal, Some(poles)) = (way, &self.back.poles) => 1 + poles.states(),
            Place::Drive(_) if way == Way::Loaded => BEHIND,
            Place::Drive(_) if way == Way::Behind => BEYOND,
            Place::Drive(_) => DIRECT[usize::from(signals > 2)] + BEHIND,
            Place::Output(_) => {
                if signals > 2 {
                    AFTER
                } else {
                    1
                }
            }
            Place::Response(_) | Place::Between(..) | Place::Error(..) | Place::OnTable(..) => {
                self.through(place, signals).len() * BEHIND
            }
        };
        signals * of_one
    }

    /// Drives through whose impulse responses so many signals at a place enter: over a drive less a response through that
    /// drive's, over responses through those that move this one most.
    fn through(&self, place: Place, signals: usize) -> Vec<usize> {
        match place {
            Place::Error(d, _) | Place::OnTable(d, _) => vec![d],
            _ => self.order.iter().copied().take(if signals > 2 { 1 } else { THROUGH }).collect(),
        }
    }

    /// Columns of signals at a place, `[segment][column][row]`. `own`: the place is this response itself.
    /// `way`: how signals over a drive enter.
    pub fn columns(
        &self,
        place: Place,
        own: bool,
        way: Way,
        signals: &[Track],
        segments: &[Segment],
    ) -> Vec<Vec<Vec<f64>>> {
        let direct = DIRECT[usize::from(signals.len() > 2)];
        let mut tracks: Vec<(Track, Range<isize>)> = Vec::new();
        for signal in signals {
            if let (Way::Modal, Some(poles)) = (way, &self.back.poles) {
                let at_once = isize::from(own);
                tracks.push((signal.clone(), at_once..at_once + 1));
                tracks.extend(poles.filter(signal).into_iter().map(|state| (state, 0..1)));
                continue;
            }
            match place {
                _ if way == Way::Free => {
                    let lead = self.lead as isize;
                    tracks.push((signal.clone(), -lead..self.back.lags.span as isize - lead));
                    let states = self.back.poles.as_ref().map(|poles| poles.filter(signal));
                    tracks.extend(states.into_iter().flatten().map(|state| (state, 0..1)));
                }
                Place::Drive(d) if way == Way::Loaded => {
                    let through = signal.iter().map(|x| self.delayed[d].apply(x)).collect();
                    tracks.push((through, behind()));
                }
                Place::Drive(d) if way == Way::Behind => {
                    tracks.push((ahead(signal, &self.whole[d], self.lead), 0..BEYOND as isize));
                }
                Place::Drive(d) => {
                    let before = -(self.lead.min(direct / 2) as isize);
                    tracks.push((signal.clone(), before..before + direct as isize));
                    tracks.push((ahead(signal, &self.whole[d], self.lead), behind()));
                }
                Place::Output(_) => {
                    let lags = if signals.len() > 2 { AFTER as isize } else { 1 };
                    tracks.push((signal.clone(), 0..lags));
                }
                Place::Response(_) | Place::Between(..) | Place::Error(..) | Place::OnTable(..) => {
                    let filters = if own { &self.delayed } else { &self.causal };
                    for d in self.through(place, signals.len()) {
                        let through = signal.iter().map(|x| filters[d].apply(x)).collect();
                        tracks.push((through, behind()));
                    }
                }
            }
        }
        segments
            .iter()
            .map(|segment| {
                let of = |(track, lags): &(Track, Range<isize>)| -> Vec<Vec<f64>> {
                    lags.clone().map(|lag| delayed(&track[segment.record], segment, lag)).collect()
                };
                tracks.iter().flat_map(of).collect()
            })
            .collect()
    }
}

fn longest(drives: &[Track]) -> usize {
    drives[0].iter().map(Vec::len).max().unwrap_or(1)
}

fn behind() -> Range<isize> {
    0..BEHIND as isize
}

/// The impulse response without what comes at once: what a response does to itself takes a sample.
fn late(h: &[f64]) -> Vec<f64> {
    std::iter::once(0.0).chain(h.iter().skip(1).copied()).collect()
}

/// The output of a filter that begins `lead` samples ahead; signals are held at their ends.
fn ahead(track: &Track, filter: &Filter, lead: usize) -> Track {
    let of = |x: &Vec<f64>| {
        let held = x.last().copied().unwrap_or(0.0);
        let longer: Vec<f64> = x.iter().copied().chain(std::iter::repeat_n(held, lead)).collect();
        filter.apply(&longer).split_off(lead)
    };
    track.iter().map(of).collect()
}
