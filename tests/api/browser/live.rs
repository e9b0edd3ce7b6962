//! The page of a job while a network trains.

use serde_json::{Value, json};

use super::{Browser, shots};
use crate::support::{TestApp, bench, noise_csv};

/// Points of the first line of the loss curve; null while there is none.
const POINTS: &str = "document.querySelector('[data-live=losses]:not(.hidden) svg path.line')?.getAttribute('d').split('L').length";

#[tokio::test]
async fn the_loss_curve_grows_while_a_network_trains_and_is_there_after_a_reload() {
    let app = TestApp::start();
    let Some(browser) = Browser::start(&format!("http://{}", app.address())).await else { return };
    app.rig(&bench()).await;
    app.run("kind=noise", &noise_csv(6000, 11)).await;
    let lstm = json!({"blocks": [39], "epochs": 30_000, "validate_every": 1, "seeds": [1, 2]});
    let job =
        app.post_json("/v1/rigs/bench/fits", &json!({"kind": "lstm", "lstm": lstm})).await.expect(202).json();
    browser.go(&format!("/jobs/{}", job["id"].as_str().expect("an id"))).await;
    browser.eval("window.notLoadedAnew = true").await;
    browser.until(&format!("{POINTS} >= 2")).await;
    let first = browser.eval(POINTS).await.as_u64().expect("points");
    browser.until(&format!("{POINTS} > {first}")).await;
    assert_eq!(browser.eval("window.notLoadedAnew").await, json!(true), "it grew in the same page");
    assert!(browser.shows("seed 1 training").await && browser.shows("seed 2 stopping").await);
    browser.shoot(&shots(), "job-training").await;
    let before = browser.eval(POINTS).await.as_u64().expect("points");
    browser.go("/jobs").await;
    browser.shoot(&shots(), "jobs-running").await;
    browser.go(&format!("/jobs/{}", job["id"].as_str().expect("an id"))).await;
    browser.until(&format!("{POINTS} >= {before}")).await;

    app.post(&format!("/v1/jobs/{}/cancel", job["id"].as_str().expect("an id"))).await.expect(202);
    browser.until("document.querySelector('[data-live=state]').textContent === 'cancelled'").await;
    browser.until(&format!("{POINTS} >= {before}")).await;
    assert_ne!(browser.eval("window.notLoadedAnew || null").await, json!(true));
    assert_eq!(browser.complaints().await, Vec::<String>::new());
    let losses =
        app.get(&format!("/v1/jobs/{}/losses", job["id"].as_str().expect("an id"))).await.expect(200).json();
    let epochs: Vec<&Value> =
        losses["curves"].as_array().expect("curves").iter().map(|c| &c["epochs"]).collect();
    assert!(
        epochs.iter().all(|epochs| epochs.as_array().is_some_and(|e| e.len() as u64 >= first)),
        "{epochs:?}"
    );
}
