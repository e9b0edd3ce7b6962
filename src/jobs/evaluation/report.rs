//! The table of an evaluation, as its comparisons come in.

use std::collections::HashSet;

use crate::domain::evaluation::{
    BaselineDifference, ClassRow, EvaluatedChannel, EvaluatedModel, EvaluatedRun, EvaluationReport,
    OmittedRun, RunResult, WorstChannel, WorstSpanOfRun,
};
use crate::domain::{Origin, RunId};
use crate::engine::evaluation::{ClassAverage, MeanSpectra, RunFigures, average, difference};
use crate::engine::model::Preprocess;

use super::Made;
use super::plan::{Class, EvaluationPlan, Pairing};

/// Results so far.
pub(super) struct Table<'a> {
    plan: &'a EvaluationPlan,
    /// The models' filters.
    filters: Vec<Preprocess>,
    results: Vec<RunResult>,
    /// Places of the results, `[model * runs + run]`.
    places: Vec<Option<usize>>,
    omitted: Vec<OmittedRun>,
    /// Of the runs that count, `[class * models + model]`.
    spectra: Vec<MeanSpectra>,
}

impl<'a> Table<'a> {
    pub fn new(plan: &'a EvaluationPlan, filters: Vec<Preprocess>) -> Self {
        let places = vec![None; plan.models.len() * plan.runs.len()];
        let spectra = vec![MeanSpectra::default(); plan.classes.len() * plan.models.len()];
        Self { plan, filters, results: Vec::new(), places, omitted: plan.omitted.clone(), spectra }
    }

    /// Adds a comparison.
    pub fn add(&mut self, pairing: &Pairing, made: Made) {
        let (result, compared) = match made {
            Ok(found) => found,
            Err(omitted) => return self.omitted.push(omitted),
        };
        if result.counted {
            let model = &self.plan.models[pairing.model];
            let names: Vec<String> = pairing.outputs.iter().map(|&o| model.outputs[o].clone()).collect();
            let classes = self.plan.classes.iter().enumerate();
            for (class, _) in classes.filter(|(_, class)| class.holds(pairing.run)) {
                let sums = &mut self.spectra[class * self.plan.models.len() + pairing.model];
                sums.add(&names, compared.segment_len, &compared.measured, &compared.predicted);
            }
        }
        self.places[pairing.model * self.plan.runs.len() + pairing.run] = Some(self.results.len());
        self.results.push(result);
    }

    /// The report.
    pub fn finish(mut self) -> EvaluationReport {
        let plan = self.plan;
        let spectra = std::mem::take(&mut self.spectra);
        let places =
            (0..plan.classes.len()).flat_map(|class| (0..plan.models.len()).map(move |m| (class, m)));
        let table =
            places.zip(spectra).map(|((class, model), sums)| self.row(&plan.classes[class], model, sums));
        let table = table.collect();
        EvaluationReport {
            models: models(plan, &self.filters),
            channels: plan
                .channels
                .iter()
                .map(|(name, unit)| EvaluatedChannel { name: name.clone(), unit: unit.clone() })
                .collect(),
            groups: plan.groups.clone(),
            runs: runs(plan),
            table,
            warnings: self.warnings(),
            results: self.results,
            omitted: self.omitted,
        }
    }

    /// Results of a model on the runs of a class.
    fn of<'s>(&'s self, class: &'s Class, model: usize) -> impl Iterator<Item = &'s RunResult> {
        let first = model * self.plan.runs.len();
        class.runs.iter().filter_map(move |run| Some(&self.results[self.places[first + run]?]))
    }

