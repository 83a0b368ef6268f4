//! Hector mapping: each scan is matched with the map so far (Kohlbrecher, von Stryk, Meyer,
//! Klingauf, SSRR 2011), redesigned.
//!
//! [`Hector::add_scan`] is the algorithm; each of its steps has a file of its own. Beyond the
//! original: the map grows, what is known of the motion enters the match, a poor guess is bettered
//! by a search, and directions that the scan does not tell are left to the guess.

pub mod correlation;
pub mod gauss_newton;
pub mod matcher;
mod parameters;
pub mod prediction;
pub mod prepared_scan;
pub mod pyramid;
pub mod state;
pub mod weakness;

use std::sync::Arc;

use nalgebra::Matrix3;
use serde::{Deserialize, Serialize};

use self::matcher::Placed;
pub use self::parameters::Parameters;
use self::prediction::Prediction;
use self::prepared_scan::{Directions, PreparedScan};
use self::pyramid::Pyramid;
use super::deskew::Velocity;
use super::engine::Sweep;
use super::grid::occupancy::{Count, OccupancyMap, OccupiedThreshold};
use super::grid::tile_map::{TileCounts, TileKey};
use super::known_map::{KnownMap, Mode};
use super::odometry::Motion;
use super::path::Path;
use super::pose::{Pose2, Stamp};
use super::scan::Scan;
use super::search::NotLocalized;
use super::update::{OdometryUpdate, OnPhase, Phase, ScanReport, ScanUpdate, SkipReason};

/// How much of the usual score each scan renews.
const RENEWAL: f64 = 0.1;

/// How surely a pose in a known map is given or found: standard deviations, m and rad.
const INITIAL: [f64; 2] = [0.1, 0.05];

/// Without odometry, a scan enters the map in any case if more than this share of what it sees is
/// new: the next ones have nothing else to go by.
const NEWS: f64 = 0.2;

/// The engine.
#[derive(Debug, Clone)]
pub struct Hector {
    parameters: Parameters,
    directions: Directions,
    pyramid: Pyramid,
    /// At the last processed scan; `None` before the first.
    state: Option<State>,
    odometry: Odometry,
    path: Path,
    output: Output,
    scans_seen: usize,
    mode: Mode,
    beginning: Beginning,
    /// The map in which the robot's place is searched for, while nobody knows where it is.
    searched: Option<Arc<KnownMap>>,
}

/// What the engine begins with, beside its parameters.
#[derive(Debug, Clone, Default)]
struct Beginning {
    /// The map that is known before the first scan.
    known: Option<Arc<KnownMap>>,
    /// Why the last scan was not localized.
    obstacle: Option<NotLocalized>,
}

/// Where the robot was at the last processed scan.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
struct State {
    stamp: Stamp,
    pose_in_map: Pose2,
    covariance: Matrix3<f64>,
    /// Since the processed scan before, a second; for want of odometry.
    velocity: Option<Pose2>,
    /// What scans score a point, on average over the last.
    usual_score: f64,
    /// Where the robot was at the last scan that entered the map.
    registered_at: Pose2,
}

/// What odometry said last, and since the last processed scan.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
struct Odometry {
    odom_from_base: Option<Pose2>,
    since_processed: Motion,
    map_from_odom: Option<Pose2>,
}

impl Hector {
    /// An engine with no scan yet.
    #[must_use]
    pub fn new(parameters: Parameters) -> Self {
        Self {
            directions: Directions::default(),
            pyramid: Pyramid::new(&parameters),
            state: None,
            odometry: Odometry::default(),
            path: Path::default(),
            output: Output::new(parameters.resolution),
            scans_seen: 0,
            mode: Mode::Mapping,
            beginning: Beginning::default(),
            searched: None,
            parameters,
        }
    }

    /// Begins with a known map, before the first scan. Without an initial pose, the first scan's
    /// is searched for.
    pub fn begin_on(&mut self, known: Arc<KnownMap>) {
        let Self { pyramid, output, .. } = self;
        pyramid.enter(known.cells(), |tile| output.stale.push(tile));
        self.beginning = Beginning { known: Some(known), obstacle: None };
    }

    /// Whether scans enter the map from now on.
    pub const fn set_mode(&mut self, mode: Mode) {
        self.mode = mode;
    }

