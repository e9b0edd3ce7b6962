//! One case: a rig, its flaws and their strength, drives, repeats and sensor noise, all from one seed.

use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::drives::{self, Wish};
use super::effects::Named;
use super::flaw::{Flaw, Placed};
use super::retune::{Moves, retuned};
use super::rig::{COARSE, FINE, RATE, Rig, Span, rms};
use super::suites::Suite;

/// Smallest and largest gap relative to the response, and the smallest relative to the noise.
const GAP: [f64; 2] = [0.012, 0.45];
const ABOVE_NOISE: f64 = 1.1;
/// Noise relative to the response.
const NOISE: [f64; 2] = [0.004, 0.02];
/// Length of the programme and start of its runs, s.
const PROGRAMME_S: f64 = 4.0 * 3600.0;
const STARTS_S: [f64; 4] = [720.0, 5040.0, 9360.0, 14040.0];
/// Length of the signal on which a strength is found.
const SHORT_S: f64 = 10.0;
/// Length of a run on which an adopted effect is checked: long enough that its closure is the true one of
/// which the interval is stated, and not another random draw.
const CHECK_S: f64 = 44.0;
/// Most rigs that are drawn until a strength gives the wanted gap.
const ATTEMPTS: u64 = 50;

/// A run as it was recorded.
#[derive(Debug, Clone)]
pub struct Record {
    pub drives: Vec<Vec<f64>>,
    pub responses: Vec<Vec<f64>>,
    /// Seconds after the programme's start.
    pub started_s: f64,
}

/// A case with its truth.
pub struct Case {
    pub suite: Suite,
    /// Its number in the suite.
    pub index: usize,
    pub axes: usize,
    rig: Rig,
    pub named: Vec<Named>,
    pub placed: Vec<Placed>,
    pub noise: f64,
    pub gap: f64,
    high_hz: f64,
    low: Vec<Vec<f64>>,
    long: Vec<Vec<f64>>,
    half: Option<Vec<Vec<f64>>>,
    rng: ChaCha8Rng,
}

/// Noise and gap of a suite.
fn ranges(suite: Suite) -> ([f64; 2], [f64; 2]) {
    match suite {
        // Small gaps near the noise leave several effects possible.
        Suite::NextExperiment => ([0.01, NOISE[1]], [GAP[0], 0.08]),
        // A diagnosis that finds no gap takes no time, so that clocked cases have a clear one.
        Suite::Time => (NOISE, [0.1, 0.3]),
        _ => (NOISE, GAP),
    }
}

fn times(k: usize) -> [f64; 2] {
    [STARTS_S[k] / PROGRAMME_S, 1.0 / (RATE * PROGRAMME_S)]
}

/// A number whose logarithm is drawn evenly.
pub fn log_uniform(range: [f64; 2], rng: &mut impl Rng) -> f64 {
    (range[0].ln() + rng.random_range(0.0..1.0) * (range[1] / range[0]).ln()).exp()
}

/// The first seconds of each channel.
fn first(channels: &[Vec<f64>], seconds: f64) -> Vec<Vec<f64>> {
    let n = (seconds * RATE) as usize;
    channels.iter().map(|c| c[..n.min(c.len())].to_vec()).collect()
}

impl Case {
    /// Draws rigs until one of them has the gap that its seed asks for.
    ///
    /// # Errors
    /// A seed for which no rig does.
    pub fn draw(suite: Suite, index: usize, seed: u64) -> Result<Self, String> {
        (0..ATTEMPTS)
            .find_map(|attempt| Self::attempt(suite, index, seed, attempt))
            .ok_or_else(|| format!("no rig of seed {seed} has the gap that is wanted"))
    }

