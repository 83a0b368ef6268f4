//! GMapping: a Rao-Blackwellized particle filter over trajectories and maps
//! (Grisetti, Stachniss, Burgard, IEEE T-RO 23(1), 2007), redesigned.
//!
//! [`GMapping::add_scan`] is the algorithm; each of its steps has a file of its own.

pub mod compat;
pub mod motion_model;
pub mod output_map;
mod parameters;
mod particle;
pub mod prepared_scan;
pub mod random;
pub mod resampling;
pub mod scan_matcher;
pub mod state;
pub mod trajectory;

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

use nalgebra::Matrix3;
use rayon::iter::{
    IndexedParallelIterator as _, IntoParallelRefMutIterator as _, ParallelIterator as _,
};
use serde::{Deserialize, Serialize};
use thiserror::Error;

use self::output_map::OutputMap;
pub use self::parameters::{MapParameters, Parameters};
pub use self::particle::Particle;
use self::particle::{ParticleMap, ScanMatcher, Step};
use self::prepared_scan::PreparedScan;
use self::random::{Purpose, Streams};
pub use self::resampling::{WeightSmoothing, Weighting};
pub use self::scan_matcher::{MatcherKind, MatcherParameters};
use self::trajectory::{NodeId, TrajectoryTree};
use super::grid::occupancy::{OccupancyGrid, OccupancyMap, OccupiedThreshold};
use super::grid::tile_map::TileCounts;
use super::known_map::{KnownMap, Mode};
use super::odometry::Motion;
pub use super::odometry::{JumpGuard, JumpPolicy};
use super::path::Path;
use super::pose::{Pose2, Stamp, wrap_angle};
use super::search::NotLocalized;
pub use super::update::{
    OdometryUpdate, OnPhase, Phase, ScanReading, ScanReport, ScanUpdate, SkipReason,
};

/// A particle must be this much likelier than the best one to take its place, in nats: four times.
///
/// Weights of nearly equal particles take turns at being the largest; without this the map and the
/// pose would jump between them, and the output map would be rebuilt over and over.
const CLEARLY_BETTER: f64 = 2.0 * std::f64::consts::LN_2;

/// The worker threads could not be started.
#[derive(Debug, Error)]
#[error("cannot start {threads} threads for the particles")]
pub struct ThreadsError {
    threads: usize,
    source: rayon::ThreadPoolBuildError,
}

/// Processed scans after which a trajectory is not disputed any more: loops up to this length
/// are closed by a choice among whole trajectories.
///
/// Then only particles that have the best one's past are drawn. It bounds the memory of particles
/// that are hardly ever drawn anew, and what the output map does when the best particle changes.
const HISTORY: u32 = 400;

/// The filter.
#[derive(Debug, Clone)]
pub struct GMapping {
    parameters: Parameters,
    streams: Streams,
    /// `None` runs everything on the caller's thread.
    pool: Option<Arc<rayon::ThreadPool>>,
    matcher: ScanMatcher,
    /// Empty before the first scan.
    particles: Vec<Particle>,
    /// Index of the particle whose map and trajectory are handed out.
    best: usize,
    tree: TrajectoryTree,
    output: OutputMap,
    odometry: Odometry,
    /// The beginning of all particles' trajectories, which is in the tree no more.
    settled: Path,
    /// Of the processed scans after those.
    stamps: VecDeque<Stamp>,
    scans_seen: usize,
    mode: Mode,
    beginning: Beginning,
    /// The map in which the robot's place is searched for, while nobody knows where it is.
    searched: Option<Arc<KnownMap>>,
}

/// What the filter begins with, beside its parameters.
#[derive(Debug, Clone, Default)]
struct Beginning {
    /// The map that is known before the first scan.
    known: Option<Arc<KnownMap>>,
    /// The same as particles have it.
    map: ParticleMap,
    /// Why the last scan was not localized.
    obstacle: Option<NotLocalized>,
}

