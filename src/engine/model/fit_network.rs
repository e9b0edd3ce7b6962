//! The LSTM part of a fit: one network per seed, the best kept.

use std::borrow::Cow;
use std::ops::ControlFlow;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use rayon::prelude::*;

use super::fit_data::FitData;
use super::fit_report::SeedReport;
use super::score::{self, with_context};
use super::split::Section;
use super::start::{continued, start};
use super::{LstmPart, ModelKind, Preprocess, RigModel, Scaler, network_inputs};
use crate::checkpoint::CheckpointStore;
use crate::lstm::{self, LstmNet, LstmSettings, Recombine, RecombineChoice, Segment, Trained, Until};
use crate::{EngineError, Loss, Progress, Signal, Watch};

/// How often a fit looks whether networks that other processes train have come back.
const LOOK_EVERY: Duration = Duration::from_millis(200);

/// The checkpoints and the progress of a network's training.
pub(super) struct Course<'a> {
    pub(super) checkpoints: &'a dyn CheckpointStore,
    pub(super) watch: Watch<'a>,
    /// Share of the whole fit that is done before and after it.
    pub(super) progress: std::ops::Range<f64>,
    /// The network that the training begins at, if it goes on from a model.
    pub(super) start: Option<&'a LstmPart>,
}

/// Standardised data of a network, and their scalers.
struct NetworkData {
    training: Vec<Segment>,
    stopping: Vec<Segment>,
    x: Scaler,
    y: Scaler,
}

/// A trained network and each seed's course.
pub(super) struct Network {
    pub(super) part: LstmPart,
    pub(super) seeds: Vec<SeedReport>,
}

/// Trains one network per seed on `training`, stops each on `stopping` and keeps the best; `model` brings
/// the FRF part.
pub(super) fn choose(
    data: &FitData,
    model: &RigModel,
    settings: &LstmSettings,
    (training, stopping): (&[Section], &[Section]),
    course: &Course<'_>,
) -> Result<Network, EngineError> {
    let prepared = NetworkData::new(data, model, training, stopping)?;
    let trained = prepared.train_seeds(model.kind, settings, course)?;
    let seeds: Vec<SeedReport> =
        trained.iter().zip(&settings.seeds).map(|(trained, &seed)| SeedReport::of(seed, trained)).collect();
    let best =
        SeedReport::best(&seeds).and_then(|b| seeds.iter().position(|r| r.seed == b.seed)).unwrap_or(0);
    let mut part = prepared.part(&trained[best], settings);
    part.recombine = match settings.recombine {
        RecombineChoice::Welch => Recombine::Welch,
        RecombineChoice::Stream => Recombine::Stream,
        RecombineChoice::Auto => better_recombination(data, model, &part, stopping)?,
    };
    Ok(Network { part, seeds })
}

/// Trains one network on `training` until the end of `epoch` of the settings' schedule.
pub(super) fn repeat(
    data: &FitData,
    model: &RigModel,
    settings: &LstmSettings,
    training: &[Section],
    (seed, epoch, recombine): (u64, usize, Recombine),
    course: &Course<'_>,
) -> Result<LstmPart, EngineError> {
    let prepared = NetworkData::new(data, model, training, &[])?;
    let start = prepared.start(model.kind, settings, seed, course);
    let stage = format!("LSTM {:?}, all runs", settings.blocks);
    let tell = |p: Progress<'_>| (course.watch)(Progress { stage: &stage, ..p.within(&course.progress) });
    let kept = (course.checkpoints, "all runs");
    let until = Until::Epoch(epoch);
    let trained = lstm::train(&prepared.training, until, &start, (settings, seed), kept, &tell)?;
    Ok(LstmPart { recombine, ..prepared.part(&trained, settings) })
}

