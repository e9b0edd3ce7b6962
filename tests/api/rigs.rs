//! Rigs: created, listed, changed under their ETag, deleted.

use serde_json::json;

use crate::support::{TestApp, bench, noise_csv, triple};

#[tokio::test]
async fn a_rig_comes_back_as_it_was_created_with_location_and_etag() {
    let app = TestApp::start();
    let mut draft = bench();
    draft["fit_policy"] = json!({"min_total_s": 60.0, "fits": [{"kind": "frf"}, {"kind": "hybrid2", "lstm": {"blocks": [39]}}]});
    let created = app.post_json("/v1/rigs", &draft).await.expect(201);
    assert_eq!(created.header("location"), "/v1/rigs/bench");
    let shown = app.get("/v1/rigs/bench").await.expect(200);
    assert_eq!(shown.header("etag"), created.header("etag"));
    let rig = shown.json();
    assert_eq!(rig, created.json());
    assert_eq!(rig["fit_policy"]["kinds"], json!(["noise"]));
    assert_eq!(rig["channels"][0]["quantity"], "force");
    app.post_json("/v1/rigs", &bench()).await.problem(409, "rig.exists");
}

#[tokio::test]
async fn a_rig_without_a_name_is_called_by_its_id() {
    let app = TestApp::start();
    let mut draft = bench();
    draft.as_object_mut().expect("an object").remove("name");
    assert_eq!(app.post_json("/v1/rigs", &draft).await.expect(201).json()["name"], "bench");
    for blank in ["", " \t"] {
        draft["name"] = json!(blank);
        draft["id"] = json!("another");
        let problem = app.post_json("/v1/rigs", &draft).await.problem(422, "body.invalid_value");
        assert_eq!(problem["errors"][0]["pointer"], "/name", "{problem}");
    }
}

#[tokio::test]
async fn a_query_that_is_no_utf8_is_refused_and_one_that_is_is_kept_exactly() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    let upload = async |name: &str| {
        let path = format!("/v1/rigs/bench/runs?kind=noise&name={name}");
        app.call("POST", &path).body("text/csv", noise_csv(300, 1).into_bytes()).send().await
    };
    let problem = upload("%ff").await.problem(400, "request.malformed");
    assert_eq!(problem["errors"][0]["pointer"], "?name", "{problem}");
    assert_eq!(upload("%EF%BF%BD%C3%BC").await.expect(201).json()["name"], "\u{fffd}ü");
}

#[tokio::test]
async fn rigs_that_make_no_sense_are_refused_field_by_field() {
    let app = TestApp::start();
    let refused = async |change: fn(&mut serde_json::Value), pointer: &str| {
        let mut draft = triple();
        change(&mut draft);
        let problem = app.post_json("/v1/rigs", &draft).await.problem(422, "rig.invalid");
        assert_eq!(problem["errors"][0]["pointer"], pointer, "{problem}");
    };
    refused(|d| d["sample_rate_hz"] = json!(0.0), "/sample_rate_hz").await;
    refused(|d| d["channels"][1]["name"] = json!("u"), "/channels/1/name").await;
    refused(|d| d["channels"][0]["role"] = json!("response"), "/channels").await;
    refused(|d| d["channels"][3]["group"] = json!("other"), "/channels").await;
    refused(
        |d| d["fit_policy"] = json!({"fits": [{"kind": "frf", "inputs": ["q"]}]}),
        "/fit_policy/fits/0/inputs/0",
    )
    .await;
    for id in ["", "A", "a b", "-a"] {
        let mut draft = bench();
        draft["id"] = json!(id);
        app.post_json("/v1/rigs", &draft).await.problem(422, "body.invalid_value");
    }
    assert_eq!(app.get("/v1/rigs").await.json()["items"], json!([]), "nothing was stored");
}

#[tokio::test]
async fn a_change_needs_the_etag_of_the_state_that_it_starts_from() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    let patch = |tag: Option<String>| {
        let call = app.call("PATCH", "/v1/rigs/bench");
        let call = match tag {
            Some(tag) => call.header("if-match", &tag),
            None => call,
        };
        call.json(&json!({"name": "New"})).send()
    };
    patch(None).await.problem(428, "if_match.missing");
    patch(Some("r1".into())).await.problem(400, "if_match.malformed");
    let before = app.get("/v1/rigs/bench").await.header("etag").to_owned();
    let changed = patch(Some(format!("\"other\", {before}"))).await.expect(200);
    assert_eq!(changed.json()["name"], "New");
    assert_ne!(changed.header("etag"), before);
    patch(Some(before)).await.problem(412, "if_match.stale");
    patch(Some("*".into())).await.expect(200);
    let merge = app.call("PATCH", "/v1/rigs/bench").header("if-match", "*");
    merge.body("application/merge-patch+json", r#"{"name": null}"#).send().await.expect(200);
    let unknown = app.call("PATCH", "/v1/rigs/bench").header("if-match", "*").json(&json!({"color": "red"}));
    unknown.send().await.problem(422, "rig.invalid");
    let missing = app.call("PATCH", "/v1/rigs/none").header("if-match", "*").json(&json!({}));
    missing.send().await.problem(404, "rig.not_found");
}

#[tokio::test]
async fn channels_are_fixed_once_a_run_exists() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    let patch = |body: serde_json::Value| {
        app.call("PATCH", "/v1/rigs/bench").header("if-match", "*").json(&body).send()
    };
    patch(json!({"sample_rate_hz": 100.0, "channels": bench()["channels"]})).await.expect(200);
    app.run("kind=other", &noise_csv(100, 1)).await;
    let mut channels = bench()["channels"].clone();
    channels[0]["unit"] = json!("N");
    patch(json!({"channels": channels})).await.problem(409, "rig.channels_fixed");
    patch(json!({"name": "still open"})).await.expect(200);
}

#[tokio::test]
async fn lists_go_page_by_page_to_their_end() {
    let app = TestApp::start();
    for id in ["c", "a", "b"] {
        let mut draft = bench();
        draft["id"] = json!(id);
        app.rig(&draft).await;
    }
    let first = app.get("/v1/rigs?limit=2").await.expect(200).json();
    let ids = |page: &serde_json::Value| -> Vec<String> {
        let items = page["items"].as_array().expect("items");
        items.iter().map(|i| i["id"].as_str().expect("an id").to_owned()).collect()
    };
    assert_eq!(ids(&first), ["a", "b"]);
    let next = first["next"].as_str().expect("a cursor");
    let second = app.get(&format!("/v1/rigs?limit=2&cursor={next}")).await.expect(200).json();
    assert_eq!((ids(&second), &second["next"]), (vec!["c".to_owned()], &json!(null)));
}

#[tokio::test]
async fn a_deleted_rig_takes_its_runs_and_files_along() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    app.run("kind=other", &noise_csv(100, 1)).await;
    assert_eq!(app.files().len(), 1);
    app.delete("/v1/rigs/bench").await.expect(204);
    app.delete("/v1/rigs/bench").await.problem(404, "rig.not_found");
    assert_eq!(app.files(), [] as [std::path::PathBuf; 0]);
}
