//! The run that would tell most.

use super::decide::Ranked;
use super::hypotheses::Listed;
use crate::Signal;
use crate::diagnosis::effects::effect::Family;
use crate::diagnosis::input::Input;
use crate::diagnosis::numerics::linear::mean;
use crate::diagnosis::report::{NextDrive, NextExperiment, Verdict, VerdictKind};
use crate::diagnosis::screen::{Recording, Screening, Transfer};

/// Levels of the menu, relative to the loudest run.
const LEVELS: [f64; 4] = [0.3, 1.0, 1.5, 2.0];
/// Squares in units of what the best leaves, over the whole run, from which on two laws are told apart.
const APART: f64 = 20.0;

/// What to run next: the same drive again where noise is to be told from a cause, another realisation where all runs
/// share one drive, else the level at which the two foremost laws differ most.
pub(super) fn experiment(
    input: &Input,
    recording: &Recording,
    screening: &Screening,
    ranked: &[Ranked<'_>],
    listed: &[Listed],
    verdict: &Verdict,
) -> Option<NextExperiment> {
    let drive = |kind: &str, level_rel: f64| NextDrive { kind: kind.into(), frequency_hz: None, level_rel };
    let separates: Vec<_> = ranked.iter().take(2).map(|r| r.standing.effect).collect();
    let plain = |drive: NextDrive| NextExperiment {
        drive,
        separates: separates.clone(),
        expected_separation: 0.0,
        inseparable_in_envelope: false,
    };
    if verdict.kind == VerdictKind::NoMaterialGap || verdict.kind == VerdictKind::NoneOfCatalogue {
        return None;
    }
    if screening.transfer == Transfer::OneDrive {
        return Some(plain(drive("noise", 1.0)));
    }
    // What time does, one drive at two times tells.
    let time = verdict.effect.is_none() && separates.iter().any(|e| e.family() == Family::TimeVariance);
    if verdict.kind == VerdictKind::Undecided || time {
        return Some(plain(drive("same_drive_again", 1.0)));
    }
    let [first, second, ..] = listed else { return Some(plain(drive("noise", LEVELS[0]))) };
    let loudest = input.loudest()?;
    // What adopted effects do at another level is not known here.
    let level_known = |scale: f64| !input.has_adopted() || scale == 1.0;
    let allowed = |scale: f64| {
        let limits = input.drive_limit.as_ref();
        limits.is_none_or(|limits| {
            loudest
                .drive
                .channels()
                .iter()
                .zip(limits)
                .all(|(u, limit)| scale * u.iter().fold(0.0_f64, |m, u| m.max(u.abs())) <= 1.001 * limit)
        })
    };
    let separation = |scale: f64| -> Option<f64> {
        let drives: Vec<Vec<f64>> =
            loudest.drive.channels().iter().map(|u| u.iter().map(|u| scale * u).collect()).collect();
        let nothing = vec![vec![0.0; loudest.drive.n_samples()]; recording.responses.len()];
        let before = loudest.added.as_ref().map(Signal::channels);
        let of = |law: &Listed| law.augmented.predict(&drives, &nothing, before);
        let (a, b) = (of(first)?, of(second)?);
        let apart = (0..recording.responses.len()).map(|r| {
            let difference: Vec<f64> = a[r].iter().zip(&b[r]).map(|(a, b)| a - b).collect();
            let centre = mean(&difference);
            let left = (first.hypothesis.responses.iter())
                .find(|h| h.channel == input.responses[r].name)
                .map_or(f64::INFINITY, |h| h.held_out.rms_after * scale.max(0.1));
            difference.iter().map(|d| (d - centre).powi(2)).sum::<f64>()
                / (left * left).max(f64::MIN_POSITIVE)
        });
        Some(apart.fold(0.0, f64::max)).filter(|s| s.is_finite())
    };
    let menu = LEVELS.into_iter().filter(|scale| allowed(*scale) && level_known(*scale));
    let (scale, expected) =
        menu.filter_map(|scale| Some((scale, separation(scale)?))).max_by(|a, b| a.1.total_cmp(&b.1))?;
    Some(NextExperiment {
        inseparable_in_envelope: expected < APART,
        expected_separation: expected,
        ..plain(drive("noise", scale))
    })
}
