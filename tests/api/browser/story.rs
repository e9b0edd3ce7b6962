//! The first day of a rig, from signing in to a drive for the rig and back.

use serde_json::json;
use tempfile::TempDir;

use super::{Browser, shots};
use crate::diagnoses::rig::{CUBIC, csv, drive, measure, upload};
use crate::support::TestApp;

/// Writes a measurement of the rig under this drive; returns the path of the file.
fn record(folder: &TempDir, name: &str, drive: &[f64], seed: u64) -> String {
    let path = folder.path().join(name);
    let response = measure(drive, CUBIC, seed);
    std::fs::write(&path, csv(&[("drive", drive), ("disp", &response)])).expect("a file");
    path.to_str().expect("UTF-8").to_owned()
}

/// Uploads a file through the page: looks at what was understood, then accepts it.
async fn upload_file(browser: &Browser, path: &str, name: &str) {
    browser.go("/rigs/mass/upload").await;
    browser.choose("[name=kind]", "noise").await;
    browser.fill("[name=name]", name).await;
    browser.fill("input[type=file]", path).await;
    browser.until("!document.querySelector('[data-understood]').classList.contains('hidden')").await;
    assert!(browser.shows("csv").await && browser.shows("128 Hz").await, "the dry run is shown");
    browser.shoot(&shots(), "upload").await;
    browser.click("[data-accept]").await;
    browser.until("/runs\\/[0-9a-f-]{36}$/.test(location.pathname)").await;
}

/// Waits on a job's page for its result, and goes to it.
async fn result(browser: &Browser, shot: Option<&str>) {
    browser.until("location.pathname.startsWith('/jobs/')").await;
    if let Some(name) = shot {
        browser.shoot(&shots(), name).await;
    }
    browser.until("document.querySelector('a.button.main') || document.querySelector('.refused')").await;
    assert!(!browser.shows("failed").await, "{}", browser.eval("document.body.innerText").await);
    browser.click("a.button.main").await;
}

async fn sign_in(browser: &Browser, app: &TestApp, token: &str) {
    browser.go("/").await;
    browser.until("location.pathname === '/sign-in'").await;
    browser.shoot(&shots(), "sign-in").await;
    browser.fill("[name=token]", token).await;
    browser.click("button[type=submit]").await;
    browser.until("location.pathname === '/'").await;
    assert!(browser.shows("There is no rig yet").await);
    browser.shoot(&shots(), "empty").await;
    let cookie = browser.eval("document.cookie").await;
    assert_eq!(cookie, "", "no script sees the session");
    app.get("/v1/rigs").await.expect(200);
}

async fn make_rig(browser: &Browser) {
    browser.fill("[name=id]", "mass").await;
    browser.fill("form.fields [name=name]", "Mass on a stiffening spring").await;
    browser.fill("[name=sample_rate_hz]", "128").await;
    for (row, name, unit) in [(1, "drive", "kN"), (2, "disp", "mm")] {
        browser.fill(&format!("[data-row]:nth-of-type({row}) [name=name]"), name).await;
        browser.fill(&format!("[data-row]:nth-of-type({row}) [name=unit]"), unit).await;
        browser.fill(&format!("[data-row]:nth-of-type({row}) [name=axis]"), "z").await;
    }
    browser.choose("[data-row]:nth-of-type(2) [name=quantity]", "displacement").await;
    browser.click("form.fields button.main").await;
    browser.until("location.pathname === '/rigs/mass'").await;
    assert!(browser.shows("Upload two noise runs").await);
}

/// The active version, as the API has it.
async fn active(app: &TestApp) -> u64 {
    app.get("/v1/rigs/mass/active-model").await.expect(200).json()["version"].as_u64().unwrap_or_default()
}

async fn fit(browser: &Browser, app: &TestApp) {
    browser.go("/rigs/mass/fit").await;
    browser.choose("[name=activate]", "never").await;
    browser.shoot(&shots(), "fit").await;
    browser.click("form.fields button.main").await;
    result(browser, Some("job")).await;
    browser.until("location.pathname === '/rigs/mass/models/1'").await;
    browser.shoot(&shots(), "model").await;
    assert_eq!(active(app).await, 0);
    browser.click("form[data-api^='PUT'] button").await;
    browser.until("document.querySelector('.tag.good')").await;
    assert_eq!(active(app).await, 1);
}

async fn predict(browser: &Browser, run: &str) {
    browser.go(&format!("/rigs/mass/runs/{run}")).await;
    browser.shoot(&shots(), "run").await;
    browser.click("a.button.main").await;
    browser.until("document.querySelector('[data-ratio]')").await;
    let ratio = browser.eval("Number(document.querySelector('[data-ratio]').textContent)").await;
    let ratio = ratio.as_f64().expect("a damage ratio");
    // The linear model knows nothing of the stiffening: its response, and with it the damage, is too large.
    assert!(ratio > 1.2 && ratio < 100.0, "{ratio}");
    browser.shoot(&shots(), "predict").await;
    browser.click("[data-zoom=in]").await;
    browser.until("document.querySelector('.zoom svg desc').textContent.startsWith('From 4 ')").await;
}

