//! The HTTP contract: routes, problem documents, one file a resource.
//!
//! Handlers parse, call and map. What needs the processor goes through [`crate::compute`]; what
//! is wrong becomes a [`problem::Problem`], whose document the outermost layer writes.

mod body;
mod codes;
mod etag;
mod json;
mod negotiate;
mod observe;
mod params;
mod problem;
mod upload;
