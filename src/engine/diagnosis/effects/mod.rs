//! Effects that a rig may have and a model lack: names, laws, maps, and a linear core with them as a free run.

pub mod candidate;
pub mod effect;
pub mod input_map;
pub mod kernel;
pub mod law;
pub mod output_map;
pub mod plant;
