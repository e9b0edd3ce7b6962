//! A search: trials of drawn settings, then the fit of the best one.

use std::sync::Arc;
use std::time::Duration;

use crate::domain::StudyReport;
use crate::domain::study::{Search, SearchMethod, SearchReport, Trial};
use crate::engine::lstm::LstmSettings;
use crate::engine::model::{FitData, FitSplit, ModelKind};
use crate::engine::simd::Isa;
use crate::engine::study::{Rung, TrialSettings, rungs, survivors};
use crate::engine::{EngineError, rounded};
use crate::jobs::fit::{self, FitPlan, GivenParts};
use crate::jobs::problem::{JobError, of_engine};
use crate::jobs::spec::StudyOutput;
use crate::storage::NewStudy;

use super::attempt::{Bench, digest};
use super::plan::{SearchTask, StudyPlan, base, with};
use super::shares::{Fits, Place, Shares};
use super::table::Table;
use super::{Making, StudyProblem};

/// Work of the last fit, in trials with the full epochs: three seeds, and one more network on all runs.
const LAST_FIT: f64 = 4.0;

/// Does a search.
pub(super) async fn make(
    making: &Making<'_>,
    plan: &StudyPlan,
    task: &SearchTask,
) -> Result<StudyOutput, JobError> {
    let Making { context, rig, job, control, helps } = *making;
    control.report("loading runs", 0.0);
    let mut trial = task.trial.clone();
    let given = GivenParts::load(context, &mut trial).await?;
    let mut data = fit::load(context, &trial, control).await?;
    // Where whole runs compare, the trials' plan has none of them.
    if !matches!(task.fit.split, FitSplit::LeftOut { .. }) {
        data = data.without_comparison();
    }
    let isa = Isa::of_process().map_err(|error| of_engine(&error, &trial.channels()))?;
    let fits = digest(&(fit::fingerprint(&trial, isa), &plan.request));
    let (table, kept) = Table::open(&context.store, job, fits.clone(), control, helps).await?;
    let rounds = rounds(&task.search);
    let report = match kept {
        Some(StudyReport::Search(report)) => report,
        _ => SearchReport { planned: rounds.iter().map(|rung| rung.trials).sum(), ..SearchReport::default() },
    };
    let whole = rounds.iter().map(|rung| rung.trials as f64 * rung.share).sum::<f64>() + LAST_FIT;
    let bench = Bench { context, job, control, fits: &fits, helps };
    let shares = Shares::open(&context.store, control, job, &fits, helps).await?;
    let data = Arc::new(data);
    let (search, seed) = (&task.search, plan.request.seed);
    let mut trials = Trials {
        bench,
        search,
        seed,
        trial,
        given,
        data,
        table,
        whole,
        shares,
        report,
        shown: 0.0,
        share: 1.0,
    };
    trials.run(&rounds).await?;
    let report = std::mem::take(&mut trials.report);
    // The last fit loads its own runs.
    drop(trials);
    let Some(best) = report.best.clone() else {
        let reason = report.trials.iter().find_map(|trial| trial.reason.clone());
        return Err(StudyProblem::NoTrial(reason.unwrap_or_default()).into());
    };
    control.scope(format!("fit of trial {}: ", best.trial), 1.0 - LAST_FIT / whole..1.0);
    // A helper of the trials waits as long as the study runs.
    let patience = helps.then_some(Duration::MAX);
    let request = with(&task.fit.request, &best.settings);
    let made = fit::fit_model(context, rig, &request, (job, patience), control).await?;
    let error = percent(best.error);
    let said =
        format!("trial {} of {} is the best, with an error of {error}", best.trial, task.search.trials);
    let model = Some((made.model, made.activation));
    let study = NewStudy { report: StudyReport::Search(report), model };
    Ok(StudyOutput { study, said, why: made.why, no_bytes: bytes::Bytes::new() })
}

fn rounds(search: &Search) -> Vec<Rung> {
    match search.method {
        SearchMethod::Random => vec![Rung { trials: search.trials, share: 1.0 }],
        SearchMethod::SuccessiveHalving => rungs(search.trials, search.reduction),
    }
}

fn percent(error: Option<f64>) -> String {
    error.map_or("none".into(), |error| format!("{} %", rounded(100.0 * error, 3)))
}