impl NetworkData {
    fn new(
        data: &FitData,
        model: &RigModel,
        training: &[Section],
        stopping: &[Section],
    ) -> Result<Self, EngineError> {
        let kind = model.kind;
        let n_runs = data.all().count();
        let used = |run: usize| training.iter().chain(stopping).any(|section| section.run == run);
        // FRF(x), or core(x), is computed on the whole run, never on a part of it.
        let linear: Vec<Option<Signal>> = (0..n_runs)
            .map(|run| if used(run) { model.linear(&data.run(run).x) } else { Ok(None) })
            .collect::<Result<_, _>>()?;
        let targets: Vec<Cow<'_, Signal>> = data
            .all()
            .zip(&linear)
            .map(|(pair, l)| target(kind, &pair.y, l.as_ref()))
            .collect::<Result<_, _>>()?;
        let of_inputs = training.iter().map(|s| (&data.run(s.run).x, s.samples.clone()));
        let mut x = Scaler::of(&of_inputs.collect::<Vec<_>>());
        if kind == ModelKind::Hybrid2 {
            let of_linear =
                training.iter().filter_map(|s| Some((linear[s.run].as_ref()?, s.samples.clone())));
            let more = Scaler::of(&of_linear.collect::<Vec<_>>());
            x.mean.extend(more.mean);
            x.std.extend(more.std);
        }
        let of_targets = training.iter().map(|s| (&*targets[s.run], s.samples.clone()));
        let y = Scaler::of(&of_targets.collect::<Vec<_>>());
        let segment = |run: usize, samples: std::ops::Range<usize>, score_from: usize| {
            let linear: Option<Vec<Vec<f64>>> = linear[run]
                .as_ref()
                .filter(|_| kind == ModelKind::Hybrid2)
                .map(|l| l.channels().iter().map(|c| c[samples.clone()].to_vec()).collect());
            let target = targets[run].channels().iter();
            Segment {
                x: network_inputs(&x, kind, &data.run(run).x, samples.clone(), linear.as_deref()),
                y: target.enumerate().map(|(c, t)| y.standardise(c, &t[samples.clone()])).collect(),
                score_from,
            }
        };
        Ok(Self {
            training: training.iter().map(|s| segment(s.run, s.samples.clone(), 0)).collect(),
            stopping: stopping
                .iter()
                .map(|s| {
                    let known = with_context(&s.samples);
                    segment(s.run, known.clone(), s.samples.start - known.start)
                })
                .collect(),
            x,
            y,
        })
    }

    /// The network that the training of one seed begins with.
    fn start(&self, kind: ModelKind, settings: &LstmSettings, seed: u64, course: &Course<'_>) -> LstmNet {
        match course.start {
            Some(part) => continued(part, &self.x, &self.y),
            None => start(kind, &self.x, &self.y, settings, seed),
        }
    }

    fn part(&self, trained: &Trained, settings: &LstmSettings) -> LstmPart {
        LstmPart {
            net: trained.net.clone(),
            x: self.x.clone(),
            y: self.y.clone(),
            window_len: settings.window_len,
            hop: settings.hop,
            recombine: Recombine::Welch,
        }
    }

    /// Trains every seed, here or in another process; the networks are the same wherever that is.
    fn train_seeds(
        &self,
        kind: ModelKind,
        settings: &LstmSettings,
        course: &Course<'_>,
    ) -> Result<Vec<Trained>, EngineError> {
        let n = settings.seeds.len();
        let stage = format!("LSTM {:?}, {n} seed{}", settings.blocks, if n == 1 { "" } else { "s" });
        let stages: Vec<String> = std::iter::once(stage.clone())
            .chain((1..=n).map(|away| format!("{stage}, {away} of them at other workers")))
            .collect();
        let done: Vec<AtomicU64> = (0..n).map(|_| AtomicU64::new(0)).collect();
        let away: Vec<AtomicBool> = (0..n).map(|_| AtomicBool::new(false)).collect();
        let tell = |seed: usize, share: f64, loss: Option<Loss>, is_away: bool| {
            done[seed].store((share * 1e6) as u64, Ordering::Relaxed);
            away[seed].store(is_away, Ordering::Relaxed);
            let sum: u64 = done.iter().map(|d| d.load(Ordering::Relaxed)).sum();
            let away = away.iter().filter(|away| away.load(Ordering::Relaxed)).count();
            let mean = Progress { stage: &stages[away], fraction: sum as f64 / (1e6 * n as f64), loss };
            (course.watch)(mean.within(&course.progress))
        };
        let parts: Vec<String> = (0..n).map(|i| format!("seed {i}")).collect();
        course.checkpoints.announce(&parts);
        let mut trained: Vec<Option<Trained>> = vec![None; n];
        loop {
            let train_one = |(i, trained): (usize, &mut Option<Trained>)| -> Result<(), EngineError> {
                if trained.is_none() {
                    let seed = (settings.seeds[i], parts[i].as_str());
                    let tell = |share: f64, loss: Option<Loss>, is_away: bool| tell(i, share, loss, is_away);
                    *trained = self.train_seed(seed, kind, settings, course, &tell)?;
                }
                Ok(())
            };
            trained.par_iter_mut().enumerate().try_for_each(train_one)?;
            if trained.iter().all(Option::is_some) {
                return Ok(trained.into_iter().flatten().collect());
            }
            std::thread::sleep(LOOK_EVERY);
        }
    }

