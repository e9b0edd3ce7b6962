//! A check for leaks: labels of other cases must score at chance.

use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;

use super::case::Case;
use super::row::{Bar, Row};

/// Shuffles of the labels.
const SHUFFLES: usize = 100;
/// Above the most frequent label's share.
const MARGIN: f64 = 0.02;

/// The share that is right when the labels of the catalogue suite are dealt out anew.
pub fn rows(cases: &[Case]) -> Vec<Row> {
    let own: Vec<&Case> = cases.iter().filter(|c| c.suite == "catalogue").collect();
    let mut labels: Vec<&serde_json::Value> = own.iter().map(|c| &c.label).collect();
    let frequent =
        own.iter().map(|c| own.iter().filter(|d| d.truth() == c.truth()).count()).max().unwrap_or(0);
    if own.is_empty() || frequent == own.len() {
        return Vec::new();
    }
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let mut right = 0;
    for _ in 0..SHUFFLES {
        labels.shuffle(&mut rng);
        let dealt = |(case, label): (&&Case, &&serde_json::Value)| Case {
            label: (*label).clone(),
            ..(*case).clone()
        };
        right += own.iter().zip(&labels).map(dealt).filter(Case::is_right).count();
    }
    let chance = frequent as f64 / own.len() as f64 + MARGIN;
    let share = right as f64 / (SHUFFLES * own.len()) as f64;
    vec![Row::number("leaks", "right with shuffled labels", Some(share), Bar::AtMost(chance))]
}
