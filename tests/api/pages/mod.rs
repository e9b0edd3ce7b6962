//! Pages for people, as a browser asks for them.

mod figures;
mod predictions;
mod session;

use serde_json::json;

use crate::support::{Call, Reply, TestApp, bench};

/// What Firefox and Chromium send, by and large.
const BROWSER: &str = "text/html,application/xhtml+xml,application/xml;q=0.9,*/*;q=0.8";

/// A request of a browser without a session.
fn browse(app: &TestApp, method: &str, path: &str) -> Call {
    app.call_as(None, method, path).header("accept", BROWSER)
}

async fn page(app: &TestApp, path: &str) -> Reply {
    browse(app, "GET", path).send().await
}

/// Paths that a page links to, in the service.
fn links(html: &str) -> Vec<String> {
    let links = html.split("href=\"").skip(1).filter_map(|rest| rest.split('"').next());
    links.filter(|link| link.starts_with('/')).map(|link| link.replace("&amp;", "&")).collect()
}

/// That a page runs nothing but what the service serves by itself.
fn strict(reply: &Reply) {
    assert!(reply.header("content-type").starts_with("text/html"));
    let policy = reply.header("content-security-policy");
    for part in [
        "default-src 'none'",
        "style-src 'self'",
        "script-src 'self'",
        "img-src 'self' data:",
        "connect-src 'self'",
        "form-action 'self'",
        "frame-ancestors 'none'",
        "base-uri 'none'",
    ] {
        assert!(policy.split("; ").any(|found| found == part), "{part}: {policy}");
    }
    let html = reply.text();
    assert!(!html.contains(" style=") && !html.contains("<style"), "{html}");
    for script in html.split("<script").skip(1) {
        let (head, rest) = script.split_once('>').expect("a tag");
        assert!(head.contains("src=\"/") && rest.starts_with("</script>"), "{script}");
    }
}

#[tokio::test]
async fn every_link_of_the_pages_of_a_rig_leads_somewhere_and_every_page_is_strict() {
    let app = TestApp::start();
    app.bench_with_model().await;
    let mut hostile = bench();
    hostile["id"] = json!("other");
    hostile["name"] = json!("<img src=x onerror=alert(1)>\u{202e}");
    app.rig(&hostile).await;
    app.run("kind=noise&name=%3Cscript%3Ealert(1)%3C/script%3E", &crate::support::noise_csv(3000, 7)).await;
    let (mut open, mut seen) = (vec!["/".to_owned()], Vec::new());
    while let Some(path) = open.pop() {
        if seen.contains(&path) {
            continue;
        }
        let reply = page(&app, &path).await.expect(200);
        if reply.header("content-type").starts_with("text/html") && !path.starts_with("/v1") {
            if !path.contains("as=part") {
                strict(&reply);
            }
            let html = reply.text();
            assert!(!html.contains("<img") && !html.contains("<script>alert"), "{path}: {html}");
            assert!(html.len() < 200_000, "{path}: {} bytes", html.len());
            open.extend(links(html));
            let figures = html.split("data-figure=\"").skip(1).filter_map(|rest| rest.split('"').next());
            open.extend(figures.map(|figure| format!("{}&as=part", figure.replace("&amp;", "&"))));
        }
        seen.push(path);
    }
    for needed in [
        "/rigs/bench",
        "/rigs/bench/drift",
        "/rigs/bench/upload",
        "/rigs/bench/fit",
        "/rigs/bench/evaluate",
        "/rigs/bench/study",
        "/jobs",
        "/tokens",
        "/operations",
        "/docs",
    ] {
        assert!(seen.iter().any(|path| path == needed), "{needed} is linked: {seen:?}");
    }
    assert!(
        seen.iter().any(|path| path.contains("/models/1?") && path.contains("figure=magnitude")),
        "{seen:?}"
    );
}

#[tokio::test]
async fn a_program_gets_links_at_the_root() {
    let app = TestApp::start();
    let links = app.get("/").await.expect(200).json();
    for (name, path) in links["links"].as_object().expect("an object") {
        assert_eq!(app.get(path.as_str().expect("a path")).await.status, 200, "{name}");
    }
    assert_eq!(app.call("GET", "/").header("accept", "image/png").send().await.status, 406);
}

#[tokio::test]
async fn a_refusal_is_a_page_for_a_browser_with_the_id_of_the_request() {
    let app = TestApp::start();
    let reply = page(&app, "/rigs/nothing").await.expect(404);
    strict(&reply);
    let id = reply.header("x-request-id");
    assert!(reply.text().contains(id) && reply.text().contains("rig.not_found"), "{}", reply.text());
    let foreign = browse(&app, "GET", "/").header("host", "evil.lab").send().await.expect(403);
    assert!(foreign.text().contains("host.foreign"));
    app.get("/rigs/nothing").await.problem(404, "rig.not_found");
}

#[tokio::test]
async fn files_of_pages_are_kept_by_browsers_and_the_rest_is_not() {
    let app = TestApp::start();
    let html = page(&app, "/").await.expect(200);
    assert_eq!(html.header("cache-control"), "no-store");
    let assets: Vec<&str> = html.text().split('"').filter(|part| part.starts_with("/assets/")).collect();
    assert!(assets.len() >= 3, "{assets:?}");
    for asset in assets {
        let reply = app.get(asset).await.expect(200);
        assert_eq!(reply.header("cache-control"), "public, max-age=31536000, immutable", "{asset}");
    }
    let old = app.get("/assets/0000000000000000/style.css").await;
    assert_eq!((old.status, old.header("cache-control")), (404, "no-store"));
}
