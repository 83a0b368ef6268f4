//! The subcommands: one file each.

mod demo;
mod doctor;
mod evaluate;
mod feed;
mod get;
mod list;
mod log;
mod mesh;
mod play;
mod progress;
mod readable;
mod record;
mod replay;
mod run;
mod save;
mod session;
mod signals;
mod simulate;
mod start;
mod state;
mod view;

use clap::{Parser, Subcommand};

/// 2D laser mapping for robots on a Zenoh mesh.
#[derive(Debug, Parser)]
#[command(
    version,
    after_help = "Examples:\n  \
        gmapd demo                                     a simulated robot and its map, in a minute\n  \
        gmapd run --prefix robot01                     map live, from scans and odometry on Zenoh\n  \
        gmapd get robot01 map                          a robot's map, drawn\n  \
        gmapd view                                     the same in a browser\n  \
        gmapd doctor robot01                           what is wrong with its scans and odometry\n  \
        gmapd record robot01 -o run.mcap               what it sends and the map, for later\n  \
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
    /// See it work: a simulated robot and its map
    Demo(demo::Arguments),
    /// Send a recorded run onto the mesh
    Play(play::Arguments),
    /// Ask a robot for its map, pose, path or status
    Get(get::Arguments),
    /// Save a robot's map here: PGM and YAML
    Save(save::Arguments),
    /// List the robots that are alive
    List(list::Arguments),
    /// Look at robots and their maps in a browser
    View(view::Arguments),
    /// Watch a robot's input and say what is wrong
    Doctor(doctor::Arguments),
    /// Record what a robot sends and what is made of it
    Record(record::Arguments),
    /// Map a recorded run
    Replay(replay::Arguments),
    /// Look into the state that a daemon keeps
    State(state::Arguments),
    /// Drive a simulated robot and record what it sees
    Simulate(simulate::SimulateArgs),
    /// Compare a trajectory with known relations between its poses
    Evaluate(evaluate::Arguments),
}

/// Runs a subcommand to its end.
pub(crate) fn run(command: Command) -> anyhow::Result<()> {
    match command {
        Command::Run(arguments) => run::run(&arguments),
        Command::Demo(arguments) => demo::run(&arguments),
        Command::Play(arguments) => play::run(&arguments),
        Command::Get(arguments) => get::run(&arguments),
        Command::Save(arguments) => save::run(&arguments),
        Command::List(arguments) => list::run(&arguments),
        Command::View(arguments) => view::run(&arguments),
        Command::Doctor(arguments) => doctor::run(&arguments),
        Command::Record(arguments) => record::run(&arguments),
        Command::Replay(arguments) => replay::run(&arguments),
        Command::State(arguments) => state::run(&arguments),
        Command::Simulate(arguments) => simulate::run(&arguments),
        Command::Evaluate(arguments) => evaluate::run(&arguments),
    }
}
