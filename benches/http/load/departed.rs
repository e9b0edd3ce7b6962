//! How long an honest prediction waits behind twenty whose clients have gone.

use std::io::Write;
use std::net::{Shutdown, TcpStream};
use std::time::Instant;

use rigcast::engine::lstm::Recombine;
use rigcast::formats::npy::Dtype;
use serde_json::json;

use super::bars::Bars;
use super::client::request;
use super::tell;
use crate::ready;
use crate::rig::npy_request;

/// Samples of a request: ten minutes, so that an answer takes longer than it takes to see that a client has gone.
const SAMPLES: usize = 600_000;
const ROUNDS: usize = 7;

/// Rounds of one prediction alone, one behind twenty closed connections, one behind twenty resets.
pub fn departed() -> Bars {
    let service = ready(Recombine::Welch, None);
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime");
    let _entered = runtime.enter();
    let (head, body) = npy_request(SAMPLES, Dtype::F4);
    let abandoned = request(&head, None, &body);
    let mut connection = service.connect();
    let mut honest = |before: &dyn Fn()| {
        before();
        let started = Instant::now();
        connection.call(&head, &body, 200);
        started.elapsed().as_secs_f64()
    };
    let leave = |reset: bool| {
        let clients: Vec<TcpStream> = (0..20)
            .map(|_| {
                let mut client = TcpStream::connect(service.address()).expect("the service accepts");
                client.write_all(&abandoned).expect("the service reads");
                client
            })
            .collect();
        for client in clients {
            if reset {
                client.set_nonblocking(true).expect("a socket");
                let client = tokio::net::TcpStream::from_std(client).expect("a socket");
                client.set_zero_linger().expect("a reset at its end");
            } else {
                client.shutdown(Shutdown::Both).expect("an open connection");
            }
        }
    };
    honest(&|| ());
    let mut times = [const { Vec::new() }; 3];
    for _ in 0..ROUNDS {
        times[0].push(honest(&|| ()));
        times[1].push(honest(&|| leave(false)));
        times[2].push(honest(&|| leave(true)));
    }
    let [alone, closed, reset] = times.map(|mut times| {
        times.sort_by(f64::total_cmp);
        times[ROUNDS / 2]
    });
    tell("departed", &json!({"alone_s": alone, "behind_20_closed_s": closed, "behind_20_reset_s": reset}));
    let mut bars = Bars::default();
    bars.at_most("behind 20 closed connections, of alone", closed / alone, 1.2);
    bars.at_most("behind 20 reset connections, of alone", reset / alone, 1.2);
    bars
}
