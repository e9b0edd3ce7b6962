//! The address of the service. It is bound before anything else, so that a start without it leaves no
//! directory behind. Listening begins once requests can be answered.

use std::io::{Error, ErrorKind};
use std::net::SocketAddr;

use tokio::net::{TcpListener, TcpSocket};

/// Connections that wait for their first answer.
const BACKLOG: u32 = 1024;

/// Why an address cannot be bound.
#[derive(Debug, thiserror::Error)]
#[error("cannot listen on {address}: {}", why(.source))]
pub struct AddressError {
    address: SocketAddr,
    source: Error,
}

fn why(source: &Error) -> String {
    match source.kind() {
        ErrorKind::AddrInUse => "another program listens there already (Rigcast, maybe: rigcast health asks); \
                                 stop it, or choose another port with --listen"
            .into(),
        ErrorKind::AddrNotAvailable => "this machine has no such address".into(),
        ErrorKind::PermissionDenied => {
            "this user may not have that port (those below 1024 are reserved); choose another one with --listen".into()
        }
        _ => source.to_string(),
    }
}

/// A bound address that does not accept connections yet.
#[derive(Debug)]
pub struct Address {
    socket: TcpSocket,
    address: SocketAddr,
}

impl Address {
    /// Binds an address; port 0 takes a free port.
    ///
    /// # Errors
    /// Another program listens there; the machine does not have the address; the user may not bind it.
    pub fn take(address: SocketAddr) -> Result<Self, AddressError> {
        let taken = || {
            let socket = if address.is_ipv4() { TcpSocket::new_v4() } else { TcpSocket::new_v6() }?;
            // Connections left by a service that has just ended do not block the address.
            socket.set_reuseaddr(true)?;
            socket.bind(address)?;
            Ok(socket)
        };
        let socket = taken().map_err(|source| AddressError { address, source })?;
        Ok(Self { socket, address })
    }

    /// Begins to accept connections.
    ///
    /// # Errors
    /// Another program began to listen there first.
    pub fn listen(self) -> Result<TcpListener, AddressError> {
        let Self { socket, address } = self;
        socket.listen(BACKLOG).map_err(|source| AddressError { address, source })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn an_address_is_one_services_and_nobody_is_let_in_before_it_listens() {
        let ours = Address::take("127.0.0.1:0".parse().unwrap()).unwrap();
        let address = ours.socket.local_addr().unwrap();
        let early = tokio::net::TcpStream::connect(address).await;
        assert_eq!(early.unwrap_err().kind(), ErrorKind::ConnectionRefused);
        let listener = ours.listen().unwrap();
        assert!(tokio::net::TcpStream::connect(address).await.is_ok());
        let refused = Address::take(address).unwrap_err().to_string();
        assert!(refused.contains(&address.to_string()) && refused.contains("another program"), "{refused}");
        drop(listener);
        Address::take(address).expect("it is free again");
    }

    #[tokio::test]
    async fn an_address_of_another_machine_is_refused_in_words() {
        // No machine has an address of TEST-NET-1 (RFC 5737).
        let refused = Address::take("192.0.2.1:80".parse().unwrap()).unwrap_err().to_string();
        assert_eq!(refused, "cannot listen on 192.0.2.1:80: this machine has no such address");
    }
}
