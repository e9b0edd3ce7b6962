//! Sixteen `f32` lanes on each instruction set, and the door through which kernels enter one.
//!
//! This is the only file of the network with `unsafe` in it. It is sound because a [`Simd`] token
//! of an instruction set can be made in [`dispatch`] only, after the machine was asked for it, and
//! because [`Columns`] checks its bounds before the first step.
//!
//! Everything that runs on a token is `#[inline(always)]` and free of closures, so that it ends up
//! inside the one function that carries the `target_feature` attribute.

use std::marker::PhantomData;

use super::isa::Isa;

/// Lanes of a vector; in the grouped kernels one lane is one window.
pub(super) const LANES: usize = 16;

/// Sixteen values, aligned to a cache line.
#[derive(Debug, Clone, Copy, PartialEq)]
#[repr(C, align(64))]
pub(super) struct Lanes(pub [f32; LANES]);

impl Lanes {
    /// All zero.
    pub(super) const ZERO: Self = Self([0.0; LANES]);
    /// All one.
    pub(super) const ONE: Self = Self([1.0; LANES]);
}

/// `N` columns of each of some steps, `[step][stride]`. Bounds are checked once, before the first
/// step: a check at every step would cost a tenth of the training time.
pub(super) struct Columns<'a, const N: usize> {
    next: *const Lanes,
    stride: usize,
    left: usize,
    data: PhantomData<&'a [Lanes]>,
}

impl<'a, const N: usize> Columns<'a, N> {
    /// Columns `first..first + N` of steps `steps` of `data`.
    ///
    /// # Panics
    /// If they are not all in `data`.
    #[inline(always)]
    pub(super) fn new(data: &'a [Lanes], stride: usize, first: usize, steps: (usize, usize)) -> Self {
        let left = steps.1.saturating_sub(steps.0);
        assert!(
            first + N <= stride && (left == 0 || steps.1 * stride <= data.len()),
            "columns within the data"
        );
        Self { next: data.as_ptr().wrapping_add(steps.0 * stride + first), stride, left, data: PhantomData }
    }
}

impl<'a, const N: usize> Iterator for Columns<'a, N> {
    type Item = &'a [Lanes; N];

    #[inline(always)]
    fn next(&mut self) -> Option<Self::Item> {
        if self.left == 0 {
            return None;
        }
        self.left -= 1;
        // SAFETY: `new` has checked that every step that is left lies within `data`, which is
        // borrowed for 'a.
        let columns = unsafe { &*self.next.cast::<[Lanes; N]>() };
        self.next = self.next.wrapping_add(self.stride);
        Some(columns)
    }
}

/// Arithmetic on sixteen lanes.
pub(super) trait Simd: Copy {
    /// Sixteen lanes in registers.
    type V: Copy;

    /// The same value in all lanes.
    fn splat(self, a: f32) -> Self::V;
    /// From memory.
    fn load(self, from: &Lanes) -> Self::V;
    /// To memory.
    fn store(self, to: &mut Lanes, a: Self::V);
    /// Asks for the memory `ahead` elements behind `from`, which will be read soon; any address will
    /// do.
    #[inline(always)]
    fn prefetch<T>(self, _from: &T, _ahead: usize) {}
    /// `a + b`.
    fn add(self, a: Self::V, b: Self::V) -> Self::V;
    /// `a - b`.
    fn sub(self, a: Self::V, b: Self::V) -> Self::V;
    /// `a * b`.
    fn mul(self, a: Self::V, b: Self::V) -> Self::V;
    /// `a * b + c`, rounded once where the machine can do that fast.
    fn mul_add(self, a: Self::V, b: Self::V, c: Self::V) -> Self::V;
    /// `c - a * b`, rounded once where the machine can do that fast.
    fn neg_mul_add(self, a: Self::V, b: Self::V, c: Self::V) -> Self::V;
    /// At most `limit`, and at least `-limit` where [`Simd::scale`] needs that; NaN stays NaN.
    fn limit(self, a: Self::V, limit: f32) -> Self::V;
    /// To the nearest integer; `|a| < 2^22`.
    fn round(self, a: Self::V) -> Self::V;
    /// `a * 2^n` for integers `n` that [`Simd::limit`] with a limit up to 126 lets through.
    fn scale(self, a: Self::V, n: Self::V) -> Self::V;
    /// `1 / a` within two units in the last place, for normal `1 <= a < 2^126`.
    fn recip(self, a: Self::V) -> Self::V;
    /// Sum over the lanes, always in the same tree: 8, 4, 2, 1 lanes apart.
    fn sum(self, a: Self::V) -> f32;
}

/// Work that runs on some instruction set. `run` must be `#[inline(always)]`.
pub(super) trait Kernel {
    /// What comes out.
    type Out;
    /// Blocked for 32 registers, so made for AVX-512 only; the others need no code for it.
    const WIDE: bool;
    /// Does the work.
    fn run<S: Simd>(self, simd: S) -> Self::Out;
}

