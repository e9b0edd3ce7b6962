//! A fit: data and settings in, model and report out.

use super::fit_data::FitData;
use super::fit_network::{self, Course, Network};
use super::fit_record::{self, FitRecord, Residual, ResidualOf, ResidualSums};
use super::fit_report::{Comparison, FitReport, SeedReport};
use super::score::{self, PredictedSection, SectionScore};
use super::split::{Section, Sections};
use super::{Band, FitSettings, ModelKind, Preprocess, RigModel, trust};
use crate::checkpoint::{CheckpointStore, NoCheckpoints};
use crate::frf::{self, RunPart};
use crate::lstm::{LstmSettings, Recombine};
use crate::progress::report;
use crate::{EngineError, Progress, Watch};

/// Share of a fit's time that each FRF estimate is shown to take when an LSTM follows.
const FRF_SHARE: f64 = 0.03;

/// Share of a fit's time before the winner is fitted again: three seeds then, one afterwards.
const CHOICE_SHARE: f64 = 0.7;

/// A model that was fitted again on all runs has seen the data that compare. Where an output comes out
/// worse on them than this many times the error of the model that has not, the second fit went wrong.
const REFIT_LIMIT: f64 = 1.1;

/// A fit's result.
#[derive(Debug, Clone, PartialEq)]
pub struct Fitted {
    /// The model.
    pub model: RigModel,
    /// How it came about.
    pub report: FitReport,
    /// Its residual, and the coverage of its training data.
    pub record: FitRecord,
}

/// Fits a model.
///
/// The result depends on data, settings, seeds and the machine's instruction set only, bit for
/// bit, whatever the number of threads.
///
/// # Errors
/// Data that do not fit the settings, dead channels, too few samples, divergence, cancellation.
pub fn fit(data: &FitData, settings: &FitSettings, watch: Watch<'_>) -> Result<Fitted, EngineError> {
    fit_resumable(data, settings, &NoCheckpoints, watch)
}

/// [`fit`], going on from what an interrupted call with the same data and settings has put by.
///
/// # Errors
/// As [`fit`].
pub fn fit_resumable(
    data: &FitData,
    settings: &FitSettings,
    checkpoints: &dyn CheckpointStore,
    watch: Watch<'_>,
) -> Result<Fitted, EngineError> {
    fitted(data, settings, checkpoints, watch, true)
}

/// [`fit_resumable`] without the second fit on all runs, for its errors on the data that compare: a trial of settings.
///
/// # Errors
/// As [`fit`].
pub fn try_out(
    data: &FitData,
    settings: &FitSettings,
    checkpoints: &dyn CheckpointStore,
    watch: Watch<'_>,
) -> Result<Fitted, EngineError> {
    fitted(data, settings, checkpoints, watch, false)
}

/// A network, and its FRF, trained on all training runs for all epochs of its settings from their first seed: nothing
/// stops it, and nothing is chosen.
///
/// # Errors
/// As [`fit`].
pub fn train_for(
    data: &FitData,
    settings: &FitSettings,
    checkpoints: &dyn CheckpointStore,
    watch: Watch<'_>,
) -> Result<RigModel, EngineError> {
    data.check(settings)?;
    settings.check_parts(data)?;
    let filtered = data.filtered(&settings.preprocess)?;
    let fit = Fit { recorded: data, data: &filtered, settings, checkpoints, watch };
    let all = filtered.whole_training();
    filtered.refuse_dead_channels(&all)?;
    let (mut model, _) = fit.linear(&all, 0.0..FRF_SHARE)?;
    let lstm = fit.lstm_settings(&all)?;
    let until = (lstm.seeds[0], lstm.epochs, Recombine::Welch);
    let part = fit_network::repeat(&filtered, &model, &lstm, &all, until, &fit.course(FRF_SHARE..1.0))?;
    model.lstm = Some(part);
    model.preprocess = settings.preprocess;
    Ok(model)
}

