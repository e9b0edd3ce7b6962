//! The linear part: a finite impulse response of every drive, as rich as the data allow.
//!
//! What a richer linear part predicts on data that it was not fitted to is no law's doing. So memory, lead and
//! ridge are chosen by held-out error, and of those that do alike the longest memory and the mildest ridge are
//! taken: what a law leaves open is noise to the linear part, and a ridge against that noise would be too strong
//! beside the right law.

use faer::Mat;
use rayon::prelude::*;
use rigcast_numerics::decompose::Cholesky;

use super::groups::PARTS;
use super::modes::{self, Poles, relocate};
use super::moments::{Lags, Moments};
use super::track::{Segment, Track};

/// Lags before the present that may be used where they help: a force that follows from a measured displacement
/// is its derivative, and two recorders are seldom in step.
pub(super) const LEAD: usize = 4;
/// Memories that are compared, samples of the analysis.
const MEMORIES: [usize; 10] = [8, 16, 32, 64, 128, 192, 256, 384, 512, 768];
/// Most coefficients: the time of a factorisation grows with their cube.
pub(super) const MOST: usize = 800;
/// Ridges, relative to each drive's power.
const RIDGES: [f64; 5] = [1e-9, 1e-7, 1e-5, 1e-3, 1e-2];
/// The ridge at the end of the memory beside that at its beginning: old samples tell less.
const GROWTHS: [f64; 2] = [1.0, 1e4];
/// Logarithms of held-out errors that are alike, that are nearly so, and by which a lead has to help.
const ALIKE: f64 = 0.01;
const NEARLY: f64 = 0.03;
const LEAD_HELPS: f64 = 0.05;

/// Pairs of poles that are compared, the lags beside them, their ridges, and most columns with modes.
const PAIRS: [usize; 6] = [2, 4, 6, 9, 13, 18];
const DIRECT: usize = 8;
/// Pairs of poles that are compared beside forces.
const PAIRS_BESIDE: [usize; 4] = [1, 2, 4, 6];
const MODE_RIDGES: [f64; 4] = [1e-10, 1e-8, 1e-6, 1e-4];
const MOST_OF_MODES: usize = 240;
/// How often poles are relocated and compared.
const STAGES: usize = 3;

/// How the linear part is set.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Setting {
    pub lags: Lags,
    /// Modes beside the lags.
    pub poles: Option<Poles>,
    pub ridge: f64,
    pub growth: f64,
    /// Whether a law over a measured motion enters every mode by a factor of its own, too: the drives' ways into a
    /// response are not known, since what moved the modes has moved them.
    pub apart: bool,
}

impl Setting {
    /// What the ridge adds to the diagonal of `a`.
    pub fn penalty(&self, a: &Mat<f64>) -> Vec<f64> {
        let span = self.width();
        let drives = a.nrows() / span.max(1);
        let most = (0..a.nrows()).map(|r| a[(r, r)]).fold(0.0, f64::max);
        (0..drives)
            .flat_map(|d| {
                let power = (0..span).map(|k| a[(d * span + k, d * span + k)]).sum::<f64>() / span as f64;
                (0..span).map(move |k| {
                    let age = k as f64 / span as f64;
                    let own = if self.poles.is_some() { a[(d * span + k, d * span + k)] } else { power };
                    self.ridge * own * self.growth.powf(age) + 1e-12 * most + f64::MIN_POSITIVE
                })
            })
            .collect()
    }

    /// Coefficients a drive.
    pub fn width(&self) -> usize {
        self.lags.span + self.poles.as_ref().map_or(0, Poles::states)
    }

    /// Impulse response of a drive's coefficients, from the lag `-lead` on, `most` samples at most.
    pub fn impulse(&self, theta: &[f64], most: usize) -> Vec<f64> {
        let (direct, modes) = theta.split_at(self.lags.span);
        let Some(poles) = &self.poles else { return direct.to_vec() };
        let lead = self.lags.lead;
        let ringing = poles.impulse(modes, poles.memory(most).max(direct.len() - lead));
        (0..lead + ringing.len())
            .map(|k| direct.get(k).copied().unwrap_or(0.0) + if k < lead { 0.0 } else { ringing[k - lead] })
            .collect()
    }

    /// Samples of its memory, `most` at most.
    pub fn memory(&self, most: usize) -> usize {
        self.poles.as_ref().map_or(self.lags.span - self.lags.lead, |p| p.memory(most))
    }

    /// The factor of `a` with the ridge; `None` where it is singular to rounding.
    pub fn factor(&self, a: &Mat<f64>) -> Option<Cholesky> {
        let penalty = self.penalty(a);
        let mut ridged = a.clone();
        for (r, penalty) in penalty.iter().enumerate() {
            ridged[(r, r)] += penalty;
        }
        Cholesky::new(&ridged)
    }
}

