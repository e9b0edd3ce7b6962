//! Limits on the number of connections at once, in all and of one address.

use std::collections::HashMap;
use std::future::poll_fn;
use std::net::{IpAddr, Ipv6Addr};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::io::AsyncWriteExt;
use tokio::net::TcpStream;
use tokio::sync::Semaphore;

use super::lingering_close::LingeringClose;
use crate::config::ConnectionSettings;
use crate::telemetry::names;

/// Refused connections that get an answer at the same time; further ones are closed without one.
const TOLD: usize = 64;

/// How long that answer may take.
const TELLING: Duration = Duration::from_secs(1);

/// The connections that are open.
#[derive(Debug)]
pub(in crate::app) struct Connections {
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

/// A counted connection; dropping it ends the count.
#[derive(Debug)]
pub(in crate::app) struct ConnectionSlot {
    connections: Arc<Connections>,
    address: IpAddr,
}

impl Connections {
    pub(in crate::app) fn new(settings: &ConnectionSettings) -> Arc<Self> {
        let telling = Arc::new(Semaphore::new(TOLD));
        let (most, per_address) = (settings.most, settings.per_address);
        Arc::new(Self { most, per_address, open: Mutex::default(), telling })
    }

    /// A slot for a connection from `address`; `None` when the limits are reached.
    pub(in crate::app) fn enter(self: &Arc<Self>, address: IpAddr) -> Option<ConnectionSlot> {
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
            return Some(ConnectionSlot { connections: Arc::clone(self), address });
        };
        metrics::counter!(names::CONNECTIONS_REFUSED, "limit" => limit).increment(1);
        None
    }

    /// Answers a client that got no slot, on a task of its own.
    pub(in crate::app) fn refuse(&self, mut stream: TcpStream, answer: Vec<u8>) {
        let Ok(telling) = Arc::clone(&self.telling).try_acquire_owned() else { return };
        let told = async move {
            stream.write_all(&answer).await?;
            let mut closing = LingeringClose::default();
            poll_fn(|cx| closing.poll(&mut stream, cx)).await
        };
        tokio::spawn(async move {
            // A client that goes away meanwhile does not matter.
            let _ = tokio::time::timeout(TELLING, told).await;
            drop(telling);
        });
    }

    fn open(&self) -> MutexGuard<'_, Open> {
        self.open.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for ConnectionSlot {
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

/// The part of an address that is counted: a host has a whole 64-bit network of IPv6 to itself.
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
