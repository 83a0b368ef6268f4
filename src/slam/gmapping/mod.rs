//! GMapping: a Rao-Blackwellized particle filter over trajectories and maps
//! (Grisetti, Stachniss, Burgard, IEEE T-RO 23(1), 2007).

pub mod motion_model;
pub mod random;
pub mod resampling;
pub mod scan_matcher;
pub mod trajectory;

use std::collections::VecDeque;

use nalgebra::Matrix3;

use self::random::{Purpose, Streams};
use self::scan_matcher::{FieldMatcher, MatchPoints};
use self::trajectory::{NodeId, TrajectoryTree};
use super::grid::Cell;
use super::grid::likelihood_field::{Kernel, Points};
use super::grid::occupancy::{BeamEnd, BeamEndKind, OccupancyMap, ScanOutline};
use super::grid::tile_map::TileMap;
use super::motion_gate::MotionGate;
use super::odometry::{Motion, MotionNoise};
use super::pose::{self, Pose2, Stamp};
use super::scan::{Beam, LaserMount, Scan};

/// Everything the filter can be told, grouped by the part that uses it.
#[derive(Debug, Clone, PartialEq)]
pub struct Parameters {
    /// Number of hypotheses; slam_gmapping's default is 30.
    pub particles: usize,
    /// `throttle_scans`: every n-th scan is looked at.
    pub throttle_scans: usize,
    /// `delta`: metres a cell.
    pub resolution: f64,
    /// `maxRange`, m: readings strictly above are discarded; `None` takes the sensor's own limit.
    pub max_range: Option<f64>,
    /// `maxUrange`, m: readings above are not matched, and free space ends there.
    pub max_usable_range: Option<f64>,
    /// Where the base is in `map` at the first scan; `None` makes `map` and `odom` coincide there.
    pub initial_pose: Option<Pose2>,
    /// Odometry noise.
    pub motion_noise: MotionNoise,
    /// Which scans are processed.
    pub gate: MotionGate,
    /// The guard against odometry jumps.
    pub jump: JumpGuard,
    /// Scan matching.
    pub matcher: MatcherParameters,
    /// Weights and resampling.
    pub weighting: Weighting,
    /// The map that is handed out.
    pub map: MapParameters,
}

impl Default for Parameters {
    fn default() -> Self {
        Self {
            particles: 30,
            throttle_scans: 1,
            resolution: 0.05,
            max_range: None,
            max_usable_range: None,
            initial_pose: None,
            motion_noise: MotionNoise::default(),
            gate: MotionGate::default(),
            jump: JumpGuard::default(),
            matcher: MatcherParameters::default(),
            weighting: Weighting::default(),
            map: MapParameters::default(),
        }
    }
}

/// What happens when odometry moves further between two readings than a robot can.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct JumpGuard {
    /// Metres between two successive odometry readings that count as a jump.
    pub max_step: f64,
    /// What then happens.
    pub policy: JumpPolicy,
}

impl Default for JumpGuard {
    fn default() -> Self {
        Self { max_step: 20.0, policy: JumpPolicy::Reject }
    }
}

/// What to do with a reading that jumped.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum JumpPolicy {
    /// The jump is taken out: the robot is believed not to have moved meanwhile.
    Reject,
    /// The jump is believed, as the original did after printing a banner.
    Continue,
}

