//! Figures of a prediction that is compared with a measurement.

use serde_json::json;

use super::page;
use crate::support::{SAFETENSORS, TestApp, gain_weights, noise, triple};

const FIGURES: [&str; 7] = ["overlay", "error", "damage_ratio", "multi_rain", "psd", "range_pair", "loop"];

/// A run of the triple whose responses are `u`, `2 u` and `3 u` with a small error.
fn csv(n: usize, seed: u64) -> String {
    let rows = noise(n, seed).into_iter().zip(noise(n, seed + 50));
    let rows =
        rows.map(|(u, e)| format!("{u},{},{},{}\n", u + 0.1 * e, 2.0 * u - 0.1 * e, 3.0 * u + 0.1 * e));
    std::iter::once("u,fx,fy,fz\n".to_owned()).chain(rows).collect()
}

/// The triple with a model of version 1, and the path of the page that compares its first run with itself.
async fn compared(with_band: bool) -> (TestApp, String) {
    let app = TestApp::start();
    app.rig(&triple()).await;
    let mut runs = Vec::new();
    for seed in [1, 2] {
        let sent = app.post_file("/v1/rigs/triple/runs?kind=noise", "text/csv", csv(4000, seed)).await;
        runs.push(sent.expect(201).json());
    }
    if with_band {
        let request = json!({"kind": "frf", "frf": {"segment_len": 256}});
        let job = app.post_json("/v1/rigs/triple/fits", &request).await.expect(202).json();
        let job = app.finished(job["id"].as_str().expect("an id")).await;
        assert_eq!(job["state"], "succeeded", "{job}");
    } else {
        let weights = gain_weights(&["u"], &["fx", "fy", "fz"], 2.0);
        app.post_file("/v1/rigs/triple/models", SAFETENSORS, weights).await.expect(201);
    }
    let run = runs[0]["id"].as_str().expect("an id").to_owned();
    (app, format!("/rigs/triple/predict?model=1&drive={run}&target={run}"))
}

#[tokio::test]
async fn every_figure_of_a_comparison_comes_as_a_picture_and_as_numbers() {
    let (app, path) = compared(true).await;
    let html = page(&app, &path).await.expect(200);
    for figure in FIGURES {
        assert!(html.text().contains(&format!("figure={figure}")), "{figure} is on the page");
        let part = page(&app, &format!("{path}&figure={figure}&as=part")).await.expect(200);
        assert!(part.text().contains("<svg") && !part.text().contains("NaN"), "{figure}: {}", part.text());
        let svg = page(&app, &format!("{path}&figure={figure}&as=svg")).await.expect(200);
        assert!(svg.text().contains("xmlns=") && !svg.text().contains("var("), "{figure}: {}", svg.text());
        let csv = page(&app, &format!("{path}&figure={figure}&as=csv")).await.expect(200);
        let rows: Vec<&str> = csv.text().lines().collect();
        let columns = rows[0].split(',').count();
        assert!(rows.len() > 3 && rows.iter().all(|row| row.split(',').count() == columns), "{figure}");
    }
    page(&app, &format!("{path}&figure=sphere")).await.expect(422);
    page(&app, &format!("{path}&figure=multi_rain&group=1")).await.expect(422);
}

#[tokio::test]
async fn damage_ratios_have_their_interval_and_the_map_the_ratio_of_each_direction() {
    let (app, path) = compared(true).await;
    let numbers = |csv: String| -> Vec<Vec<f64>> {
        let rows = csv.lines().skip(1).map(|row| row.split(',').filter_map(|x| x.parse().ok()).collect());
        rows.collect()
    };
    let csv = page(&app, &format!("{path}&figure=damage_ratio&as=csv")).await.expect(200).text().to_owned();
    assert!(
        csv.starts_with("name,ratio,lower,upper\r\nfx,") && csv.contains("Multi-Rain of force,"),
        "{csv}"
    );
    for row in &numbers(csv)[..3] {
        assert!(row[1] <= row[0] && row[0] <= row[2] && row[0] > 0.5 && row[0] < 2.0, "{row:?}");
    }
    let csv = page(&app, &format!("{path}&figure=multi_rain&as=csv")).await.expect(200).text().to_owned();
    let map = numbers(csv);
    assert_eq!((map.len(), map[0].len()), (500, 8));
    let request =
        json!({"drive": {"run": path.rsplit('=').next()}, "target": {"run": path.rsplit('=').next()}});
    let told = app.post_json("/v1/rigs/triple/predict", &request).await.expect(200).json();
    let group = &told["damage"]["groups"]["force"];
    for (name, column) in [("predicted", 5), ("target", 6)] {
        let largest = map.iter().map(|row| row[column]).fold(0.0, f64::max);
        let told = group[name].as_f64().expect("a damage");
        assert!((largest / told - 1.0).abs() < 1e-9, "{name}: {largest} for {told}");
    }
}

#[tokio::test]
async fn the_band_is_about_the_prediction_and_a_model_without_one_says_so() {
    let (app, path) = compared(true).await;
    let csv = page(&app, &format!("{path}&figure=overlay&as=csv&from_s=1&to_s=1.1")).await.expect(200);
    let head = csv.text().lines().next().expect("a head").to_owned();
    let at = |name: &str| head.split(',').position(|found| found == name).unwrap_or_else(|| panic!("{head}"));
    let (lower, upper) = (at("90 % band lower"), at("90 % band upper"));
    let predicted = at("predicted smallest");
    for row in csv.text().lines().skip(1) {
        let row: Vec<f64> = row.split(',').map(|x| x.parse().expect("a number")).collect();
        assert!(row[lower] < row[predicted] && row[predicted] < row[upper], "{row:?}");
    }
    let (app, path) = compared(false).await;
    let html = page(&app, &path).await.expect(200);
    assert!(html.text().contains("There is no band: the weights carry no band"), "{}", html.text());
    let csv = page(&app, &format!("{path}&figure=overlay&as=csv")).await.expect(200);
    assert!(!csv.text().contains("band"));
    let ratios = page(&app, &format!("{path}&figure=damage_ratio&as=csv")).await.expect(200);
    assert!(ratios.text().starts_with("name,ratio\r\n"), "{}", ratios.text());
}

#[tokio::test]
async fn without_a_target_the_map_shows_shares_and_there_is_no_ratio() {
    let (app, path) = compared(true).await;
    let path = path.split("&target=").next().expect("a path").to_owned();
    let html = page(&app, &path).await.expect(200);
    assert!(html.text().contains("figure=multi_rain") && !html.text().contains("figure=damage_ratio"));
    let map = page(&app, &format!("{path}&figure=multi_rain")).await.expect(200);
    assert!(map.text().contains("Share of the largest damage"), "{}", map.text());
    let none = page(&app, &format!("{path}&figure=damage_ratio")).await.expect(200);
    assert!(none.text().contains("has none of the predicted channels"));
}
