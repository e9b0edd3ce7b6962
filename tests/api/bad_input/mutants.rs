//! Valid requests of every kind, truncated, with flipped bits and with other sizes.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tempfile::TempDir;

use super::corpus::Case;
use super::meter::Meter;
use super::seeds::seeds;
use crate::support::setting;

/// Growth of the program's resident memory over the whole corpus.
const MAX_GROWTH: u64 = 256 << 20;

/// Critical values of sizes, counts and rates.
const EDGES: [&[u8]; 8] = [
    &[0xff; 8],
    &[0; 8],
    &[0xff, 0xff, 0xff, 0x7f],
    &[0, 0, 0, 0, 0, 0, 0xf8, 0x7f],
    b"-1",
    b"1e999",
    b"99999999999999999999",
    b"\xc3\x28",
];

fn mutant(seed: &Case, random: &mut ChaCha8Rng) -> Case {
    let mut bytes = seed.body.to_vec();
    for _ in 0..random.random_range(1..4) {
        let len = bytes.len();
        if len == 0 {
            break;
        }
        // Half of the faults in the first hundred bytes, where headers are.
        let near = if random.random_bool(0.5) { len.min(100) } else { len };
        let at = random.random_range(0..near);
        match random.random_range(0..6) {
            0 => bytes.truncate(at),
            1 | 2 => bytes[at] ^= 1 << random.random_range(0..8),
            3 => {
                let edge = EDGES[random.random_range(0..EDGES.len())];
                let end = len.min(at + edge.len());
                bytes.splice(at..end, edge.iter().copied());
            }
            4 => {
                let part = bytes[at..len.min(at + random.random_range(1..40))].to_vec();
                bytes.splice(at..at, part);
            }
            _ => {
                bytes.drain(at..len.min(at + random.random_range(1..40)));
            }
        }
    }
    Case { body: bytes.into(), ..seed.clone() }
}

#[tokio::test]
async fn files_cut_short_or_turned_are_refused_and_cost_no_memory() {
    let each: usize = setting("RIGCAST_TEST_MUTANTS", 100);
    let directory = TempDir::new().expect("a directory");
    Meter::furnish(&directory).await;
    let meter = Meter::start(directory.path()).await;
    let mut random = ChaCha8Rng::seed_from_u64(11);
    let (mut taken, mut refused) = (0, std::collections::BTreeMap::<String, usize>::new());
    for seed in seeds() {
        let whole = meter.measure(&seed).await;
        assert!(whole.status < 300, "{}: the seed itself is right: {whole:?}", seed.name);
        let mut bad = 0;
        for _ in 0..each {
            let case = mutant(&seed, &mut random);
            let found = meter.measure(&case).await;
            assert!(found.peak <= found.allowed, "{found:?} {case:?}");
            if found.status < 300 {
                taken += 1;
            } else {
                bad += 1;
                *refused.entry(found.code).or_default() += 1;
            }
        }
        assert!(2 * bad >= each / 2, "{}: only {bad} of {each} mutants were bad", seed.name);
    }
    let growth = meter.growth();
    println!("{} mutants: {taken} still right, refused by {refused:?}; {} MiB more", each * 10, growth >> 20);
    assert!(growth < MAX_GROWTH, "{growth}");
}
