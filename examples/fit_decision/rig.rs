//! Rigs of the population: masses on springs and dampers, a drive that is a force, a command in a closed loop, or the
//! motion of a specimen whose force is measured, or of a table; each with one thing beyond its linear part, or none.

use std::f64::consts::TAU;

use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use rigcast::engine::diagnosis::Family;
use rigcast::engine::diagnosis::screen::{Channel, Record, Recording};
use rigcast::engine::{Quantity, Signal};

use crate::drives::{self, Kind, deviation};
use crate::law::{Command, Force, Now, SLIDERS, Sensor};

const RATE_HZ: f64 = 256.0;
/// Steps of integration a sample.
const STEPS: usize = 6;
/// Samples before the record begins.
const BEFORE: usize = 400;

/// A rig's recording and what it has beyond its linear part: one of these families, or none of them.
pub struct Case {
    pub recording: Recording,
    pub truth: Vec<Family>,
}

/// How a drive moves the rig.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Control {
    Force,
    /// A servo-hydraulic loop of position with a gain and an integrator, each a sample.
    Loop {
        gain: f64,
        reset: f64,
    },
    /// A valve lets oil in by the error of position; what the mass does not make room for presses on it.
    Servo {
        /// Flow of an error, a sample.
        pace: f64,
        /// Frequency of the mass on the oil, rad a sample, and its damping ratio.
        oil: f64,
        damping: f64,
    },
    /// The specimen's motion is commanded, its force measured.
    Specimen,
    /// All stands on a table whose acceleration is the drive; motions are those over the table.
    Table,
}

/// A chain of masses, the first tied to ground.
struct Chain {
    /// Frequency of each spring on its mass, rad a sample, squared.
    stiffness: Vec<f64>,
    damping: Vec<f64>,
}

/// What stands beyond the linear part.
#[derive(Clone, Copy)]
struct Beyond {
    force: Option<Force>,
    strength: f64,
    /// A second, weaker one.
    background: Option<(Force, f64)>,
    command: Command,
    sensor: Sensor,
    /// A static law between two filters.
    block: Option<Block>,
    /// What a valve makes of the error of position.
    valve: Command,
    /// Supply of a valve whose flow falls with the load's root, in deviations of the elastic force.
    supply: Option<f64>,
}

/// A bend of the command behind two lags, or a pair of poles, of so many cycles a sample.
#[derive(Clone, Copy)]
struct Block {
    bend: f64,
    corner: f64,
    damping: Option<f64>,
}

/// Where a force acts: the motion of a mass against ground or against the one before it.
#[derive(Clone, Copy)]
struct Site {
    mass: usize,
    between: bool,
}

/// Deviations by which laws are scaled.
#[derive(Clone, Copy)]
struct Level {
    y: f64,
    rate: f64,
    beside: f64,
    force: f64,
    error: f64,
}

struct Rig {
    /// One of each axis.
    chains: Vec<Chain>,
    control: Control,
    lag: f64,
    site: Site,
    hidden: bool,
    quantity: Quantity,
    drive_kind: Kind,
    low: f64,
    high: f64,
    noise: f64,
    noise_colour: Option<f64>,
    process: f64,
}

