//! Warnings about the faults of a run, and what they mean for a fit.

use super::{ChannelQuality, DriveRepeats, Role, shown};
use crate::engine::rounded;

/// Share of a channel's standard deviation from which noise that no model can predict is told: good models of rigs have
/// errors of some per cent, in which one per cent is not seen.
pub const NOISE_FROM_SHARE: f64 = 0.01;

/// Noise between repeats from which it is told: it is then the larger part of the error of any good model.
pub const UNREPEATED_FROM_SHARE: f64 = 0.1;

/// Samples of the segment that delays are compared with, the longest that is usual for an FRF.
const SEGMENT: f64 = 4096.0;

/// Delay over the length of a segment at which an H1 estimate loses 5 %: the autocorrelation of the Hann window is
/// 0.95 there.
const LOSES_5_PERCENT: f64 = 0.088;

/// Longest segment of an FRF that is advised, samples: of longer ones a usual run leaves too few averages.
const LONGEST_ADVISED: usize = 16_384;

/// Warnings about one channel of a run with this sample rate.
pub(super) fn warnings(channel: &ChannelQuality, role: Role, sample_rate_hz: f64) -> Vec<String> {
    let found = [
        spikes(channel, sample_rate_hz),
        dropouts(channel, sample_rate_hz),
        hum(channel),
        quantisation(channel, role),
        delay(channel, sample_rate_hz),
    ];
    found.into_iter().flatten().collect()
}

fn spikes(channel: &ChannelQuality, sample_rate_hz: f64) -> Option<String> {
    let (name, found) = (&channel.channel, channel.spikes?);
    let first = seconds(found.first_sample? as f64 / sample_rate_hz);
    let (largest, deviations) = (shown(found.largest), shown(rounded(found.largest / channel.std, 2)));
    let count = counted(found.count, "spike", "spikes");
    Some(format!(
        "{name}: {count} of up to {largest} ({deviations} standard deviations), the first at {first}: each adds a cycle to the damage, \
         and a linear fit cannot explain it. Check the cable and the connector, and mend these samples or cut the run there, unless the \
         rig knocks."
    ))
}

fn dropouts(channel: &ChannelQuality, sample_rate_hz: f64) -> Option<String> {
    let (name, found) = (&channel.channel, channel.dropouts?);
    let first = seconds(found.first_sample? as f64 / sample_rate_hz);
    let longest = seconds(found.longest as f64 / sample_rate_hz);
    let count = counted(found.count, "drop-out", "drop-outs");
    Some(format!(
        "{name}: {count}, the first at {first}, the longest {longest} long: the channel holds one value there, and a fit \
         learns that the rig stands still. Check the sensor and its cable, and upload the run without these spans."
    ))
}

pub(super) fn hum(channel: &ChannelQuality) -> Option<String> {
    let (name, found) = (&channel.channel, channel.hum.as_ref()?);
    found.mains_hz?;
    if found.share < NOISE_FROM_SHARE {
        return None;
    }
    let lines: Vec<String> = found.lines_hz.iter().map(|hz| rounded(*hz, 3).to_string()).collect();
    Some(format!(
        "{name}: mains hum at {} Hz is {} of its RMS about the mean. No drive has these lines, so no model can predict \
         them. Check shields and earth, or fit below them with preprocess.low_pass_hz.",
        lines.join(", "),
        percent(found.share)
    ))
}

fn quantisation(channel: &ChannelQuality, role: Role) -> Option<String> {
    let (name, found) = (&channel.channel, channel.quantisation?);
    // A drive is what its steps say. The steps of a response are noise on what was measured.
    if role == Role::Drive || found.noise_share < NOISE_FROM_SHARE {
        return None;
    }
    Some(format!(
        "{name}: its values have steps of {}, its standard deviation is {} steps: rounding adds noise of {} of the standard \
         deviation, which no model can predict. Measure with a smaller range, or write the file with more digits.",
        shown(found.step),
        shown(rounded(found.steps_per_std, 2)),
        percent(found.noise_share)
    ))
}

pub(super) fn delay(channel: &ChannelQuality, sample_rate_hz: f64) -> Option<String> {
    let (name, found) = (&channel.channel, channel.delay.as_ref()?);
    let (drive, ms) = (&found.drive, shown(rounded(found.delay_ms.abs(), 3)));
    let samples = found.delay_ms * sample_rate_hz / 1e3;
    let resolution = found.resolution_ms * sample_rate_hz / 1e3;
    if samples < -resolution.max(1.0) {
        return Some(format!(
            "{name} is {ms} ms ahead of {drive}: a model predicts a response from the past of its drives, so it cannot learn \
             this one. Check whether the channels come from different devices or filters, and shift them into line."
        ));
    }
    if samples > LOSES_5_PERCENT * SEGMENT {
        let needed = ((samples / LOSES_5_PERCENT).ceil() as usize).next_power_of_two();
        let or_fit = if needed <= LONGEST_ADVISED {
            format!(", or fit with frf.segment_len {needed}")
        } else {
            String::new()
        };
        return Some(format!(
            "{name} follows {drive} by {ms} ms: an FRF with segments of {SEGMENT} samples is too low by more than 5 %. Shift the \
             channel into line{or_fit}."
        ));
    }
    None
}

/// Warnings about responses that do not repeat with their drives.
pub(super) fn noise_warnings(found: &DriveRepeats) -> Vec<String> {
    let noisy = found.responses.iter().filter(|response| response.noise_share >= UNREPEATED_FROM_SHARE);
    noisy
        .map(|response| {
            format!(
                "{}: from one repeat of the drives to the next it differs by noise of {} of its standard deviation. No model can \
                 come closer than that. Check the sensor and its range, or whether the rig drifts.",
                response.channel,
                percent(response.noise_share)
            )
        })
        .collect()
}

/// What repeats of the drives mean for a fit.
pub(super) fn note(found: &DriveRepeats) -> String {
    let responses: Vec<String> =
        found.responses.iter().map(|r| format!("{} {}", r.channel, percent(r.noise_share))).collect();
    let floor = if responses.is_empty() {
        String::new()
    } else {
        format!(
            " The responses repeat within {} of their standard deviations, a floor for the error of any model.",
            responses.join(", ")
        )
    };
    format!(
        "The drives repeat every {}, {} times. They excite multiples of {} Hz alone.{floor}",
        seconds(found.period_s),
        found.count,
        shown(rounded(1.0 / found.period_s, 4))
    )
}

fn counted(count: u64, one: &str, many: &str) -> String {
    format!("{count} {}", if count == 1 { one } else { many })
}

fn seconds(seconds: f64) -> String {
    format!("{} s", shown(seconds))
}

pub(super) fn percent(share: f64) -> String {
    format!("{} %", shown(rounded(100.0 * share, 2)))
}
