//! Whether the time of a refusal tells how much of a token was right: Welch's t of two kinds of wrong
//! token, those that begin like a right one and those that share nothing with it.
//!
//! `cargo test --lib timing -- --ignored --nocapture` measures; on a busy machine it takes longer and
//! says the same. After dudect (Reparaz, Balasch, Verbauwhede, 2017): both kinds interleaved in a random
//! order that is fixed before, prepared alike and read from one place, and the slowest measurements cut
//! off at several heights, of which the one counts that looks worst.

use std::hint::black_box;
use std::time::Instant;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;
use crate::domain::{Secret, TokenRole};

/// Measurements, both kinds together.
const SAMPLES: usize = 100_000;

/// Measurements before those that count: caches and branches get used to the work.
const WARM_UP: usize = 10_000;

/// Beyond this the two kinds differ in time.
const BAR: f64 = 4.5;

/// Shares of the measurements that are kept, the quickest.
const KEPT: [f64; 8] = [1.0, 0.999, 0.99, 0.95, 0.9, 0.75, 0.5, 0.25];

/// Fewest measurements of a kind that say something.
const FEWEST: f64 = 1000.0;

/// Characters of a secret that a forger would have got right.
const SHARED: usize = 48;

const ALPHABET: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789-_";

/// A wrong token, and whether it begins like a right one.
#[derive(Clone)]
struct Wrong {
    text: [u8; 51],
    close: bool,
}

/// Every one is drawn whole, and then given the right beginning or one that is as random.
fn wrong(right: &[u8], random: &mut ChaCha8Rng) -> Wrong {
    let mut draw = || {
        let mut text = *b"rigcast_0000000000000000000000000000000000000000000";
        text[8..].fill_with(|| ALPHABET[random.random_range(0..64)]);
        text
    };
    let (mut text, other) = (draw(), draw());
    let close = random.random_bool(0.5);
    let beginning = if close { right } else { &other[..] };
    text[..SHARED].copy_from_slice(&beginning[..SHARED]);
    // Of a hundred thousand with three characters to guess, one may be right.
    if text == right { self::wrong(right, random) } else { Wrong { text, close } }
}

/// Nanoseconds that each takes, the warm-up left out.
fn measure(wrong: &[Wrong], check: impl Fn(&[u8]) -> bool) -> Vec<(f64, bool)> {
    let mut times = Vec::with_capacity(wrong.len());
    for Wrong { text, close } in wrong {
        let started = Instant::now();
        let opened = black_box(check(black_box(text)));
        let took = started.elapsed().as_nanos() as f64;
        assert!(!opened, "a wrong token opens nothing");
        times.push((took, *close));
    }
    times.split_off(WARM_UP)
}

/// Welch's t of those that begin like a right one against the others; nothing where too few of a kind
/// are left.
fn welch(times: &[(f64, bool)]) -> Option<f64> {
    let moments = |close: bool| {
        let of_kind = || times.iter().filter(|(_, kind)| *kind == close).map(|(time, _)| *time);
        let n = of_kind().count() as f64;
        let mean = of_kind().sum::<f64>() / n;
        let variance = of_kind().map(|time| (time - mean).powi(2)).sum::<f64>() / (n - 1.0);
        (n >= FEWEST).then_some((mean, variance / n))
    };
    let ((a, error_a), (b, error_b)) = (moments(true)?, moments(false)?);
    Some((a - b) / (error_a + error_b).sqrt())
}

/// The largest t of all heights at which the slowest are cut off.
fn worst(times: &[(f64, bool)]) -> f64 {
    let mut sorted: Vec<f64> = times.iter().map(|(time, _)| *time).collect();
    sorted.sort_by(f64::total_cmp);
    let cut = |kept: f64| {
        let height = sorted[((sorted.len() as f64 * kept) as usize).min(sorted.len() - 1)];
        welch(&times.iter().copied().filter(|(time, _)| *time <= height).collect::<Vec<_>>())
    };
    KEPT.into_iter().filter_map(cut).max_by(|a, b| a.abs().total_cmp(&b.abs())).expect("heights")
}

#[test]
#[ignore = "a measurement of time, for .ci/full"]
fn the_time_of_a_refusal_does_not_tell_how_much_of_a_token_was_right() {
    let secrets: Vec<Secret> = (0..100).map(|_| Secret::draw().expect("randomness")).collect();
    let now: Timestamp = "2026-03-01T12:00:00Z".parse().expect("a time");
    let token = |secret: &Secret| {
        let id = uuid::Uuid::nil();
        let (name, rigs, role) = (String::new(), None, TokenRole::Reader);
        (secret.digest(), Token { id, name, role, rigs, created_at: now, expires_at: None })
    };
    let keys = Keys::of(TokenTable { tokens: secrets.iter().map(token).collect(), any: true });
    let right = secrets[0].reveal().as_bytes();
    let mut random = ChaCha8Rng::seed_from_u64(5);
    let wrong: Vec<Wrong> = (0..WARM_UP + SAMPLES).map(|_| self::wrong(right, &mut random)).collect();

    let found = worst(&measure(&wrong, |text| keys.find(&SecretDigest::of(text), now).is_some()));
    // What a measurement like this sees where there is something to see.
    let early = |text: &[u8]| text.len() == right.len() && text.iter().zip(right).all(|(a, b)| a == b);
    let control = worst(&measure(&wrong, early));
    println!(
        "Welch's t over {SAMPLES} refusals: {found:.2} (bar {BAR}); a comparison that stops early: {control:.1}"
    );
    assert!(control.abs() > BAR, "the measurement would see nothing: {control}");
    assert!(found.abs() < BAR, "{found}");
}