    fn attempt(suite: Suite, index: usize, seed: u64, attempt: u64) -> Option<Self> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        rng.set_stream(attempt);
        let high_hz = rng.random_range(25.0..45.0);
        let axes = suite.axes(index);
        let lengths = suite.lengths();
        let mut noise_drives = |seconds: f64, level: f64| -> Vec<Vec<f64>> {
            let one = |rng: &mut _| drives::noise(seconds, high_hz, rng).iter().map(|u| level * u).collect();
            (0..axes.max(2)).map(|_| one(&mut rng)).collect()
        };
        let long = noise_drives(lengths.long, 1.0);
        let half = lengths.half.map(|seconds| noise_drives(seconds, 0.5));
        let low = noise_drives(lengths.baseline, 0.5);
        let named = suite.flaws(index, &mut rng);
        let kinds: Vec<Flaw> = named.iter().map(|n| n.flaw).collect();
        let rig = Rig::draw(&mut rng, axes, &long, &kinds);
        let (noises, gaps) = ranges(suite);
        let noise = log_uniform(noises, &mut rng);
        let lowest = (ABOVE_NOISE * noise).max(gaps[0]);
        let wanted = log_uniform([lowest, gaps[1]], &mut rng);
        let axis = rng.random_range(0..axes);
        let force = axes > 1 && rng.random_bool(0.5);
        let sensor = axis + if force { axes } else { 0 };
        let place = |(k, &flaw): (usize, &Flaw)| {
            // Of effects on several axes each is on the next.
            let beside = if suite == Suite::TwoAxes { k } else { 0 };
            let on = |channel: usize| channel - channel % axes + (channel + beside) % axes;
            Placed { flaw, strength: 0.0, axis: on(axis), sensor: on(sensor) }
        };
        let mut placed: Vec<Placed> = kinds.iter().enumerate().map(place).collect();
        let mut gap = 0.0;
        if !kinds.iter().all(|flaw| flaw.of_recording()) {
            let (low, long) = (first(&low, SHORT_S), first(&long, SHORT_S));
            let fitted = if suite == Suite::NoRepeats { &long } else { &low };
            let measure = GapMeasure::new(suite, &rig, fitted, &long);
            // Of two effects neither is more than four times the other.
            let parts: Vec<f64> = match placed.len() {
                1 => vec![wanted],
                _ => {
                    let ratio = 2.0_f64.powf(rng.random_range(-1.0..1.0));
                    vec![wanted * ratio / 2.0_f64.sqrt(), wanted / ratio / 2.0_f64.sqrt()]
                }
            };
            for (placed, part) in placed.iter_mut().zip(&parts) {
                placed.strength = measure.strength(*placed, *part);
                let alone = measure.gap(&[*placed]);
                if alone < 0.8 * part || alone < lowest {
                    return None;
                }
            }
            gap = measure.gap(&placed);
            if !(gap >= lowest && gap <= gaps[1]) {
                return None;
            }
        }
        if suite == Suite::NoRepeats && gap > 0.0 {
            gap = left_in_the_loud_run(&rig, &long, &placed);
        }
        Some(Self { suite, index, axes, rig, named, placed, noise, gap, high_hz, low, long, half, rng })
    }

    /// Whether the sim is fitted on the rig with the flaw.
    pub fn with_the_flaw(&self) -> bool {
        matches!(self.suite, Suite::InSitu | Suite::NoRepeats)
    }

    /// The baseline run: with the flaw only where the sim was fitted on the rig that has it.
    pub fn baseline(&mut self) -> Record {
        let flaws = if self.with_the_flaw() { self.placed.clone() } else { Vec::new() };
        let drives = self.low.clone();
        let responses = self.respond(&drives, &flaws, [0.0, 0.0]);
        self.record(drives, responses, &flaws, 0.0)
    }

    /// The runs, and which of them have the same drives.
    pub fn runs(&mut self) -> (Vec<Record>, Vec<Vec<usize>>) {
        let flaws = self.placed.clone();
        let (long, half) = (self.long.clone(), self.half.clone());
        let (order, repeats) = match half {
            Some(half) => (vec![long.clone(), half.clone(), half, long], vec![vec![0, 3], vec![1, 2]]),
            None => (vec![long.clone(), long], vec![vec![0, 1]]),
        };
        let hours = if order.len() == 4 { vec![0, 1, 2, 3] } else { vec![0, 3] };
        let changes = flaws.iter().any(|p| p.flaw.of_the_hour());
        let mut responses: Vec<Vec<Vec<f64>>> = Vec::new();
        for (i, drives) in order.iter().enumerate() {
            // What does not change with the hour answers a repeated drive alike.
            let alike = repeats.iter().find_map(|pair| (pair[1] == i).then_some(pair[0]));
            let again = alike.filter(|_| !changes).map(|first| responses[first].clone());
            responses.push(again.unwrap_or_else(|| self.respond(drives, &flaws, times(hours[i]))));
        }
        let both = order.into_iter().zip(responses).zip(hours);
        let runs = both.map(|((d, y), k)| self.record(d, y, &flaws, STARTS_S[k])).collect();
        (runs, repeats)
    }

    /// The sim: the rig without the flaw, or one fitted to what the rig with the flaw does on the baseline
    /// run; and the mean of each response beside it.
    pub fn sim(&self) -> (Rig, Vec<f64>) {
        let n_responses = if self.axes == 1 { 1 } else { 2 * self.axes };
        if !self.with_the_flaw() {
            return (self.rig.clone(), vec![0.0; n_responses]);
        }
        let drives = first(&self.low, SHORT_S);
        let span = Span { drives: &drives, time: [0.0, 0.0], steps: COARSE };
        let low = self.rig.respond(span, &self.placed);
        let (sim, mean) = retuned(&self.rig, &drives, &low[0]);
        (sim, vec![mean; n_responses])
    }

    /// Drives at full and half level as fresh as on another day, and what the rig does without noise.
    pub fn checks(&mut self) -> Vec<Record> {
        let levels = if self.half.is_some() { vec![1.0, 0.5] } else { vec![1.0] };
        let mut record = |level: f64| {
            let count = self.long.len();
            let one = |rng: &mut ChaCha8Rng| from_rest(drives::noise(CHECK_S, self.high_hz, rng));
            let drives: Vec<Vec<f64>> =
                (0..count).map(|_| one(&mut self.rng).iter().map(|u| level * u).collect()).collect();
            let responses = self.respond(&drives, &self.placed, times(3));
            Record { drives, responses, started_s: STARTS_S[3] }
        };
        levels.into_iter().map(&mut record).collect()
    }

    /// One more run of the rig, after all others.
    ///
    /// # Errors
    /// A kind of run that the rig does not know.
    pub fn further(&mut self, wish: &Wish) -> Result<Record, String> {
        let peaks = self.peaks();
        let resonance = self.rig.resonance_hz();
        let drives = drives::wished(wish, &peaks, self.high_hz, resonance, &mut self.rng)?;
        let flaws = self.placed.clone();
        let responses = self.respond(&drives, &flaws, [1.0, 1.0 / (RATE * PROGRAMME_S)]);
        Ok(self.record(drives, responses, &flaws, PROGRAMME_S))
    }

    /// Largest magnitude of each drive of the runs.
    pub fn peaks(&self) -> Vec<f64> {
        self.long.iter().map(|d| drives::peak(d)).collect()
    }

    fn respond(&self, drives: &[Vec<f64>], flaws: &[Placed], time: [f64; 2]) -> Vec<Vec<f64>> {
        self.rig.respond(Span { drives, time, steps: FINE }, flaws)
    }

    /// What a recorder makes of responses.
    fn record(
        &mut self,
        drives: Vec<Vec<f64>>,
        mut responses: Vec<Vec<f64>>,
        flaws: &[Placed],
        started_s: f64,
    ) -> Record {
        let is = |flaw: Flaw| flaws.iter().any(|p| p.flaw == flaw);
        let sigma = self.noise * if is(Flaw::RaisedNoise) { 3.0 } else { 1.0 };
        let hum = flaws.iter().find_map(|p| if let Flaw::Hum { hz } = p.flaw { Some(hz) } else { None });
        for response in &mut responses {
            let phase = self.rng.random_range(0.0..std::f64::consts::TAU);
            for (i, y) in response.iter_mut().enumerate() {
                let e: f64 = StandardNormal.sample(&mut self.rng);
                *y += sigma * e;
                if let Some(hz) = hum {
                    *y += 2.5 * self.noise * (std::f64::consts::TAU * hz * i as f64 / RATE + phase).sin();
                }
                if is(Flaw::Quantisation) {
                    let step = 8.0 * self.noise;
                    *y = (*y / step).round() * step;
                }
            }
        }
        Record { drives, responses, started_s }
    }
}