/// Runs `kernel` on `isa`.
///
/// # Panics
/// If the machine lacks `isa`: [`Isa::choose`] never answers such a one, so that would be our bug.
pub(super) fn dispatch<K: Kernel>(isa: Isa, kernel: K) -> K::Out {
    assert!(isa.is_available(), "this machine lacks {}", isa.name());
    if K::WIDE {
        assert!(isa == Isa::Avx512, "a kernel for AVX-512 on {}", isa.name());
        #[cfg(target_arch = "x86_64")]
        // SAFETY: the features were asserted above.
        return unsafe { x86::on_avx512(kernel) };
    }
    match isa {
        Isa::Portable => kernel.run(Portable),
        #[cfg(target_arch = "x86_64")]
        // SAFETY: the features were asserted above.
        Isa::Avx2 => unsafe { x86::on_avx2(kernel) },
        #[cfg(target_arch = "x86_64")]
        // SAFETY: as above.
        Isa::Avx512 => unsafe { x86::on_avx512(kernel) },
        #[cfg(not(target_arch = "x86_64"))]
        Isa::Avx2 | Isa::Avx512 => unreachable!("asserted above"),
    }
}

/// Plain arrays; the compiler uses what the target has.
#[derive(Clone, Copy)]
struct Portable;

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

#[cfg(target_arch = "x86_64")]
mod x86 {
    use std::arch::x86_64::*;

    use super::{Kernel, Lanes, Simd};

    /// # Safety
    /// The machine must have AVX2 and FMA.
    #[target_feature(enable = "avx2,fma")]
    pub(super) unsafe fn on_avx2<K: Kernel>(kernel: K) -> K::Out {
        kernel.run(Avx2(()))
    }

    /// # Safety
    /// The machine must have AVX-512 F, AVX2 and FMA.
    #[target_feature(enable = "avx512f,avx2,fma")]
    pub(super) unsafe fn on_avx512<K: Kernel>(kernel: K) -> K::Out {
        kernel.run(Avx512(()))
    }

    /// Proof that the machine has AVX2 and FMA; the private field keeps others from making one.
    #[derive(Clone, Copy)]
    struct Avx2(());

    /// Proof that the machine has AVX-512 F; the private field keeps others from making one.
    #[derive(Clone, Copy)]
    struct Avx512(());

    /// Calls an intrinsic: sound because the token proves that the machine has it.
    macro_rules! op {
        ($e:expr) => {
            // SAFETY: the token in `self` proves the features; pointers come from references.
            unsafe { $e }
        };
    }

    /// Nearest, without exceptions.
    const NEAREST: i32 = _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC;

    /// Sum of eight lanes, 4, 2, 1 apart.
    #[inline(always)]
    fn sum_of_8(_proof: Avx2, a: __m256) -> f32 {
        op!({
            let four = _mm_add_ps(_mm256_castps256_ps128(a), _mm256_extractf128_ps::<1>(a));
            let two = _mm_add_ps(four, _mm_movehl_ps(four, four));
            _mm_cvtss_f32(_mm_add_ss(two, _mm_movehdup_ps(two)))
        })
    }

    impl Simd for Avx2 {
        type V = (__m256, __m256);

