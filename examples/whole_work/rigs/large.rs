//! A large synthetic rig: 32 drives, 32 responses.
//!
//! Each drive `u_i` passes an actuator of order two (45 to 70 Hz, damping 0.6 to 0.8): `a_i`. The actuators move a structure of
//! 24 modes `q_m'' + 2 z w q_m' + w^2 (q_m + b q_m^3 / (1 + (q_m / c)^2)) = w^2 (phi^T a)_m`, from 3 to 60 Hz, damping 2 to
//! 6 %, whose stiffness rises with deflection: by about 4 % at the level of the noise, and by 22 % at most. A response is its
//! actuator and the structure, `y_i = a_i + (psi q)_i`, with white sensor noise of 0.5 %. Shapes, frequencies and dampings are
//! drawn from a seed.
//!
//! Every second-order system is advanced exactly over a sample, its force held; the cubic force is that of the middle of the
//! sample, extrapolated: one of its beginning would take damping away.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use rigcast::engine::{EngineError, Signal};
use serde_json::{Value, json};

use super::{Drive, RATE_HZ, Rig};

/// Drives, and responses.
const N: usize = 32;
const MODES: usize = 24;
/// Rise of a mode's stiffness with the square of its deflection, whose RMS is one to two under noise, and the deflection from
/// which it rises no further.
const CUBIC: f64 = 0.025;
const BENT: f64 = 3.0;
const SENSOR_NOISE: f64 = 0.005;
/// Length of a stretch of one mean and level, samples.
const STRETCH: usize = 15_000;
/// Samples in which noise passes from one stretch to the next.
const RAMP: usize = 1_000;

/// The rig with the parameters of a seed.
pub struct Large {
    actuators: Vec<Oscillator>,
    modes: Vec<Oscillator>,
    /// `[mode][drive]`
    phi: Vec<[f64; N]>,
    /// `[mode][response]`
    psi: Vec<[f64; N]>,
}

/// `x'' + 2 z w x' + w^2 x = w^2 f` over one sample with `f` held: position and velocity, and what `f` adds to them.
#[derive(Clone, Copy)]
struct Oscillator {
    a: [f64; 4],
    b: [f64; 2],
}

impl Oscillator {
    fn new(hz: f64, damping: f64) -> Self {
        let (w, dt) = (std::f64::consts::TAU * hz, 1.0 / RATE_HZ);
        let (s, wd) = (damping * w, w * (1.0 - damping * damping).sqrt());
        let (sin, cos, decay) = ((wd * dt).sin(), (wd * dt).cos(), (-s * dt).exp());
        let a = [
            decay * (cos + s / wd * sin),
            decay * sin / wd,
            -decay * w * w / wd * sin,
            decay * (cos - s / wd * sin),
        ];
        // At rest under a constant force of one, the position is one.
        Self { a, b: [1.0 - a[0], -a[2]] }
    }

    fn next(&self, [x, v]: [f64; 2], force: f64) -> [f64; 2] {
        let Self { a, b } = self;
        [a[0] * x + a[1] * v + b[0] * force, a[2] * x + a[3] * v + b[1] * force]
    }
}

impl Large {
    pub fn new(seed: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let actuators = (0..N)
            .map(|_| Oscillator::new(rng.random_range(45.0..70.0), rng.random_range(0.6..0.8)))
            .collect();
        let modes = (0..MODES)
            .map(|mode| {
                let place = (mode as f64 + rng.random::<f64>()) / MODES as f64;
                Oscillator::new(3.0 * 20.0_f64.powf(place), rng.random_range(0.02..0.06))
            })
            .collect();
        let mut shapes = |scale: f64| -> Vec<[f64; N]> {
            let mut one = || scale * Distribution::<f64>::sample(&StandardNormal, &mut rng);
            (0..MODES).map(|_| std::array::from_fn(|_| one())).collect()
        };
        let (phi, psi) = (shapes(0.18), shapes(0.1));
        Self { actuators, modes, phi, psi }
    }
}