/// Longest memory that the segments can carry; repeats of a drive count once.
pub(super) fn longest(segments: &[Segment], records: &[usize], drives: usize) -> usize {
    let rows = unique_rows(segments);
    let shortest = segments.iter().map(|s| records[s.record]).min().unwrap_or(0);
    (shortest / 4).min(rows / (5 * drives.max(1))).min(MOST / drives.max(1)).max(MEMORIES[0])
}

/// Rows that are no repeats.
fn unique_rows(segments: &[Segment]) -> usize {
    let mut units: Vec<(usize, usize)> = segments.iter().map(|s| (s.unit, s.rows.len())).collect();
    units.sort_unstable();
    units.dedup_by_key(|(unit, _)| *unit);
    units.iter().map(|(_, rows)| rows).sum()
}

/// Chooses memory, lead and ridge for all responses together.
pub(super) fn choose(moments: &[Moments], segments: &[Segment], lags: Lags) -> (f64, Setting) {
    let of_parts = of_parts(moments, segments);
    let longest = lags.span - lags.lead;
    let memories: Vec<usize> =
        MEMORIES.iter().copied().filter(|m| 10 * m <= 9 * longest).chain([longest]).collect();
    let many = |memory: usize| memory * (moments[0].a.nrows() / lags.span) > 300;
    // Of each memory its least error, and all that was tried.
    let mut tried: Vec<(f64, Vec<(f64, Setting)>)> = Vec::new();
    let mut around: Option<f64> = None;
    for &memory in &memories {
        let to = Lags { lead: 0, span: memory };
        // With many coefficients only ridges near the best so far.
        let near =
            |ridge: &f64| !many(memory) || around.is_none_or(|best| (ridge / best).log10().abs() < 2.5);
        let settings: Vec<Setting> = RIDGES
            .into_iter()
            .filter(near)
            .flat_map(|ridge| {
                GROWTHS.map(|growth| Setting { lags: to, poles: None, ridge, growth, apart: false })
            })
            .collect();
        let found = errors(&of_parts, lags, &settings);
        let (error, best) = least(&found);
        around = Some(best.ridge);
        tried.push((error, found));
    }
    let lowest = tried.iter().map(|(e, _)| *e).fold(f64::INFINITY, f64::min);
    let (_, richest) = tried.iter().rev().find(|(e, _)| *e <= lowest + ALIKE).unwrap_or(&tried[0]);
    let mut mild: Vec<&(f64, Setting)> = richest.iter().filter(|(e, _)| *e <= lowest + NEARLY).collect();
    mild.sort_by(|a, b| a.1.ridge.total_cmp(&b.1.ridge).then(a.0.total_cmp(&b.0)));
    let (error, setting) = mild.first().map_or_else(|| least(richest), |found| (*found).clone());
    let led =
        Setting { lags: Lags { lead: lags.lead, span: setting.lags.span + lags.lead }, ..setting.clone() };
    let (led_error, led) = least(&errors(&of_parts, lags, &[led]));
    if led_error < error - LEAD_HELPS { (led_error, led) } else { (error, setting) }
}

/// A linear part of modes, ready to be factored.
pub(super) struct WithModes {
    /// Mean logarithm of held-out errors.
    pub error: f64,
    pub setting: Setting,
    /// Its regressors, a matrix a segment.
    pub columns: Vec<Mat<f64>>,
    pub moments: Vec<Moments>,
}

/// Modes in place of a long memory: their poles from the signals of all segments, their number and the ridge by
/// held-out error; `None` where no poles can be had.
pub(super) fn with_modes(
    drives: &[Track],
    responses: &[Track],
    segments: &[Segment],
    lead: usize,
) -> Option<WithModes> {
    let span = lead + DIRECT;
    let mut best: Option<WithModes> = None;
    let fits = |pairs: &usize| {
        let columns = drives.len() * (2 * pairs + span);
        *pairs == PAIRS[0] || (columns <= MOST_OF_MODES && 5 * columns <= unique_rows(segments))
    };
    for pairs in PAIRS.into_iter().filter(fits) {
        let mut poles = Poles::spread(pairs, 0.35);
        // Noise may move poles away again: later rounds are no better of themselves.
        for _ in 0..STAGES {
            let Some(next) = relocate(poles, drives, &[], responses, segments, DIRECT) else { break };
            poles = next;
            let found = with_poles(&poles, drives, responses, segments, lead);
            if found.error.is_finite() && best.as_ref().is_none_or(|b| found.error < b.error - ALIKE) {
                best = Some(found);
            }
        }
    }
    best
}

