//! Pages of whole diagnoses.

use super::rig::{few, hardening, none, request};
use super::{Heading, Simulation, drawing, figures, page, sentence};
use crate::engine::diagnosis::{Diagnosis, Effect, Family, Input, Mode, VerdictKind, diagnose};
use crate::engine::progress::unwatched;

fn heading() -> Heading {
    Heading {
        rig: "bench-1".into(),
        rig_name: "<script>alert(\"rig\")</script> & co".into(),
        diagnosis: "0197a3c2".into(),
        when: "21 November 2026, 09:45 UTC".into(),
        model: Simulation::Version { version: 3, kind: "frf".into() },
        elapsed_s: 1.25,
        adopt: Some("POST /v1/rigs/bench-1/diagnoses/0197a3c2/adopt".into()),
    }
}

/// A hardening spring on a rig whose names are as hostile as a client can make them.
fn hostile() -> Diagnosis {
    let mut input = Input { catalogue: few(), ..request(hardening, 0.01) };
    input.responses[0].name = "disp<x onload=\"run()\">".into();
    input.responses[0].axis = Some("<b>".into());
    input.drives[0].unit = "k\"N' & <i>".into();
    input.runs[0].name = "</svg><script>".into();
    diagnose(&input, &unwatched).unwrap()
}

/// Names of the tags of a document that nest as they should; panics where they do not.
fn tags(html: &str) -> Vec<&str> {
    let (mut open, mut all) = (Vec::new(), Vec::new());
    for piece in html.split('<').skip(1) {
        let (tag, _) = piece.split_once('>').expect("a tag ends");
        assert_eq!(tag.matches('"').count() % 2, 0, "<{tag}>");
        let name = tag.split([' ', '/']).find(|n| !n.is_empty()).unwrap();
        if let Some(closed) = tag.strip_prefix('/') {
            assert_eq!(open.pop(), Some(closed), "</{closed}> closes what is open");
        } else if !matches!(name, "!DOCTYPE" | "meta") {
            open.push(name);
            all.push(name);
        }
    }
    assert!(open.is_empty(), "{open:?} are left open");
    all
}

#[test]
fn a_page_tells_the_verdict_escapes_every_name_and_is_well_formed() {
    let found = hostile();
    let html = page(&heading(), &found.report, &found.views);
    let sentence = sentence::verdict(&found.report);
    assert!(sentence.contains("stiffness"), "{sentence}");
    let escaped = sentence.replace('<', "&lt;").replace('>', "&gt;");
    assert!(html.contains(&escaped), "{escaped}");
    let tags = tags(&html);
    assert!(!tags.contains(&"script") && !tags.contains(&"b>") && !tags.contains(&"i"));
    assert_eq!(html.matches("onload=\"").count(), 0);
    let plots = tags.iter().filter(|t| **t == "svg").count();
    assert!(plots >= 9, "{plots}");
    assert_eq!(tags.iter().filter(|t| **t == "desc").count(), plots);
    for word in ["NaN", "inf ", "inf\"", "Infinity", "not known", "null"] {
        assert!(!html.contains(word), "{word}");
    }
    for id in ["where", "which", "how-far", "force", "adopt", "method"] {
        assert!(html.contains(&format!("<h2 id=\"{id}\"")), "{id}");
    }
    assert!(html.len() < 400_000, "{}", html.len());
    // Ids are unique, and what names a plot exists.
    let ids: Vec<&str> = html.split(" id=\"").skip(1).map(|s| s.split('"').next().unwrap()).collect();
    let unique: std::collections::BTreeSet<&&str> = ids.iter().collect();
    assert_eq!(unique.len(), ids.len());
}

#[test]
fn every_plot_of_the_page_is_a_file_by_the_name_that_it_has_there() {
    let found = hostile();
    let html = page(&heading(), &found.report, &found.views);
    let plots = figures(&found.report, &found.views);
    assert!(plots.len() >= 7, "{}", plots.len());
    for plot in &plots {
        assert!(html.contains(&plot.svg().into_string()), "{} is on the page", plot.id);
        let file = drawing(&found.report, &found.views, &plot.id).unwrap();
        assert!(file.csv().lines().count() > 2, "{}: {}", plot.id, file.csv());
        tags(file.svg().split_once("?>").unwrap().1);
    }
    let known = drawing(&found.report, &found.views, "phase").unwrap_err();
    assert!(known.contains("over-time") && known.contains("unseen-spectra"), "{known}");
}

