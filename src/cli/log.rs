//! Opens what was recorded, whatever its format.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::ensure;
use clap::Args;
use gmapd::config::Config;
use gmapd::daemon::frames::FrameNames;
use gmapd::daemon::ledger::Verdict;
use gmapd::daemon::synchronizer::Refusal;
use gmapd::logs::carmen::CarmenLog;
use gmapd::logs::recording::{self, Format, Recording};
use gmapd::logs::{LogError, LogStatistics};
use gmapd::recorded::{Event, Recorded, Sweeps, Topics, Wanted};

/// Malformed lines and damaged places that are told one by one.
const FAULTS_SHOWN: usize = 10;

/// Which topics of a recording are used.
#[derive(Debug, Clone, Default, Args)]
pub(super) struct TopicArguments {
    /// Topic of the scans, where a recording has several
    #[arg(long, value_name = "TOPIC")]
    scan: Option<String>,
    /// Topic of odometry, nav_msgs/Odometry or transforms, where a recording has several
    #[arg(long, value_name = "TOPIC")]
    odom: Option<String>,
}

/// What comes next, or why no more can be read.
pub(super) type Events<'a> = Box<dyn Iterator<Item = Result<Event, LogError>> + 'a>;

/// Which poses of a CARMEN log go in with its scans.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Along {
    Odometry,
    CorrectedPoses,
}

/// A recorded run.
pub(super) enum Log {
    /// Readings, line by line.
    Carmen(CarmenLog),
    /// ROS messages.
    Recorded(Box<Recorded>),
}

impl Log {
    pub(super) fn open(
        path: &Path,
        topics: &TopicArguments,
        config: &Config,
    ) -> anyhow::Result<Self> {
        let format = recording::format(path)?;
        let wanted = Wanted { scan: topics.scan.clone(), odometry: topics.odom.clone() };
        if format == Format::Carmen {
            ensure!(
                wanted == Wanted::default(),
                "{} is a CARMEN log, which has no topics to choose with --scan and --odom",
                path.display()
            );
            return Ok(Self::Carmen(CarmenLog::open(path)?));
        }
        let recording = Recording::new(path, format)?;
        Ok(Self::Recorded(Box::new(Recorded::open(recording, path, &wanted, config)?)))
    }

    pub(super) const fn statistics(&self) -> &LogStatistics {
        match self {
            Self::Carmen(log) => log.statistics(),
            Self::Recorded(recorded) => recorded.statistics(),
        }
    }

    /// What the filter is to take, in its order.
    pub(super) fn events(&self, config: &Config, along: Along) -> Result<Events<'_>, LogError> {
        let log = match self {
            Self::Carmen(log) => log,
            Self::Recorded(recorded) => return Ok(Box::new(recorded.readings(config).map(Ok))),
        };
        let readings: Box<dyn Iterator<Item = _>> = match along {
            Along::Odometry => Box::new(log.readings()?),
            Along::CorrectedPoses => Box::new(log.corrected_readings()?),
        };
        if has_sweeps(config) {
            return Ok(Box::new(Sweeps::new(readings, config)));
        }
        Ok(Box::new(readings.map(|reading| reading.map(Event::Reading))))
    }

    /// Whether its readings have been messages, or are as a synchronizer makes them of such.
    pub(super) fn is_received(&self, config: &Config) -> bool {
        matches!(self, Self::Recorded(_)) || has_sweeps(config)
    }

    /// Tells what is used, and what could not be read.
    pub(super) fn warn(&self, path: &Path) {
        match self {
            Self::Carmen(log) => warn_about_lines(log.statistics(), path),
            Self::Recorded(recorded) => {
                eprintln!("{}", used(recorded));
                for fault in recorded.faults().iter().take(FAULTS_SHOWN) {
                    eprintln!("warning: {fault}; what can be read is used");
                }
                for rejected in recorded.rejected() {
                    eprintln!("warning: {rejected}");
                }
            }
        }
    }

    /// Tells if the poses that a CARMEN log has for its scans are none but odometry's.
    pub(super) fn warn_of_odometry(&self, path: &Path) -> Result<(), LogError> {
        if let Self::Carmen(log) = self
            && !log.has_corrected_poses()?
        {
            eprintln!(
                "warning: in {} no pose is corrected: the map is along odometry; --poses FILE gives \
                 other poses",
                path.display()
            );
        }
        Ok(())
    }
}

/// CARMEN's scans do not say how long a sweep takes; the configuration may.
fn has_sweeps(config: &Config) -> bool {
    config.raw.sweep_time_s.is_some_and(|seconds| seconds > 0.0)
}

/// What is used of a recording, in words.
fn used(recorded: &Recorded) -> String {
    let Topics { scan, odometry, transforms, .. } = recorded.topics();
    let FrameNames { base, odom } = recorded.frames();
    let odometry = odometry.clone().unwrap_or_else(|| transforms.join(" and "));
    format!("scans on {scan}, odometry on {odometry}, from `{odom}` to `{base}`")
}

fn warn_about_lines(log: &LogStatistics, path: &Path) {
    for malformed in log.first_malformed.iter().take(FAULTS_SHOWN) {
        eprintln!("warning: {}:{}: {}", path.display(), malformed.line, malformed.reason);
    }
    if log.malformed > FAULTS_SHOWN as u64 {
        eprintln!("warning: {} malformed lines in all", log.malformed);
    }
}

/// Scans that did not reach the filter.
#[derive(Debug, Default)]
pub(super) struct Refusals {
    /// How many, and what was said of the last.
    by_verdict: BTreeMap<Verdict, (u64, String)>,
}

impl Refusals {
    pub(super) fn add(&mut self, refusal: Refusal) {
        let (count, detail) = self.by_verdict.entry(refusal.verdict).or_default();
        *count += 1;
        *detail = refusal.detail;
    }

    pub(super) fn warn(&self) {
        for (count, detail) in self.by_verdict.values() {
            eprintln!("warning: {count} scans could not be used; of the last of them: {detail}");
        }
    }
}
