//! Where the gap lies, of all responses together.

use crate::diagnosis::core::drive_band;
use crate::diagnosis::data::locate::{bands, ranges, segments};
use crate::diagnosis::data::overview::{Overview, gaps};
use crate::diagnosis::data::prepare::Prepared;
use crate::diagnosis::input::Input;
use crate::diagnosis::report::{ChannelShare, TimeVariance, Where};

/// The whole of where the gap lies.
pub fn location(
    input: &Input,
    prepared: &Prepared,
    overview: &Overview,
    names: &[String],
    rate: f64,
) -> Where {
    let mut place = Where {
        channels: Vec::new(),
        bands: Vec::new(),
        amplitude: Vec::new(),
        velocity: Vec::new(),
        segments: Vec::new(),
        out_of_band_excitation: out_of_band(prepared),
        time_variance: TimeVariance {
            repeat_drive_coherence: prepared.noises.iter().map(|n| n.drive_coherence).fold(0.0, f64::max),
        },
    };
    let shares: Vec<f64> = (0..prepared.problems.len()).map(|r| overview.systematic(r).powi(2)).collect();
    let total: f64 = shares.iter().sum();
    for (r, problem) in prepared.problems.iter().enumerate() {
        let (channel, noise) = (&input.responses[r].name, &prepared.noises[r]);
        let errors = gaps(problem, &problem.select);
        place.channels.push(ChannelShare {
            channel: channel.clone(),
            share_of_gap: if total > 0.0 { shares[r] / total } else { 0.0 },
            rms_error: overview.power[r].rms_error,
        });
        place.bands.extend(bands(channel, &problem.select, &errors, noise, prepared.band, rate));
        for (velocity, out) in [(false, &mut place.amplitude), (true, &mut place.velocity)] {
            out.extend(ranges(channel, problem, &problem.select, &errors, noise, prepared.band, velocity));
        }
        place.segments.extend(segments(channel, names, &problem.select, &errors, rate));
    }
    place
}

/// Whether the runs' drives have more than 5 % of their power outside the core's band.
fn out_of_band(prepared: &Prepared) -> bool {
    let stretches = prepared.problems[0].fit.iter();
    let drives: Vec<Vec<&[f64]>> = stretches.map(|s| s.drives.iter().map(Vec::as_slice).collect()).collect();
    drive_band(&drives).is_some_and(|band| band[1] > 1.15 * prepared.band[1])
}
