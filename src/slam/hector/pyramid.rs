//! Maps of the same world in cells of growing size, each updated with every scan that enters.

use super::super::grid::Cell;
use super::super::grid::footprint::{Footprint, halved};
use super::super::grid::log_odds::{Evidence, LogOdds, LogOddsMap, Probabilities};
use super::super::grid::tile_map::{TileCounts, TileKey, TileMap};
use super::super::pose::Pose2;
use super::Parameters;
use super::gauss_newton::{Level, MARGIN};
use super::prepared_scan::PreparedScan;

/// A coarse map only leads to where the finest decides: so many points are enough.
const COARSE_POINTS: usize = 180;

/// The maps, finest first.
#[derive(Debug, Clone)]
pub struct Pyramid {
    maps: Vec<LogOddsMap>,
    probabilities: Probabilities,
    evidence: Evidence,
    footprint: Footprint,
}

impl Pyramid {
    /// An unknown world.
    #[must_use]
    pub fn new(parameters: &Parameters) -> Self {
        let levels = 0..parameters.levels.max(1);
        let cell = |level: usize| parameters.resolution * (1_u64 << level) as f64;
        Self {
            maps: levels.map(|level| LogOddsMap::new(cell(level))).collect(),
            probabilities: Probabilities::default(),
            evidence: Evidence {
                free: LogOdds::of_probability(parameters.free_probability),
                occupied: LogOdds::of_probability(parameters.occupied_probability),
            },
            footprint: Footprint::default(),
        }
    }

    /// The finest map.
    #[must_use]
    pub fn finest(&self) -> &LogOddsMap {
        &self.maps[0]
    }

    /// The cells of all maps, finest first.
    pub(super) fn cells(&self) -> impl Iterator<Item = &TileMap<LogOdds>> {
        self.maps.iter().map(LogOddsMap::cells)
    }

    /// Takes the cells of all maps, finest first.
    pub(super) fn set_cells(&mut self, cells: Vec<TileMap<LogOdds>>) {
        for (map, cells) in self.maps.iter_mut().zip(cells) {
            *map = LogOddsMap::of_cells(map.resolution(), cells);
        }
    }

    /// Enters a scan taken with the base at `pose_in_map` in each map; `touched` is called with
    /// the tiles of the finest that change.
    pub fn add(
        &mut self,
        scan: &PreparedScan,
        pose_in_map: Pose2,
        mut touched: impl FnMut(TileKey),
    ) {
        let (finest, coarse) = self.maps.split_first_mut().expect("there is a finest map");
        let mut seen = self.footprint.of(&scan.outline, pose_in_map, finest.resolution());
        finest.add(seen, self.evidence);
        seen.iter().for_each(|(tile, _)| touched(*tile));
        let mut halves;
        for map in coarse {
            halves = halved(seen);
            map.add(&halves, self.evidence);
            seen = &halves;
        }
    }

    /// Enters cells of the finest map that are known, with whether an obstacle is there; `touched`
    /// is called with their tiles. In coarser maps an obstacle counts more than free space.
    pub fn enter(
        &mut self,
        cells: impl Iterator<Item = (Cell, bool)>,
        mut touched: impl FnMut(TileKey),
    ) {
        for (cell, occupied) in cells {
            touched(TileKey::containing(cell));
            for (level, map) in self.maps.iter_mut().enumerate() {
                let cell = Cell::new(cell.ix >> level, cell.iy >> level);
                if occupied {
                    map.know_occupied(cell);
                } else {
                    map.know_free(cell);
                }
            }
        }
    }

    /// The maps as a scan is matched with them near a pose, coarsest first.
    pub fn levels<'a>(
        &'a self,
        scan: &'a PreparedScan,
        near: Pose2,
    ) -> impl Iterator<Item = Level<'a>> {
        let coarsest = self.maps.last().map_or(0.0, LogOddsMap::resolution);
        let reach = scan.radius() + MARGIN * coarsest;
        self.maps.iter().enumerate().rev().map(move |(level, map)| {
            let mut points = scan.points(map.resolution());
            if level > 0 {
                points = thinned(points);
            }
            Level::new(map, &self.probabilities, points, (near, reach))
        })
    }

    /// The share of a scan's points, taken at a pose, that lie where the coarsest map knows nothing.
    #[must_use]
    pub fn unknown_share(&self, scan: &PreparedScan, pose_in_map: Pose2) -> f64 {
        let coarsest = self.levels(scan, pose_in_map).next();
        coarsest.map_or(1.0, |level| level.unknown_share(pose_in_map))
    }

    /// The tiles of all maps.
    #[must_use]
    pub fn tiles(&self) -> TileCounts {
        TileCounts::of(self.maps.iter().map(LogOddsMap::cells))
    }
}

fn thinned(points: Vec<[f32; 2]>) -> Vec<[f32; 2]> {
    let every = points.len().div_ceil(COARSE_POINTS).max(1);
    if every == 1 { points } else { points.into_iter().step_by(every).collect() }
}
