//! Pages for people: HTML with plots as inline SVG. Every page loads one style sheet and small scripts of the service;
//! nothing stands inside the page, and nothing comes from elsewhere.

pub mod assets;
pub mod diagnosis;
pub mod drift;
pub mod evaluation;
pub mod figures;
pub mod fit;
pub mod frame;
pub mod iteration;
pub mod job;
pub mod model;
pub mod model_report;
mod plot;
pub mod predict;
pub mod refusal;
pub mod rig;
pub mod rigs;
pub mod run;
pub mod sign_in;
mod spectrum;
pub mod study;
#[cfg(test)]
mod testing;
mod text;
pub mod tokens;
pub mod upload;
mod words;
