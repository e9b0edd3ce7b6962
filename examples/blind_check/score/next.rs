//! Whether the run that a report asks for settles what it could not tell.

use serde_json::Value;

use super::case::Case;
use super::row::{Bar, Row};
use super::statistics::Share;

/// The truth leads alone after a further run.
fn resolved(case: &Case, which: &str) -> bool {
    let report = &case.answer["next"][which]["report"];
    let set = report["verdict"]["equivalence_set"].as_array().map_or(&[][..], Vec::as_slice);
    let leader = &report["hypotheses"][0]["effect"];
    set.len() == 1 && set[0] == case.truth() && *leader == case.truth()
}

/// The runs left several effects standing, the true one among them.
fn is_ambiguous(case: &Case) -> bool {
    case.set().len() > 1 && case.truth_is_in_set()
}

/// Rows over the ambiguous cases. That no allowed run separates them is believed unless a run drawn at
/// random does.
pub fn rows(cases: &[Case]) -> Vec<Row> {
    let own: Vec<&Case> = cases.iter().filter(|c| c.suite == "next-experiment").collect();
    if own.is_empty() {
        return Vec::new();
    }
    let ambiguous: Vec<&Case> = own.iter().copied().filter(|c| is_ambiguous(c)).collect();
    let given_up = |c: &Case| {
        let next = &c.report()["next_experiment"];
        *next == Value::Null || next["inseparable_in_envelope"] == true
    };
    let separable: Vec<&Case> =
        ambiguous.iter().copied().filter(|c| !given_up(c) || resolved(c, "random")).collect();
    let by = |which: &str| Share::count(&separable, |c| resolved(c, which));
    vec![
        Row::share("next-experiment", "ambiguous", Share { of: ambiguous.len(), all: own.len() }, Bar::None),
        Row::share(
            "next-experiment",
            "of these some run separates",
            Share { of: separable.len(), all: ambiguous.len() },
            Bar::None,
        ),
        Row::share("next-experiment", "resolved by the run asked for", by("proposed"), Bar::AtLeast(0.80)),
        Row::share("next-experiment", "resolved by a run drawn at random", by("random"), Bar::None),
    ]
}
