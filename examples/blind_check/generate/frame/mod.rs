//! Frames: rows of masses with several sensors, driven by forces, through a position loop, or by the motion of one end
//! of a specimen; with a law at any place, a weak nonlinearity everywhere and forces that nobody measures.

mod body;
mod case;
mod draw;
mod law;
mod linear;

pub use case::write;