        #[inline(always)]
        fn splat(self, a: f32) -> Self::V {
            let v = op!(_mm256_set1_ps(a));
            (v, v)
        }
        #[inline(always)]
        fn load(self, from: &Lanes) -> Self::V {
            let p = from.0.as_ptr();
            op!((_mm256_load_ps(p), _mm256_load_ps(p.add(8))))
        }
        #[inline(always)]
        fn store(self, to: &mut Lanes, a: Self::V) {
            let p = to.0.as_mut_ptr();
            op!({
                _mm256_store_ps(p, a.0);
                _mm256_store_ps(p.add(8), a.1);
            });
        }
        #[inline(always)]
        fn prefetch<T>(self, from: &T, ahead: usize) {
            op!(_mm_prefetch::<_MM_HINT_T0>(std::ptr::from_ref(from).wrapping_add(ahead).cast()));
        }
        #[inline(always)]
        fn add(self, a: Self::V, b: Self::V) -> Self::V {
            op!((_mm256_add_ps(a.0, b.0), _mm256_add_ps(a.1, b.1)))
        }
        #[inline(always)]
        fn sub(self, a: Self::V, b: Self::V) -> Self::V {
            op!((_mm256_sub_ps(a.0, b.0), _mm256_sub_ps(a.1, b.1)))
        }
        #[inline(always)]
        fn mul(self, a: Self::V, b: Self::V) -> Self::V {
            op!((_mm256_mul_ps(a.0, b.0), _mm256_mul_ps(a.1, b.1)))
        }
        #[inline(always)]
        fn mul_add(self, a: Self::V, b: Self::V, c: Self::V) -> Self::V {
            op!((_mm256_fmadd_ps(a.0, b.0, c.0), _mm256_fmadd_ps(a.1, b.1, c.1)))
        }
        #[inline(always)]
        fn neg_mul_add(self, a: Self::V, b: Self::V, c: Self::V) -> Self::V {
            op!((_mm256_fnmadd_ps(a.0, b.0, c.0), _mm256_fnmadd_ps(a.1, b.1, c.1)))
        }
        #[inline(always)]
        fn limit(self, a: Self::V, limit: f32) -> Self::V {
            // min and max answer their second operand when one is NaN.
            op!({
                let (lo, hi) = (_mm256_set1_ps(-limit), _mm256_set1_ps(limit));
                (_mm256_max_ps(lo, _mm256_min_ps(hi, a.0)), _mm256_max_ps(lo, _mm256_min_ps(hi, a.1)))
            })
        }
        #[inline(always)]
        fn round(self, a: Self::V) -> Self::V {
            op!((_mm256_round_ps::<NEAREST>(a.0), _mm256_round_ps::<NEAREST>(a.1)))
        }
        #[inline(always)]
        fn scale(self, a: Self::V, n: Self::V) -> Self::V {
            op!({
                let one = _mm256_set1_epi32(127);
                let p0 = _mm256_slli_epi32::<23>(_mm256_add_epi32(_mm256_cvtps_epi32(n.0), one));
                let p1 = _mm256_slli_epi32::<23>(_mm256_add_epi32(_mm256_cvtps_epi32(n.1), one));
                (_mm256_mul_ps(a.0, _mm256_castsi256_ps(p0)), _mm256_mul_ps(a.1, _mm256_castsi256_ps(p1)))
            })
        }
        #[inline(always)]
        fn recip(self, a: Self::V) -> Self::V {
            // A true division: the estimate of this instruction set differs between makers.
            op!({
                let one = _mm256_set1_ps(1.0);
                (_mm256_div_ps(one, a.0), _mm256_div_ps(one, a.1))
            })
        }
        #[inline(always)]
        fn sum(self, a: Self::V) -> f32 {
            sum_of_8(self, op!(_mm256_add_ps(a.0, a.1)))
        }
    }

    impl Simd for Avx512 {
        type V = __m512;

        #[inline(always)]
        fn splat(self, a: f32) -> Self::V {
            op!(_mm512_set1_ps(a))
        }
        #[inline(always)]
        fn load(self, from: &Lanes) -> Self::V {
            op!(_mm512_load_ps(from.0.as_ptr()))
        }
        #[inline(always)]
        fn store(self, to: &mut Lanes, a: Self::V) {
            op!(_mm512_store_ps(to.0.as_mut_ptr(), a));
        }
        #[inline(always)]
        fn prefetch<T>(self, from: &T, ahead: usize) {
            op!(_mm_prefetch::<_MM_HINT_T0>(std::ptr::from_ref(from).wrapping_add(ahead).cast()));
        }
        #[inline(always)]
        fn add(self, a: Self::V, b: Self::V) -> Self::V {
            op!(_mm512_add_ps(a, b))
        }
        #[inline(always)]
        fn sub(self, a: Self::V, b: Self::V) -> Self::V {
            op!(_mm512_sub_ps(a, b))
        }
        #[inline(always)]
        fn mul(self, a: Self::V, b: Self::V) -> Self::V {
            op!(_mm512_mul_ps(a, b))
        }
        #[inline(always)]
        fn mul_add(self, a: Self::V, b: Self::V, c: Self::V) -> Self::V {
            op!(_mm512_fmadd_ps(a, b, c))
        }
        #[inline(always)]
        fn neg_mul_add(self, a: Self::V, b: Self::V, c: Self::V) -> Self::V {
            op!(_mm512_fnmadd_ps(a, b, c))
        }
        #[inline(always)]
        fn limit(self, a: Self::V, limit: f32) -> Self::V {
            // min answers its second operand when one is NaN; scaling by any 2^-n is fine here.
            op!(_mm512_min_ps(_mm512_set1_ps(limit), a))
        }
        #[inline(always)]
        fn round(self, a: Self::V) -> Self::V {
            op!(_mm512_roundscale_ps::<NEAREST>(a))
        }
        #[inline(always)]
        fn scale(self, a: Self::V, n: Self::V) -> Self::V {
            op!(_mm512_scalef_ps(a, n))
        }
        #[inline(always)]
        fn recip(self, a: Self::V) -> Self::V {
            // The 14-bit estimate is defined bit for bit; one Newton step takes it to f32.
            op!({
                let r = _mm512_rcp14_ps(a);
                let error = _mm512_fnmadd_ps(a, r, _mm512_set1_ps(1.0));
                _mm512_fmadd_ps(r, error, r)
            })
        }
        #[inline(always)]
        fn sum(self, a: Self::V) -> f32 {
            let eight = op!(_mm256_add_ps(
                _mm512_castps512_ps256(a),
                _mm256_castpd_ps(_mm512_extractf64x4_pd::<1>(_mm512_castps_pd(a))),
            ));
            sum_of_8(Avx2(()), eight)
        }
    }
}

#[cfg(test)]
mod tests;
