//! Warnings about an estimate, by channel and band.

use super::choose::ENOUGH_AVERAGES;
use super::{Frf, FrfQuality};

/// Multiple coherence below this gives a warning: at 0.8 a fifth of the output's power does not come
/// linearly from the inputs.
pub const LOW_COHERENCE: f64 = 0.8;

/// Smallest share of the excited lines with low coherence that gives a warning: narrow dips at
/// antiresonances are normal.
pub const LOW_SHARE: f64 = 0.03;

/// A relative random error above this gives a warning even if there are averages enough.
pub const LARGE_ERROR: f64 = 0.2;

/// Most bands of a channel that are named: the widest.
const NAMED_BANDS: usize = 3;

/// Coherence is averaged over this fraction of the excited lines, one in 64: a single line of few
/// averages scatters.
const SMOOTHED_SHARE: usize = 64;

/// Fewest lines of that mean.
const SMOOTHED_LINES: usize = 5;

/// A warning when few averages, or much noise, leave `H` uncertain.
pub(super) fn random_error(frf: &Frf, quality: &FrfQuality) -> Option<String> {
    let (averages, effective, nx) = (quality.averages, quality.effective_averages, frf.n_inputs);
    let few = averages < ENOUGH_AVERAGES * nx || effective < 2.0 * nx as f64;
    let worst = quality.random_error(frf).into_iter().flatten().reduce(f64::max);
    if !few && worst.is_none_or(|error| error < LARGE_ERROR) {
        return None;
    }
    let drives = if nx == 1 { "1 input".to_owned() } else { format!("{nx} inputs") };
    let error = match worst {
        Some(error) if error < 1.0 => format!("the FRF's random error is about {:.0} %", 100.0 * error),
        _ => "the FRF's random error is as large as the FRF".to_owned(),
    };
    let bias = if few { " and coherence is too high by construction" } else { "" };
    Some(format!(
        "{averages} averages ({effective:.1} independent ones) for {drives}: {error}{bias}; shorten \
         frf.segment_len or add runs"
    ))
}

/// A warning for each output whose multiple coherence is low in part of the excited band; `outputs` are
/// the channels' names.
pub fn low_coherence(frf: &Frf, quality: &FrfQuality, outputs: &[String]) -> Vec<String> {
    let lines: Vec<usize> = quality.judged_lines().collect();
    let hz = |line: usize| shown_hz(line as f64 * frf.df_hz(), frf.df_hz());
    outputs
        .iter()
        .enumerate()
        .filter_map(|(o, name)| {
            let coherence: Vec<f64> =
                lines.iter().map(|line| quality.multiple_coherence[line * frf.n_outputs + o]).collect();
            let low: Vec<bool> = smoothed(&coherence).into_iter().map(|c| c < LOW_COHERENCE).collect();
            let share = low.iter().filter(|low| **low).count() as f64 / low.len().max(1) as f64;
            if share < LOW_SHARE {
                return None;
            }
            let bands = widest(bands(&low));
            let named: Vec<String> = bands
                .named
                .iter()
                .map(|&[first, last]| format!("from {} to {} Hz", hz(lines[first]), hz(lines[last])))
                .collect();
            let more = if bands.more { " and elsewhere" } else { "" };
            Some(format!(
                "{name}: multiple coherence below {LOW_COHERENCE} {}{more} ({:.0} % of the band)",
                named.join(", "),
                100.0 * share
            ))
        })
        .collect()
}

/// Centred moving mean, shorter at the ends.
fn smoothed(values: &[f64]) -> Vec<f64> {
    let half = (values.len() / SMOOTHED_SHARE).max(SMOOTHED_LINES) / 2;
    (0..values.len())
        .map(|i| {
            let near = &values[i.saturating_sub(half)..values.len().min(i + half + 1)];
            near.iter().sum::<f64>() / near.len() as f64
        })
        .collect()
}

/// First and last of each stretch of low values; stretches that are hardly apart are one.
fn bands(low: &[bool]) -> Vec<[usize; 2]> {
    let apart = (low.len() / SMOOTHED_SHARE).max(SMOOTHED_LINES);
    let mut bands: Vec<[usize; 2]> = Vec::new();
    for i in (0..low.len()).filter(|&i| low[i]) {
        match bands.last_mut() {
            Some([_, last]) if i - *last <= apart => *last = i,
            _ => bands.push([i, i]),
        }
    }
    bands
}

/// The bands that are named, ascending, and whether there are more.
struct Widest {
    named: Vec<[usize; 2]>,
    more: bool,
}

fn widest(mut bands: Vec<[usize; 2]>) -> Widest {
    bands.sort_by_key(|[first, last]| std::cmp::Reverse(last - first));
    let more = bands.len() > NAMED_BANDS;
    bands.truncate(NAMED_BANDS);
    bands.sort_unstable();
    Widest { named: bands, more }
}

/// A frequency with as many digits as the distance of lines gives it.
fn shown_hz(hz: f64, df_hz: f64) -> String {
    let digits = (-df_hz.log10()).ceil().clamp(0.0, 9.0) as usize;
    let text = format!("{hz:.digits$}");
    if digits == 0 { text } else { text.trim_end_matches('0').trim_end_matches('.').to_owned() }
}
