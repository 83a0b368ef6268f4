//! `gmapd record`: what a robot sends, and what gmapd makes of it, to a file.

use std::collections::BTreeMap;
use std::path::PathBuf;

use anyhow::Context as _;
use clap::Args;
use gmapd::config::Keys;
use gmapd::daemon::input::Input;
use gmapd::daemon::keys::{InputKeys, Prefix};
use gmapd::daemon::recorder::Recorder;
use serde::Deserialize;
use zenoh::Session;

use super::mesh;
use super::session::SessionArguments;
use super::signals::Signals;

/// Whom to record, and where to.
#[derive(Debug, Args)]
#[command(after_help = "\
    Records scan, odom, tf and tf_static, and what gmapd run publishes: map, map_metadata, pose,\n\
    particlecloud, path, entropy, diagnostics and tf. Ctrl-C or SIGTERM ends it.\n\n\
    The file is MCAP as rosbag2 writes it: ros2 bag, Foxglove and gmapd replay open it. Until it\n\
    ends it is called FILE.part, which gmapd replay reads, too, after a crash. A file that is there\n\
    is not touched: the new one gets a number.\n\n\
    Examples:\n  \
        gmapd record robot01 -o run.mcap\n  \
        gmapd replay run.mcap --out out")]
pub(crate) struct Arguments {
    /// Whom to record: what the robot's keys begin with; without, the only robot that is alive
    robot: Option<String>,
    /// The file
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    #[command(flatten)]
    session: SessionArguments,
}

/// What is used of a daemon's status.
#[derive(Deserialize)]
struct Status {
    inputs: BTreeMap<String, InputStatus>,
}

#[derive(Default, Deserialize)]
struct InputStatus {
    key: String,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    mesh::block_on(async {
        let session = arguments.session.open().await?;
        let mut signals = Signals::listen()?;
        let robot = mesh::choose(&session, arguments.robot.as_deref()).await?;
        let keys = input_keys(&session, &robot).await?;
        let recorder = Recorder::start(&session, &robot, &keys, &arguments.output).await?;
        // Who answers this has heard of the subscriptions, which went out before.
        mesh::alive(&session).await?;
        eprintln!(
            "recording {} to {}; Ctrl-C ends it",
            mesh::name(&robot),
            recorder.unfinished().display()
        );
        signals.next().await;
        let recorded = recorder.finish().await?;
        println!("recorded {} messages to {}", recorded.messages, recorded.path.display());
        if recorded.lost > 0 {
            eprintln!("warning: {} messages are not in it", recorded.lost);
        }
        session.close().await.ok();
        Ok(())
    })
}

/// The keys that the robot's daemon tells, or without a daemon those of its defaults.
async fn input_keys(session: &Session, robot: &Prefix) -> anyhow::Result<InputKeys> {
    let status = robot.key("slam/status")?.to_string();
    let Some(answer) = mesh::ask(session, &status).await? else {
        return Ok(InputKeys::under(robot, &Keys::default())?);
    };
    let mut status: Status = serde_json::from_slice(&answer.bytes)
        .with_context(|| format!("what answers on {status} is no gmapd"))?;
    let poses = status.inputs.contains_key(Input::Pose.name());
    let motion = if poses { Input::Pose } else { Input::Odom };
    // An input that an older daemon does not have leaves an empty key, which is an error.
    let key = |input: Input| status.inputs.remove(input.name()).unwrap_or_default().key;
    Ok(InputKeys::parse(motion, key)?)
}