/// The scan matcher's settings.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MatcherParameters {
    /// Which matcher runs.
    pub kind: MatcherKind,
    /// `lstep`, m: first step of the hill climb.
    pub linear_step: f64,
    /// `astep`, rad: first step of the hill climb.
    pub angular_step: f64,
    /// `iterations`: how often the compat matcher halves its steps.
    pub iterations: u32,
    /// `sigma`: the compat matcher's score is exp(-d^2 / sigma).
    pub sigma: f64,
    /// `kernelSize`, cells: the compat matcher looks this far around an endpoint.
    pub kernel_size: u32,
    /// `lsigma`: the compat log likelihood of a beam is -d^2 / lsigma.
    pub likelihood_sigma: f64,
    /// `lskip`: this many beams are passed over between two that are matched.
    pub beam_skip: usize,
    /// `minimumScore`: a match counts only above this score.
    pub minimum_score: f64,
    /// Standard deviation of the likelihood field around each hit, m.
    pub field_sigma: f64,
    /// experiment
    pub known: u8,
    /// experiment
    pub climb_levels: u32,
    /// experiment
    pub polish_steps: u32,
    /// experiment
    pub damping: f64,
    /// experiment
    pub coarse_step: usize,
    /// experiment
    pub likelihood: u8,
    /// experiment
    pub cut: f64,
    /// experiment
    pub hit_fraction: f64,
    /// experiment
    pub like_sigma: f64,
    /// experiment
    pub gap: f64,
    /// experiment
    pub robust: bool,
    /// experiment
    pub tail: f64,
    /// experiment
    pub tail_sigma: f64,
    /// experiment
    pub sweep: u32,
    /// experiment
    pub sweep_step: f64,
    /// experiment
    pub sweep_bias: f64,
    /// experiment
    pub spacing: f64,
    /// experiment
    pub incidence: f64,
}

impl Default for MatcherParameters {
    fn default() -> Self {
        Self {
            kind: MatcherKind::Field,
            linear_step: 0.05,
            angular_step: 0.05,
            iterations: 5,
            sigma: 0.05,
            kernel_size: 1,
            likelihood_sigma: 0.075,
            beam_skip: 0,
            minimum_score: 0.0,
            field_sigma: 0.06,
            known: 240,
            climb_levels: 2,
            polish_steps: 5,
            damping: 0.0,
            coarse_step: 2,
            likelihood: 0,
            cut: 0.1,
            hit_fraction: 0.9,
            like_sigma: 0.1,
            gap: 0.5,
            robust: true,
            tail: 0.0,
            tail_sigma: 0.1,
            sweep: 0,
            sweep_step: 0.1,
            sweep_bias: 1.0,
            spacing: 1.0,
            incidence: 4.0,
        }
    }
}

/// Which scan matcher runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MatcherKind {
    /// A cached likelihood field, a coarse climb and a Gauss-Newton polish.
    Field,
    /// The original's objective and schedule: slow, and the reference for tests.
    Compat,
}

/// How weights are formed and when particles are drawn anew.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Weighting {
    /// `ogain`: the larger, the flatter the weights.
    pub gain: f64,
    /// Whether weights are flattened with the number of particles, as the original does.
    pub smoothing: WeightSmoothing,
    /// `resampleThreshold`: resample below this fraction of N effective particles.
    pub resample_threshold: f64,
    /// experiment
    pub proposal: f64,
    /// experiment
    pub prior: f64,
    /// experiment
    pub motion_scale: f64,
    /// experiment
    pub reference: f64,
    /// experiment
    pub per_beam: bool,
    /// experiment
    pub conditional: f64,
}

impl Weighting {
    fn log_weight_gain(&self, particles: usize) -> f64 {
        1.0 / (self.gain
            * match self.smoothing {
                WeightSmoothing::Fixed => self.reference,
                WeightSmoothing::PerParticle => particles as f64,
            })
    }
}

impl Default for Weighting {
    fn default() -> Self {
        Self {
            gain: 3.0,
            smoothing: WeightSmoothing::Fixed,
            resample_threshold: 0.5,
            proposal: 0.0,
            prior: 0.0,
            motion_scale: 1.0,
            reference: 30.0,
            per_beam: true,
            conditional: 1.0,
        }
    }
}

/// How log likelihoods become weights.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WeightSmoothing {
    /// The same for any number of particles.
    Fixed,
    /// Divided by `ogain * N`: the original's rule.
    PerParticle,
}

