//! The filter's state as plain data.

use std::collections::VecDeque;
use std::sync::Arc;

use nalgebra::Matrix3;
use serde::{Deserialize, Serialize};

use super::super::grid::hit_map::Hits;
use super::super::grid::likelihood_field::LikelihoodField;
use super::super::grid::occupancy::{Count, OccupancyMap, ScanOutline};
use super::super::grid::tile_map::TileMap;
use super::super::grid::tile_map::saved::SavedMaps;
use super::super::known_map::Mode;
use super::super::path::Path;
use super::super::pose::{Pose2, Stamp};
use super::super::state::{StateError, ensure, ensure_figures, ensure_poses};
use super::output_map::OutputMap;
use super::particle::{Particle, ParticleMap};
use super::trajectory::{NodeId, TrajectoryTree};
use super::{GMapping, Odometry};

const TRAJECTORIES: &str = "trajectories";

/// All that the filter knows. Random numbers have no state: scans and particles number them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct GMappingState {
    initial_pose: Option<Pose2>,
    particles: Vec<ParticleState>,
    fields: SavedMaps<u8>,
    hits: SavedMaps<Hits>,
    best: usize,
    tree: TrajectoryTree,
    output: OutputState,
    odometry: Odometry,
    settled: Path,
    stamps: VecDeque<Stamp>,
    scans_seen: usize,
    mode: Mode,
}

/// A particle without its map.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct ParticleState {
    pose_in_map: Pose2,
    covariance: Matrix3<f64>,
    log_weight: f64,
    total_log_weight: f64,
    node: NodeId,
    score: f64,
    matched: bool,
}

/// The map that is handed out, and the scans that may move in it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct OutputState {
    counts: SavedMaps<Count>,
    node: Option<NodeId>,
    scans: Vec<ScanOutline>,
    first_depth: u32,
    corrections: u64,
}

impl GMapping {
    /// All that it knows now.
    #[must_use]
    pub fn state(&self) -> GMappingState {
        GMappingState {
            initial_pose: self.parameters.initial_pose,
            particles: self.particles.iter().map(ParticleState::of).collect(),
            fields: SavedMaps::of(self.particles.iter().map(|p| p.map.field.tiles())),
            hits: SavedMaps::of(self.particles.iter().map(|p| &p.map.hits)),
            best: self.best,
            tree: self.tree.clone(),
            output: OutputState::of(&self.output),
            odometry: self.odometry.clone(),
            settled: self.settled.clone(),
            stamps: self.stamps.clone(),
            scans_seen: self.scans_seen,
            mode: self.mode,
        }
    }

    /// Goes on from a state of a filter with the same parameters.
    ///
    /// # Errors
    /// When the state is not one that a filter with these parameters can have; nothing is changed.
    pub fn resume(&mut self, state: GMappingState) -> Result<(), StateError> {
        state.check(self.parameters.particles.max(1))?;
        let (fields, hits) = (state.fields.restore()?, state.hits.restore()?);
        ensure(fields.len() == state.particles.len() && hits.len() == fields.len(), "maps")?;
        let maps = fields.into_iter().zip(hits);
        let output = state.output.restore(self.parameters.resolution)?;
        let particles = state.particles.iter().zip(maps).map(|(saved, map)| saved.with_map(map));
        self.particles = particles.collect();
        self.parameters.initial_pose = state.initial_pose;
        self.best = state.best;
        self.tree = state.tree;
        self.output = output;
        self.odometry = state.odometry;
        self.settled = state.settled;
        self.stamps = state.stamps;
        self.scans_seen = state.scans_seen;
        self.mode = state.mode;
        self.searched = None;
        Ok(())
    }
}

