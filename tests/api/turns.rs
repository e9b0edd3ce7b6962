//! Turns of jobs between tokens, and the limit of a token's waiting jobs.

use serde_json::{Value, json};

use crate::support::{TestApp, bench, noise_csv};

const FITS: &str = "/v1/rigs/bench/fits";

/// A fit that takes longer than any test.
fn endless() -> Value {
    json!({"kind": "lstm", "lstm": {"blocks": [39], "epochs": 1000000, "seeds": [1]}})
}

fn frf() -> Value {
    json!({"kind": "frf"})
}

/// A service with a rig, a run and the tokens of two operators.
async fn two_operators(app: &mut TestApp) -> [String; 2] {
    app.close_doors().await;
    app.rig(&bench()).await;
    app.run("kind=noise", &noise_csv(3000, 11)).await;
    let operator = json!({"role": "operator"});
    [app.token(&operator).await.0, app.token(&operator).await.0]
}

/// Asks for a fit; returns the job's id.
async fn fit(app: &TestApp, token: &str, request: &Value) -> String {
    let job = app.call_as(Some(token), "POST", FITS).json(request).send().await.expect(202).json();
    job["id"].as_str().expect("an id").to_owned()
}

#[tokio::test]
async fn a_tokens_only_fit_starts_next_however_many_another_token_has_queued() {
    let mut app = TestApp::start();
    let [many, one] = two_operators(&mut app).await;
    let at_work = fit(&app, &many, &endless()).await;
    let mut others = Vec::new();
    for _ in 0..30 {
        others.push(fit(&app, &many, &frf()).await);
    }
    let only = fit(&app, &one, &frf()).await;
    app.post(&format!("/v1/jobs/{at_work}/cancel")).await.expect(202);
    let started =
        async |job: &str| app.finished(job).await["started_at"].as_str().expect("a start").to_owned();
    let only = started(&only).await;
    for other in others {
        assert!(only < started(&other).await, "it starts next");
    }
}

#[tokio::test]
async fn a_token_with_too_many_waiting_jobs_learns_its_limit_and_other_tokens_are_not_held_up() {
    let mut app = TestApp::start_as(|mut config| {
        config.jobs.max_waiting = 2;
        config
    });
    let [many, one] = two_operators(&mut app).await;
    let mut jobs = vec![fit(&app, &many, &endless()).await];
    while app.get(&format!("/v1/jobs/{}", jobs[0])).await.json()["state"] != "running" {
        tokio::time::sleep(std::time::Duration::from_millis(20)).await;
    }
    for _ in 0..2 {
        jobs.push(fit(&app, &many, &frf()).await);
    }
    let ask = async |path: &str, request: &Value| {
        let refused = app.call_as(Some(&many), "POST", path).json(request).send().await;
        assert_eq!(refused.header("retry-after"), "30");
        refused.problem(429, "job.too_many_waiting")
    };
    let problem = ask(FITS, &frf()).await;
    assert_eq!(problem["errors"][0]["limit"], "at most 2 waiting jobs of one token");
    jobs.push(fit(&app, &one, &frf()).await);
    app.post(&format!("/v1/jobs/{}/cancel", jobs[0])).await.expect(202);
    for job in &jobs {
        app.finished(job).await;
    }
    jobs.push(fit(&app, &many, &frf()).await);
    assert_eq!(app.finished(jobs.last().expect("a job")).await["state"], "succeeded");
}
