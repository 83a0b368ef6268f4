//! What the tests that drive the real program share.

use std::fs;
use std::io::{BufRead as _, BufReader, Read};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::thread;
use std::time::Duration;

use tempfile::TempDir;

/// Much longer than anything takes, for machines with other things to do.
pub(crate) const PATIENCE: Duration = Duration::from_secs(60);

/// A router, so that everybody on loopback hears everybody, and nobody else does.
pub(crate) const ROUTER: &str = r#"{
    mode: "router",
    listen: { endpoints: ["tcp/127.0.0.1:0"] },
    scouting: { multicast: { enabled: false }, gossip: { enabled: false } },
}"#;

pub(crate) fn program() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_gmapd"));
    command.stdin(Stdio::null()).env_remove("COLUMNS");
    command
}

/// A finished run of the program.
pub(crate) struct Run {
    pub(crate) code: Option<i32>,
    pub(crate) stdout: Vec<u8>,
    pub(crate) stderr: String,
}

impl Run {
    fn of(output: Output) -> Self {
        let stderr = String::from_utf8(output.stderr).expect("it prints text");
        Self { code: output.status.code(), stdout: output.stdout, stderr }
    }

    pub(crate) fn text(&self) -> &str {
        std::str::from_utf8(&self.stdout).expect("it prints text")
    }
}

pub(crate) fn gmapd(arguments: &[&str]) -> Run {
    Run::of(program().args(arguments).output().expect("the program was built with this test"))
}

/// What it printed; it has to succeed.
pub(crate) fn succeed(arguments: &[&str]) -> String {
    let run = gmapd(arguments);
    assert_eq!(run.code, Some(0), "{arguments:?}: {}{}", run.text(), run.stderr);
    run.text().to_owned()
}

/// A program that runs until the test ends.
pub(crate) struct Background {
    child: Child,
    lines: Receiver<String>,
}

impl Background {
    /// Its standard error and output are read all the time, or it would block.
    pub(crate) fn start(command: &mut Command) -> Self {
        let mut child = command
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .expect("the program was built with this test");
        let (sender, lines) = channel();
        let out: Box<dyn Read + Send> = Box::new(child.stdout.take().expect("it is piped"));
        let err: Box<dyn Read + Send> = Box::new(child.stderr.take().expect("it is piped"));
        for stream in [out, err] {
            let sender = sender.clone();
            let read = move || {
                for line in BufReader::new(stream).lines().map_while(Result::ok) {
                    sender.send(line).ok();
                }
            };
            let thread = thread::Builder::new().name("output".to_owned());
            thread.spawn(read).expect("a thread can be started");
        }
        Self { child, lines }
    }

    /// The first line to come that has this in it.
    pub(crate) fn line_with(&self, word: &str) -> String {
        loop {
            let line = self.lines.recv_timeout(PATIENCE);
            let line = line.unwrap_or_else(|error| panic!("no line with {word:?}: {error}"));
            if line.contains(word) {
                return line;
            }
        }
    }

    pub(crate) fn interrupt(&self) {
        self.signal("-INT");
    }

    pub(crate) fn signal(&self, signal: &str) {
        let id = self.child.id().to_string();
        let killed = Command::new("kill").args([signal, &id]).status().expect("kill is there");
        assert!(killed.success());
    }

    pub(crate) fn exit_code(&mut self) -> Option<i32> {
        self.child.wait().expect("it was started").code()
    }
}

impl Drop for Background {
    fn drop(&mut self) {
        self.child.kill().ok();
        self.child.wait().ok();
    }
}

/// The endpoint in a line that tells one.
pub(crate) fn endpoint(line: &str) -> String {
    let word = line.split_whitespace().find(|word| word.starts_with("tcp/127.0.0.1:"));
    word.expect("it listens on loopback").trim_end_matches(',').to_owned()
}

/// A daemon, and where it listens.
pub(crate) struct Daemon {
    pub(crate) background: Background,
    pub(crate) endpoint: String,
    /// Where it runs.
    directory: TempDir,
}

impl Daemon {
    pub(crate) fn start(prefix: &str) -> Self {
        Self::start_with(prefix, &[])
    }

    pub(crate) fn start_with(prefix: &str, arguments: &[&str]) -> Self {
        let directory = directory();
        let zenoh = file(&directory, "router.json5", ROUTER);
        let mut command = program();
        command.args(["run", "--prefix", prefix, "--zenoh", text(&zenoh), "--threads", "1"]);
        command.args(arguments).current_dir(directory.path());
        let background = Background::start(&mut command);
        let endpoint = endpoint(&background.line_with("listens on"));
        Self { background, endpoint, directory }
    }

    /// Where it saves maps.
    pub(crate) fn maps(&self) -> PathBuf {
        self.directory.path().join("maps")
    }

    /// Sends a log to it, and returns what was said at the end.
    pub(crate) fn play(&self, arguments: &[&str]) -> String {
        succeed(&[&["play", "-e", &self.endpoint], arguments].concat())
    }
}

pub(crate) fn directory() -> TempDir {
    tempfile::tempdir().expect("a temporary directory can be made")
}

pub(crate) fn text(path: &Path) -> &str {
    path.to_str().expect("temporary names are text")
}

pub(crate) fn file(directory: &TempDir, name: &str, content: &str) -> PathBuf {
    let path = directory.path().join(name);
    fs::write(&path, content).expect("a temporary directory can be written to");
    path
}

/// A drive of 143 s through a corridor.
pub(crate) fn simulated_log(directory: &TempDir) -> PathBuf {
    let path = directory.path().join("sim.log");
    succeed(&["simulate", "--scenario", "corridor", "--beams", "90", "--out", text(&path)]);
    path
}