impl GMappingState {
    /// Whether all parts fit together, so that nothing that is done with them can fail.
    fn check(&self, expected: usize) -> Result<(), StateError> {
        let found = self.particles.len();
        if found != 0 && found != expected {
            return Err(StateError::Number { what: "particles", found, expected });
        }
        ensure(self.best < found.max(1), "particles")?;
        ensure_poses(self.particles.iter().map(|p| p.pose_in_map), "the pose of a particle")?;
        ensure_poses(self.initial_pose.into_iter(), "the initial pose")?;
        ensure_poses(self.odometry.poses(), "odometry")?;
        let weights = self.particles.iter().flat_map(|p| [p.log_weight, p.total_log_weight]);
        let figures = self.particles.iter().flat_map(|p| p.covariance.iter().copied());
        ensure_figures(weights.chain(figures), "the weight of a particle")?;
        self.output.check()?;
        self.check_trajectories()
    }

    /// All trajectories begin at one root, are as long as there are stamps, and every scan that may
    /// move is there.
    fn check_trajectories(&self) -> Result<(), StateError> {
        let leaves: Vec<NodeId> = self.particles.iter().map(|p| p.node).collect();
        let holders: Vec<NodeId> = leaves.iter().copied().chain(self.output.node).collect();
        let Some((root, deepest)) = self.tree.check(&holders)? else {
            let none = leaves.is_empty() && self.output.node.is_none();
            return ensure(none && self.output.scans.is_empty(), TRAJECTORIES);
        };
        let OutputState { node, ref scans, first_depth, .. } = self.output;
        ensure(!leaves.is_empty() && node.is_some(), TRAJECTORIES)?;
        ensure(holders.iter().all(|node| self.tree.depth(*node) == deepest), TRAJECTORIES)?;
        let length = (deepest - root) as usize + 1;
        let kept = u64::from(first_depth) + scans.len() as u64 == u64::from(deepest) + 1;
        let from_root = first_depth == root || first_depth == root + 1;
        ensure(self.stamps.len() == length && kept && from_root, TRAJECTORIES)
    }
}

impl ParticleState {
    fn of(particle: &Particle) -> Self {
        let &Particle { pose_in_map, covariance, log_weight, total_log_weight, node, .. } =
            particle;
        let (score, matched) = (particle.score, particle.matched);
        Self { pose_in_map, covariance, log_weight, total_log_weight, node, score, matched }
    }

    fn with_map(&self, (field, hits): (TileMap<u8>, TileMap<Hits>)) -> Particle {
        Particle {
            pose_in_map: self.pose_in_map,
            covariance: self.covariance,
            map: ParticleMap { field: LikelihoodField::of_tiles(field), hits },
            log_weight: self.log_weight,
            total_log_weight: self.total_log_weight,
            node: self.node,
            score: self.score,
            matched: self.matched,
        }
    }
}

impl OutputState {
    fn of(output: &OutputMap) -> Self {
        Self {
            counts: SavedMaps::of([output.map.counts()]),
            node: output.node,
            scans: output.scans.iter().map(|scan| ScanOutline::clone(scan)).collect(),
            first_depth: output.first_depth,
            corrections: output.corrections,
        }
    }

    fn check(&self) -> Result<(), StateError> {
        let ends = |scan: &ScanOutline| scan.ends.iter().all(|end| end.point.iter().all(is_near));
        let near = |scan: &ScanOutline| {
            let sensor = [scan.sensor.x as f32, scan.sensor.y as f32];
            sensor.iter().all(is_near) && scan.angle_increment.is_finite() && ends(scan)
        };
        if self.scans.iter().all(near) { Ok(()) } else { Err(StateError::OutOfRange("a scan")) }
    }

    fn restore(self, resolution: f64) -> Result<OutputMap, StateError> {
        Ok(OutputMap {
            map: OccupancyMap::of_counts(resolution, self.counts.restore_one()?),
            node: self.node,
            scans: self.scans.into_iter().map(Arc::new).collect(),
            first_depth: self.first_depth,
            corrections: self.corrections,
        })
    }
}

/// Whether a beam may end so many metres away; entering a longer one would take for ever.
fn is_near(metres: &f32) -> bool {
    metres.abs() < 1e6
}
