//! A prediction that is compared with its measurement: damage by direction, and the band.

use serde_json::json;

use super::{Browser, shots};
use crate::support::{TestApp, noise};

/// Three drives and three responses: x saturates, y is linear, z stiffens.
fn rig() -> serde_json::Value {
    let channel = |axis: &str, role: &str| {
        let mut channel = json!({"name": format!("{role}_{axis}"), "unit": "kN", "role": role, "axis": axis, "quantity": "force"});
        if role == "response" {
            channel["group"] = json!("force");
        }
        channel
    };
    let channels: Vec<_> = ["drive", "response"]
        .iter()
        .flat_map(|role| ["x", "y", "z"].map(|axis| channel(axis, role)))
        .collect();
    json!({"id": "three", "name": "Three axes", "sample_rate_hz": 100.0, "channels": channels})
}

/// A run of noise whose level rises from a third to the whole of it.
fn run(n: usize, seed: u64) -> String {
    let smooth = |k: u64| -> Vec<f64> {
        let mut state = 0.0;
        let level = |t: usize| if t < n / 2 { 1.0 } else { 3.0 };
        noise(n, 10 * seed + k)
            .iter()
            .enumerate()
            .map(|(t, u)| {
                state += 0.3 * (u - state);
                level(t) * state
            })
            .collect()
    };
    let (x, y, z, e) = (smooth(1), smooth(2), smooth(3), noise(n, 10 * seed + 4));
    let row = |t: usize| {
        let error = 0.05 * e[t];
        let (fx, fy, fz) =
            (x[t].tanh() + error, y[t] + 0.3 * x[t] - error, z[t] + 0.3 * z[t].powi(3) + error);
        format!("{},{},{},{fx},{fy},{fz}\n", x[t], y[t], z[t])
    };
    let head = "drive_x,drive_y,drive_z,response_x,response_y,response_z\n".to_owned();
    std::iter::once(head).chain((0..n).map(row)).collect()
}

#[tokio::test]
async fn damage_is_seen_by_direction_and_a_zoom_shows_the_band() {
    let app = TestApp::start();
    let Some(browser) = Browser::start(&format!("http://{}", app.address())).await else { return };
    app.rig(&rig()).await;
    let mut last = String::new();
    for seed in [1, 2] {
        let sent = app.post_file("/v1/rigs/three/runs?kind=noise", "text/csv", run(6000, seed)).await;
        last = sent.expect(201).json()["id"].as_str().expect("an id").to_owned();
    }
    let request = json!({"kind": "frf", "frf": {"segment_len": 256}});
    let job = app.post_json("/v1/rigs/three/fits", &request).await.expect(202).json();
    assert_eq!(app.finished(job["id"].as_str().expect("an id")).await["state"], "succeeded");
    browser.go(&format!("/rigs/three/predict?drive={last}&target={last}")).await;
    browser.until("document.body.dataset.drawn").await;
    let drawn = "[...document.querySelectorAll('path.ray')].filter(path => path.getAttribute('d').length > 20).length";
    assert!(
        browser.eval(drawn).await.as_u64().is_some_and(|classes| classes >= 3),
        "ratios differ by direction"
    );
    let marks = browser.eval("document.querySelectorAll('.peak').length").await;
    assert_eq!(marks, json!(4), "the largest damages, and their keys");
    assert_eq!(browser.eval("document.querySelectorAll('line.whisker').length").await, json!(3));
    browser.shoot(&shots(), "predict-directions").await;
    for _ in 0..4 {
        let before = browser.eval("document.querySelector('.zoom svg desc').textContent").await;
        browser.click("[data-zoom=in]").await;
        browser.until(&format!("document.querySelector('.zoom svg desc').textContent !== {before}")).await;
    }
    let tall = "document.querySelector('.zoom path.band').getBBox().height";
    assert!(browser.eval(tall).await.as_f64().is_some_and(|height| height > 20.0), "the band is seen");
    browser.shoot(&shots(), "predict-band").await;
    let csv =
        browser.eval("document.querySelector('.zoom').parentElement.querySelector('[data-save]').href").await;
    assert!(
        csv.as_str().is_some_and(|address| address.contains("from_s=") && address.contains("as=csv")),
        "{csv}"
    );
    assert_eq!(browser.complaints().await, Vec::<String>::new());
}
