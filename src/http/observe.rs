//! The outermost layer: request id, log line, metrics, and the body of every problem document.

use std::net::IpAddr;
use std::panic::AssertUnwindSafe;
use std::time::Instant;

use axum::body::Body;
use axum::extract::{FromRequestParts, MatchedPath, RawPathParams, Request, State};
use axum::http::header::{ACCEPT, CONTENT_LENGTH, CONTENT_SECURITY_POLICY, CONTENT_TYPE, LOCATION};
use axum::http::request::Parts;
use axum::http::{HeaderMap, HeaderName, HeaderValue, Method, StatusCode};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use futures::FutureExt;
use tracing::Instrument;

use super::auth::Identity;
use super::headers::{Immutable, PAGE, keep, protect};
use super::pages::Visitor;
use super::problem::{self, Problem};
use super::{Shared, codes};
use crate::domain::RigId;
use crate::telemetry::names;

/// Header with the id of a request, in logs and answers.
pub static X_REQUEST_ID: HeaderName = HeaderName::from_static("x-request-id");

/// Longest request id that a client may set.
const MAX_ID_LEN: usize = 128;

/// Address of the connection that a request came by: the client's, or that of a proxy in front of the service.
#[derive(Debug, Clone, Copy)]
pub struct ClientAddress(pub IpAddr);

/// Routes that monitors ask all the time: their successes are logged at `debug`.
const PROBES: [&str; 5] = ["/livez", "/readyz", "/metrics", "/v2/health/live", "/v2/health/ready"];

/// Wraps each request; every answer passes here.
pub async fn observe(
    State(http): State<Shared>,
    matched: Option<MatchedPath>,
    request: Request,
    next: Next,
) -> Response {
    let started = Instant::now();
    let id = client_id(request.headers()).unwrap_or_else(|| http.new_id().to_string());
    let method = method_label(request.method());
    let form = Form::of(&request);
    // An unknown path must not become a label: clients could make any number of labels.
    let route = matched.as_ref().map_or("unmatched", MatchedPath::as_str).to_owned();
    let span = tracing::info_span!(
        "request",
        http.method = method,
        http.route = route,
        request.id = id,
        client.address = tracing::field::Empty,
        rig.id = tracing::field::Empty,
        token.id = tracing::field::Empty,
        token.name = tracing::field::Empty,
        problem.code = tracing::field::Empty,
        http.status = tracing::field::Empty,
        duration_ms = tracing::field::Empty,
    );
    if let Some(ClientAddress(address)) = request.extensions().get() {
        span.record("client.address", tracing::field::display(address));
    }
    let (mut parts, body) = request.into_parts();
    if let Some(rig) = rig_of(&mut parts).await {
        note_rig(&span, &rig);
    }
    let request = Request::from_parts(parts, body);
    let response =
        AssertUnwindSafe(next.run(request)).catch_unwind().instrument(span.clone()).await.unwrap_or_else(
            |panic| Problem::internal(format!("panic: {}", panic_text(&*panic))).into_response(),
        );
    if response.extensions().get::<Problem>().is_some_and(|problem| problem.code() == codes::STORE_ROW.name) {
        http.store.doubt_rows();
    }
    let response = finish(response, &id, &span, &form);

    let status = response.status();
    let elapsed = started.elapsed();
    let probe = PROBES.contains(&route.as_str()) && status.is_success();
    metrics::counter!(names::REQUESTS, "route" => route.clone(), "method" => method, "status" => status.as_str().to_owned())
        .increment(1);
    metrics::histogram!(names::REQUEST_SECONDS, "route" => route, "method" => method)
        .record(elapsed.as_secs_f64());
    span.record("http.status", status.as_u16());
    span.record("duration_ms", elapsed.as_secs_f64() * 1e3);
    span.in_scope(|| if probe { tracing::debug!("answered") } else { tracing::info!("answered") });
    response
}

/// The form of the document that a refused request gets.
enum Form {
    /// RFC 9457.
    Problem,
    /// The same with the field of the Open Inference Protocol.
    Inference,
    /// A page, for a browser; with the address that signing in leads back to, of a request that can be repeated.
    Page(Option<String>),
}

impl Form {
    fn of(request: &Request) -> Self {
        let path = request.uri().path();
        let below =
            |root: &str| path.strip_prefix(root).is_some_and(|rest| rest.is_empty() || rest.starts_with('/'));
        if below("/v2") {
            return Self::Inference;
        }
        // Programs take anything; only browsers name HTML.
        let accepts = request.headers().get_all(ACCEPT).iter().filter_map(|value| value.to_str().ok());
        let is_browser =
            accepts.flat_map(|value| value.split([',', ';'])).any(|kind| kind.trim() == "text/html");
        if below("/v1") || !is_browser {
            return Self::Problem;
        }
        let again = (*request.method() == Method::GET).then(|| request.uri().path_and_query()).flatten();
        Self::Page(again.map(|address| address.as_str().to_owned()))
    }
}

/// The rig in the path. Only a valid id counts, so that clients cannot write other text into the log.
async fn rig_of(parts: &mut Parts) -> Option<RigId> {
    let params = RawPathParams::from_request_parts(parts, &()).await.ok()?;
    params.iter().find(|(name, _)| *name == "rig").and_then(|(_, rig)| rig.parse().ok())
}

