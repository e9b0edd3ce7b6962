//! The session of one rig with the service: upload runs, fit a sim, request a diagnosis.

use std::collections::HashMap;

use rigcast::client::{Client, ClientError};
use serde_json::{Value, json};

use crate::AnyError;

/// A rig of the service and its runs by name.
pub struct Session<'a> {
    client: &'a Client,
    rig: String,
    runs: HashMap<String, String>,
}

impl<'a> Session<'a> {
    /// Creates the rig; `rig` is the body of `POST /v1/rigs`.
    pub async fn open(client: &'a Client, rig: &Value) -> Result<Self, AnyError> {
        let made = client.post("/v1/rigs", rig).await?;
        let id = made["id"].as_str().ok_or(ClientError::Missing("id"))?;
        Ok(Self { client, rig: id.into(), runs: HashMap::new() })
    }

    /// Uploads a recording.
    pub async fn upload(
        &mut self,
        name: &str,
        kind: &str,
        started_at: &str,
        content_type: &str,
        file: Vec<u8>,
    ) -> Result<(), AnyError> {
        let query = [("name", name), ("kind", kind), ("started_at", started_at)];
        let run = self.client.upload(&self.rig, &query, content_type, file).await?;
        let id = run["id"].as_str().ok_or(ClientError::Missing("id"))?;
        self.runs.insert(name.into(), id.into());
        Ok(())
    }

    /// The service's ids of runs.
    ///
    /// # Errors
    /// A name that was not uploaded.
    pub fn ids(&self, names: &[&str]) -> Result<Value, String> {
        let id = |name: &&str| self.runs.get(*name).cloned().ok_or_else(|| format!("no run {name}"));
        names.iter().map(id).map(|id| id.map(Value::from)).collect()
    }

    /// Imports a sim as safetensors and returns its version.
    pub async fn import(&self, weights: Vec<u8>) -> Result<u64, AnyError> {
        let model = self.client.import(&self.rig, weights).await?;
        Ok(model["version"].as_u64().ok_or(ClientError::Missing("version"))?)
    }

    /// Fits a sim to runs and returns its version.
    pub async fn fit(&self, request: &Value, runs: &[&str]) -> Result<u64, AnyError> {
        let mut request = request.clone();
        request["runs"] = self.ids(runs)?;
        let job = self.client.fit(&self.rig, &request).await?;
        let job = self.client.wait(&job, |_| {}).await?;
        let model = self.client.fitted_model(&job).await?;
        Ok(model["version"].as_u64().ok_or(ClientError::Missing("version"))?)
    }

    /// What a version makes of an NPY file of drives, as such a file.
    pub async fn predict_file(
        &self,
        version: u64,
        rate_hz: f64,
        drive: Vec<u8>,
    ) -> Result<Vec<u8>, AnyError> {
        let answer = self.client.predict_npy(&self.rig, &version.to_string(), rate_hz, drive).await?;
        Ok(answer.npy)
    }

    /// The path of a diagnosis and its report.
    pub async fn diagnose(&self, request: &Value) -> Result<(String, Value), AnyError> {
        let job = self.client.post(&format!("/v1/rigs/{}/diagnoses", self.rig), request).await?;
        let id = job["id"].as_str().ok_or(ClientError::Missing("id"))?;
        let job = self.client.wait(id, |_| {}).await?;
        let href = job["result"]["href"].as_str().ok_or(ClientError::Missing("result.href"))?;
        let report = self.client.get(href).await?;
        Ok((href.into(), report))
    }

    /// Adopts the first hypothesis and returns the version of the model.
    pub async fn adopt(&self, diagnosis: &str) -> Result<u64, AnyError> {
        let model = self.client.post(&format!("{diagnosis}/adopt"), &json!({})).await?;
        Ok(model["version"].as_u64().ok_or(ClientError::Missing("version"))?)
    }

    /// The response of a model to a drive.
    pub async fn predict(&self, version: u64, drive: &Value) -> Result<Value, AnyError> {
        let request = json!({"model": version, "drive": drive, "include": ["response"]});
        let mut answer = self.client.post(&format!("/v1/rigs/{}/predict", self.rig), &request).await?;
        Ok(answer["response"].take())
    }
}
