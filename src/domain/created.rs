//! The answer to a creating request. It is stored, and repeated when the request comes again under its
//! idempotency key.

use serde::Serialize;

use super::{InsertedRun, Job, Model, Rig, Token};

/// Paths of tokens begin with this.
const TOKENS: &str = "/v1/tokens/";

/// Status, location and JSON of a created resource.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Created {
    /// 201 for a resource, 202 for a job.
    pub status: u16,
    /// Path.
    pub location: String,
    /// `ETag` of a resource that can change.
    pub etag: Option<String>,
    /// JSON.
    pub body: String,
}

impl Created {
    fn new(status: u16, location: String, what: &impl Serialize) -> Self {
        let body = serde_json::to_string(what).expect("finite numbers and text always serialise");
        Self { status, location, etag: None, body }
    }

    /// A rig.
    pub fn rig(rig: &Rig) -> Self {
        Self { etag: Some(rig.etag()), ..Self::new(201, format!("/v1/rigs/{}", rig.id), rig) }
    }

    /// An accepted run.
    pub fn run(inserted: &InsertedRun) -> Self {
        Self::new(201, format!("/v1/rigs/{}/runs/{}", inserted.run.rig, inserted.run.id), inserted)
    }

    /// A queued job.
    pub fn job(job: &Job) -> Self {
        Self::new(202, format!("/v1/jobs/{}", job.id), job)
    }

    /// An imported model.
    pub fn model(model: &Model) -> Self {
        Self::new(201, format!("/v1/rigs/{}/models/{}", model.rig, model.version), model)
    }

    /// A token, without its secret, which is never stored.
    pub fn token(token: &Token) -> Self {
        Self::new(201, format!("{TOKENS}{}", token.id), token)
    }

    /// The id of the token that was created, if it was one.
    pub fn token_id(&self) -> Option<&str> {
        self.location.strip_prefix(TOKENS)
    }

    /// A model version that an effect was adopted into.
    pub fn adopted(model: &Model) -> Self {
        #[derive(Serialize)]
        struct NewVersion<'a> {
            version: u32,
            href: &'a str,
        }
        let href = format!("/v1/rigs/{}/models/{}", model.rig, model.version);
        let version = NewVersion { version: model.version, href: &href };
        Self::new(201, href.clone(), &version)
    }
}
