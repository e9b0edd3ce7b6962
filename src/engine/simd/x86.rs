//! AVX2 and AVX-512.

use std::arch::x86_64::*;

use super::{Kernel, Lanes, Simd};

/// Whether this machine has all features that [`on_avx2`] uses.
pub(super) fn has_avx2() -> bool {
    use std::arch::is_x86_feature_detected as has;
    has!("avx2") && has!("fma") && has!("bmi1") && has!("bmi2")
}

/// Whether this machine has all features that [`on_avx512`] uses.
pub(super) fn has_avx512() -> bool {
    use std::arch::is_x86_feature_detected as has;
    has_avx2() && has!("avx512f") && has!("avx512vl") && has!("avx512dq") && has!("avx512bw")
}

/// # Safety
/// The machine must have the features that [`has_avx2`] checks.
#[target_feature(enable = "avx2,fma,bmi1,bmi2")]
pub(super) unsafe fn on_avx2<K: Kernel>(kernel: K) -> K::Out {
    kernel.run(Avx2(()))
}

/// # Safety
/// The machine must have the features that [`has_avx512`] checks.
#[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw,avx2,fma,bmi1,bmi2")]
pub(super) unsafe fn on_avx512<K: Kernel>(kernel: K) -> K::Out {
    kernel.run(Avx512(()))
}

/// Proof that the machine has AVX2; the private field keeps others from making one.
#[derive(Clone, Copy)]
struct Avx2(());

/// Proof that the machine has AVX-512; the private field keeps others from making one.
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

/// Halves of four doubles in the order that brings those whose bit of the index is set to the front.
#[repr(align(32))]
struct Order([i32; 8]);

static ORDER: [Order; 16] = {
    let mut table = [const { Order([0; 8]) }; 16];
    let mut mask = 0;
    while mask < 16 {
        let (mut from, mut to) = (0, 0);
        while from < 4 {
            if mask >> from & 1 == 1 {
                table[mask].0[2 * to] = 2 * from;
                table[mask].0[2 * to + 1] = 2 * from + 1;
                to += 1;
            }
            from += 1;
        }
        mask += 1;
    }
    table
};

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
        // min and max return their second operand when one is NaN.
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
        // A true division: the estimate of this instruction set differs between processor makers.
        op!({
            let one = _mm256_set1_ps(1.0);
            (_mm256_div_ps(one, a.0), _mm256_div_ps(one, a.1))
        })
    }
    #[inline(always)]
    fn sum(self, a: Self::V) -> f32 {
        sum_of_8(self, op!(_mm256_add_ps(a.0, a.1)))
    }

    #[inline(always)]
    fn less(self, a: &[f64; 8], b: &[f64; 8]) -> u8 {
        let (a, b) = (a.as_ptr(), b.as_ptr());
        let mask = op!({
            let low = _mm256_cmp_pd::<_CMP_LT_OQ>(_mm256_loadu_pd(a), _mm256_loadu_pd(b));
            let high = _mm256_cmp_pd::<_CMP_LT_OQ>(_mm256_loadu_pd(a.add(4)), _mm256_loadu_pd(b.add(4)));
            _mm256_movemask_pd(low) | _mm256_movemask_pd(high) << 4
        });
        mask as u8
    }
    #[inline(always)]
    fn compress(self, values: [f64; 8], mask: u8, to: &mut [f64; 8]) {
        let (low, high) = (mask & 15, mask >> 4);
        let from = values.as_ptr();
        // The high half is stored after at most four values of the low half.
        let behind = to[low.count_ones() as usize..].as_mut_ptr();
        op!({
            let order = |mask: u8| _mm256_load_si256(std::ptr::from_ref(&ORDER[usize::from(mask)]).cast());
            let pick = |at, mask| {
                let values = _mm256_castpd_ps(_mm256_loadu_pd(from.add(at)));
                _mm256_castps_pd(_mm256_permutevar8x32_ps(values, order(mask)))
            };
            let (low, high) = (pick(0, low), pick(4, high));
            _mm256_storeu_pd(to.as_mut_ptr(), low);
            _mm256_storeu_pd(behind, high);
        });
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
        // min returns its second operand when one is NaN; scaling by any 2^-n is fine here.
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

    #[inline(always)]
    fn less(self, a: &[f64; 8], b: &[f64; 8]) -> u8 {
        op!(_mm512_cmp_pd_mask::<_CMP_LT_OQ>(_mm512_loadu_pd(a.as_ptr()), _mm512_loadu_pd(b.as_ptr())))
    }
    #[inline(always)]
    fn compress(self, values: [f64; 8], mask: u8, to: &mut [f64; 8]) {
        // Not the instruction that compresses into memory, which is slow microcode on some processors.
        op!({
            let picked = _mm512_maskz_compress_pd(mask, _mm512_loadu_pd(values.as_ptr()));
            _mm512_storeu_pd(to.as_mut_ptr(), picked);
        });
    }
}