#[test]
fn a_rig_like_its_model_gets_a_short_page_that_says_so() {
    let found = diagnose(&request(none, 0.01), &unwatched).unwrap();
    let html = page(&heading(), &found.report, &found.views);
    assert!(html.contains("model and rig agree"));
    tags(&html);
    assert!(!html.contains("id=\"which\"") && !html.contains("id=\"adopt\""));
}

#[test]
fn a_page_of_runs_without_repeats_shows_what_the_law_leaves_of_each_group() {
    let plain = request(hardening, 0.01);
    let runs = plain.runs[..2].to_vec();
    let input = Input { baseline: runs.clone(), runs, repeats: Vec::new(), mode: Mode::InSitu, ..plain };
    let found = diagnose(&input, &unwatched).unwrap();
    let html = page(&heading(), &found.report, &found.views);
    tags(&html);
    assert!(html.contains("<h2 id=\"transfer\"") && html.contains("In terms of drive_x"), "{html}");
    assert!(html.contains("What the best law, or a linear part alone, predicts"));
    assert!(!html.contains("NaN"));
}

#[test]
fn two_effects_are_told_in_one_sentence_and_weighed() {
    let spring_and_friction = |x: f64, v: f64| 260.0 * x * x * x + 300.0 * v.tanh();
    let input = Input { catalogue: few(), ..request(spring_and_friction, 0.01) };
    let found = diagnose(&input, &unwatched).unwrap();
    let said = sentence::verdict(&found.report);
    for part in ["cubic stiffness on axis x", "Coulomb friction on axis x", "together they close"] {
        assert!(said.contains(part), "{said}");
    }
    let html = page(&heading(), &found.report, &found.views);
    tags(&html);
    assert_eq!(html.matches("beside what is named before it").count(), 1);
    assert!(html.contains("Coulomb friction: transition velocity"), "the numbers say whose they are");
    assert!(html.contains("adopt these and diagnose again"));
}

#[test]
fn every_kind_of_verdict_has_a_sentence_of_its_own() {
    let found = hostile();
    let mut seen = std::collections::BTreeSet::new();
    for (kind, effect) in [
        (VerdictKind::Identified, Some(Effect::CubicStiffness)),
        (VerdictKind::Identified, Some(Effect::Gain)),
        (VerdictKind::Identified, Some(Effect::Quantisation)),
        (VerdictKind::Partial, Some(Effect::CubicStiffness)),
        (VerdictKind::FamilyOnly, None),
        (VerdictKind::NotDistinguishable, None),
        (VerdictKind::NoneOfCatalogue, None),
        (VerdictKind::Undecided, None),
        (VerdictKind::NoiseOrUnmeasuredDisturbance, Some(Effect::PeriodicDisturbance)),
        (VerdictKind::NoiseOrUnmeasuredDisturbance, Some(Effect::RaisedNoise)),
        (VerdictKind::NoMaterialGap, None),
    ] {
        for hypotheses in [true, false] {
            let mut report = found.report.clone();
            report.verdict.kind = kind;
            report.verdict.effect = effect;
            report.verdict.family = Some(Family::Stiffness);
            report.verdict.equivalence_set = vec![Effect::CubicStiffness, Effect::BumpStop];
            report.verdict.probability = 0.7;
            if !hypotheses {
                report.hypotheses.clear();
                report.next_experiment = None;
            }
            let said = sentence::verdict(&report);
            assert!(said.starts_with("Probably (70\u{a0}%), ") && said.ends_with('.'), "{said}");
            assert_eq!(said.matches(". ").count(), 0, "one sentence: {said}");
            assert!(!said.contains('_') && !said.contains("  "), "{said}");
            tags(&page(&heading(), &report, &found.views));
            seen.insert(said);
        }
    }
    assert!(seen.len() >= 12, "{seen:#?}");
}

#[test]
fn what_cannot_be_told_apart_comes_with_the_run_that_would_tell() {
    let mut report = hostile().report;
    report.verdict.kind = VerdictKind::NotDistinguishable;
    let next = sentence::next(&report).unwrap();
    assert!(next.starts_with("Run ") && next.contains("apart") && next.contains("noise floor"), "{next}");
    report.next_experiment.as_mut().unwrap().inseparable_in_envelope = true;
    assert!(sentence::next(&report).unwrap().starts_with("No run within the allowed drive levels"));
}
