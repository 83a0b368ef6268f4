//! The subcommands: one file each.

mod evaluate;
mod progress;
mod replay;
#[allow(dead_code, reason = "the subcommands that use it follow")]
mod session;
mod simulate;

use clap::{Parser, Subcommand};

/// 2D laser mapping for robots on a Zenoh mesh.
#[derive(Debug, Parser)]
#[command(
    version,
    after_help = "Examples:\n  \
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
        Command::Replay(arguments) => replay::run(&arguments),
        Command::Simulate(arguments) => simulate::run(&arguments),
        Command::Evaluate(arguments) => evaluate::run(&arguments),
    }
}
