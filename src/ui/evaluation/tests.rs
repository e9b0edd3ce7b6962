use serde_json::{Value, json};

use super::page;
use crate::domain::StoredEvaluation;
use crate::domain::evaluation::{EvaluationReport, EvaluationSummary};

/// A report on one channel: version 1 is the baseline and has no damage ratio.
fn report() -> Value {
    let average = |rms: f64, ratio: Value| {
        let channel = json!({"rms": rms, "rms_ac": rms, "psd_rms": rms, "damage_ratio": ratio});
        let group = json!({"rms": rms, "rms_ac": rms, "psd_rms": rms, "damage_ratio": ratio, "multi_rain": null,
                           "reasons": {"multi_rain": "not_a_vector"}});
        (json!({"<y>": channel}), json!({"force": group}))
    };
    let row = |model: u32, rms: f64, ratio: Value| {
        let (channels, groups) = average(rms, ratio);
        json!({"class": "service", "model": model, "runs": 1, "duration_s": 60.0, "left_out": 0, "channels": channels,
               "groups": groups, "inside": 0.5, "worst_channel": {"channel": "<y>", "rms": rms},
               "worst_span": {"run": "0197f1a0-0000-7000-8000-000000000001", "from_s": 1.0, "to_s": 2.0, "channel": "<y>", "rms": 0.9},
               "spectra": {"segment_len": 4, "freq_hz": [1.0, 2.0], "channels": {"<y>": {"predicted": [1.0, 0.0], "target": [2.0, 1.0]}}}})
    };
    let model = |version: u32, baseline: bool| {
        json!({"version": version, "kind": "frf", "sha256": "ab", "origin": "fit", "inputs": ["u"], "outputs": ["<y>"],
               "preprocess": {}, "baseline": baseline})
    };
    json!({
        "models": [model(2, false), model(1, true)], "channels": [{"name": "<y>", "unit": "kN"}],
        "groups": [{"name": "force", "channels": ["<y>"]}],
        "runs": [{"id": "0197f1a0-0000-7000-8000-000000000001", "name": "load & more", "kind": "service", "split": "test",
                  "duration_s": 60.0, "classes": ["service"]}],
        "table": [row(2, 0.034, json!(1.2)), row(1, 0.2, Value::Null)],
        "results": [], "omitted": [], "warnings": ["mind <this>"],
    })
}

fn stored() -> StoredEvaluation {
    let outline = json!({"models": [2, 1], "baseline": 1, "classes": ["service"], "runs": 1});
    StoredEvaluation {
        summary: EvaluationSummary {
            id: uuid_of(1),
            rig: "bench".parse().unwrap(),
            created_at: "2026-03-01T12:00:00Z".parse().unwrap(),
            job: uuid_of(2),
            outline: serde_json::from_value(outline).unwrap(),
        },
        request: serde_json::from_str("{}").unwrap(),
        elapsed_s: 1.0,
        report: String::new(),
    }
}

fn uuid_of(n: u128) -> crate::domain::EvaluationId {
    crate::domain::EvaluationId::from_u128(n)
}

#[test]
fn the_page_names_the_best_model_marks_absent_figures_and_escapes_names() {
    let report: EvaluationReport = serde_json::from_value(report()).unwrap();
    let html = page("Bench & co", &stored(), &report);
    assert!(html.contains("service: version 2 (frf), 3.4\u{a0}% over one channel"), "{html}");
    assert!(
        html.contains("Bench &amp; co") && html.contains("&lt;y&gt;") && html.contains("mind &lt;this&gt;")
    );
    assert!(!html.contains("<y>") && !html.contains("<script") && !html.contains("NaN"));
    assert!(html.contains("<td>–</td>"), "a figure that is absent: {html}");
    assert!(html.contains("of load &amp; more (90\u{a0}%"), "{html}");
    assert_eq!(html.matches("<path class=\"line after\"").count(), 1, "the first model's spectrum");
    assert_eq!(html.matches("<path class=\"line before\"").count(), 1, "the baseline's spectrum");
}

#[test]
fn a_class_without_runs_that_count_has_no_plots() {
    let mut report = report();
    for row in report["table"].as_array_mut().unwrap() {
        row["runs"] = json!(0);
        row["spectra"] = Value::Null;
        row["worst_span"] = Value::Null;
        row["worst_channel"] = Value::Null;
    }
    let report: EvaluationReport = serde_json::from_value(report).unwrap();
    let html = page("Bench", &stored(), &report);
    assert!(html.contains("service: no run counts") && !html.contains("<svg"), "{html}");
}
