//! The rows of each suite.

use super::case::Case;
use super::row::{Bar, Row};
use super::statistics::{Share, median, quantile};

/// The default `material_gap`.
const MATERIAL: f64 = 0.02;

/// Rows of the suites that have cases.
pub fn rows(cases: &[Case]) -> Vec<Row> {
    let of = |suite: &str| -> Vec<&Case> { cases.iter().filter(|c| c.suite == suite).collect() };
    let mut rows = Vec::new();
    let mut add = |suite: &'static str, make: fn(&'static str, &[&Case]) -> Vec<Row>| {
        let own = of(suite);
        if !own.is_empty() {
            rows.extend(make(suite, &own));
        }
    };
    add("catalogue", catalogue);
    add("nothing", nothing);
    add("outside", |suite, cases| {
        let spared = Share::count(cases, |c| !c.is_blamed());
        vec![Row::share(suite, "not blamed", spared, Bar::AtLeast(0.95))]
    });
    add("struck", |suite, cases| {
        let abstains = Share::count(cases, |c| !c.is_blamed());
        vec![Row::share(suite, "abstains", abstains, Bar::AtLeast(0.85))]
    });
    add("other-equation", other_equation);
    add("in-situ", |suite, cases| {
        let right = Share::count(cases, |c| c.is_right());
        let by_name = Share::count(cases, |c| c.is_right() && !c.by_its_other_name());
        vec![
            Row::share(suite, "right", right, Bar::AtLeast(0.90)),
            Row::share(suite, "right by the generator's name", by_name, Bar::None),
        ]
    });
    add("two-effects", |suite, cases| {
        let both = Share::count(cases, |c| c.both_are_found());
        vec![Row::share(suite, "both among the first two", both, Bar::AtLeast(0.80))]
    });
    add("two-axes", |suite, cases| {
        let found = |count: usize| Share::count(cases, |c| c.axes_found() >= count);
        let wrong = |c: &Case| c.is_blamed() && !c.is_right();
        vec![
            Row::share(suite, "both effects, each with its axis", found(2), Bar::AtLeast(0.80)),
            Row::share(suite, "one of them at least", found(1), Bar::None),
            Row::share(suite, "blamed wrongly", Share::count(cases, |c| wrong(c)), Bar::AtMost(0.03)),
        ]
    });
    add("three-axes", |suite, cases| {
        let right = Share::count(cases, |c| c.is_right());
        vec![Row::share(suite, "effect and axis right", right, Bar::AtLeast(0.90))]
    });
    add("no-repeats", no_repeats);
    add("sims-that-err", sims_that_err);
    add("rough-rigs", |suite, cases| of_frames(suite, cases, 0.88));
    add("place", |suite, cases| of_frames(suite, cases, 0.88));
    add("force-over-displacement", |suite, cases| of_frames(suite, cases, 0.90));
    rows
}

/// What is stated with 0.9 or more and wrong, and what is blamed wrongly, of all cases.
fn certainty(suite: &'static str, cases: &[&Case]) -> Vec<Row> {
    let wrong = |c: &Case| c.is_blamed() && !c.family_is_right();
    vec![
        Row::share(suite, "blamed wrongly", Share::count(cases, |c| wrong(c)), Bar::AtMost(0.03)),
        Row::share(
            suite,
            "stated with 0.9 or more and wrong",
            Share::count(cases, |c| c.stated_probability() >= 0.9 && !c.verdict_is_true()),
            Bar::AtMost(0.01),
        ),
    ]
}

/// Cases with a gap that is clearly one beside a linear part, and cases without any effect.
fn clear_and_none<'a>(cases: &[&'a Case]) -> [Vec<&'a Case>; 2] {
    let is_clear = |c: &Case| c.label["gap"].as_f64() >= Some(2.0 * MATERIAL);
    let of = |wanted: &dyn Fn(&Case) -> bool| cases.iter().copied().filter(|c| wanted(c)).collect();
    [of(&|c| c.has_effect() && is_clear(c)), of(&|c| !c.has_effect())]
}

/// What is reassured although there is a clear gap, and blamed although there is no effect.
fn errors(suite: &'static str, clear: &[&Case], none: &[&Case]) -> [Row; 2] {
    let reassured = Share::count(clear, |c| c.kind() == "no_material_gap");
    let blamed = Share::count(none, |c| c.is_blamed());
    [
        Row::share(suite, "falsely reassured", reassured, Bar::AtMost(0.01)),
        Row::share(suite, "blamed where nothing is", blamed, Bar::AtMost(0.03)),
    ]
}

