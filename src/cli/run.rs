//! `gmapd run`: the daemon, until a signal ends it.

use std::convert::Infallible;
use std::io::IsTerminal as _;
use std::num::NonZeroUsize;
use std::path::PathBuf;
use std::time::Duration;

use anyhow::Context as _;
use clap::Args;
use gmapd::config::Config;
use gmapd::daemon::keys::Prefix;
use gmapd::daemon::{self, Settings};
use gmapd::starting;
use tokio::runtime::Handle;
use tokio::task::spawn_blocking;
use tracing_subscriber::EnvFilter;

use super::session::SessionArguments;
use super::signals::Signals;
use super::start::StartArguments;

/// What is logged if nothing is said: Zenoh tells more than an operator wants to know.
const LOG_FILTER: &str = "warn,gmapd=info";

/// Exit code of a process that a second Ctrl-C ended, as shells count it.
const INTERRUPTED: i32 = 130;

/// Between two warnings that nobody answers.
const WAITING: Duration = Duration::from_secs(10);

/// What Zenoh takes beyond the largest message that is read, bytes: what is a little too large is
/// told with its key.
const ROOM: usize = 4 << 20;

/// How long tasks that are left may take at the end.
const LAST_BREATH: Duration = Duration::from_millis(100);

/// What to map, and where the mesh is.
#[derive(Debug, Args)]
#[command(after_help = "\
    Maps what a robot sends on PREFIX/scan (sensor_msgs/LaserScan) and PREFIX/odom\n\
    (nav_msgs/Odometry), or PREFIX/tf instead of odom, as ROS 2 CDR or as JSON.\n\
    The laser's place on the robot comes from PREFIX/tf_static or from laser in the configuration.\n\
    Ctrl-C or SIGTERM ends it; a second one ends it at once.\n\n\
    GMAPD_LOG (or RUST_LOG) says what is logged to stderr, as in GMAPD_LOG=gmapd=debug.\n\n\
    Examples:\n  \
        gmapd run --prefix robot01                     on the local network\n  \
        gmapd run --prefix robot01 -e tcp/10.0.0.1:7447\n                                                 \
        through a router\n  \
        gmapd run --config config/gmapd.yaml --set laser='{x: 0.2}' -l tcp/0.0.0.0:7447\n  \
        gmapd run --prefix robot01 --state /var/lib/gmapd\n                                                 \
        goes on where it was, after a crash too\n\n\
    Going on in a map that was saved:\n  \
        gmapd run --map maps/office.yaml                        from where the first scan fits\n  \
        gmapd run --map maps/office.yaml --initial-pose 1.5,-2,0.5\n  \
        gmapd run --map maps/office.yaml --mode localization    the map stays as it is\n  \
        gmapd run --state /var/lib/gmapd --initial-pose search  a robot that was carried\n\n\
    Then, from anywhere on the mesh:\n  \
        gmapd get robot01 status                       what it does, and why the map does not grow\n\n\
    Exit codes: 0 ended by a signal, 1 failed, 2 wrong usage, 130 ended by a second signal.")]
pub(crate) struct Arguments {
    /// Configuration, or a parameter file of slam_gmapping; slam_gmapping's defaults without
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// What the robot's keys begin with; the same as --set prefix=ROBOT
    #[arg(long, value_name = "ROBOT")]
    prefix: Option<String>,
    /// Set a key of the configuration; may be repeated
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Which system maps; the same as --set engine=ENGINE
    #[arg(long, value_name = "ENGINE")]
    engine: Option<String>,
    /// Seed of the random numbers; the same as --set seed=N
    #[arg(long, value_name = "N")]
    seed: Option<u64>,
    /// Threads of the filter; one a processor without. The result is the same for any number
    #[arg(long, value_name = "N")]
    threads: Option<NonZeroUsize>,
    /// Keep the state in DIR, and go on from there after a restart; the same as state_directory
    #[arg(long, value_name = "DIR")]
    state: Option<PathBuf>,
    #[command(flatten)]
    start: StartArguments,
    #[command(flatten)]
    mesh: SessionArguments,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    start_log()?;
    let settings = settings(arguments)?;
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .thread_name("daemon")
        .enable_all()
        .build()
        .context("cannot start the threads of the daemon")?;
    let ended = runtime.block_on(until_signalled(settings, &arguments.mesh));
    // Zenoh blocks threads while it connects or its network is slow.
    runtime.shutdown_timeout(LAST_BREATH);
    ended
}

