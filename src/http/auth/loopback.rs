//! While there is no token the service is open to programs of this machine, but not to web pages that a
//! browser on this machine shows, nor to proxies. A page may point a name of its own at 127.0.0.1, which
//! `Host` reveals, or send requests without reading their answers, which `Origin` reveals. A proxy
//! speaks for other machines; most proxies add a header that says so.

use std::net::IpAddr;

use axum::http::header::{HOST, ORIGIN};
use axum::http::request::Parts;
use axum::http::uri::Authority;
use axum::http::{HeaderMap, HeaderName};

use crate::http::codes;
use crate::http::problem::{Answer, Problem};

/// Headers of requests that come through a proxy.
const FORWARDED: [&str; 4] = ["forwarded", "x-forwarded-for", "x-real-ip", "via"];

/// Refuses requests that do not come from a program of this machine.
///
/// # Errors
/// `host.foreign`, `origin.foreign`.
pub fn check(parts: &Parts) -> Answer<()> {
    let host = only(&parts.headers, &HOST).filter(|host| names_loopback(host));
    // A request line with a whole URI takes precedence over Host (RFC 9112, section 3.2.2).
    let named = parts.uri.authority().is_none_or(|authority| names_loopback(authority.as_str()));
    let forwarded = FORWARDED.iter().any(|name| parts.headers.contains_key(*name));
    let Some(host) = host.filter(|_| named && !forwarded) else {
        let detail = "While there is no token the service answers to 127.0.0.1, localhost and [::1] only, and to \
                      no proxy; `rigcast token create --role admin` makes the first token.";
        return Err(Problem::new(codes::HOST_FOREIGN, detail));
    };
    if !parts.method.is_safe() && parts.headers.contains_key(ORIGIN) {
        let origin = only(&parts.headers, &ORIGIN).and_then(|origin| Some(origin.split_once("://")?.1));
        if !origin.is_some_and(|origin| origin.eq_ignore_ascii_case(host)) {
            let detail = "While there is no token, changes are not taken from pages of another origin.";
            return Err(Problem::new(codes::ORIGIN_FOREIGN, detail));
        }
    }
    Ok(())
}

/// The value of a header that is there exactly once.
fn only<'a>(headers: &'a HeaderMap, name: &HeaderName) -> Option<&'a str> {
    let mut values = headers.get_all(name).iter();
    values.next().filter(|_| values.next().is_none())?.to_str().ok()
}

/// Whether an authority names the loopback of this machine, at any port.
fn names_loopback(text: &str) -> bool {
    let Ok(authority) = text.parse::<Authority>() else { return false };
    let host = authority.host();
    let address = host.strip_prefix('[').and_then(|host| host.strip_suffix(']')).unwrap_or(host);
    !text.contains('@')
        && (host.eq_ignore_ascii_case("localhost")
            || address.parse().is_ok_and(|address: IpAddr| address.is_loopback()))
}

#[cfg(test)]
mod tests {
    use axum::http::Request;

    use super::*;

    fn checked(method: &str, uri: &str, headers: &[(&str, &str)]) -> Result<(), String> {
        let mut request = Request::builder().method(method).uri(uri);
        for (name, value) in headers {
            request = request.header(*name, *value);
        }
        check(&request.body(()).unwrap().into_parts().0).map_err(|problem| problem.code().to_owned())
    }

    #[test]
    fn only_names_of_this_machine_come_in() {
        for host in ["127.0.0.1", "127.0.0.1:8080", "localhost", "LocalHost:1", "[::1]", "[::1]:8080"] {
            assert_eq!(checked("POST", "/v1/rigs", &[("host", host)]), Ok(()), "{host}");
        }
        for host in [
            "",
            "rigcast.lab",
            "localhost.lab",
            "127.0.0.1.lab:8080",
            "localhost@lab",
            "lab@localhost",
            "127.1",
            "192.168.0.1",
            "0.0.0.0",
            "[::]",
            "::1",
            "[::1",
            "localhost:8080:1",
            "local host",
            "127.0.0.1/x",
        ] {
            assert_eq!(checked("GET", "/v1/rigs", &[("host", host)]), Err("host.foreign".into()), "{host:?}");
        }
        let refused = Err("host.foreign".to_owned());
        assert_eq!(checked("GET", "/", &[]), refused, "no Host");
        assert_eq!(checked("GET", "/", &[("host", "localhost"), ("host", "localhost")]), refused, "two");
        assert_eq!(checked("GET", "http://lab/", &[("host", "localhost")]), refused, "a whole URI");
        assert_eq!(checked("GET", "http://localhost/", &[("host", "lab")]), refused);
        assert_eq!(checked("GET", "http://localhost/", &[("host", "localhost")]), Ok(()));
        for name in FORWARDED {
            assert_eq!(checked("GET", "/", &[("host", "localhost"), (name, "10.0.0.7")]), refused, "{name}");
        }
    }

    #[test]
    fn changes_are_taken_from_our_own_origin_and_from_programs() {
        let origin =
            |method, origin| checked(method, "/v1/rigs", &[("host", "localhost:8080"), ("origin", origin)]);
        assert_eq!(origin("POST", "http://localhost:8080"), Ok(()));
        for foreign in [
            "null",
            "",
            "http://localhost",
            "http://localhost:80",
            "http://127.0.0.1:8080",
            "https://lab",
            "localhost:8080",
        ] {
            for method in ["POST", "PUT", "PATCH", "DELETE"] {
                assert_eq!(origin(method, foreign), Err("origin.foreign".into()), "{method} {foreign}");
            }
            assert_eq!(origin("GET", foreign), Ok(()), "the browser keeps the answer from the page");
        }
        let twice = [("host", "localhost"), ("origin", "http://localhost"), ("origin", "http://localhost")];
        assert_eq!(checked("POST", "/", &twice), Err("origin.foreign".into()));
    }
}