/// What odometry said last, and since the last processed scan.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
struct Odometry {
    odom_from_base: Option<Pose2>,
    since_processed: Motion,
}

impl Odometry {
    /// Every pose in it, to look whether they are numbers.
    fn poses(&self) -> impl Iterator<Item = Pose2> {
        self.odom_from_base.into_iter().chain(self.since_processed.poses())
    }
}

impl GMapping {
    /// A filter with no scan yet. `threads` of 1 or 0 runs everything on the caller's thread.
    ///
    /// # Errors
    /// When the threads cannot be started.
    pub fn new(parameters: Parameters, seed: u64, threads: usize) -> Result<Self, ThreadsError> {
        let builder = rayon::ThreadPoolBuilder::new().num_threads(threads);
        let builder = builder.thread_name(|i| format!("particles-{i}"));
        let pool = (threads > 1).then(|| builder.build()).transpose();
        Ok(Self {
            streams: Streams::new(seed),
            pool: pool.map_err(|source| ThreadsError { threads, source })?.map(Arc::new),
            matcher: ScanMatcher::new(parameters.matcher, parameters.resolution),
            particles: Vec::new(),
            best: 0,
            tree: TrajectoryTree::default(),
            output: OutputMap::new(parameters.resolution),
            odometry: Odometry::default(),
            settled: Path::default(),
            stamps: VecDeque::new(),
            scans_seen: 0,
            mode: Mode::Mapping,
            beginning: Beginning::default(),
            searched: None,
            parameters,
        })
    }

    /// Begins with a known map, before the first scan. Without an initial pose, the first scan's
    /// is searched for.
    pub fn begin_on(&mut self, known: Arc<KnownMap>) {
        self.output = OutputMap::on(known.occupancy());
        let map = self.matcher.map_of(&known);
        self.beginning = Beginning { known: Some(known), map, obstacle: None };
    }

