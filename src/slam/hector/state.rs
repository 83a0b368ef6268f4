//! The engine's state as plain data.

use serde::{Deserialize, Serialize};

use super::super::grid::log_odds::LogOdds;
use super::super::grid::tile_map::saved::SavedMaps;
use super::super::known_map::Mode;
use super::super::path::Path;
use super::super::pose::Pose2;
use super::super::state::{StateError, ensure_figures, ensure_poses};
use super::{Hector, Odometry, Output, State};

/// All that the engine knows; the map that is handed out follows from the finest.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct HectorState {
    initial_pose: Option<Pose2>,
    maps: Vec<SavedMaps<LogOdds>>,
    state: Option<State>,
    odometry: Odometry,
    path: Path,
    scans_seen: usize,
    mode: Mode,
}

impl Hector {
    /// All that it knows now.
    #[must_use]
    pub fn state(&self) -> HectorState {
        HectorState {
            initial_pose: self.parameters.initial_pose,
            maps: self.pyramid.cells().map(|cells| SavedMaps::of([cells])).collect(),
            state: self.state,
            odometry: self.odometry.clone(),
            path: self.path.clone(),
            scans_seen: self.scans_seen,
            mode: self.mode,
        }
    }

    /// Goes on from a state of an engine with the same parameters.
    ///
    /// # Errors
    /// When the state is not one that an engine with these parameters can have; nothing is changed.
    pub fn resume(&mut self, state: HectorState) -> Result<(), StateError> {
        let (found, expected) = (state.maps.len(), self.pyramid.cells().count());
        if found != expected {
            return Err(StateError::Number { what: "maps", found, expected });
        }
        ensure_poses(state.poses(), "the pose or the odometry")?;
        let figures =
            state.state.iter().flat_map(|s| s.covariance.iter().copied().chain([s.usual_score]));
        ensure_figures(figures, "the covariance")?;
        let cells = state.maps.iter().map(SavedMaps::restore_one).collect::<Result<_, _>>()?;
        self.pyramid.set_cells(cells);
        let stale = self.pyramid.finest().cells().tiles().map(|(key, _)| key).collect();
        self.output = Output { stale, ..Output::new(self.parameters.resolution) };
        self.parameters.initial_pose = state.initial_pose;
        self.state = state.state;
        self.odometry = state.odometry;
        self.path = state.path;
        self.scans_seen = state.scans_seen;
        self.mode = state.mode;
        self.searched = None;
        Ok(())
    }
}

impl HectorState {
    /// Every pose in it, to look whether they are numbers.
    fn poses(&self) -> impl Iterator<Item = Pose2> {
        let last = self
            .state
            .iter()
            .flat_map(|state| [Some(state.pose_in_map), Some(state.registered_at), state.velocity]);
        let Odometry { odom_from_base, since_processed, map_from_odom } = &self.odometry;
        let odometry = [*odom_from_base, *map_from_odom, self.initial_pose];
        last.chain(odometry).flatten().chain(since_processed.poses())
    }
}
