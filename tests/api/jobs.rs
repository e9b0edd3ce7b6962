//! Jobs: lists, events, cancellation, and their state when the service stops.

use serde_json::{Value, json};

use crate::support::{TestApp, bench, noise_csv};

const FITS: &str = "/v1/rigs/bench/fits";

/// A fit that takes longer than any test.
fn endless() -> Value {
    json!({"kind": "lstm", "lstm": {"blocks": [39], "epochs": 1000000, "seeds": [1]}})
}

async fn with_noise() -> TestApp {
    let app = TestApp::start();
    app.rig(&bench()).await;
    app.run("kind=noise", &noise_csv(6000, 11)).await;
    app
}

fn id(job: &Value) -> String {
    job["id"].as_str().expect("an id").to_owned()
}

/// Data and id of each event of a stream.
fn events(text: &str) -> Vec<(u64, Value)> {
    let field = |block: &str, name: &str| {
        let line = block.lines().find_map(|l| l.strip_prefix(name)?.strip_prefix(':'));
        line.map(|l| l.trim_start().to_owned())
    };
    text.split("\n\n")
        .filter(|block| block.contains("data:"))
        .map(|block| {
            assert_eq!(field(block, "event").as_deref(), Some("job"), "{block}");
            let id = field(block, "id").and_then(|i| i.parse().ok()).expect("an id");
            (id, serde_json::from_str(&field(block, "data").expect("data")).expect("JSON"))
        })
        .collect()
}

#[tokio::test]
async fn events_rise_to_the_terminal_state_and_a_client_that_saw_it_gets_no_more() {
    let app = with_noise().await;
    let job = app.post_json(FITS, &json!({"kind": "frf"})).await.expect(202).json();
    let path = format!("/v1/jobs/{}/events", id(&job));
    let stream = app.get(&path).await.expect(200);
    assert_eq!(stream.header("content-type"), "text/event-stream");
    let seen = events(stream.text());
    let (last, end) = seen.last().expect("at least one event");
    assert_eq!(end["state"], "succeeded", "{end}");
    assert!(seen.windows(2).all(|pair| pair[0].0 < pair[1].0), "ids rise");
    let contract = crate::support::Contract::get();
    for (_, job) in &seen {
        contract.validate("event", "/components/schemas/Job", job);
    }
    let again = app.call("GET", &path).header("last-event-id", &last.to_string()).send().await.expect(200);
    assert_eq!(events(again.text()), [], "it has seen the end");
    let earlier = app.call("GET", &path).header("last-event-id", "0").send().await.expect(200);
    assert_eq!(events(earlier.text()).last().map(|e| e.0), Some(*last), "the present state is told again");
}

#[tokio::test]
async fn a_running_job_is_cancelled_and_cancelling_again_changes_nothing() {
    let app = with_noise().await;
    let job = app.post_json(FITS, &endless()).await.expect(202);
    let path = job.header("location").to_owned();
    let waiting = app.post_json(FITS, &endless()).await.expect(202).json();
    let cancelled = app.post(&format!("/v1/jobs/{}/cancel", id(&waiting))).await.expect(202).json();
    assert_eq!(cancelled["state"], "cancelled", "a queued job ends at once");
    app.post(&format!("{path}/cancel")).await.expect(202);
    let ended = app.finished(&id(&job.json())).await;
    assert_eq!((&ended["state"], &ended["result"]), (&json!("cancelled"), &json!(null)));
    let again = app.post(&format!("{path}/cancel")).await.expect(202).json();
    assert_eq!(again, ended);
    assert_eq!(app.get("/v1/rigs/bench/models").await.json()["items"], json!([]));
    app.post("/v1/jobs/0197f1a0-0000-7000-8000-000000000000/cancel").await.problem(404, "job.not_found");
}