    /// Whether scans enter the map.
    #[must_use]
    pub const fn mode(&self) -> Mode {
        self.mode
    }

    /// Why the last scan was not localized, until one is.
    #[must_use]
    pub const fn obstacle(&self) -> Option<&NotLocalized> {
        self.beginning.obstacle.as_ref()
    }

    /// Forgets map and path, as if nothing had been read: the next scan is the first, at
    /// `initial_pose` in `map`, or where odometry says.
    pub fn reset(&mut self, initial_pose: Option<Pose2>) {
        let parameters = Parameters { initial_pose, ..self.parameters.clone() };
        let (mode, known) = (self.mode, self.beginning.known.take());
        *self = Self { mode, ..Self::new(parameters) };
        known.into_iter().for_each(|known| self.begin_on(known));
    }

    /// Says where the base is in `map`: before the first scan, where the map begins; later, the
    /// robot is there, and the map stays where it is. A search for the pose ends.
    pub fn set_pose(&mut self, pose_in_map: Pose2) {
        self.searched = None;
        let Some(state) = &mut self.state else {
            self.parameters.initial_pose = Some(pose_in_map);
            return;
        };
        let Prediction { covariance, .. } = Prediction::within(pose_in_map, INITIAL);
        *state = State { pose_in_map, covariance, velocity: None, ..*state };
        self.odometry.since_processed = Motion::default();
        self.odometry.anchor(pose_in_map);
    }

    /// Forgets where the robot is: its place is searched for in the map, until a scan fits there.
    /// Before the first scan there is only a known map to search, or none.
    pub fn search_pose(&mut self) {
        self.parameters.initial_pose = None;
        let grid = self.occupancy().to_grid(OCCUPIED_THRESHOLD).filter(|_| self.state.is_some());
        self.searched = grid.map(|grid| Arc::new(KnownMap::new(grid, OCCUPIED_THRESHOLD)));
    }

    /// Whether nobody knows where the robot is in the map so far.
    #[must_use]
    pub const fn is_searching(&self) -> bool {
        self.searched.is_some()
    }

    /// Forgets where odometry has the base: the next reading begins anew, and is no motion.
    pub const fn forget_odometry(&mut self) {
        self.odometry.odom_from_base = None;
    }

    /// Takes an odometry reading: the base in `odom`.
    pub fn add_odometry(&mut self, odom_from_base: Pose2) -> OdometryUpdate {
        let jump = &self.parameters.jump;
        if !jump.is_usable(odom_from_base) {
            return OdometryUpdate::NotUsable;
        }
        let Some(before) = self.odometry.odom_from_base.replace(odom_from_base) else {
            return OdometryUpdate::Accepted;
        };
        let step = before.between(odom_from_base);
        if jump.rejects(step) {
            self.odometry.map_from_odom = None;
            return OdometryUpdate::JumpRejected;
        }
        self.odometry.since_processed.extend(step);
        OdometryUpdate::Accepted
    }

    /// Takes a scan; `on_phase` is called as each phase of processing ends.
    pub fn add_scan(&mut self, sweep: &Sweep<'_>, on_phase: OnPhase<'_>) -> ScanUpdate {
        let scan = match self.admit(sweep) {
            Ok(scan) => scan,
            Err(reason) => return ScanUpdate::Skipped(reason),
        };
        if let Err(reason) = self.locate(&scan) {
            return ScanUpdate::Skipped(reason);
        }
        let placed = self.place(&scan, sweep);
        on_phase(Phase::Match);
        on_phase(Phase::Resample);
        let registered = self.advance(&scan, sweep, &placed) && self.mode == Mode::Mapping;
        if registered {
            let Self { pyramid, output, .. } = self;
            pyramid.add(&scan, placed.pose_in_map, |tile| output.stale.push(tile));
        }
        on_phase(Phase::Register);
        on_phase(Phase::Map);
        ScanUpdate::Processed(ScanReport {
            hits: scan.hits.len(),
            matched: usize::from(placed.matched),
            best_score: placed.score,
            effective_sample_size: 1.0,
            entropy: 0.0,
            resampled: false,
            registered,
            weak_direction: placed.weakness.direction_in_map(placed.pose_in_map.theta),
        })
    }

