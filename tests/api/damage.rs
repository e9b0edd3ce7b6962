//! Damage and counts of signals that are sent.

use serde_json::{Value, json};

use crate::support::TestApp;

/// The history of ASTM E1049-85, figure 6.
const ASTM: [f64; 9] = [-2.0, 1.0, -3.0, 5.0, -1.0, 3.0, -4.0, 4.0, -2.0];

fn signals(channels: Value) -> Value {
    json!({"sample_rate_hz": 100.0, "channels": channels})
}

#[tokio::test]
async fn a_published_history_gets_its_published_counts_and_damage() {
    let app = TestApp::start();
    let request = json!({
        "predicted": signals(json!({"a": ASTM})),
        "damage": {"slope": 1, "constant": 1.0, "residue": "half"},
        "classes": {"count": 10, "lower": -4.0, "upper": 6.0},
    });
    let answer = app.post_json("/v1/damage", &request).await.expect(200).json();
    // Ranges 3: 0.5, 4: 1.5, 6: 0.5, 8: 1.0, 9: 0.5 (section 5.4.4); amplitude is half of the range.
    let damage = answer["damage"]["channels"]["a"]["predicted"].as_f64().expect("a figure");
    assert!((damage - (1.5 + 6.0 + 3.0 + 8.0 + 4.5) / 2.0).abs() < 1e-12, "{damage}");
    let counts = &answer["counts"]["channels"]["a"]["predicted"];
    assert_eq!(counts["range_pair"]["cycles"], json!([0.0, 0.0, 0.0, 0.5, 1.5, 0.0, 0.5, 0.0, 1.0, 0.5]));
    assert_eq!(answer["counts"]["residue"], "half");
    assert_eq!(answer["damage"]["settings"]["slope"], json!(1.0));
}

#[tokio::test]
async fn targets_give_ratios_and_groups_give_multi_rain() {
    let app = TestApp::start();
    let zeros = vec![0.0; 9];
    let double: Vec<f64> = ASTM.iter().map(|v| 2.0 * v).collect();
    let request = json!({
        "predicted": signals(json!({"x": double, "y": double, "z": double, "still": zeros})),
        "target": signals(json!({"x": ASTM, "y": ASTM, "z": ASTM, "still": zeros})),
        "groups": {"force": ["x", "y", "z"]},
    });
    let answer = app.post_json("/v1/damage", &request).await.expect(200).json();
    let close = |value: &Value, expected: f64| {
        let found = value.as_f64().expect("a ratio");
        assert!((found / expected - 1.0).abs() < 1e-9, "{found}, expected {expected}");
    };
    close(&answer["damage"]["channels"]["x"]["ratio"], 32.0);
    close(&answer["damage"]["groups"]["force"]["ratio"], 32.0);
    let still = &answer["damage"]["channels"]["still"];
    assert_eq!((&still["ratio"], &still["reason"]), (&json!(null), &json!("target_damage_zero")));
    assert!(answer["counts"]["channels"]["x"]["target"].is_object());
}

#[tokio::test]
async fn signals_that_make_no_sense_are_refused_by_name() {
    let app = TestApp::start();
    let refused = async |request: Value, code: &str| {
        app.post_json("/v1/damage", &request).await.problem(422, code)["errors"][0].clone()
    };
    let predicted = signals(json!({"a": [0.0, 1.0], "b": [0.0, 1.0]}));
    let place =
        refused(json!({"predicted": signals(json!({"a": [0.0], "b": []}))}), "signal.unequal_lengths").await;
    assert_eq!((&place["channel"], &place["pointer"]), (&json!("b"), &json!("/predicted/channels")));
    refused(json!({"predicted": signals(json!({}))}), "signal.channel_count").await;
    refused(json!({"predicted": signals(json!({"a": []}))}), "signal.too_short").await;
    let place =
        refused(json!({"predicted": predicted, "groups": {"g": ["a", "b", "c"]}}), "damage.unknown_channel")
            .await;
    assert_eq!((&place["channel"], &place["pointer"]), (&json!("c"), &json!("/groups/g/2")));
    let place = refused(
        json!({"predicted": predicted, "target": signals(json!({"c": [0.0, 1.0]}))}),
        "damage.unknown_channel",
    )
    .await;
    assert_eq!(place["channel"], "c");
    let short = signals(json!({"b": [0.0]}));
    let place = refused(json!({"predicted": predicted, "target": short}), "signal.unequal_lengths").await;
    assert_eq!(place["channel"], "b");
    let mut fast = predicted.clone();
    fast["sample_rate_hz"] = json!(200.0);
    refused(json!({"predicted": predicted, "target": fast}), "damage.sample_rate").await;
    let place =
        refused(json!({"predicted": predicted, "classes": {"count": 0}}), "setting.out_of_range").await;
    assert_eq!(place["pointer"], "/classes/count");
    let huge = signals(json!({"a": [0.0, 1e200]}));
    let place = refused(json!({"predicted": huge}), "result.non_finite").await;
    assert_eq!(place["channel"], "a");
    refused(json!({"predicted": predicted, "damage": {"slop": 5}}), "body.unknown_field").await;
    refused(json!({"predicted": predicted, "groups": {"g": ["a", "b"]}}), "body.invalid_value").await;
    let twice = r#"{"predicted": {"sample_rate_hz": 1, "channels": {"a": [1], "a": [1]}}}"#;
    let problem =
        app.post_file("/v1/damage", "application/json", twice).await.problem(422, "body.invalid_value");
    assert_eq!(problem["errors"][0]["pointer"], "/predicted/channels/a", "{problem}");
}
