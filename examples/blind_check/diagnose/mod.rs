//! Diagnoses all cases with a service, over HTTP like any user. Labels are not read; a further run of a
//! case's rig is made by the lab, which is another process.

use std::fs;
use std::path::{Path, PathBuf};

use futures::stream::{self, StreamExt};
use indicatif::{ProgressBar, ProgressStyle};
use rigcast::client::Client;
use rigcast::demo::LocalService;
use serde_json::{Map, Value, json};

use crate::AnyError;
use session::Session;

mod lab;
pub mod session;

/// Arguments.
pub struct How {
    /// Directory of the cases.
    pub dir: PathBuf,
    /// A running service; `None`: one is started.
    pub service: Option<String>,
    /// Token for the service.
    pub token: Option<String>,
    /// Cases at a time.
    pub in_flight: usize,
    /// Fit an FRF to the baseline runs instead of importing the sim.
    pub fit_sims: bool,
    /// Ask by default requests: of each drive one run, and the FRF that the service fits to these.
    pub plain: bool,
}

/// Writes `reports/<id>.json` for every case that has none yet.
///
/// # Errors
/// No cases, or a service that cannot be started; what goes wrong in a case stands in its report.
pub fn run(how: &How) -> Result<(), AnyError> {
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
    runtime.block_on(async {
        let own = match how.service {
            Some(_) => None,
            None => Some(LocalService::start(([127, 0, 0, 1], 0).into(), None).await?),
        };
        let url = own.as_ref().map(LocalService::url).or(how.service.clone()).ok_or("no service")?;
        all(how, &Client::new(&url, how.token.as_deref())?).await?;
        if let Some(own) = own {
            own.stop().await?;
        }
        Ok(())
    })
}

async fn all(how: &How, client: &Client) -> Result<(), AnyError> {
    let dir = &how.dir;
    let reports = dir.join("reports");
    fs::create_dir_all(&reports)?;
    let mut folders: Vec<PathBuf> =
        fs::read_dir(dir.join("cases"))?.map(|e| Ok(e?.path())).collect::<std::io::Result<_>>()?;
    folders.sort();
    let mut together = Vec::new();
    let mut alone = Vec::new();
    for folder in folders {
        let about: Value = serde_json::from_slice(&fs::read(folder.join("case.json"))?)?;
        let report = reports.join(format!("{}.json", about["id"].as_str().ok_or("a case without id")?));
        if !report.exists() {
            let list = if about["alone"] == true { &mut alone } else { &mut together };
            list.push((folder, about, report));
        }
    }
    let style = ProgressStyle::with_template("{prefix:>9} {bar:32} {pos}/{len}, {eta} left")?;
    let bar = ProgressBar::new((together.len() + alone.len()) as u64).with_style(style);
    bar.set_prefix("diagnose");
    bar.tick();
    for (list, width) in [(together, how.in_flight.max(1)), (alone, 1)] {
        let cases = list.into_iter().map(|(folder, about, report)| {
            let bar = &bar;
            async move {
                let answer = answer(how, client, &folder, &about).await;
                bar.inc(1);
                fs::write(report, answer.to_string())
            }
        });
        let mut written = stream::iter(cases).buffer_unordered(width);
        while let Some(result) = written.next().await {
            result?;
        }
    }
    bar.finish_and_clear();
    Ok(())
}

/// The result of one case: its report and the checks of it, or the error.
async fn answer(how: &How, client: &Client, folder: &Path, about: &Value) -> Value {
    let found = ask(how, client, folder, about).await;
    let rig = about["rig"]["id"].as_str().unwrap_or_default();
    let deleted = client.delete(&format!("/v1/rigs/{rig}")).await;
    match (found, deleted) {
        (Ok(answer), Ok(())) => answer,
        (Ok(mut answer), Err(e)) => {
            answer["error"] = format!("rig not deleted: {e}").into();
            answer
        }
        (Err(e), _) => json!({"report": null, "error": e.to_string()}),
    }
}