/// The occupancy map that is handed out.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MapParameters {
    /// `occ_thresh`: a cell is occupied when hits / visits is above this.
    pub occupied_threshold: f64,
    /// Whether a beam without return marks free space out to `maxUrange`.
    pub free_on_no_return: bool,
}

impl Default for MapParameters {
    fn default() -> Self {
        Self { occupied_threshold: 0.25, free_on_no_return: false }
    }
}

/// A scan with all that is needed to use it.
#[derive(Debug, Clone, Copy)]
pub struct ScanReading<'a> {
    /// The sweep.
    pub scan: &'a Scan,
    /// How the laser sits on the robot.
    pub mount: &'a LaserMount,
    /// Where odometry says the base was when the sweep was taken.
    pub odom_from_base: Pose2,
}

/// What became of a scan.
#[derive(Debug, Clone, PartialEq)]
pub enum ScanUpdate {
    /// It is in the map.
    Processed(ScanReport),
    /// It is not, for this reason.
    Skipped(SkipReason),
}

/// Figures about a processed scan.
#[derive(Debug, Clone, PartialEq)]
pub struct ScanReport {
    /// 1 / Σ wᵢ² before resampling, between 1 and the number of particles.
    pub effective_sample_size: f64,
    /// Whether particles were drawn anew.
    pub resampled: bool,
    /// Particles whose scan match was accepted.
    pub matched: usize,
}

/// Why a scan was not processed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum SkipReason {
    /// Not the n-th scan that `throttle_scans` asks for.
    Throttled,
    /// The motion gate is closed.
    NotMovedEnough,
    /// No beam is a hit within `maxUrange`.
    NoUsableBeams,
    /// The odometry pose is not finite.
    BadOdometry,
}

/// The parts of processing a scan, in order; reported when each ends.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Phase {
    /// Scan matching and weighting of all particles.
    Match,
    /// Normalisation, resampling and the trajectory tree.
    Resample,
    /// The scan enters each particle's map.
    Register,
    /// The scan enters the output map.
    Map,
}

/// The filter.
#[derive(Debug)]
pub struct GMapping {
    parameters: Parameters,
    streams: Streams,
    pool: Option<rayon::ThreadPool>,
    matcher: FieldMatcher,
    kernel: Kernel,
    particles: Vec<Particle>,
    tree: TrajectoryTree,
    output: OutputMap,
    odometry: Option<Pose2>,
    since_processed: Motion,
    last_processed: Option<Stamp>,
    stamps: Vec<Stamp>,
    scans_seen: usize,
}

impl GMapping {
    /// A filter with no scan yet. `threads` of 1 runs everything on the caller's thread.
    #[must_use]
    pub fn new(parameters: Parameters, seed: u64, threads: usize) -> Self {
        let matcher = FieldMatcher::new(parameters.matcher, parameters.resolution);
        let pool = (threads > 1).then(|| {
            rayon::ThreadPoolBuilder::new()
                .num_threads(threads)
                .thread_name(|i| format!("particles-{i}"))
                .build()
                .expect("threads can be started")
        });
        Self {
            streams: Streams::new(seed),
            pool,
            matcher,
            kernel: Kernel::new(
                parameters.matcher.field_sigma / parameters.resolution,
                parameters.matcher.known, parameters.matcher.tail, parameters.matcher.tail_sigma / parameters.resolution),
            particles: Vec::new(),
            tree: TrajectoryTree::default(),
            output: OutputMap::new(parameters.resolution),
            odometry: None,
            since_processed: Motion::default(),
            last_processed: None,
            stamps: Vec::new(),
            scans_seen: 0,
            parameters,
        }
    }

    /// Takes an odometry reading between scans; returns whether the jump guard rejected its step.
    pub fn add_odometry(&mut self, odom_from_base: Pose2) -> bool {
        let Some(before) = self.odometry.replace(odom_from_base) else { return false };
        let step = before.between(odom_from_base);
        let jumped = step.position().norm() > self.parameters.jump.max_step;
        if jumped && self.parameters.jump.policy == JumpPolicy::Reject {
            return true;
        }
        self.since_processed.extend(step);
        false
    }