#[tokio::test]
async fn lists_are_filtered_by_rig_state_and_kind() {
    let app = with_noise().await;
    let job = app.post_json(FITS, &json!({"kind": "frf"})).await.expect(202).json();
    app.finished(&id(&job)).await;
    for (query, count) in [
        ("", 1),
        ("?rig=bench&state=succeeded&kind=fit", 1),
        ("?state=queued", 0),
        ("?kind=study", 0),
        ("?rig=other", 0),
    ] {
        let found = app.get(&format!("/v1/jobs{query}")).await.expect(200).json();
        assert_eq!(found["items"].as_array().map(Vec::len), Some(count), "{query}");
    }
}

#[tokio::test]
async fn a_job_that_the_stop_interrupted_runs_again_after_the_start() {
    let app = with_noise().await;
    let job = id(&app.post_json(FITS, &endless()).await.expect(202).json());
    let path = format!("/v1/jobs/{job}");
    while app.get(&path).await.json()["state"] != "running" {
        tokio::time::sleep(std::time::Duration::from_millis(20)).await;
    }
    let app = app.restart();
    for _ in 0..200 {
        if app.get(&path).await.expect(200).json()["state"] == "running" {
            break;
        }
        tokio::time::sleep(std::time::Duration::from_millis(50)).await;
    }
    assert_eq!(app.get(&path).await.json()["state"], "running");
    app.post(&format!("{path}/cancel")).await.expect(202);
    assert_eq!(app.finished(&job).await["state"], "cancelled");
}

#[tokio::test]
async fn the_loss_curve_of_a_fit_grows_with_its_epochs_and_stays_after_its_end() {
    let app = with_noise().await;
    app.run("kind=noise", &noise_csv(3000, 12)).await;
    let lstm = json!({"blocks": [4], "window_len": 32, "epochs": 4, "seeds": [5, 6]});
    let job = id(&app.post_json(FITS, &json!({"kind": "lstm", "lstm": lstm})).await.expect(202).json());
    let ended = app.finished(&job).await;
    let curves = app.get(&format!("/v1/jobs/{job}/losses")).await.expect(200).json()["curves"].clone();
    let curves = curves.as_array().expect("curves");
    let seeds: Vec<&Value> = curves.iter().map(|curve| &curve["seed"]).collect();
    assert_eq!(seeds[..2], [&json!(5), &json!(6)], "{curves:?}");
    let href = ended["result"]["href"].as_str().expect("a model");
    let report = app.get(&format!("{href}/report")).await.expect(200).json();
    for (curve, seed) in curves.iter().zip(report["training"]["seeds"].as_array().expect("seeds")) {
        for part in ["epochs", "training", "stopping"] {
            assert_eq!(curve[part], seed[part], "as in the report: {part}");
        }
    }
    assert_eq!((curves.len(), &curves[2]["stopping"]), (3, &Value::Null), "the winner on all runs");

    let lstm = json!({"blocks": [39], "epochs": 30000, "validate_every": 1, "seeds": [1]});
    let endless = id(&app.post_json(FITS, &json!({"kind": "lstm", "lstm": lstm})).await.expect(202).json());
    let path = format!("/v1/jobs/{endless}/losses");
    while app.get(&path).await.expect(200).json()["curves"] == json!([]) {
        tokio::time::sleep(std::time::Duration::from_millis(50)).await;
    }
    let page = format!("/jobs/{endless}");
    let html = app.call("GET", &page).header("accept", "text/html").send().await.expect(200);
    assert!(html.text().contains("figure=losses") && html.text().contains("data-late"), "{}", html.text());
    let part = app.get(&format!("{page}?figure=losses")).await.expect(200);
    assert!(part.text().contains("seed 1 training") && part.text().contains("seed 1 stopping"));
    let csv = app.get(&format!("{page}?figure=losses&as=csv")).await.expect(200);
    assert!(csv.text().starts_with("Epoch,seed 1 training,seed 1 stopping\r\n"), "{}", csv.text());
    app.post(&format!("/v1/jobs/{endless}/cancel")).await.expect(202);
    app.finished(&endless).await;
    assert_ne!(app.get(&path).await.expect(200).json()["curves"], json!([]), "they stay after the end");
    app.get("/v1/jobs/0197f1a0-0000-7000-8000-000000000000/losses").await.problem(404, "job.not_found");
}