/// Models that err, with an effect and without.
fn sims_that_err(suite: &'static str, cases: &[&Case]) -> Vec<Row> {
    let (there, none): (Vec<&Case>, Vec<&Case>) = cases.iter().partition(|c| c.has_effect());
    let mut rows = vec![
        Row::share(
            suite,
            "effect and axis right",
            Share::count(&there, |c| c.is_right()),
            Bar::AtLeast(0.85),
        ),
        Row::share(suite, "right family", Share::count(&there, |c| c.family_is_right()), Bar::None),
        Row::share(
            suite,
            "blamed where only the model errs",
            Share::count(&none, |c| c.is_blamed()),
            Bar::AtMost(0.03),
        ),
    ];
    rows.extend(certainty(suite, cases));
    rows
}

/// Frames: the label's gap is what the best linear frame leaves of a loud run.
fn of_frames(suite: &'static str, cases: &[&Case], family: f64) -> Vec<Row> {
    let [there, none] = clear_and_none(cases);
    let by_default = |yes: bool| -> Vec<&Case> {
        there.iter().filter(|c| (c.label["default_request"] == true) == yes).copied().collect()
    };
    let placed: Vec<&Case> = there.iter().filter(|c| c.states_place()).copied().collect();
    let mut rows = vec![Row::share(
        suite,
        "right family",
        Share::count(&there, |c| c.family_is_right()),
        Bar::AtLeast(family),
    )];
    for (name, yes) in [("right family, default requests", true), ("right family, drives run twice", false)] {
        rows.push(Row::share(
            suite,
            name,
            Share::count(&by_default(yes), |c| c.family_is_right()),
            Bar::None,
        ));
    }
    let first = Share::count(&there, |c| c.family_is_first());
    rows.push(Row::share(suite, "true family first", first, Bar::None));
    rows.extend(errors(suite, &there, &none));
    let place = Share::count(&placed, |c| c.place_is_right());
    rows.push(Row::share(suite, "place right", place, Bar::AtLeast(0.85)));
    rows.extend(certainty(suite, cases));
    rows
}

/// Default requests. The label's gap is what the best linear rig leaves of the loud run.
fn no_repeats(suite: &'static str, cases: &[&Case]) -> Vec<Row> {
    let [clear, none] = clear_and_none(cases);
    let mut rows = vec![
        Row::share(
            suite,
            "true family first",
            Share::count(&clear, |c| c.family_is_first()),
            Bar::AtLeast(0.85),
        ),
        Row::share(suite, "true family stated", Share::count(&clear, |c| c.family_is_right()), Bar::None),
    ];
    rows.extend(errors(suite, &clear, &none));
    rows.extend(certainty(suite, cases));
    rows
}

fn catalogue(suite: &'static str, cases: &[&Case]) -> Vec<Row> {
    let count = |holds: fn(&Case) -> bool| Share::count(cases, |c| holds(c));
    let sizes = || cases.iter().map(|c| c.set().len() as f64);
    vec![
        Row::share(suite, "right", count(Case::is_right), Bar::AtLeast(0.95)),
        Row::share(
            suite,
            "right and identified",
            count(|c| c.is_right() && c.kind() == "identified"),
            Bar::AtLeast(0.80),
        ),
        Row::share(suite, "right family", count(Case::family_is_right), Bar::AtLeast(0.97)),
        Row::share(suite, "blamed wrongly", count(|c| c.is_blamed() && !c.is_right()), Bar::None),
        Row::share(suite, "truth in the equivalence set", count(Case::truth_is_in_set), Bar::AtLeast(0.98)),
        Row::number(suite, "size of the set, median", median(sizes()), Bar::AtMost(2.0)),
        Row::number(suite, "size of the set, 90th percentile", quantile(sizes(), 0.9), Bar::AtMost(4.0)),
    ]
}

fn nothing(suite: &'static str, cases: &[&Case]) -> Vec<Row> {
    let blamed = Share::count(cases, |c| c.is_blamed_on_drive());
    let right = Share::count(cases, |c| c.is_right());
    vec![
        Row::share(suite, "blamed on a drive-related effect", blamed, Bar::AtMost(0.02)),
        Row::share(suite, "the right one of the four", right, Bar::AtLeast(0.90)),
    ]
}

fn other_equation(suite: &'static str, cases: &[&Case]) -> Vec<Row> {
    // A family of which no member is among the hypotheses closes nothing.
    let best_member = |case: &Case| -> f64 {
        let family = &case.label["effects"][0]["family"];
        let members = case.hypotheses().iter().filter(|h| h["family"] == *family);
        members.filter_map(|h| h["held_out"]["closure"].as_f64()).fold(0.0, f64::max)
    };
    let closures: Vec<f64> = cases.iter().map(|c| best_member(c)).collect();
    vec![
        Row::share(suite, "right family", Share::count(cases, |c| c.family_is_right()), Bar::AtLeast(0.95)),
        Row::number(
            suite,
            "closure by the family's best member, median",
            median(closures),
            Bar::AtLeast(0.95),
        ),
    ]
}
