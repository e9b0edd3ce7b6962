//! A test programme in the paper's shape (arXiv 2107.03645, sec. 3.1): noise to train on, two service-load
//! shapes to choose by, a third to test on.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::drives::{
    MAX_DURATION_S, MIN_DURATION_S, MixedNoise, NoiseRegion, SERVICE_OFFSET_KN, ServiceLoad, ServiceShape,
    Sine, Sweep, check, draw_stretches, linear_noise, mixed_noise, service_load, sine, stitched, sweep,
};
use crate::{EngineError, RunKind, Signal, Split};

/// One run to make on the bench.
#[derive(Debug, Clone, PartialEq)]
pub struct ProgrammeRun {
    /// Unique within the programme.
    pub name: String,
    /// Kind.
    pub kind: RunKind,
    /// Split.
    pub split: Split,
    /// `linear` (small and centred: the FRF's), `mixed`, `n1`, `n2`, `sl`, `sl-minus`, `sl-plus`, `sine`,
    /// `sweep`; service loads also carry their shape's name.
    pub tags: Vec<&'static str>,
    /// Three channels, kN.
    pub drive: Signal,
}

/// Lengths of a programme.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ProgrammeSettings {
    /// Mixed training noise, all runs together.
    pub training_min: f64,
    /// Small, centred training noise tagged `linear`, all runs together.
    pub linear_min: f64,
    /// Mixed validation noise, one run.
    pub validation_min: f64,
    /// Length of each training run and each service load, s.
    pub run_s: f64,
    /// Length of a stretch of one mean and level within mixed noise, s.
    pub stretch_s: f64,
}

impl Default for ProgrammeSettings {
    /// 20 minutes of training noise in runs of a minute.
    fn default() -> Self {
        Self::of_minutes(20.0)
    }
}

impl ProgrammeSettings {
    /// A programme with so much mixed training noise; the shares are the paper's, with a fifth more for the FRF.
    pub fn of_minutes(training_min: f64) -> Self {
        Self {
            training_min,
            linear_min: 0.2 * training_min,
            validation_min: 0.1 * training_min,
            run_s: 60.0,
            stretch_s: 15.0,
        }
    }
}

/// Scales of the service loads: of the two validation shapes, and of the test shape.
const VALIDATION_SCALES: [f64; 3] = [0.4, 0.7, 1.0];
const TEST_SCALES: [f64; 4] = [0.3, 0.5, 0.7, 1.0];
/// Scale of SL+ and SL-.
const OFFSET_SCALE: f64 = 0.5;

/// Streams of the programme's seed: the drives of one purpose stay when another's length changes.
#[derive(Clone, Copy)]
enum Purpose {
    Training,
    Linear,
    Validation,
    Service,
    N1,
    N2,
    LinearTest,
}

fn seed_for(seed: u64, purpose: Purpose, index: usize) -> u64 {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(((purpose as u64) << 32) | index as u64);
    rng.random()
}

/// All drives of the programme, in the order in which a lab would make them.
///
/// - Training: mixed noise whose means and levels cover the interior evenly over all runs together, and
///   small centred noise tagged `linear`.
/// - Validation: mixed noise, the first two service-load shapes at scales 0.4 to 1.
/// - Test: N1 (mixed noise), N2 (noise from the boundary region that training leaves out), the third
///   service-load shape at scales 0.3 to 1 (SL) and at scale 0.5 with an offset (SL-, SL+), a sine, a
///   sweep, and small centred noise.
///
/// # Errors
/// Lengths out of range.
pub fn programme(settings: &ProgrammeSettings, seed: u64) -> Result<Vec<ProgrammeRun>, EngineError> {
    let mut runs = noise_runs(settings, seed)?;
    runs.extend(service_runs(settings, seed)?);
    runs.extend(tone_runs(settings)?);
    Ok(runs)
}

