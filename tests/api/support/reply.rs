//! Requests and answers; every answer is checked against the contract.

use std::collections::BTreeSet;
use std::sync::{Arc, Mutex};

use reqwest::header::HeaderMap;
use serde_json::Value;

use super::contract::Contract;

/// A request before it is sent.
pub struct Call {
    request: reqwest::RequestBuilder,
    method: reqwest::Method,
    path: String,
    json: Option<Value>,
    succeeded: Arc<Mutex<BTreeSet<String>>>,
}

/// An answer, read to its end.
#[derive(Debug)]
pub struct Reply {
    /// Status.
    pub status: u16,
    /// Headers.
    pub headers: HeaderMap,
    /// Body.
    pub bytes: Vec<u8>,
}

impl Call {
    pub(super) fn new(
        request: reqwest::RequestBuilder,
        method: reqwest::Method,
        path: &str,
        succeeded: Arc<Mutex<BTreeSet<String>>>,
    ) -> Self {
        Self { request, method, path: path.to_owned(), json: None, succeeded }
    }

    /// Adds a header.
    pub fn header(mut self, name: &str, value: &str) -> Self {
        self.request = self.request.header(name, value);
        self
    }

    /// A JSON body.
    pub fn json(mut self, body: &Value) -> Self {
        self.json = Some(body.clone());
        self.body("application/json", serde_json::to_vec(body).expect("JSON"))
    }

    /// A body of any type.
    pub fn body(mut self, media_type: &str, bytes: impl Into<Vec<u8>>) -> Self {
        self.request = self.request.header("content-type", media_type).body(bytes.into());
        self
    }

    /// Sends it, and checks the answer against the contract.
    pub async fn send(self) -> Reply {
        let response = self.request.send().await.expect("the service answers");
        let (status, headers) = (response.status().as_u16(), response.headers().clone());
        let bytes = response.bytes().await.expect("a whole answer").to_vec();
        let reply = Reply { status, headers, bytes };
        let contract = Contract::get();
        if let Some(operation) = contract.check(self.method.as_str(), &self.path, self.json.as_ref(), &reply)
            && (200..300).contains(&status)
        {
            self.succeeded.lock().expect("no test panics with the lock").insert(operation);
        }
        reply
    }
}

impl Reply {
    /// The answer, if it has this status.
    #[track_caller]
    pub fn expect(self, status: u16) -> Self {
        assert_eq!(self.status, status, "{}", String::from_utf8_lossy(&self.bytes));
        self
    }

    /// The body as JSON.
    #[track_caller]
    pub fn json(&self) -> Value {
        serde_json::from_slice(&self.bytes)
            .unwrap_or_else(|e| panic!("{e}: {}", String::from_utf8_lossy(&self.bytes)))
    }

    /// The body as text.
    #[track_caller]
    pub fn text(&self) -> &str {
        std::str::from_utf8(&self.bytes).expect("UTF-8")
    }

    /// A header as text.
    #[track_caller]
    pub fn header(&self, name: &str) -> &str {
        self.headers.get(name).unwrap_or_else(|| panic!("no header {name}")).to_str().expect("text")
    }

    /// The problem document, which must have this status and code.
    #[track_caller]
    pub fn problem(self, status: u16, code: &str) -> Value {
        let text = String::from_utf8_lossy(&self.bytes).into_owned();
        assert_eq!(self.status, status, "{text}");
        let problem = self.json();
        assert_eq!(problem["code"], code, "{text}");
        problem
    }
}