async fn ask(how: &How, client: &Client, folder: &Path, about: &Value) -> Result<Value, AnyError> {
    let mut session = Session::open(client, &about["rig"]).await?;
    for run in about["runs"].as_array().into_iter().flatten() {
        let word = |key: &str| run[key].as_str().ok_or_else(|| format!("a run without {key}"));
        let file = fs::read(folder.join(word("file")?))?;
        session.upload(word("name")?, word("kind")?, word("started_at")?, "application/x-npy", file).await?;
    }
    let names = |baseline: bool| -> Vec<&str> {
        let runs = about["runs"].as_array().into_iter().flatten();
        runs.filter(|r| r["baseline"] == baseline).filter_map(|r| r["name"].as_str()).collect()
    };
    if how.plain || !about["asked"].is_null() {
        return asked_plainly(&session, about).await;
    }
    let model = match about["sim"].as_str() {
        Some(file) if !how.fit_sims => session.import(fs::read(folder.join(file))?).await?,
        _ => {
            let frf = json!({"kind": "frf"});
            let fit = Some(&about["fit"]).filter(|fit| fit.is_object()).unwrap_or(&frf);
            session.fit(fit, &names(true)).await?
        }
    };
    if about["default_request"] == true {
        let request = json!({"model": model, "runs": session.ids(&names(false))?});
        let (_, report) = session.diagnose(&request).await?;
        return Ok(json!({"report": report}));
    }
    let mut request = about["diagnosis"].clone();
    request["model"] = model.into();
    request["baseline_runs"] = session.ids(&names(true))?;
    request["runs"] = session.ids(&names(false))?;
    request["repeats"] = about["repeats"]
        .as_array()
        .into_iter()
        .flatten()
        .map(|group| {
            session
                .ids(&group.as_array().map_or(Vec::new(), |g| g.iter().filter_map(Value::as_str).collect()))
        })
        .collect::<Result<Vec<Value>, _>>()?
        .into();
    let (href, report) = session.diagnose(&request).await?;
    let mut answer = json!({"report": report});
    // The steps that follow may fail without invalidating the report.
    match check(&session, folder, about, &answer["report"], model, &href).await {
        Ok(found) => answer["check"] = found,
        Err(e) => answer["error"] = format!("check: {e}").into(),
    }
    if about["next_experiment"] == true {
        match lab::further(&how.dir, folder, about, &mut session, &request, &answer["report"]).await {
            Ok(found) => answer["next"] = found,
            Err(e) => answer["error"] = format!("next experiment: {e}").into(),
        }
    }
    Ok(answer)
}

/// A default request: a model that the service fits to the runs, and the runs: those that the case asks about, or of
/// each drive one.
async fn asked_plainly(session: &Session<'_>, about: &Value) -> Result<Value, AnyError> {
    let groups = about["repeats"].as_array();
    let again = |name: &str| {
        let later = |group: &Value| group.as_array().is_some_and(|g| g.iter().skip(1).any(|n| n == name));
        groups.is_some_and(|groups| groups.iter().any(later))
    };
    let runs: Vec<&str> = about["runs"]
        .as_array()
        .into_iter()
        .flatten()
        .filter(|run| run["baseline"] == false)
        .filter_map(|run| run["name"].as_str())
        .filter(|name| match about["asked"].as_array() {
            Some(asked) => asked.iter().any(|a| a == name),
            None => !again(name),
        })
        .collect();
    let model = session.fit(&json!({"kind": "frf"}), &runs).await?;
    let request = json!({"model": model, "runs": session.ids(&runs)?});
    let (_, report) = session.diagnose(&request).await?;
    Ok(json!({"report": report}))
}

/// The predictions of the sim, and of the sim with the blamed effect adopted, for fresh drives.
async fn check(
    session: &Session<'_>,
    folder: &Path,
    about: &Value,
    report: &Value,
    model: u64,
    href: &str,
) -> Result<Value, AnyError> {
    let checks = about["check"].as_array().map_or(&[][..], Vec::as_slice);
    let kind = report["verdict"]["kind"].as_str();
    if checks.is_empty() || !matches!(kind, Some("identified" | "partial")) {
        return Ok(Value::Null);
    }
    let adopted = session.adopt(href).await?;
    let mut found = Map::new();
    for (name, version) in [("sim", model), ("adopted", adopted)] {
        let mut responses = Vec::new();
        for file in checks.iter().filter_map(Value::as_str) {
            let drive = serde_json::from_slice(&fs::read(folder.join(file))?)?;
            responses.push(session.predict(version, &drive).await?);
        }
        found.insert(name.into(), responses.into());
    }
    Ok(found.into())
}
