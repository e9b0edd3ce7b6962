//! Figures of the pages, in a browser on the machine that serves:
//!
//! ```sh
//! cargo test --release --locked --test api browser::figures -- --ignored --nocapture
//! ```

use serde_json::json;

use super::Browser;
use crate::support::{TestApp, npy};

/// Samples of an hour.
const HOUR: usize = 3_600_000;

/// Milliseconds until the page has loaded, and bytes that came for it without its cached files.
async fn load(browser: &Browser, path: &str) -> (f64, f64) {
    browser.go(path).await;
    browser.until("performance.getEntriesByType('navigation')[0].loadEventEnd > 0").await;
    let time = browser.eval("performance.getEntriesByType('navigation')[0].loadEventEnd").await;
    // The page, and what it loads that was not kept from before: figures that are drawn later, too.
    browser.until("!document.querySelector('[data-late]') || document.body.dataset.drawn").await;
    let bytes = browser
        .eval("['navigation', 'resource'].flatMap(kind => performance.getEntriesByType(kind)).reduce((sum, entry) => sum + entry.transferSize, 0)")
        .await;
    (time.as_f64().expect("milliseconds"), bytes.as_f64().expect("bytes"))
}

#[tokio::test]
#[ignore = "figures of an optimised build"]
async fn the_first_page_and_an_hour_of_nine_channels_open_in_time() {
    let app = TestApp::start();
    let Some(browser) = Browser::start(&format!("http://{}", app.address())).await else { return };
    let channel = |k: usize| {
        let role = if k < 3 { "drive" } else { "response" };
        json!({"name": format!("channel_{k}"), "unit": "kN", "role": role})
    };
    let channels: Vec<_> = (0..9).map(channel).collect();
    app.rig(&json!({"id": "hour", "name": "Hour", "sample_rate_hz": 1000.0, "channels": channels})).await;
    let mut bytes = Vec::with_capacity(4 * 9 * HOUR);
    let mut state = 1_u32;
    for i in 0..HOUR {
        for k in 0..9 {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            let noise = f64::from(state >> 8) / f64::from(1 << 24) - 0.5;
            let x = (i as f64 * 1e-3 * (1.0 + k as f64)).sin() + noise;
            bytes.extend((x as f32).to_le_bytes());
        }
    }
    let file = npy("<f4", false, &format!("({HOUR}, 9)"), &bytes);
    let run =
        app.post_file("/v1/rigs/hour/runs?kind=noise", "application/x-npy", file).await.expect(201).json();
    let path = format!("/rigs/hour/runs/{}", run["id"].as_str().expect("an id"));
    load(&browser, "/").await;
    let (first_ms, first_bytes) = load(&browser, "/").await;
    let (run_ms, run_bytes) = load(&browser, &path).await;
    let (again_ms, _) = load(&browser, &path).await;
    println!("first page: {first_ms:.0} ms, {:.0} kB", first_bytes / 1e3);
    println!(
        "run of 1 h x 9 channels: {run_ms:.0} ms at first, {again_ms:.0} ms again, {:.0} kB",
        run_bytes / 1e3
    );
    assert!(first_ms <= 200.0 && run_ms <= 1000.0, "as promised");
    assert!(first_bytes <= 200e3 && run_bytes <= 200e3, "as promised");
}
