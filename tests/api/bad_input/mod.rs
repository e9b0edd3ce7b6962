//! Bad requests to the real program: each is refused with a documented code within the memory allowed for
//! its size, and the program goes on.

mod corpus;
mod lies;
mod meter;
mod mutants;
mod peaks;
mod seeds;
