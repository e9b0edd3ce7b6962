//! Four lanes at a time as the target has them (SSE2, NEON, or plain values), for every machine.

use wide::{f32x4, i32x4};

use super::{LANES, Lanes, Simd};

/// The vector type that every machine of the compiler's target has.
#[derive(Clone, Copy)]
pub(super) struct Portable;

/// Adding 1.5 * 2^23 rounds to an integer: no bits are left for the fraction.
const TO_INTEGER: f32 = 12_582_912.0;

/// One quarter of the lanes after another.
macro_rules! quarters {
    ($i:ident => $value:expr) => {{
        let mut to = [f32x4::splat(0.0); LANES / 4];
        for $i in 0..LANES / 4 {
            to[$i] = $value;
        }
        to
    }};
}

impl Simd for Portable {
    type V = [f32x4; LANES / 4];

    #[inline(always)]
    fn splat(self, a: f32) -> Self::V {
        [f32x4::splat(a); LANES / 4]
    }
    #[inline(always)]
    fn load(self, from: &Lanes) -> Self::V {
        let from = from.0.as_chunks::<4>().0;
        quarters!(i => f32x4::new(from[i]))
    }
    #[inline(always)]
    fn store(self, to: &mut Lanes, a: Self::V) {
        for (to, a) in to.0.as_chunks_mut::<4>().0.iter_mut().zip(a) {
            *to = a.to_array();
        }
    }
    #[inline(always)]
    fn add(self, a: Self::V, b: Self::V) -> Self::V {
        quarters!(i => a[i] + b[i])
    }
    #[inline(always)]
    fn sub(self, a: Self::V, b: Self::V) -> Self::V {
        quarters!(i => a[i] - b[i])
    }
    #[inline(always)]
    fn mul(self, a: Self::V, b: Self::V) -> Self::V {
        quarters!(i => a[i] * b[i])
    }
    #[inline(always)]
    fn mul_add(self, a: Self::V, b: Self::V, c: Self::V) -> Self::V {
        quarters!(i => a[i].mul_add(b[i], c[i]))
    }
    #[inline(always)]
    fn neg_mul_add(self, a: Self::V, b: Self::V, c: Self::V) -> Self::V {
        quarters!(i => a[i].mul_neg_add(b[i], c[i]))
    }
    #[inline(always)]
    fn limit(self, a: Self::V, limit: f32) -> Self::V {
        // No comparison holds for NaN, which therefore stays.
        let (lo, hi) = (f32x4::splat(-limit), f32x4::splat(limit));
        quarters!(i => a[i].simd_gt(hi).bitselect(hi, a[i].simd_lt(lo).bitselect(lo, a[i])))
    }
    #[inline(always)]
    fn round(self, a: Self::V) -> Self::V {
        let to_integer = f32x4::splat(TO_INTEGER);
        quarters!(i => (a[i] + to_integer) - to_integer)
    }
    #[inline(always)]
    fn scale(self, a: Self::V, n: Self::V) -> Self::V {
        // In 1.5 * 2^23 + n the low bits are n; shifted into the exponent they give 2^n.
        let (to_integer, one) = (f32x4::splat(TO_INTEGER), i32x4::splat(127 << 23));
        quarters!(i => {
            let bits: i32x4 = bytemuck::cast(n[i] + to_integer);
            let power: f32x4 = bytemuck::cast((bits << 23_i32) + one);
            a[i] * power
        })
    }
    #[inline(always)]
    fn recip(self, a: Self::V) -> Self::V {
        let one = f32x4::splat(1.0);
        quarters!(i => one / a[i])
    }
    #[inline(always)]
    fn sum(self, a: Self::V) -> f32 {
        let four = ((a[0] + a[2]) + (a[1] + a[3])).to_array();
        (four[0] + four[2]) + (four[1] + four[3])
    }
}
