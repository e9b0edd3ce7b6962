//! The root of the service, in a browser and for a program.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use serde_json::json;
use sha2::{Digest, Sha256};

use crate::support::{Reply, TestApp, bench};

/// What Firefox and Chromium send, by and large.
const BROWSER: &str = "text/html,application/xhtml+xml,application/xml;q=0.9,*/*;q=0.8";

async fn page(app: &TestApp, token: Option<&str>) -> Reply {
    app.call_as(token, "GET", "/").header("accept", BROWSER).send().await.expect(200)
}

#[tokio::test]
async fn a_browser_sees_the_rigs_with_their_active_models_and_a_program_gets_links() {
    let app = TestApp::start();
    app.bench_with_model().await;
    let mut hostile = bench();
    hostile["id"] = json!("other");
    hostile["name"] = json!("<img src=x onerror=alert(1)>");
    app.rig(&hostile).await;
    let reply = page(&app, None).await;
    assert!(reply.header("content-type").starts_with("text/html"));
    let html = reply.text();
    assert!(html.contains(r#"<a href="/v1/rigs/bench/models/1">Version 1</a> (frf)"#), "{html}");
    assert!(!html.contains("<img") && html.contains("&lt;img src=x onerror=alert(1)&gt;"), "{html}");
    for link in html.split("href=\"").skip(1).filter_map(|rest| rest.split('"').next()) {
        app.get(link).await.expect(200);
    }
    let links = app.get("/").await.expect(200).json();
    for (name, path) in links["links"].as_object().expect("an object") {
        assert_eq!(app.get(path.as_str().expect("a path")).await.status, 200, "{name}");
    }
    assert_eq!(app.call("GET", "/").header("accept", "image/png").send().await.status, 406);
}

#[tokio::test]
async fn the_page_allows_its_own_style_and_nothing_else() {
    let app = TestApp::start();
    let reply = page(&app, None).await;
    let style = reply.text().split("<style>").nth(1).and_then(|rest| rest.split("</style>").next());
    let digest = STANDARD.encode(Sha256::digest(style.expect("a style")));
    let policy = reply.header("content-security-policy");
    assert!(policy.contains(&format!("style-src 'sha256-{digest}'")), "{policy}");
    assert!(policy.starts_with("default-src 'none'") && !policy.contains("unsafe"), "{policy}");
    assert!(!policy.contains("script-src") && !reply.text().contains("<script"), "{policy}");
    assert!(reply.text().contains("prefers-color-scheme: dark"));
}

#[tokio::test]
async fn rigs_are_shown_to_those_who_may_read_them() {
    let mut app = TestApp::start();
    app.bench_with_model().await;
    let mut other = bench();
    other["id"] = json!("other");
    app.rig(&other).await;
    let foreign = app.call("GET", "/").header("accept", BROWSER).header("host", "evil.lab").send().await;
    assert!(!foreign.expect(200).text().contains("bench"), "a name that is not this machine's");
    app.close_doors().await;
    let (limited, id) = app.token(&json!({"role": "reader", "rigs": ["bench"]})).await;
    for token in [None, Some("rigcast_of_nobody")] {
        let html = page(&app, token).await.text().to_owned();
        assert!(html.contains("Authorization: Bearer") && !html.contains("bench"), "{html}");
    }
    let html = page(&app, Some(&limited)).await.text().to_owned();
    assert!(html.contains("/v1/rigs/bench/models/1") && !html.contains("other"), "{html}");
    app.delete(&format!("/v1/tokens/{id}")).await.expect(204);
    assert!(!page(&app, Some(&limited)).await.text().contains("bench"), "revoked");
}
