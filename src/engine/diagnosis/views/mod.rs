//! What the report's page draws beside the report itself: curves and clouds, thinned to what a page
//! can show. All numbers are finite; a density of 0 means nothing above the noise.

mod force;
mod inverse;
mod spectra;
mod unseen;

use serde::{Deserialize, Serialize};

use super::input::Input;
use crate::diagnosis::data::prepare::Prepared;
use crate::diagnosis::data::problem::Problem;
use crate::diagnosis::fit::fitting::Fitted;

pub use force::{Argument, ForceView, Law, Path};
pub use spectra::ResponseSpectra;
pub use unseen::{UnseenRun, UnseenSpectra};

/// Curves and clouds of a diagnosis.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Views {
    /// Lower and upper edge of the band in which errors count.
    pub band_hz: [f64; 2],
    /// One a response; of very many those with the largest gaps.
    pub spectra: Vec<ResponseSpectra>,
    /// The verdict's response on a run that neither fitted nor chose.
    pub unseen: Option<UnseenRun>,
    /// What the model lacks, seen as a force or as a change of drive or sensor.
    pub force: Option<ForceView>,
}

impl Views {
    /// Views of all responses; of the verdict's with what the best fit does to it; and of the response
    /// on which the effect acts, if one was found.
    pub(super) fn new(
        input: &Input,
        prepared: &Prepared,
        shown: (&Problem, Option<&Fitted>),
        host: Option<(&Problem, &Fitted)>,
    ) -> Self {
        let rate = input.sample_rate_hz();
        let (seen_at, acting) = host.map_or((shown.0, None), |(problem, fitted)| (problem, Some(fitted)));
        Self {
            band_hz: prepared.band.map(|f| short(f * rate)),
            spectra: spectra::all(input, prepared),
            unseen: unseen::view(input, prepared, shown.0, shown.1),
            force: force::view(input, prepared, seen_at, acting),
        }
    }
}

/// Five digits, which is more than a page can show and half of what a number takes to write.
fn short(x: f64) -> f64 {
    if x == 0.0 || !x.is_finite() {
        return 0.0;
    }
    let digits = 10.0_f64.powi(4 - x.abs().log10().floor() as i32);
    let rounded = (x * digits).round() / digits;
    if rounded.is_finite() { rounded } else { x }
}

fn shorten(values: impl IntoIterator<Item = f64>) -> Vec<f64> {
    values.into_iter().map(short).collect()
}

#[cfg(test)]
mod tests {
    use super::short;

    #[test]
    fn numbers_are_cut_to_five_digits_and_stay_finite() {
        assert_eq!(short(123.456_789), 123.46);
        assert_eq!(short(-0.001_234_567_8), -0.001_234_6);
        assert_eq!(short(f64::NAN), 0.0);
        assert_eq!(short(f64::MIN_POSITIVE / 8.0), f64::MIN_POSITIVE / 8.0);
        assert_eq!(short(0.0), 0.0);
    }
}