    /// Takes a scan; `on_phase` is called as each phase of processing ends.
    pub fn add_scan(
        &mut self,
        reading: &ScanReading<'_>,
        on_phase: &mut dyn FnMut(Phase),
    ) -> ScanUpdate {
        self.scans_seen += 1;
        self.add_odometry(reading.odom_from_base);
        if !self.scans_seen.is_multiple_of(self.parameters.throttle_scans) {
            return ScanUpdate::Skipped(SkipReason::Throttled);
        }
        let stamp = reading.scan.stamp;
        let elapsed = self.last_processed.map(|last| stamp.seconds_since(last));
        if !self.parameters.gate.opens(&self.since_processed, elapsed) {
            return ScanUpdate::Skipped(SkipReason::NotMovedEnough);
        }
        let scan = PreparedScan::new(reading, &self.parameters);
        if scan.points.all.is_empty() {
            return ScanUpdate::Skipped(SkipReason::NoUsableBeams);
        }
        let motion = std::mem::take(&mut self.since_processed);
        self.last_processed = Some(stamp);
        self.stamps.push(stamp);
        let report = if self.particles.is_empty() {
            self.begin(reading.odom_from_base)
        } else {
            self.match_particles(&scan, &motion);
            on_phase(Phase::Match);
            self.resample()
        };
        on_phase(Phase::Resample);
        self.register(&scan);
        on_phase(Phase::Register);
        let best = self.best().node;
        self.output.add_scan(scan.outline);
        self.output.follow(&mut self.tree, best);
        if report.resampled {
            let leaves = self.particles.iter().map(|p| p.node);
            self.output.forget_scans_before(&self.tree, leaves);
        }
        on_phase(Phase::Map);
        ScanUpdate::Processed(report)
    }

    fn begin(&mut self, odom_from_base: Pose2) -> ScanReport {
        let pose = self.parameters.initial_pose.unwrap_or(odom_from_base);
        let root = self.tree.append(None, pose);
        (1..self.parameters.particles).for_each(|_| self.tree.hold(root));
        self.particles = (0..self.parameters.particles)
            .map(|_| Particle {
                pose_in_map: pose,
                log_weight: 0.0,
                total_log_weight: 0.0,
                node: root,
                field: TileMap::new(),
                covariance: Matrix3::zeros(),
                matched: true,
            })
            .collect();
        ScanReport {
            effective_sample_size: self.parameters.particles as f64,
            resampled: false,
            matched: self.parameters.particles,
        }
    }

    fn match_particles(&mut self, scan: &PreparedScan, motion: &Motion) {
        let step = self.stamps.len() as u64;
        let (matcher, streams) = (&self.matcher, &self.streams);
        let noise = &self.parameters.motion_noise;
        let weighting = self.parameters.weighting;
        let [sx, sy, st] = noise.standard_deviations(motion);
        for_each(self.pool.as_ref(), &mut self.particles, |i, particle| {
            let ms = weighting.motion_scale;
            let predicted = particle.pose_in_map * motion.increment;
            let heading = particle.pose_in_map.theta;
            let (sin, cos) = libm::sincos(heading);
            let r = nalgebra::Matrix3::new(cos, -sin, 0.0, sin, cos, 0.0, 0.0, 0.0, 1.0);
            let d = nalgebra::Vector3::new(
                1.0 / (sx * sx + 1e-8),
                1.0 / (sy * sy + 1e-8),
                1.0 / (st * st + 1e-8),
            );
            let prior = if weighting.prior > 0.0 {
                r * Matrix3::from_diagonal(&d) * r.transpose() * weighting.prior
            } else {
                Matrix3::zeros()
            };
            let start = if ms > 0.0 {
                let mut gaussian = streams.gaussian(Purpose::Motion, step, i);
                let scaled = Motion {
                    forward: motion.forward * ms * ms,
                    sideways: motion.sideways * ms * ms,
                    turned: motion.turned * ms * ms,
                    ..*motion
                };
                particle.pose_in_map * motion_model::sample(&scaled, noise, &mut gaussian)
            } else {
                predicted
            };
            let found = matcher.run(&particle.field, &scan.points, start, &prior);
            let mut pose = found.pose_in_map;
            if weighting.proposal > 0.0 {
                let mut g = streams.gaussian(Purpose::Proposal, step, i);
                let c = found.covariance;
                if c[(2, 2)] > 0.0 {
                    let turn = g.draw() * weighting.proposal * c[(2, 2)].sqrt();
                    let k = weighting.conditional * turn / c[(2, 2)];
                    pose = Pose2::new(pose.x + k * c[(0, 2)], pose.y + k * c[(1, 2)], pose::wrap_angle(pose.theta + turn));
                }
            }
            particle.pose_in_map = pose;
            particle.covariance = found.covariance;
            particle.matched = found.accepted;
            let beams = if weighting.per_beam { 180.0 / scan.points.all.len() as f64 } else { 1.0 };
            particle.log_weight += found.log_likelihood * beams;
            particle.total_log_weight += found.log_likelihood * beams;
        });
    }

