//! The fourth-order Runge-Kutta method.

/// Moves `state` on by `h`. `slope(q, share, d)` writes the time derivative at the state `q` and the `share` of the step
/// into `d`; what it never writes is zero.
pub fn step<const N: usize>(
    state: &mut [f64; N],
    h: f64,
    mut slope: impl FnMut(&[f64; N], f64, &mut [f64; N]),
) {
    let mut d = [0.0; N];
    slope(state, 0.0, &mut d);
    let mut sum = d;
    for (share, weight) in [(0.5, 2.0), (0.5, 2.0), (1.0, 1.0)] {
        let moved = plus(state, share * h, &d);
        slope(&moved, share, &mut d);
        sum = plus(&sum, weight, &d);
    }
    *state = plus(state, h / 6.0, &sum);
}

/// `q + share d`. Making cases is this for the most part, and tests are compiled without optimisation, where an iterator
/// takes five times as long as this loop.
fn plus<const N: usize>(q: &[f64; N], share: f64, d: &[f64; N]) -> [f64; N] {
    let mut out = *q;
    let mut i = 0;
    while i < N {
        out[i] += share * d[i];
        i += 1;
    }
    out
}
