//! Faults of measured channels that a fit would learn as if they were the rig: spikes, drop-outs, mains hum, coarse steps,
//! delays; and the noise floor that a cyclic drive shows.
//!
//! One pass over a channel finds spikes and drop-outs. All other figures come from excerpts: at most a stated number
//! of samples, spread evenly over the run. Time and memory of those do not grow with the run. Thresholds follow
//! from the number of samples and [`FALSE_ALARM`], so that a longer run does not warn more often. Nothing is random.

mod delay;
mod dropouts;
mod excerpt;
mod hum;
mod long_delay;
mod quantisation;
mod repeats;
mod scan;
mod spikes;

pub use delay::{Delay, delays};
pub use dropouts::Dropouts;
pub use excerpt::Excerpts;
pub use hum::{Hum, MainsFinder};
pub use quantisation::Quantisation;
pub use repeats::{Repeats, repeats};
pub use scan::{Scan, scan};
pub use spikes::Spikes;

/// Probability that a figure of one channel of independent Gaussian samples is a false alarm, however many samples it has.
pub const FALSE_ALARM: f64 = 1e-6;

/// Shortest run that is judged, samples: below, a channel's own statistics are too vague for a fault to stand out.
pub const SHORTEST: usize = 256;

/// Factor on a Gaussian standard deviation that one of `n` samples exceeds with [`FALSE_ALARM`] at most:
/// `P(|x| > z) <= exp(-z^2 / 2)` for z above 1.
fn gaussian_limit(n: usize) -> f64 {
    (2.0 * (n as f64 / FALSE_ALARM).ln()).sqrt()
}

/// The same for a deviation that is estimated from `freedom` degrees of freedom, by the tail of Student's distribution:
/// `P(|t| > x) <= (1 + x^2 / freedom)^(-freedom / 2)`.
fn student_limit(n: usize, freedom: f64) -> f64 {
    (freedom * ((n as f64 / FALSE_ALARM).powf(2.0 / freedom) - 1.0)).sqrt()
}

/// The value below which a share of the values lies; 0 for none. Reorders the values.
fn quantile(values: &mut [f64], share: f64) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    let at = ((values.len() - 1) as f64 * share) as usize;
    *values.select_nth_unstable_by(at, f64::total_cmp).1
}
