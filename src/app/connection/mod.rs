//! One client connection: limits on their number, timeouts, and its end.

mod client_stream;
mod limits;
mod lingering_close;
mod unreadable;
mod write_timeout;

pub(super) use client_stream::Client;
pub(super) use limits::{ConnectionSlot, Connections};
pub(super) use unreadable::ProblemStream;
pub(super) use write_timeout::WriteTimeout;
