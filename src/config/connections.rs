//! Settings of connections.

use std::time::Duration;

/// How many connections there may be, and how long their clients may take.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ConnectionSettings {
    /// Connections at once.
    pub most: usize,
    /// Connections at once of one address (IPv6: of one network of 64 bits).
    pub per_address: usize,
    /// Longest time from the moment a request could begin to the end of its head; ends idle connections too.
    pub head_timeout: Duration,
    /// Longest time in which a client reads nothing of its answer.
    pub answer_timeout: Duration,
}

impl Default for ConnectionSettings {
    /// 4,096, half of them of one address, which may be a proxy's; 15 s and 30 s.
    fn default() -> Self {
        Self {
            most: 4096,
            per_address: 2048,
            head_timeout: Duration::from_secs(15),
            answer_timeout: Duration::from_secs(30),
        }
    }
}
