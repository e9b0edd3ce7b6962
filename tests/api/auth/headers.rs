//! Security headers of every answer.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use rigcast::http::routes::ROUTES;
use sha2::{Digest, Sha256};

use crate::support::{Reply, TestApp, bench};

#[track_caller]
fn protected(reply: &Reply) {
    for (name, value) in [
        ("x-content-type-options", "nosniff"),
        ("x-frame-options", "DENY"),
        ("referrer-policy", "no-referrer"),
        ("cross-origin-resource-policy", "same-origin"),
        ("cache-control", "no-store"),
    ] {
        assert_eq!(reply.header(name), value);
    }
    let policy = reply.header("content-security-policy");
    for part in ["default-src 'none'", "base-uri 'none'", "form-action 'none'", "frame-ancestors 'none'"] {
        assert!(policy.contains(part), "{policy}");
    }
    assert!(!policy.contains("unsafe-eval"), "{policy}");
    let cors = reply.headers.keys().find(|name| name.as_str().starts_with("access-control-"));
    assert_eq!(cors, None, "no other origin is invited");
}

#[tokio::test]
async fn every_answer_of_every_operation_is_protected() {
    let mut app = TestApp::start();
    app.rig(&bench()).await;
    let fill = |path: &str| {
        path.replace("{rig}", "bench").replace("{asset}", "swagger-ui-bundle.js").replace(['{', '}'], "")
    };
    for closed in [false, true] {
        for route in ROUTES.iter().filter(|route| route.path != "/v1/rigs/{rig}" || route.method != "DELETE")
        {
            let call = app.call(route.method.as_str(), &fill(route.path)).header("origin", "http://evil.lab");
            protected(&call.send().await);
            protected(&app.call_as(None, route.method.as_str(), &fill(route.path)).send().await);
        }
        protected(&app.get("/nothing").await);
        protected(
            &app.call("OPTIONS", "/v1/rigs").header("access-control-request-method", "POST").send().await,
        );
        if !closed {
            app.close_doors().await;
        }
    }
}

#[tokio::test]
async fn the_documentation_runs_its_own_script_and_no_other() {
    let app = TestApp::start();
    let page = app.get("/docs").await.expect(200);
    let policy = page.header("content-security-policy");
    assert!(
        !policy.split(';').any(|part| part.contains("script-src") && part.contains("unsafe-inline")),
        "{policy}"
    );
    let scripts: Vec<&str> = page.text().split("<script").skip(1).collect();
    assert_eq!(scripts.len(), 2, "one that is loaded, one that stands there");
    assert!(scripts[0].contains("src=\"/docs/swagger-ui-bundle.js\""), "{}", scripts[0]);
    let inline =
        scripts[1].split_once('>').and_then(|(_, rest)| rest.split_once("</script>")).expect("a script").0;
    let digest = STANDARD.encode(Sha256::digest(inline));
    assert!(inline.contains("SwaggerUIBundle") && policy.contains(&format!("'sha256-{digest}'")), "{policy}");
    assert!(!page.text().contains(" style="), "no style that the policy would have to name");
    for (accept, path) in
        [("text/javascript", "/docs/swagger-ui-bundle.js"), ("text/css", "/docs/swagger-ui.css")]
    {
        assert!(app.get(path).await.expect(200).header("content-type").starts_with(accept));
    }
}
