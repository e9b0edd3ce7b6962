//! Drift over HTTP.

use std::time::Duration;

use serde_json::{Value, json};

use crate::support::{TestApp, bench, noise, noise_csv};

const DRIFT: &str = "/v1/rigs/bench/drift";

/// `y = gain u` with a little noise of its own.
fn rig(n: usize, seed: u64, gain: f64) -> String {
    let sensor = noise(n, seed + 1000);
    let rows = noise(n, seed).into_iter().zip(sensor);
    let rows = rows.map(|(u, e)| format!("{u},{}\n", gain * u + 0.02 * e));
    std::iter::once("u,y\n".to_owned()).chain(rows).collect()
}

/// The answer once nothing waits.
async fn settled(app: &TestApp) -> Value {
    for _ in 0..600 {
        let drift = app.get(DRIFT).await.expect(200).json();
        if drift["pending"] == 0 {
            return drift;
        }
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    panic!("runs still wait");
}

async fn fit(app: &TestApp) {
    let fit = json!({"kind": "frf", "frf": {"segment_len": 256}});
    let job = app.post_json("/v1/rigs/bench/fits", &fit).await.expect(202).json();
    app.finished(job["id"].as_str().expect("an id")).await;
}

async fn ratio(app: &TestApp) -> Option<f64> {
    let text = app.get("/metrics").await.expect(200).text().to_owned();
    let line = text.lines().find(|line| line.starts_with("rigcast_model_error_ratio{rig=\"bench\"}"));
    line.map(|line| line.rsplit(' ').next().and_then(|n| n.parse().ok()).expect("a number"))
}

#[tokio::test]
async fn a_rig_that_changes_is_flagged_by_its_first_run_and_the_diagnosis_is_named() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    let nothing = app.get(DRIFT).await.expect(200).json();
    assert!(nothing["model"].is_null() && nothing["runs"] == json!([]), "{nothing}");
    app.run("kind=noise", &rig(6000, 1, 2.0)).await;
    let held_out = app.run("kind=noise", &rig(3000, 2, 2.0)).await;
    fit(&app).await;
    for seed in 3..8 {
        app.run("kind=noise&split=test", &rig(3000, seed, 2.0)).await;
    }
    let drift = settled(&app).await;
    assert_eq!((drift["runs"].as_array().map(Vec::len), &drift["past"]), (Some(5), &json!(false)), "{drift}");
    assert!(drift["diagnosis"].is_null() && drift["no_limit"].is_null(), "{drift}");
    let limit = &drift["limits"][0];
    assert_eq!(
        (&limit["kind"], &limit["basis"], &limit["factor"]),
        (&json!("noise"), &json!("same_kind"), &json!(5.0))
    );
    let omitted = drift["omitted"].as_array().expect("omitted");
    assert!(omitted.iter().all(|run| run["reason"] == "training"), "fitted again on all: {omitted:?}");
    assert!(omitted.iter().any(|run| run["run"] == held_out["id"]));
    assert!(ratio(&app).await.is_some_and(|ratio| (0.1..1.0).contains(&ratio)));

    let changed = app.run("kind=noise&split=test&name=worn", &rig(3000, 9, 2.4)).await;
    let drift = settled(&app).await;
    let newest = drift["runs"].as_array().and_then(|runs| runs.last()).expect("runs");
    assert_eq!(
        (&newest["run"], &newest["past"], &drift["past"]),
        (&changed["id"], &json!(true), &json!(true))
    );
    let error = &newest["channels"]["y"];
    let rms = error["rms"].as_f64().expect("an error");
    assert!((rms - 0.4 / 2.4).abs() < 0.01, "{rms}");
    assert!(error["ratio"].as_f64() > Some(2.0), "{error}");
    assert_eq!(ratio(&app).await, drift["ratio"].as_f64());
    let diagnosis = &drift["diagnosis"];
    assert_eq!(diagnosis["body"], json!({"model": 1, "runs": [changed["id"]]}));
    let job =
        app.post_json(diagnosis["href"].as_str().expect("a path"), &diagnosis["body"]).await.expect(202);
    app.post(&format!("{}/cancel", job.header("location"))).await.expect(202);
    let few = app.get(&format!("{DRIFT}?limit=2")).await.expect(200).json();
    assert_eq!((few["runs"].as_array().map(Vec::len), &few["earlier"]), (Some(2), &json!(4)));
    let page = app.get("/rigs/bench/drift").await.expect(200);
    assert!(page.text().contains("Past the limit") && page.text().contains("<svg"), "{}", page.text());

    // What was judged stays, each run once, after a restart too.
    let app = app.restart();
    let again = settled(&app).await;
    assert_eq!(again["runs"], drift["runs"]);
}

