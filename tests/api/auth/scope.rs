//! Tokens that are limited to some rigs: other rigs look as if they did not exist.

use futures::StreamExt;
use serde_json::{Value, json};

use crate::support::{Reply, TestApp, bench, gain_weights, noise_csv};

const NOTHING: &str = "0197f1a0-0000-7000-8000-00000000000";

/// The bench with a run, a model and a finished job; a token of each role for another rig. Returns the ids of
/// the job and the run.
async fn two_labs() -> (TestApp, Vec<String>, String, String) {
    let mut app = TestApp::start();
    app.bench_with_model().await;
    let run = app.run("kind=noise", &noise_csv(3000, 7)).await;
    let job = app.post_json("/v1/rigs/bench/fits", &json!({"kind": "frf"})).await.expect(202).json();
    let [job, run] = [job, run].map(|thing| thing["id"].as_str().expect("an id").to_owned());
    app.finished(&job).await;
    let mut other = bench();
    other["id"] = json!("other");
    app.rig(&other).await;
    app.close_doors().await;
    let mut tokens = Vec::new();
    for role in ["reader", "operator", "admin"] {
        tokens.push(app.token(&json!({"role": role, "rigs": ["other"]})).await.0);
    }
    (app, tokens, job, run)
}

/// All of an answer but the fields that differ between any two answers.
fn shown(reply: &Reply) -> (u16, Value, Vec<(String, String)>) {
    let mut body: Value = serde_json::from_slice(&reply.bytes).unwrap_or_default();
    if let Some(body) = body.as_object_mut() {
        body.remove("request_id");
    }
    let of_its_own = ["x-request-id", "date", "content-length"];
    let mut headers: Vec<(String, String)> = reply
        .headers
        .iter()
        .filter(|(name, _)| !of_its_own.contains(&name.as_str()))
        .map(|(name, value)| (name.to_string(), value.to_str().expect("text").to_owned()))
        .collect();
    headers.sort();
    (reply.status, body, headers)
}

#[tokio::test]
async fn foreign_and_unknown_ids_look_alike() {
    let (app, tokens, job, run) = two_labs().await;
    let bodies = [("application/json", "{}"), ("text/csv", "u,y\n1,2\n"), ("application/json", "[[")];
    let rest = [
        "",
        "/runs",
        "/models",
        "/models/1",
        "/models/1/weights",
        "/models/1/frf",
        "/models/1/report",
        "/models/x",
        "/active-model",
        "/drift",
        "/predict",
        "/fits",
        "/diagnoses",
        "/diagnoses/x",
        "/iterations",
        "/iterations/x",
        "/evaluations",
        "/evaluations/x",
        "/studies",
        "/studies/x",
        &format!("/runs/{run}"),
        &format!("/runs/{run}/data"),
        &format!("/runs/{run}?kind=nonsense"),
    ];
    let rest = rest.map(|rest| format!("/v1/rigs/{{rig}}{rest}"));
    let inference = ["", "/config", "/ready", "/infer"];
    let inference = ["", "/versions/1", "/versions/x"]
        .into_iter()
        .flat_map(|version| inference.map(|rest| format!("/v2/models/{{rig}}{version}{rest}")));
    let paths: Vec<String> = rest.into_iter().chain(inference).collect();
    let mut compared = 0;
    for token in &tokens {
        for path in &paths {
            for method in ["GET", "POST", "PUT", "PATCH", "DELETE"] {
                for (media_type, body) in bodies {
                    let ask = async |rig: &str| {
                        let call = app.call_as(Some(token), method, &path.replace("{rig}", rig));
                        let call = call.header("if-match", "*").body(media_type, body);
                        shown(&call.send().await)
                    };
                    let (mut foreign, unknown) = (ask("bench").await, ask("bonch").await);
                    assert!(foreign.0 >= 400, "{method} {path}: {foreign:?}");
                    let text = foreign.1.to_string().replace("bench", "bonch");
                    foreign.1 = serde_json::from_str(&text).expect("JSON");
                    assert_eq!(foreign, unknown, "{method} {path}");
                    compared += 1;
                }
            }
        }
        let ask = async |job: &str, rest: &str, method: &str| {
            let call = app.call_as(Some(token), method, &format!("/v1/jobs/{job}{rest}"));
            let mut shown = shown(&call.send().await);
            shown.1 = serde_json::from_str(&shown.1.to_string().replace(job, "JOB")).expect("JSON");
            shown
        };
        for (rest, method) in [("", "GET"), ("/losses", "GET"), ("/events", "GET"), ("/cancel", "POST")] {
            let foreign = ask(&job, rest, method).await;
            assert!(foreign.0 == 404 || foreign.0 == 403, "{foreign:?}");
            for i in 0..10 {
                assert_eq!(ask(&format!("{NOTHING}{i}"), rest, method).await, foreign, "{rest}");
                compared += 1;
            }
        }
    }
    compared += probe(&app, &tokens[2], &job).await;
    println!("{compared} probes, 0 told foreign from unknown");
    let job = app.get(&format!("/v1/jobs/{job}")).await.expect(200).json();
    assert_eq!(job["state"], "succeeded", "the admin sees it");
    app.get("/v1/rigs/bench").await.expect(200);
}

