//! Which responses of a rig of many a diagnosis is about.
//!
//! A response costs a linear core, candidates of its own, and a path for every effect elsewhere: the time of a diagnosis
//! grows with the square of their number. A cause shows where the sim errs by more than it did before the change.

use super::settled::{Left, settled};
use super::split::same_drive;
use crate::diagnosis::input::{Input, Mode};
use crate::diagnosis::numerics::linear::squares_about_mean;

/// Responses that are all looked at, whatever they show.
const MANY: usize = 8;
/// Responses that are never all looked at: the time would be hours.
const TOO_MANY: usize = 16;
/// Responses that are looked at where none shows anything.
const FEWEST: usize = 2;
/// Responses that share an axis at most; more share a direction.
const ON_AXIS: usize = 4;
/// Share of `material_gap` by which a sim errs more than before where that is nothing.
const NOTHING: f64 = 0.25;
/// Share of `material_gap` from which on an error on the baseline runs may hide a change.
const UNTOLD: f64 = 0.5;

/// Indices of the responses that a diagnosis is about, in their order: of many those at which the sim errs most beyond what
/// it did on the baseline runs, and the others of their axes; also those at which it erred then by half of what matters, since
/// its errors tell little of a change. All of a rig of few, and where the sim has seen the effect or no repeats tell the noise.
///
/// Of [too many](too_many) those that erred before must be among the foremost as well, and these are sought in every mode: a
/// sim that has seen the effect errs where it could not take it in, and without repeats all that it errs by counts.
pub fn concerned(input: &Input) -> Vec<usize> {
    let all: Vec<usize> = (0..input.responses.len()).collect();
    let by_transfer = input.mode == Mode::InSitu || input.repeats.is_empty();
    if all.len() <= MANY || by_transfer && !too_many(input) {
        return all;
    }
    let Some(errs) = all.iter().map(|&r| Errs::of(input, r)).collect::<Option<Vec<Errs>>>() else {
        return all;
    };
    let material = input.material_gap * input.material_gap;
    let erred = |&r: &usize| errs[r].before >= UNTOLD * UNTOLD * material;
    let tells = |r: &&usize| too_many(input) || !erred(r);
    let (mut foremost, untold): (Vec<usize>, Vec<usize>) = all.iter().partition(tells);
    foremost.sort_by(|&a, &b| errs[b].grown.total_cmp(&errs[a].grown));
    let shows = |&&r: &&usize| errs[r].grown > NOTHING * NOTHING * material;
    // Of those whose errors tell little the foremost may be any.
    let fewest = if foremost.iter().take(MANY).any(erred) { MANY } else { FEWEST };
    let count = foremost.iter().take(MANY).filter(shows).count().max(fewest);
    foremost.truncate(count);
    foremost.extend(untold);
    // The displacement of an axis may be that of its foremost sensor; a direction of many sensors is no one axis.
    let axis = |r: usize| input.responses[r].axis.as_ref().filter(|of| on_axis(input, of) <= ON_AXIS);
    let beside = |r: usize| foremost.iter().any(|&f| axis(r).is_some() && axis(r) == axis(f));
    all.into_iter().filter(|&r| foremost.contains(&r) || beside(r)).collect()
}

fn on_axis(input: &Input, axis: &str) -> usize {
    input.responses.iter().filter(|response| response.axis.as_deref() == Some(axis)).count()
}

/// Whether a rig has so many responses that what the foremost of them tell has to do.
pub fn too_many(input: &Input) -> bool {
    input.responses.len() > TOO_MANY
}

/// How a sim errs at a response, relative to it, by power.
struct Errs {
    /// Beyond the noise, on the baseline runs.
    before: f64,
    /// What the same has grown by on the runs to explain; or what the noise has, where that is more. All of it where the
    /// sim has seen the effect.
    grown: f64,
}

impl Errs {
    /// `None` where the sim does not say; also, of a rig of not too many responses, where no repeats tell the noise.
    fn of(input: &Input, response: usize) -> Option<Self> {
        let noise = noise(input, response).or(too_many(input).then_some(0.0))?;
        let beyond = |left: &Left| (left.mean_square() - noise).max(0.0) / left.variance();
        let now = Left::of(&input.runs, response)?;
        if input.mode == Mode::InSitu {
            return Some(Self { before: 0.0, grown: beyond(&now) });
        }
        let was = Left::of(&input.baseline, response)?;
        let before = beyond(&was);
        Some(Self {
            before,
            grown: (beyond(&now) - before).max((noise - was.mean_square()) / now.variance()),
        })
    }
}