/// Draws the rig of a seed and runs it.
pub fn draw(seed: u64) -> Result<Case, rigcast::engine::EngineError> {
    let rng = &mut ChaCha8Rng::seed_from_u64(seed);
    let kind = rng.random_range(0..26);
    let of_valve = kind == 22 || kind == 23;
    let control = match rng.random_range(0..20) {
        _ if (4..=8).contains(&kind) || kind == 10 || kind == 20 => Control::Force,
        _ if of_valve => servo(rng),
        _ if kind == 24 || kind == 25 => Control::Table,
        0..=9 => Control::Force,
        10..=11 => servo(rng),
        12..=13 => Control::Loop { gain: rng.random_range(0.02..0.2), reset: rng.random_range(0.0..0.001) },
        _ if kind == 21 => Control::Force,
        _ => Control::Specimen,
    };
    // A second axis says nothing of what the first has.
    let axes = if kind == 8 || (control == Control::Force && rng.random_bool(0.3)) { 2 } else { 1 };
    let masses = if control == Control::Specimen || of_valve { 1 } else { rng.random_range(1..4) };
    let first = log_uniform(0.012, 0.07, rng);
    let chain = |rng: &mut ChaCha8Rng| {
        let zeta = log_uniform(0.008, 0.25, rng);
        let at = |i: usize, rng: &mut ChaCha8Rng| first * (1.0 + 1.1 * i as f64) * rng.random_range(0.8..1.4);
        let frequencies: Vec<f64> = (0..masses).map(|i| TAU * at(i, rng).min(0.3)).collect();
        Chain {
            damping: frequencies.iter().map(|w| 2.0 * zeta * w).collect(),
            stiffness: frequencies.iter().map(|w| w * w).collect(),
        }
    };
    let chains: Vec<Chain> = (0..axes).map(|_| chain(rng)).collect();
    let mass =
        if control == Control::Table && rng.random_bool(0.7) { 0 } else { rng.random_range(0..masses) };
    let quantity = match (control, rng.random_range(0..10)) {
        (Control::Specimen, _) => Quantity::Force,
        (Control::Servo { .. }, _) => Quantity::Displacement,
        (Control::Table, _) => Quantity::Acceleration,
        (_, 0..=4) => Quantity::Displacement,
        (_, 5..=6) => Quantity::Velocity,
        _ => Quantity::Acceleration,
    };
    let drive_kind = match rng.random_range(0..10) {
        0..=6 => Kind::Noise,
        7..=8 => Kind::Multisine { period: [512, 1024, 2048][rng.random_range(0..3)] },
        _ => Kind::Sweep,
    };
    let rig = Rig {
        chains,
        control,
        lag: log_uniform(0.05, 0.4, rng),
        site: Site { mass, between: mass > 0 && rng.random_bool(0.6) },
        hidden: masses > 1 && rng.random_bool(0.2),
        quantity,
        drive_kind,
        low: if rng.random_bool(0.5) { 0.0 } else { 0.2 * first },
        high: (first * rng.random_range(1.5..6.0)).min(0.3),
        noise: log_uniform(3e-4, 0.1, rng),
        noise_colour: rng.random_bool(0.4).then(|| rng.random_range(0.01..0.2)),
        process: if rng.random_bool(0.25) { log_uniform(0.003, 0.1, rng) } else { 0.0 },
    };
    let plain = Beyond {
        force: None,
        strength: log_uniform(0.04, 0.8, rng),
        background: rng.random_bool(0.2).then(|| {
            let force = if rng.random_bool(0.5) { Force::stiffness(rng) } else { Force::damping(rng) };
            (force, rng.random_range(0.05..0.2))
        }),
        command: Command::Plain,
        sensor: Sensor::Plain,
        block: None,
        valve: Command::Plain,
        supply: None,
    };
    let levels = levels(rng);
    let repeated = levels.len() > 1 && rng.random_bool(0.2);
    let n = if levels.len() == 1 { rng.random_range(6000..16_000) } else { rng.random_range(3000..7000) };
    let drives: Vec<Vec<Vec<f64>>> = levels
        .iter()
        .map(|level| {
            let of = |rng: &mut ChaCha8Rng| {
                let u = drives::drive(rig.drive_kind, n + BEFORE, rig.low, rig.high, rng);
                u.into_iter().map(|u| level * u).collect::<Vec<f64>>()
            };
            (0..axes).map(|_| of(rng)).collect()
        })
        .collect();
    let loud = (0..levels.len()).max_by(|a, b| levels[*a].total_cmp(&levels[*b])).unwrap_or(0);
    let step = deviation(&drives[loud][0].windows(2).map(|w| w[1] - w[0]).collect::<Vec<f64>>());
    let control = rig.control;
    let beyond = match kind {
        0..=2 => Beyond { force: Some(Force::stiffness(rng)), ..plain },
        3 | 9 | 15 => Beyond { force: Some(Force::friction(rng)), ..plain },
        4 | 5 => Beyond { command: Command::actuator(step, rng), background: None, ..plain },
        6 => Beyond { command: Command::deadband(rng), background: None, ..plain },
        7 => Beyond { sensor: Sensor::some(rng), background: None, ..plain },
        8 => Beyond { force: Some(Force::cross_axis(rng)), background: None, ..plain },
        10 | 20 => {
            let block = Block {
                bend: rng.random_range(0.1..0.8),
                corner: rig.high * log_uniform(0.15, 1.2, rng),
                damping: rng.random_bool(0.5).then(|| rng.random_range(0.1..0.7)),
            };
            Beyond { block: Some(block), background: None, ..plain }
        }
        21 => Beyond { supply: Some(rng.random_range(1.3..5.0)), background: None, ..plain },
        22 | 23 => Beyond { valve: Command::valve(rng), background: None, ..plain },
        24 => Beyond { force: Some(Force::stiffness(rng)), ..plain },
        25 if rng.random_bool(0.5) => Beyond { force: Some(Force::friction(rng)), ..plain },
        25 => Beyond { force: Some(Force::damping(rng)), ..plain },
        11 => Beyond { force: Some(Force::drift(rng)), background: None, ..plain },
        12 | 14 => Beyond { force: Some(Force::damping(rng)), background: None, ..plain },
        13 => Beyond { force: Some(Force::outside(rng)), background: None, ..plain },
        _ => Beyond { background: None, ..plain },
    };
    let unscaled = Level { y: 1.0, rate: 1.0, beside: 1.0, force: 1.0, error: 1.0 };
    let linear = Beyond {
        force: None,
        background: None,
        command: Command::Plain,
        sensor: Sensor::Plain,
        block: None,
        valve: Command::Plain,
        supply: None,
        ..plain
    };
    let level =
        rig.run(&drives[loud], &linear, unscaled, [0.0, 1.0], &mut ChaCha8Rng::seed_from_u64(0)).level;
    let mut records = Vec::new();
    let (mut with, mut without) = (0.0, 0.0);
    let order: Vec<usize> = (0..levels.len()).chain(repeated.then_some(0)).collect();
    for (at, &index) in order.iter().enumerate() {
        let clock = [at, at + 1].map(|a| a as f64 / order.len() as f64);
        let quiet = &mut ChaCha8Rng::seed_from_u64(seed ^ 0x55 ^ at as u64);
        let made = rig.run(&drives[index], &beyond, level, clock, quiet);
        let quiet = &mut ChaCha8Rng::seed_from_u64(seed ^ 0x55 ^ at as u64);
        let bare = rig.run(&drives[index], &linear, level, clock, quiet);
        let (y, y0) = (&made.responses[0], &bare.responses[0]);
        with += y.iter().zip(y0).map(|(a, b)| (a - b).powi(2)).sum::<f64>();
        without += y0.iter().map(|y| y * y).sum::<f64>();
        let drive: Vec<Vec<f64>> = drives[index].iter().map(|u| u[BEFORE..].to_vec()).collect();
        records.push(Record {
            drive: Signal::new(RATE_HZ, drive)?,
            response: Signal::new(RATE_HZ, rig.measured(made.responses, rng))?,
            added: None,
            started_s: 100.0 * at as f64,
        });
    }
    let channel = |name: String, quantity: Quantity| Channel { name, quantity, size: None };
    let driven = match control {
        Control::Force => Quantity::Force,
        Control::Table => Quantity::Acceleration,
        _ => Quantity::Displacement,
    };
    let responses = records[0].response.n_channels();
    let recording = Recording {
        drives: (0..axes).map(|i| channel(format!("drive_{i}"), driven)).collect(),
        responses: (0..responses).map(|i| channel(format!("response_{i}"), rig.quantity)).collect(),
        records,
    };
    // What changes less than this cannot be seen beside rounding.
    let seen = with > 1e-8 * without;
    let maps = [beyond.command.family(), beyond.valve.family(), beyond.sensor.family()];
    // A static law behind a filter of the command is both a block structure and an actuator's map.
    let block = [Family::BlockStructure, Family::Actuator].map(|f| beyond.block.map(|_| f));
    let valve = beyond.supply.map(|_| Family::Actuator);
    let force = beyond.force.and_then(Force::family);
    let truth = maps.into_iter().chain(block).chain([valve, force]).flatten().filter(|_| seen).collect();
    Ok(Case { recording, truth })
}

