//! The subcommands: one file each.

mod evaluate;
mod progress;
mod replay;
mod run;
#[allow(dead_code, reason = "open() is for subcommands that follow")]
mod session;
mod simulate;

use clap::{Parser, Subcommand};

/// 2D laser mapping for robots on a Zenoh mesh.
#[derive(Debug, Parser)]
#[command(
    version,
    after_help = "Examples:\n  \
        gmapd run --prefix robot01                     map live, from scans and odometry on Zenoh\n  \
        gmapd simulate --out sim.log                   make a log to try\n  \
        gmapd replay run.log --out out                 map a recorded run\n  \
        gmapd replay run.log --set particles=60        with more particles\n  \
        gmapd evaluate out/trajectory.tum run.relations\n\n\
        Exit codes: 0 done, 1 failed, 2 wrong usage."
)]
pub(crate) struct Arguments {
    /// What to do.
    #[command(subcommand)]
    pub(crate) command: Command,
}

/// What to do.
#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    /// Map live: scans and odometry from a Zenoh mesh, map and pose to it
    Run(run::Arguments),
    /// Map a recorded run
    Replay(replay::Arguments),
    /// Drive a simulated robot and record what it sees
    Simulate(simulate::SimulateArgs),
    /// Compare a trajectory with known relations between its poses
    Evaluate(evaluate::Arguments),
}

/// Runs a subcommand to its end.
pub(crate) fn run(command: Command) -> anyhow::Result<()> {
    match command {
        Command::Run(arguments) => run::run(&arguments),
        Command::Replay(arguments) => replay::run(&arguments),
        Command::Simulate(arguments) => simulate::run(&arguments),
        Command::Evaluate(arguments) => evaluate::run(&arguments),
    }
}
