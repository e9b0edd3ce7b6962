//! Where a law may have moved the modes: the linear part then holds part of the law, and laws beside it run badly.

use super::free_run::DISTORTED;
use super::place::Place;
use super::report::Screening;
use super::run::{left_by_free_runs, mean_error};
use crate::diagnosis::numerics::linear::rms;

/// Share of that down to which free runs say what the law is.
const UNCLEAR: f64 = 0.1;
/// A law at a place that leaves no more than this of the linear part tells of something there.
const TELLS: f64 = 0.9;
/// Error of the linear part from which on something is at a response, whatever laws say.
const STRONG: f64 = 0.3;
/// Places at most.
const MOST: usize = 2;

/// Places of the structure where a law may be that has moved the modes: those over which laws explain most, then
/// responses of which the linear part leaves most. None where it has moved none, or free runs are clear already.
pub(super) fn places(screening: &Screening) -> Vec<Place> {
    let errors: Vec<f64> = screening.linear.errors.iter().map(|errors| rms(errors)).collect();
    let most = errors.iter().copied().fold(0.0, f64::max);
    let clear = left_by_free_runs(screening) < UNCLEAR * mean_error(&screening.linear.errors);
    if most < DISTORTED || clear {
        return Vec::new();
    }
    let mut telling: Vec<(f64, Place)> = screening
        .standings
        .iter()
        .filter(|s| s.place.is_of_structure() && s.ratio < TELLS)
        .map(|s| (s.ratio, s.place))
        .collect();
    telling.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut strong: Vec<usize> = (0..errors.len()).filter(|&r| errors[r] > STRONG).collect();
    strong.sort_by(|&a, &b| errors[b].total_cmp(&errors[a]));
    let mut places: Vec<Place> = Vec::new();
    for place in telling.into_iter().map(|t| t.1).chain(strong.into_iter().map(Place::Response)) {
        if places.len() < MOST && !places.contains(&place) {
            places.push(place);
        }
    }
    places
}
