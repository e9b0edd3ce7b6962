//! Figures of a run: drawn, zoomed, and saved, whatever the signals are.

use serde_json::Value;

use super::page;
use crate::support::{TestApp, bench, noise_csv};

const FIGURES: [&str; 5] = ["time", "psd", "from_to", "range_pair", "level_crossing"];

async fn lab(csv: &str) -> (TestApp, String) {
    let app = TestApp::start();
    app.rig(&bench()).await;
    let run: Value = app.run("kind=noise", csv).await;
    let path = format!("/rigs/bench/runs/{}", run["id"].as_str().expect("an id"));
    (app, path)
}

#[tokio::test]
async fn every_figure_comes_as_a_picture_and_as_numbers() {
    let (app, path) = lab(&noise_csv(5000, 3)).await;
    for figure in FIGURES {
        for channel in [0, 1] {
            let at = |form: &str| format!("{path}?channel={channel}&figure={figure}&as={form}");
            let part = page(&app, &at("part")).await.expect(200);
            assert!(
                part.text().contains("<svg") && !part.text().contains("NaN"),
                "{figure}: {}",
                part.text()
            );
            let svg = page(&app, &at("svg")).await.expect(200);
            assert!(svg.header("content-disposition").contains(".svg") && svg.text().contains("</svg>"));
            let csv = page(&app, &at("csv")).await.expect(200);
            let rows: Vec<&str> = csv.text().lines().collect();
            let columns = rows[0].split(',').count();
            assert!(rows.len() > 5 && rows.iter().all(|row| row.split(',').count() == columns), "{figure}");
        }
    }
    page(&app, &format!("{path}?figure=phase")).await.expect(422);
    page(&app, &format!("{path}?figure=time&width=1e9")).await.expect(422);
    page(&app, &format!("{path}?channel=2")).await.expect(422);
}

#[tokio::test]
async fn a_zoom_goes_down_to_the_samples_that_were_sent() {
    let (app, path) = lab(&noise_csv(5000, 3)).await;
    let csv =
        page(&app, &format!("{path}?figure=time&as=csv&from_s=10&to_s=10.2&width=900")).await.expect(200);
    let rows: Vec<Vec<f64>> = csv
        .text()
        .lines()
        .skip(1)
        .map(|row| row.split(',').map(|x| x.parse().expect("a number")).collect())
        .collect();
    assert_eq!(rows.len(), 20);
    let sent = app.get(&format!("/v1{path}/data?from_s=10&to_s=10.2")).await.expect(200).json();
    for (place, name) in ["u", "y"].iter().enumerate() {
        let sent = sent["channels"][name].as_array().expect("samples");
        for (row, x) in rows.iter().zip(sent) {
            assert_eq!(row[place + 1], x.as_f64().expect("a number"));
        }
    }
}

#[tokio::test]
async fn constant_and_very_short_signals_are_drawn_or_said() {
    for csv in
        ["u,y\n1,2\n", "u,y\n1,2\n1,2\n1,2\n", "u,y\n0,0\n1,0\n", "u,y\n-1e300,1e-300\n1e300,-1e-300\n0,0\n"]
    {
        let (app, path) = lab(csv).await;
        page(&app, &path).await.expect(200);
        for figure in FIGURES {
            let reply = page(&app, &format!("{path}?figure={figure}&as=part")).await;
            assert!([200, 422].contains(&reply.status), "{figure} of {csv:?}: {}", reply.text());
            assert!(
                !reply.text().contains("NaN") && !reply.text().contains("inf "),
                "{figure}: {}",
                reply.text()
            );
        }
        page(&app, &format!("{path}?figure=time&from_s=99&to_s=98")).await.expect(200);
    }
}

#[tokio::test]
async fn the_samples_come_as_a_file_in_every_format() {
    let (app, path) = lab(&noise_csv(3000, 3)).await;
    for (format, ending) in
        [("csv", "csv"), ("npy", "npy"), ("rpc3", "rsp"), ("mat", "mat"), ("json", "json")]
    {
        let file = page(&app, &format!("{path}/file?format={format}")).await.expect(200);
        assert!(file.header("content-disposition").contains(&format!(".{ending}\"")), "{format}");
        assert!(file.bytes.len() > 3000);
    }
    page(&app, &format!("{path}/file?format=exe")).await.expect(422);
}