/// Adds the rig of a request to its log line where the path does not name it.
pub fn note_rig(span: &tracing::Span, rig: &RigId) {
    span.record("rig.id", tracing::field::display(rig));
}

/// Adds request id and protective headers to an answer and, if it is a problem, writes its document.
fn finish(mut response: Response, id: &str, span: &tracing::Span, form: &Form) -> Response {
    let status = response.status();
    let mut problem = response.extensions_mut().remove::<Problem>();
    if problem.is_none() && (status.is_client_error() || status.is_server_error()) {
        problem = Some(Problem::of_status(status));
    }
    if let Some(problem) = problem {
        span.record("problem.code", problem.code());
        if status.is_server_error() {
            let cause = problem.cause().unwrap_or("none given");
            span.in_scope(|| tracing::error!(cause, "request failed"));
        } else {
            span.in_scope(|| tracing::debug!("request refused"));
        }
        let visitor = response.extensions_mut().remove::<Identity>().map(Visitor::from);
        refuse(&mut response, &problem, id, form, visitor.as_ref());
    }
    let kept = response.extensions_mut().remove::<Immutable>().is_some();
    let id = HeaderValue::from_str(id).expect("ids are letters, digits and four marks");
    response.headers_mut().insert(X_REQUEST_ID.clone(), id);
    protect(response.headers_mut());
    if kept {
        keep(response.headers_mut());
    }
    response
}

/// Writes the document of a problem. A browser that is not signed in is sent to the form for that.
fn refuse(response: &mut Response, problem: &Problem, id: &str, form: &Form, visitor: Option<&Visitor>) {
    let (document, kind) = match form {
        Form::Problem => (problem.document(id), problem::MEDIA_TYPE),
        Form::Inference => (problem.inference_document(id), problem::MEDIA_TYPE),
        Form::Page(Some(again)) if problem.code() == codes::TOKEN_MISSING.name => {
            let query = form_urlencoded::Serializer::new(String::new()).append_pair("to", again).finish();
            if let Ok(address) = HeaderValue::try_from(format!("/sign-in?{query}")) {
                response.headers_mut().insert(LOCATION, address);
            }
            *response.status_mut() = StatusCode::SEE_OTHER;
            (Vec::new(), "text/plain")
        }
        Form::Page(_) => {
            let page = problem.page(id, visitor.map(|visitor| &visitor.shown));
            (page.into_bytes(), "text/html; charset=utf-8")
        }
    };
    if kind.starts_with("text/html") {
        response.headers_mut().insert(CONTENT_SECURITY_POLICY, HeaderValue::from_static(PAGE));
    }
    *response.body_mut() = Body::from(document);
    response.headers_mut().remove(CONTENT_LENGTH);
    response.headers_mut().insert(CONTENT_TYPE, HeaderValue::from_static(kind));
}

/// The client's own request id, if it can be logged and sent back as it is.
fn client_id(headers: &HeaderMap) -> Option<String> {
    let id = headers.get(&X_REQUEST_ID)?.to_str().ok()?;
    let sane = (1..=MAX_ID_LEN).contains(&id.len())
        && id.bytes().all(|b| b.is_ascii_alphanumeric() || matches!(b, b'-' | b'_' | b'.' | b':'));
    sane.then(|| id.to_owned())
}

/// A method as a label; unknown methods share one label, because clients may invent them.
pub fn method_label(method: &Method) -> &'static str {
    match *method {
        Method::GET => "GET",
        Method::HEAD => "HEAD",
        Method::POST => "POST",
        Method::PUT => "PUT",
        Method::PATCH => "PATCH",
        Method::DELETE => "DELETE",
        _ => "other",
    }
}

fn panic_text(panic: &(dyn std::any::Any + Send)) -> &str {
    panic
        .downcast_ref::<&str>()
        .copied()
        .or_else(|| panic.downcast_ref::<String>().map(String::as_str))
        .unwrap_or("without a message")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn headers(id: &str) -> HeaderMap {
        let mut headers = HeaderMap::new();
        headers.insert(X_REQUEST_ID.clone(), HeaderValue::from_str(id).expect("header value"));
        headers
    }

    #[test]
    fn a_clients_id_is_taken_only_if_it_is_short_and_plain() {
        assert_eq!(client_id(&headers("batch-7:drive_3.1")).as_deref(), Some("batch-7:drive_3.1"));
        for odd in ["", "a b", "a\"b", "<id>", &"x".repeat(129)] {
            assert_eq!(client_id(&headers(odd)), None, "{odd}");
        }
        assert_eq!(client_id(&HeaderMap::new()), None);
    }

    #[test]
    fn an_answer_that_the_framework_refused_becomes_a_problem_document() {
        let response =
            finish(StatusCode::IM_A_TEAPOT.into_response(), "r-1", &tracing::Span::none(), &Form::Problem);
        assert_eq!(response.headers()[CONTENT_TYPE], problem::MEDIA_TYPE);
        assert_eq!(response.headers()["x-request-id"], "r-1");
    }
}
