//! Every instruction set against the portable one.

use super::*;

/// Applies every operation to fixed lanes.
struct Everything;

impl Kernel for Everything {
    type Out = Vec<Lanes>;
    const WIDE: bool = false;
    #[inline(always)]
    fn run<S: Simd>(self, s: S) -> Vec<Lanes> {
        let mut lanes = [Lanes::ZERO; 3];
        for i in 0..LANES {
            lanes[0].0[i] = 1.0 + 0.37 * i as f32;
            lanes[1].0[i] = -3.0 + 0.61 * i as f32;
            lanes[2].0[i] = i as f32 * 4.0 - 30.0;
        }
        let (a, b, n) = (s.load(&lanes[0]), s.load(&lanes[1]), s.load(&lanes[2]));
        let results = [
            s.splat(2.5),
            s.add(a, b),
            s.sub(a, b),
            s.mul(a, b),
            s.mul_add(a, b, n),
            s.neg_mul_add(a, b, n),
            s.limit(b, 4.0),
            s.round(b),
            s.scale(a, n),
            s.recip(a),
            s.splat(s.sum(a)),
        ];
        let mut out = vec![Lanes::ZERO; results.len()];
        for (to, v) in out.iter_mut().zip(results) {
            s.store(to, v);
        }
        out
    }
}

#[test]
fn every_instruction_set_computes_what_the_portable_one_does() {
    let expected = dispatch(Isa::Portable, Everything);
    let sum: f32 = (0..LANES).map(|i| 1.0 + 0.37 * i as f32).sum();
    assert!((expected[10].0[3] - sum).abs() < 1e-4);
    for isa in [Isa::Avx2, Isa::Avx512] {
        if !isa.is_available() {
            println!("skipped {}: not on this machine", isa.name());
            continue;
        }
        let found = dispatch(isa, Everything);
        assert_eq!(found.len(), expected.len());
        for (op, (f, e)) in found.iter().zip(&expected).enumerate() {
            for (f, e) in f.0.iter().zip(&e.0) {
                assert!((f - e).abs() <= 3e-7 * e.abs().max(1.0), "{} op {op}: {f} {e}", isa.name());
            }
        }
    }
}

#[test]
fn columns_are_those_of_each_step_and_never_leave_the_data() {
    let data: Vec<Lanes> = (0..12).map(|i| Lanes([i as f32; LANES])).collect();
    let found: Vec<[f32; 2]> =
        Columns::<2>::new(&data, 4, 1, (1, 3)).map(|c| [c[0].0[0], c[1].0[0]]).collect();
    assert_eq!(found, [[5.0, 6.0], [9.0, 10.0]]);
    assert_eq!(Columns::<2>::new(&data, 4, 0, (3, 3)).count(), 0);
    for (first, steps) in [(3, (0, 3)), (0, (0, 4))] {
        assert!(std::panic::catch_unwind(|| Columns::<2>::new(&data, 4, first, steps)).is_err());
    }
}

/// Limits NaN.
struct LimitNan;

impl Kernel for LimitNan {
    type Out = f32;
    const WIDE: bool = false;
    #[inline(always)]
    fn run<S: Simd>(self, s: S) -> f32 {
        let mut to = Lanes::ZERO;
        s.store(&mut to, s.limit(s.splat(f32::NAN), 1.0));
        to.0[5]
    }
}

#[test]
fn limiting_does_not_hide_a_value_that_is_not_a_number() {
    for isa in Isa::ALL.into_iter().filter(|i| i.is_available()) {
        assert!(dispatch(isa, LimitNan).is_nan(), "{}", isa.name());
    }
}
