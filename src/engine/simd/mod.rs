//! Sixteen `f32` lanes on each instruction set, and the dispatch of kernels to one of them.
//!
//! `unsafe` is used here and in `x86` only. It is sound because a `Simd` token of an instruction set is
//! made in `dispatch` only, after a check that the machine has the set, and because `Columns` checks its
//! bounds before the first step.
//!
//! Plain loops can be kernels too, without using the token: the compiler then vectorises them for that
//! instruction set. Rust never fuses a product and a sum by itself, so that their results are
//! bit-identical on every set.
//!
//! Everything that runs on a token is `#[inline(always)]` and free of closures, so that it ends up
//! inside the one function that carries the `target_feature` attribute.

use std::marker::PhantomData;

mod isa;
mod peak;
mod portable;
#[cfg(test)]
mod tests;
#[cfg(target_arch = "x86_64")]
mod x86;

pub use isa::{ISA_VARIABLE, Isa};
pub use peak::peak_fma;

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
    /// Loads sixteen values.
    fn load(self, from: &Lanes) -> Self::V;
    /// Stores sixteen values.
    fn store(self, to: &mut Lanes, a: Self::V);
    /// Prefetches the memory `ahead` elements after `from`. Any address is allowed.
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

    /// Bit `i` says `a[i] < b[i]`.
    #[inline(always)]
    fn less(self, a: &[f64; 8], b: &[f64; 8]) -> u8 {
        let mut mask = 0;
        for i in 0..8 {
            mask |= u8::from(a[i] < b[i]) << i;
        }
        mask
    }
    /// Moves the values whose bit is set to the front of `to`, in order. The rest of `to` is unspecified.
    #[inline(always)]
    fn compress(self, values: [f64; 8], mask: u8, to: &mut [f64; 8]) {
        let mut n = 0;
        for (i, value) in values.into_iter().enumerate() {
            // Written in either case: a branch on data costs more.
            to[n] = value;
            n += usize::from(mask >> i & 1);
        }
    }
}

/// Work that runs on some instruction set. `run` must be `#[inline(always)]`.
pub(super) trait Kernel {
    /// Result of the work.
    type Out;
    /// Whether the kernel is blocked for 32 registers, so that it is compiled for AVX-512 only.
    const WIDE: bool;
    /// Does the work.
    fn run<S: Simd>(self, simd: S) -> Self::Out;
}

/// Runs `kernel` on `isa`.
///
/// # Panics
/// If the machine lacks `isa`. [`Isa::choose`] never returns such a set, so that this is a defect of the
/// caller.
pub(super) fn dispatch<K: Kernel>(isa: Isa, kernel: K) -> K::Out {
    assert!(isa.is_available(), "this machine lacks {}", isa.name());
    if K::WIDE {
        assert!(isa == Isa::Avx512, "a kernel for AVX-512 on {}", isa.name());
        #[cfg(target_arch = "x86_64")]
        // SAFETY: the features were asserted above.
        return unsafe { x86::on_avx512(kernel) };
    }
    match isa {
        Isa::Portable => kernel.run(portable::Portable),
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
