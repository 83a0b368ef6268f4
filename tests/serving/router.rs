//! A router in a process of its own, as it is killed and started anew.

use std::io::{BufRead as _, BufReader};
use std::process::{Child, Command, Stdio};

use zenoh::Session;
use zenoh::sample::SampleKind;

use super::{UnboundedReceiver, unbounded_channel};

/// The program itself, in the mode of a router. It is killed when this is dropped.
pub(crate) struct Router {
    child: Child,
    /// Where it listens.
    pub(crate) endpoint: String,
    _directory: tempfile::TempDir,
}

impl Router {
    /// Port 0 is any.
    pub(crate) fn start(endpoint: &str) -> Self {
        let directory = tempfile::tempdir().expect("there is a place for temporary files");
        let file = directory.path().join("router.json5");
        let config = format!(
            r#"{{ mode: "router", listen: {{ endpoints: [{endpoint:?}] }},
                 scouting: {{ multicast: {{ enabled: false }}, gossip: {{ enabled: false }} }} }}"#
        );
        std::fs::write(&file, config).expect("a temporary directory can be written to");
        let mut command = Command::new(env!("CARGO_BIN_EXE_gmapd"));
        command.args(["run", "--prefix", "router", "--threads", "1", "--zenoh"]).arg(&file);
        command.current_dir(directory.path()).stdin(Stdio::null()).stderr(Stdio::piped());
        let mut child = command.spawn().expect("the program was built with this test");
        let stderr = child.stderr.take().expect("it is piped");
        let mut lines = BufReader::new(stderr).lines().map_while(Result::ok);
        let line = lines.find(|line| line.contains("listens on")).expect("it listens");
        // What it says later is read, or it would be held up.
        let thread = std::thread::Builder::new().name("output".to_owned());
        thread.spawn(move || lines.for_each(drop)).expect("a thread can be started");
        let word = line.split_whitespace().find(|word| word.starts_with("tcp/127.0.0.1:"));
        let endpoint = word.expect("it tells where").trim_end_matches(',').to_owned();
        Self { child, endpoint, _directory: directory }
    }
}

impl Drop for Router {
    fn drop(&mut self) {
        self.child.kill().ok();
        self.child.wait().ok();
    }
}

/// A client that looks for a router that is gone several times a second.
pub(crate) async fn open_impatient(endpoint: &str) -> Session {
    let config = format!(
        r#"{{ mode: "client",
             connect: {{ endpoints: [{endpoint:?}], timeout_ms: -1,
                         retry: {{ period_init_ms: 50, period_max_ms: 200 }} }},
             scouting: {{ multicast: {{ enabled: false }}, gossip: {{ enabled: false }} }} }}"#
    );
    let config = zenoh::Config::from_json5(&config).expect("it is well-formed");
    zenoh::open(config).await.expect("the router is there")
}

/// The links of a session, as they come and go.
pub(crate) async fn links(session: &Session) -> UnboundedReceiver<SampleKind> {
    let (sender, receiver) = unbounded_channel();
    let info = session.info();
    let listener = info.transport_events_listener();
    let tell = move |event: zenoh::session::TransportEvent| {
        sender.send(event.kind()).ok();
    };
    listener.callback(tell).background().await.expect("the session is open");
    receiver
}
