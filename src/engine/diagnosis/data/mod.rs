//! The runs of a request, prepared: one problem a response, its noise, and where the gap lies.

pub mod concerned;
pub mod disturbance;
pub mod locate;
pub mod means;
pub mod noise;
pub mod overview;
pub mod prepare;
pub mod problem;
pub mod seldom;
pub mod settled;
pub mod split;
pub mod tolerance;
