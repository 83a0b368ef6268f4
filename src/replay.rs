//! Runs the filter over recorded readings, one after the other and as fast as it goes.
//!
//! Each reading passes once through the ROS messages that would carry it over a mesh, so that a
//! replay gives what the daemon gives for the same log, byte for byte.
//!
//! The result depends on the readings, the configuration and the seed alone; the figures about
//! time and memory come from [`crate::clock`].

mod summary;

use std::time::Duration;

pub use summary::{
    Counts, Hashes, PhaseSplit, PhaseTimes, Run, SampleSizes, Summary, Tiles, Timing,
};

use crate::clock::{Elapsed, Stopwatch};
use crate::config::{Config, InitialPose, OdometrySource};
use crate::convert;
use crate::evaluation::StampedPose;
use crate::logs::Reading;
use crate::slam::engine::{Engine, Sweep};
use crate::slam::grid::occupancy::OccupancyGrid;
use crate::slam::known_map::Mode;
use crate::slam::path::Path;
use crate::slam::pose::{Pose2, Stamp};
use crate::slam::scan::{LaserMount, Scan};
use crate::slam::update::{OdometryUpdate, Phase, ScanReport, ScanUpdate, SkipReason};
use crate::starting::{self, StartError};

/// An engine that is fed with readings, and what came of each.
#[derive(Debug)]
pub struct Replay {
    engine: Engine,
    /// What odometry says is passed over if the configuration wants none.
    source: OdometrySource,
    weak: u64,
    mount: Option<LaserMount>,
    track: Track,
    counts: Counts,
    sample_sizes: Vec<f64>,
    resamples: u64,
    times: ScanTimes,
}

impl Replay {
    /// An engine as configured, before its first reading.
    ///
    /// # Errors
    /// When the map to start from cannot be used, or the threads cannot be started.
    pub fn new(config: &Config, threads: usize) -> Result<Self, StartError> {
        let searches = matches!(config.raw.initial_pose, Some(InitialPose::Search(_)));
        match config.raw.map {
            None if config.raw.mode == Mode::Localization => {
                return Err(StartError::NoMap("mode is localization"));
            }
            None if searches => return Err(StartError::NoMap("initial_pose is search")),
            _ => {}
        }
        Ok(Self {
            engine: starting::engine(config, threads)?,
            source: config.raw.odometry_source,
            weak: 0,
            mount: config.laser_mount(),
            track: Track::default(),
            counts: Counts::default(),
            sample_sizes: Vec::new(),
            resamples: 0,
            times: ScanTimes::default(),
        })
    }

    /// Takes the next reading of a log that no message has carried yet.
    pub fn add(&mut self, reading: &Reading) -> Verdict {
        let mount = mount_as_received(&reading.mount);
        let scan = reading.scan.as_ref().map(scan_as_received);
        let odom_from_base = convert::odometry_as_received(reading.stamp, reading.odom_from_base);
        self.take(reading.stamp, self.wanted(odom_from_base), scan.as_ref(), &mount)
    }

    /// Takes the next reading as messages have brought it.
    pub fn add_received(&mut self, reading: &Reading) -> Verdict {
        let scan = reading.scan.clone().map(Some);
        let odom_from_base = self.wanted(reading.odom_from_base);
        self.take(reading.stamp, odom_from_base, scan.as_ref(), &reading.mount)
    }

    /// Takes a scan that messages have brought, and no odometry with it.
    pub fn add_scan_alone(&mut self, scan: &Scan, mount: &LaserMount) -> Verdict {
        self.take(scan.stamp, None, Some(&Some(scan.clone())), mount)
    }

    /// Counts a scan that does not reach the filter, for want of odometry or order.
    pub const fn refuse(&mut self) {
        self.counts.refused += 1;
    }

