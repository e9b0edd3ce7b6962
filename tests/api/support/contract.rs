//! Checks of requests and answers against `openapi.yaml`.

use std::collections::HashMap;
use std::sync::{Arc, LazyLock, Mutex, PoisonError};

use jsonschema::Validator;
use serde_json::{Value, json};

use rigcast::http::routes::{Audience, ROUTES};

use super::reply::Reply;

/// The contract's text.
pub const OPENAPI: &str = include_str!("../../../openapi.yaml");

/// The contract, parsed.
pub struct Contract {
    /// The whole document.
    pub document: Value,
    validators: Mutex<HashMap<String, Arc<Validator>>>,
}

impl Contract {
    /// The one that all tests share.
    pub fn get() -> &'static Self {
        static CONTRACT: LazyLock<Contract> = LazyLock::new(|| Contract {
            document: serde_norway::from_str(OPENAPI).expect("openapi.yaml is YAML"),
            validators: Mutex::default(),
        });
        &CONTRACT
    }

    /// Method, path and id of every operation.
    pub fn operations(&self) -> Vec<(String, String, String)> {
        let mut operations = Vec::new();
        for (path, item) in self.document["paths"].as_object().expect("paths") {
            for method in ["get", "put", "post", "delete", "patch"] {
                if let Some(id) = item[method]["operationId"].as_str() {
                    operations.push((method.to_uppercase(), path.clone(), id.to_owned()));
                }
            }
        }
        operations
    }

    /// Checks an answer, and the JSON body that it accepted; returns the id of the operation, if the path is one
    /// of the contract.
    pub fn check(&self, method: &str, path: &str, sent: Option<&Value>, reply: &Reply) -> Option<String> {
        let path = path.split('?').next().unwrap_or_default();
        let place = format!("{method} {path} -> {}", reply.status);
        assert!(reply.headers.contains_key("x-request-id"), "{place}: no X-Request-Id");
        let media_type = reply.headers.get("content-type").map(|v| v.to_str().expect("text"));
        let media_type = media_type.map(|t| t.split(';').next().unwrap_or_default().to_owned());
        if is_page(method, path) || (path == "/" && media_type.as_deref() == Some("text/html")) {
            if media_type.as_deref() == Some("application/problem+json") {
                self.check_problem(&place, reply);
            }
            return None;
        }
        if reply.status >= 400 {
            assert_eq!(media_type.as_deref(), Some("application/problem+json"), "{place}");
            self.check_problem(&place, reply);
        }
        let Some((template, id)) = self.find(method, path) else {
            assert!(
                [404, 405].contains(&reply.status),
                "{place}: an operation that the contract does not have"
            );
            return None;
        };
        let operation = format!("/paths/{}/{}", token(&template), method.to_lowercase());
        let responses = &self.at(&operation)["responses"];
        let status = reply.status.to_string();
        let key = if responses.get(&status).is_some() { status } else { "default".to_owned() };
        assert!(
            key != "default" || reply.status >= 400,
            "{place}: a success that the contract does not have"
        );
        if reply.status < 400 {
            self.check_success(&place, &format!("{operation}/responses/{key}"), media_type.as_deref(), reply);
            if let Some(sent) = sent {
                let content = format!("{operation}/requestBody/content");
                // A merge patch is sent as JSON too.
                let is_patch = self.at(&content).get("application/json").is_none();
                let media_type = if is_patch { "application~1merge-patch+json" } else { "application~1json" };
                self.validate(&format!("{place}, request"), &format!("{content}/{media_type}/schema"), sent);
            }
        }
        Some(id)
    }

    fn check_success(&self, place: &str, response: &str, media_type: Option<&str>, reply: &Reply) {
        let described = self.at(response);
        for (name, header) in described["headers"].as_object().into_iter().flatten() {
            let header = header["$ref"].as_str().map_or(header, |r| self.at(&r[1..]));
            let required = header["required"].as_bool().unwrap_or_default();
            assert!(!required || reply.headers.contains_key(name.as_str()), "{place}: no header {name}");
        }
        let Some(content) = described["content"].as_object() else {
            assert!(reply.bytes.is_empty(), "{place}: a body that the contract does not have");
            return;
        };
        let media_type = media_type.unwrap_or_else(|| panic!("{place}: no Content-Type"));
        assert!(content.contains_key(media_type), "{place}: {media_type} is not in the contract");
        if media_type == "application/json" {
            self.validate(place, &format!("{response}/content/application~1json/schema"), &reply.json());
        }
    }

    fn check_problem(&self, place: &str, reply: &Reply) {
        let problem = reply.json();
        self.validate(place, "/components/schemas/Problem", &problem);
        assert_eq!(problem["status"], reply.status, "{place}");
        assert_eq!(problem["request_id"], reply.header("x-request-id"), "{place}");
        let code = problem["code"].as_str().expect("a code");
        let known =
            rigcast::http::codes::find(code).unwrap_or_else(|| panic!("{place}: unknown code {code}"));
        assert_eq!(
            (known.status, known.title),
            (reply.status, problem["title"].as_str().expect("a title")),
            "{place}"
        );
    }

    /// Path template and id of the operation that answers to a path; literal paths come first.
    fn find(&self, method: &str, path: &str) -> Option<(String, String)> {
        let parts: Vec<&str> = path.split('/').collect();
        let fits = |template: &str| {
            let template: Vec<&str> = template.split('/').collect();
            template.len() == parts.len()
                && template.iter().zip(&parts).all(|(t, p)| t == p || (t.starts_with('{') && !p.is_empty()))
        };
        let mut found: Vec<_> =
            self.operations().into_iter().filter(|(m, p, _)| m == method && fits(p)).collect();
        found.sort_by_key(|(_, p, _)| p.matches('{').count());
        found.into_iter().next().map(|(_, path, id)| (path, id))
    }

    fn at(&self, pointer: &str) -> &Value {
        self.document.pointer(pointer).unwrap_or_else(|| panic!("openapi.yaml has nothing at {pointer}"))
    }

    /// Checks a value against the schema at a place of the document.
    pub fn validate(&self, what: &str, pointer: &str, value: &Value) {
        let validator = self.validator(pointer);
        let errors: Vec<String> =
            validator.iter_errors(value).map(|e| format!("{}: {e}", e.instance_path())).collect();
        assert!(errors.is_empty(), "{what} is not as {pointer} says: {errors:?} in {value}");
    }

    fn validator(&self, pointer: &str) -> Arc<Validator> {
        // A test that panics with the lock leaves the validators intact.
        let mut validators = self.validators.lock().unwrap_or_else(PoisonError::into_inner);
        let made = validators.entry(pointer.to_owned()).or_insert_with(|| {
            let schema = json!({
                "$schema": "https://json-schema.org/draft/2020-12/schema",
                "allOf": [self.at(pointer)],
                "components": self.document["components"],
            });
            let options = jsonschema::options().should_validate_formats(true);
            Arc::new(options.build(&schema).unwrap_or_else(|e| panic!("{pointer}: {e}")))
        });
        made.clone()
    }
}

/// One token of a JSON pointer.
/// Whether a path is a page's, which the contract does not describe.
fn is_page(method: &str, path: &str) -> bool {
    let parts: Vec<&str> = path.split('/').collect();
    let fits = |template: &str| {
        let template: Vec<&str> = template.split('/').collect();
        template.len() == parts.len()
            && template.iter().zip(&parts).all(|(t, p)| t == p || t.starts_with('{'))
    };
    ROUTES
        .iter()
        .any(|r| r.audience == Audience::People && (r.method == method || r.path == path) && fits(r.path))
}

fn token(text: &str) -> String {
    text.replace('~', "~0").replace('/', "~1")
}
