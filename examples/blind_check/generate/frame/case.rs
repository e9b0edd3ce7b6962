//! A case of a frame, or of several side by side: runs, files and label.

use std::fs;
use std::io;
use std::path::Path;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use serde_json::{Value, json};

use super::super::case::{Record, log_uniform};
use super::super::drives;
use super::super::files::{self, channel};
use super::super::rig::{FINE, RATE, rms};
use super::super::suites::Suite;
use super::body::{Beyond, Control, Frame, Quantity, Stretch};
use super::draw::{self, Wanted};
use super::law::{self, Named};
use super::linear::Nearby;

/// Smallest and largest share that the best linear frame leaves of a response.
const GAP: [f64; 2] = [0.03, 0.35];
/// What it leaves of a frame with a weak nonlinearity everywhere: less than matters.
const BACKGROUND: [f64; 2] = [0.004, 0.012];
const NOISE: [f64; 2] = [0.004, 0.02];
/// What forces that nobody measures do to a response.
const PROCESS: [f64; 2] = [0.005, 0.03];
const SHORT_S: f64 = 8.0;
const LONG_S: f64 = 30.0;
const HALF_S: f64 = 20.0;
const BASELINE_S: f64 = 40.0;
const ATTEMPTS: u64 = 60;

/// A drawn case.
struct Case {
    /// The first has the law.
    frames: Vec<Frame>,
    named: Named,
    beyond: Beyond,
    /// Strength of the force that nobody measures.
    process: f64,
    noise: f64,
    gap: f64,
    elsewhere: bool,
    high_hz: f64,
    rng: ChaCha8Rng,
}

impl Case {
    fn draw(suite: Suite, index: usize, seed: u64) -> Result<Self, String> {
        (0..ATTEMPTS)
            .find_map(|attempt| Self::attempt(suite, index, seed, attempt))
            .ok_or_else(|| format!("no frame of seed {seed} has the gap that is wanted"))
    }