/// Modes that are found beside forces which drive them as a law might: what is strong then moves no poles. Their number
/// by what they leave with the forces; `None` where no poles can be had.
pub(super) fn modes_beside(
    drives: &[Track],
    forces: &[Track],
    responses: &[Track],
    segments: &[Segment],
    lead: usize,
) -> Option<WithModes> {
    let mut best: Option<(f64, Poles)> = None;
    for pairs in PAIRS_BESIDE {
        let all = drives.len() * (2 * pairs + lead + DIRECT) + forces.len() * 2 * pairs;
        if all > MOST_OF_MODES && pairs > PAIRS_BESIDE[0] {
            break;
        }
        let mut poles = Poles::spread(pairs, 0.35);
        for _ in 0..STAGES {
            let Some(next) = relocate(poles, drives, forces, responses, segments, DIRECT) else { break };
            poles = next;
            let columns = modes::columns_beside(drives, forces, segments, &poles, lead, lead + DIRECT);
            let parts = of_parts(&Moments::of_columns(&columns, responses, segments), segments);
            // Each column has a ridge of its own, as if it were a drive.
            let lags = Lags { lead: 0, span: 1 };
            let setting = Setting { lags, poles: None, ridge: MODE_RIDGES[1], growth: 1.0, apart: false };
            let error = self::error(&parts, &setting);
            if error.is_finite() && best.as_ref().is_none_or(|b| error < b.0 - ALIKE) {
                best = Some((error, poles.clone()));
            }
        }
    }
    let mut found = with_poles(&best?.1, drives, responses, segments, lead);
    found.setting.apart = true;
    found.error.is_finite().then_some(found)
}

/// A linear part of modes whose poles are given, with the ridge by held-out error.
fn with_poles(
    poles: &Poles,
    drives: &[Track],
    responses: &[Track],
    segments: &[Segment],
    lead: usize,
) -> WithModes {
    let lags = Lags { lead, span: lead + DIRECT };
    let columns = modes::columns(drives, segments, poles, lead, lags.span);
    let moments = Moments::of_columns(&columns, responses, segments);
    let parts = of_parts(&moments, segments);
    let settings = MODE_RIDGES.map(|ridge| Setting {
        lags,
        poles: Some(poles.clone()),
        ridge,
        growth: 1.0,
        apart: false,
    });
    let found: Vec<(f64, Setting)> =
        settings.into_iter().map(|setting| (self::error(&parts, &setting), setting)).collect();
    let (error, setting) = least(&found);
    WithModes { error, setting, columns, moments }
}

/// The modes of a linear part moved to where other responses have them; `None` where it has none.
pub(super) fn moved(
    setting: &Setting,
    drives: &[Track],
    responses: &[Track],
    segments: &[Segment],
) -> Option<Setting> {
    let lead = setting.lags.lead;
    let poles = relocate(setting.poles.clone()?, drives, &[], responses, segments, DIRECT)?;
    let found = with_poles(&poles, drives, responses, segments, lead);
    found.error.is_finite().then_some(Setting { apart: setting.apart, ..found.setting })
}

fn of_parts(moments: &[Moments], segments: &[Segment]) -> Vec<Moments> {
    (0..PARTS)
        .filter_map(|part| {
            Moments::sum(moments.iter().zip(segments).filter(|(_, s)| s.part == part).map(|(m, _)| m))
        })
        .collect()
}

/// The mean logarithm of held-out errors of settings of the same lags.
fn errors(parts: &[Moments], lags: Lags, settings: &[Setting]) -> Vec<(f64, Setting)> {
    let selected: Vec<Moments> = parts.iter().map(|m| m.select(lags, settings[0].lags)).collect();
    settings.par_iter().map(|setting| (error(&selected, setting), setting.clone())).collect()
}

fn least(of: &[(f64, Setting)]) -> (f64, Setting) {
    of.iter().min_by(|a, b| a.0.total_cmp(&b.0)).expect("at least one setting is tried").clone()
}

fn error(parts: &[Moments], setting: &Setting) -> f64 {
    let Some(total) = Moments::sum(parts) else { return f64::INFINITY };
    let (mut sum, mut count) = (0.0, 0);
    for part in parts {
        let Some(factor) = setting.factor(&(&total.a - &part.a)) else { return f64::INFINITY };
        let theta = factor.solve(&(&total.b - &part.b));
        let through = &part.a * &theta;
        for (r, yy) in part.yy.iter().enumerate().filter(|(_, yy)| **yy > 0.0) {
            let column = |m: &Mat<f64>, k: usize| m[(k, r)];
            let left: f64 = (0..theta.nrows())
                .map(|k| column(&theta, k) * (column(&through, k) - 2.0 * column(&part.b, k)))
                .sum();
            sum += 0.5 * ((yy + left) / yy).max(1e-12).ln();
            count += 1;
        }
    }
    if count == 0 || !sum.is_finite() { f64::INFINITY } else { sum / f64::from(count) }
}
