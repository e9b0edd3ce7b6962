//! The laws that ran freely, as hypotheses of the report.

use rayon::prelude::*;

use super::decide::Ranked;
use super::recording::Runs;
use super::words;
use crate::Signal;
use crate::diagnosis::augmented::Added;
use crate::diagnosis::augmented::Augmented;
use crate::diagnosis::data::overview::Overview;
use crate::diagnosis::input::{Input, Run};
use crate::diagnosis::numerics::linear::{mean, rms};
use crate::diagnosis::report::{
    ChannelHeldOut, EffectShare, HeldOut, Hypothesis, Parameter, Shape, Strength, TransferRow,
};
use crate::diagnosis::screen::{FreeRun, Number, NumberOf, Place, Screening};

/// Student's deviations that 90 % of all lie within, by degrees of freedom from 1 on, and that of the normal distribution.
const STUDENT: [f64; 10] = [6.314, 2.920, 2.353, 2.132, 2.015, 1.943, 1.895, 1.860, 1.833, 1.812];
const NORMAL: f64 = 1.645;
/// Share of what a sim with the law on it leaves, below which the law's own linear part takes the sim's place.
const BETTER_ALONE: f64 = 0.9;
/// Points of a law's curve.
const CURVE: usize = 41;

/// A hypothesis with the sim that has its law.
pub(super) struct Listed {
    pub hypothesis: Hypothesis,
    pub augmented: Augmented,
    /// The same fitted once more, which is better.
    pub again: Option<(Hypothesis, Augmented)>,
    /// Held-out errors of its free run relative to the response, `[response][group]`.
    pub errors: Vec<Vec<f64>>,
}

impl Listed {
    /// The hypothesis as it was fitted last.
    pub fn last(&self) -> &Hypothesis {
        self.again.as_ref().map_or(&self.hypothesis, |again| &again.0)
    }
}

/// Hypotheses of all laws that ran freely, in the order of their rank.
pub(super) fn all(
    input: &Input,
    overview: &Overview,
    runs: &Runs,
    screening: &Screening,
    ranked: &[Ranked<'_>],
) -> Vec<Listed> {
    ranked
        .par_iter()
        .filter_map(|ranked| Of { input, overview, runs, screening, ranked, free: ranked.free }.listed())
        .collect()
}

/// All that a hypothesis is made of.
struct Of<'a> {
    input: &'a Input,
    overview: &'a Overview,
    runs: &'a Runs,
    screening: &'a Screening,
    ranked: &'a Ranked<'a>,
    free: &'a FreeRun,
}

