//! Motions as the linear part predicts them: without noise, and without what laws add to them.

use rayon::prelude::*;

use super::desk::Desk;
use super::entry::Entry;
use super::judge::{Base, Block};
use super::law::{Law, Way};
use super::motion::{Limits, Motion, beside, motion};
use super::place::{Argument, Place, argument};
use super::run::Bench;
use super::track::{Track, add, less, mean};
use crate::Quantity;

/// Predicted motions over which all laws are tried at most, and the laws by which they are chosen.
const MOST_PREDICTED: usize = 6;
const PROBES: [Law; 5] = [
    Law::Cubic,
    Law::Kink { at: 0.7 },
    Law::OneSided { at: 0.0 },
    Law::Slider { limit: 0.15 },
    Law::QuadraticDamping,
];

/// Motions of the structure, of the places that were measured.
pub(super) fn predicted(desk: &Desk<'_>, base: &Base<'_>, measured: &[Argument]) -> Vec<Argument> {
    let of = |a: &Argument| -> Vec<Vec<f64>> { a.motion.iter().map(|m| m.d.clone()).collect() };
    let responses: Vec<&Argument> =
        measured.iter().filter(|a| matches!(a.place, Place::Response(_))).collect();
    let added: Vec<Option<Track>> = responses.iter().map(|a| desk.added_to(a)).collect();
    let tracks: Vec<Track> = responses
        .iter()
        .zip(&added)
        .map(|(a, added)| {
            let moving = desk.thinned(&of(a));
            match added {
                Some(added) => less(&moving, added),
                None => moving,
            }
        })
        .collect();
    if tracks.is_empty() {
        return Vec::new();
    }
    let Some(with_motions) = desk.rebased(base.setting(), &tracks) else { return Vec::new() };
    let first = desk.responses.len();
    let linear: Vec<Track> = (0..tracks.len())
        .into_par_iter()
        .map(|at| {
            let mut d = Entry::new(&with_motions, first + at, &desk.drives).output;
            let level = mean(&tracks[at]) - mean(&d);
            d.iter_mut().flatten().for_each(|d| *d += level);
            if let Some(added) = &added[at] {
                add(&mut d, added);
            }
            d
        })
        .collect();
    let rate = desk.rate_hz();
    let limits = Limits { low_hz: 0.0, high_hz: rate };
    let moving = |place: Place, quantity: Quantity, d: &Track| {
        let motion = d.iter().map(|d| motion(d, Quantity::Displacement, rate, limits)).collect();
        argument(place, quantity, limits, motion).map(|found| Argument { predicted: true, ..found })
    };
    let at = |r: usize| responses.iter().position(|a| a.place == Place::Response(r));
    measured
        .iter()
        .filter_map(|a| match a.place {
            Place::Response(r) => moving(a.place, a.quantity, &linear[at(r)?]),
            Place::Between(i, j) => {
                let mut taken = linear[at(j)?].clone();
                taken.iter_mut().flatten().for_each(|y| *y *= a.factor);
                moving(a.place, a.quantity, &less(&linear[at(i)?], &taken))
            }
            Place::Error(_, r) | Place::OnTable(_, r) => {
                let of_response = responses[at(r)?];
                if of_response.quantity.integrals() != a.quantity.integrals() {
                    return None;
                }
                // What the response is beside the linear part comes back in, as far as it was taken away.
                let mut beside_linear = less(&desk.thinned(&of(of_response)), &linear[at(r)?]);
                beside_linear.iter_mut().for_each(|d| *d = beside(d, a.quantity, rate, a.limits));
                let mut d = desk.thinned(&of(a));
                add(&mut d, &beside_linear);
                moving(a.place, a.quantity, &d)
            }
            Place::Drive(_) | Place::Output(_) => None,
        })
        .collect()
}

impl Bench<'_> {
    /// The linear part's prediction as an argument, at the rate of the analysis.
    pub(super) fn output(&self, response: usize) -> Option<Argument> {
        let moving = |d: &Vec<f64>| Motion {
            v: std::iter::once(0.0).chain(d.windows(2).map(|w| w[1] - w[0])).collect(),
            d: d.clone(),
        };
        let mut output = self.entries[response].output.clone();
        if let Some(added) = self.desk.added.get(response) {
            add(&mut output, added);
        }
        let motion = output.iter().map(moving).collect();
        let found = argument(Place::Output(response), Quantity::Other, self.desk.limits, motion)?;
        Some(Argument { predicted: true, ..found })
    }

    /// Predicted motions that are worth all laws: those over which one of a few leaves least.
    pub(super) fn promising(&self) -> Vec<usize> {
        let all: Vec<usize> = (0..self.predicted.len()).collect();
        if all.len() <= MOST_PREDICTED {
            return all;
        }
        let least = |at: usize| {
            let argument = &self.predicted[at];
            let companions = self.companions_of(argument);
            let of = |law: &Law| {
                let signals = self.signals(*law, argument, None);
                self.standing(*law, argument, None, &signals, &companions).ratio
            };
            PROBES.iter().map(of).fold(1.0, f64::min)
        };
        let mut ranked: Vec<(f64, usize)> = all.into_par_iter().map(|at| (least(at), at)).collect();
        ranked.sort_by(|a, b| a.0.total_cmp(&b.0));
        ranked.into_iter().take(MOST_PREDICTED).map(|(_, at)| at).collect()
    }

    /// From -1, where a law that moves every mode by itself resists the motion in every one, to 1, where it gives way. `shared`
    /// is its block where it is alike at all responses.
    pub(super) fn gain_of_modes(
        &self,
        law: Law,
        argument: &Argument,
        signals: &[Track],
        shared: Option<&Block>,
    ) -> f64 {
        let setting = self.base.setting();
        let Some(poles) = &setting.poles else { return 0.0 };
        let width = 1 + poles.states();
        // How far each signal goes with the motion or its rate.
        let (motion, scale) = if law.is_over_rate() {
            (self.rate(argument), argument.scale.v)
        } else {
            (self.unbent(argument), argument.scale.d)
        };
        let slopes: Vec<f64> = signals
            .iter()
            .map(|signal| {
                let level = mean(signal);
                let pairs = signal.iter().zip(&motion).flat_map(|(s, m)| s.iter().zip(m));
                pairs.map(|(s, x)| (s - level) * x).sum::<f64>() / scale
            })
            .collect();
        let follows = |response: usize| -> f64 {
            let rates = self.desk.recording.responses[response].quantity.integrals();
            let block = match shared {
                Some(block) => self.base.retargeted(block, response),
                None => self.block(argument.place, Way::Modal, signals, response),
            };
            let found = self.base.coefficients(&block, response, None, 1).columns;
            let mut of_all = vec![0.0; poles.states()];
            for (own, slope) in found.chunks_exact(width).zip(&slopes) {
                of_all.iter_mut().zip(&own[1..]).for_each(|(all, c)| *all += slope * c);
            }
            poles.follows(&of_all, rates)
        };
        match argument.place {
            Place::Between(a, b) => 0.5 * (follows(a) - follows(b)),
            Place::Response(r) => follows(r),
            _ => 0.0,
        }
    }
}
