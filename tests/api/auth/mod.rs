//! Authentication: tokens, rights, scopes, hosts, headers, secrets, names.

mod cli;
mod headers;
mod hostile;
mod loopback;
mod matrix;
mod names;
mod scope;
mod secrets;
mod strict;
mod tokens;
mod traced;

use crate::support::Reply;

/// Status and problem code, which is empty for a success.
fn outcome(reply: &Reply) -> (u16, String) {
    let code = if reply.status < 400 {
        String::new()
    } else {
        reply.json()["code"].as_str().expect("a code").into()
    };
    (reply.status, code)
}
