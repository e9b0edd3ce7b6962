//! Security headers of every answer.

use rigcast::http::routes::ROUTES;

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
    // Pages of the service send their forms to it.
    assert!(policy.contains("form-action 'none'") || policy.contains("form-action 'self'"), "{policy}");
    for part in ["default-src 'none'", "base-uri 'none'", "frame-ancestors 'none'"] {
        assert!(policy.contains(part), "{policy}");
    }
    assert!(!policy.contains("unsafe"), "{policy}");
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
async fn the_documentation_loads_its_scripts_and_has_none_inside() {
    let app = TestApp::start();
    let page = app.get("/docs").await.expect(200);
    let policy = page.header("content-security-policy");
    assert!(policy.contains("script-src 'self';") && policy.contains("style-src 'self';"), "{policy}");
    assert!(page.text().contains("src=\"/docs/swagger-ui-bundle.js\""), "{}", page.text());
    for script in page.text().split("<script").skip(1) {
        let (head, rest) = script.split_once('>').expect("a tag");
        assert!(head.contains("src=\"/") && rest.starts_with("</script>"), "{script}");
    }
    assert!(!page.text().contains(" style=") && !page.text().contains("<style"), "nothing inline");
    for (accept, path) in
        [("text/javascript", "/docs/swagger-ui-bundle.js"), ("text/css", "/docs/swagger-ui.css")]
    {
        assert!(app.get(path).await.expect(200).header("content-type").starts_with(accept));
    }
    app.get("/docs/oauth2-redirect.html").await.expect(404);
}