    fn attempt(suite: Suite, index: usize, seed: u64, attempt: u64) -> Option<Self> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        rng.set_stream(attempt);
        let kind = index % 4;
        let rough = suite == Suite::RoughRigs;
        let none =
            if rough { index / 4 % 6 == 5 } else { suite == Suite::ForceOverDisplacement && index % 7 == 6 };
        let wanted = Wanted {
            suite,
            elsewhere: rough && kind == 0 && !none,
            looped: (rough && kind == 2) || (suite == Suite::Place && rng.random_bool(0.2)),
        };
        let mut list = law::of_structure(&mut rng);
        if rough && kind != 0 {
            list.extend(law::of_drives_and_sensors(&mut rng));
        }
        // Steps that are prime to the lists' lengths go through all of them.
        let step = if rough { 7 * (index / 4) + 5 * kind } else { 7 * (index / 2) + 4 * (index % 2) };
        let named = if none { law::NOTHING } else { list[step % list.len()] };
        let high_hz = rng.random_range(25.0..45.0);
        let count = if suite == Suite::ForceOverDisplacement { [1, 1, 3][index % 3] } else { 1 };
        let frames: Vec<Frame> = (0..count)
            .map(|_| {
                let frame = draw::frame(wanted, &mut rng);
                let drives = noises(frame.driven.len(), SHORT_S, 1.0, high_hz, &mut rng);
                frame.scaled(&drives)
            })
            .collect();
        let frame = &frames[0];
        let drives = noises(frame.driven.len(), SHORT_S, 1.0, high_hz, &mut rng);
        let nearby = Nearby::new(frame, &drives);
        let mut beyond = Beyond { law: named.law, ..Beyond::NONE };
        if rough && kind == 1 {
            let wanted = log_uniform(BACKGROUND, &mut rng);
            beyond.background =
                strength(wanted, |background| nearby.left(&Beyond { background, ..Beyond::NONE }));
        }
        let mut gap = 0.0;
        if named.family.is_some() {
            let wanted = log_uniform(GAP, &mut rng);
            beyond.strength = strength(wanted, |strength| nearby.left(&Beyond { strength, ..beyond }));
            gap = nearby.left_by_the_best(&beyond);
            if !(GAP[0]..=GAP[1]).contains(&gap) {
                return None;
            }
        } else if rough && kind == 1 {
            gap = nearby.left_by_the_best(&beyond);
        }
        let process =
            if rough && kind == 3 { process(frame, log_uniform(PROCESS, &mut rng), &mut rng) } else { 0.0 };
        let noise = log_uniform(NOISE, &mut rng);
        let elsewhere = wanted.elsewhere;
        Some(Self { frames, named, beyond, process, noise, gap, elsewhere, high_hz, rng })
    }

    /// Drives of all frames, one after the other.
    fn drives(&mut self, seconds: f64, level: f64) -> Vec<Vec<f64>> {
        let count = self.frames.iter().map(|frame| frame.driven.len()).sum();
        noises(count, seconds, level, self.high_hz, &mut self.rng)
    }

    fn record(&mut self, drives: &[Vec<f64>], started_s: f64) -> Record {
        let mut responses = Vec::new();
        let mut first = 0;
        for (f, frame) in self.frames.iter().enumerate() {
            let own = &drives[first..first + frame.driven.len()];
            first += frame.driven.len();
            let process = (self.process > 0.0).then(|| coloured(own[0].len(), self.process, &mut self.rng));
            let beyond = if f == 0 { self.beyond } else { Beyond::NONE };
            let stretch = Stretch { drives: own, process: process.as_deref(), steps: FINE };
            responses.extend(frame.respond(stretch, &beyond).into_iter().zip(frame.shares()));
        }
        let responses = responses
            .into_iter()
            .map(|(response, share)| {
                let noisy = |y: f64| -> f64 {
                    let e: f64 = StandardNormal.sample(&mut self.rng);
                    share * (y + self.noise * e)
                };
                response.into_iter().map(noisy).collect()
            })
            .collect();
        Record { drives: drives.to_vec(), responses, started_s }
    }

    /// The channels, drives first.
    fn channels(&self) -> Vec<Value> {
        let frame = &self.frames[0];
        if frame.control == Control::Specimen {
            let axes = || (0..self.frames.len()).map(files::axis_name);
            let drives = axes().map(|a| channel(&format!("disp_{a}"), "mm", "drive", "displacement", a));
            let forces = axes().map(|a| channel(&format!("force_{a}"), "kN", "response", "force", a));
            return drives.chain(forces).collect();
        }
        let drives = (1..=frame.driven.len()).map(|d| {
            let in_loop = d == 1 && matches!(frame.control, Control::Loop { .. });
            let (unit, quantity) = if in_loop { ("mm", "displacement") } else { ("kN", "force") };
            channel(&format!("drive_{d}"), unit, "drive", quantity, "z")
        });
        let responses = frame.sensors.iter().map(|sensor| {
            let (unit, quantity) = match sensor.quantity {
                Quantity::Acceleration => ("m/s^2", "acceleration"),
                _ => ("mm", "displacement"),
            };
            channel(&self.sensor_at(sensor.mass), unit, "response", quantity, "z")
        });
        drives.chain(responses).collect()
    }

    /// Name of the sensor at a mass.
    fn sensor_at(&self, mass: usize) -> String {
        let acceleration = self.frames[0].sensors[0].quantity == Quantity::Acceleration;
        format!("{}_{}", if acceleration { "acc" } else { "disp" }, mass + 1)
    }

    /// Where the law acts, as a verdict has it: `at` a channel or `between` two; `None` without a law, and where no
    /// sensor is.
    fn place(&self) -> Option<Value> {
        self.named.family?;
        let (frame, law) = (&self.frames[0], self.named.law);
        let mass = frame.site.mass;
        let at = |channel: String| Some(json!({"at": channel}));
        if frame.control == Control::Specimen {
            at(format!("disp_{}", files::axis_name(0)))
        } else if law.is_of_command() {
            at("drive_1".into())
        } else if !law.is_force() {
            at(self.sensor_at(frame.sensors[0].mass))
        } else if self.elsewhere {
            None
        } else if frame.site.joint && mass > 0 {
            Some(json!({"between": [self.sensor_at(mass - 1), self.sensor_at(mass)]}))
        } else {
            at(self.sensor_at(mass))
        }
    }
}

/// Strength at which something leaves the wanted share, or the strongest below it.
fn strength(wanted: f64, left: impl Fn(f64) -> f64) -> f64 {
    let (mut low, mut high) = (1e-4, 4.0);
    for _ in 0..12 {
        let middle = f64::sqrt(low * high);
        if left(middle) > wanted { high = middle } else { low = middle }
    }
    low
}

fn noises(count: usize, seconds: f64, level: f64, high_hz: f64, rng: &mut ChaCha8Rng) -> Vec<Vec<f64>> {
    let one = |rng: &mut ChaCha8Rng| drives::noise(seconds, high_hz, rng).iter().map(|u| level * u).collect();
    (0..count).map(|_| one(rng)).collect()
}

/// Noise that falls with the frequency.
fn coloured(n: usize, level: f64, rng: &mut ChaCha8Rng) -> Vec<f64> {
    let mut slow = 0.0;
    (0..n)
        .map(|_| {
            let e: f64 = StandardNormal.sample(rng);
            slow += 0.15 * (e - slow);
            // The deviation of this filter's output is 0.285 of its input's.
            level * slow / 0.285
        })
        .collect()
}