    fn resample(&mut self) -> ScanReport {
        let n = self.particles.len();
        let log_weights: Vec<f64> = self.particles.iter().map(|p| p.log_weight).collect();
        let weights =
            resampling::normalize(&log_weights, self.parameters.weighting.log_weight_gain(n));
        let effective_sample_size = resampling::effective_sample_size(&weights);
        let resampled =
            effective_sample_size < self.parameters.weighting.resample_threshold * n as f64;
        let before: Vec<NodeId> = self.particles.iter().map(|p| p.node).collect();
        if resampled {
            let uniform = self.streams.uniform(Purpose::Resampling, self.stamps.len() as u64, 0);
            let ancestors = resampling::systematic(&weights, uniform);
            self.particles = ancestors
                .into_iter()
                .map(|ancestor| Particle { log_weight: 0.0, ..self.particles[ancestor].clone() })
                .collect();
        }
        for particle in &mut self.particles {
            particle.node = self.tree.append(Some(particle.node), particle.pose_in_map);
        }
        before.into_iter().for_each(|node| self.tree.release(node));
        let matched = self.particles.iter().filter(|p| p.matched).count();
        ScanReport { effective_sample_size, resampled, matched }
    }

    fn register(&mut self, scan: &PreparedScan) {
        let (kernel, resolution) = (&self.kernel, self.parameters.resolution);
        for_each(self.pool.as_ref(), &mut self.particles, |_, particle| {
            let pose = particle.pose_in_map;
            let origin = Cell::containing(pose.position(), resolution);
            let x = pose.x / resolution - f64::from(origin.ix);
            let y = pose.y / resolution - f64::from(origin.iy);
            let (sin, cos) = libm::sincos(pose.theta);
            for (px, py) in scan.surface.iter() {
                let (px, py) = (f64::from(px), f64::from(py));
                kernel.stamp(
                    &mut particle.field,
                    origin,
                    x + cos * px - sin * py,
                    y + sin * px + cos * py,
                );
            }
        });
    }

    fn best(&self) -> &Particle {
        let mut particles = self.particles.iter();
        let first = particles.next().expect("there is at least one particle");
        particles.fold(
            first,
            |best, p| if p.total_log_weight > best.total_log_weight { p } else { best },
        )
    }

    /// experiment
    pub fn conflict(&self) -> (f64, usize) {
        let (mut a, mut b, mut occ) = (0.0, 0.0, 0);
        for (_, t) in self.output.map.counts().tiles() { for c in t { a += f64::from(c.hits.min(c.visits - c.hits)); b += f64::from(c.hits); occ += usize::from(c.hits as f64 > 0.25 * c.visits as f64); } }
        (a / b, occ)
    }

    /// Particles.
    pub fn particles(&self) -> &[Particle] {
        &self.particles
    }