fn fitted(
    data: &FitData,
    settings: &FitSettings,
    checkpoints: &dyn CheckpointStore,
    watch: Watch<'_>,
    refits: bool,
) -> Result<Fitted, EngineError> {
    data.check(settings)?;
    settings.check_parts(data)?;
    report(watch, "filter", 0.0)?;
    let filtered = data.filtered(&settings.preprocess)?;
    let window_len = settings.lstm.resolve(settings.preset, settings.kind, settings.task, &[])?.window_len;
    let mut sections = data.sections(settings.kind, window_len);
    sections.refit &= refits;
    let fit = Fit { recorded: data, data: &filtered, settings, checkpoints, watch };
    let compares = !sections.comparison.is_empty();
    let scored = if compares { &sections.comparison } else { &sections.stopping };
    if scored.is_empty() || (settings.kind != ModelKind::Frf && sections.stopping.is_empty()) {
        return Err(EngineError::TooShort { what: "validation data", needed: 1, found: 0 });
    }
    fit.refuse_dead_channels(&sections)?;

    let end = if sections.refit { CHOICE_SHARE } else { 0.98 };
    let chosen = fit.choose(&sections, 0.0..end)?;
    report(watch, "validation", end)?;
    let predicted = PredictedSection::all(&chosen.model, &filtered, scored)?;
    let scores: Vec<SectionScore> =
        predicted.iter().map(|part| part.score(&filtered, data, &settings.preprocess)).collect();
    let residual = fit.residual(&predicted, compares);
    let band =
        compares.then(|| Band::calibrate(&chosen.model, &filtered, &sections, &predicted)).transpose()?;
    drop(predicted);
    let mut fitted = if sections.refit { fit.again(&chosen, &sections, &scores)? } else { chosen };
    fitted.model.preprocess = settings.preprocess;
    fitted.model.band = band;
    report(watch, "done", 1.0)?;
    let shaped = fitted.refitted.then(|| filtered.whole_training());
    let training = shaped.as_deref().unwrap_or(&sections.training);
    let coverage = fit_record::coverage(&filtered, training, &fitted.model.range);
    // The FRF of a core is not this fit's.
    let quality = fitted.model.frf_quality.as_ref().filter(|_| settings.core.is_none());
    Ok(Fitted {
        report: FitReport {
            task: Some(settings.task),
            preprocess: settings.preprocess,
            frf: quality.map(|quality| quality.settings.clone()),
            lstm: fitted.lstm,
            validation_rms: score::total(&scores).into_iter().map(score::Squares::rms).collect(),
            comparison: Some(Comparison {
                rule: data.split.rule(),
                reason: None,
                refitted: fitted.refitted,
                scores: if compares { scores } else { Vec::new() },
            }),
            recombine: fitted.model.lstm.as_ref().map(|l| l.recombine),
            best_seed: SeedReport::best(&fitted.seeds).map(|s| s.seed),
            seeds: fitted.seeds,
            frf_averages: quality.map(|quality| quality.averages),
            training_s: filtered.seconds(training),
            validation_s: filtered.seconds(&sections.comparison),
            warnings: fitted.warnings,
        },
        record: FitRecord { residual, coverage },
        model: fitted.model,
    })
}

/// Everything that a fit reads.
struct Fit<'a> {
    /// As recorded.
    recorded: &'a FitData,
    /// Behind the filter.
    data: &'a FitData,
    settings: &'a FitSettings,
    checkpoints: &'a dyn CheckpointStore,
    watch: Watch<'a>,
}

/// A model and the facts about its making.
struct Made {
    model: RigModel,
    lstm: Option<LstmSettings>,
    seeds: Vec<SeedReport>,
    refitted: bool,
    warnings: Vec<String>,
}

