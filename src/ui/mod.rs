//! Pages for people: HTML with plots as inline SVG, without scripts and without a network.

pub mod diagnosis;
mod document;
mod plot;
pub mod start;
mod text;
