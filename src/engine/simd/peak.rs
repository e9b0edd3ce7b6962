//! What the machine's vector units reach at this moment: the yardstick of the kernels' speed.

use std::hint::black_box;
use std::time::Instant;

use rayon::prelude::*;

use super::{Isa, Kernel, LANES, Simd, dispatch};
use crate::EngineError;

/// Multiply-adds per accumulator and measurement; a few milliseconds a thread.
const ROUNDS: usize = 1 << 20;

/// `N` sums that do not wait for each other: more than the latency of two units asks for.
struct Peak<const N: usize> {
    factor: f32,
}

impl<const N: usize> Kernel for Peak<N> {
    type Out = f32;
    const WIDE: bool = N > 8;

    #[inline(always)]
    fn run<S: Simd>(self, s: S) -> f32 {
        let (a, b) = (s.splat(self.factor), s.splat(1.0 - self.factor));
        let mut sums = [s.splat(0.5); N];
        for _ in 0..ROUNDS {
            for sum in &mut sums {
                *sum = s.mul_add(*sum, a, b);
            }
        }
        let mut total = sums[0];
        for sum in &sums[1..] {
            total = s.add(total, *sum);
        }
        s.sum(total)
    }
}

/// Multiply-adds from registers that all threads of rayon's current pool together reach with the
/// instruction set of the process, in FLOP/s (a multiply-add counts two); measured once.
///
/// # Errors
/// As [`Isa::of_process`].
pub fn peak_fma() -> Result<f64, EngineError> {
    let isa = Isa::of_process()?;
    let sums = if isa == Isa::Avx512 { 20 } else { 5 };
    let threads = rayon::current_num_threads();
    let begin = Instant::now();
    (0..threads).into_par_iter().with_max_len(1).for_each(|_| {
        let factor = black_box(0.999);
        black_box(match isa {
            Isa::Avx512 => dispatch(isa, Peak::<20> { factor }),
            _ => dispatch(isa, Peak::<5> { factor }),
        });
    });
    Ok((threads * ROUNDS * sums * LANES * 2) as f64 / begin.elapsed().as_secs_f64())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_yardstick_computes_what_it_is_timed_for() {
        // s -> 0.5 s + 0.5 tends to one in each lane of each sum.
        assert_eq!(dispatch(Isa::Portable, Peak::<5> { factor: 0.5 }), (5 * LANES) as f32);
        let peak = peak_fma().unwrap();
        assert!(peak.is_finite() && peak > 0.0);
    }
}
