//! A learning curve: fits to random subsets, and what more data would bring.

use std::sync::Arc;

use crate::domain::StudyReport;
use crate::domain::study::{ErrorAt, LearningCurve, LearningCurveReport, OutputCurve, SubsetFit};
use crate::engine::model::{ModelKind, Section};
use crate::engine::rounded;
use crate::engine::simd::Isa;
use crate::engine::study::{Curve, CurvePoint, Pool};
use crate::jobs::fit::{self, FitPlan, GivenParts};
use crate::jobs::problem::{JobError, of_engine};
use crate::jobs::spec::StudyOutput;
use crate::storage::NewStudy;

use super::attempt::{Bench, digest};
use super::plan::StudyPlan;
use super::shares::{Fits, Place, Shares};
use super::table::Table;
use super::{Making, StudyProblem};

/// Shortest block of a subset, samples: a segment of an FRF has room in it.
const SHORTEST: usize = 1024;

/// Minutes between the points of a curve that is drawn: a twentieth of its length.
const POINTS: usize = 40;

/// Does a learning curve.
pub(super) async fn make(
    making: &Making<'_>,
    plan: &StudyPlan,
    curve: &LearningCurve,
    fit: &FitPlan,
) -> Result<StudyOutput, JobError> {
    let Making { context, job, control, helps, .. } = *making;
    control.report("loading runs", 0.0);
    let mut fit = fit.clone();
    let given = GivenParts::load(context, &mut fit).await?;
    let data = fit::load(context, &fit, control).await?;
    let isa = Isa::of_process().map_err(|error| of_engine(&error, &fit.channels()))?;
    let fits = digest(&(fit::fingerprint(&fit, isa), &plan.request));
    let (table, kept) = Table::open(&context.store, job, fits.clone(), control, helps).await?;
    let rate = data.training[0].x.sample_rate_hz();
    let window = fit.window_len();
    let held_out = held_out(&data.sections(fit.request.kind, window));
    let segment = fit.request.frf.segment_len.unwrap_or(SHORTEST);
    let pool = Pool::new(data, &held_out, segment.max(2 * window))
        .map_err(|error| of_engine(&error, &fit.channels()))?;
    let sizes = pool.sizes(curve.sizes);
    let report = match kept {
        Some(StudyReport::LearningCurve(report)) => report,
        _ => LearningCurveReport { planned: sizes.len() * curve.repeats, ..LearningCurveReport::default() },
    };
    let bench = Bench { context, job, control, fits: &fits, helps };
    let shares = Shares::open(&context.store, control, job, &fits, helps).await?;
    let seed = plan.request.seed;
    let mut subsets = Subsets {
        bench,
        fit: &fit,
        given: &given,
        pool,
        sizes: &sizes,
        repeats: curve.repeats,
        seed,
        rate,
        table,
        report,
    };
    let places: Vec<Place> =
        (0..sizes.len()).flat_map(|size| (0..curve.repeats).map(move |repeat| (size, repeat))).collect();
    shares.all(&mut subsets, &places).await?;
    if helps {
        return Err(JobError::Stopped);
    }
    let mut report = subsets.report;
    // In the order of one worker, whoever has done what.
    report.fits.sort_by_key(|one| (one.size, one.repeat));
    report.outputs = outputs(&fit.outputs, &report.fits, curve.more_min);
    if report.fits.iter().all(|one| one.reason.is_some()) {
        let reason = report.fits.iter().find_map(|one| one.reason.clone()).unwrap_or_default();
        return Err(StudyProblem::NoTrial(reason).into());
    }
    let said = match report.outputs.iter().max_by(|a, b| a.now.error.total_cmp(&b.now.error)) {
        Some(worst) => worst.sentence.clone(),
        None => "too few errors for a curve".into(),
    };
    let study = NewStudy { report: StudyReport::LearningCurve(report), model: None };
    Ok(StudyOutput { study, said, why: String::new(), no_bytes: bytes::Bytes::new() })
}

/// Everything that the fits to subsets use.
struct Subsets<'a> {
    bench: Bench<'a>,
    fit: &'a FitPlan,
    given: &'a GivenParts,
    pool: Pool,
    /// Blocks of each size.
    sizes: &'a [usize],
    repeats: usize,
    /// Seed of the study.
    seed: u64,
    /// Sample rate, Hz.
    rate: f64,
    table: Table,
    report: LearningCurveReport,
}

impl Fits for Subsets<'_> {
    type Row = SubsetFit;

    fn has(&self, (size, repeat): Place) -> bool {
        self.report.fits.iter().any(|done| (done.size, done.repeat) == (size, repeat))
    }

    fn add(&mut self, row: SubsetFit) {
        self.report.fits.push(row);
        self.table.keep(&StudyReport::LearningCurve(self.report.clone()));
    }

    async fn try_one(&mut self, (size, repeat): Place) -> Result<SubsetFit, JobError> {
        let (done, total) = (self.report.fits.len() as f64, self.report.planned as f64);
        let stage = format!("fit {} of {}: ", self.report.fits.len() + 1, self.report.planned);
        self.bench.control.scope(stage, done / total..(done + 1.0) / total);
        let number = size * self.repeats + repeat;
        let (subset, samples) = self.pool.subset(self.sizes[size], self.seed.wrapping_add(number as u64));
        let mut settings = fit::settings(self.fit, self.given);
        if self.fit.request.kind != ModelKind::Frf {
            // Another start for each subset: what it adds to the scatter belongs to the error of a fit.
            settings.lstm.seeds = Some(vec![repeat as u64 + 1]);
        }
        let tried = self.bench.fit((size, repeat), settings, Arc::new(subset)).await?;
        let (rms, reason) = match tried {
            Ok(fitted) => (fitted.report.validation_rms, None),
            Err(error) => (Vec::new(), Some(error.to_string())),
        };
        let (minutes, share) =
            (samples as f64 / self.rate / 60.0, samples as f64 / self.pool.n_samples() as f64);
        Ok(SubsetFit { size, repeat, minutes, share, rms, reason })
    }
}