    /// Tiles of the particles' fields.
    pub fn tile_counts(&self) -> super::grid::tile_map::TileCounts {
        super::grid::tile_map::TileCounts::of(self.particles.iter().map(|p| &p.field))
    }

    /// The best particle's pose of the base in `map` at its last processed scan, with odometry since.
    #[must_use]
    pub fn pose_in_map(&self) -> Pose2 {
        self.best().pose_in_map * self.since_processed.increment
    }

    /// The pose of each processed scan as the best particle sees it now, oldest first.
    #[must_use]
    pub fn path(&self) -> Vec<(Stamp, Pose2)> {
        if self.particles.is_empty() {
            return Vec::new();
        }
        let mut poses: Vec<Pose2> =
            self.tree.ancestry(self.best().node).map(|n| self.tree.pose(n)).collect();
        poses.reverse();
        self.stamps.iter().copied().zip(poses).collect()
    }

    /// The map of the best particle, cropped to what is known; `None` before the first scan.
    #[must_use]
    pub fn occupancy_grid(&self) -> Option<OccupancyGrid> {
        self.output.map.to_grid(self.parameters.map.occupied_threshold)
    }
}

/// Runs `work` on each particle with its number, in parallel if there is a pool.
fn for_each(
    pool: Option<&rayon::ThreadPool>,
    particles: &mut [Particle],
    work: impl Fn(usize, &mut Particle) + Sync,
) {
    use rayon::prelude::*;
    match pool {
        Some(pool) => pool.install(|| {
            particles.par_iter_mut().with_min_len(4).enumerate().for_each(|(i, p)| work(i, p));
        }),
        None => particles.iter_mut().enumerate().for_each(|(i, p)| work(i, p)),
    }
}

/// One hypothesis.
#[derive(Debug, Clone)]
pub struct Particle {
    /// The base at the last processed scan.
    pub pose_in_map: Pose2,
    /// Since the last resampling.
    log_weight: f64,
    total_log_weight: f64,
    node: NodeId,
    field: TileMap<u8>,
    /// Of the last match.
    pub covariance: Matrix3<f64>,
    matched: bool,
}

/// A scan made ready.
#[derive(Debug)]
struct PreparedScan {
    points: MatchPoints,
    surface: Points,
    outline: ScanOutline,
}

impl PreparedScan {
    fn new(reading: &ScanReading<'_>, parameters: &Parameters) -> Self {
        let geometry = &reading.scan.geometry;
        let limit = 16_000.0 * parameters.resolution;
        let max_range = parameters.max_range.unwrap_or(f64::INFINITY);
        let usable =
            parameters.max_usable_range.unwrap_or(geometry.range_max()).min(max_range).min(limit);
        let mut hits = Vec::new();
        let mut ends = Vec::new();
        for (i, range) in reading.scan.ranges.iter().enumerate() {
            let angle = geometry.angle(i);
            let (range, kind) = match geometry.classify(*range) {
                Beam::Hit(range) if range <= usable => (range, BeamEndKind::Hit),
                Beam::Hit(range) if range <= max_range => (usable, BeamEndKind::Free),
                Beam::NoReturn if parameters.map.free_on_no_return => (usable, BeamEndKind::Free),
                _ => (0.0, BeamEndKind::Nothing),
            };
            let point = reading.mount.point_in_base(angle, range);
            if kind == BeamEndKind::Hit {
                hits.push((
                    (point.x / parameters.resolution) as f32,
                    (point.y / parameters.resolution) as f32,
                ));
            }
            ends.push(BeamEnd { point: [point.x as f32, point.y as f32], kind });
        }
        let all: Points = hits.into_iter().step_by(parameters.matcher.beam_skip + 1).collect();
        let coarse = all.every(parameters.matcher.coarse_step);
        let mut surface: Vec<(f32, f32)> = Vec::new();
        let gap = parameters.matcher.gap / parameters.resolution;
        let mut before: Option<(f64, f64)> = None;
        let inc = geometry.angle_increment().abs();
        for e in &ends {
            let now = (e.kind == BeamEndKind::Hit).then(|| {
                (
                    f64::from(e.point[0]) / parameters.resolution,
                    f64::from(e.point[1]) / parameters.resolution,
                )
            });
            if let (Some(a), Some(b)) = (before, now) {
                let d = ((a.0 - b.0).powi(2) + (a.1 - b.1).powi(2)).sqrt();
                let r = (a.0 * a.0 + a.1 * a.1).sqrt().min((b.0 * b.0 + b.1 * b.1).sqrt());
                if d > parameters.matcher.spacing
                    && d < gap
                    && d < parameters.matcher.incidence * r * inc
                {
                    let k = (d / parameters.matcher.spacing).ceil();
                    for i in 1..k as usize {
                        let f = i as f64 / k;
                        surface
                            .push(((a.0 + f * (b.0 - a.0)) as f32, (a.1 + f * (b.1 - a.1)) as f32));
                    }
                }
            }
            if let Some(b) = now {
                surface.push((b.0 as f32, b.1 as f32));
            }
            before = now;
        }
        let surface: Points = surface.into_iter().collect();
        let radius = all.iter().map(|(x, y)| x.hypot(y)).fold(0.0, f32::max) as i32 + 1;
        let sensor = reading.mount.base_from_laser.position();
        Self {
            points: MatchPoints { all, coarse, radius },
            surface,
            outline: ScanOutline {
                sensor,
                ends,
                angle_increment: geometry.angle_increment().abs(),
            },
        }
    }
}

