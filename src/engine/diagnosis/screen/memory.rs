//! What a law remembers: a spring and dry friction in series, a smooth hysteresis, a rate limit.

use super::front::Front;
use super::law::Scale;

/// Largest exponent of a force that stiffens as it yields: beyond it no motion of the rig goes.
const MOST_GROWTH: f64 = 20.0;

/// The hidden states of a law over one record.
#[derive(Debug, Clone)]
pub(super) struct Memory {
    /// Forces of the elements.
    pub z: [f64; 4],
    /// The displacement before; `None` at the first sample.
    last: Option<f64>,
    /// What follows at a limited rate.
    followed: f64,
    /// The outputs before of the filter ahead of a bend: of its pair of poles, two, and of its lag; `None` at the
    /// first sample.
    front: Option<[f64; 3]>,
    /// A deviation of the rate as a change a sample, in deviations of the displacement.
    rate: f64,
}

impl Memory {
    /// Of a law over an argument of this scale at so many samples a second.
    pub fn new(scale: Scale, rate_hz: f64) -> Self {
        Self { z: [0.0; 4], last: None, followed: 0.0, front: None, rate: scale.v / (scale.d * rate_hz) }
    }

    /// The change since the sample before; 0 at the first.
    pub fn step(&mut self, d: f64) -> f64 {
        if self.last.is_none() {
            self.followed = d;
        }
        d - self.last.replace(d).unwrap_or(d)
    }

    /// The output of a filter that has rested at the first sample, in its own deviations.
    pub fn filtered(&mut self, front: Front, d: f64) -> f64 {
        let before = self.front.unwrap_or([d; 3]);
        let (next, x) = front.next(before, d);
        self.front = Some(next);
        x
    }

    /// Follows `d` at `limit` deviations of the rate at most.
    pub fn follow(&mut self, d: f64, limit: f64) -> f64 {
        let most = limit * self.rate;
        self.followed += (d - self.followed).clamp(-most, most);
        self.followed
    }
}

/// The force of a spring of stiffness 1 in series with dry friction that slips at `limit` (Jenkins' element,
/// the stop operator): it follows the displacement until it slips.
pub(super) fn slide(z: &mut f64, step: f64, limit: f64) -> f64 {
    *z = (*z + step).clamp(-limit, limit);
    *z
}

/// The hysteretic displacement of Bouc and Wen with exponent 1, exact for any step: `dz = dy (1 - b |z| / limit)` with
/// `b = unloading` while `dy` and `z` have opposite signs, and `b = 1 + unloading` while they have one.
///
/// In their words `beta + gamma = (1 + unloading) / limit` and `gamma - beta = unloading / limit`: at 0 it unloads along a
/// straight line, below it more steeply, and below -1 it stiffens as it is loaded.
pub(super) fn yielding(z: &mut f64, step: f64, limit: f64, unloading: f64) -> f64 {
    let (side, way) = (step.signum(), step.abs());
    let along = *z * side;
    let to_zero = if along < 0.0 { unloaded_after(-along, unloading / limit) } else { 0.0 };
    let next = if way < to_zero {
        -yielded(-along, -way, unloading / limit)
    } else {
        yielded(along.max(0.0), way - to_zero, (1.0 + unloading) / limit)
    };
    *z = next * side;
    *z
}

/// Where `dz = dy (1 - rate z)` takes `z` over a way.
fn yielded(z: f64, way: f64, rate: f64) -> f64 {
    let exponent = (-rate * way).min(MOST_GROWTH);
    let grown = if exponent == 0.0 { way } else { way * exponent.exp_m1() / exponent };
    z * exponent.exp() + grown
}

/// The way back over which the same takes `z > 0` to 0; infinite where it never does.
fn unloaded_after(z: f64, rate: f64) -> f64 {
    match rate * z {
        0.0 => z,
        share if share < 1.0 => -(-share).ln_1p() / rate,
        _ => f64::INFINITY,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn over(d: &[f64], mut element: impl FnMut(&mut Memory, f64, f64) -> f64) -> Vec<f64> {
        let mut memory = Memory::new(Scale { centre: 0.0, d: 1.0, v: 1.0 }, 1.0);
        let each = |d: &f64| {
            let step = memory.step(*d);
            element(&mut memory, *d, step)
        };
        d.iter().map(each).collect()
    }

    #[test]
    fn a_slider_follows_to_its_limit_and_returns_at_once() {
        let found = over(&[0.0, 0.5, 2.0, 1.5, 0.5, -0.5, -1.0], |m, _, step| slide(&mut m.z[0], step, 1.0));
        assert_eq!(found, [0.0, 0.5, 1.0, 0.5, -0.5, -1.0, -1.0]);
    }

    #[test]
    fn a_rate_limit_follows_slowly_and_arrives() {
        assert_eq!(over(&[0.0, 1.0, 1.0, 0.9], |m, d, _| m.follow(d, 0.5)), [0.0, 0.5, 1.0, 0.9]);
    }

    #[test]
    fn a_smooth_hysteresis_does_not_depend_on_the_steps_and_stays_inside_its_limit() {
        let coarse = [0.0, 3.0, -2.0, 1.0];
        let fine: Vec<f64> = coarse
            .windows(2)
            .flat_map(|w| (0..100).map(move |k| w[0] + (w[1] - w[0]) * f64::from(k) / 100.0))
            .chain([1.0])
            .collect();
        for unloading in [0.0, 0.5, -0.5, -1.0, -1.2] {
            let of = |d: &[f64]| over(d, |m, _, step| yielding(&mut m.z[0], step, 0.7, unloading));
            let (a, b) = (of(&coarse), of(&fine));
            assert!((a[3] - b[300]).abs() < 1e-9 && (a[2] - b[200]).abs() < 1e-9, "{unloading}: {a:?}");
            assert!(unloading < -0.9 || b.iter().all(|z| z.abs() <= 0.7 / (1.0 + unloading)), "{unloading}");
        }
    }

    #[test]
    fn a_smooth_hysteresis_follows_its_equation() {
        let (limit, unloading, h) = (0.4, -1.2, 1e-4);
        let way: Vec<f64> = (0..40_000).map(|k| 1.5 * (f64::from(k) * h * 3.0).sin()).collect();
        let found = over(&way, |m, _, step| yielding(&mut m.z[0], step, limit, unloading));
        let mut z = 0.0;
        for (k, pair) in way.windows(2).enumerate() {
            let dy = pair[1] - pair[0];
            let slope = |z: f64| 1.0 - z.abs() / limit * (unloading + f64::from(u8::from(dy * z > 0.0)));
            let half = z + 0.5 * dy * slope(z);
            z += dy * slope(half);
            assert!((z - found[k + 1]).abs() < 1e-3, "{k}: {z} for {}", found[k + 1]);
        }
    }
}