/// Mean square of a response's noise, by what repeats differ in, a drift of its offset left aside; `None` without any.
fn noise(input: &Input, response: usize) -> Option<f64> {
    let (mut squares, mut count) = (0.0, 0);
    for pair in input.repeats.iter().flat_map(|group| group.windows(2)) {
        if !same_drive(input, pair[0], pair[1]) {
            continue;
        }
        let [a, b] = [pair[0], pair[1]].map(|run| settled(input.runs[run].response.channel(response)));
        let difference: Vec<f64> = a.iter().zip(b).map(|(a, b)| a - b).collect();
        squares += 0.5 * squares_about_mean(&difference);
        count += difference.len();
    }
    (count > 0).then(|| squares / count as f64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Signal;
    use crate::diagnosis::tests::many;

    #[test]
    fn of_many_responses_those_are_looked_at_where_the_sim_errs_more_than_before() {
        let input = many::request(12, 3, 0.05);
        assert_eq!(concerned(&input), [2, 3, 4], "the axis that changed and its neighbours");
        let quiet = many::request(12, 3, 0.0);
        assert_eq!(concerned(&quiet).len(), FEWEST);
        let few = many::request(MANY, 3, 0.05);
        assert_eq!(concerned(&few).len(), MANY);
        let in_situ = Input { mode: Mode::InSitu, ..input.clone() };
        assert_eq!(concerned(&in_situ).len(), 12);
        let alone = Input { repeats: Vec::new(), ..input };
        assert_eq!(concerned(&alone).len(), 12);
    }

    #[test]
    fn of_too_many_responses_only_the_foremost_are_looked_at_even_where_the_sim_has_always_erred() {
        let mut input = many::request(TOO_MANY + 1, 3, 0.05);
        assert_eq!(concerned(&input), [2, 3, 4]);
        for run in input.baseline.iter_mut().chain(&mut input.runs) {
            let simulated = run.simulated.as_ref().unwrap();
            let errs = |(r, x): (usize, &Vec<f64>)| -> Vec<f64> {
                let by = if r < 12 { 1.1 } else { 1.0 };
                x.iter().map(|x| by * x).collect()
            };
            let channels = simulated.channels().iter().enumerate().map(errs).collect();
            run.simulated = Some(Signal::new(simulated.sample_rate_hz(), channels).unwrap());
        }
        let found = concerned(&input);
        assert_eq!(found.len(), MANY, "{found:?}");
        assert!([2, 3, 4].iter().all(|r| found.contains(r)), "{found:?}");
    }

    #[test]
    fn of_too_many_responses_the_foremost_are_looked_at_in_every_mode() {
        let input = many::request(TOO_MANY + 1, 3, 0.05);
        let in_situ = Input { mode: Mode::InSitu, ..input.clone() };
        assert_eq!(concerned(&in_situ), [2, 3, 4]);
        let alone = Input { repeats: Vec::new(), ..input.clone() };
        assert_eq!(concerned(&alone), [2, 3, 4]);
        let mut unsaid = input;
        unsaid.runs[0].simulated = None;
        assert_eq!(concerned(&unsaid).len(), TOO_MANY + 1, "no sim says where it errs");
    }

    #[test]
    fn what_the_sim_has_always_erred_by_is_no_change_and_more_noise_is_one() {
        let mut input = many::request(12, 3, 0.05);
        let bent = |signal: &Signal, by: &dyn Fn(usize, f64) -> f64| {
            let of = |x: &Vec<f64>| x.iter().enumerate().map(|(k, x)| x + by(k, *x)).collect();
            let mut channels = signal.channels().to_vec();
            channels[9] = of(&channels[9]);
            Signal::new(signal.sample_rate_hz(), channels).unwrap()
        };
        for run in input.baseline.iter_mut().chain(&mut input.runs) {
            run.simulated = run.simulated.as_ref().map(|sim| bent(sim, &|_, x| 0.01 * x));
        }
        assert_eq!(concerned(&input), [2, 3, 4]);
        let mut errs = input.clone();
        for run in errs.baseline.iter_mut().chain(&mut errs.runs) {
            run.simulated = run.simulated.as_ref().map(|sim| bent(sim, &|_, x| 0.1 * x));
        }
        assert_eq!(concerned(&errs), [2, 3, 4, 9], "what has always erred tells nothing of a change");
        for (n, run) in input.runs.iter_mut().enumerate() {
            let hiss = |k: usize, _: f64| 0.2 * (7.3 * k as f64 * (n as f64 + 1.7)).sin();
            run.response = bent(&run.response, &hiss);
        }
        assert_eq!(concerned(&input), [2, 3, 4, 9]);
    }
}