#[tokio::test]
async fn limits_rest_on_other_kinds_where_none_of_the_kind_was_held_out_and_on_nothing_for_imports() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    app.run("kind=noise", &rig(6000, 1, 2.0)).await;
    app.run("kind=noise", &rig(3000, 2, 2.0)).await;
    fit(&app).await;
    app.run("kind=service&split=test", &rig(3000, 3, 2.0)).await;
    // Three times the drive of the training.
    let far: String = rig(3000, 4, 2.0)
        .lines()
        .map(|line| {
            match line
                .split_once(',')
                .and_then(|(u, y)| Some((u.parse::<f64>().ok()?, y.parse::<f64>().ok()?)))
            {
                Some((u, y)) => format!("{},{}\n", 3.0 * u, 3.0 * y),
                None => format!("{line}\n"),
            }
        })
        .collect();
    app.run("kind=noise&split=test", &far).await;
    app.run("kind=noise&split=test", "u\n0.1\n0.2\n").await;
    let drift = settled(&app).await;
    let service = &drift["runs"][0];
    assert_eq!((&service["basis"], &service["past"]), (&json!("other_kinds"), &json!(false)), "{drift}");
    let of_service =
        drift["limits"].as_array().expect("limits").iter().find(|limit| limit["kind"] == "service");
    assert_eq!(of_service.map(|limit| &limit["factor"]), Some(&json!(10.0)));
    let outside = &drift["runs"][1];
    assert_eq!((&outside["no_limit"], &outside["ratio"]), (&json!("outside"), &Value::Null));
    assert!(outside["inside"].as_f64() < Some(0.9), "{outside}");
    let omitted = drift["omitted"].as_array().expect("omitted");
    assert!(omitted.iter().any(|run| run["reason"] == "missing_channels"), "{omitted:?}");

    app.activate("bench", crate::support::gain_weights(&["u"], &["y"], 2.0)).await;
    let drift = settled(&app).await;
    assert_eq!((&drift["no_limit"], &drift["limits"]), (&json!("no_held_out_runs"), &json!([])));
    assert_eq!(drift["runs"].as_array().map(Vec::len), Some(4), "every run with both channels: {drift}");
    assert!(
        drift["runs"].as_array().expect("runs").iter().all(|run| run["channels"]["y"]["rms"].is_number())
    );
    assert_eq!(ratio(&app).await, None, "nothing is held against a limit");
}

#[tokio::test]
async fn a_run_of_another_kind_is_judged_anew_and_a_second_upload_is_not() {
    let app = TestApp::start();
    app.bench_with_model().await;
    let run = app.run("kind=noise&split=test", &noise_csv(500, 1)).await;
    app.run("kind=noise&split=test", &noise_csv(500, 1)).await;
    let drift = settled(&app).await;
    assert_eq!(
        (&drift["runs"][0]["kind"], &drift["omitted"][0]["reason"]),
        (&json!("noise"), &json!("duplicate"))
    );
    let path = format!("/v1/rigs/bench/runs/{}", run["id"].as_str().expect("an id"));
    app.call("PATCH", &path).json(&json!({"kind": "service"})).send().await.expect(200);
    let drift = settled(&app).await;
    assert_eq!(drift["runs"][0]["kind"], "service");
    app.delete(&path).await.expect(204);
    let drift = settled(&app).await;
    assert_eq!((drift["runs"].as_array().map(Vec::len), &drift["omitted"]), (Some(1), &json!([])), "{drift}");
}
