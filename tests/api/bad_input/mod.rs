//! Bad requests to the real program: each is refused by a documented code, with no more memory than
//! what came with it allows, and the program lives on.

mod corpus;
mod lies;
mod meter;
mod mutants;
mod peaks;
mod seeds;