/// Level of the force that nobody measures at which it does so much to the first response.
fn process(frame: &Frame, share: f64, rng: &mut ChaCha8Rng) -> f64 {
    let n = (SHORT_S * RATE) as usize;
    let (silent, force) = (vec![vec![0.0; n]; frame.driven.len()], coloured(n, 1.0, rng));
    let stretch = Stretch { drives: &silent, process: Some(&force), steps: FINE };
    share / rms(&frame.respond(stretch, &Beyond::NONE)[0]).max(f64::MIN_POSITIVE)
}

/// Writes the runs and the `case.json` of a case, and answers its label.
///
/// # Errors
/// Files that cannot be written; a seed for which no frame has the wanted gap.
pub fn write(suite: Suite, index: usize, seed: u64, id: &str, folder: &Path) -> io::Result<Value> {
    let mut case = Case::draw(suite, index, seed).map_err(io::Error::other)?;
    fs::create_dir_all(folder)?;
    let low = case.drives(BASELINE_S, 0.5);
    let (long, half) = (case.drives(LONG_S, 1.0), case.drives(HALF_S, 0.5));
    let mut runs = vec![files::run(folder, "baseline-0", true, &case.record(&low, 0.0))?];
    let plain = suite.is_default_request(index);
    let order: &[(&str, &Vec<Vec<f64>>)] =
        &[("run-0", &long), ("run-1", &half), ("run-2", &half), ("run-3", &long)];
    let order = if plain { &order[..2] } else { order };
    for (k, (name, drives)) in order.iter().enumerate() {
        let record = case.record(drives, 720.0 + 4320.0 * k as f64);
        runs.push(files::run(folder, name, false, &record)?);
    }
    let repeats = if plain { json!([]) } else { json!([["run-0", "run-3"], ["run-1", "run-2"]]) };
    let about = json!({
        "id": id,
        "rig": {"id": format!("case-{id}"), "name": format!("Case {id}"), "sample_rate_hz": RATE, "channels": case.channels()},
        "runs": runs,
        "repeats": repeats,
        "sim": null,
        "diagnosis": {"mode": "in_situ"},
        "asked": plain.then_some(["run-0", "run-1"]),
        "check": [],
        "next_experiment": false,
        "alone": false,
    });
    fs::write(folder.join("case.json"), serde_json::to_string_pretty(&about)?)?;
    let effect = json!({"effect": case.named.effect, "family": case.named.family, "axis": null,
                        "strength": case.beyond.strength, "place": case.place()});
    Ok(
        json!({"id": id, "suite": suite.name(), "index": index, "seed": seed, "effects": [effect], "gap": case.gap,
              "noise": case.noise, "axes": case.frames.len(), "elsewhere": case.elsewhere,
              "looped": matches!(case.frames[0].control, Control::Loop { .. }),
              "background": case.beyond.background > 0.0, "process": case.process > 0.0,
              "default_request": plain}),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_case_has_the_gap_and_the_channels_of_its_suite() {
        for suite in [Suite::RoughRigs, Suite::Place, Suite::ForceOverDisplacement] {
            for index in 0..6 {
                let case = Case::draw(suite, index, 40 + index as u64).unwrap();
                let sensors: usize = case.frames.iter().map(|frame| frame.sensors.len()).sum();
                let drives: usize = case.frames.iter().map(|frame| frame.driven.len()).sum();
                assert_eq!(case.channels().len(), sensors + drives);
                assert_eq!(
                    case.place().is_some(),
                    case.named.family.is_some() && !case.elsewhere,
                    "{suite:?} {index}"
                );
                if case.named.family.is_some() {
                    assert!((GAP[0]..=GAP[1]).contains(&case.gap), "{suite:?} {index}: {}", case.gap);
                }
            }
        }
    }

    #[test]
    fn sensors_of_one_quantity_share_a_unit() {
        let mut case = (0..20)
            .filter_map(|seed| Case::draw(Suite::Place, 0, seed).ok())
            .find(|case| case.frames[0].sensors.len() > 1)
            .unwrap();
        let drives = case.drives(10.0, 1.0);
        let levels = case.frames[0].levels.clone();
        let made = case.record(&drives, 0.0).responses;
        let of = |i: usize| rms(&made[i]) / levels[i];
        assert!((of(0) / of(1) - 1.0).abs() < 0.3, "{} {}", of(0), of(1));
    }

    #[test]
    fn a_run_that_is_made_twice_differs_by_noise_alone() {
        let mut case = Case::draw(Suite::Place, 1, 3).unwrap();
        let drives = case.drives(10.0, 1.0);
        let [a, b] = [(); 2].map(|()| case.record(&drives, 0.0).responses.swap_remove(0));
        let apart: Vec<f64> = a.iter().zip(&b).map(|(a, b)| a - b).collect();
        let noise = case.noise * case.frames[0].shares()[0];
        assert!((rms(&apart) / 2.0_f64.sqrt() / noise - 1.0).abs() < 0.05);
    }
}
