//! The session's links to other machines: how many there are, and how many ended.

use std::sync::{Arc, Mutex, PoisonError};

use serde::Serialize;
use zenoh::Session;
use zenoh::sample::SampleKind;

/// Links since the daemon started.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct LinksStatus {
    /// Routers, peers and clients that the session is connected to.
    pub connected: u64,
    /// Connections that ended: outages of the network, and others that went.
    pub ended: u64,
}

/// Counts links as they come and go.
#[derive(Debug, Default)]
pub struct Links(Mutex<LinksStatus>);

impl Links {
    /// Counts those of a session, as long as it lives.
    pub(super) async fn watch(self: &Arc<Self>, session: &Session) -> Result<(), zenoh::Error> {
        let links = Arc::clone(self);
        let info = session.info();
        let listener = info.transport_events_listener().history(true);
        let count = move |event: zenoh::session::TransportEvent| {
            let other = event.transport();
            links.count(event.kind(), &format!("{} {}", other.whatami(), other.zid()));
        };
        listener.callback(count).background().await
    }

    fn count(&self, kind: SampleKind, other: &str) {
        let mut status = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        match kind {
            SampleKind::Put => {
                status.connected += 1;
                tracing::info!("connected to {other}");
            }
            SampleKind::Delete => {
                status.connected = status.connected.saturating_sub(1);
                status.ended += 1;
                tracing::info!("the connection to {other} ended");
            }
        }
    }

    /// How many there are and were.
    #[must_use]
    pub fn status(&self) -> LinksStatus {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
