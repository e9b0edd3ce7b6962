//! Long short-term memory networks: inference, training, windows and their recombination.
//!
//! Networks are those of Heindel et al., section 2.2: blocks of memory cells from a zero state, one
//! fully connected layer without activation, inputs and outputs standardised by the caller. All
//! numbers are `f32`.
//!
//! The networks are tiny (39 cells), so the layout decides the speed: one lane of a vector is one
//! window (`forward`), or one cell where the state is carried through a signal (`stream`). The
//! kernels are written once over a trait of vector operations and run on the best instruction set of
//! the machine ([`Isa`](crate::simd::Isa)).

mod activation;
mod adjoint;
mod bptt;
mod forward;
mod net;
mod optimizer;
mod params;
mod predict;
mod product;
#[cfg(test)]
mod reference;
#[cfg(test)]
mod samples;
mod settings;
mod state;
mod stream;
#[cfg(test)]
mod torch_vectors;
mod train;
mod validate;

pub use adjoint::adjoint;
pub use net::{LstmBlock, LstmNet};
pub use predict::{Streaming, predict, predict_watched};
pub use settings::{
    HybridStart, LstmSettings, MAX_BATCH, MAX_BLOCKS, MAX_CELLS, MAX_SEEDS, MAX_WINDOW_LEN, Optimizer,
    Recombine, RecombineChoice, Schedule, WindowOffset,
};
pub use train::{EpochRecord, Segment, Trained, Until, train};
