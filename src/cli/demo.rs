//! `gmapd demo`: a simulated robot, a daemon and real Zenoh between them, in one process.

use std::collections::BTreeMap;
use std::io::IsTerminal as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context as _, anyhow};
use clap::Args;
use gmapd::clock::Stopwatch;
use gmapd::config::Config;
use gmapd::daemon::keys::Prefix;
use gmapd::daemon::snapshot::{MapVersion, Snapshot};
use gmapd::daemon::{Daemon, Settings};
use gmapd::evaluation::{Alignment, StampedPose, absolute_errors, tum_of_path};
use gmapd::files::write_atomically;
use gmapd::logs::Reading;
use gmapd::map;
use gmapd::sim::lidar::Lidar;
use gmapd::sim::{Simulation, building};
use gmapd::slam::pose::{Point2, Pose2, Stamp};
use indicatif::{ProgressBar, ProgressStyle};
use tokio::task::JoinSet;
use tokio::time::sleep;
use zenoh::Session;

use super::feed::Feed;
use super::mesh;
use super::signals::Signals;
use super::view;

/// The world, the robot's errors and the filter's random numbers.
const SEED: u64 = 1;

/// Side of the building, m: a tour of it is ten times as long.
const BUILDING_M: f64 = 30.0;

/// Seconds that the robot drives a second: the tour takes most of a minute.
const SPEED: f64 = 10.0;

/// Time from line to line of progress where nobody watches.
const LINE_PERIOD: Duration = Duration::from_secs(5);

/// For the daemon, which runs in this process, to answer.
const DAEMON_PATIENCE: Duration = Duration::from_secs(10);

/// Where the robot and its map go.
#[derive(Debug, Args)]
#[command(after_help = "\
    Nothing else is needed: no robot, no ROS, no router, no network. A simulated robot drives\n\
    through an office building of 30 m by 30 m, ten times as fast as a real one, and publishes its\n\
    scans and noisy odometry over Zenoh; a gmapd daemon maps them. Ctrl-C ends it early.\n\n\
    It listens on a port of this machine that it prints; from another terminal, meanwhile:\n  \
        gmapd get -e tcp/127.0.0.1:PORT robot01 map\n  \
        gmapd doctor -e tcp/127.0.0.1:PORT robot01\n\n\
    Examples:\n  \
        gmapd demo\n  \
        gmapd demo --view\n  \
        gmapd demo --out /tmp/demo --prefix r2d2 --seconds 60")]
pub(crate) struct Arguments {
    /// Directory for the map; made if it is not there
    #[arg(long, value_name = "DIR", default_value = "demo")]
    out: PathBuf,
    /// What the robot's keys begin with
    #[arg(long, value_name = "PREFIX", default_value = "robot01", value_parser = Prefix::parse)]
    prefix: Prefix,
    /// Seconds that the robot drives, by its own clock; the whole tour without
    #[arg(long, value_name = "S", value_parser = clap::value_parser!(u32).range(1..))]
    seconds: Option<u32>,
    /// Show it in a browser too: prints the address, which is there until Ctrl-C
    #[arg(long)]
    view: bool,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let Arguments { out, seconds, .. } = arguments;
    std::fs::create_dir_all(out)
        .with_context(|| format!("cannot make the directory {}", out.display()))?;
    let lidar = Lidar::full_circle(360).context("the laser cannot be simulated")?;
    let simulation = Simulation::through(&building::building(SEED, BUILDING_M), 1, lidar, SEED);
    let duration_s = simulation.trajectory.duration_s();
    let duration_s = seconds.map_or(duration_s, |seconds| duration_s.min(f64::from(seconds)));
    let mut drive = Drive { simulation, duration_s, truth: BTreeMap::new() };
    let last = mesh::block_on(drive.mapped(arguments))?;
    let map = last.map.as_deref().context("no scan was processed, so there is no map")?;
    println!("{}", drive.result(&last, map));
    for path in save(out, map)? {
        println!("wrote {}", path.display());
    }
    println!("{}", next_steps(out));
    Ok(())
}

/// A robot on its way through the building.
struct Drive {
    simulation: Simulation,
    /// By the robot's clock.
    duration_s: f64,
    /// Where the base truly was at each scan that was sent.
    truth: BTreeMap<Stamp, Pose2>,
}

