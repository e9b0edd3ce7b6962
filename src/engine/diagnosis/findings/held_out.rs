//! How far the gap closes on the test stretches, response by response.

use crate::diagnosis::data::locate;
use crate::diagnosis::data::prepare::Prepared;
use crate::diagnosis::data::problem::Problem;
use crate::diagnosis::fit::fitting::Fitted;
use crate::diagnosis::input::Input;
use crate::diagnosis::report::{ChannelHeldOut, HeldOut};
use crate::diagnosis::search::propagation::Propagation;
use crate::diagnosis::search::score::{Scored, blocks, closure_interval, remaining};
use crate::fatigue::{DamageSettings, damage};

/// What a hypothesis does at one response: that response, with what is carried to it, and the fit.
pub struct Place {
    pub problem: Problem,
    pub fitted: Fitted,
    /// Mean square in noise floors that is left of the select stretches.
    pub chi2: f64,
}

impl Scored {
    /// The responses at which the effect acts, its host first.
    pub fn places(&self, prepared: &Prepared) -> Vec<Place> {
        let host = &prepared.problems[self.problem];
        let mut places =
            vec![Place { problem: host.clone(), fitted: self.fitted.clone(), chi2: self.host_chi2 }];
        let propagated = |propagated: &Propagation| {
            let problem = prepared.problems[propagated.response].carrying(host, &self.fitted)?;
            Some(Place { problem, fitted: propagated.fitted.clone(), chi2: propagated.chi2 })
        };
        places.extend(self.propagations.iter().filter_map(propagated));
        places
    }
}

/// The same at every place; `None` where a free run of a test stretch runs away.
pub fn held_out_at(input: &Input, prepared: &Prepared, places: &[&Place]) -> Option<Vec<ChannelHeldOut>> {
    places
        .iter()
        .map(|place| {
            let channel = input.responses[place.problem.response].name.clone();
            Some(ChannelHeldOut {
                channel,
                held_out: held_out(input, prepared, &place.problem, &place.fitted)?,
            })
        })
        .collect()
}

/// Closure on the test stretches of one response, from what the sim leaves that was `prepared`; `None` where a free
/// run runs away.
pub fn held_out(input: &Input, prepared: &Prepared, problem: &Problem, fitted: &Fitted) -> Option<HeldOut> {
    let rate = input.sample_rate_hz();
    let noise = &prepared.noises[problem.response];
    let predictions = fitted.candidate.predictions(problem, &problem.test, &fitted.p)?;
    let sim = &prepared.problems[problem.response].test;
    let simulated: Vec<Vec<f64>> = sim.iter().map(|s| s.sim(input, problem.response).to_vec()).collect();
    let before: Vec<Vec<f64>> = problem.test.iter().zip(&simulated).map(|(s, y)| s.residual(y)).collect();
    let after: Vec<Vec<f64>> = problem.test.iter().zip(&predictions).map(|(s, p)| s.residual(p)).collect();
    let (chi2_before, chi2_after) =
        (problem.chi2(&problem.test, &simulated), problem.chi2(&problem.test, &predictions));
    let power = |errors: &[Vec<f64>]| locate::power(problem, &problem.test, errors, noise, prepared.band);
    let (of_before, of_after) = (power(&before), power(&after));
    let floor = of_before.noise;
    let above = |rms: f64| (rms * rms - floor).max(0.0);
    let (rms_before, rms_after) = (of_before.rms_error, of_after.rms_error);
    let gap = above(rms_before);
    let mut runs: Vec<String> = problem.test.iter().map(|s| input.runs[s.run].name.clone()).collect();
    runs.dedup();
    Some(HeldOut {
        runs,
        rms_before,
        rms_after,
        noise_rms: floor.sqrt(),
        chi2_before,
        chi2_after,
        closure: 1.0 - remaining(chi2_after, chi2_before),
        closure_ci90: closure_interval(
            &blocks(&problem.test, &before, rate),
            &blocks(&problem.test, &after, rate),
            input.seed,
        ),
        closure_rms: if gap > 0.0 { 1.0 - above(rms_after) / gap } else { 0.0 },
        damage_ratio_before: damage_ratio(problem, &simulated),
        damage_ratio_after: damage_ratio(problem, &predictions),
    })
}

/// Predicted over measured damage of the test stretches after their lead-in, slope 5; `None` where
/// the measured response does none.
fn damage_ratio(problem: &Problem, predictions: &[Vec<f64>]) -> Option<f64> {
    let settings = DamageSettings::default();
    let (mut predicted, mut measured) = (0.0, 0.0);
    for (stretch, prediction) in problem.test.iter().zip(predictions) {
        predicted += damage(&prediction[stretch.lead..], &settings).ok()?;
        measured += damage(&stretch.measured[stretch.lead..], &settings).ok()?;
    }
    (measured > 0.0).then(|| predicted / measured).filter(|ratio| ratio.is_finite())
}