    /// `Some(None)` is a scan that no message can carry.
    fn take(
        &mut self,
        stamp: Stamp,
        odom_from_base: Option<Pose2>,
        scan: Option<&Option<Scan>>,
        mount: &LaserMount,
    ) -> Verdict {
        let step = self.add_odometry(stamp, odom_from_base);
        let verdict = match (scan, step) {
            (Some(Some(scan)), _) => self.add_scan(scan, mount, odom_from_base),
            (Some(None), _) => Verdict::BadGeometry,
            (None, OdometryUpdate::NotUsable) => Verdict::BadOdometry,
            (None, OdometryUpdate::Accepted | OdometryUpdate::JumpRejected) => {
                Verdict::OdometryOnly
            }
        };
        self.counts.add(verdict, step);
        verdict
    }

    /// Ends the replay: the map, and the trajectory as the best particle sees it now.
    #[must_use]
    pub fn finish(mut self) -> Outcome {
        let path = self.engine.path();
        Outcome {
            map: self.engine.occupancy_grid(),
            trajectory: self.track.corrected(&path),
            path,
            tiles: self.engine.tiles().into(),
            counts: self.counts,
            sample_sizes: self.sample_sizes,
            resamples: self.resamples,
            weak: self.weak,
            times: self.times,
        }
    }

    /// What odometry says, unless the configuration wants none.
    fn wanted(&self, odom_from_base: Pose2) -> Option<Pose2> {
        (self.source != OdometrySource::None).then_some(odom_from_base)
    }

    /// Every reading's odometry passes the jump guard; a scan's counts no second time after it.
    fn add_odometry(&mut self, stamp: Stamp, odom_from_base: Option<Pose2>) -> OdometryUpdate {
        let step = odom_from_base
            .map_or(OdometryUpdate::Accepted, |odometry| self.engine.add_odometry(odometry));
        self.track.add(stamp, odom_from_base, step);
        step
    }

    fn add_scan(
        &mut self,
        scan: &Scan,
        mount: &LaserMount,
        odom_from_base: Option<Pose2>,
    ) -> Verdict {
        let mount = &self.mount.unwrap_or(*mount);
        let sweep = Sweep { scan, mount, odom_from_base };
        let mut phases = [Elapsed::default(); PHASES];
        let total = Stopwatch::start();
        let mut phase_watch = total;
        let update = self.engine.add_scan(&sweep, &mut |phase| {
            let spent = phase_watch.lap();
            let sum = &mut phases[phase_index(phase)];
            sum.wall += spent.wall;
            sum.cpu += spent.cpu;
        });
        let total = total.elapsed();
        match update {
            ScanUpdate::Processed(report) => {
                self.track.mark_processed();
                self.add_report(&report);
                self.times.add(total, phases);
                Verdict::Processed
            }
            ScanUpdate::Skipped(reason) => reason.into(),
        }
    }

    fn add_report(&mut self, report: &ScanReport) {
        self.sample_sizes.push(report.effective_sample_size);
        self.resamples += u64::from(report.resampled);
        self.weak += u64::from(report.weak_direction.is_some());
    }
}

fn scan_as_received(scan: &Scan) -> Option<Scan> {
    convert::scan(convert::laser_scan(scan, "")).ok()
}

fn mount_as_received(mount: &LaserMount) -> LaserMount {
    let message = convert::mount_transform(convert::header(Stamp(0), ""), "", mount);
    let received = convert::transform(message)
        .and_then(|transform| convert::laser_mount(&transform.parent_from_child));
    received.unwrap_or(*mount)
}

/// What a replay leaves.
#[derive(Debug)]
pub struct Outcome {
    /// The map of the best particle; `None` when no scan was processed.
    pub map: Option<OccupancyGrid>,
    /// The pose of the base in `map` at every reading.
    pub trajectory: Vec<StampedPose>,
    /// The pose of the base in `map` at every processed scan.
    pub path: Path,
    /// Tiles of the particles' maps.
    pub tiles: Tiles,
    /// Readings by verdict.
    pub counts: Counts,
    /// The effective sample size at every processed scan.
    pub sample_sizes: Vec<f64>,
    /// How often particles were drawn anew.
    pub resamples: u64,
    /// Processed scans that left a direction open, where the engine looks for it.
    pub weak: u64,
    /// What processed scans took.
    pub times: ScanTimes,
}