/// A loop around a valve that is as quick as the oil allows, or slower.
fn servo(rng: &mut impl Rng) -> Control {
    let oil = TAU * log_uniform(0.06, 0.16, rng);
    let damping = rng.random_range(0.2..0.6);
    Control::Servo { pace: 2.0 * damping * oil * rng.random_range(0.1..0.5), oil, damping }
}

/// RMS of the drive of each run.
fn levels(rng: &mut impl Rng) -> Vec<f64> {
    match rng.random_range(0..5) {
        0 => vec![1.0],
        1 => vec![1.0; rng.random_range(2..5)],
        2 => vec![0.5, 1.0],
        3 => vec![0.3, 0.6, 1.0],
        _ => vec![1.0, 0.5, 1.0, 0.25],
    }
}

fn log_uniform(low: f64, high: f64, rng: &mut impl Rng) -> f64 {
    (rng.random_range(low.ln()..high.ln())).exp()
}

/// What a run does.
struct Made {
    responses: Vec<Vec<f64>>,
    level: Level,
}

impl Rig {
    fn masses(&self) -> usize {
        self.chains[0].stiffness.len()
    }

    /// Responses after the first samples, and the deviations at the place of the law.
    fn run(
        &self,
        drives: &[Vec<f64>],
        beyond: &Beyond,
        level: Level,
        clock: [f64; 2],
        rng: &mut ChaCha8Rng,
    ) -> Made {
        let n = drives[0].len();
        let mut commands: Vec<Vec<f64>> = drives.to_vec();
        commands[0] = beyond.command.apply(&commands[0]);
        if let Some(bend) = beyond.block {
            commands[0] = block(&commands[0], bend);
        }
        for command in &mut commands {
            let disturbance = drives::coloured(n, self.high, rng);
            let size = self.process * deviation(command) / deviation(&disturbance).max(1e-12);
            command.iter_mut().zip(disturbance).for_each(|(u, d)| *u += size * d);
        }
        let (axes, masses) = (self.chains.len(), self.masses());
        let width = 2 * masses + 2;
        let mut x = vec![0.0; axes * width + 2 * SLIDERS];
        let mut kept: Vec<Vec<f64>> = vec![Vec::with_capacity(n); axes * masses];
        let (mut y, mut rate, mut beside, mut force) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        let mut error = Vec::new();
        for t in 0..n {
            let next = (t + 1).min(n - 1);
            for step in 0..STEPS {
                let at = |share: f64| -> Vec<f64> {
                    let s = (step as f64 + share) / STEPS as f64;
                    commands.iter().map(|u| u[t] + s * (u[next] - u[t])).collect()
                };
                let now = t as f64 + step as f64 / STEPS as f64;
                let time = (clock[0] + (clock[1] - clock[0]) * now / n as f64, now + 7e4 * clock[0]);
                let rates = |x: &[f64], u: &[f64]| self.rates(x, u, beyond, level, time).rates;
                let h = 1.0 / STEPS as f64;
                let moved =
                    |k: &[f64], by: f64| -> Vec<f64> { x.iter().zip(k).map(|(x, k)| x + by * k).collect() };
                let (u0, u1, u2) = (at(0.0), at(0.5), at(1.0));
                let a = rates(&x, &u0);
                let b = rates(&moved(&a, 0.5 * h), &u1);
                let c = rates(&moved(&b, 0.5 * h), &u1);
                let d = rates(&moved(&c, h), &u2);
                for i in 0..x.len() {
                    x[i] += h / 6.0 * (a[i] + 2.0 * b[i] + 2.0 * c[i] + d[i]);
                }
            }
            let u: Vec<f64> = commands.iter().map(|u| u[next]).collect();
            let time = (clock[0] + (clock[1] - clock[0]) * t as f64 / n as f64, t as f64 + 7e4 * clock[0]);
            let now = self.rates(&x, &u, beyond, level, time);
            y.push(now.y);
            rate.push(now.rate);
            beside.push(now.beside);
            force.push(now.elastic);
            error.push(u[0] - x[2 * (masses - 1)]);
            for axis in 0..axes {
                for mass in 0..masses {
                    let at = axis * width + 2 * mass;
                    kept[axis * masses + mass].push(match self.quantity {
                        Quantity::Force => now.force,
                        Quantity::Displacement => x[at],
                        Quantity::Velocity => x[at + 1],
                        _ if self.control == Control::Table => now.rates[at + 1] + u[axis],
                        _ => now.rates[at + 1],
                    });
                }
            }
        }
        let level = Level {
            y: deviation(&y).max(1e-12),
            rate: deviation(&rate).max(1e-12),
            beside: deviation(&beside).max(1e-12),
            force: deviation(&force).max(1e-12),
            error: deviation(&error).max(1e-12),
        };
        let sensed = |y: Vec<f64>| -> Vec<f64> {
            let y = y[BEFORE..].to_vec();
            let size = deviation(&y).max(1e-12);
            y.iter().map(|y| size * beyond.sensor.apply(y / size)).collect()
        };
        // One sensor an axis where the place is hidden, at another mass.
        let seen = |i: usize| {
            let mass = i % masses;
            !self.hidden || mass != self.site.mass
        };
        let responses =
            kept.into_iter().enumerate().filter(|(i, _)| seen(*i)).map(|(_, y)| sensed(y)).collect();
        Made { responses, level }
    }