/// The drive with a rise over its first second: what a sim takes for a drive's past is then no matter.
fn from_rest(mut drive: Vec<f64>) -> Vec<f64> {
    for (k, u) in drive.iter_mut().enumerate().take(RATE as usize) {
        *u *= k as f64 / RATE;
    }
    drive
}

/// What the best linear rig leaves of the first run, which is loud, relative to the response: the gap that a user who
/// asks about that run has. What only changes from run to run is no part of it.
fn left_in_the_loud_run(rig: &Rig, drives: &[Vec<f64>], flaws: &[Placed]) -> f64 {
    let respond = |rig: &Rig, flaws: &[Placed]| {
        rig.respond(Span { drives, time: times(0), steps: COARSE }, flaws).swap_remove(0)
    };
    let with = respond(rig, flaws);
    let (best, mean) = retuned(rig, drives, &with);
    let left: Vec<f64> = with.iter().zip(respond(&best, &[])).map(|(y, sim)| y - sim - mean).collect();
    rms(&left) / rms(&with)
}

/// What a sim leaves of a flaw on a stretch of the programme, relative to the response.
struct GapMeasure<'a> {
    rig: &'a Rig,
    low: &'a [Vec<f64>],
    long: &'a [Vec<f64>],
    linear: Vec<Vec<f64>>,
    /// Where the sim is fitted on the rig with the flaw: how it moves on `low` and on `long`.
    moves: Option<[Moves; 2]>,
}