async fn diagnose(browser: &Browser, app: &TestApp, runs: &[String]) {
    browser.go(&format!("/rigs/mass/diagnose?run={}", runs[0])).await;
    for run in &runs[1..] {
        browser.click(&format!("input[value='{run}']")).await;
    }
    browser.shoot(&shots(), "diagnose").await;
    browser.click("form.fields button.main").await;
    result(browser, None).await;
    browser.until("location.pathname.startsWith('/rigs/mass/diagnoses/')").await;
    let diagnosis = browser.path().await;
    browser.shoot(&shots(), "diagnosis").await;
    let files = browser.eval("Promise.all([...document.querySelectorAll('a[data-save]')].map(a => fetch(a.href).then(r => r.status))).then(all => all.join())").await;
    let files = files.as_str().expect("a list").split(',').map(str::to_owned).collect::<Vec<_>>();
    assert!(files.len() >= 10 && files.iter().all(|status| status == "200"), "{files:?}");
    browser.choose("[name=activate]", "always").await;
    browser.click("form[data-api$='/adopt'] button").await;
    browser.until("location.pathname === '/rigs/mass/models/2'").await;
    assert_eq!(active(app).await, 2);
    browser.go(&format!("/rigs/mass/diagnoses/{}", diagnosis.rsplit('/').next().expect("an id"))).await;
    assert!(browser.shows("low noise 1").await, "the model's own runs have their names");
    browser.go("/rigs/mass/models/2").await;
    assert!(browser.shows("cubic_stiffness").await, "{}", browser.eval("document.body.innerText").await);
}

async fn study(browser: &Browser) {
    browser.go("/rigs/mass/study").await;
    browser.shoot(&shots(), "study-form").await;
    browser.choose("[name=kind]", "learning_curve").await;
    assert!(!browser.shows("Trials").await, "fields of other kinds are hidden");
    browser.choose("[name='fit.kind']", "frf").await;
    browser.fill("[name=sizes]", "3").await;
    browser.fill("[name=repeats]", "2").await;
    browser.click("form.fields button.main").await;
    result(browser, None).await;
    browser.until("location.pathname.startsWith('/rigs/mass/studies/')").await;
    browser.shoot(&shots(), "study").await;
    assert!(
        browser.shows("minutes of noise would").await,
        "{}",
        browser.eval("document.body.innerText").await
    );
}

async fn iterate(browser: &Browser, target: &str) {
    browser.go(&format!("/rigs/mass/iterate?run={target}")).await;
    browser.fill("[name=iterations]", "4").await;
    browser.fill("[name='limits.*.peak']", "50").await;
    browser.shoot(&shots(), "iterate").await;
    browser.click("form.fields button.main").await;
    result(browser, None).await;
    browser.until("location.pathname.startsWith('/rigs/mass/iterations/')").await;
    browser.shoot(&shots(), "iteration").await;
    browser.click("a.button.main").await;
    for _ in 0..100 {
        let mut found =
            std::fs::read_dir(browser.downloads.path()).expect("a directory").filter_map(Result::ok);
        if found.any(|file| file.path().extension().is_some_and(|ending| ending == "rsp")) {
            return;
        }
        tokio::time::sleep(std::time::Duration::from_millis(100)).await;
    }
    panic!("the drive was not downloaded");
}

#[tokio::test]
async fn an_engineer_comes_from_the_first_sign_in_to_a_drive_and_rolls_back() {
    let mut app = TestApp::start();
    let token = app.close_doors().await["secret"].as_str().expect("a secret").to_owned();
    let Some(browser) = Browser::start(&format!("http://{}", app.address())).await else { return };
    sign_in(&browser, &app, &token).await;
    make_rig(&browser).await;
    let folder = TempDir::new().expect("a directory");
    for (name, seed) in [("low noise 1", 3), ("low noise 2", 4)] {
        let file = record(&folder, &format!("noise{seed}.csv"), &drive(120.0, 0.15, seed), 10 + seed);
        upload_file(&browser, &file, name).await;
    }
    fit(&browser, &app).await;
    let (a, b) = (drive(16.0, 1.0, 1), drive(16.0, 0.7, 2));
    let mut high = Vec::new();
    for (k, drive) in [&a, &b, &b, &a].into_iter().enumerate() {
        high.push(
            upload(&app, &format!("kind=service&tag=high&name=load%20{k}"), drive, 11 + k as u64).await,
        );
    }
    predict(&browser, &high[0]).await;
    diagnose(&browser, &app, &high).await;
    iterate(&browser, &high[1]).await;
    study(&browser).await;
    browser.go("/rigs/mass/models/1").await;
    assert!(browser.shows("Roll back to this version").await);
    browser.click("form[data-api^='PUT'] button").await;
    browser.until("document.querySelector('.tag.good')").await;
    assert_eq!(active(&app).await, 1);
    for (path, name) in [
        ("/rigs/mass", "rig"),
        ("/", "rigs"),
        ("/jobs", "jobs"),
        ("/tokens", "tokens"),
        ("/operations", "operations"),
        ("/docs", "docs"),
    ] {
        browser.go(path).await;
        if path == "/docs" {
            browser.until("document.querySelector('.opblock')").await;
        } else {
            browser.shoot(&shots(), name).await;
        }
    }
    a_hostile_name_is_text(&browser, &app).await;
    app.delete("/v1/rigs/mass").await.expect(204);
    browser.go("/rigs/mass").await;
    assert!(browser.shows("No such rig").await);
    browser.shoot(&shots(), "gone").await;
    let complaints: Vec<String> =
        browser.complaints().await.into_iter().filter(|line| !line.contains("404 (Not Found)")).collect();
    assert!(complaints.is_empty(), "{complaints:?}");
}

async fn a_hostile_name_is_text(browser: &Browser, app: &TestApp) {
    let name = format!("<img src=x onerror=document.title='owned'>\u{202e}{}", "x".repeat(900));
    let mut rig = crate::diagnoses::rig::draft();
    (rig["id"], rig["name"]) = (json!("hostile"), json!(name));
    app.rig(&rig).await;
    browser.go("/").await;
    assert_ne!(browser.eval("document.title").await, "owned");
    browser.shoot(&shots(), "hostile").await;
}
