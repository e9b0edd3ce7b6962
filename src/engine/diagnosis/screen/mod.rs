//! The screen: which law, over which place, predicts what the linear part leaves.
//!
//! The linear part of each response is made of modes that all responses and drives share, or of a finite impulse
//! response of every drive, as rich as the data allow. A candidate is a law of the catalogue as a signal over a
//! place: a drive, a response, the difference of two, or a drive less the response that follows it, which is the error
//! of a loop or the motion over a table. The signal enters through the linear part's own impulse responses, as a force
//! that acts where a drive does, and over drives also directly. All coefficients come from
//! linear least squares on all groups of runs but one and count by the error in that one, relative to what the
//! same signal does unbent, let in the same way. So a law is believed as far as it carries over to data that it
//! was not fitted to, and neither a linear part that is too poor nor a response that predicts itself counts for it.
//!
//! A strong law moves the modes of a linear part that is fitted without it. Where neither the linear part nor free runs
//! are clear, modes are found beside bends of the motions at the places that laws point to, and the laws at these places
//! are tried there once more, over what was measured alone (`moved.rs`).
//!
//! A law of the structure is tried once more over the motion that the linear part predicts at its place, where there
//! is no noise, and there it moves every mode by factors of its own, as a force does that acts elsewhere than the
//! drives. What is predicted so follows from drives alone. Another place than a family's first stands where its free
//! run leaves clearly less.
//!
//! Of a long recording the beginnings of its stretches are looked at, as records of their own, and all laws are tried by
//! few rows before those that may come first are by all.
//!
//! A bend between two filters is a law over a drive behind a filter, whose numbers are searched; its signals leave
//! through what the linear part has beyond that filter.
//!
//! What a regression beside a free linear part cannot carry is not here: linear changes, delays and offsets are
//! part of it; an offset that drifts is lost with the means, which are taken off stretch by stretch, and sought in them
//! before; noise and lines follow from no drive; valve flow stands as its second-order series.

mod arguments;
mod band;
mod bend;
mod candidates;
mod correlate;
mod desk;
mod drift;
mod entry;
mod first_look;
mod foremost;
mod forward;
mod free_run;
mod front;
mod groups;
mod input;
mod judge;
mod kernel;
mod law;
mod linear_part;
mod memory;
mod modes;
mod moments;
mod motion;
mod moved;
mod naming;
mod past;
mod period;
mod pieces;
mod place;
mod predicted;
mod refine;
mod regressors;
mod relative;
mod report;
mod run;
#[cfg(test)]
mod tests;
mod track;

pub use forward::{AsDrive, Forward, Number, NumberOf, Simulated};
pub use free_run::FreeRun;
pub use groups::{Grouping, Stretch, Transfer, group};
pub use input::{Channel, Record, Recording};
pub use law::Law;
pub use place::{Moved, Place, moved};
pub use report::{LinearPart, Screening, Standing};
pub use run::screen;