impl<'a> GapMeasure<'a> {
    fn new(suite: Suite, rig: &'a Rig, low: &'a [Vec<f64>], long: &'a [Vec<f64>]) -> Self {
        let span = Span { drives: long, time: times(3), steps: COARSE };
        let fitted = matches!(suite, Suite::InSitu | Suite::NoRepeats);
        let moves = fitted.then(|| [low, long].map(|drives| Moves::new(rig, drives)));
        Self { rig, low, long, linear: rig.respond(span, &[]), moves }
    }

    /// The largest over the responses.
    fn gap(&self, flaws: &[Placed]) -> f64 {
        let respond = |drives, time| self.rig.respond(Span { drives, time, steps: COARSE }, flaws);
        let with = respond(self.long, times(3));
        let fitted = self
            .moves
            .as_ref()
            .map(|[low, long]| vec![long.response(&low.fit(&respond(self.low, [0.0, 0.0])[0]))]);
        let sim = fitted.as_ref().unwrap_or(&self.linear);
        let of = |(y, sim): (&Vec<f64>, &Vec<f64>)| {
            let left: Vec<f64> = y.iter().zip(sim).map(|(a, b)| a - b).collect();
            let gap = rms(&left) / rms(y);
            if gap.is_finite() { gap } else { f64::INFINITY }
        };
        with.iter().zip(sim).map(of).fold(0.0, f64::max)
    }

    /// The strength at which a flaw leaves the gap that is wanted, or the strongest below it.
    fn strength(&self, placed: Placed, wanted: f64) -> f64 {
        let (mut low, mut high) = (1e-4, 3.0);
        for _ in 0..11 {
            let mid = f64::sqrt(low * high);
            if self.gap(&[Placed { strength: mid, ..placed }]) > wanted { high = mid } else { low = mid }
        }
        low
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_seed_gives_the_same_case_and_a_gap_above_the_noise() {
        let mut one = Case::draw(Suite::Catalogue, 3, 5).unwrap();
        let mut two = Case::draw(Suite::Catalogue, 3, 5).unwrap();
        assert_eq!(one.baseline().responses, two.baseline().responses);
        assert!(one.gap >= GAP[0] && one.gap <= GAP[1] && one.gap >= ABOVE_NOISE * one.noise);
    }

    #[test]
    fn repeats_differ_by_noise_alone_and_the_baseline_of_an_external_sim_is_without_the_flaw() {
        let mut case = Case::draw(Suite::Catalogue, 4, 6).unwrap();
        let (runs, repeats) = case.runs();
        for pair in &repeats {
            let [a, b] = [&runs[pair[0]], &runs[pair[1]]];
            assert_eq!(a.drives, b.drives);
            let difference: Vec<f64> =
                a.responses[0].iter().zip(&b.responses[0]).map(|(a, b)| a - b).collect();
            let noise = rms(&difference) / 2.0_f64.sqrt();
            assert!((noise / case.noise - 1.0).abs() < 0.05, "{noise} for {}", case.noise);
        }
        let baseline = case.baseline();
        let span = Span { drives: &baseline.drives, time: [0.0, 0.0], steps: 2 * FINE };
        let linear = case.rig.respond(span, &[]);
        let left: Vec<f64> = baseline.responses[0].iter().zip(&linear[0]).map(|(a, b)| a - b).collect();
        assert!((rms(&left) / case.noise - 1.0).abs() < 0.05);
    }

    #[test]
    fn a_sim_fitted_on_the_rig_has_taken_in_what_is_linear() {
        let mut case = Case::draw(Suite::InSitu, 0, 7).unwrap();
        let measure = GapMeasure::new(Suite::InSitu, &case.rig, &case.low, &case.long);
        let gain = Placed { flaw: Flaw::Gain, strength: 0.2, axis: 0, sensor: 0 };
        assert!(measure.gap(&[gain]) < 0.01, "{}", measure.gap(&[gain]));
        let outside = GapMeasure::new(Suite::Catalogue, &case.rig, &case.low, &case.long);
        assert!(outside.gap(&[gain]) > 0.1);
        case.placed = vec![gain];
        let (sim, _) = case.sim();
        let span = Span { drives: &case.low, time: [0.0, 0.0], steps: COARSE };
        let expected = case.rig.respond(span, &[gain]);
        let left: Vec<f64> = sim.respond(span, &[])[0].iter().zip(&expected[0]).map(|(a, b)| a - b).collect();
        assert!(rms(&left) < 2e-3 * rms(&expected[0]), "{}", rms(&left) / rms(&expected[0]));
    }
}