    fn row(&self, class: &Class, model: usize, spectra: MeanSpectra) -> ClassRow {
        let results: Vec<&RunResult> = self.of(class, model).collect();
        let counted: Vec<&RunResult> = results.iter().copied().filter(|result| result.counted).collect();
        let durations = |result: &RunResult| {
            let run = self.plan.runs.iter().find(|run| run.id == result.run);
            run.map_or(0.0, |run| run.duration_s)
        };
        let duration_s: f64 = counted.iter().map(|result| durations(result)).sum();
        let inside: f64 = counted.iter().map(|result| result.inside * durations(result)).sum();
        let average = self.average(&counted, model);
        let worst_channel = average.channels.iter().filter_map(|(name, found)| Some((name, found.rms?)));
        let worst_channel = worst_channel.reduce(|a, b| if b.1 > a.1 { b } else { a });
        let worst_span =
            counted.iter().filter_map(|result| Some((result.run, result.figures.worst_span.as_ref()?)));
        let worst_span = worst_span.reduce(|a, b| if b.1.rms > a.1.rms { b } else { a });
        ClassRow {
            class: class.name.clone(),
            model: self.plan.models[model].version,
            runs: counted.len(),
            duration_s,
            left_out: results.len() - counted.len(),
            inside: (duration_s > 0.0).then(|| (inside / duration_s).min(1.0)),
            worst_channel: worst_channel.map(|(name, rms)| WorstChannel { channel: name.clone(), rms }),
            worst_span: worst_span.map(|(run, span)| WorstSpanOfRun { run, span: span.clone() }),
            spectra: spectra.finish(),
            difference: self.difference(class, model, &counted),
            average,
        }
    }

    /// Averages over the channels that the model predicts.
    fn average(&self, results: &[&RunResult], model: usize) -> ClassAverage {
        let figures: Vec<&RunFigures> = results.iter().map(|result| &result.figures).collect();
        let outputs = &self.plan.models[model].outputs;
        let mut groups = self.plan.groups.clone();
        groups.iter_mut().for_each(|group| group.channels.retain(|name| outputs.contains(name)));
        groups.retain(|group| !group.channels.is_empty());
        average(&figures, &groups)
    }

    /// Against the baseline, over the runs that count for both.
    fn difference(&self, class: &Class, model: usize, counted: &[&RunResult]) -> Option<BaselineDifference> {
        let baseline = self.plan.baseline.filter(|&baseline| baseline != model)?;
        let others: Vec<&RunResult> = self.of(class, baseline).filter(|result| result.counted).collect();
        let ids = |results: &[&RunResult]| results.iter().map(|r| r.run).collect::<HashSet<RunId>>();
        let (ours, theirs) = (ids(counted), ids(&others));
        let common = |results: &[&'_ RunResult], also: &HashSet<RunId>, of: usize| {
            let both: Vec<&RunResult> = results.iter().copied().filter(|r| also.contains(&r.run)).collect();
            (both.len(), self.average(&both, of))
        };
        let (runs, found) = common(counted, &theirs, model);
        let (_, against) = common(&others, &ours, baseline);
        Some(BaselineDifference { runs, figures: difference(&found, &against) })
    }

    fn warnings(&self) -> Vec<String> {
        let plan = self.plan;
        let mut warnings = Vec::new();
        for model in plan.models.iter().filter(|model| model.origin == Origin::Import) {
            warnings.push(format!(
                "Model {} was imported: the runs that it was fitted on are not known, and none is left out.",
                model.version
            ));
        }
        for class in &plan.classes {
            for (m, model) in plan.models.iter().enumerate() {
                if self.of(class, m).count() > 0 && self.of(class, m).all(|result| !result.counted) {
                    warnings.push(format!(
                        "Model {} was fitted on every run of {:?}: it has no averages there (include_fitted gives them).",
                        model.version, class.name
                    ));
                }
            }
        }
        warnings
    }
}

fn models(plan: &EvaluationPlan, filters: &[Preprocess]) -> Vec<EvaluatedModel> {
    let of = |(place, model): (usize, &crate::domain::Model)| EvaluatedModel {
        version: model.version,
        kind: model.kind,
        sha256: model.sha256.clone(),
        origin: model.origin,
        inputs: model.inputs.clone(),
        outputs: model.outputs.clone(),
        preprocess: filters[place],
        baseline: plan.baseline == Some(place),
    };
    plan.models.iter().enumerate().map(of).collect()
}

fn runs(plan: &EvaluationPlan) -> Vec<EvaluatedRun> {
    let classes = |run: usize| {
        let of_run = plan.classes.iter().filter(|class| class.holds(run));
        of_run.map(|class| class.name.clone()).collect()
    };
    let of = |(place, run): (usize, &crate::domain::Run)| EvaluatedRun {
        id: run.id,
        name: run.name.clone(),
        kind: run.kind,
        split: run.split,
        duration_s: run.duration_s,
        classes: classes(place),
    };
    plan.runs.iter().enumerate().map(of).collect()
}
