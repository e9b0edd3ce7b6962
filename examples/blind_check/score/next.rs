//! Whether the run that a report proposes decides between the effects that it could not tell apart.

use serde_json::Value;

use super::case::Case;
use super::row::{Bar, Row};
use super::statistics::Share;

/// What further runs of one way made: `proposed` is one or none, `random` are one or more.
fn further<'a>(case: &'a Case, which: &str) -> Vec<&'a Value> {
    match &case.answer["next"][which] {
        Value::Array(runs) => runs.iter().map(|r| &r["report"]).collect(),
        Value::Null => Vec::new(),
        run => vec![&run["report"]],
    }
}

/// One effect is left, right or wrong.
fn settled(report: &Value) -> bool {
    report["verdict"]["equivalence_set"].as_array().is_some_and(|set| set.len() == 1)
}

/// The truth leads alone after the first run made this way.
fn resolved(case: &Case, which: &str) -> bool {
    further(case, which).first().is_some_and(|report| {
        settled(report)
            && report["verdict"]["equivalence_set"][0] == case.truth()
            && report["hypotheses"][0]["effect"] == case.truth()
    })
}

/// The runs left several effects standing, the true one among them.
fn is_ambiguous(case: &Case) -> bool {
    case.set().len() > 1 && case.truth_is_in_set()
}

/// Rows over the ambiguous cases. Runs were made until one left a single effect, so that what none settles is
/// what no allowed run separates.
pub fn rows(cases: &[Case]) -> Vec<Row> {
    let own: Vec<&Case> = cases.iter().filter(|c| c.suite == "next-experiment").collect();
    if own.is_empty() {
        return Vec::new();
    }
    let ambiguous: Vec<&Case> = own.iter().copied().filter(|c| is_ambiguous(c)).collect();
    let some_settles = |c: &Case| ["proposed", "random"].iter().flat_map(|w| further(c, w)).any(settled);
    let separable: Vec<&Case> = ambiguous.iter().copied().filter(|c| some_settles(c)).collect();
    let given_up = Share::count(&separable, |c| {
        let next = &c.report()["next_experiment"];
        *next == Value::Null || next["inseparable_in_envelope"] == true
    });
    let by = |which: &str| Share::count(&separable, |c| resolved(c, which));
    vec![
        Row::share("next-experiment", "ambiguous", Share { of: ambiguous.len(), all: own.len() }, Bar::None),
        Row::share(
            "next-experiment",
            "of these some run separates",
            Share { of: separable.len(), all: ambiguous.len() },
            Bar::None,
        ),
        Row::share("next-experiment", "of these said to be inseparable", given_up, Bar::None),
        Row::share("next-experiment", "resolved by the run asked for", by("proposed"), Bar::AtLeast(0.80)),
        Row::share("next-experiment", "resolved by a run drawn at random", by("random"), Bar::None),
    ]
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use serde_json::json;

    use super::*;

    /// A case of Coulomb's friction that Stribeck's fits too.
    fn case(given_up: bool, proposed: &Value, random: &[Value]) -> Case {
        let next = json!({"inseparable_in_envelope": given_up});
        let verdict = json!({"equivalence_set": ["coulomb_friction", "stribeck_friction"]});
        Case {
            id: "0".into(),
            suite: "next-experiment".into(),
            label: json!({"effects": [{"effect": "coulomb_friction"}]}),
            answer: Arc::new(json!({
                "report": {"verdict": verdict, "next_experiment": next},
                "next": {"proposed": proposed, "random": random},
            })),
        }
    }

    fn further(leaves: &[&str]) -> Value {
        json!({"report": {"verdict": {"equivalence_set": leaves}, "hypotheses": [{"effect": leaves[0]}]}})
    }

    #[test]
    fn what_any_run_settles_counts_and_only_the_truth_resolves_it() {
        let right = further(&["coulomb_friction"]);
        let wrong = further(&["stribeck_friction"]);
        let open = further(&["coulomb_friction", "stribeck_friction"]);
        let cases = [
            case(false, &right, std::slice::from_ref(&open)),
            case(false, &wrong, std::slice::from_ref(&open)),
            case(true, &open, &[open.clone(), right.clone()]),
            case(true, &Value::Null, std::slice::from_ref(&right)),
            case(false, &open, &[open.clone(), open.clone()]),
        ];
        let shown: Vec<String> = rows(&cases).iter().map(|r| r.cells()[1].clone()).collect();
        let expected = ["5 of 5", "4 of 5", "2 of 4", "1 of 4", "1 of 4"];
        assert_eq!(shown.len(), expected.len());
        for (shown, expected) in shown.iter().zip(expected) {
            assert!(shown.ends_with(&format!("({expected})")), "{shown}");
        }
    }
}
