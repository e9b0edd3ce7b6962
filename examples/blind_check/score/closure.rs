//! The closure of the gap, and the coverage of its intervals.

use realfft::RealFftPlanner;
use serde_json::Value;

use super::case::Case;
use super::row::{Bar, Row};
use super::statistics::{Share, median};

/// Start of a check run that is left to the transients, s.
const SETTLING_S: f64 = 4.0;

/// Rows over the right ones of all suites; `truth` is what each checked rig does on fresh drives.
///
/// The equation of the rig itself, with the rig's own numbers, leaves nothing but noise: its closure is 1,
/// so a median closure of 0.99 is 99 % of it.
pub fn rows(cases: &[Case], truth: impl Fn(&Case) -> Option<Value>) -> Vec<Row> {
    let right = || {
        cases
            .iter()
            .filter(|c| ["catalogue", "in-situ", "three-axes"].contains(&c.suite.as_str()) && c.is_right())
    };
    if right().next().is_none() {
        return Vec::new();
    }
    let held = |c: &Case, key: &str| c.blamed_hypothesis().and_then(|h| h["held_out"][key].as_f64());
    let closures = right().filter_map(|c| held(c, "closure"));
    let left = |c: &&Case| Some(held(c, "rms_after")? / held(c, "noise_rms")?.max(f64::MIN_POSITIVE));
    let ratios: Vec<f64> = right().filter(|c| c.kind() == "identified").filter_map(|c| left(&c)).collect();
    let covered: Vec<bool> = right().filter_map(|c| interval_holds(c, &truth(c)?)).collect();
    vec![
        Row::number("closure", "of the right ones, median", median(closures), Bar::AtLeast(0.99)),
        Row::share(
            "closure",
            "90 % interval holds that on fresh drives",
            Share::count(covered, |holds| *holds),
            Bar::Between(0.85, 0.95),
        ),
        Row::number(
            "closure",
            "identified: RMS after, in noise floors, median",
            median(ratios.iter().copied()),
            Bar::AtMost(1.2),
        ),
        Row::share(
            "closure",
            "identified: at most 1.2 noise floors",
            Share::count(ratios, |r| *r <= 1.2),
            Bar::None,
        ),
    ]
}

/// Whether the closure's interval holds what the adopted effect closes of a noise-free response to
/// fresh drives; `None` where it was not adopted, or where the rig goes on changing.
fn interval_holds(case: &Case, truth: &Value) -> Option<bool> {
    let hypothesis = case.blamed_hypothesis()?;
    if hypothesis["family"] == "time_variance" {
        return None;
    }
    let channel = hypothesis["channel"].as_str()?;
    let band = band(case, channel)?;
    let left = |model: &str| -> Option<f64> {
        let runs = case.answer["check"][model].as_array()?;
        let of = |(predicted, truth): (&Value, &Value)| {
            let rate = truth["sample_rate_hz"].as_f64()?;
            let (p, t) = (samples(predicted, channel)?, samples(truth, channel)?);
            let from = (SETTLING_S * rate) as usize;
            let error: Vec<f64> = p.iter().zip(&t).skip(from).map(|(p, t)| p - t).collect();
            Some(power(&error, rate, band))
        };
        runs.iter().zip(truth.as_array()?).map(of).sum()
    };
    let closure = 1.0 - left("adopted")? / left("sim")?;
    let ends = hypothesis["held_out"]["closure_ci90"].as_array()?;
    Some(closure >= ends[0].as_f64()? && closure <= ends[1].as_f64()?)
}

fn samples(signal: &Value, channel: &str) -> Option<Vec<f64>> {
    signal["channels"][channel].as_array()?.iter().map(Value::as_f64).collect()
}

/// The band in which the report scores, Hz.
fn band(case: &Case, channel: &str) -> Option<[f64; 2]> {
    let bands = case.report()["where"]["bands"].as_array()?;
    let own = || bands.iter().filter(|b| b["channel"] == channel);
    let low = own().filter_map(|b| b["from_hz"].as_f64()).fold(f64::INFINITY, f64::min);
    let high = own().filter_map(|b| b["to_hz"].as_f64()).fold(0.0, f64::max);
    (low < high).then_some([low, high])
}

/// Sum of squares of a signal inside a band.
fn power(x: &[f64], rate: f64, band: [f64; 2]) -> f64 {
    let fft = RealFftPlanner::new().plan_fft_forward(x.len());
    let mut input = x.to_vec();
    let mut lines = fft.make_output_vec();
    fft.process(&mut input, &mut lines).expect("buffers of the plan's own lengths");
    let hz = |line: usize| line as f64 * rate / x.len() as f64;
    let inside = |line: usize| hz(line) >= band[0] && hz(line) <= band[1];
    lines.iter().enumerate().filter(|(i, _)| inside(*i)).map(|(_, c)| c.norm_sqr()).sum()
}