impl Of<'_> {
    fn listed(&self) -> Option<Listed> {
        let standing = self.ranked.standing;
        let (added, of_bare) = self.added();
        let loudest = self.input.loudest()?;
        let drives = loudest.drive.channels();
        let peaks: Vec<f64> = (0..self.input.drives.len())
            .map(|d| {
                let all = self.input.runs.iter().flat_map(|run| run.drive.channel(d));
                all.fold(0.0_f64, |m, u| m.max(u.abs())).max(f64::MIN_POSITIVE)
            })
            .collect();
        let stable_over_envelope = added.bounded(drives, &self.input.limits(&peaks));
        let responses: Option<Vec<ChannelHeldOut>> = (0..self.input.responses.len())
            .map(|r| {
                let channel = self.input.responses[r].name.clone();
                Some(ChannelHeldOut { channel, held_out: self.held_out(r, &added, of_bare.as_deref())? })
            })
            .collect();
        let mut responses = responses?;
        let held_out = responses[standing.response].held_out.clone();
        responses.swap(0, standing.response);
        let (at, between) = words::place(self.input, standing.place);
        let (strength, shape) = self.strength(loudest);
        let left = held_out.left();
        let alone = EffectShare {
            effect: standing.effect,
            family: standing.family,
            axis: words::axis(self.input, standing),
            at,
            between,
            share_of_gap: (1.0 - left).max(0.0),
        };
        Some(Listed {
            hypothesis: Hypothesis {
                effect: alone.effect,
                family: alone.family,
                axis: alone.axis.clone(),
                at: alone.at.clone(),
                between: alone.between.clone(),
                effects: vec![alone],
                channel: self.input.responses[standing.response].name.clone(),
                probability: self.ranked.probability,
                remaining_share: left,
                parameters: self.parameters(),
                strength,
                shape,
                transfer: self.transfer(),
                held_out,
                responses,
                stable_over_envelope,
            },
            augmented: Augmented::of_transfer(added, self.input.has_adopted()),
            again: None,
            errors: self.free.errors.clone(),
        })
    }

    /// The law on top of the sim; without the sim where the law's own linear part is better: than a linear sim at all,
    /// than another by more than chance, on groups that it was not fitted to. With it, what the law on top of the sim
    /// leaves of each response.
    fn added(&self) -> (Added, Option<Vec<f64>>) {
        let responses = self.input.responses.len();
        let standing = self.ranked.standing;
        let bare = Added {
            effect: standing.effect,
            response: standing.response,
            forward: self.free.forward.clone(),
            alone: vec![false; responses],
        };
        let whole = Added { alone: vec![true; responses], ..bare.clone() };
        let of_bare = self.left(&bare);
        let of_whole = (0..responses).any(|r| self.input.core_stands(r)).then(|| self.left(&whole)).flatten();
        let at = |left: &Option<Vec<f64>>, r: usize| left.as_ref().map_or(f64::INFINITY, |left| left[r]);
        let stands = |r: usize| {
            if self.input.core_stands(r) {
                at(&of_whole, r) <= at(&of_bare, r)
            } else {
                self.held_out_alone(r) < BETTER_ALONE * at(&of_bare, r)
            }
        };
        let alone = (0..responses).map(stands).collect();
        (Added { alone, ..bare }, of_bare)
    }

    /// RMS of what the law on its own linear part leaves of groups that it was not fitted to.
    fn held_out_alone(&self, r: usize) -> f64 {
        self.rms_of(r, &self.free.errors[r])
    }

    /// RMS of errors of a response's groups, see [`Runs::left`].
    fn rms_of(&self, r: usize, errors: &[f64]) -> f64 {
        self.overview.power[r].level() * self.runs.left(r, errors)
    }

    /// RMS of what a sim with the law leaves of each response over all runs, after their first sixth; `None` where
    /// the sim is not known or the free run diverges.
    fn left(&self, added: &Added) -> Option<Vec<f64>> {
        let mut left = vec![Vec::new(); self.input.responses.len()];
        for run in &self.input.runs {
            let simulated = run.simulated.as_ref()?.channels();
            let before = run.added.as_ref().map(Signal::channels);
            let made = added.predict(run.drive.channels(), simulated, before)?;
            for (r, left) in left.iter_mut().enumerate() {
                left.extend(errors(run, r, &made[r]));
            }
        }
        Some(left.iter().map(|left| rms(left)).collect())
    }

    /// How far the gap of a response closes in groups that the law was not fitted to; `of_bare` is what the law on top
    /// of the sim leaves of each.
    fn held_out(&self, r: usize, added: &Added, of_bare: Option<&[f64]>) -> Option<HeldOut> {
        let power = &self.overview.power[r];
        let stands = self.input.core_stands(r) || self.input.runs.iter().any(|run| run.simulated.is_none());
        let (rms_before, rms_after) = if stands {
            let linear = self.rms_of(r, &self.screening.linear.errors[r]);
            (self.input.left_of_unseen(power.rms_error, linear), self.held_out_alone(r))
        } else {
            // A sim that bends by itself: the law has to help on top of it.
            let of_sim: Vec<f64> = self
                .input
                .runs
                .iter()
                .flat_map(|run| run.simulated.as_ref().map_or(Vec::new(), |s| errors(run, r, s.channel(r))))
                .collect();
            let after = if added.alone[r] { self.held_out_alone(r) } else { of_bare?[r] };
            (rms(&of_sim), after)
        };
        let whole = HeldOut {
            runs: self.input.runs.iter().map(|run| run.name.clone()).collect(),
            rms_before,
            rms_after,
            ..HeldOut::default()
        };
        let counted = whole.above_noise(self.runs.noise.as_ref().map_or(0.0, |noise| noise[r]));
        let closure = counted.closure;
        // How far groups differ tells how far the next may.
        let linear = &self.screening.linear.errors[r];
        let by_group: Vec<f64> = linear
            .iter()
            .zip(&self.free.errors[r])
            .filter(|(before, _)| **before > 0.0)
            .map(|(before, after)| 1.0 - (after / before).powi(2))
            .collect();
        let width = next_within(&by_group).max(0.03 * (1.0 - closure).abs());
        // Where nothing tells the noise, all of the rest may be noise.
        let highest = if self.runs.noise.is_some() { (closure + width).min(1.0) } else { 1.0 };
        Some(HeldOut { closure_ci90: [closure - width, highest], ..counted })
    }

    /// The law's numbers.
    fn parameters(&self) -> Vec<Parameter> {
        let (unit, rate) = self.unit();
        let parameter = |number: Number| Parameter {
            name: number.name.into(),
            value: number.value,
            se: None,
            unit: match number.of {
                NumberOf::Argument => unit.clone(),
                NumberOf::Rate => rate.clone(),
                NumberOf::Frequency => "Hz".into(),
                NumberOf::Ratio => "1".into(),
            },
        };
        self.free.forward.numbers().into_iter().map(parameter).collect()
    }

    /// Units of the law's displacement and of its rate.
    fn unit(&self) -> (String, String) {
        use crate::Quantity::{Acceleration, Velocity};
        let channel = match self.ranked.standing.place {
            Place::Drive(d) => &self.input.drives[d],
            // Differences are in the unit of the first response, and of the response where a drive is the first.
            Place::Response(r)
            | Place::Output(r)
            | Place::Between(r, _)
            | Place::Error(_, r)
            | Place::OnTable(_, r) => &self.input.responses[r],
        };
        let unit = &channel.unit;
        match channel.quantity {
            Acceleration => (format!("{unit}*s^2"), format!("{unit}*s")),
            Velocity => (format!("{unit}*s"), unit.clone()),
            _ => (unit.clone(), format!("{unit}/s")),
        }
    }

    /// How strong the law is in terms of a drive, and its curve.
    fn strength(&self, loudest: &Run) -> (Option<Strength>, Option<Shape>) {
        let standing = self.ranked.standing;
        let before = loudest.added.as_ref().map(Signal::channels);
        let force = self.free.forward.as_drive(standing.response, loudest.drive.channels(), before);
        let Some(force) = force else { return (None, None) };
        let drive = &self.input.drives[force.drive];
        let strength = Strength {
            rms: rms(&force.samples),
            peak: force.samples.iter().fold(0.0_f64, |m, f| m.max(f.abs())),
            unit: drive.unit.clone(),
            as_drive: drive.name.clone(),
        };
        let gains: Vec<f64> = standing.gains.iter().flatten().copied().filter(|g| g.is_finite()).collect();
        let (least, most) =
            gains.iter().fold((1.0_f64, 1.0_f64), |(low, high), g| (low.min(*g), high.max(*g)));
        let (unit, rate) = self.unit();
        let shape = self.free.forward.curve(&force, CURVE).map(|(over_rate, x, curve)| {
            let (a, b): (Vec<f64>, Vec<f64>) = curve.iter().map(|f| (f * least, f * most)).unzip();
            Shape {
                argument: words::argument(self.input, standing.place),
                unit: if over_rate { rate } else { unit },
                low: a.iter().zip(&b).map(|(a, b)| a.min(*b)).collect(),
                high: a.iter().zip(&b).map(|(a, b)| a.max(*b)).collect(),
                x,
                force: curve,
            }
        });
        (Some(strength), shape)
    }

    /// What is left in each group by the law fitted to the others.
    fn transfer(&self) -> Vec<TransferRow> {
        let r = self.ranked.standing.response;
        let linear = &self.screening.linear.errors[r];
        let of_group = |g: usize| {
            let stretches = self.runs.grouping.stretches.iter().filter(|s| s.group == g);
            let (mut runs, mut samples) = (Vec::new(), Vec::new());
            let (mut drive, mut count) = (0.0, 0);
            for s in stretches {
                let record = &self.runs.recording.records[s.record];
                let y = record.beside_added(r, s.samples.clone());
                let centre = mean(&y);
                samples.extend(y.iter().map(|y| y - centre));
                for u in record.drive.channels() {
                    let u = &u[s.samples.clone()];
                    let centre = mean(u);
                    drive += u.iter().map(|u| (u - centre).powi(2)).sum::<f64>();
                }
                count += s.samples.len();
                runs.push(self.runs.names[s.record].clone());
            }
            runs.dedup();
            let level = rms(&samples);
            TransferRow {
                group: format!("drive RMS {:.3e}", f64::sqrt(drive / f64::from(count.max(1) as u32))),
                runs,
                rms_before: level * linear[g],
                rms_after: level * self.free.errors[r][g],
                fitted_on_others: true,
                parameters_alone: self.ranked.standing.gains.get(g).copied().flatten().into_iter().collect(),
            }
        };
        (0..linear.len().min(self.runs.grouping.groups)).map(of_group).collect()
    }
}

