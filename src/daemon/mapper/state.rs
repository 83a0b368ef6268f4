//! All that the filter's thread knows, as plain data.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::{Gauges, Mapper, View};
use crate::clock;
use crate::config::InitialPose;
use crate::daemon::frames::FramesState;
use crate::daemon::ledger::Ledger;
use crate::daemon::snapshot::Estimate;
use crate::daemon::synchronizer::state::SynchronizerState;
use crate::slam::known_map::Mode;
use crate::slam::path::Path;
use crate::slam::pose::{Pose2, Stamp};
use crate::slam::state::{EngineState, StateError, ensure};

/// All that is known beside the engine.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MapperState {
    synchronizer: SynchronizerState,
    frames: FramesState,
    gauges: Gauges,
    ledger: Ledger,
    paused: bool,
    resamples: u64,
    estimate: Estimate,
    version: u64,
    first_epoch: u64,
    /// Of the last scan in the map.
    mapped: Option<Stamp>,
    processed: Option<Stamp>,
    odom_from_base: Option<Pose2>,
}

impl MapperState {
    /// Looks whether all parts fit together.
    fn check(&self) -> Result<(), StateError> {
        self.synchronizer.check()?;
        self.frames.check()?;
        let Estimate { pose_in_map, map_from_odom, .. } = &self.estimate;
        let poses = [Some(*pose_in_map), Some(*map_from_odom), self.odom_from_base];
        ensure(poses.into_iter().flatten().all(Pose2::is_finite), "poses")
    }

    /// The last scan that was taken.
    #[must_use]
    pub const fn taken(&self) -> Option<Stamp> {
        self.synchronizer.taken()
    }

    /// Scans that had their verdict.
    #[must_use]
    pub const fn scans(&self) -> u64 {
        self.ledger.total()
    }
}

impl Mapper {
    /// All that it knows beside the engine.
    #[must_use]
    pub fn state(&self) -> MapperState {
        let view = &self.view;
        MapperState {
            synchronizer: self.synchronizer.state(),
            frames: self.frames.state(),
            gauges: self.gauges.clone(),
            ledger: view.ledger.clone(),
            paused: view.paused,
            resamples: view.resamples,
            estimate: view.estimate.clone(),
            version: view.version,
            first_epoch: view.first_epoch,
            mapped: view.unpublished.or(view.map.as_ref().map(|map| map.stamp)),
            processed: view.processed,
            odom_from_base: view.odom_from_base,
        }
    }

    /// Goes on from a state, as if nothing had happened since; the map is a version of its own.
    ///
    /// # Errors
    /// When the state is not one that this mapper can have; nothing is changed.
    pub fn go_on_from(
        &mut self,
        state: MapperState,
        engine: EngineState,
    ) -> Result<(), StateError> {
        state.check()?;
        self.engine.resume(engine)?;
        self.synchronizer.resume(state.synchronizer, clock::now());
        self.frames.resume(state.frames);
        self.gauges = state.gauges;
        self.view = View {
            ledger: state.ledger,
            paused: state.paused,
            mode: self.engine.mode(),
            resamples: state.resamples,
            estimate: state.estimate,
            version: state.version,
            first_epoch: state.first_epoch,
            unpublished: state.mapped,
            processed: state.processed,
            odom_from_base: state.odom_from_base,
            ..View::new()
        };
        self.renew_map();
        if let Some(map) = self.view.map.as_mut().and_then(Arc::get_mut) {
            map.path = up_to(&map.path, map.stamp);
        }
        self.publish();
        Ok(())
    }

    /// Takes the robot to be where the configuration says, if it does, and not where the state has
    /// it; or searches for its place in the map. Odometry begins anew where it was carried to, and
    /// until then no pose is told.
    pub fn take_configured_pose(&mut self) {
        let Some(initial_pose) = self.initial_pose else { return };
        self.engine.forget_odometry();
        self.synchronizer.forget_odometry();
        self.view.odom_from_base = None;
        self.view.estimate.stamp = None;
        match initial_pose {
            InitialPose::At([x, y, yaw]) => {
                let (done, _) = self.set_pose(Pose2::new(x, y, yaw));
                tracing::info!("initial_pose is another than before: {done}");
            }
            InitialPose::Search(_) => {
                tracing::info!("the robot's place in the map is searched for");
                self.search_pose();
            }
        }
        self.publish();
    }

    /// Searches for the robot's place in the map; until it is found, no pose is told.
    pub fn search_pose(&mut self) {
        self.engine.search_pose();
        self.view.estimate.particles = Arc::new([]);
        self.renew_estimate(None);
        self.publish();
    }

    /// Maps or localizes as the configuration says, and not as the state did.
    pub fn take_configured_mode(&mut self) {
        self.engine.set_mode(self.first_mode);
        self.view.mode = self.engine.mode();
        self.view.changed = true;
        self.publish();
    }

    /// Whether it is to localize, and there is no map to do so in.
    pub fn localizes_in_nothing(&mut self) -> bool {
        self.engine.mode() == Mode::Localization && !self.knows_a_map()
    }
}

/// The path of a map whose last scan has this stamp: later scans have a pose and are in no map.
fn up_to(path: &Path, last: Stamp) -> Path {
    let later = path.iter().rev().take_while(|(stamp, _)| *stamp != last).count();
    if later == path.len() { path.clone() } else { path.iter().take(path.len() - later).collect() }
}
