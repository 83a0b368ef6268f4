//! `gmapd state`: what is in the checkpoints of a daemon.

use std::io::ErrorKind::NotFound;
use std::path::{Path, PathBuf};

use anyhow::ensure;
use clap::{Args, Subcommand};
use gmapd::checkpoint::{self, FORMAT, Head, Opened, Refusal, checkpoints};
use gmapd::daemon::checkpointing::Checkpoint;
use serde_json::{Value, json};

/// What to do with a state.
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    #[command(subcommand)]
    action: Action,
}

#[derive(Debug, Subcommand)]
enum Action {
    /// Say what checkpoints are of, and whether they are good
    Info(Info),
}

/// Which checkpoints.
#[derive(Debug, Args)]
#[command(after_help = "\
    Of a directory, the newest comes first: the daemon goes on from the first that is good and of\n\
    its robot, engine and configuration.\n\n\
    Examples:\n  \
        gmapd state info /var/lib/gmapd\n  \
        gmapd state info --json checkpoint-0000000007.state\n\n\
    Exit codes: 0 there is a good one, 1 there is none, 2 wrong usage.")]
struct Info {
    /// A checkpoint, or a directory of them
    #[arg(value_name = "FILE")]
    path: PathBuf,
    /// As JSON: a list with an object a file
    #[arg(long)]
    json: bool,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let Action::Info(Info { path, json }) = &arguments.action;
    let paths: Vec<PathBuf> = if path.is_dir() {
        checkpoints(path).into_iter().map(|(_, path)| path).collect()
    } else {
        vec![path.clone()]
    };
    // A daemon that runs may have deleted one since they were listed.
    let is_gone = |found: &Found| {
        path.is_dir()
            && matches!(&found.wrong, Some(Refusal::Read(error)) if error.kind() == NotFound)
    };
    let found = paths.iter().map(|path| look(path)).filter(|found| !is_gone(found));
    let found: Vec<Found> = found.collect();
    if *json {
        println!("{:#}", Value::from_iter(found.iter().map(Found::json)));
    } else {
        found.iter().for_each(|found| print!("{}", found.text()));
    }
    ensure!(!found.is_empty(), "there is no checkpoint in {}", path.display());
    ensure!(found.iter().any(|found| found.wrong.is_none()), "there is no good checkpoint");
    Ok(())
}

/// A checkpoint that was looked at.
struct Found {
    path: PathBuf,
    bytes: usize,
    /// As far as it can be read.
    head: Option<Head>,
    /// Why nobody can go on from it.
    wrong: Option<Refusal>,
}

fn look(path: &Path) -> Found {
    let path = path.to_owned();
    let bytes = match checkpoint::read(&path) {
        Ok(bytes) => bytes,
        Err(refusal) => return Found { path, bytes: 0, head: None, wrong: Some(refusal) },
    };
    let (head, wrong) = match checkpoint::open(&bytes) {
        Ok(opened) => (Some(opened.head.clone()), undecodable(&opened)),
        Err(refusal) => (None, Some(refusal)),
    };
    Found { path, bytes: bytes.len(), head, wrong }
}

fn undecodable(opened: &Opened<'_>) -> Option<Refusal> {
    Checkpoint::decode(opened).err()
}

impl Found {
    fn json(&self) -> Value {
        json!({
            "file": self.path.display().to_string(),
            "good": self.wrong.is_none(),
            "reason": self.wrong.as_ref().map(ToString::to_string),
            "bytes": self.bytes,
            "format": self.head.as_ref().map(|_| FORMAT),
            "settings_sha256": self.head.as_ref().map(Head::settings_sha256),
            "head": self.head,
        })
    }

    fn text(&self) -> String {
        let good = self.wrong.as_ref().map_or("good".to_owned(), ToString::to_string);
        let mut lines = vec![format!("{}\n  state        {good}", self.path.display())];
        lines.push(format!("  size         {} bytes", self.bytes));
        if let Some(head) = &self.head {
            lines.extend(words(head));
        }
        lines.join("\n") + "\n"
    }
}

fn words(head: &Head) -> [String; 6] {
    let Head { gmapd, robot, engine, scans, processed, particles, .. } = head;
    let robot = if robot.is_empty() { "without a prefix" } else { robot };
    let stamp =
        head.stamp.map_or("none".to_owned(), |stamp| format!("{:.3} s", stamp.as_seconds()));
    let map = head.map.map_or("none".to_owned(), |map| {
        format!("{} x {} cells of {} m", map.width, map.height, map.resolution)
    });
    [
        format!("  robot        {robot}"),
        format!("  engine       {engine}, {particles} hypotheses"),
        format!("  scans        {processed} of {scans} in the path, the last of {stamp}"),
        format!("  map          {map}"),
        format!("  settings     sha256 {}", head.settings_sha256()),
        format!("  written by   gmapd {gmapd}, format {FORMAT}"),
    ]
}
