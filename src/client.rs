//! A small client of the HTTP contract, used by the demo and the examples. It depends on the contract only
//! and on no other part of the service.

use std::error::Error;
use std::time::Duration;

use bytes::Bytes;
use http_body_util::{BodyExt, Full};
use hyper::body::Incoming;
use hyper::header::{ACCEPT, AUTHORIZATION, CONTENT_TYPE, HeaderMap, HeaderName, HeaderValue, IF_MATCH};
use hyper::{Method, Request, Response, Uri};
use hyper_util::client::legacy::{self, connect::HttpConnector};
use hyper_util::rt::TokioExecutor;
use serde_json::{Value, json as document};

/// The reason why a call failed.
#[derive(Debug, thiserror::Error)]
pub enum ClientError {
    /// No HTTP answer.
    #[error("the service does not answer: {}", chain(.0.as_ref()))]
    Transport(Box<dyn Error + Send + Sync>),
    /// An address of a service that is none.
    #[error("{0:?} is no address of a service, such as http://127.0.0.1:8080")]
    Address(String),
    /// A problem document (RFC 9457).
    #[error("{status}: {}", explain(.problem))]
    Problem {
        /// HTTP status.
        status: u16,
        /// The document, or the text in its place.
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
    /// A token that cannot be sent in a header.
    #[error("the token is not valid: it has characters that no token has")]
    Token,
    /// An answer without a field that the contract promises.
    #[error("the answer lacks {0}")]
    Missing(&'static str),
}

/// An error and its causes: the first often says no more than that there is one.
fn chain(error: &(dyn Error + 'static)) -> String {
    let (mut told, mut cause) = (error.to_string(), error.source());
    while let Some(error) = cause {
        told = format!("{told}: {error}");
        cause = error.source();
    }
    told
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

/// A client of one service. Clones share its connections.
#[derive(Debug, Clone)]
pub struct Client {
    http: legacy::Client<HttpConnector, Full<Bytes>>,
    base: String,
    authorization: Option<HeaderValue>,
}

impl Client {
    /// A client of the service at `base`, such as `http://127.0.0.1:8080`, with a token if it asks
    /// for one.
    ///
    /// # Errors
    /// A token or an address that is none.
    pub fn new(base: &str, token: Option<&str>) -> Result<Self, ClientError> {
        let base = base.trim_end_matches('/');
        let uri: Option<Uri> = base.parse().ok();
        if !uri.is_some_and(|uri| uri.scheme_str() == Some("http") && uri.host().is_some()) {
            return Err(ClientError::Address(base.into()));
        }
        let authorization = token.map(|token| HeaderValue::try_from(format!("Bearer {token}"))).transpose();
        let mut authorization = authorization.map_err(|_| ClientError::Token)?;
        authorization.iter_mut().for_each(|value| value.set_sensitive(true));
        let mut connector = HttpConnector::new();
        connector.set_nodelay(true);
        let http = legacy::Client::builder(TokioExecutor::new()).build(connector);
        Ok(Self { http, base: base.into(), authorization })
    }

    /// `GET` of a JSON resource.
    ///
    /// # Errors
    /// [`ClientError::Problem`] for any status but 2xx.
    pub async fn get(&self, path: &str) -> Result<Value, ClientError> {
        json(self.send(Method::GET, path, &[], Vec::new()).await?).await
    }

    /// `POST` of a JSON document.
    ///
    /// # Errors
    /// [`ClientError::Problem`] for any status but 2xx.
    pub async fn post(&self, path: &str, body: &Value) -> Result<Value, ClientError> {
        let headers = [(CONTENT_TYPE, "application/json")];
        json(self.send(Method::POST, path, &headers, body.to_string().into_bytes()).await?).await
    }

    /// `DELETE` of a resource.
    ///
    /// # Errors
    /// [`ClientError::Problem`] for any status but 2xx.
    pub async fn delete(&self, path: &str) -> Result<(), ClientError> {
        self.send(Method::DELETE, path, &[], Vec::new()).await.map(|_| ())
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
        let path = with_query(&format!("/v1/rigs/{rig}/runs"), query);
        json(self.send(Method::POST, &path, &[(CONTENT_TYPE, content_type)], file).await?).await
    }

    /// Imports a model from a safetensors file.
    ///
    /// # Errors
    /// [`ClientError::Problem`] when the file is refused.
    pub async fn import(&self, rig: &str, weights: Vec<u8>) -> Result<Value, ClientError> {
        let headers = [(CONTENT_TYPE, "application/octet-stream")];
        json(self.send(Method::POST, &format!("/v1/rigs/{rig}/models"), &headers, weights).await?).await
    }

    /// Requests a fit and returns the id of the job.
    ///
    /// # Errors
    /// [`ClientError::Problem`] when the request is refused.
    pub async fn fit(&self, rig: &str, request: &Value) -> Result<String, ClientError> {
        let job = self.post(&format!("/v1/rigs/{rig}/fits"), request).await?;
        Ok(job["id"].as_str().ok_or(ClientError::Missing("id"))?.into())
    }

    /// Waits for a job, reporting its state several times a second, and returns it when it has succeeded.
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

    /// The model that a fit job has made.
    ///
    /// # Errors
    /// [`ClientError::Missing`] when the job names none.
    pub async fn fitted_model(&self, job: &Value) -> Result<Value, ClientError> {
        let href = job["result"]["href"].as_str().ok_or(ClientError::Missing("result.href"))?;
        self.get(href).await
    }

    /// Makes a version the rig's active model, whichever was active before.
    ///
    /// # Errors
    /// [`ClientError::Problem`] when the version cannot be active.
    pub async fn activate(&self, rig: &str, version: u64) -> Result<Value, ClientError> {
        let headers = [(CONTENT_TYPE, "application/json"), (IF_MATCH, "*")];
        let body = document!({ "version": version }).to_string().into_bytes();
        json(self.send(Method::PUT, &format!("/v1/rigs/{rig}/active-model"), &headers, body).await?).await
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
        let query = [("model", model), ("sample_rate_hz", rate.as_str())];
        let path = with_query(&format!("/v1/rigs/{rig}/predict"), &query);
        let headers = [(CONTENT_TYPE, "application/x-npy"), (ACCEPT, "application/x-npy")];
        let answer = self.send(Method::POST, &path, &headers, drive).await?;
        let trust_inside = header(answer.headers(), "rigcast-trust-inside");
        Ok(NpyPrediction { npy: bytes(answer).await?.to_vec(), trust_inside })
    }

    /// Sends a request and waits for the head of its answer, which is a 2xx.
    async fn send(
        &self,
        method: Method,
        path: &str,
        headers: &[(HeaderName, &str)],
        body: Vec<u8>,
    ) -> Result<Response<Incoming>, ClientError> {
        let mut request = Request::builder().method(method).uri(format!("{}{path}", self.base));
        for (name, value) in headers {
            request = request.header(name, *value);
        }
        if let Some(authorization) = &self.authorization {
            request = request.header(AUTHORIZATION, authorization);
        }
        let request = request.body(Full::from(body)).map_err(transport)?;
        let answer = self.http.request(request).await.map_err(transport)?;
        let status = answer.status();
        if status.is_success() {
            return Ok(answer);
        }
        let text = bytes(answer).await?;
        let problem = serde_json::from_slice(&text);
        let problem = problem.unwrap_or_else(|_| Value::String(String::from_utf8_lossy(&text).into_owned()));
        Err(ClientError::Problem { status: status.as_u16(), problem })
    }
}

/// A path with its query, percent-encoded.
fn with_query(path: &str, query: &[(&str, &str)]) -> String {
    let query = form_urlencoded::Serializer::new(String::new()).extend_pairs(query).finish();
    if query.is_empty() { path.into() } else { format!("{path}?{query}") }
}

fn transport(error: impl Into<Box<dyn Error + Send + Sync>>) -> ClientError {
    ClientError::Transport(error.into())
}

/// Seconds between start and end of a finished job.
pub fn elapsed_s(job: &Value) -> Option<f64> {
    let time = |key: &str| job[key].as_str()?.parse::<jiff::Timestamp>().ok();
    Some(time("finished_at")?.duration_since(time("started_at")?).as_secs_f64())
}

fn header(headers: &HeaderMap, name: &str) -> Option<f64> {
    headers.get(name)?.to_str().ok()?.parse().ok()
}

async fn bytes(answer: Response<Incoming>) -> Result<Bytes, ClientError> {
    Ok(answer.into_body().collect().await.map_err(transport)?.to_bytes())
}

async fn json(answer: Response<Incoming>) -> Result<Value, ClientError> {
    serde_json::from_slice(&bytes(answer).await?).map_err(transport)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_query_says_what_was_meant_whatever_is_in_it() {
        assert_eq!(
            with_query("/runs", &[("name", "a b&c=d"), ("tag", "ü")]),
            "/runs?name=a+b%26c%3Dd&tag=%C3%BC"
        );
        assert_eq!(with_query("/runs", &[]), "/runs");
    }

    #[test]
    fn addresses_and_tokens_that_are_none_are_refused() {
        for base in ["127.0.0.1:8080", "https://lab", "", "http://"] {
            assert!(matches!(Client::new(base, None), Err(ClientError::Address(_))), "{base}");
        }
        assert!(matches!(Client::new("http://lab", Some("a\nb")), Err(ClientError::Token)));
        assert!(Client::new("http://lab:80/", Some("a")).is_ok());
    }

    #[tokio::test]
    async fn a_service_that_is_not_there_is_told_with_the_cause() {
        // A port that was free a moment ago.
        let free = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
        let told = Client::new(&format!("http://{free}"), None).unwrap().get("/livez").await.unwrap_err();
        let told = told.to_string();
        assert!(told.starts_with("the service does not answer: ") && told.contains("refused"), "{told}");
    }
}
