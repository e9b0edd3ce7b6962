//! The regularised inverse does what its equation says, whatever the units.

use super::modal::Modal;
use super::*;

/// An FRF of white noise matrices, `[line, output, input]`, its lines from `first` to `last` excited.
fn random_frf(n_outputs: usize, n_inputs: usize, n_lines: usize, excited: [usize; 2]) -> Frf {
    let len = n_lines * n_outputs * n_inputs;
    let (re, im) = (noise(91, len), noise(92, len));
    let segment_len = 2 * (n_lines - 1);
    Frf {
        sample_rate_hz: segment_len as f64,
        segment_len,
        n_inputs,
        n_outputs,
        h: re.into_iter().zip(im).map(|(re, im)| Complex64::new(re, im)).collect(),
        usable_hz: excited.map(|line| line as f64),
        x_mean: vec![0.0; n_inputs],
        y_mean: vec![0.0; n_outputs],
    }
}

fn inverse(frf: &Frf, ridge: f64) -> Vec<Complex64> {
    FrfInverse::new(frf, None, ridge).unwrap().lines(frf, 0..frf.n_lines()).unwrap()
}

#[test]
fn without_a_ridge_it_is_the_pseudo_inverse() {
    for (ny, nx) in [(3, 3), (2, 3), (4, 2), (1, 1)] {
        let frf = random_frf(ny, nx, 33, [4, 28]);
        let inverse = inverse(&frf, 0.0);
        for line in 4..=28 {
            let g = |i: usize, o: usize| inverse[(line * nx + i) * ny + o];
            // Of full rank: the smaller of both products is the identity.
            for a in 0..nx.min(ny) {
                for b in 0..nx.min(ny) {
                    let product: Complex64 = if nx <= ny {
                        (0..ny).map(|o| g(a, o) * frf.at(line, o, b)).sum()
                    } else {
                        (0..nx).map(|i| frf.at(line, a, i) * g(i, b)).sum()
                    };
                    let identity = f64::from(u8::from(a == b));
                    assert!((product - identity).norm() < 1e-9, "{ny}x{nx}, line {line}: {product}");
                }
            }
        }
    }
}

#[test]
fn of_one_drive_it_is_tikhonovs_formula_about_the_median_line() {
    let frf = random_frf(1, 1, 34, [3, 31]);
    let mut squares: Vec<f64> = (3..=31).map(|line| frf.at(line, 0, 0).norm_sqr()).collect();
    squares.sort_by(f64::total_cmp);
    let level = squares[14];
    for ridge in [1e-3, 0.2] {
        let found = inverse(&frf, ridge);
        for (line, found) in found.iter().enumerate().take(32).skip(3) {
            let h = frf.at(line, 0, 0);
            let expected = h.conj() / (h.norm_sqr() + ridge * level);
            assert!((found - expected).norm() < 1e-12 * expected.norm(), "line {line}");
            assert!(found.norm() <= (1.0 + 1e-9) / (2.0 * (ridge * level).sqrt()), "line {line}");
        }
    }
}

#[test]
fn it_does_not_depend_on_units() {
    let frf = random_frf(3, 2, 33, [2, 30]);
    let (outputs, inputs) = ([1e-6, 1.0, 1e4], [1e3, 1e-5]);
    let mut scaled = frf.clone();
    for (at, h) in scaled.h.iter_mut().enumerate() {
        *h *= outputs[at / 2 % 3] / inputs[at % 2];
    }
    let (one, two) = (inverse(&frf, 0.05), inverse(&scaled, 0.05));
    for (at, (one, two)) in one.iter().zip(&two).enumerate() {
        let back = two * outputs[at % 3] / inputs[at / 3 % 2];
        assert!((one - back).norm() <= 1e-9 * one.norm(), "{at}: {one} {back}");
    }
}