    /// Whether scans enter the map from now on.
    ///
    /// When they do no more, all particles go on from the best one's pose and share its map.
    pub fn set_mode(&mut self, mode: Mode) {
        if self.mode == Mode::Mapping && mode == Mode::Localization {
            self.unite();
        }
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

    /// All particles become the best one.
    fn unite(&mut self) {
        let Some(best) = self.best().cloned() else { return };
        let count = self.particles.len();
        (0..count).for_each(|_| self.tree.hold(best.node));
        let likeliest = Particle { log_weight: 0.0, ..best };
        for particle in std::mem::replace(&mut self.particles, vec![likeliest; count]) {
            self.tree.release(particle.node);
        }
        self.settle();
    }

    /// Forgets map and trajectories, as if nothing had been read: the next scan is the first, at
    /// `initial_pose` in `map`, or where odometry says.
    pub fn reset(&mut self, initial_pose: Option<Pose2>) {
        self.parameters.initial_pose = initial_pose;
        self.particles.clear();
        self.best = 0;
        self.tree = TrajectoryTree::default();
        self.output = OutputMap::new(self.parameters.resolution);
        self.odometry = Odometry::default();
        self.settled = Path::default();
        self.stamps.clear();
        self.scans_seen = 0;
        self.searched = None;
        if let Some(known) = self.beginning.known.take() {
            self.begin_on(known);
        }
    }

    /// Says where the base is in `map`: before the first scan, where the map begins; later, all
    /// particles are moved and turned together, so that the best one's pose is this one.
    ///
    /// Maps and trajectories stay where they are. A search for the pose ends.
    pub fn set_pose(&mut self, pose_in_map: Pose2) {
        self.searched = None;
        if self.particles.is_empty() {
            self.parameters.initial_pose = Some(pose_in_map);
            return;
        }
        let moved = pose_in_map * self.pose_in_map().inverse();
        for particle in &mut self.particles {
            particle.pose_in_map = moved * particle.pose_in_map;
        }
    }

    /// Forgets where the robot is: its place is searched for in the map, until a scan fits there.
    ///
    /// A place in the best particle's map is none in the others' maps, so all go on from that one.
    /// Before the first scan there is only a known map to search, or none.
    pub fn search_pose(&mut self) {
        self.parameters.initial_pose = None;
        self.unite();
        let grid = self.occupancy_grid().filter(|_| !self.particles.is_empty());
        let threshold = self.parameters.map.occupied_threshold;
        self.searched = grid.map(|grid| Arc::new(KnownMap::new(grid, threshold)));
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
        if !self.parameters.jump.is_usable(odom_from_base) {
            return OdometryUpdate::NotUsable;
        }
        let Some(before) = self.odometry.odom_from_base.replace(odom_from_base) else {
            return OdometryUpdate::Accepted;
        };
        let step = before.between(odom_from_base);
        if self.parameters.jump.rejects(step) {
            return OdometryUpdate::JumpRejected;
        }
        self.odometry.since_processed.extend(step);
        OdometryUpdate::Accepted
    }

    /// Takes a scan; `on_phase` is called as each phase of processing ends.
    pub fn add_scan(&mut self, reading: &ScanReading<'_>, on_phase: OnPhase<'_>) -> ScanUpdate {
        let scan = match self.admit(reading) {
            Ok(scan) => scan,
            Err(reason) => return ScanUpdate::Skipped(reason),
        };
        if let Err(reason) = self.locate(&scan) {
            return ScanUpdate::Skipped(reason);
        }
        self.beginning.obstacle = None;
        self.stamps.push_back(reading.scan.stamp);
        let odom_from_base = reading.odom_from_base;
        // On one of the pool's threads, so that only the others have to be woken.
        let report = match self.pool.clone() {
            Some(pool) => pool.install(|| self.process(&scan, odom_from_base, on_phase)),
            None => self.process(&scan, odom_from_base, on_phase),
        };
        ScanUpdate::Processed(report)
    }

    fn process(
        &mut self,
        scan: &PreparedScan,
        odom_from_base: Pose2,
        on_phase: OnPhase<'_>,
    ) -> ScanReport {
        let motion = std::mem::take(&mut self.odometry.since_processed);
        if self.particles.is_empty() {
            self.begin(scan, odom_from_base);
        } else {
            self.match_particles(scan, motion);
        }
        on_phase(Phase::Match);
        let report = self.resample(scan.hits.len());
        on_phase(Phase::Resample);
        self.register(scan, on_phase);
        if report.resampled || self.particles.len() == 1 {
            self.settle();
        }
        on_phase(Phase::Map);
        report
    }

    /// The scan made ready, if it is to be processed.
    fn admit(&mut self, reading: &ScanReading<'_>) -> Result<PreparedScan, SkipReason> {
        self.scans_seen += 1;
        if self.add_odometry(reading.odom_from_base) == OdometryUpdate::NotUsable {
            return Err(SkipReason::BadOdometry);
        }
        if !self.scans_seen.is_multiple_of(self.parameters.throttle_scans.max(1)) {
            return Err(SkipReason::Throttled);
        }
        let last = self.stamps.back().filter(|_| !self.is_searching());
        let elapsed = last.map(|last| reading.scan.stamp.seconds_since(*last));
        if !self.parameters.gate.opens(&self.odometry.since_processed, elapsed) {
            return Err(SkipReason::NotMovedEnough);
        }
        let scan = PreparedScan::new(reading, &self.parameters);
        if scan.hits.is_empty() { Err(SkipReason::NoUsableBeams) } else { Ok(scan) }
    }

    /// Searches for where the scan was taken: in the known map if it is the first and no pose is
    /// set, and in the map so far if the robot's place is searched for.
    fn locate(&mut self, scan: &PreparedScan) -> Result<(), SkipReason> {
        let anywhere = self.particles.is_empty() && self.parameters.initial_pose.is_none();
        let known = self.beginning.known.as_ref().filter(|_| anywhere);
        let Some(known) = self.searched.as_ref().or(known) else { return Ok(()) };
        match known.find(&scan.outline, self.pool.as_deref()) {
            Ok(place) => {
                // The way there says nothing any more.
                self.odometry.since_processed = Motion::default();
                self.set_pose(place.pose_in_map);
            }
            Err(obstacle) => {
                self.beginning.obstacle = Some(obstacle);
                return Err(SkipReason::NotLocalized);
            }
        }
        Ok(())
    }

    /// All particles start alike; without an initial pose, `map` is `odom` at the first scan. In a
    /// known map, the scan is matched first.
    fn begin(&mut self, scan: &PreparedScan, odom_from_base: Pose2) {
        let mut pose = self.parameters.initial_pose.unwrap_or(odom_from_base);
        let map = self.beginning.map.clone();
        if self.beginning.known.is_some() {
            let found = self.matcher.run(&map, scan, pose);
            if found.score > self.parameters.matcher.minimum_score {
                pose = found.pose_in_map;
            }
        }
        let count = self.parameters.particles.max(1);
        let root = self.tree.append(None, pose);
        self.particles = vec![Particle::new(pose, root, map); count];
        (1..count).for_each(|_| self.tree.hold(root));
    }

    fn match_particles(&mut self, scan: &PreparedScan, motion: Motion) {
        let step = Step {
            scan,
            motion,
            noise: self.parameters.motion_noise,
            weight_gain: self.parameters.weighting.gain(self.particles.len(), scan.hits.len()),
            minimum_score: self.parameters.matcher.minimum_score,
            number: self.processed(),
        };
        let (matcher, streams) = (&self.matcher, &self.streams);
        for_each(self.pool.as_deref(), &mut self.particles, |index, particle| {
            particle.advance(matcher, &step, streams, index);
        });
        for particle in &mut self.particles {
            let node = self.tree.append(Some(particle.node), particle.pose_in_map);
            self.tree.release(std::mem::replace(&mut particle.node, node));
        }
    }

    /// Draws the particles anew if too few of them carry the weight.
    fn resample(&mut self, hits: usize) -> ScanReport {
        self.choose_best();
        let weights = self.weights();
        let effective_sample_size = resampling::effective_sample_size(&weights);
        let threshold = self.parameters.weighting.resample_threshold * weights.len() as f64;
        let disputed = self.stamps.len() as u32;
        let report = ScanReport {
            hits,
            matched: self.particles.iter().filter(|particle| particle.matched).count(),
            best_score: self.best().map_or(0.0, |particle| particle.score),
            effective_sample_size,
            entropy: resampling::entropy(&weights),
            resampled: effective_sample_size < threshold || disputed > HISTORY + HISTORY / 4,
            registered: self.mode == Mode::Mapping,
            weak_direction: None,
        };
        if report.resampled {
            let weights =
                if disputed > HISTORY { self.weights_of_likeliest_past(&weights) } else { weights };
            let number = self.processed();
            let uniform = self.streams.uniform(Purpose::Resampling, number, 0);
            let ancestors = resampling::systematic(&weights, uniform);
            let before = std::mem::take(&mut self.particles);
            let survivor = ancestors.iter().position(|ancestor| *ancestor == self.best);
            for ancestor in ancestors {
                let particle = before[ancestor].clone();
                self.tree.hold(particle.node);
                self.particles.push(Particle { log_weight: 0.0, ..particle });
            }
            before.into_iter().for_each(|particle| self.tree.release(particle.node));
            self.best = survivor.unwrap_or_else(|| self.most_likely());
        }
        report
    }

    /// Enters the scan in each particle's map, and in the output map at the same time if there are
    /// threads; while the map is frozen, in none.
    fn register(&mut self, scan: &PreparedScan, on_phase: OnPhase<'_>) {
        let Some(best) = self.best().map(|particle| particle.node) else { return };
        if self.mode == Mode::Localization {
            self.output.follow(&mut self.tree, best);
            return on_phase(Phase::Register);
        }
        let outline = scan.outline.clone();
        let Self { matcher, particles, output, tree, pool, .. } = self;
        let mut register = || {
            for_each(pool.as_deref(), particles, |_, particle| matcher.register(particle, scan));
        };
        let extend = || output.extend(tree, best, outline);
        if let Some(pool) = &*pool {
            pool.join(register, extend);
            on_phase(Phase::Register);
        } else {
            register();
            on_phase(Phase::Register);
            extend();
        }
    }

    /// The weights of the particles that share the likeliest trajectory up to [`HISTORY`] scans
    /// ago; zero for all others.
    fn weights_of_likeliest_past(&self, weights: &[f64]) -> Vec<f64> {
        let depth = |particle: &Particle| self.tree.depth(particle.node).saturating_sub(HISTORY);
        let past = |particle: &Particle| self.tree.ancestor_at(particle.node, depth(particle));
        let pasts: Vec<NodeId> = self.particles.iter().map(past).collect();
        let mut likelihoods = BTreeMap::<NodeId, f64>::new();
        for (past, weight) in pasts.iter().zip(weights) {
            *likelihoods.entry(*past).or_default() += weight;
        }
        let likelier =
            |a: &(NodeId, f64), b: &(NodeId, f64)| a.1.total_cmp(&b.1).then(b.0.cmp(&a.0));
        let likeliest = likelihoods.into_iter().max_by(likelier);
        let Some((likeliest, likelihood)) = likeliest else { return weights.to_vec() };
        let share = |(past, weight): (&NodeId, &f64)| {
            if *past == likeliest { weight / likelihood } else { 0.0 }
        };
        pasts.iter().zip(weights).map(share).collect()
    }

    /// Takes the beginning that all trajectories share out of the tree.
    fn settle(&mut self) {
        let mut nodes = self.particles.iter().map(|particle| particle.node);
        let Some(first) = nodes.next() else { return };
        let Some(root) = nodes.try_fold(first, |a, b| self.tree.common_ancestor(a, b)) else {
            return;
        };
        let settled: Vec<Pose2> =
            self.tree.ancestry(root).skip(1).map(|node| self.tree.pose(node)).collect();
        for (pose, stamp) in settled.iter().rev().zip(self.stamps.drain(..settled.len())) {
            self.settled.push(stamp, *pose);
        }
        self.tree.cut_above(root);
        self.output.forget(self.tree.depth(root));
    }

    /// Index of the particle with the largest weight since the start; the first of equals.
    fn most_likely(&self) -> usize {
        let weight = |index: usize| self.particles[index].total_log_weight;
        let better = |best, other| if weight(other) > weight(best) { other } else { best };
        (0..self.particles.len()).reduce(better).unwrap_or(0)
    }

    fn choose_best(&mut self) {
        let candidate = self.most_likely();
        let weight = |index: usize| self.particles[index].total_log_weight;
        if weight(candidate) > weight(self.best) + CLEARLY_BETTER {
            self.best = candidate;
        }
    }

    /// The particle whose map and trajectory are handed out: the most likely one, except that
    /// another takes its place only when it is clearly better.
    #[must_use]
    pub fn best(&self) -> Option<&Particle> {
        self.particles.get(self.best)
    }

    /// The particles; none before the first scan.
    #[must_use]
    pub fn particles(&self) -> &[Particle] {
        &self.particles
    }

    /// The particles' weights, in their order; they sum to one.
    #[must_use]
    pub fn weights(&self) -> Vec<f64> {
        let log_weights: Vec<f64> = self.particles.iter().map(|p| p.log_weight).collect();
        resampling::normalize(&log_weights)
    }

    /// The best particle's pose of the base in `map` at its last processed scan, with odometry
    /// since; the initial pose before the first scan.
    #[must_use]
    pub fn pose_in_map(&self) -> Pose2 {
        let initial = self.parameters.initial_pose.unwrap_or_default();
        let processed = self.best().map_or(initial, |particle| particle.pose_in_map);
        processed * self.odometry.since_processed.increment
    }

    /// What takes odometry poses to the map: the best particle's correction at its last processed
    /// scan. The identity before the first scan, as in slam_gmapping.
    #[must_use]
    pub fn map_from_odom(&self) -> Pose2 {
        match (self.best(), self.odometry.odom_from_base) {
            (Some(_), Some(odom_from_base)) => self.pose_in_map() * odom_from_base.inverse(),
            _ => Pose2::IDENTITY,
        }
    }

    /// The weighted covariance of the particles' poses about the best one: m², m rad, rad².
    #[must_use]
    pub fn cloud_covariance(&self) -> Matrix3<f64> {
        let Some(best) = self.best() else { return Matrix3::zeros() };
        let mean = best.pose_in_map;
        let weighted = self.particles.iter().zip(self.weights());
        weighted.fold(Matrix3::zeros(), |sum, (particle, weight)| {
            let Pose2 { x, y, theta } = particle.pose_in_map;
            let error =
                nalgebra::Vector3::new(x - mean.x, y - mean.y, wrap_angle(theta - mean.theta));
            sum + weight * error * error.transpose()
        })
    }

    /// The pose of each processed scan as the best particle sees it now, oldest first.
    #[must_use]
    pub fn path(&self) -> Path {
        let Some(best) = self.best() else { return Path::default() };
        let poses: Vec<Pose2> =
            self.tree.ancestry(best.node).map(|node| self.tree.pose(node)).collect();
        let mut path = self.settled.clone();
        self.stamps.iter().zip(poses.iter().rev()).for_each(|(&at, &pose)| path.push(at, pose));
        path
    }

    /// Hits and visits of each cell, along the best particle's trajectory.
    #[must_use]
    pub const fn occupancy(&self) -> &OccupancyMap {
        self.output.map()
    }

    /// When a cell is occupied.
    #[must_use]
    pub const fn occupied_threshold(&self) -> OccupiedThreshold {
        self.parameters.map.occupied_threshold
    }

    /// How often the map became another one since the first scan, not only a larger one: with
    /// another best particle, the last scans lie elsewhere.
    #[must_use]
    pub const fn map_corrections(&self) -> u64 {
        self.output.corrections()
    }

    /// The map of the best particle, cropped to what is known; `None` before the first scan.
    #[must_use]
    pub fn occupancy_grid(&self) -> Option<OccupancyGrid> {
        self.output.map().to_grid(self.parameters.map.occupied_threshold)
    }

    /// The tiles of the particles' maps.
    #[must_use]
    pub fn particle_tiles(&self) -> TileCounts {
        match self.matcher {
            ScanMatcher::Field(_) => {
                TileCounts::of(self.particles.iter().map(|p| p.map.field.tiles()))
            }
            ScanMatcher::Compat(_) => TileCounts::of(self.particles.iter().map(|p| &p.map.hits)),
        }
    }

    /// How many scans have been processed.
    fn processed(&self) -> u64 {
        (self.settled.len() + self.stamps.len()) as u64
    }

    /// Nodes of the trajectory tree: at most a few hundred a particle, however long the run.
    #[must_use]
    pub fn trajectory_nodes(&self) -> usize {
        self.tree.len()
    }
}

/// Runs `work` on each particle with its number, in parallel if there is a pool.
fn for_each(
    pool: Option<&rayon::ThreadPool>,
    particles: &mut [Particle],
    work: impl Fn(usize, &mut Particle) + Sync,
) {
    let Some(pool) = pool else {
        particles.iter_mut().enumerate().for_each(|(index, particle)| work(index, particle));
        return;
    };
    pool.install(|| {
        let particles = particles.par_iter_mut().enumerate();
        particles.for_each(|(index, particle)| work(index, particle));
    });
}
