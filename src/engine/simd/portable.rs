//! Plain arrays, for every machine.

use super::{LANES, Lanes, Simd};

/// Plain arrays; the compiler uses what the target has.
#[derive(Clone, Copy)]
pub(super) struct Portable;

/// One lane after another.
macro_rules! lanewise {
    ($i:ident => $value:expr) => {{
        let mut to = [0.0_f32; LANES];
        for $i in 0..LANES {
            to[$i] = $value;
        }
        to
    }};
}

impl Simd for Portable {
    type V = [f32; LANES];

    #[inline(always)]
    fn splat(self, a: f32) -> Self::V {
        [a; LANES]
    }
    #[inline(always)]
    fn load(self, from: &Lanes) -> Self::V {
        from.0
    }
    #[inline(always)]
    fn store(self, to: &mut Lanes, a: Self::V) {
        to.0 = a;
    }
    #[inline(always)]
    fn add(self, a: Self::V, b: Self::V) -> Self::V {
        lanewise!(i => a[i] + b[i])
    }
    #[inline(always)]
    fn sub(self, a: Self::V, b: Self::V) -> Self::V {
        lanewise!(i => a[i] - b[i])
    }
    #[inline(always)]
    fn mul(self, a: Self::V, b: Self::V) -> Self::V {
        lanewise!(i => a[i] * b[i])
    }
    #[inline(always)]
    fn mul_add(self, a: Self::V, b: Self::V, c: Self::V) -> Self::V {
        // f32::mul_add would be a library call on machines without FMA.
        lanewise!(i => a[i] * b[i] + c[i])
    }
    #[inline(always)]
    fn neg_mul_add(self, a: Self::V, b: Self::V, c: Self::V) -> Self::V {
        lanewise!(i => c[i] - a[i] * b[i])
    }
    #[inline(always)]
    fn limit(self, a: Self::V, limit: f32) -> Self::V {
        lanewise!(i => if a[i] > limit { limit } else if a[i] < -limit { -limit } else { a[i] })
    }
    #[inline(always)]
    fn round(self, a: Self::V) -> Self::V {
        // Adding 1.5 * 2^23 leaves no bits for the fraction.
        lanewise!(i => (a[i] + 12_582_912.0) - 12_582_912.0)
    }
    #[inline(always)]
    fn scale(self, a: Self::V, n: Self::V) -> Self::V {
        // In 1.5 * 2^23 + n the low bits are n; shifted into the exponent they give 2^n.
        lanewise!(i => a[i] * f32::from_bits(
            ((n[i] + 12_582_912.0).to_bits() << 23).wrapping_add(127 << 23)
        ))
    }
    #[inline(always)]
    fn recip(self, a: Self::V) -> Self::V {
        lanewise!(i => 1.0 / a[i])
    }
    #[inline(always)]
    fn sum(self, a: Self::V) -> f32 {
        let mut a = a;
        for apart in [8, 4, 2, 1] {
            for i in 0..apart {
                a[i] += a[i + apart];
            }
        }
        a[0]
    }
}