/// Everything that the trials use.
struct Trials<'a> {
    bench: Bench<'a>,
    search: &'a Search,
    /// Seed of the study.
    seed: u64,
    /// The fit of a trial, before it draws.
    trial: FitPlan,
    given: GivenParts,
    data: Arc<FitData>,
    table: Table,
    /// Work of the whole study, in trials with the full epochs.
    whole: f64,
    shares: Shares<'a>,
    report: SearchReport,
    /// Work of the rounds before this one.
    shown: f64,
    /// Share of the epochs in this round.
    share: f64,
}

impl Fits for Trials<'_> {
    type Row = Trial;

    fn has(&self, (trial, rung): Place) -> bool {
        self.report.done(trial, rung).is_some()
    }

    fn add(&mut self, row: Trial) {
        self.report.add(row);
        self.table.keep(&StudyReport::Search(self.report.clone()));
    }

    async fn try_one(&mut self, (trial, rung): Place) -> Result<Trial, JobError> {
        let best = percent(self.report.best.as_ref().and_then(|best| best.error));
        let (which, of) = (self.report.trials.len() + 1, self.report.planned);
        let in_round = self.report.trials.iter().filter(|row| row.rung == rung).count() as f64;
        let done = self.shown + in_round * self.share;
        let stage = format!("trial fit {which} of {of}, least error so far {best}: ");
        self.bench.control.scope(stage, done / self.whole..(done + self.share) / self.whole);
        self.fit_of(trial, rung, self.share).await
    }
}

impl Trials<'_> {
    /// Does the trials that the report lacks.
    async fn run(&mut self, rounds: &[Rung]) -> Result<(), JobError> {
        let mut alive: Vec<usize> = (0..self.search.trials).collect();
        for (number, rung) in rounds.iter().enumerate() {
            self.share = rung.share;
            let places: Vec<Place> = alive.iter().map(|&trial| (trial, number)).collect();
            let shares = self.shares.clone();
            shares.all(self, &places).await?;
            // In the order of one worker, whoever has done what.
            self.report.in_order();
            self.shown += rung.share * places.len() as f64;
            if let Some(next) = rounds.get(number + 1) {
                let error =
                    |trial: &usize| (*trial, self.report.done(*trial, number).and_then(|row| row.error));
                let errors: Vec<_> = alive.iter().map(error).collect();
                alive = survivors(&errors, next.trials);
            }
        }
        Ok(())
    }

    /// Fits what a trial draws, and scores it on data that compare no models.
    async fn fit_of(&self, trial: usize, rung: usize, share: f64) -> Result<Trial, JobError> {
        let settings = self.search.space.draw(&base(&self.trial.request), self.seed, trial);
        let mut row = Trial {
            trial,
            rung,
            share,
            epochs: None,
            settings: settings.clone(),
            error: None,
            rms: Vec::new(),
            reason: None,
        };
        let tried = match self.options(&settings, share) {
            Ok((used, epochs)) => {
                row.epochs = epochs;
                let request = with(&self.trial.request, &used);
                let plan = FitPlan { request, ..self.trial.clone() };
                let settings = fit::settings(&plan, &self.given);
                self.bench.fit((trial, rung), settings, Arc::clone(&self.data)).await?
            }
            Err(error) => Err(error),
        };
        match tried {
            Ok(fitted) => {
                row.rms = fitted.report.validation_rms;
                let known: Vec<f64> = row.rms.iter().flatten().copied().collect();
                row.error = (!known.is_empty()).then(|| known.iter().sum::<f64>() / known.len() as f64);
                if row.error.is_none() {
                    row.reason = Some("every output is zero on the data that choose".into());
                }
            }
            Err(error) => row.reason = Some(error.to_string()),
        }
        Ok(row)
    }

    /// The settings of a trial with its share of the epochs and its seeds; and its epochs.
    fn options(
        &self,
        settings: &TrialSettings,
        share: f64,
    ) -> Result<(TrialSettings, Option<usize>), EngineError> {
        let mut used = settings.clone();
        if used.kind == ModelKind::Frf {
            return Ok((used, None));
        }
        used.lstm.seeds = Some(self.search.trial_seeds.clone());
        let (preset, task) = (self.trial.request.preset, self.trial.task);
        let resolved = |lens: &[usize]| -> Result<LstmSettings, EngineError> {
            used.lstm.resolve(preset, used.kind, task, lens)
        };
        let sections = self.data.sections(used.kind, resolved(&[])?.window_len);
        let lens: Vec<usize> = sections.training.iter().map(|section| section.samples.len()).collect();
        let full = resolved(&lens)?.epochs;
        let epochs = ((share * full as f64).round() as usize).max(1);
        used.lstm.epochs = Some(epochs);
        Ok((used, Some(epochs)))
    }
}