fn noise_runs(settings: &ProgrammeSettings, seed: u64) -> Result<Vec<ProgrammeRun>, EngineError> {
    let ProgrammeSettings { run_s, stretch_s, .. } = *settings;
    check("programme.run_s", run_s, MIN_DURATION_S, MAX_DURATION_S)?;
    check("programme.stretch_s", stretch_s, MIN_DURATION_S, MAX_DURATION_S)?;
    let mut runs = Vec::new();
    let mut push = |name: String, split, tag, drive| {
        runs.push(ProgrammeRun { name, kind: RunKind::Noise, split, tags: vec![tag], drive });
    };
    for index in 0..run_count("programme.linear_min", settings.linear_min, run_s)? {
        let drive = linear_noise(run_s, seed_for(seed, Purpose::Linear, index))?;
        push(format!("linear-{:02}", index + 1), Split::Training, "linear", drive);
    }
    let n_runs = run_count("programme.training_min", settings.training_min, run_s)?;
    let per_run = ((run_s / stretch_s).floor() as usize).max(1);
    let stretches =
        draw_stretches(n_runs * per_run, NoiseRegion::Interior, seed_for(seed, Purpose::Training, n_runs));
    for (index, part) in stretches.chunks(per_run).enumerate() {
        let drive = stitched(run_s, part, seed_for(seed, Purpose::Training, index))?;
        push(format!("noise-{:02}", index + 1), Split::Training, "mixed", drive);
    }
    let mixed = |duration_s, region| MixedNoise { duration_s, stretch_s, region };
    let drive = mixed_noise(
        &mixed(settings.validation_min * 60.0, NoiseRegion::Interior),
        seed_for(seed, Purpose::Validation, 0),
    )?;
    push("validation-noise".into(), Split::Validation, "mixed", drive);
    let drive = mixed_noise(&mixed(2.0 * run_s, NoiseRegion::Interior), seed_for(seed, Purpose::N1, 0))?;
    push("test-n1".into(), Split::Test, "n1", drive);
    let drive = mixed_noise(&mixed(2.0 * run_s, NoiseRegion::Boundary), seed_for(seed, Purpose::N2, 0))?;
    push("test-n2".into(), Split::Test, "n2", drive);
    let drive = linear_noise(run_s, seed_for(seed, Purpose::LinearTest, 0))?;
    push("test-linear".into(), Split::Test, "linear", drive);
    Ok(runs)
}

fn service_runs(settings: &ProgrammeSettings, seed: u64) -> Result<Vec<ProgrammeRun>, EngineError> {
    let load = |shape: ServiceShape, scale, offset_kn| {
        service_load(
            &ServiceLoad { shape, duration_s: settings.run_s, scale, offset_kn },
            seed_for(seed, Purpose::Service, 0),
        )
    };
    let [first, second, third] = ServiceShape::ALL;
    let mut runs = Vec::new();
    let mut push = |name, split, tag, shape: ServiceShape, drive| {
        runs.push(ProgrammeRun { name, kind: RunKind::Service, split, tags: vec![tag, shape.name()], drive });
    };
    for shape in [first, second] {
        for scale in VALIDATION_SCALES {
            let name = format!("validation-{}-{scale:.1}", shape.name());
            push(name, Split::Validation, "sl", shape, load(shape, scale, 0.0)?);
        }
    }
    for scale in TEST_SCALES {
        push(format!("test-sl-{scale:.1}"), Split::Test, "sl", third, load(third, scale, 0.0)?);
    }
    for (name, tag, offset) in
        [("test-sl-minus", "sl-minus", -SERVICE_OFFSET_KN), ("test-sl-plus", "sl-plus", SERVICE_OFFSET_KN)]
    {
        push(name.into(), Split::Test, tag, third, load(third, OFFSET_SCALE, offset)?);
    }
    Ok(runs)
}

fn tone_runs(settings: &ProgrammeSettings) -> Result<[ProgrammeRun; 2], EngineError> {
    let tone = |name: &str, kind, tag, drive| ProgrammeRun {
        name: name.into(),
        kind,
        split: Split::Test,
        tags: vec![tag],
        drive,
    };
    let sines = sine(&Sine {
        duration_s: settings.run_s,
        frequency_hz: [2.0, 3.0, 5.0],
        amplitude_kn: [2.0; 3],
        mean_kn: [0.0; 3],
        phase_rad: [0.0; 3],
    })?;
    let sweeps = sweep(&Sweep {
        duration_s: settings.run_s,
        from_hz: 0.5,
        to_hz: 50.0,
        amplitude_kn: 1.0,
        mean_kn: [0.0; 3],
    })?;
    Ok([tone("test-sine", RunKind::Sine, "sine", sines), tone("test-sweep", RunKind::Sweep, "sweep", sweeps)])
}

/// Runs of `run_s` that make up `minutes`, at least one.
fn run_count(setting: &'static str, minutes: f64, run_s: f64) -> Result<usize, EngineError> {
    check(setting, minutes, 0.0, 24.0 * 60.0)?;
    Ok(((minutes * 60.0 / run_s).round() as usize).max(1))
}