/// The data that score every subset: those that compare models; where nothing compares, those that stop.
fn held_out(sections: &crate::engine::model::Sections) -> Vec<Section> {
    let scored = if sections.comparison.is_empty() { &sections.stopping } else { &sections.comparison };
    scored.clone()
}

/// The curve of each output.
fn outputs(names: &[String], fits: &[SubsetFit], more_min: f64) -> Vec<OutputCurve> {
    let sizes = fits.iter().map(|one| one.size + 1).max().unwrap_or_default();
    let of = |(output, name): (usize, &String)| {
        let points: Vec<CurvePoint> = (0..sizes)
            .filter_map(|size| {
                let of_size = || fits.iter().filter(move |one| one.size == size);
                let first = of_size().next()?;
                let errors = of_size().filter_map(|one| one.rms.get(output).copied().flatten()).collect();
                Some(CurvePoint { minutes: first.minutes, share: first.share, errors })
            })
            .collect();
        let curve = Curve::fit(&points)?;
        let at = |minutes: f64| {
            let found = curve.at(minutes);
            ErrorAt { minutes, error: found.median, low: found.low, high: found.high }
        };
        let (least, all) = (points.first()?.minutes, points.last()?.minutes);
        let end = all + more_min;
        let step = (end / least).powf(1.0 / (POINTS - 1) as f64);
        let [offset, exponent] = curve.offset_and_exponent();
        let (now, then) = (at(all), at(end));
        Some(OutputCurve {
            channel: name.clone(),
            sentence: sentence(name, now, then, more_min),
            now,
            then,
            offset,
            exponent,
            curve: (0..POINTS).map(|i| at(least * step.powi(i as i32))).collect(),
        })
    };
    names.iter().enumerate().filter_map(of).collect()
}

/// What more data would bring.
fn sentence(name: &str, now: ErrorAt, then: ErrorAt, more_min: f64) -> String {
    let percent = |error: f64| rounded(100.0 * error, 2);
    let interval = format!("({}-{})", percent(then.low), percent(then.high));
    let minutes = rounded(more_min, 4);
    let unit = if minutes == 1.0 { "minute" } else { "minutes" };
    let (before, after) = (percent(now.error), percent(then.error));
    if before == after {
        return format!(
            "another {minutes} {unit} of noise would leave the error of {name} at {before} % {interval}"
        );
    }
    format!(
        "another {minutes} {unit} of noise would lower the error of {name} from {before} % to {after} % {interval}"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_sentence_names_the_output_both_errors_and_the_interval() {
        let at = |error: f64, low: f64, high: f64| ErrorAt { minutes: 1.0, error, low, high };
        let said = sentence("force_x", at(0.0312, 0.03, 0.033), at(0.0268, 0.0241, 0.0299), 10.0);
        let wanted =
            "another 10 minutes of noise would lower the error of force_x from 3.1 % to 2.7 % (2.4-3)";
        assert_eq!(said, wanted);
        let said = sentence("y", at(0.0312, 0.03, 0.033), at(0.0311, 0.0301, 0.0322), 1.0);
        assert_eq!(said, "another 1 minute of noise would leave the error of y at 3.1 % (3-3.2)");
    }

    #[test]
    fn each_output_has_the_curve_of_its_own_errors() {
        let fits: Vec<SubsetFit> = (0..5)
            .flat_map(|size| {
                let minutes = 2.5 * 2.0_f64.powi(size as i32);
                let share = minutes / 40.0;
                let rms = vec![Some(0.1 / minutes.sqrt()), Some(0.05), None];
                let one =
                    move |repeat| SubsetFit { size, repeat, minutes, share, rms: rms.clone(), reason: None };
                [0, 1].map(one)
            })
            .collect();
        let found = outputs(&["x", "y", "z"].map(String::from), &fits, 40.0);
        assert_eq!(
            found.iter().map(|one| one.channel.as_str()).collect::<Vec<_>>(),
            ["x", "y"],
            "z has no error"
        );
        assert!((found[0].then.error / (0.1 / 80.0_f64.sqrt()) - 1.0).abs() < 0.05, "{:?}", found[0].then);
        assert!((found[1].then.error / 0.05 - 1.0).abs() < 0.02 && found[1].sentence.contains("leave"));
        let end = found[0].curve.last().unwrap();
        assert!((end.minutes - 80.0).abs() < 1e-6 && (end.error - found[0].then.error).abs() < 1e-9);
    }
}