/// What became of a reading.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Verdict {
    /// Its scan is in the map, or was placed in a map that is frozen.
    Processed,
    /// The robot had not moved enough since the last processed scan.
    NotMovedEnough,
    /// Not the n-th scan that `throttle_scans` asks for.
    Throttled,
    /// No beam is a hit within `maxUrange`.
    NoUsableBeams,
    /// Its odometry is not finite, or further away than a robot gets.
    BadOdometry,
    /// Where in the known map its scan was taken cannot be told.
    NotLocalized,
    /// The angles or limits of its scan are none when written with the digits of a message.
    BadGeometry,
    /// It has no scan.
    OdometryOnly,
}

impl From<SkipReason> for Verdict {
    fn from(reason: SkipReason) -> Self {
        match reason {
            SkipReason::Throttled => Self::Throttled,
            SkipReason::NotMovedEnough => Self::NotMovedEnough,
            SkipReason::NoUsableBeams => Self::NoUsableBeams,
            SkipReason::BadOdometry => Self::BadOdometry,
            SkipReason::NotLocalized => Self::NotLocalized,
        }
    }
}

/// How many variants [`Phase`] has.
const PHASES: usize = 4;

const fn phase_index(phase: Phase) -> usize {
    match phase {
        Phase::Match => 0,
        Phase::Resample => 1,
        Phase::Register => 2,
        Phase::Map => 3,
    }
}

/// Time of every processed scan, whole and by phase, in milliseconds.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ScanTimes {
    total: Times,
    phases: [Times; PHASES],
}

impl ScanTimes {
    fn add(&mut self, total: Elapsed, phases: [Elapsed; PHASES]) {
        self.total.add(total);
        for (times, elapsed) in self.phases.iter_mut().zip(phases) {
            times.add(elapsed);
        }
    }
}

#[derive(Debug, Clone, Default, PartialEq)]
struct Times {
    wall_ms: Vec<f64>,
    cpu_ms: Vec<f64>,
}

impl Times {
    fn add(&mut self, elapsed: Elapsed) {
        let milliseconds = |duration: Duration| duration.as_secs_f64() * 1e3;
        self.wall_ms.push(milliseconds(elapsed.wall));
        self.cpu_ms.push(milliseconds(elapsed.cpu));
    }
}

/// Odometry of every reading, and which of them were processed.
///
/// Processed scans are known by their order: stamps of real logs repeat and step back.
#[derive(Debug, Default)]
struct Track {
    last_odom_from_base: Option<Pose2>,
    /// Odometry with its jumps taken out, from the first reading on.
    readings: Vec<StampedPose>,
    /// Indices into `readings`.
    processed: Vec<usize>,
}

impl Track {
    /// Without odometry the robot is taken to stand, and what odometry says next has no beginning.
    fn add(&mut self, stamp: Stamp, odom_from_base: Option<Pose2>, step: OdometryUpdate) {
        let last = self.readings.last().map(|reading| reading.pose);
        let accepted = odom_from_base.filter(|_| step == OdometryUpdate::Accepted);
        let pose = match (accepted, last, self.last_odom_from_base) {
            (Some(now), Some(last), Some(before)) => last * before.between(now),
            (Some(now), None, _) => now,
            (_, last, _) => last.unwrap_or_default(),
        };
        if step != OdometryUpdate::NotUsable {
            self.last_odom_from_base = odom_from_base;
        }
        self.readings.push(StampedPose { stamp, pose });
    }

    fn mark_processed(&mut self) {
        self.processed.push(self.readings.len().saturating_sub(1));
    }

