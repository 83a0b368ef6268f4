//! Requests of HTTP/1.1, with any headers, and messages of WebSockets.

use std::io::{ErrorKind, Read as _, Write as _};
use std::net::TcpStream;

use serde_json::Value;
use tungstenite::stream::MaybeTlsStream;
use tungstenite::{Error, Message, Result, WebSocket};

use crate::processes::PATIENCE;

/// What came back.
pub(crate) struct Answer {
    pub(crate) status: u16,
    pub(crate) head: String,
    pub(crate) body: Vec<u8>,
}

impl Answer {
    pub(crate) fn text(&self) -> &str {
        std::str::from_utf8(&self.body).expect("it is text")
    }

    pub(crate) fn json(&self) -> Value {
        serde_json::from_slice(&self.body).expect("it is JSON")
    }

    /// Empty if it is not there.
    pub(crate) fn header(&self, name: &str) -> &str {
        let headers = self.head.lines().filter_map(|line| line.split_once(": "));
        let mut values = headers.filter(|(other, _)| other.eq_ignore_ascii_case(name));
        values.next().map_or("", |(_, value)| value)
    }
}

pub(crate) fn get(host: &str, path: &str, headers: &[(&str, &str)]) -> Answer {
    ask(host, &format!("GET {path}"), (headers, ""))
}

pub(crate) fn post(host: &str, path: &str, headers: &[(&str, &str)], body: &Value) -> Answer {
    let headers = [headers, &[("content-type", "application/json")]].concat();
    ask(host, &format!("POST {path}"), (&headers, &body.to_string()))
}

fn ask(host: &str, what: &str, (headers, body): (&[(&str, &str)], &str)) -> Answer {
    let mut stream = TcpStream::connect(host).expect("it listens");
    stream.set_read_timeout(Some(PATIENCE)).expect("any time will do");
    let mut request = format!("{what} HTTP/1.1\r\n");
    let length = body.len().to_string();
    let own = [("host", host), ("connection", "close"), ("content-length", &length)];
    let is_given = |name: &str| headers.iter().any(|(given, _)| *given == name);
    let own = own.into_iter().filter(|(name, _)| !is_given(name));
    for (name, value) in own.chain(headers.iter().copied()) {
        request += &format!("{name}: {value}\r\n");
    }
    request += &format!("\r\n{body}");
    stream.write_all(request.as_bytes()).expect("it reads");
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).expect("it answers");
    let end = answer.windows(4).position(|bytes| bytes == b"\r\n\r\n").expect("there is a head");
    let body = answer.split_off(end + 4);
    let head = String::from_utf8(answer).expect("a head is text");
    let status = head.split(' ').nth(1).and_then(|code| code.parse().ok());
    Answer { status: status.expect("there is a code"), head, body }
}

/// The next message; a read that the system interrupts is begun again.
pub(crate) fn message(socket: &mut WebSocket<MaybeTlsStream<TcpStream>>) -> Result<Message> {
    loop {
        match socket.read() {
            Err(Error::Io(error)) if error.kind() == ErrorKind::Interrupted => {}
            message => return message,
        }
    }
}