    /// The scan made ready, if it is to be processed.
    fn admit(&mut self, sweep: &Sweep<'_>) -> Result<PreparedScan, SkipReason> {
        self.scans_seen += 1;
        if let Some(odom_from_base) = sweep.odom_from_base
            && self.add_odometry(odom_from_base) == OdometryUpdate::NotUsable
        {
            return Err(SkipReason::BadOdometry);
        }
        if !self.scans_seen.is_multiple_of(self.parameters.throttle_scans.max(1)) {
            return Err(SkipReason::Throttled);
        }
        let deskewed = self.deskewed(sweep);
        let scan = deskewed.as_ref().unwrap_or(sweep.scan);
        let scan = self.directions.prepare(scan, sweep.mount, &self.parameters);
        if scan.hits.is_empty() { Err(SkipReason::NoUsableBeams) } else { Ok(scan) }
    }

    /// Without odometry, the scan as seen by a robot that goes on as before during the sweep.
    fn deskewed(&self, sweep: &Sweep<'_>) -> Option<Scan> {
        let Sweep { scan, odom_from_base: None, .. } = sweep else { return None };
        let takes_time = scan.geometry.time_increment() != 0.0;
        let Pose2 { x, y, theta: turn } = self.state.filter(|_| takes_time)?.velocity?;
        let geometry = scan.geometry.with_velocity(Velocity { x, y, turn });
        Some(Scan { geometry, ..(*scan).clone() })
    }

    /// Where the scan was taken, as far as the map, odometry and the motion so far tell.
    fn place(&self, scan: &PreparedScan, sweep: &Sweep<'_>) -> Placed {
        let Some(state) = &self.state else {
            let odometry = sweep.odom_from_base.unwrap_or_default();
            let pose = self.parameters.initial_pose.unwrap_or(odometry);
            if self.beginning.known.is_none() {
                return Placed::first(scan, pose);
            }
            let prediction = Prediction::within(pose, INITIAL);
            return matcher::place(&self.pyramid, scan, &prediction, 1.0);
        };
        let prediction = self.predict(state, sweep);
        matcher::place(&self.pyramid, scan, &prediction, state.usual_score)
    }

    /// Searches for where the scan was taken: in the known map if it is the first and no pose is
    /// set, and in the map so far if the robot's place is searched for.
    fn locate(&mut self, scan: &PreparedScan) -> Result<(), SkipReason> {
        let anywhere = self.state.is_none() && self.parameters.initial_pose.is_none();
        let known = self.beginning.known.as_ref().filter(|_| anywhere);
        if let Some(known) = self.searched.as_ref().or(known) {
            match known.find(&scan.outline, None) {
                Ok(place) => self.set_pose(place.pose_in_map),
                Err(obstacle) => {
                    self.beginning.obstacle = Some(obstacle);
                    return Err(SkipReason::NotLocalized);
                }
            }
        }
        self.beginning.obstacle = None;
        Ok(())
    }

    fn predict(&self, state: &State, sweep: &Sweep<'_>) -> Prediction {
        let Self { odometry, parameters, .. } = self;
        let from = (state.pose_in_map, state.covariance);
        if sweep.odom_from_base.is_some() && odometry.map_from_odom.is_some() {
            return Prediction::by_odometry(
                from,
                &odometry.since_processed,
                parameters.motion_noise,
            );
        }
        let seconds = sweep.scan.stamp.seconds_since(state.stamp);
        Prediction::by_velocity(from, state.velocity, seconds)
    }

