//! The paper's linear study on the FRF of one of the rig's versions.

use std::sync::Arc;

use crate::compute::Class;
use crate::domain::study::{LinearFit, LinearStudy, LinearStudyReport};
use crate::domain::{Model, StudyReport};
use crate::engine::EngineError;
use crate::engine::frf::Frf;
use crate::engine::simd::Isa;
use crate::engine::study::{FixedNet, mean_rms};
use crate::jobs::checkpoints::JobCheckpoints;
use crate::jobs::problem::{JobError, of_engine, unreadable};
use crate::jobs::spec::StudyOutput;
use crate::storage::NewStudy;

use super::attempt::digest;
use super::plan::StudyPlan;
use super::table::Table;
use super::{Making, StudyProblem};

/// Number of the first file that scores: never that of a training file.
const FIRST_SCORED: u64 = 1 << 32;

/// Does a linear study.
pub(super) async fn make(
    making: &Making<'_>,
    plan: &StudyPlan,
    study: &LinearStudy,
    model: &Model,
) -> Result<StudyOutput, JobError> {
    let Making { context, job, control, .. } = *making;
    let frf = Arc::new(read_frf(making, model).await?);
    let channels =
        crate::domain::FitChannels { inputs: model.inputs.clone(), outputs: model.outputs.clone() };
    let isa = Isa::of_process().map_err(|error| of_engine(&error, &channels))?;
    let fits = digest(&(crate::VERSION, isa.name(), &plan.request, &model.sha256));
    let (table, kept) = Table::open(&context.store, job, fits.clone(), control, making.helps).await?;
    let mut report = match kept {
        Some(StudyReport::LinearStudy(report)) => report,
        _ => LinearStudyReport {
            planned: study.files.len() * study.nets.len(),
            ..LinearStudyReport::default()
        },
    };
    let of_files = |files: &usize| study.nets.iter().map(|net| (*files, net.clone())).collect::<Vec<_>>();
    let all: Vec<(usize, Vec<usize>)> = study.files.iter().flat_map(of_files).collect();
    let total: f64 = all.iter().map(|(files, net)| work(*files, net)).sum();
    let mut done = 0.0;
    for (place, (files, net)) in all.iter().enumerate() {
        let (files, share) = (*files, work(*files, net) / total);
        if report.fits.len() <= place {
            control.scope(format!("network {net:?} on {files} files: "), done..done + share);
            let (store, every) = (&context.store, context.checkpoint_every);
            let of_fit = digest(&(&fits, place));
            let checkpoints = JobCheckpoints::open(store, job, of_fit, every, control).await?;
            let fixed = FixedNet {
                blocks: net.clone(),
                epochs: study.epochs,
                learning_rate: study.learning_rate,
                seed: plan.request.seed,
            };
            let (noise, scored, frf, watched) =
                (study.noise, study.scored_files as u64, Arc::clone(&frf), Arc::clone(control));
            let fit = move || -> Result<(usize, Vec<Option<f64>>), EngineError> {
                let made = |number: u64| noise.file(&frf, number);
                let training = (0..files as u64).map(made).collect::<Result<_, _>>()?;
                let model = fixed.train(training, &checkpoints, &|progress| watched.watch(progress))?;
                let parameters = model.lstm.as_ref().map_or(0, |part| part.net.n_parameters());
                let rms = mean_rms(&model, (FIRST_SCORED..FIRST_SCORED + scored).map(made))?;
                Ok((parameters, rms))
            };
            let tried = context.compute.run(Class::Fit, None, fit).await?;
            let minutes = files as f64 * study.noise.duration_s / 60.0;
            report.fits.push(row(net, files, minutes, tried)?);
            table.keep(&StudyReport::LinearStudy(report.clone()));
        }
        done += share;
    }
    let least = report
        .fits
        .iter()
        .filter(|one| one.error.is_some())
        .min_by(|a, b| a.error.unwrap_or(f64::INFINITY).total_cmp(&b.error.unwrap_or(f64::INFINITY)));
    let Some(least) = least else {
        let reason = report.fits.iter().find_map(|one| one.reason.clone()).unwrap_or_default();
        return Err(StudyProblem::NoTrial(reason).into());
    };
    let percent = crate::engine::rounded(100.0 * least.error.unwrap_or_default(), 3);
    let said = format!("least error {percent} %: network {:?} on {} files", least.net, least.files);
    let study = NewStudy { report: StudyReport::LinearStudy(report), model: None };
    Ok(StudyOutput { study, said, why: String::new(), no_bytes: bytes::Bytes::new() })
}

/// Work of a training, in files times recurrent weights.
fn work(files: usize, net: &[usize]) -> f64 {
    files as f64 * net.iter().map(|cells| (cells * cells) as f64).sum::<f64>()
}

fn row(
    net: &[usize],
    files: usize,
    minutes: f64,
    tried: Result<(usize, Vec<Option<f64>>), EngineError>,
) -> Result<LinearFit, JobError> {
    let mut row = LinearFit {
        net: net.to_vec(),
        parameters: 0,
        files,
        minutes,
        error: None,
        rms: Vec::new(),
        reason: None,
    };
    match tried {
        Ok((parameters, rms)) => {
            let known: Vec<f64> = rms.iter().flatten().copied().collect();
            row.error = (!known.is_empty()).then(|| known.iter().sum::<f64>() / known.len() as f64);
            if row.error.is_none() {
                row.reason = Some("every output of the FRF is zero".into());
            }
            (row.parameters, row.rms) = (parameters, rms);
        }
        Err(EngineError::Cancelled) => return Err(JobError::Stopped),
        Err(error) => row.reason = Some(error.to_string()),
    }
    Ok(row)
}

async fn read_frf(making: &Making<'_>, model: &Model) -> Result<Frf, JobError> {
    let frf = making.context.read_model(model, |model| Ok(model.frf)).await?;
    frf.ok_or_else(|| unreadable(model.version, &"it has no FRF"))
}
