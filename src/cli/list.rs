//! `gmapd list`: who is alive on the mesh.

use std::io::Write as _;

use anyhow::{Context as _, bail};
use clap::Args;
use gmapd::daemon::keys::Prefix;
use serde_json::Value;

use super::mesh;
use super::readable;
use super::session::SessionArguments;

/// Where to look.
#[derive(Debug, Args)]
#[command(after_help = "\
    Examples:\n  \
        gmapd list\n  \
        gmapd list -e tcp/192.168.1.5:7447\n\n\
    Exit codes: 0 somebody is alive, 1 nobody is, 2 wrong usage.")]
pub(crate) struct Arguments {
    #[command(flatten)]
    session: SessionArguments,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let (alive, statuses) = mesh::block_on(async {
        let session = arguments.session.open().await?;
        let alive = mesh::alive(&session).await?;
        let answers = mesh::ask_all(&session, "slam/status").await?;
        session.close().await.ok();
        let status = |(robot, answer): (Prefix, mesh::Answer)| {
            Some((robot, serde_json::from_slice(&answer.bytes).ok()?))
        };
        Ok((alive, answers.into_iter().filter_map(status).collect::<Vec<(Prefix, Value)>>()))
    })?;
    if alive.is_empty() {
        bail!(
            "nobody is alive on this mesh: start gmapd run, or name the way to it with \
             -e tcp/HOST:PORT"
        );
    }
    let mut out = std::io::stdout().lock();
    for robot in &alive {
        let status = statuses.iter().find(|(other, _)| other == robot).map(|(_, status)| status);
        writeln!(out, "{}", line(robot, status)).context("cannot print")?;
    }
    Ok(())
}

fn line(robot: &Prefix, status: Option<&Value>) -> String {
    let name = mesh::name(robot);
    let Some(status) = status else { return format!("{name:<16} does not answer") };
    let state = status["state"].as_str().unwrap_or("?").replace('_', " ");
    let map = readable::map_size(status).unwrap_or_else(|| "no map yet".to_owned());
    let pose = readable::pose_of(status).unwrap_or_default();
    format!("{name:<16} {state:<21} {map}; at {pose}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_robot_has_a_line() {
        let robot = Prefix::parse("robot01").unwrap();
        assert_eq!(line(&robot, None), "robot01          does not answer");
        let status = serde_json::json!({
            "state": "waiting_for_scans", "map": null,
            "pose_in_map": {"x": 1.0, "y": 2.0, "theta": 0.0},
        });
        assert_eq!(
            line(&robot, Some(&status)),
            "robot01          waiting for scans     no map yet; at (1.000 m, 2.000 m), 0.0 degrees"
        );
    }
}
