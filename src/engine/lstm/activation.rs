//! Sigmoid and tanh through one polynomial for `2^x` and a refined reciprocal.
//!
//! Arguments come already multiplied: `-log2(e) a` for a sigmoid, `-2 log2(e) a` for tanh (the
//! factors are folded into the packed weights), so that
//! `sigmoid(a) = 1 / (1 + 2^s)` and `tanh(a) = (1 - 2^s) / (1 + 2^s)`.
//! Both are within 2e-7 of the exact value. Damage grows with the fifth power of an amplitude, so a
//! larger error would show in it.

use crate::simd::Simd;

/// Factor of a sigmoid's argument, `-log2(e)`.
pub(super) const SIGMOID_SCALE: f32 = -std::f32::consts::LOG2_E;
/// Factor of tanh's argument, `-2 log2(e)`.
pub(super) const TANH_SCALE: f32 = -2.0 * std::f32::consts::LOG2_E;

/// Beyond `2^60` both functions are at their limit in `f32`, and the product of two denominators
/// still fits.
const LIMIT: f32 = 60.0;

/// `2^f = 1 + f (c1 + f (c2 + ...))` for `|f| <= 0.5`: the minimax polynomial of this degree, with a
/// largest relative error of 1.1e-7. `2^0` is exactly 1, so that tanh has no offset.
#[expect(clippy::approx_constant, reason = "near ln 2, but a coefficient that balances the error")]
const EXP2: [f32; 6] = [1.0, 0.693_147, 0.240_222_42, 0.055_507_336, 0.009_671_513, 0.001_326_472_8];

/// `2^a`, `a` at most 60.
#[inline(always)]
pub(super) fn exp2<S: Simd>(s: S, a: S::V) -> S::V {
    let a = s.limit(a, LIMIT);
    let n = s.round(a);
    let f = s.sub(a, n);
    let mut p = s.splat(EXP2[5]);
    p = s.mul_add(p, f, s.splat(EXP2[4]));
    p = s.mul_add(p, f, s.splat(EXP2[3]));
    p = s.mul_add(p, f, s.splat(EXP2[2]));
    p = s.mul_add(p, f, s.splat(EXP2[1]));
    p = s.mul_add(p, f, s.splat(EXP2[0]));
    s.scale(p, n)
}

/// Sigmoid of an argument already scaled with [`SIGMOID_SCALE`].
#[inline(always)]
pub(super) fn sigmoid<S: Simd>(s: S, scaled: S::V) -> S::V {
    s.recip(s.add(s.splat(1.0), exp2(s, scaled)))
}

/// Tanh of an argument already scaled with [`TANH_SCALE`].
#[inline(always)]
pub(super) fn tanh<S: Simd>(s: S, scaled: S::V) -> S::V {
    let e = exp2(s, scaled);
    let one = s.splat(1.0);
    s.mul(s.sub(one, e), s.recip(s.add(one, e)))
}

/// `sigmoid * tanh` of two scaled arguments with one reciprocal.
#[inline(always)]
pub(super) fn sigmoid_times_tanh<S: Simd>(s: S, sigmoid_arg: S::V, tanh_arg: S::V) -> S::V {
    let (a, b) = (exp2(s, sigmoid_arg), exp2(s, tanh_arg));
    let one = s.splat(1.0);
    s.mul(s.sub(one, b), s.recip(s.mul(s.add(one, a), s.add(one, b))))
}

/// New state of a memory cell from the scaled pre-activations of its gates store, forget and in
/// (Heindel et al., section 2.2.1).
#[inline(always)]
pub(super) fn state<S: Simd>(s: S, [i, f, g]: [S::V; 3], c: S::V) -> S::V {
    s.mul_add(c, sigmoid(s, f), sigmoid_times_tanh(s, i, g))
}

/// Output of a memory cell from the scaled pre-activation of its gate out and its new state.
#[inline(always)]
pub(super) fn output<S: Simd>(s: S, o: S::V, c: S::V) -> S::V {
    sigmoid_times_tanh(s, o, s.mul(c, s.splat(TANH_SCALE)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simd::Isa;
    use crate::simd::{Kernel, LANES, Lanes, dispatch};

    /// Sigmoid, tanh and `sigmoid(a) * tanh(b)` at sixteen places.
    struct At(Lanes, Lanes);

    impl Kernel for At {
        type Out = [Lanes; 3];
        const WIDE: bool = false;
        #[inline(always)]
        fn run<S: Simd>(self, s: S) -> [Lanes; 3] {
            let (a, b) = (s.load(&self.0), s.load(&self.1));
            let (sa, ta) = (s.mul(a, s.splat(SIGMOID_SCALE)), s.mul(a, s.splat(TANH_SCALE)));
            let tb = s.mul(b, s.splat(TANH_SCALE));
            let mut out = [Lanes::ZERO; 3];
            s.store(&mut out[0], sigmoid(s, sa));
            s.store(&mut out[1], tanh(s, ta));
            s.store(&mut out[2], sigmoid_times_tanh(s, sa, tb));
            out
        }
    }

    #[test]
    fn activations_are_right_to_a_few_units_in_the_seventh_digit_everywhere() {
        let sigmoid = |x: f32| 1.0 / (1.0 + (-f64::from(x)).exp());
        for isa in Isa::ALL {
            if !isa.is_available() {
                println!("skipped {}: not on this machine", isa.name());
                continue;
            }
            let mut worst = [0.0_f64; 3];
            for step in 0..4000 {
                let (mut a, mut b) = (Lanes::ZERO, Lanes::ZERO);
                for l in 0..LANES {
                    a.0[l] = -20.0 + 0.01 * step as f32 + 0.000_613 * l as f32;
                    b.0[l] = 5.0 - 0.0025 * step as f32 + 0.000_213 * l as f32;
                }
                let out = dispatch(isa, At(a, b));
                for l in 0..LANES {
                    let (x, y) = (a.0[l], b.0[l]);
                    let truth = [sigmoid(x), f64::from(x).tanh(), sigmoid(x) * f64::from(y).tanh()];
                    for k in 0..3 {
                        worst[k] = worst[k].max((f64::from(out[k].0[l]) - truth[k]).abs());
                    }
                }
            }
            assert!(worst.iter().all(|&w| w < 2e-7), "{}: {worst:?}", isa.name());
        }
    }

    #[test]
    fn far_arguments_reach_the_limits_without_overflow() {
        for isa in Isa::ALL.into_iter().filter(|i| i.is_available()) {
            for x in [1e3_f32, 1e30, f32::MAX] {
                let out = dispatch(isa, At(Lanes([x; LANES]), Lanes([-x; LANES])));
                assert_eq!(out.map(|o| o.0[0]), [1.0, 1.0, -1.0], "{}", isa.name());
                let out = dispatch(isa, At(Lanes([-x; LANES]), Lanes([x; LANES])));
                assert!(out[0].0[0].abs() < 1e-17 && out[1].0[0] == -1.0 && out[2].0[0].abs() < 1e-17);
            }
        }
    }
}