#[test]
fn beyond_the_excited_lines_it_falls_to_zero_as_the_frf_does() {
    let frf = random_frf(2, 2, 257, [40, 200]);
    let prepared = FrfInverse::new(&frf, None, 1e-3).unwrap();
    let [first, last] = prepared.zero_outside();
    let all = prepared.lines(&frf, 0..257).unwrap();
    let size = |line: usize| all[line * 4..line * 4 + 4].iter().map(|z| z.norm()).sum::<f64>();
    assert_eq!((first, last), (30, 210), "a sixteenth of 161 lines");
    assert!((0..first).chain(last + 1..257).all(|line| size(line) == 0.0));
    assert!((200..last).all(|line| size(line + 1) < size(line)) && size(last) > 0.0);
    assert!((first..40).all(|line| size(line) < size(line + 1)));
    // Some lines of it are the same numbers.
    assert_eq!(prepared.lines(&frf, 35..50).unwrap(), all[35 * 4..50 * 4]);
}

#[test]
fn it_finds_the_drive_of_a_known_response() {
    // The bench's two outputs cannot tell three drives apart, two of them they can.
    let rig = Modal::bench();
    let n = 40_000;
    let x = channels(93, 2, n);
    let silent = vec![0.0; n];
    let y = rig.simulate(&[x[0].clone(), silent, x[1].clone()]);
    let (x, y) = (signal(rig.fs, x), signal(rig.fs, y));
    let found = estimate(&[(&x, &y)], &fixed(1024, 0.0), &unwatched).unwrap();
    let inverse = FrfInverse::new(&found.frf, Some(&found.quality), 1e-9).unwrap();
    let lines = found.frf.n_lines();
    let back = Frf {
        n_inputs: 2,
        n_outputs: 2,
        h: inverse.lines(&found.frf, 0..lines).unwrap(),
        x_mean: found.frf.y_mean.clone(),
        y_mean: found.frf.x_mean.clone(),
        ..found.frf.clone()
    };
    // Back and forth: what the rig does to the drives that the inverse asks for is the response.
    let drives = back.apply(&y).unwrap();
    let again = found.frf.apply(&drives).unwrap();
    for o in 0..2 {
        let error = relative_error(&y.channel(o)[1000..n - 1000], &again.channel(o)[1000..n - 1000]);
        assert!(error < 0.1, "output {o}: {error}");
    }
}

#[test]
fn a_ridge_that_is_no_share_is_refused_and_a_silent_channel_is_not() {
    let frf = random_frf(2, 2, 9, [1, 7]);
    for ridge in [-1e-9, f64::NAN, f64::INFINITY] {
        let refused = FrfInverse::new(&frf, None, ridge).unwrap_err();
        assert!(matches!(refused, EngineError::Setting { setting: "ridge", .. }), "{refused}");
    }
    let mut silent = frf.clone();
    silent.h.iter_mut().skip(1).step_by(2).for_each(|h| *h = Complex64::default());
    for ridge in [0.0, 1e-3] {
        let found = inverse(&silent, ridge);
        for line in 1..8 {
            let drives = &found[line * 4..line * 4 + 4];
            assert!(drives[..2].iter().any(|z| z.norm() > 0.0), "the input that acts");
            assert!(drives[2..].iter().all(|z| z.norm() == 0.0), "the input that does not");
        }
    }
    silent.h.fill(Complex64::default());
    assert!(inverse(&silent, 0.0).iter().all(|z| z.norm() == 0.0));
}

/// The quality of an FRF with one multiple coherence everywhere.
fn coherent(frf: &Frf, excited: [usize; 2], coherence: f64) -> FrfQuality {
    let pairs = frf.n_lines() * frf.n_outputs * frf.n_inputs;
    FrfQuality {
        settings: FrfSettings::default(),
        averages: 20,
        effective_averages: 20.0,
        excited: vec![excited],
        input_hz: vec![frf.usable_hz; frf.n_inputs],
        coherence: vec![coherence; pairs],
        multiple_coherence: vec![coherence; frf.n_lines() * frf.n_outputs],
        condition: vec![1.0; frf.n_lines()],
        std_error: vec![0.0; pairs],
    }
}