    /// Goes on to where the scan was taken; whether it is to enter the map.
    fn advance(&mut self, scan: &PreparedScan, sweep: &Sweep<'_>, placed: &Placed) -> bool {
        let (pose_in_map, stamp) = (placed.pose_in_map, sweep.scan.stamp);
        let last = self.state.map(|state| state.registered_at);
        let registered = placed.matched
            && last.is_none_or(|last| {
                let moved = last.between(pose_in_map);
                let news = || self.pyramid.unknown_share(scan, pose_in_map);
                moved.position().norm() > self.parameters.update_distance
                    || moved.theta.abs() > self.parameters.update_angle
                    || (sweep.odom_from_base.is_none() && news() > NEWS)
            });
        let velocity = self.state.filter(|_| placed.matched).and_then(|state| {
            let seconds = stamp.seconds_since(state.stamp);
            let motion = state.pose_in_map.between(pose_in_map);
            prediction::velocity(motion, seconds, state.velocity)
        });
        let score = if placed.points > 0.0 { placed.score / placed.points } else { 1.0 };
        let usual = self.state.map_or(1.0, |state| state.usual_score);
        self.state = Some(State {
            stamp,
            usual_score: usual + RENEWAL * (score - usual),
            pose_in_map,
            covariance: placed.covariance,
            velocity,
            registered_at: last.filter(|_| !registered).unwrap_or(pose_in_map),
        });
        self.odometry.since_processed = Motion::default();
        if sweep.odom_from_base.is_none() {
            // What odometry says next has no beginning that this scan shares.
            self.odometry.odom_from_base = None;
            self.odometry.map_from_odom = None;
        } else {
            self.odometry.anchor(pose_in_map);
        }
        self.path.push(stamp, pose_in_map);
        registered
    }

    /// The base in `map` at the last processed scan, with odometry since; the initial pose before
    /// the first.
    #[must_use]
    pub fn pose_in_map(&self) -> Pose2 {
        let initial = self.parameters.initial_pose.unwrap_or_default();
        let processed = self.state.map_or(initial, |state| state.pose_in_map);
        processed * self.odometry.since_processed.increment
    }

    /// What takes odometry poses to the map; the identity before the first scan and without
    /// odometry.
    #[must_use]
    pub fn map_from_odom(&self) -> Pose2 {
        match (&self.state, self.odometry.odom_from_base) {
            (Some(_), Some(odom_from_base)) => self.pose_in_map() * odom_from_base.inverse(),
            _ => Pose2::IDENTITY,
        }
    }

    /// How sure the pose of the last processed scan is, relative to the map: m², m rad, rad².
    #[must_use]
    pub fn covariance(&self) -> Matrix3<f64> {
        self.state.map_or_else(Matrix3::zeros, |state| state.covariance)
    }

    /// Whether a scan has been processed.
    #[must_use]
    pub const fn has_begun(&self) -> bool {
        self.state.is_some()
    }

    /// The pose of the base at each processed scan, oldest first; it never changes afterwards.
    #[must_use]
    pub const fn path(&self) -> &Path {
        &self.path
    }

    /// The finest map as it is handed out: a cell more likely occupied than free was hit by the
    /// one scan that saw it, as [`OCCUPIED_THRESHOLD`] reads it.
    pub fn occupancy(&mut self) -> &OccupancyMap {
        self.output.renew(&self.pyramid)
    }

    /// The tiles of all levels.
    #[must_use]
    pub fn tiles(&self) -> TileCounts {
        self.pyramid.tiles()
    }
}

/// When a cell of [`Hector::occupancy`] is occupied.
pub const OCCUPIED_THRESHOLD: OccupiedThreshold = OccupiedThreshold::of_share(0.5);

impl Odometry {
    /// Takes note of where the base is in `map` as odometry stands.
    fn anchor(&mut self, pose_in_map: Pose2) {
        self.map_from_odom = self.odom_from_base.map(|odom| pose_in_map * odom.inverse());
    }
}

/// The map that is handed out, brought up to date when it is asked for.
#[derive(Debug, Clone)]
struct Output {
    map: OccupancyMap,
    /// Tiles that have changed since, some more than once.
    stale: Vec<TileKey>,
}

impl Output {
    fn new(resolution: f64) -> Self {
        Self { map: OccupancyMap::new(resolution), stale: Vec::new() }
    }

    fn renew(&mut self, pyramid: &Pyramid) -> &OccupancyMap {
        self.stale.sort_unstable();
        self.stale.dedup();
        for key in self.stale.drain(..) {
            let Some(cells) = pyramid.finest().cells().tile(key) else { continue };
            let counts = cells.map(|cell| match cell.sign() {
                0 => Count::default(),
                sign => Count { hits: u32::from(sign > 0), visits: 1 },
            });
            // A tile that stays as it is stays shared.
            if self.map.counts().tile(key) != Some(&counts) {
                *self.map.tile_mut(key) = counts;
            }
        }
        &self.map
    }
}
