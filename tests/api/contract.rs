//! `openapi.yaml` against the program's own tables.

use std::collections::BTreeSet;

use rigcast::http::routes::{Audience, ROUTES, Route};
use rigcast::http::{Right, Traffic};

use crate::support::{Contract, OPENAPI, TestApp};

/// Routes for programs; pages are no part of the contract.
fn operations() -> impl Iterator<Item = &'static Route> {
    ROUTES.iter().filter(|route| route.audience == Audience::Programs)
}

#[test]
fn pages_stand_apart_from_what_the_contract_promises() {
    let pages: Vec<&Route> = ROUTES.iter().filter(|route| route.audience == Audience::People).collect();
    assert!(pages.len() > 10);
    for page in pages {
        assert!(!page.path.starts_with("/v1") && !page.path.starts_with("/v2"), "{}", page.path);
        assert!(Contract::get().document["paths"].get(page.path).is_none(), "{}", page.path);
    }
}

#[test]
fn every_route_is_in_the_contract_and_every_operation_of_the_contract_is_a_route() {
    let routes: BTreeSet<(String, String)> =
        operations().map(|r| (r.method.to_string(), r.path.to_owned())).collect();
    let operations: BTreeSet<(String, String)> =
        Contract::get().operations().into_iter().map(|(method, path, _)| (method, path)).collect();
    assert!(routes.len() > 30, "the table is not empty");
    assert_eq!(routes, operations);
}

#[test]
fn every_problem_code_is_in_the_contract_with_its_status_and_title() {
    let ours: BTreeSet<(String, u64, String)> = rigcast::http::codes::ALL
        .iter()
        .map(|c| (c.name.to_owned(), c.status.into(), c.title.to_owned()))
        .collect();
    let codes = &Contract::get().document["components"]["schemas"]["ProblemCode"]["x-codes"];
    let theirs: BTreeSet<(String, u64, String)> = codes
        .as_array()
        .expect("a list of codes")
        .iter()
        .map(|c| {
            let text = |key: &str| c[key].as_str().expect(key).to_owned();
            (text("const"), c["x-status"].as_u64().expect("a status"), text("title"))
        })
        .collect();
    assert_eq!(ours, theirs);
}

#[test]
fn the_contract_asks_of_every_operation_what_the_table_of_rights_asks() {
    let document = &Contract::get().document;
    assert_eq!(
        document["security"],
        serde_json::json!([{"token": []}]),
        "a token unless an operation says otherwise"
    );
    for route in operations() {
        let operation = &document["paths"][route.path][route.method.as_str().to_lowercase()];
        let role = operation["x-role"].as_str();
        let without = operation["security"].as_array().map(|ways| {
            ways.is_empty() || ways.iter().any(|way| way.as_object().is_some_and(serde_json::Map::is_empty))
        });
        let answers = ["401", "403"].map(|status| operation["responses"].get(status).is_some());
        let all_rigs = operation["x-all-rigs"].as_bool();
        let found = (role, without, all_rigs, answers);
        let expected = match route.right {
            Right::Public => (None, Some(true), None, [false; 2]),
            Right::Role(role) => (Some(role.as_str()), None, None, [true; 2]),
            Right::AllRigs(role) => (Some(role.as_str()), None, Some(true), [true; 2]),
        };
        assert_eq!(found, expected, "{} {}", route.method, route.path);
    }
}

#[test]
fn the_contract_says_of_every_operation_how_it_is_refused_under_load() {
    let document = &Contract::get().document;
    for route in operations() {
        let operation = &document["paths"][route.path][route.method.as_str().to_lowercase()];
        let found = ["408", "429", "503", "504"].map(|status| operation["responses"].get(status).is_some());
        let body = operation.get("requestBody").is_some();
        let expected = [body, true, true, route.traffic == Traffic::Predict];
        assert_eq!(found, expected, "{} {}", route.method, route.path);
    }
}

#[test]
fn operation_ids_are_unique_and_path_parameters_are_described() {
    let contract = Contract::get();
    let mut ids = BTreeSet::new();
    for (method, path, id) in contract.operations() {
        assert!(ids.insert(id.clone()), "{id} comes twice");
        let item = &contract.document["paths"][&path];
        let described: BTreeSet<String> = [&item["parameters"], &item[method.to_lowercase()]["parameters"]]
            .into_iter()
            .flat_map(|list| list.as_array().cloned().unwrap_or_default())
            .map(|p| match p["$ref"].as_str() {
                Some(r) => contract.document.pointer(&r[1..]).expect("a parameter").clone(),
                None => p,
            })
            .filter(|p| p["in"] == "path")
            .map(|p| p["name"].as_str().expect("a name").to_owned())
            .collect();
        let in_path: BTreeSet<String> = path
            .split('/')
            .filter_map(|s| Some(s.strip_prefix('{')?.strip_suffix('}')?.to_owned()))
            .collect();
        assert_eq!(described, in_path, "{path}");
    }
}

#[tokio::test]
async fn the_service_serves_the_contract_that_the_tests_read() {
    let app = TestApp::start();
    assert_eq!(app.get("/openapi.yaml").await.expect(200).text(), OPENAPI);
}
