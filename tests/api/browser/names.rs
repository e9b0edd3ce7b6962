//! Names of the greatest length that the service takes, on every page that shows them.

use serde_json::json;

use super::{Browser, shots};
use crate::support::{TestApp, bench, gain_weights, noise};

/// The longest name of a rig, run, tag or token.
const LONGEST: usize = 1000;

/// A name that holds a tag and turns its direction.
fn long(letter: &str) -> String {
    let head = "<img src=x onerror=document.title='owned'>\u{202e}";
    format!("{head}{}", letter.repeat(LONGEST - head.chars().count()))
}

/// Names in the page that are taller than a line, or cut without their whole text in the title.
const BROKEN: &str = "[...document.querySelectorAll('.clamp')].filter(name => name.getClientRects().length > 1 \
     || name.offsetHeight > 2 * parseFloat(getComputedStyle(name).fontSize) || name.title !== name.textContent)\
     .map(name => name.outerHTML.slice(0, 80))";

/// Whether a name in the page is cut by the style sheet.
const CUT: &str = "[...document.querySelectorAll('.clamp')].some(name => name.scrollWidth > name.clientWidth \
     && name.title.length >= 1000 && getComputedStyle(name).textOverflow === 'ellipsis')";

#[tokio::test]
async fn long_names_end_in_an_ellipsis_and_are_whole_in_their_title() {
    let app = TestApp::start();
    let Some(browser) = Browser::start(&format!("http://{}", app.address())).await else { return };
    let mut rig = bench();
    rig["name"] = json!("x".repeat(10_000));
    app.post_json("/v1/rigs", &rig).await.problem(422, "rig.invalid");
    let (drive, response) = (long("u"), long("y"));
    rig["name"] = json!(long("r"));
    (rig["channels"][0]["name"], rig["channels"][1]["name"]) = (json!(drive), json!(response));
    (rig["channels"][1]["unit"], rig["channels"][1]["axis"]) =
        (json!("k".repeat(LONGEST)), json!("a".repeat(LONGEST)));
    app.rig(&rig).await;
    let samples = noise(600, 3);
    let run = json!({"sample_rate_hz": 100.0, "channels": {&drive: samples, &response: samples}});
    let query: String = form_urlencoded::Serializer::new(String::new())
        .extend_pairs([("kind", "noise"), ("name", &long("n")), ("tag", &long("t"))])
        .finish();
    let run = app.post_json(&format!("/v1/rigs/bench/runs?{query}"), &run).await.expect(201).json();
    app.activate("bench", gain_weights(&[&drive], &[&response], 1.1)).await;
    let run = run["id"].as_str().expect("an id");
    for (name, path) in [
        ("rigs", "/".to_owned()),
        ("rig", "/rigs/bench".into()),
        ("run", format!("/rigs/bench/runs/{run}")),
        ("fit", "/rigs/bench/fit".into()),
        ("predict", format!("/rigs/bench/predict?drive={run}&target={run}")),
        ("model", "/rigs/bench/models/1".into()),
        ("report", "/rigs/bench/models/1/report".into()),
        ("diagnose", "/rigs/bench/diagnose".into()),
        ("evaluate", "/rigs/bench/evaluate".into()),
        ("iterate", "/rigs/bench/iterate".into()),
        ("drift", "/rigs/bench/drift".into()),
        ("upload", "/rigs/bench/upload".into()),
        ("study-form", "/rigs/bench/study".into()),
    ] {
        browser.go(&path).await;
        // It looks at the width of the page, too.
        browser.shoot(&shots(), &format!("long-{name}")).await;
        assert_eq!(browser.eval(BROKEN).await, json!([]), "{path}");
        assert_eq!(browser.eval(CUT).await, json!(true), "{path}: some name is cut");
        assert_ne!(browser.eval("document.title").await, "owned", "{path}");
        // Nothing that is text runs over more than some lines.
        let tall = "[...document.querySelectorAll('main p, main td, main h1, main label, main dd')]\
            .filter(part => part.offsetHeight > 400 && part.textContent.length > 900).map(part => part.outerHTML.slice(0, 120))";
        assert_eq!(browser.eval(tall).await, json!([]), "{path}");
    }
}
