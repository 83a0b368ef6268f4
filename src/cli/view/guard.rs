//! Who may ask the server of the page.

use std::fmt::Write as _;
use std::fs::File;
use std::io::{self, Read as _};
use std::net::IpAddr;

use axum::http::uri::Authority;
use axum::http::{HeaderMap, Method, header};
use thiserror::Error;

/// Carries the token, which may be empty; a page of another origin cannot set it.
const TOKEN_HEADER: &str = "x-gmapd-token";

/// Why somebody is turned away.
#[derive(Debug, PartialEq, Eq, Error)]
pub(super) enum Refusal {
    #[error("this page is for this machine: open it as 127.0.0.1 or localhost")]
    Host,
    #[error("requests are not taken from pages of other origins")]
    Origin,
    #[error("a command needs the header {TOKEN_HEADER}")]
    Header,
    #[error("the token is missing or wrong: open the address that gmapd view printed")]
    Token,
}

/// Keeps strangers and other sites' pages out.
pub(super) struct Guard {
    /// `None` on this machine's own addresses.
    token: Option<String>,
}

impl Guard {
    /// For a server that listens there.
    pub(super) fn of(address: IpAddr) -> io::Result<Self> {
        let token = if address.is_loopback() { None } else { Some(random_token()?) };
        Ok(Self { token })
    }

    /// What follows the address of the page.
    pub(super) fn suffix(&self) -> String {
        self.token.as_ref().map_or_else(String::new, |token| format!("?token={token}"))
    }

    pub(super) fn check(
        &self,
        method: &Method,
        headers: &HeaderMap,
        query: &str,
    ) -> Result<(), Refusal> {
        let text = |name: &str| headers.get(name).and_then(|value| value.to_str().ok());
        let host = text(header::HOST.as_str()).unwrap_or_default();
        // A stranger's name may be made to lead here.
        if self.token.is_none() && !is_own(host) {
            return Err(Refusal::Host);
        }
        let origin = headers.get(header::ORIGIN).map(|value| value.to_str().unwrap_or_default());
        let is_foreign = origin.is_some_and(|origin| origin != format!("http://{host}"));
        let site = text("sec-fetch-site").unwrap_or("none");
        if is_foreign || !["same-origin", "none"].contains(&site) {
            return Err(Refusal::Origin);
        }
        let in_header = text(TOKEN_HEADER);
        if method != Method::GET && in_header.is_none() {
            return Err(Refusal::Header);
        }
        let in_query = query.split('&').find_map(|pair| pair.strip_prefix("token="));
        let given = in_header.or(in_query).unwrap_or_default();
        match &self.token {
            Some(token) if !same(token.as_bytes(), given.as_bytes()) => Err(Refusal::Token),
            Some(_) | None => Ok(()),
        }
    }
}

fn is_own(host: &str) -> bool {
    let Ok(authority) = host.parse::<Authority>() else { return false };
    let name = authority.host();
    let address = name.trim_start_matches('[').trim_end_matches(']').parse::<IpAddr>();
    name == "localhost" || address.is_ok_and(|address| address.is_loopback())
}

fn random_token() -> io::Result<String> {
    let mut bytes = [0_u8; 16];
    File::open("/dev/urandom")?.read_exact(&mut bytes)?;
    Ok(bytes.iter().fold(String::new(), |mut token, byte| {
        write!(token, "{byte:02x}").ok();
        token
    }))
}

/// Takes as long wherever the first difference is.
fn same(a: &[u8], b: &[u8]) -> bool {
    a.len() == b.len() && a.iter().zip(b).fold(0, |all, (a, b)| all | (a ^ b)) == 0
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check(guard: &Guard, method: &Method, headers: &[(&str, &str)]) -> Result<(), Refusal> {
        let mut map = HeaderMap::new();
        for (name, value) in headers {
            let name = axum::http::HeaderName::try_from(*name).unwrap();
            map.insert(name, value.parse().unwrap());
        }
        guard.check(method, &map, "robot=a&token=secret")
    }

    const HOST: (&str, &str) = ("host", "127.0.0.1:8080");

    #[test]
    fn strangers_names_do_not_lead_here() {
        let guard = Guard { token: None };
        assert_eq!(check(&guard, &Method::GET, &[HOST]), Ok(()));
        assert_eq!(check(&guard, &Method::GET, &[("host", "localhost:1")]), Ok(()));
        assert_eq!(check(&guard, &Method::GET, &[("host", "[::1]:1")]), Ok(()));
        assert_eq!(check(&guard, &Method::GET, &[("host", "[::1]")]), Ok(()));
        assert_eq!(check(&guard, &Method::GET, &[("host", "127.0.0.1")]), Ok(()));
        let look_alike = [("host", "127.0.0.1.evil.org")];
        assert_eq!(check(&guard, &Method::GET, &look_alike), Err(Refusal::Host));
        assert_eq!(check(&guard, &Method::GET, &[("host", "evil.org:1")]), Err(Refusal::Host));
        assert_eq!(check(&guard, &Method::GET, &[]), Err(Refusal::Host));
    }

    #[test]
    fn other_origins_are_refused() {
        let guard = Guard { token: None };
        let from = |name, value| check(&guard, &Method::GET, &[HOST, (name, value)]);
        assert_eq!(from("origin", "http://127.0.0.1:8080"), Ok(()));
        assert_eq!(from("origin", "http://127.0.0.1:8081"), Err(Refusal::Origin));
        assert_eq!(from("origin", "null"), Err(Refusal::Origin));
        assert_eq!(from("sec-fetch-site", "same-origin"), Ok(()));
        assert_eq!(from("sec-fetch-site", "cross-site"), Err(Refusal::Origin));
        assert_eq!(from("sec-fetch-site", "same-site"), Err(Refusal::Origin));
    }

    #[test]
    fn commands_need_the_header() {
        let guard = Guard { token: None };
        assert_eq!(check(&guard, &Method::POST, &[HOST]), Err(Refusal::Header));
        assert_eq!(check(&guard, &Method::POST, &[HOST, (TOKEN_HEADER, "")]), Ok(()));
    }

    #[test]
    fn the_token_is_asked_for_where_others_may_come() {
        let guard = Guard::of([0, 0, 0, 0].into()).unwrap();
        assert_eq!(guard.suffix().len(), "?token=".len() + 32);
        assert_eq!(check(&guard, &Method::GET, &[HOST]), Err(Refusal::Token));
        let guard = Guard { token: Some("secret".to_owned()) };
        assert_eq!(check(&guard, &Method::GET, &[("host", "robot.local:1")]), Ok(()));
        let wrong = [HOST, (TOKEN_HEADER, "secreT")];
        assert_eq!(check(&guard, &Method::POST, &wrong), Err(Refusal::Token));
    }
}
