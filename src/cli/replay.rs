//! `gmapd replay`: a recorded run to a map, a trajectory and figures.

use std::fmt::Write as _;
use std::io::Write as _;
use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, bail, ensure};
use clap::Args;
use gmapd::clock::Stopwatch;
use gmapd::config::{Config, EngineKind};
use gmapd::daemon::ledger::Verdict;
use gmapd::daemon::synchronizer::Refusal;
use gmapd::evaluation::{tum, tum_of_path};
use gmapd::files::write_atomically;
use gmapd::given_poses::GivenPoses;
use gmapd::logs::Reading;
use gmapd::map;
use gmapd::recorded::Event;
use gmapd::replay::{Hashes, Outcome, PhaseTimes, Replay, Run, Summary};
use gmapd::slam::pose::Point2;
use sha2::{Digest as _, Sha256};

use super::log::{Along, Log, Refusals, TopicArguments};
use super::progress::Progress;
use super::start::StartArguments;

/// What to replay, and how.
#[derive(Debug, Args)]
#[command(after_help = "\
    The log is one of these, told by its first bytes:\n\
    - CARMEN, plain or gzipped: FLASER, ROBOTLASER1, ODOM and PARAM lines are used, others are\n  \
      counted, and it is replayed in file order;\n\
    - rosbag2's MCAP (a file, or the folder with metadata.yaml) and ROS 1 bags: scans, odometry\n  \
      and transforms are used, in the order of their log times. Topics are found by type, or\n  \
      named with --scan and --odom; frames are those of the configuration, or as the recorded\n  \
      transforms tell them. What is damaged is told and passed over.\n\
    The same log, configuration and seed give the same map on any number of threads, and\n\
    the map and the path that gmapd run makes of the log when gmapd play sends it.\n\n\
    With --out DIR: map.pgm and map.yaml (nav2's map_server loads them), map.png (to look at),\n\
    trajectory.tum (evo opens it) and summary.json. Without, only the summary is printed.\n\n\
    Examples:\n  \
        gmapd replay intel.log --out out\n  \
        gmapd replay run.bag --out out\n  \
        gmapd replay rosbag2_2026_01_01/ --scan /front/scan --odom /odom --out out\n  \
        gmapd replay run.mcap --expect 1f0a5c...   (the map's hash, as a replay prints it)\n  \
        gmapd replay intel.log.gz --config config/gmapd.yaml --set maxUrange=40 --out out\n  \
        gmapd replay intel.log --engine known_poses --poses out/trajectory.tum --out again\n  \
        gmapd replay next.log --map out/map.yaml --initial-pose search --mode localization\n  \
        gmapd replay intel.log --set particles=30 --set delta=0.1 --seed 7 --json")]
pub(crate) struct Arguments {
    /// Recorded log
    log: PathBuf,
    #[command(flatten)]
    topics: TopicArguments,
    /// Configuration, or a parameter file of slam_gmapping; slam_gmapping's defaults without
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Directory for the results; made if it is not there
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Set a key of the configuration; may be repeated
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Which system maps; the same as --set engine=ENGINE
    #[arg(long, value_name = "ENGINE")]
    engine: Option<String>,
    /// Poses to map along, for --engine known_poses: TUM's format, or stamp x y theta.
    /// Without, those of the log: its corrected ones, or transforms from map_frame to base_frame
    #[arg(long, value_name = "FILE")]
    poses: Option<PathBuf>,
    /// Seed of the random numbers; the same as --set seed=N
    #[arg(long, value_name = "N")]
    seed: Option<u64>,
    #[command(flatten)]
    start: StartArguments,
    /// Threads of the filter; the result is the same for any number
    #[arg(long, value_name = "N", default_value = "1")]
    threads: NonZeroUsize,
    /// Fail unless the map has this hash
    #[arg(long, value_name = "HASH")]
    expect: Option<String>,
    /// Print the summary as JSON
    #[arg(long)]
    json: bool,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let config = load_config(arguments)?;
    let threads = arguments.threads.get();
    let replay = Replay::new(&config, threads)?;
    // Where a file gives poses, the log's odometry is odometry.
    let of_log = match arguments.poses {
        Some(_) => config.clone(),
        None => config.with_poses_as_odometry(),
    };
    let log = Log::open(&arguments.log, &arguments.topics, &of_log)?;
    log.warn(&arguments.log);
    if let Some(directory) = &arguments.out {
        std::fs::create_dir_all(directory)
            .with_context(|| format!("cannot make the directory {}", directory.display()))?;
    }
    let watch = Stopwatch::start();
    let outcome = match poses(arguments, &config)? {
        Poses::Odometry => along(Along::Odometry, &log, &config, replay)?,
        Poses::OfLog => {
            log.warn_of_odometry(&arguments.log)?;
            along(Along::CorrectedPoses, &log, &config, replay)?
        }
        Poses::Given(poses) => along_given_poses(&log, &config, replay, &poses)?,
    };
    let elapsed = watch.elapsed();

    let products = Products::of(&outcome);
    let mut written = match &arguments.out {
        Some(directory) => products.write(directory, &outcome)?,
        None => Vec::new(),
    };
    // Last, so that the peak of memory is that of the whole run.
    let run = Run { config: &config, threads, log: log.statistics(), elapsed };
    let summary = Summary::new(&run, &outcome, products.hashes());
    if let Some(directory) = &arguments.out {
        let path = directory.join("summary.json");
        write_atomically(&path, json(&summary)?.as_bytes())?;
        written.push(path);
    }
    let text = if arguments.json { json(&summary)? } else { readable(&summary, &written) };
    std::io::stdout().lock().write_all(text.as_bytes()).context("cannot print the summary")?;
    match &arguments.expect {
        Some(expected) => check_hash(expected, &summary.sha256),
        None => Ok(()),
    }
}

fn load_config(arguments: &Arguments) -> anyhow::Result<Config> {
    let mut overrides = arguments.set.clone();
    overrides.extend(arguments.engine.as_ref().map(|engine| format!("engine={engine}")));
    overrides.extend(arguments.seed.map(|seed| format!("seed={seed}")));
    overrides.extend(arguments.start.overrides());
    let config = Config::load(arguments.config.as_deref(), &overrides)?;
    for warning in &config.warnings {
        eprintln!("warning: {warning}");
    }
    if cfg!(debug_assertions) {
        eprintln!("warning: this is a debug build, many times slower than a release build");
    }
    Ok(config)
}

/// Where the poses come from that go in with the scans.
enum Poses {
    /// The engine corrects odometry.
    Odometry,
    /// The log tells where the robot was in the map.
    OfLog,
    /// A file does.
    Given(GivenPoses),
}

fn poses(arguments: &Arguments, config: &Config) -> anyhow::Result<Poses> {
    match (&arguments.poses, config.raw.engine) {
        (Some(path), EngineKind::KnownPoses) => Ok(Poses::Given(GivenPoses::read(path)?)),
        (None, EngineKind::KnownPoses) => Ok(Poses::OfLog),
        (Some(_), _) => bail!("--poses is for --engine known_poses; other engines find poses"),
        (None, _) => Ok(Poses::Odometry),
    }
}

fn along(poses: Along, log: &Log, config: &Config, mut replay: Replay) -> anyhow::Result<Outcome> {
    let mut progress = Progress::new(log.statistics());
    let mut refusals = Refusals::default();
    for event in log.events(config, poses)? {
        match event? {
            Event::Reading(reading) => {
                add(&mut replay, log, config, &reading);
                progress.advance(reading.stamp);
            }
            Event::ScanAlone(scan, mount) => {
                replay.add_scan_alone(&scan, &mount);
                progress.advance(scan.stamp);
            }
            Event::Refused(refusal) => refuse(&mut replay, &mut refusals, refusal),
        }
    }
    refusals.warn();
    progress.finish();
    Ok(replay.finish())
}

fn along_given_poses(
    log: &Log,
    config: &Config,
    mut replay: Replay,
    poses: &GivenPoses,
) -> anyhow::Result<Outcome> {
    let mut progress = Progress::new(log.statistics());
    let mut refusals = Refusals::default();
    for event in log.events(config, Along::Odometry)? {
        match event? {
            Event::Reading(mut reading) => {
                progress.advance(reading.stamp);
                match poses.at(reading.stamp) {
                    Ok(map_from_base) => {
                        reading.odom_from_base = map_from_base;
                        add(&mut replay, log, config, &reading);
                    }
                    Err(missing) if reading.scan.is_some() => {
                        let (stamp, detail) = (Some(reading.stamp), missing.to_string());
                        let refusal = Refusal { stamp, verdict: Verdict::NoOdometry, detail };
                        refuse(&mut replay, &mut refusals, refusal);
                    }
                    Err(_) => {}
                }
            }
            // The file says where it was taken, whatever the log says.
            Event::ScanAlone(..) => {}
            Event::Refused(refusal) => refuse(&mut replay, &mut refusals, refusal),
        }
    }
    refusals.warn();
    progress.finish();
    Ok(replay.finish())
}

/// Readings that have been messages already are taken as they are.
fn add(replay: &mut Replay, log: &Log, config: &Config, reading: &Reading) {
    if log.is_received(config) {
        replay.add_received(reading);
    } else {
        replay.add(reading);
    }
}

fn refuse(replay: &mut Replay, refusals: &mut Refusals, refusal: Refusal) {
    replay.refuse();
    refusals.add(refusal);
}

/// Fails if another map was expected; both hashes are told.
fn check_hash(expected: &str, hashes: &Hashes) -> anyhow::Result<()> {
    let found = hashes.map.as_deref().unwrap_or("no map");
    ensure!(
        found.eq_ignore_ascii_case(expected),
        "the map is another: its SHA-256 is {found}, and {expected} was expected"
    );
    eprintln!("the map is as expected: {found}");
    Ok(())
}

/// What is hashed even when it is not written.
struct Products {
    /// `map.pgm`; none when no scan was processed.
    map: Option<Vec<u8>>,
    /// `trajectory.tum`.
    trajectory: Vec<u8>,
    /// What the daemon answers for `path?format=tum`.
    path: Vec<u8>,
}

impl Products {
    fn of(outcome: &Outcome) -> Self {
        Self {
            map: outcome.map.as_ref().map(map::pgm),
            trajectory: tum(&outcome.trajectory).into_bytes(),
            path: tum_of_path(&outcome.path).into_bytes(),
        }
    }

    fn hashes(&self) -> Hashes {
        Hashes {
            map: self.map.as_deref().map(sha256),
            trajectory: sha256(&self.trajectory),
            path: sha256(&self.path),
        }
    }

    fn write(&self, directory: &Path, outcome: &Outcome) -> anyhow::Result<Vec<PathBuf>> {
        let mut written = Vec::new();
        let mut write = |name: &str, bytes: &[u8]| {
            let path = directory.join(name);
            write_atomically(&path, bytes)?;
            written.push(path);
            anyhow::Ok(())
        };
        match (&self.map, &outcome.map) {
            (Some(pgm), Some(grid)) => {
                let path: Vec<Point2> =
                    outcome.trajectory.iter().map(|reading| reading.pose.position()).collect();
                write("map.pgm", pgm)?;
                write("map.yaml", map::yaml(grid, "map.pgm").as_bytes())?;
                write("map.png", &map::png(grid, &path).context("cannot draw map.png")?)?;
            }
            _ => eprintln!("warning: no scan was processed, so no map is written"),
        }
        write("trajectory.tum", &self.trajectory)?;
        Ok(written)
    }
}

fn sha256(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect()
}

fn json(summary: &Summary) -> anyhow::Result<String> {
    Ok(serde_json::to_string_pretty(summary)? + "\n")
}

fn readable(summary: &Summary, written: &[PathBuf]) -> String {
    let mut text = String::new();
    let mut line = |name: &str, value: String| {
        writeln!(text, "{name:<14} {value}").ok();
    };
    line("readings", readings(summary));
    line("particles", particles(summary));
    let timing = &summary.timing;
    line(
        "time",
        format!(
            "{:.1} s for {:.0} s of log: {:.0} times real time (CPU {:.1} s, {} threads)",
            timing.wall_s, timing.log_s, timing.real_time_factor, timing.cpu_s, summary.threads
        ),
    );
    if let Some(times) = &timing.scan {
        line("ms a scan", milliseconds(times));
    }
    if let Some(phases) = &timing.phases {
        line("  match", milliseconds(&phases.matching));
        line("  resample", milliseconds(&phases.resample));
        line("  register", milliseconds(&phases.register));
        line("  map", milliseconds(&phases.map));
    }
    if let Some(bytes) = timing.peak_memory_bytes {
        line("peak memory", format!("{:.1} MB", bytes as f64 / 1e6));
    }
    let tiles = &summary.tiles;
    line(
        "tiles",
        format!(
            "{} in {:.1} MB, shared by {:.1} particles on average",
            tiles.distinct,
            tiles.bytes as f64 / 1e6,
            tiles.referenced as f64 / tiles.distinct.max(1) as f64
        ),
    );
    line("map SHA-256", summary.sha256.map.clone().unwrap_or_else(|| "no map".to_owned()));
    line("trajectory", summary.sha256.trajectory.clone());
    line("path", summary.sha256.path.clone());
    for path in written {
        line("wrote", path.display().to_string());
    }
    text
}

fn readings(summary: &Summary) -> String {
    let counts = &summary.readings;
    let rare = [
        (counts.not_moved_enough, "not moved enough"),
        (counts.throttled, "throttled"),
        (counts.no_usable_beams, "without usable beams"),
        (counts.bad_odometry, "with bad odometry"),
        (counts.not_localized, "not localized"),
        (counts.bad_geometry, "with bad geometry"),
        (counts.odometry_only, "odometry only"),
        (counts.jump_rejected, "jumps rejected"),
        (counts.refused, "refused"),
        (counts.malformed, "malformed"),
    ];
    let mut text = format!("{}: {} processed", counts.total, counts.processed);
    for (count, name) in rare.into_iter().filter(|(count, _)| *count > 0) {
        write!(text, ", {count} {name}").ok();
    }
    text
}

fn particles(summary: &Summary) -> String {
    let sizes = summary.effective_sample_size.map_or_else(String::new, |sizes| {
        format!(", effective {:.1} on average, {:.1} at least", sizes.mean, sizes.min)
    });
    format!("{}, resampled {} times{sizes}", summary.particles, summary.resamples)
}

fn milliseconds(times: &PhaseTimes) -> String {
    let cpu = times.cpu_ms;
    format!(
        "CPU mean {:.3}  p50 {:.3}  p99 {:.3}  max {:.3}; wall mean {:.3}",
        cpu.mean, cpu.p50, cpu.p99, cpu.max, times.wall_ms.mean
    )
}
