//! Fourier transforms and matrix decompositions for the number types that the engine uses.
//!
//! The libraries behind them are generic: whoever names a number type compiles them for it. This crate names it, so
//! that the engine and its tests do not compile them each time.

pub mod decompose;
pub mod fft;
