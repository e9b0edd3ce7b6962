//! A small client of the service's HTTP contract: what the demo and the examples speak.
//!
//! It knows paths, media types and problem documents, and nothing of the service's inside.

use std::time::Duration;

use reqwest::header::{ACCEPT, AUTHORIZATION, CONTENT_TYPE, HeaderMap, HeaderValue};
use serde_json::Value;

/// Why a call did not give an answer.
#[derive(Debug, thiserror::Error)]
pub enum ClientError {
    /// No HTTP answer.
    #[error("the service does not answer: {0}")]
    Transport(#[from] reqwest::Error),
    /// A problem document (RFC 9457).
    #[error("{status}: {}", explain(.problem))]
    Problem {
        /// HTTP status.
        status: u16,
        /// The document, or the text that came instead.
        problem: Value,
    },
    /// A job that did not succeed.
    #[error("job {id} {state}: {}", explain(.problem))]
    Job {
        /// Job id.
        id: String,
        /// `failed` or `cancelled`.
        state: String,
        /// Its problem.
        problem: Value,
    },
    /// A token that cannot stand in a header.
    #[error("the token is none: it has characters that no token has")]
    Token,
    /// An answer without a field that the contract promises.
    #[error("the answer lacks {0}")]
    Missing(&'static str),
}

fn explain(problem: &Value) -> String {
    match (problem["title"].as_str(), problem["detail"].as_str()) {
        (Some(title), Some(detail)) => format!("{title}: {detail}"),
        (Some(text), None) | (None, Some(text)) => text.into(),
        (None, None) => problem.to_string(),
    }
}

/// An answer to a prediction in NPY.
#[derive(Debug, Clone)]
pub struct NpyPrediction {
    /// The NPY file, `[samples, outputs]`.
    pub npy: Vec<u8>,
    /// Share of samples inside the training range, if the model knows it.
    pub trust_inside: Option<f64>,
}

/// A connection to one service.
#[derive(Debug, Clone)]
pub struct Client {
    http: reqwest::Client,
    base: String,
}

impl Client {
    /// A client of the service at `base`, such as `http://127.0.0.1:8080`, with a token if it asks
    /// for one.
    ///
    /// # Errors
    /// A token that is none; when no HTTP client can be built.
    pub fn new(base: &str, token: Option<&str>) -> Result<Self, ClientError> {
        let mut headers = HeaderMap::new();
        if let Some(token) = token {
            let value = HeaderValue::try_from(format!("Bearer {token}"));
            let mut value = value.map_err(|_| ClientError::Token)?;
            value.set_sensitive(true);
            headers.insert(AUTHORIZATION, value);
        }
        let http = reqwest::Client::builder().default_headers(headers).build()?;
        Ok(Self { http, base: base.trim_end_matches('/').into() })
    }

    /// `GET` of a JSON resource.
    ///
    /// # Errors
    /// [`ClientError::Problem`] for any status but 2xx.
    pub async fn get(&self, path: &str) -> Result<Value, ClientError> {
        json(self.http.get(self.url(path)).send().await?).await
    }

    /// `POST` of a JSON document.
    ///
    /// # Errors
    /// [`ClientError::Problem`] for any status but 2xx.
    pub async fn post(&self, path: &str, body: &Value) -> Result<Value, ClientError> {
        json(self.http.post(self.url(path)).json(body).send().await?).await
    }

    /// `DELETE` of a resource.
    ///
    /// # Errors
    /// [`ClientError::Problem`] for any status but 2xx.
    pub async fn delete(&self, path: &str) -> Result<(), ClientError> {
        ok(self.http.delete(self.url(path)).send().await?).await.map(|_| ())
    }

    /// Uploads a run: `query` as in `POST /v1/rigs/{rig}/runs`, the body is the file.
    ///
    /// # Errors
    /// [`ClientError::Problem`] when the run is refused.
    pub async fn upload(
        &self,
        rig: &str,
        query: &[(&str, &str)],
        content_type: &str,
        file: Vec<u8>,
    ) -> Result<Value, ClientError> {
        let request = self.http.post(self.url(&format!("/v1/rigs/{rig}/runs")));
        json(request.query(query).header(CONTENT_TYPE, content_type).body(file).send().await?).await
    }

    /// Imports a model from a safetensors file.
    ///
    /// # Errors
    /// [`ClientError::Problem`] when the file is refused.
    pub async fn import(&self, rig: &str, weights: Vec<u8>) -> Result<Value, ClientError> {
        let request = self.http.post(self.url(&format!("/v1/rigs/{rig}/models")));
        json(request.header(CONTENT_TYPE, "application/octet-stream").body(weights).send().await?).await
    }

    /// Asks for a fit and answers the job's id.
    ///
    /// # Errors
    /// [`ClientError::Problem`] when the request is refused.
    pub async fn fit(&self, rig: &str, request: &Value) -> Result<String, ClientError> {
        let job = self.post(&format!("/v1/rigs/{rig}/fits"), request).await?;
        Ok(job["id"].as_str().ok_or(ClientError::Missing("id"))?.into())
    }

    /// Waits for a job, telling its state several times a second, and answers it when it has
    /// succeeded.
    ///
    /// # Errors
    /// [`ClientError::Job`] when it fails or is cancelled.
    pub async fn wait(&self, job: &str, mut tell: impl FnMut(&Value)) -> Result<Value, ClientError> {
        loop {
            let state = self.get(&format!("/v1/jobs/{job}")).await?;
            tell(&state);
            match state["state"].as_str() {
                Some("succeeded") => return Ok(state),
                Some(end @ ("failed" | "cancelled")) => {
                    return Err(ClientError::Job {
                        id: job.into(),
                        state: end.into(),
                        problem: state["problem"].clone(),
                    });
                }
                _ => tokio::time::sleep(Duration::from_millis(200)).await,
            }
        }
    }

    /// The model that a succeeded fit job made.
    ///
    /// # Errors
    /// [`ClientError::Missing`] when the job names none.
    pub async fn fitted_model(&self, job: &Value) -> Result<Value, ClientError> {
        let href = job["result"]["href"].as_str().ok_or(ClientError::Missing("result.href"))?;
        self.get(href).await
    }

    /// Predicts with an NPY body and an NPY answer; `model` is `active` or a version.
    ///
    /// # Errors
    /// [`ClientError::Problem`] when the drive is refused.
    pub async fn predict_npy(
        &self,
        rig: &str,
        model: &str,
        sample_rate_hz: f64,
        drive: Vec<u8>,
    ) -> Result<NpyPrediction, ClientError> {
        let rate = sample_rate_hz.to_string();
        let request = self
            .http
            .post(self.url(&format!("/v1/rigs/{rig}/predict")))
            .query(&[("model", model), ("sample_rate_hz", &rate)])
            .header(CONTENT_TYPE, "application/x-npy")
            .header(ACCEPT, "application/x-npy");
        let answer = ok(request.body(drive).send().await?).await?;
        let trust_inside = header(answer.headers(), "rigcast-trust-inside");
        Ok(NpyPrediction { npy: answer.bytes().await?.to_vec(), trust_inside })
    }

    fn url(&self, path: &str) -> String {
        format!("{}{path}", self.base)
    }
}

/// Seconds between start and end of a finished job.
pub fn elapsed_s(job: &Value) -> Option<f64> {
    let time = |key: &str| job[key].as_str()?.parse::<jiff::Timestamp>().ok();
    Some(time("finished_at")?.duration_since(time("started_at")?).as_secs_f64())
}

fn header(headers: &HeaderMap, name: &str) -> Option<f64> {
    headers.get(name)?.to_str().ok()?.parse().ok()
}

async fn ok(answer: reqwest::Response) -> Result<reqwest::Response, ClientError> {
    let status = answer.status();
    if status.is_success() {
        return Ok(answer);
    }
    let text = answer.text().await?;
    let problem = serde_json::from_str(&text).unwrap_or(Value::String(text));
    Err(ClientError::Problem { status: status.as_u16(), problem })
}

async fn json(answer: reqwest::Response) -> Result<Value, ClientError> {
    Ok(ok(answer).await?.json().await?)
}
