//! Receives an upload: a file with its description in the query, or a form that holds both.

use axum::body::Body;
use axum::http::HeaderMap;

use super::{KINDS, SPLITS, form};
use crate::domain::run::RunMeta;
use crate::domain::{RunKind, Split};
use crate::formats::Format;
use crate::http::jobs::word;
use crate::http::measurement::{self, FileQuery};
use crate::http::params::{Params, invalid};
use crate::http::problem::Answer;
use crate::http::upload::Upload;
use crate::http::{Http, body, upload};

/// A file that has come whole, with what the client says of it.
#[derive(Debug)]
pub struct Received {
    pub description: Description,
    /// Its format, where the client says it.
    pub format: Option<Format>,
    pub upload: Upload,
}

/// The parameters of an upload.
#[derive(Debug)]
pub struct Description {
    /// What the run will say of itself.
    pub meta: RunMeta,
    /// How the file is to be read.
    pub query: FileQuery,
    /// Whether nothing is to be stored.
    pub is_dry: bool,
}

impl Received {
    /// Receives a body of either kind. Errors of the query are reported before a file comes; the fields of a form come
    /// beside it.
    ///
    /// # Errors
    /// `query.invalid`, `query.unknown_parameter`, `content_type.unsupported`, those of [`form::receive`].
    pub async fn take(http: &Http, mut params: Params, headers: &HeaderMap, body: Body) -> Answer<Self> {
        let media_type = body::media_type(headers);
        if media_type.as_deref() == Some(form::MEDIA_TYPE) {
            let form = form::receive(http, headers, body).await?;
            params.add_fields(form.fields)?;
            let description = Description::take(params)?;
            return Ok(Self { description, format: form.format, upload: form.upload });
        }
        let description = Description::take(params)?;
        let format = measurement::format(media_type.as_deref())?;
        let upload = upload::receive(http, headers, body).await?;
        Ok(Self { description, format, upload })
    }
}

impl Description {
    /// Takes all parameters; any other is refused.
    fn take(mut params: Params) -> Answer<Self> {
        let meta = meta(&mut params)?;
        let query = FileQuery::take(&mut params)?;
        let is_dry = params.flag("dry_run")?;
        params.finish()?;
        Ok(Self { meta, query, is_dry })
    }
}

/// Takes the description of a run.
fn meta(params: &mut Params) -> Answer<RunMeta> {
    let meta = RunMeta {
        name: params.one("name")?.unwrap_or_default(),
        kind: word(params, "kind", KINDS)?.unwrap_or(RunKind::Other),
        split: word(params, "split", SPLITS)?.unwrap_or(Split::Training),
        tags: params.all("tag"),
        started_at: params.parse("started_at", "a time like 2026-03-01T12:00:00Z")?,
    };
    meta.check().map_err(|found| {
        let name = if found.iter().any(|e| e.pointer.starts_with("/tags")) { "tag" } else { "name" };
        let limit = found.first().and_then(|e| e.limit.clone()).unwrap_or_default();
        invalid(name, "does not fit", &limit)
    })
}