#[test]
fn the_incoherent_share_of_a_line_damps_it() {
    let (excited, ridge) = ([3, 31], 1e-3);
    let frf = random_frf(1, 1, 34, excited);
    let mut squares: Vec<f64> = (3..=31).map(|line| frf.at(line, 0, 0).norm_sqr()).collect();
    squares.sort_by(f64::total_cmp);
    let level = squares[14];
    // All of what is less than half coherent is noise.
    for (coherence, share) in [(1.0, 0.0), (0.8, 0.25), (0.5, 1.0), (0.2, 1.0), (0.0, 1.0)] {
        let quality = coherent(&frf, excited, coherence);
        let damped = FrfInverse::new(&frf, Some(&quality), ridge).unwrap().damped_by(&quality);
        let (found, reach) = (damped.lines(&frf, 0..34).unwrap(), damped.reach(&frf));
        for line in 3..=31 {
            let h = frf.at(line, 0, 0);
            let below = h.norm_sqr() * (1.0 + share) + ridge * level;
            assert!((found[line] - h.conj() / below).norm() < 1e-12 * found[line].norm(), "{coherence}");
            assert!((reach[line] - h.norm_sqr() / below).abs() < 1e-12, "{coherence}");
        }
        assert_eq!((reach[0], reach[33]), (0.0, 0.0));
    }
}

/// Corrections by an inverse, of a rig that is off from the FRF by as much as its coherence leaves open: the largest growth
/// of an error over as many iterations as a search has.
fn growth(inverse: &[Complex64], rig: &Frf, line: usize) -> f64 {
    let n = rig.n_outputs;
    let mut error: Vec<Complex64> = (0..n).map(|o| Complex64::from_polar(1.0, o as f64)).collect();
    let mut largest = 1.0_f64;
    for _ in 0..15 {
        let drive: Vec<Complex64> =
            (0..n).map(|i| (0..n).map(|o| inverse[(line * n + i) * n + o] * error[o]).sum()).collect();
        for (o, error) in error.iter_mut().enumerate() {
            *error -= (0..n).map(|i| rig.at(line, o, i) * drive[i]).sum::<Complex64>();
        }
        let norm = error.iter().map(Complex64::norm_sqr).sum::<f64>() / n as f64;
        largest = largest.max(norm.sqrt());
    }
    largest
}

#[test]
fn lines_of_high_condition_and_low_coherence_do_not_diverge() {
    let (n, excited, coherence) = (3, [4, 60], 0.8);
    let mut frf = random_frf(n, n, 65, excited);
    // The second drive nearly does what the first does: condition numbers of some 80.
    for line in frf.h.chunks_exact_mut(n) {
        line[1] = line[0] * 0.9 + line[1] * 0.05;
    }
    let uncertain: f64 = (1.0 - coherence) / coherence;
    let off = random_frf(n, n, 65, excited);
    let mut rig = frf.clone();
    for (place, (row, off)) in rig.h.chunks_exact_mut(n).zip(off.h.chunks_exact(n).rev()).enumerate() {
        let norm = |row: &[Complex64]| row.iter().map(Complex64::norm_sqr).sum::<f64>().sqrt();
        let share = uncertain.sqrt() * norm(row) / norm(off);
        assert!(share.is_finite(), "row {place}");
        row.iter_mut().zip(off).for_each(|(h, off)| *h += off * share);
    }
    let quality = coherent(&frf, excited, coherence);
    let plain = FrfInverse::new(&frf, Some(&quality), DEFAULT_RIDGE).unwrap();
    let damped = plain.clone().damped_by(&quality);
    let worst = |inverse: &FrfInverse| {
        let lines = inverse.lines(&frf, 0..65).unwrap();
        (4..=60).map(|line| growth(&lines, &rig, line)).fold(0.0, f64::max)
    };
    let (plain, damped) = (worst(&plain), worst(&damped));
    assert!(plain > 1e3 && damped < 4.0, "{plain} {damped}");
}