fn start_log() -> anyhow::Result<()> {
    let set = ["GMAPD_LOG", "RUST_LOG"].into_iter().find_map(|name| {
        let directives = std::env::var(name).ok()?;
        Some(EnvFilter::try_new(directives).with_context(|| format!("{name} is no log filter")))
    });
    let filter = set.unwrap_or_else(|| Ok(EnvFilter::new(LOG_FILTER)))?;
    tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_ansi(std::io::stderr().is_terminal())
        .with_writer(std::io::stderr)
        .init();
    Ok(())
}

fn settings(arguments: &Arguments) -> anyhow::Result<Settings> {
    let mut overrides = arguments.set.clone();
    overrides.extend(arguments.engine.as_ref().map(|engine| format!("engine={engine}")));
    overrides.extend(arguments.seed.map(|seed| format!("seed={seed}")));
    overrides.extend(arguments.start.overrides());
    if let Some(directory) = &arguments.state {
        let text = directory.to_str().context("the path of --state is not UTF-8")?;
        // A JSON string is a YAML string, whatever is in it.
        overrides.push(format!("state_directory={}", serde_json::Value::from(text)));
    }
    let config = Config::load(arguments.config.as_deref(), &overrides)?;
    for warning in &config.warnings {
        tracing::warn!("{warning}");
    }
    if cfg!(debug_assertions) {
        tracing::warn!("this is a debug build, many times slower than a release build");
    }
    // Told before the mesh is waited for.
    starting::known_map(&config)?;
    let prefix = Prefix::parse(arguments.prefix.as_deref().unwrap_or(&config.raw.prefix))?;
    let threads = arguments.threads.map_or_else(std::thread::available_parallelism, Ok);
    // A system that does not say has one.
    let threads = threads.map_or(1, NonZeroUsize::get);
    Ok(Settings { config, prefix, threads })
}

async fn until_signalled(settings: Settings, mesh: &SessionArguments) -> anyhow::Result<()> {
    let mut signals = Signals::listen()?;
    if !mesh.endpoints().is_empty() {
        tracing::info!("connecting to {}", mesh.endpoints().join(", "));
    }
    let (runtime, reachable) = (Handle::current(), mesh.clone());
    let most = settings.config.raw.max_message_bytes + ROOM;
    // It blocks the thread that polls it.
    let opening = spawn_blocking(move || runtime.block_on(reachable.open_when_reachable(most)));
    let session = tokio::select! {
        session = opening => session.context("the session could not be opened")??,
        never = tell_waiting(mesh) => match never {},
        () = signals.next() => return Ok(()),
    };
    let robot = settings.prefix.to_string();
    tell_where(&session, &robot).await;
    let shutdown = async move {
        signals.next().await;
        tracing::info!("ending; a second signal ends at once");
        tokio::spawn(async move {
            signals.next().await;
            std::process::exit(INTERRUPTED);
        });
    };
    daemon::run(session, settings, shutdown).await?;
    Ok(())
}

/// Says again and again that nobody has answered yet.
async fn tell_waiting(mesh: &SessionArguments) -> Infallible {
    let endpoints = match mesh.endpoints() {
        [] => "the endpoints of Zenoh's configuration".to_owned(),
        endpoints => endpoints.join(", "),
    };
    loop {
        tokio::time::sleep(WAITING).await;
        tracing::warn!(
            "nobody answers at {endpoints}, or lets us in: is a router there, with a certificate \
             of our authority, and are our certificate, name and password those it knows? It is \
             tried again; GMAPD_LOG=zenoh_transport=debug,zenoh=debug tells more"
        );
    }
}

async fn tell_where(session: &zenoh::Session, robot: &str) {
    let locators: Vec<String> =
        session.info().locators().await.iter().map(ToString::to_string).collect();
    if locators.is_empty() {
        tracing::info!("gmapd {} is a client of the mesh", env!("CARGO_PKG_VERSION"));
    } else {
        let locators = locators.join(", ");
        tracing::info!("gmapd {} listens on {locators}", env!("CARGO_PKG_VERSION"));
    }
    let robot = if robot.is_empty() { String::new() } else { format!("{robot} ") };
    tracing::info!("how it goes: gmapd get {robot}status");
}