impl Drive {
    /// Drives, with a daemon that maps, and returns what that knows at the end.
    async fn mapped(&mut self, arguments: &Arguments) -> anyhow::Result<Arc<Snapshot>> {
        let prefix = &arguments.prefix;
        let daemon_session = zenoh::open(router()?).await.map_err(|error| anyhow!(error))?;
        let endpoint = endpoint(&daemon_session).await?;
        let robot_session =
            zenoh::open(client(&endpoint)?).await.map_err(|error| anyhow!(error))?;
        let config = Config::load(None, &[format!("seed={SEED}")])?;
        let threads = std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
        let settings = Settings { config, prefix: prefix.clone(), threads };
        let daemon = Daemon::start(&daemon_session, settings).await?;
        let robot = mesh::name(prefix);
        println!("a simulated robot drives {:.0} s at {SPEED} times its speed", self.duration_s);
        println!("meanwhile: gmapd get -e {endpoint} {robot} map");
        let mut signals = Signals::listen()?;
        let mut page = JoinSet::new();
        if arguments.view {
            let opened = view::Page::open(([127, 0, 0, 1], 0).into(), robot_session.clone());
            let opened = opened.await?;
            println!("look at it: {}", opened.address);
            page.spawn(opened.serve());
        }
        tokio::select! {
            driven = self.drive(&robot_session, prefix, &daemon) => {
                driven?;
                if arguments.view {
                    println!("the drive is over; the page is there until Ctrl-C");
                    signals.next().await;
                }
            }
            () = signals.next() => {}
        }
        let last = daemon.stop().await;
        robot_session.close().await.ok();
        daemon_session.close().await.ok();
        Ok(last)
    }

    async fn drive(
        &mut self,
        session: &Session,
        prefix: &Prefix,
        daemon: &Daemon,
    ) -> anyhow::Result<()> {
        let mut feed = Feed::open(session, prefix).await?;
        feed.somebody_listens().await?;
        feed.finds_daemon(DAEMON_PATIENCE).await?;
        let mut line = ProgressLine::new(self.duration_s);
        let watch = Stopwatch::start();
        let simulation = self.simulation.clone();
        let mut start = None;
        for simulated in simulation.readings() {
            let start = *start.get_or_insert(simulated.stamp);
            let driven_s = simulated.stamp.seconds_since(start);
            if driven_s > self.duration_s {
                break;
            }
            if self.truth.is_empty() {
                feed.announce(start, &simulation.lidar.mount).await?;
            }
            self.truth.insert(simulated.stamp, simulated.world_from_base);
            let due = Duration::from_secs_f64(driven_s / SPEED);
            sleep(due.saturating_sub(watch.elapsed().wall)).await;
            for reading in readings(simulated) {
                feed.has_room(reading.stamp).await?;
                feed.send(&reading).await?;
            }
            line.advance(driven_s, watch.elapsed().wall, || self.figures(daemon));
        }
        feed.settle().await?;
        line.finish();
        Ok(())
    }

    /// Area, error and speed, for the line of progress.
    fn figures(&self, daemon: &Daemon) -> String {
        let snapshot = daemon.snapshots().borrow().clone();
        let area = daemon.status().map.map_or(0.0, |map| map.known_area_m2);
        let error = self.error_now(&snapshot);
        let error = error.map_or(String::new(), |error| format!(", {:.0} mm off", 1e3 * error));
        format!("{area:.0} m2 known{error}{}", speed(&snapshot))
    }

    /// Distance from the truth, m.
    fn error_now(&self, snapshot: &Snapshot) -> Option<f64> {
        let world_from_base = self.truth.get(&snapshot.estimate.stamp?)?;
        Some(world_from_base.between(snapshot.estimate.pose_in_map).position().norm())
    }

    /// How well it went, in a line.
    fn result(&self, last: &Snapshot, map: &MapVersion) -> String {
        let poses = map.path.iter().filter_map(|(stamp, pose)| {
            let truth = StampedPose { stamp, pose: *self.truth.get(&stamp)? };
            Some((StampedPose { stamp, pose }, truth))
        });
        let (estimate, truth): (Vec<_>, Vec<_>) = poses.unzip();
        let errors = absolute_errors(&estimate, &truth, Alignment::None);
        let error = errors.map_or(String::new(), |[translation, _]| {
            format!(
                ", {:.0} mm from the truth on average, {:.0} mm at most",
                1e3 * translation.mean,
                1e3 * translation.max
            )
        });
        format!("{} scans in the map{error}{}", map.path.len(), speed(last))
    }
}