/// The occupancy map of one trajectory, moved from trajectory to trajectory by what differs.
#[derive(Debug)]
struct OutputMap {
    map: OccupancyMap,
    node: Option<NodeId>,
    /// Scans that living particles may place differently; the first has number `first_scan`.
    scans: VecDeque<ScanOutline>,
    first_scan: u32,
}

impl OutputMap {
    fn new(resolution: f64) -> Self {
        Self {
            map: OccupancyMap::new(resolution),
            node: None,
            scans: VecDeque::new(),
            first_scan: 0,
        }
    }

    fn add_scan(&mut self, scan: ScanOutline) {
        self.scans.push_back(scan);
    }

    fn follow(&mut self, tree: &mut TrajectoryTree, node: NodeId) {
        let shared = self.node.and_then(|old| tree.common_ancestor(old, node));
        if let Some(old) = self.node {
            for id in tree.ancestry(old).take_while(|id| Some(*id) != shared) {
                let scan = &self.scans[(tree.depth(id) - self.first_scan) as usize];
                self.map.remove(scan, tree.pose(id));
            }
        }
        for id in tree.ancestry(node).take_while(|id| Some(*id) != shared) {
            let scan = &self.scans[(tree.depth(id) - self.first_scan) as usize];
            self.map.add(scan, tree.pose(id));
        }
        tree.hold(node);
        if let Some(old) = self.node.replace(node) {
            tree.release(old);
        }
    }

    fn forget_scans_before(&mut self, tree: &TrajectoryTree, leaves: impl Iterator<Item = NodeId>) {
        let mut shared = self.node;
        for leaf in leaves {
            shared = shared.and_then(|shared| tree.common_ancestor(shared, leaf));
        }
        if let Some(shared) = shared {
            while self.first_scan <= tree.depth(shared) {
                self.scans.pop_front();
                self.first_scan += 1;
            }
        }
    }
}

/// A map as `nav_msgs/OccupancyGrid` means it.
#[derive(Debug, Clone, PartialEq)]
pub struct OccupancyGrid {
    /// Metres a cell.
    pub resolution: f64,
    /// Cells a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// The lower-left corner of cell (0, 0) in `map`, m.
    pub origin: super::pose::Point2,
    /// Row by row from the lowest y: -1 unknown, 0 free, 100 occupied.
    pub cells: Vec<i8>,
}
