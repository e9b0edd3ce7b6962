//! Pages for people. A page has the path of what it shows in the API, without `/v1`. It reads with the same functions as the
//! API; what it changes goes through the API, sent by the page's script with the session's CSRF token.

mod admin;
mod assets;
mod figure;
mod jobs;
mod models;
mod predict;
mod reports;
mod rigs;
mod runs;
mod sign_in;
mod views;

use axum::extract::FromRequestParts;
use axum::http::HeaderValue;
use axum::http::header::{CONTENT_SECURITY_POLICY, CONTENT_TYPE};
use axum::http::request::Parts;
use axum::response::IntoResponse;

use super::Shared;
use super::auth::{Caller, Identity};
use super::headers::PAGE;
use super::problem::{Answer, Problem};
use crate::ui::frame;

pub use admin::{docs, operations, tokens};
pub use assets::show as asset;
pub use jobs::{list as jobs, show as job};
pub use models::{report as model_report, show as model};
pub use predict::show as predict;
pub use reports::{diagnose, diagnosis, evaluate, evaluation, iterate, iteration, start_study, study};
pub use rigs::{drift, fit, list as rigs, show as rig, upload};
pub use runs::{file as run_file, show as run};
pub use sign_in::{session, show as sign_in, sign_in as begin_session, sign_out, signed_in};
pub use views::RunViews;

/// The person who looks at a page, as the guard identified it.
#[derive(Debug, Clone)]
pub struct Visitor {
    /// The caller.
    pub caller: Caller,
    /// The same for the page.
    pub shown: frame::Visitor,
}

impl From<Identity> for Visitor {
    fn from(Identity { caller, csrf }: Identity) -> Self {
        let token = caller.token().map(|token| token.name.clone());
        let shown = frame::Visitor { token, role: caller.role(), all_rigs: caller.scope().is_none(), csrf };
        Self { caller, shown }
    }
}

impl FromRequestParts<Shared> for Visitor {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, http: &Shared) -> Answer<Self> {
        // A public page identifies its visitor itself.
        match parts.extensions.get::<Identity>().cloned() {
            Some(identity) => Ok(identity.into()),
            None => http.auth.identify(parts, http.now()).await.map(Into::into),
        }
    }
}

/// The answer with a page.
fn html(page: String) -> Answer {
    let kind = HeaderValue::from_static("text/html; charset=utf-8");
    Ok(([(CONTENT_TYPE, kind), (CONTENT_SECURITY_POLICY, HeaderValue::from_static(PAGE))], page)
        .into_response())
}