/// Requests many ids that do not exist, and two that belong to another rig; returns the number of requests.
async fn probe(app: &TestApp, token: &str, job: &str) -> usize {
    let client = reqwest::Client::new();
    let ask = async |kind: &str, id: String| {
        let request = client.get(format!("http://{}/v1/{kind}/{id}", app.address())).bearer_auth(token);
        let answer = request.send().await.expect("an answer");
        assert_eq!(answer.status(), 404, "{kind}/{id}");
        let mut body: Value = answer.json().await.expect("JSON");
        body.as_object_mut().expect("an object").remove("request_id");
        body.to_string().replace(&id, "ID")
    };
    let mut probes = 0;
    for (kind, foreign) in [("rigs", "bench"), ("jobs", job)] {
        let known = ask(kind, foreign.to_owned()).await;
        let ids = (0..5000_u128).map(|i| match kind {
            "rigs" => format!("rig-{i}"),
            _ => uuid::Uuid::from_u128(0x0197_f1a0_0000_7000_8000_0000_0000_0000 + i * i).to_string(),
        });
        let answers: Vec<String> =
            futures::stream::iter(ids).map(|id| ask(kind, id)).buffer_unordered(16).collect().await;
        assert!(answers.iter().all(|answer| *answer == known), "{kind}");
        probes += answers.len();
    }
    probes
}

#[tokio::test]
async fn lists_show_what_is_in_reach_and_cursors_do_not_help() {
    let (app, tokens, _, _) = two_labs().await;
    for token in &tokens {
        let list = async |path: &str| app.call_as(Some(token), "GET", path).send().await.expect(200).json();
        for path in ["/v1/rigs", "/v1/rigs?limit=1", "/v1/rigs?cursor=bench"] {
            let rigs = list(path).await;
            assert_eq!(
                (&rigs["items"][0]["id"], &rigs["items"][1]),
                (&json!("other"), &Value::Null),
                "{path}"
            );
            assert_eq!(rigs["next"], Value::Null);
        }
        assert_eq!(list("/v1/rigs?cursor=other").await["items"], json!([]));
        for path in ["/v1/jobs", "/v1/jobs?rig=bench", "/v1/jobs?rig=bonch", "/v1/jobs?state=succeeded"] {
            assert_eq!(list(path).await, json!({"items": [], "next": null}), "{path}");
        }
    }
    assert_eq!(app.get("/v1/jobs").await.expect(200).json()["items"].as_array().map(Vec::len), Some(1));
}

#[tokio::test]
async fn a_token_of_some_rigs_works_there_and_makes_no_others() {
    let (app, tokens, _, run) = two_labs().await;
    let [reader, operator, admin] = &tokens[..] else { panic!("three tokens") };
    let call = |token: &str, method: &str, path: &str| app.call_as(Some(token), method, path);
    // Within the scope.
    call(admin, "DELETE", "/v1/rigs/other").send().await.expect(204);
    call(admin, "GET", "/v1/rigs/other").send().await.problem(404, "rig.not_found");
    let mut draft = bench();
    draft["id"] = json!("other");
    call(reader, "POST", "/v1/rigs").json(&draft).send().await.problem(403, "token.role");
    call(operator, "POST", "/v1/rigs").json(&draft).send().await.expect(201);
    let weights = gain_weights(&["u"], &["y"], 3.0);
    let import = call(admin, "POST", "/v1/rigs/other/models").body("application/octet-stream", weights);
    import.send().await.expect(201);
    // A run of the other rig is not found under this one.
    let drive = json!({"model": 1, "drive": {"run": run}});
    call(reader, "POST", "/v1/rigs/other/predict").json(&drive).send().await.problem(404, "run.not_found");
    let drive = json!({"model": 1, "drive": {"sample_rate_hz": 100.0, "channels": {"u": [0.0, 1.0]}}});
    call(reader, "POST", "/v1/rigs/other/predict").json(&drive).send().await.expect(200);
    // Beyond the scope: the same for a rig that exists and one that does not.
    for id in ["bench", "new"] {
        draft["id"] = json!(id);
        let problem = call(admin, "POST", "/v1/rigs").json(&draft).send().await.problem(403, "token.scope");
        assert_eq!(problem["errors"][0]["pointer"], "/id");
    }
    for draft in [json!({"role": "reader", "rigs": ["other"]}), json!({"role": "admin"})] {
        call(admin, "POST", "/v1/tokens").json(&draft).send().await.problem(403, "token.scope");
    }
    call(admin, "GET", "/v1/tokens").send().await.problem(403, "token.scope");
    call(reader, "GET", "/metrics").send().await.problem(403, "token.scope");
}

#[tokio::test]
async fn readiness_names_degraded_rigs_to_those_who_may_see_them() {
    let (mut app, tokens, _, _) = two_labs().await;
    for weights in app.files() {
        let mut permissions = std::fs::metadata(&weights).expect("there").permissions();
        #[expect(
            clippy::permissions_set_readonly_false,
            reason = "a file of the test's own, for its own user"
        )]
        permissions.set_readonly(false);
        std::fs::set_permissions(&weights, permissions).expect("allowed");
        std::fs::write(&weights, b"damaged").expect("written");
    }
    app = app.restart();
    let drive = json!({"drive": {"sample_rate_hz": 100.0, "channels": {"u": [0.0]}}});
    app.post_json("/v1/rigs/bench/predict", &drive).await.problem(500, "store.damaged");
    let named = async |token: Option<&str>| {
        let ready = app.call_as(token, "GET", "/readyz").send().await.expect(200).json();
        assert_eq!(ready["degraded_models"], 1);
        ready["degraded"].as_array().expect("a list").len()
    };
    assert_eq!(named(None).await, 0);
    assert_eq!(named(Some("garbage")).await, 0);
    assert_eq!(named(Some(&tokens[2])).await, 0);
    let (reader, _) = app.token(&json!({"role": "reader", "rigs": ["bench"]})).await;
    assert_eq!(named(Some(&reader)).await, 1);
    assert_eq!(app.get("/readyz").await.expect(200).json()["degraded"][0]["rig"], "bench");
}