    /// Adds the noise of sensors.
    fn measured(&self, responses: Vec<Vec<f64>>, rng: &mut ChaCha8Rng) -> Vec<Vec<f64>> {
        responses
            .into_iter()
            .map(|y| {
                let noise: Vec<f64> = match self.noise_colour {
                    Some(high) => drives::coloured(y.len(), high, rng),
                    None => (0..y.len()).map(|_| StandardNormal.sample(rng)).collect(),
                };
                let size = self.noise * deviation(&y) / deviation(&noise).max(1e-12);
                y.iter().zip(noise).map(|(y, e)| y + size * e).collect()
            })
            .collect()
    }
}

/// Rates of all states, and what is at the place of the law.
struct Rates {
    rates: Vec<f64>,
    y: f64,
    rate: f64,
    beside: f64,
    /// Of the linear part at the place.
    elastic: f64,
    /// That a commanded motion needs.
    force: f64,
}

impl Rig {
    /// Newton's law for every mass, the actuator's lag or loop, and the states of friction.
    fn rates(&self, x: &[f64], u: &[f64], beyond: &Beyond, level: Level, time: (f64, f64)) -> Rates {
        let (axes, masses) = (self.chains.len(), self.masses());
        let width = 2 * masses + 2;
        let mut rates = vec![0.0; x.len()];
        let place = |axis: usize, of: usize| {
            let at = axis * width;
            let own = x[at + 2 * self.site.mass + of];
            if self.site.between && self.site.mass > 0 {
                own - x[at + 2 * (self.site.mass - 1) + of]
            } else {
                own
            }
        };
        let (y, rate) = (place(0, 0), place(0, 1));
        let beside = if axes > 1 { place(1, 0) } else { 0.0 };
        let now = Now {
            y: y / level.y,
            rate: rate / level.y,
            v: rate / level.rate,
            beside: beside / level.beside,
            clock: time.0,
            sample: time.1,
        };
        let friction = axes * width;
        let mut law = 0.0;
        for (i, found) in
            [beyond.force.map(|f| (f, beyond.strength)), beyond.background].into_iter().enumerate()
        {
            let Some((force, strength)) = found else { continue };
            let own = friction + i * SLIDERS..friction + (i + 1) * SLIDERS;
            law += strength * level.force * force.at(&now, &x[own.clone()], &mut rates[own]);
        }
        let (mut elastic, mut needed) = (0.0, 0.0);
        // The root of the pressure that the load leaves.
        let valve = |axis: usize, opening: f64, load: f64| match beyond.supply {
            Some(supply) if axis == 0 => {
                (1.0 - opening.signum() * load / (supply * level.force)).clamp(0.0, 2.0).sqrt()
            }
            _ => 1.0,
        };
        for (axis, chain) in self.chains.iter().enumerate() {
            let at = axis * width;
            for mass in 0..masses {
                let (own, before) = (at + 2 * mass, mass.checked_sub(1).map(|m| at + 2 * m));
                let spring = |i: usize, a: usize, b: Option<usize>| {
                    let (d, v) = b.map_or((x[a], x[a + 1]), |b| (x[a] - x[b], x[a + 1] - x[b + 1]));
                    chain.stiffness[i] * d + chain.damping[i] * v
                };
                let mut force = -spring(mass, own, before);
                if axis == 0 && mass == self.site.mass {
                    elastic = force;
                }
                if mass + 1 < masses {
                    force += spring(mass + 1, own + 2, Some(own));
                }
                if axis == 0 && mass == self.site.mass {
                    force -= law;
                } else if axis == 0 && self.site.between && mass + 1 == self.site.mass {
                    force += law;
                }
                if mass == masses - 1 {
                    let actuator = at + 2 * masses;
                    match self.control {
                        Control::Force => {
                            let flow = u[axis] * valve(axis, u[axis], x[actuator]);
                            rates[actuator] = TAU * self.lag * (flow - x[actuator]);
                            force += x[actuator];
                        }
                        Control::Loop { gain, reset } => {
                            let error = u[axis] - x[own];
                            rates[actuator] = reset * error;
                            let wanted = gain * error + x[actuator];
                            let wanted = wanted * valve(axis, wanted, x[actuator + 1]);
                            rates[actuator + 1] = TAU * self.lag * (wanted - x[actuator + 1]);
                            force += x[actuator + 1];
                        }
                        Control::Servo { pace, oil, damping } => {
                            let error = (u[axis] - x[own]) / level.error;
                            let error = if axis == 0 { beyond.valve.at(error, &mut 0.0) } else { error };
                            let wanted = pace * level.error * error;
                            let flow = x[actuator + 1] * valve(axis, x[actuator + 1], x[actuator]);
                            rates[actuator + 1] = TAU * 0.3 * (wanted - x[actuator + 1]);
                            rates[actuator] =
                                oil * oil * (flow - x[own + 1]) - 2.0 * damping * oil * x[actuator];
                            force += x[actuator];
                        }
                        Control::Table => {}
                        Control::Specimen => {
                            // A stiff table follows the command; what it needs beside that is the specimen's.
                            let follow = (TAU * 0.15).powi(2);
                            let table = follow * (u[axis] - x[own]) - 2.0 * 0.7 * TAU * 0.15 * x[own + 1];
                            needed = -force;
                            force = table;
                        }
                    }
                }
                if self.control == Control::Table {
                    force -= u[axis];
                }
                rates[own] = x[own + 1];
                rates[own + 1] = force;
            }
        }
        Rates { rates, y, rate, beside, elastic, force: needed }
    }
}

/// Bends a command between a filter and the rig's dynamics.
fn block(u: &[f64], Block { bend, corner, damping }: Block) -> Vec<f64> {
    let pace = TAU * corner / STEPS as f64;
    let mut states = [0.0; 2];
    let filtered: Vec<f64> = u
        .iter()
        .map(|u| {
            for _ in 0..STEPS {
                match damping {
                    Some(damping) => {
                        states[0] += pace * (u - states[1] - 2.0 * damping * states[0]);
                        states[1] += pace * states[0];
                    }
                    None => {
                        states[0] += pace * (u - states[0]);
                        states[1] += pace * (states[0] - states[1]);
                    }
                }
            }
            states[1]
        })
        .collect();
    let size = deviation(&filtered).max(1e-12);
    filtered.iter().map(|x| x + bend * size * ((x / size).max(-0.3) + 0.3).powf(1.3)).collect()
}