impl Rig for Large {
    fn id(&self) -> &'static str {
        "large"
    }

    fn channels(&self) -> Value {
        let drives = (0..N).map(
            |i| json!({"name": format!("drive_{i}"), "unit": "kN", "role": "drive", "quantity": "force"}),
        );
        // Ten groups of three for Multi-Rain, and two channels on their own.
        let responses = (0..N).map(|i| {
            let mut channel =
                json!({"name": format!("force_{i}"), "unit": "kN", "role": "response", "quantity": "force"});
            if i < 30 {
                channel["group"] = format!("group_{}", i / 3).into();
                channel["axis"] = ["x", "y", "z"][i % 3].into();
            }
            channel
        });
        drives.chain(responses).collect()
    }

    fn drives(&self) -> usize {
        N
    }

    fn targets(&self) -> Vec<String> {
        (0..N).map(|i| format!("force_{i}")).collect()
    }

    fn drive(&self, kind: Drive, seconds: f64, seed: u64) -> Result<Signal, EngineError> {
        let n = (seconds * RATE_HZ).round() as usize;
        let channels = (0..N as u64).map(|channel| {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            rng.set_stream(channel + 1);
            match kind {
                Drive::LinearNoise => noise(n, &mut rng).into_iter().map(|v| 0.3 * v).collect(),
                Drive::Noise => stretches(n, &mut rng),
                Drive::Service => load(n, &mut rng),
            }
        });
        Signal::new(RATE_HZ, channels.collect())
    }

    fn play(&self) -> f64 {
        0.2
    }

    fn respond(&self, arriving: &Signal, seed: u64) -> Result<Signal, EngineError> {
        let (mut actuators, mut modes) = ([[0.0; 2]; N], [[0.0; 2]; MODES]);
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut found: Vec<Vec<f64>> = (0..N).map(|_| Vec::with_capacity(arriving.n_samples())).collect();
        for t in 0..arriving.n_samples() {
            let mut a = [0.0; N];
            for i in 0..N {
                actuators[i] = self.actuators[i].next(actuators[i], arriving.channel(i)[t]);
                a[i] = actuators[i][0];
            }
            let mut y = a;
            for (m, mode) in modes.iter_mut().enumerate() {
                let q = mode[0] + 0.5 * mode[1] / RATE_HZ;
                let cubic = CUBIC * q.powi(3) / (1.0 + (q / BENT).powi(2));
                let force: f64 = self.phi[m].iter().zip(&a).map(|(phi, a)| phi * a).sum();
                *mode = self.modes[m].next(*mode, force - cubic);
                y.iter_mut().zip(&self.psi[m]).for_each(|(y, psi)| *y += psi * mode[0]);
            }
            for (y, channel) in y.iter().zip(&mut found) {
                let noise: f64 = StandardNormal.sample(&mut rng);
                channel.push(y + SENSOR_NOISE * noise);
            }
        }
        Signal::new(RATE_HZ, found)
    }
}

/// Noise below about 80 Hz, standard deviation near one.
fn noise(n: usize, rng: &mut ChaCha8Rng) -> Vec<f64> {
    let mut state = [0.0_f64; 4];
    (0..n)
        .map(|_| {
            let mut value: f64 = StandardNormal.sample(rng);
            for s in &mut state {
                *s += 0.5 * (value - *s);
                value = *s;
            }
            2.2 * value
        })
        .collect()
}

/// Noise whose level (0.3 to 1) and mean (-1 to 1) change every quarter of a minute.
fn stretches(n: usize, rng: &mut ChaCha8Rng) -> Vec<f64> {
    let mut noise = noise(n, rng);
    let draw = |rng: &mut ChaCha8Rng| (rng.random_range(0.3..1.0), rng.random_range(-1.0..1.0));
    let (mut before, mut next): ((f64, f64), (f64, f64)) = ((0.0, 0.0), draw(rng));
    for (t, v) in noise.iter_mut().enumerate() {
        let place = t % STRETCH;
        if t > 0 && place == 0 {
            (before, next) = (next, draw(rng));
        }
        let share = (place as f64 / RAMP as f64).min(1.0);
        let between = |a: f64, b: f64| a + share * (b - a);
        *v = between(before.1, next.1) + between(before.0, next.0) * *v;
    }
    noise
}

/// A load of slow sway and of roughness whose level wanders, with a burst every five seconds or so.
fn load(n: usize, rng: &mut ChaCha8Rng) -> Vec<f64> {
    let roughness = noise(n, rng);
    let (mut sway, mut level, mut burst) = (0.0, 0.0, 0.0);
    let slow = |state: &mut f64, hz: f64, rng: &mut ChaCha8Rng| {
        let share = (std::f64::consts::TAU * hz / RATE_HZ).min(1.0);
        let value: f64 = StandardNormal.sample(rng);
        *state += share * (value - *state);
        // As large as the noise that it is made of, whatever its corner.
        *state * (2.0 / share).sqrt()
    };
    roughness
        .into_iter()
        .map(|rough| {
            let slow_part = 0.4 * slow(&mut sway, 0.5, rng);
            let wanders = 0.3 + 0.15 * slow(&mut level, 0.1, rng).tanh();
            if rng.random::<f64>() < 0.2 / RATE_HZ {
                burst = 1.0;
            }
            burst *= 0.99;
            (slow_part + (wanders + 0.8 * burst) * rough).clamp(-3.0, 3.0)
        })
        .collect()
}
