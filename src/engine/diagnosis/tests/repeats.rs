use std::sync::Arc;

use super::rig::{few, hardening, request};
use crate::diagnosis::data::prepare::prepare;
use crate::diagnosis::data::problem::{Stretch, first_equivalent};
use crate::diagnosis::effects::candidate::{Candidate, Part};
use crate::diagnosis::effects::law::Law;
use crate::diagnosis::effects::output_map::OutputMap;
use crate::diagnosis::{Effect, Input};
use crate::progress::unwatched;

/// Drives that are another's own, so that nothing is shared.
fn apart(stretch: &Stretch) -> Stretch {
    let mut apart = stretch.clone();
    apart.course.drives = Arc::new((*stretch.drives).clone());
    apart
}

#[test]
fn repeats_share_their_free_runs_and_nothing_changes() {
    let problem = prepare(&Input { catalogue: few(), ..request(hardening, 0.01) }, &unwatched)
        .unwrap()
        .problems
        .remove(0);
    let repeats = first_equivalent(&problem.fit, false);
    assert_eq!(repeats, [0, 0, 2, 2]);
    assert_eq!(first_equivalent(&problem.fit, true), [0, 1, 2, 3], "recorded at different times");

    let cubic = Part::force(Effect::CubicStiffness, vec![Law::Cubic], None);
    let drift = Part::output(Effect::OffsetDrift, OutputMap::Drift);
    let mut alone = problem.clone();
    alone.fit = problem.fit.iter().map(apart).collect();
    assert_eq!(first_equivalent(&alone.fit, false), [0, 1, 2, 3]);
    for parts in [vec![cubic.clone()], vec![drift.clone()], vec![cubic, drift]] {
        let candidate = Candidate { parts, retune: false };
        let p: Vec<f64> = (0..candidate.parameters(&problem)).map(|i| 1e-6 * (1.0 + i as f64)).collect();
        let rows = |problem| candidate.residual_rows(problem, &problem.fit, &p).unwrap();
        assert_eq!(rows(&problem), rows(&alone));
        let scale = vec![1.0; p.len()];
        let columns = |problem| -> Vec<Vec<f64>> {
            let jacobian = candidate.jacobian(problem, &p, &scale).unwrap();
            jacobian.into_iter().map(|c| c.values).collect()
        };
        assert_eq!(columns(&problem), columns(&alone));
    }
}

#[test]
fn stretches_of_other_drives_share_nothing() {
    let mut input = request(hardening, 0.01);
    input.runs.truncate(2);
    input.repeats.clear();
    let problem = prepare(&input, &unwatched).unwrap().problems.remove(0);
    assert_eq!(first_equivalent(&problem.fit, false), [0, 1]);
}