/// How far from the mean of some values the next lies at most in 90 % of cases: Student's interval of prediction,
/// `t s sqrt(1 + 1 / n)`.
fn next_within(values: &[f64]) -> f64 {
    let Some(freedom) = values.len().checked_sub(1).filter(|freedom| *freedom > 0) else { return 0.0 };
    let centre = mean(values);
    let squares: f64 = values.iter().map(|x| (x - centre) * (x - centre)).sum();
    // Beyond the table two terms of Student's expansion are exact to a thousandth.
    let (square, nu) = (NORMAL * NORMAL, freedom as f64);
    let first = (square + 1.0) / (4.0 * nu);
    let second = (5.0 * square * square + 16.0 * square + 3.0) / (96.0 * nu * nu);
    let of_more = NORMAL * (1.0 + first + second);
    let student = STUDENT.get(freedom - 1).copied().unwrap_or(of_more);
    student * (squares / nu).sqrt() * (1.0 + 1.0 / values.len() as f64).sqrt()
}

/// What a prediction leaves of a run's response about its mean, after the first sixth.
fn errors(run: &Run, r: usize, made: &[f64]) -> Vec<f64> {
    let from = made.len() / 6;
    let left: Vec<f64> =
        run.response.channel(r)[from..].iter().zip(&made[from..]).map(|(y, m)| y - m).collect();
    let centre = mean(&left);
    left.iter().map(|l| l - centre).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_next_value_lies_as_far_as_student_says() {
        // Tables of Student's distribution: 2.353 for 3 degrees of freedom, 1.796 for 11.
        let few = [1.0, 2.0, 3.0, 4.0];
        assert!((next_within(&few) - 2.353 * (5.0_f64 / 3.0).sqrt() * 1.25_f64.sqrt()).abs() < 1e-9);
        let many: Vec<f64> = (0..12).map(f64::from).collect();
        let expected = 1.796 * 13.0_f64.sqrt() * (13.0_f64 / 12.0).sqrt();
        assert!((next_within(&many) - expected).abs() < 0.002 * expected);
        assert_eq!(next_within(&[0.3]), 0.0);
    }
}
