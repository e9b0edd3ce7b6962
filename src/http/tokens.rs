//! Creating, listing and revoking tokens. Only the answer to the creating request has the secret.

use axum::extract::State;
use axum::http::StatusCode;
use axum::response::IntoResponse;
use serde::Serialize;

use super::idempotency::RequestKey;
use super::json::{self, Json};
use super::params::{NoParams, Params, page};
use super::paths::{OfToken, no_token};
use super::problem::{Answer, Problem};
use super::{Shared, codes, errors};
use crate::domain::{Secret, Token, TokenDraft};
use crate::storage::TokenInsert;

/// A new token with its secret.
#[derive(Serialize)]
struct NewToken<'a> {
    #[serde(flatten)]
    token: &'a Token,
    secret: &'a str,
}

/// `GET /v1/tokens`
pub async fn list(State(http): State<Shared>, mut params: Params) -> Answer {
    let page = page(&mut params)?;
    params.finish()?;
    json::answer(&http.store.tokens(&page).await?)
}

/// `POST /v1/tokens`
pub async fn create(
    State(http): State<Shared>,
    _: NoParams,
    key: RequestKey,
    Json(draft): Json<TokenDraft>,
) -> Answer {
    draft.check(http.now()).map_err(|found| {
        Problem::new(codes::BODY_INVALID_VALUE, errors::summary("The token does not make sense", &found))
            .with_all(found)
    })?;
    let secret = Secret::draw().map_err(Problem::internal)?;
    match http.store.insert_token(&draft, secret.digest(), key.stored().as_ref(), http.now()).await? {
        TokenInsert::Inserted(token) => {
            http.auth.changed();
            let answer = json::answer(&NewToken { token: &token, secret: secret.reveal() })?;
            Ok((StatusCode::CREATED, answer).into_response())
        }
        TokenInsert::FirstMustBeAdmin => {
            let detail =
                "The first token closes the service for everybody else: it must be an admin's for all rigs.";
            Err(Problem::new(codes::TOKEN_FIRST_ADMIN, detail))
        }
    }
}

/// `DELETE /v1/tokens/{token}`
pub async fn remove(State(http): State<Shared>, OfToken(id): OfToken, _: NoParams) -> Answer {
    if !http.store.revoke_token(id, http.now()).await? {
        return Err(no_token());
    }
    http.auth.changed();
    Ok(StatusCode::NO_CONTENT.into_response())
}
