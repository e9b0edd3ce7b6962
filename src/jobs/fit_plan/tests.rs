use super::testing::{plan_of, run};
use super::*;
use RunKind::{Noise, Service};
use Split::{Test, Training, Validation};

fn ids(runs: &[Run]) -> Vec<u128> {
    runs.iter().map(|run| run.id.as_u128()).collect()
}

fn tagged(mut run: Run, tag: &str) -> Run {
    run.tags.push(tag.into());
    run
}

/// The same upload once more.
fn again(id: u128, split: Split, original: &Run) -> Run {
    Run {
        sha256: original.sha256.clone(),
        duplicate_of: Some(original.id),
        ..run(id, original.kind, split, original.samples)
    }
}

/// The refusal of a fit: the problem's code, and the first place that it names.
fn refused(runs: &[Run], request: &str) -> (String, FieldError) {
    let problem = plan_of(runs, request).unwrap_err().problem();
    (problem.code, problem.errors[0].clone())
}

#[test]
fn a_fit_takes_noise_runs_of_the_training_split_and_all_validation_runs() {
    let runs = [
        run(1, Noise, Training, 1000),
        run(2, Service, Training, 1000),
        run(3, Noise, Validation, 1000),
        run(4, Service, Validation, 1000),
        run(5, Noise, Test, 1000),
    ];
    let plan = plan_of(&runs, r#"{"kind": "hybrid2"}"#).unwrap();
    assert_eq!((ids(&plan.training), ids(&plan.validation)), (vec![1], vec![3, 4]));
    assert_eq!(plan.frf, None);
    let resolved =
        |ids: &[u128]| Some(RunSelection::Ids(ids.iter().copied().map(RunId::from_u128).collect()));
    assert_eq!(plan.request.runs, resolved(&[1]));
    assert_eq!(plan.request.validation_runs, resolved(&[3, 4]));
    assert_eq!(plan.request.inputs, Some(vec!["u".into()]));
    let lineage = plan.lineage(false);
    assert_eq!(lineage.training[0].to_sample, 1000, "nothing is held out of training runs");
    let spans = |spans: &[Span]| spans.iter().map(|s| (s.from_sample, s.to_sample)).collect::<Vec<_>>();
    assert_eq!(spans(&lineage.stopping.unwrap()), [(0, 375); 2], "the first half less a quarter of it");
    assert_eq!(spans(&lineage.validation), [(500, 1000); 2]);
    let paper = plan_of(&runs, r#"{"kind": "hybrid2", "preset": "paper"}"#).unwrap().lineage(false);
    assert_eq!((spans(&paper.stopping.unwrap()), paper.validation.len()), (vec![(0, 1000); 2], 0));
}

#[test]
fn selections_by_kind_tag_and_split_and_an_empty_list_of_kinds() {
    let runs = [
        tagged(run(1, Noise, Training, 900), "a"),
        tagged(tagged(run(2, Service, Training, 900), "a"), "b"),
        run(3, Noise, Validation, 900),
    ];
    let training = |selection: &str| {
        let request = format!(r#"{{"kind": "lstm", "runs": {selection}}}"#);
        plan_of(&runs, &request).map(|plan| ids(&plan.training)).unwrap_or_default()
    };
    assert_eq!(training(r#"{"kinds": []}"#), [1, 2]);
    assert_eq!(training(r#"{"tags": ["a"]}"#), [1]);
    assert_eq!(training(r#"{"kinds": ["service", "noise"], "tags": ["a", "b"]}"#), [2]);
    assert_eq!(training(r#"{"split": "validation"}"#), [3]);
    assert_eq!(training(r#"{"tags": ["c"]}"#), [] as [u128; 0]);
}

#[test]
fn the_frf_part_may_use_other_runs() {
    let runs = [run(1, Noise, Training, 900), tagged(run(2, Noise, Training, 900), "linear")];
    let frf_runs = r#""frf": {"runs": {"tags": ["linear"]}}"#;
    let hybrid = plan_of(&runs, &format!(r#"{{"kind": "hybrid1", {frf_runs}}}"#)).unwrap();
    assert_eq!((ids(&hybrid.training), ids(&hybrid.frf.unwrap())), (vec![1, 2], vec![2]));
    // An FRF has no other part; an LSTM has no FRF part.
    let frf = plan_of(&runs, &format!(r#"{{"kind": "frf", {frf_runs}}}"#)).unwrap();
    assert_eq!((ids(&frf.training), frf.frf), (vec![2], None));
    let lstm = plan_of(&runs, &format!(r#"{{"kind": "lstm", {frf_runs}}}"#)).unwrap();
    assert_eq!((ids(&lstm.training), lstm.frf), (vec![1, 2], None));
    let same = plan_of(&runs[1..], &format!(r#"{{"kind": "hybrid1", {frf_runs}}}"#)).unwrap();
    assert_eq!(same.frf, None, "the same runs are not loaded twice");
}

#[test]
fn a_fit_without_runs_says_which_selection_is_empty() {
    let runs = [run(1, Service, Training, 900)];
    assert_eq!(refused(&[], r#"{"kind": "frf"}"#).1.pointer, "/runs");
    let (code, place) = refused(&runs, r#"{"kind": "frf"}"#);
    assert_eq!((code.as_str(), place.pointer.as_str()), ("fit.no_runs", "/runs"));
    let runs = [run(1, Noise, Training, 900)];
    let (_, place) = refused(&runs, r#"{"kind": "frf", "frf": {"runs": {"tags": ["no"]}}}"#);
    assert_eq!(place.pointer, "/frf/runs");
    let (_, place) = refused(&runs, r#"{"kind": "frf", "validation_runs": {"tags": ["no"]}}"#);
    assert_eq!(place.pointer, "/validation_runs");
    // The contract's default may be spelled out, and falls back to holding out.
    let plan = plan_of(&runs, r#"{"kind": "frf", "validation_runs": {"split": "validation"}}"#).unwrap();
    assert_eq!(plan.validation, []);
}

#[test]
fn an_unknown_run_is_named() {
    let runs = [run(1, Noise, Training, 900)];
    let request = format!(r#"{{"kind": "frf", "runs": ["{}", "{}"]}}"#, runs[0].id, RunId::from_u128(9));
    let (code, place) = refused(&runs, &request);
    assert_eq!((code.as_str(), place.pointer.as_str()), ("fit.invalid", "/runs/1"));
}

#[test]
fn a_run_that_lacks_a_channel_is_named_with_the_channel() {
    let mut partial = run(2, Noise, Training, 900);
    partial.channels = vec!["u".into()];
    let runs = [run(1, Noise, Training, 900), partial];
    let (code, place) = refused(&runs, r#"{"kind": "frf"}"#);
    assert_eq!((code.as_str(), place.channel.as_deref()), ("fit.missing_channel", Some("y")));
    assert!(place.limit.unwrap().contains(&runs[1].id.to_string()));
}

#[test]
fn a_channel_that_is_constant_in_every_run_is_named_and_one_that_moves_once_is_not() {
    let mut dead = run(1, Noise, Training, 900);
    dead.quality.dead_channels = vec!["u".into()];
    let (code, place) = refused(std::slice::from_ref(&dead), r#"{"kind": "frf"}"#);
    assert_eq!((code.as_str(), place.channel.as_deref()), ("signal.dead_channel", Some("u")));
    assert!(plan_of(&[dead, run(2, Noise, Training, 900)], r#"{"kind": "frf"}"#).is_ok());
}

#[test]
fn test_data_never_enter_a_fit_under_whatever_name() {
    let test = run(1, Noise, Test, 900);
    let request = |id: RunId| format!(r#"{{"kind": "frf", "runs": ["{id}"]}}"#);
    let (code, _) = refused(std::slice::from_ref(&test), &request(test.id));
    assert_eq!(code, "fit.test_run");
    // Test bytes that were uploaded again for training.
    let disguised = [test.clone(), again(2, Training, &test)];
    assert_eq!(refused(&disguised, &request(disguised[1].id)).0, "fit.test_run");
    assert_eq!(refused(&disguised, r#"{"kind": "frf"}"#).0, "fit.no_runs");
    // Training bytes that were uploaded again for a test.
    let original = run(3, Noise, Training, 900);
    let both = [original.clone(), again(4, Test, &original)];
    assert_eq!(refused(&both, r#"{"kind": "frf"}"#).0, "fit.test_run");
    let free = run(5, Noise, Training, 900);
    let frf =
        format!(r#"{{"kind": "hybrid1", "runs": ["{}"], "frf": {{"runs": ["{}"]}}}}"#, free.id, test.id);
    assert_eq!(refused(&[free, test], &frf).0, "fit.test_run");
}

#[test]
fn a_measurement_enters_once_however_often_it_was_uploaded() {
    let first = run(1, Noise, Training, 900);
    let runs = [first.clone(), again(2, Training, &first), run(3, Noise, Training, 900)];
    assert_eq!(ids(&plan_of(&runs, r#"{"kind": "frf"}"#).unwrap().training), [1, 3]);
    let both = format!(r#"{{"kind": "frf", "runs": ["{}", "{}"]}}"#, runs[1].id, runs[0].id);
    assert_eq!(ids(&plan_of(&runs, &both).unwrap().training), [1]);
}

#[test]
fn no_run_is_trained_on_and_validated_on() {
    let runs = [run(1, Noise, Training, 900), run(2, Noise, Validation, 900)];
    let (code, place) = refused(&runs, r#"{"kind": "frf", "validation_runs": {"split": "training"}}"#);
    assert_eq!((code.as_str(), place.pointer.as_str()), ("fit.invalid", "/validation_runs"));
    // Validation runs that the request did not name are used for training.
    let plan = plan_of(&runs, r#"{"kind": "frf", "runs": {"split": "validation"}}"#).unwrap();
    assert_eq!((ids(&plan.training), plan.validation), (vec![2], vec![]));
}

#[test]
fn runs_that_are_too_short_for_the_settings_are_refused_before_the_job() {
    let short = [run(1, Noise, Training, 9)];
    let (code, place) = refused(&short, r#"{"kind": "frf"}"#);
    assert_eq!((code.as_str(), place.pointer.as_str()), ("signal.too_short", "/runs"));
    let runs = [run(1, Noise, Training, 300), run(2, Noise, Training, 280)];
    let (code, place) = refused(&runs, r#"{"kind": "lstm"}"#);
    assert_eq!((code.as_str(), place.pointer.as_str()), ("signal.too_short", "/lstm/window_len"));
    assert!(place.limit.unwrap().starts_with("at most 224,"), "280 samples less the two tenths held out");
    assert!(plan_of(&runs, r#"{"kind": "lstm", "lstm": {"window_len": 224}}"#).is_ok());
    let (_, place) =
        refused(&runs, r#"{"kind": "hybrid1", "frf": {"segment_len": 512}, "lstm": {"window_len": 64}}"#);
    assert_eq!(place.pointer, "/frf/segment_len");
}

#[test]
fn of_several_runs_whole_ones_compare_and_the_model_is_fitted_again_on_all() {
    let runs = [1, 2, 3].map(|id| run(id, Noise, Training, 5000));
    let plan = plan_of(&runs, r#"{"kind": "hybrid2"}"#).unwrap();
    assert_eq!(plan.split, FitSplit::LeftOut { comparison: vec![2], stopping: vec![] });
    let ends = |spans: &[Span]| {
        spans.iter().map(|s| (s.run.as_u128(), s.from_sample, s.to_sample)).collect::<Vec<_>>()
    };
    let before = plan.lineage(false);
    assert_eq!(ends(&before.training), [(1, 0, 4500), (2, 0, 4500)]);
    assert_eq!(ends(before.stopping.as_ref().unwrap()), [(1, 4500, 5000), (2, 4500, 5000)]);
    assert_eq!(ends(&before.validation), [(3, 0, 5000)]);
    assert!(!before.validation.iter().any(|span| before.has_seen(span)));
    let after = plan.lineage(true);
    assert_eq!(ends(&after.training), [(1, 0, 5000), (2, 0, 5000), (3, 0, 5000)]);
    assert_eq!((ends(&after.stopping.unwrap()), ends(&after.validation)), (vec![], vec![(3, 0, 5000)]));
    // Every kind leaves the same runs out, so that they can be compared.
    for kind in ["frf", "lstm", "hybrid1"] {
        let other = plan_of(&runs, &format!(r#"{{"kind": "{kind}"}}"#)).unwrap();
        assert_eq!(
            (other.lineage(true).validation, other.split),
            (plan.lineage(true).validation, plan.split.clone())
        );
    }
}

#[test]
fn of_a_single_run_the_last_tenth_compares_and_the_tenth_before_it_stops() {
    let runs = [run(1, Noise, Training, 10_000)];
    let spans = |spans: &[Span]| spans.iter().map(|s| (s.from_sample, s.to_sample)).collect::<Vec<_>>();
    let lineage = plan_of(&runs, r#"{"kind": "lstm"}"#).unwrap().lineage(false);
    assert_eq!(spans(&lineage.training), [(0, 8000)]);
    assert_eq!(spans(&lineage.stopping.unwrap()), [(8000, 8750)], "no window reaches from one to the other");
    assert_eq!(spans(&lineage.validation), [(9000, 10_000)]);
    let lineage = plan_of(&runs, r#"{"kind": "frf"}"#).unwrap().lineage(false);
    assert_eq!((spans(&lineage.training), lineage.stopping), (vec![(0, 9000)], Some(vec![])));
}

#[test]
fn runs_too_short_to_compare_fall_back_to_their_last_tenths_and_say_so() {
    let runs = [run(1, Noise, Training, 10_000), run(2, Noise, Training, 400)];
    let plan = plan_of(&runs, r#"{"kind": "lstm"}"#).unwrap();
    assert_eq!(plan.split, FitSplit::LastTenths);
    assert!(plan.split_reason.unwrap().contains("too little would be left"));
    let short = [run(1, Noise, Training, 400), run(2, Noise, Training, 400)];
    let why = plan_of(&short, r#"{"kind": "frf"}"#).unwrap().split_reason.unwrap();
    assert!(why.contains("400 samples, 512 are needed"), "{why}");
}

#[test]
fn runs_of_the_frf_part_are_not_left_out_and_are_cut_where_they_are_held_out() {
    let linear = |id| tagged(run(id, Noise, Training, 5000), "linear");
    let runs = [run(1, Noise, Training, 5000), run(2, Noise, Training, 5000), linear(3)];
    let request = r#"{"kind": "hybrid2", "frf": {"runs": {"tags": ["linear"]}}}"#;
    let plan = plan_of(&runs, request).unwrap();
    assert_eq!(plan.split, FitSplit::LeftOut { comparison: vec![1], stopping: vec![] });
    let ends = |lineage: Lineage| lineage.frf.iter().map(|s| s.to_sample).collect::<Vec<_>>();
    assert_eq!((ends(plan.lineage(false)), ends(plan.lineage(true))), (vec![4500], vec![5000]));
    assert_eq!((plan.frf_places(), plan.frf_only().count()), (Some(vec![2]), 0));
    // Trained on other runs only, they are whole.
    let request = format!(
        r#"{{"kind": "hybrid2", "runs": ["{}", "{}"], "frf": {{"runs": {{"tags": ["linear"]}}}}}}"#,
        runs[0].id, runs[1].id
    );
    let plan = plan_of(&runs, &request).unwrap();
    assert_eq!(ends(plan.lineage(false)), [5000]);
    assert_eq!((plan.frf_places(), plan.frf_only().count()), (Some(vec![2]), 1));
    assert_eq!(plan_of(&runs[2..], r#"{"kind": "hybrid1"}"#).unwrap().split, FitSplit::LastTenths);
}