fn speed(snapshot: &Snapshot) -> String {
    let spread = snapshot.milliseconds_per_scan;
    spread.map_or(String::new(), |spread| format!(", {:.1} ms a scan", spread.mean))
}

/// What the robot publishes at a scan and since the one before.
fn readings(simulated: gmapd::sim::Reading) -> Vec<Reading> {
    let reading = |stamp, odom_from_base, scan| Reading {
        line: 0,
        stamp,
        odom_from_base,
        scan,
        mount: gmapd::slam::scan::LaserMount::default(),
    };
    let between = simulated.odometry_between.into_iter();
    let mut readings: Vec<Reading> =
        between.map(|(stamp, odom_from_base)| reading(stamp, odom_from_base, None)).collect();
    readings.push(reading(simulated.stamp, simulated.odom_from_base, Some(simulated.scan)));
    readings
}

/// Others on this machine reach the robot through it, too.
fn router() -> anyhow::Result<zenoh::Config> {
    config(&[
        ("mode", "\"router\""),
        ("listen/endpoints", r#"["tcp/127.0.0.1:0"]"#),
        ("scouting/multicast/enabled", "false"),
    ])
}

fn client(endpoint: &str) -> anyhow::Result<zenoh::Config> {
    config(&[
        ("mode", "\"client\""),
        ("connect/endpoints", &format!("[\"{endpoint}\"]")),
        ("scouting/multicast/enabled", "false"),
    ])
}

fn config(values: &[(&str, &str)]) -> anyhow::Result<zenoh::Config> {
    let mut config = zenoh::Config::default();
    for (key, value) in values {
        config.insert_json5(key, value).map_err(|error| anyhow!(error))?;
    }
    Ok(config)
}

async fn endpoint(session: &Session) -> anyhow::Result<String> {
    let locators = session.info().locators().await;
    let locator = locators.first().context("the daemon's session does not listen")?;
    Ok(locator.to_string())
}

fn save(directory: &Path, version: &MapVersion) -> anyhow::Result<Vec<PathBuf>> {
    let grid = version.occupancy.to_grid(version.occupied_threshold);
    let grid = grid.context("nothing is known, so there is no map")?;
    let path: Vec<Point2> = version.path.iter().map(|(_, pose)| pose.position()).collect();
    let picture = map::png(&grid, &path).context("cannot draw map.png")?;
    let files: [(&str, Vec<u8>); 4] = [
        ("map.pgm", map::pgm(&grid)),
        ("map.yaml", map::yaml(&grid, "map.pgm").into_bytes()),
        ("map.png", picture),
        ("path.tum", tum_of_path(&version.path).into_bytes()),
    ];
    files
        .into_iter()
        .map(|(name, bytes)| {
            let path = directory.join(name);
            write_atomically(&path, &bytes)?;
            Ok(path)
        })
        .collect()
}

fn next_steps(out: &Path) -> String {
    format!(
        "next: open {}\n\
         then map your own robot: gmapd run --prefix robot01, and from anywhere on the mesh\n\
         gmapd doctor robot01, gmapd get robot01 map",
        out.join("map.png").display()
    )
}

/// How far the robot is, on standard error.
struct ProgressLine {
    bar: Option<ProgressBar>,
    duration_s: f64,
    next_line: Duration,
}

impl ProgressLine {
    fn new(duration_s: f64) -> Self {
        let style = ProgressStyle::with_template("{wide_bar} {pos}/{len} s, {msg}")
            .unwrap_or_else(|_| ProgressStyle::default_bar());
        let bar = || ProgressBar::new(duration_s as u64).with_style(style);
        let bar = std::io::stderr().is_terminal().then(bar);
        Self { bar, duration_s, next_line: Duration::ZERO }
    }

    fn advance(&mut self, driven_s: f64, wall: Duration, figures: impl Fn() -> String) {
        if wall < self.next_line {
            return;
        }
        if let Some(bar) = &self.bar {
            self.next_line = wall + LINE_PERIOD / 50;
            bar.set_position(driven_s as u64);
            bar.set_message(figures());
        } else {
            self.next_line = wall + LINE_PERIOD;
            eprintln!("{driven_s:.0} of {:.0} s: {}", self.duration_s, figures());
        }
    }

    fn finish(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}