    /// Trains one seed; `None` while another process does.
    fn train_seed(
        &self,
        (seed, part): (u64, &str),
        kind: ModelKind,
        settings: &LstmSettings,
        course: &Course<'_>,
        tell: &(dyn Fn(f64, Option<Loss>, bool) -> ControlFlow<()> + Sync),
    ) -> Result<Option<Trained>, EngineError> {
        let checkpoints = course.checkpoints;
        if let Some(share) = checkpoints.elsewhere(part, 0.0) {
            return if tell(share, None, true).is_break() { Err(EngineError::Cancelled) } else { Ok(None) };
        }
        let until = match course.start {
            Some(_) => Until::BetterThanStart(&self.stopping),
            None => Until::Best(&self.stopping),
        };
        let leaves = AtomicBool::new(false);
        let watch = |p: Progress<'_>| {
            tell(p.fraction, p.loss, false)?;
            let is_elsewhere = checkpoints.elsewhere(part, p.fraction).is_some();
            // What has ended is not left.
            if is_elsewhere && p.fraction < 1.0 {
                leaves.store(true, Ordering::Relaxed);
                return ControlFlow::Break(());
            }
            ControlFlow::Continue(())
        };
        let start = self.start(kind, settings, seed, course);
        let trained =
            lstm::train(&self.training, until, &start, (settings, seed), (checkpoints, part), &watch);
        if matches!(trained, Err(EngineError::Cancelled)) {
            checkpoints.hand_over(part);
            if leaves.into_inner() {
                return Ok(None);
            }
        }
        trained.map(Some)
    }
}

/// The target of the network: the output, for hybrid 1 the error of the FRF or of the core (section 2.3).
fn target<'a>(
    kind: ModelKind,
    y: &'a Signal,
    linear: Option<&Signal>,
) -> Result<Cow<'a, Signal>, EngineError> {
    match (kind, linear) {
        (ModelKind::Hybrid1, Some(linear)) => {
            let error = |(y, l): (&Vec<f64>, &Vec<f64>)| y.iter().zip(l).map(|(y, l)| y - l).collect();
            let error = y.channels().iter().zip(linear.channels()).map(error).collect();
            Ok(Cow::Owned(Signal::new(y.sample_rate_hz(), error)?))
        }
        _ => Ok(Cow::Borrowed(y)),
    }
}

/// The recombination with less error on the data that stop the training.
fn better_recombination(
    data: &FitData,
    model: &RigModel,
    part: &LstmPart,
    stopping: &[Section],
) -> Result<Recombine, EngineError> {
    let error = |recombine| -> Result<f64, EngineError> {
        let lstm = Some(LstmPart { recombine, ..part.clone() });
        let model = RigModel { lstm, ..model.clone() };
        let scores = score::score(&model, data, data, &Preprocess::default(), stopping)?;
        Ok(score::total(&scores).into_iter().filter_map(score::Squares::rms).sum())
    };
    Ok(if error(Recombine::Stream)? < error(Recombine::Welch)? {
        Recombine::Stream
    } else {
        Recombine::Welch
    })
}