impl Fit<'_> {
    /// Power in every channel wherever weights come from.
    fn refuse_dead_channels(&self, sections: &Sections) -> Result<(), EngineError> {
        self.data.refuse_dead_channels(&sections.training)?;
        self.data.refuse_dead_channels(&self.data.frf_sections(&sections.training))
    }

    /// A model that is trained on `training`, still without its LSTM part, and the warnings about its FRF.
    fn linear(
        &self,
        training: &[Section],
        progress: std::ops::Range<f64>,
    ) -> Result<(RigModel, Vec<String>), EngineError> {
        let (data, settings) = (self.data, self.settings);
        let mut warnings = Vec::new();
        let mut core = Vec::new();
        let (frf, frf_quality) = if settings.kind == ModelKind::Lstm {
            (None, None)
        } else if let Some(given) = &settings.core {
            core.clone_from(&given.effects);
            (given.frf.clone(), given.frf_quality.clone())
        } else {
            let sections = data.frf_sections(training);
            let parts: Vec<RunPart<'_>> = sections
                .iter()
                .map(|section| {
                    let run = data.run(section.run);
                    RunPart { x: &run.x, y: &run.y, samples: section.samples.clone() }
                })
                .collect();
            let tell = |p: Progress<'_>| (self.watch)(p.within(&progress));
            let estimate = frf::estimate_parts(&parts, &settings.frf, &tell)?;
            warnings.extend(estimate.warnings);
            warnings.extend(frf::low_coherence(&estimate.frf, &estimate.quality, &settings.outputs));
            (Some(estimate.frf), Some(estimate.quality))
        };
        let mut model = RigModel {
            kind: settings.kind,
            inputs: settings.inputs.clone(),
            outputs: settings.outputs.clone(),
            sample_rate_hz: data.training[0].x.sample_rate_hz(),
            // The data are filtered already; the model's own filter is set last.
            preprocess: Preprocess::default(),
            frf,
            frf_quality,
            core,
            lstm: None,
            range: data.input_ranges(training)?,
            joint_range: None,
            window_range: Vec::new(),
            band: None,
            effects: Vec::new(),
        };
        (model.window_range, model.joint_range) = trust::of_training(&model, &data.inputs(training));
        Ok((model, warnings))
    }

    /// The model that is compared: trained, stopped and chosen without the data that compare.
    fn choose(&self, sections: &Sections, progress: std::ops::Range<f64>) -> Result<Made, EngineError> {
        let frf_end = self.frf_end(&progress);
        let (mut model, warnings) = self.linear(&sections.training, progress.start..frf_end)?;
        if self.settings.kind == ModelKind::Frf {
            return Ok(Made { model, lstm: None, seeds: Vec::new(), refitted: false, warnings });
        }
        let lstm = self.lstm_settings(&sections.training)?;
        let course = self.course(frf_end..progress.end);
        let data = (&sections.training[..], &sections.stopping[..]);
        let Network { part, seeds } = fit_network::choose(self.data, &model, &lstm, data, &course)?;
        model.lstm = Some(part);
        Ok(Made { model, lstm: Some(lstm), seeds, refitted: false, warnings })
    }

    /// The winner fitted on all training runs, with the seed and recombination that were chosen, stopped at the
    /// same share of the schedule. This fit has seen the data that compare; if it is worse on them than the
    /// chosen model, which has not, it went wrong, and the chosen model stays.
    fn again(
        &self,
        chosen: &Made,
        sections: &Sections,
        scores: &[SectionScore],
    ) -> Result<Made, EngineError> {
        let all = self.data.whole_training();
        let frf_end = self.frf_end(&(CHOICE_SHARE..0.98));
        let (mut model, mut warnings) = self.linear(&all, CHOICE_SHARE..frf_end)?;
        let mut lstm = None;
        if let (Some(part), Some(used)) = (&chosen.model.lstm, &chosen.lstm) {
            let settings = self.lstm_settings(&all)?;
            let best = SeedReport::best(&chosen.seeds);
            let (seed, epoch) = best.map_or((settings.seeds[0], 0), |best| (best.seed, best.best_epoch));
            let course = self.course(frf_end..0.98);
            let epoch = same_share(epoch, used.epochs, settings.epochs);
            let course_of = (seed, epoch, part.recombine);
            match fit_network::repeat(self.data, &model, &settings, &all, course_of, &course) {
                Ok(part) => model.lstm = Some(part),
                Err(EngineError::Diverged { .. }) => return Ok(chosen.kept("its training diverged")),
                Err(error) => return Err(error),
            }
            lstm = Some(settings);
        }
        report(self.watch, "validation", 0.98)?;
        let before = score::total(scores);
        let after = score::total(&self.score(&model, &sections.comparison)?);
        let worse = before.iter().zip(&after).position(|(before, after)| {
            // Written so that NaN would be worse too.
            let fine = after.error <= REFIT_LIMIT * REFIT_LIMIT * before.error
                || after.error <= 1e-12 * after.measured;
            !fine
        });
        if let Some(output) = worse {
            let name = &self.settings.outputs[output];
            return Ok(chosen.kept(&format!("it came out worse on output {name}")));
        }
        warnings.dedup();
        Ok(Made { model, lstm, seeds: chosen.seeds.clone(), refitted: true, warnings })
    }

    fn course(&self, progress: std::ops::Range<f64>) -> Course<'_> {
        let start = self.settings.start.as_ref();
        Course { checkpoints: self.checkpoints, watch: self.watch, progress, start }
    }

    fn frf_end(&self, progress: &std::ops::Range<f64>) -> f64 {
        if self.settings.kind == ModelKind::Frf { progress.end } else { progress.start + FRF_SHARE }
    }

    fn lstm_settings(&self, training: &[Section]) -> Result<LstmSettings, EngineError> {
        let lens: Vec<usize> = training.iter().map(|section| section.samples.len()).collect();
        let FitSettings { preset, kind, task, lstm, .. } = self.settings;
        lstm.resolve(*preset, *kind, *task, &lens)
    }

    fn score(&self, model: &RigModel, sections: &[Section]) -> Result<Vec<SectionScore>, EngineError> {
        score::score(model, self.data, self.recorded, &self.settings.preprocess, sections)
    }

    /// The residual of a model on the data that compare it, or those that stopped it.
    fn residual(&self, predicted: &[PredictedSection<'_>], compares: bool) -> Option<Residual> {
        let (mut sums, names) = (ResidualSums::default(), &self.settings.outputs);
        for part in predicted {
            let measured = self.data.run(part.section.run).y.slice(part.section.samples.clone());
            sums.add(names, &measured, &part.shown());
        }
        let of = if compares { ResidualOf::Comparison } else { ResidualOf::Stopping };
        sums.finish(names, of, self.data.training[0].x.sample_rate_hz())
    }
}

impl Made {
    /// The chosen model, if the fit on all runs went wrong.
    fn kept(&self, why: &str) -> Self {
        let mut warnings = self.warnings.clone();
        warnings.push(format!(
            "the fit on all runs was dropped, because {why}; this model was fitted without the runs that compare it"
        ));
        Self {
            model: self.model.clone(),
            lstm: self.lstm.clone(),
            seeds: self.seeds.clone(),
            refitted: false,
            warnings,
        }
    }
}

/// The epoch of a schedule of `to` epochs that is as far on as `epoch` is in one of `from`.
fn same_share(epoch: usize, from: usize, to: usize) -> usize {
    if epoch == 0 {
        return 0;
    }
    let share = epoch as f64 / from.max(1) as f64;
    ((share * to as f64).round() as usize).clamp(1, to)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_second_fit_stops_at_the_same_share_of_its_schedule() {
        assert_eq!(same_share(50, 100, 40), 20);
        assert_eq!(same_share(1, 1000, 10), 1, "a trained network stays one");
        assert_eq!(same_share(0, 1000, 10), 0, "a start that was kept is kept");
        assert_eq!(same_share(100, 100, 80), 80);
    }
}
