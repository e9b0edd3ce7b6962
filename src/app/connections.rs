//! Connections: how many there may be at once, of everybody and of one address.

use std::collections::HashMap;
use std::future::poll_fn;
use std::net::{IpAddr, Ipv6Addr};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::io::AsyncWriteExt;
use tokio::net::TcpStream;
use tokio::sync::Semaphore;

use super::farewell::Farewell;
use crate::telemetry::names;

/// Refused connections that are told so at once; others beyond them are cut without a word.
const TOLD: usize = 64;

/// How long telling one may take.
const TELLING: Duration = Duration::from_secs(1);

/// How many connections there may be, and how long their clients may take.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ConnectionSettings {
    /// Connections at once.
    pub most: usize,
    /// Connections at once of one address (IPv6: of one network of 64 bits).
    pub per_address: usize,
    /// From when a request could come to the end of its head: ends idle connections too.
    pub head_timeout: Duration,
    /// How long a client may take none of its answer.
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

/// The connections that are open.
#[derive(Debug)]
pub(super) struct Connections {
    most: usize,
    per_address: usize,
    open: Mutex<Open>,
    telling: Arc<Semaphore>,
}

#[derive(Debug, Default)]
struct Open {
    all: usize,
    by_address: HashMap<IpAddr, usize>,
}

/// A connection that counts; it counts no more when this value ends.
#[derive(Debug)]
pub(super) struct Place {
    connections: Arc<Connections>,
    address: IpAddr,
}

impl Connections {
    pub(super) fn new(settings: &ConnectionSettings) -> Arc<Self> {
        let telling = Arc::new(Semaphore::new(TOLD));
        let (most, per_address) = (settings.most, settings.per_address);
        Arc::new(Self { most, per_address, open: Mutex::default(), telling })
    }

    /// A place for a connection from `address`; none when the limits are reached.
    pub(super) fn enter(self: &Arc<Self>, address: IpAddr) -> Option<Place> {
        let address = network(address);
        let mut open = self.open();
        let own = open.by_address.get(&address).copied().unwrap_or_default();
        let limit = if open.all >= self.most {
            "all"
        } else if own >= self.per_address {
            "address"
        } else {
            open.all += 1;
            *open.by_address.entry(address).or_default() += 1;
            metrics::gauge!(names::CONNECTIONS).increment(1.0);
            return Some(Place { connections: Arc::clone(self), address });
        };
        metrics::counter!(names::CONNECTIONS_REFUSED, "limit" => limit).increment(1);
        None
    }

    /// Tells who got no place, on a task of its own.
    pub(super) fn refuse(&self, mut stream: TcpStream, answer: Vec<u8>) {
        let Ok(telling) = Arc::clone(&self.telling).try_acquire_owned() else { return };
        let told = async move {
            stream.write_all(&answer).await?;
            let mut farewell = Farewell::default();
            poll_fn(|cx| farewell.poll(&mut stream, cx)).await
        };
        tokio::spawn(async move {
            // Who goes away meanwhile has been told all the same.
            let _ = tokio::time::timeout(TELLING, told).await;
            drop(telling);
        });
    }

    fn open(&self) -> MutexGuard<'_, Open> {
        self.open.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        metrics::gauge!(names::CONNECTIONS).decrement(1.0);
        let mut open = self.connections.open();
        open.all -= 1;
        if let Some(own) = open.by_address.get_mut(&self.address) {
            *own -= 1;
            if *own == 0 {
                open.by_address.remove(&self.address);
            }
        }
    }
}

/// What counts as one address: a host has a whole network of 64 bits of IPv6 to itself.
fn network(address: IpAddr) -> IpAddr {
    match address.to_canonical() {
        IpAddr::V6(address) => {
            let [a, b, c, d, ..] = address.segments();
            Ipv6Addr::new(a, b, c, d, 0, 0, 0, 0).into()
        }
        address => address,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn address(text: &str) -> IpAddr {
        text.parse().unwrap()
    }

    #[test]
    fn places_are_limited_for_everybody_and_for_an_address_and_come_back() {
        let settings = ConnectionSettings { most: 3, per_address: 2, ..ConnectionSettings::default() };
        let connections = Connections::new(&settings);
        let enter = |text: &str| connections.enter(address(text));
        let own = [enter("10.0.0.1").unwrap(), enter("::ffff:10.0.0.1").unwrap()];
        assert!(enter("10.0.0.1").is_none(), "two are its share");
        let other = enter("10.0.0.2").unwrap();
        assert!(enter("10.0.0.3").is_none(), "three are all");
        drop(own);
        let networks = [enter("2001:db8::1").unwrap(), enter("2001:db8::2").unwrap()];
        drop(other);
        assert!(enter("2001:db8::3:4:5").is_none(), "one network, one share");
        drop(networks);
        assert!(connections.open().by_address.is_empty());
    }
}