    /// At every reading the corrected pose of the last processed scan with the odometry since;
    /// before the first processed scan, odometry traced back from it.
    fn corrected(self, path: &Path) -> Vec<StampedPose> {
        let mut anchors = self.processed.iter().zip(path.iter()).peekable();
        let correction = |(&index, (_, pose_in_map)): (&usize, (Stamp, Pose2))| {
            pose_in_map * self.readings[index].pose.inverse()
        };
        let mut map_from_odom =
            anchors.peek().map_or(Pose2::IDENTITY, |&anchor| correction(anchor));
        let mut trajectory = self.readings.clone();
        for (index, reading) in trajectory.iter_mut().enumerate() {
            if let Some(anchor) = anchors.next_if(|&(&at, _)| at == index) {
                map_from_odom = correction(anchor);
            }
            reading.pose = map_from_odom * reading.pose;
        }
        trajectory
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn near(a: Pose2, b: Pose2) -> bool {
        let difference = a.between(b);
        difference.position().norm() < 1e-12 && difference.theta.abs() < 1e-12
    }

    fn track(readings: &[(Pose2, OdometryUpdate)], processed: &[usize]) -> Track {
        let mut track = Track::default();
        for (index, &(odom_from_base, step)) in readings.iter().enumerate() {
            track.add(Stamp(0), Some(odom_from_base), step);
            if processed.contains(&index) {
                track.mark_processed();
            }
        }
        track
    }

    fn at(x: f64) -> Pose2 {
        Pose2::new(x, 0.0, 0.0)
    }

    #[test]
    fn between_processed_scans_odometry_is_appended() {
        let turned = Pose2::new(5.0, 5.0, std::f64::consts::FRAC_PI_2);
        let track =
            track(&[0.0, 1.0, 2.0, 3.0, 3.5].map(|x| (at(x), OdometryUpdate::Accepted)), &[1, 3]);
        let path = [(Stamp(0), turned), (Stamp(0), at(10.0))];
        let poses: Vec<Pose2> =
            track.corrected(&path.into_iter().collect()).into_iter().map(|p| p.pose).collect();
        let expected = [
            Pose2::new(5.0, 4.0, turned.theta),
            turned,
            Pose2::new(5.0, 6.0, turned.theta),
            at(10.0),
            at(10.5),
        ];
        assert!(poses.iter().zip(expected).all(|(&a, b)| near(a, b)), "{poses:?}");
    }

    #[test]
    fn a_rejected_jump_is_no_motion() {
        let readings = [
            (at(0.0), OdometryUpdate::Accepted),
            (at(100.0), OdometryUpdate::JumpRejected),
            (at(101.0), OdometryUpdate::Accepted),
            (Pose2::new(f64::NAN, 0.0, 0.0), OdometryUpdate::NotUsable),
            (at(102.0), OdometryUpdate::Accepted),
        ];
        let track = track(&readings, &[0]);
        let poses = track.corrected(&std::iter::once((Stamp(0), at(0.0))).collect());
        let x: Vec<f64> = poses.iter().map(|p| p.pose.x).collect();
        assert_eq!(x, [0.0, 0.0, 1.0, 1.0, 2.0]);
    }

    #[test]
    fn without_odometry_the_robot_stands_between_scans() {
        let mut track = Track::default();
        for odom_from_base in [Some(at(5.0)), Some(at(6.0)), None, Some(at(9.0)), Some(at(9.5))] {
            track.add(Stamp(0), odom_from_base, OdometryUpdate::Accepted);
            if odom_from_base.is_none() {
                track.mark_processed();
            }
        }
        let poses = track.corrected(&std::iter::once((Stamp(0), at(20.0))).collect());
        let x: Vec<f64> = poses.iter().map(|p| p.pose.x).collect();
        assert_eq!(x, [19.0, 20.0, 20.0, 20.0, 20.5]);
    }

    #[test]
    fn without_a_processed_scan_the_trajectory_is_odometry() {
        let poses = track(&[1.0, 2.0].map(|x| (at(x), OdometryUpdate::Accepted)), &[])
            .corrected(&Path::default());
        assert_eq!(poses.iter().map(|p| p.pose.x).collect::<Vec<_>>(), [1.0, 2.0]);
    }
}
