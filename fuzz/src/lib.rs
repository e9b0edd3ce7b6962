//! Helpers of the fuzz targets: checks of readers' results, and a service to send requests to.

pub mod fixtures;
mod seeds;
mod service;

pub use seeds::plant;
pub use service::{Service, reply};

use rigcast::formats::{FormatError, MAX_CHANNELS, ParsedRun};
use rigcast::http::codes;

/// Checks the result of a reader: a valid run, no larger than its file can hold, or a documented code.
pub fn check_parsed(read: Result<ParsedRun, FormatError>, bytes: usize) {
    match read {
        Ok(run) => {
            let samples = run.channels[0].len();
            assert!((1..=MAX_CHANNELS).contains(&run.channels.len()) && samples > 0);
            assert!(run.channels.iter().all(|c| c.len() == samples && c.iter().all(|v| v.is_finite())));
            assert!(run.names.is_none_or(|names| names.len() == run.channels.len()));
            assert!(run.sample_rate_hz.is_none_or(|rate| rate.is_finite() && rate > 0.0));
            assert!(samples * run.channels.len() <= bytes, "no sample without a byte");
        }
        Err(error) => assert!(codes::find(error.code()).is_some(), "{error:?}"),
    }
}
