//! Tests whether the time of a refusal reveals how much of a token was right: Welch's t between two
//! kinds of wrong tokens, those that begin like a right one and those that share nothing with it.
//!
//! `cargo test --lib timing -- --ignored --nocapture` runs the measurement; a busy machine makes it
//! longer, not different. The method is dudect's (Reparaz, Balasch, Verbauwhede, 2017): both kinds are
//! interleaved in a random order that is fixed beforehand, prepared alike and read from one place. The
//! slowest measurements are cut off at several thresholds, and the worst result counts.

use std::hint::black_box;
use std::time::Instant;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;
use crate::domain::{Secret, TokenRole};

/// Measurements, both kinds together.
const SAMPLES: usize = 100_000;

/// Measurements before those that count, to warm up caches and branch prediction.
const WARM_UP: usize = 10_000;

/// Above this value the two kinds differ in time.
const BAR: f64 = 4.5;

/// Shares of the measurements that are kept; the slowest are cut off.
const KEPT: [f64; 8] = [1.0, 0.999, 0.99, 0.95, 0.9, 0.75, 0.5, 0.25];

/// Fewest measurements of a kind for a result.
const FEWEST: f64 = 1000.0;

/// Leading characters of the secret that the close kind shares.
const SHARED: usize = 48;

const ALPHABET: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789-_";

/// A wrong token, and whether it begins like a right one.
#[derive(Clone)]
struct Wrong {
    text: [u8; 51],
    close: bool,
}

/// Each token is drawn whole; then its beginning is replaced by the right one or by another random one.
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
    // Of a hundred thousand tokens with three random characters, one may be right by chance.
    if text == right { self::wrong(right, random) } else { Wrong { text, close } }
}

/// Nanoseconds of each check, without the warm-up.
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

/// Welch's t between the two kinds; `None` where too few of a kind are left.
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

/// The largest t over all thresholds at which the slowest are cut off.
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
    let snapshot =
        TokenSnapshot::of(TokenTable { tokens: secrets.iter().map(token).collect(), revoked: Vec::new() });
    let right = secrets[0].reveal().as_bytes();
    let mut random = ChaCha8Rng::seed_from_u64(5);
    let wrong: Vec<Wrong> = (0..WARM_UP + SAMPLES).map(|_| self::wrong(right, &mut random)).collect();

    let found = worst(&measure(&wrong, |text| snapshot.find(&SecretDigest::of(text), now).is_some()));
    // A comparison that stops early, to show that the measurement detects one.
    let early = |text: &[u8]| text.len() == right.len() && text.iter().zip(right).all(|(a, b)| a == b);
    let control = worst(&measure(&wrong, early));
    println!(
        "Welch's t over {SAMPLES} refusals: {found:.2} (bar {BAR}); a comparison that stops early: {control:.1}"
    );
    assert!(control.abs() > BAR, "the measurement would see nothing: {control}");
    assert!(found.abs() < BAR, "{found}");
}
