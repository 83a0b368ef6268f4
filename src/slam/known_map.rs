//! A map that mapping starts from, and whether maps grow at all.

use serde::{Deserialize, Serialize};

use super::grid::Cell;
use super::grid::occupancy::{BeamEndKind, ScanOutline};
use super::grid::occupancy::{OccupancyGrid, OccupancyMap, OccupiedThreshold};
use super::search::{NotLocalized, Place, SearchMap};

/// How many scans a known cell counts as, at least: a wild range changes nothing.
const VISITS: u32 = 10;

/// Whether scans enter the map.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Mode {
    /// They do.
    #[default]
    Mapping,
    /// The map stays as it is, and poses in it are estimated.
    Localization,
}

/// A map that mapping starts from.
#[derive(Debug)]
pub struct KnownMap {
    grid: OccupancyGrid,
    threshold: OccupiedThreshold,
    /// The cell of the map that has the grid's first cell, most of it.
    first: Cell,
    search: SearchMap,
}

impl KnownMap {
    /// A map whose cells are of 0 (free) to 100 (occupied), or -1; `threshold` says when a cell is
    /// occupied.
    ///
    /// Cells of the map have their corners at multiples of the resolution. Where those of the grid
    /// have not, they go to the nearest, and obstacles that scans are matched with stay in place.
    #[must_use]
    pub fn new(grid: OccupancyGrid, threshold: OccupiedThreshold) -> Self {
        let nearest = |metres: f64| libm::round(metres / grid.resolution) as i32;
        let first = Cell::new(nearest(grid.origin.x), nearest(grid.origin.y));
        let search = SearchMap::new(&grid, occupied_above(threshold));
        Self { grid, threshold, first, search }
    }

    /// Metres a cell.
    #[must_use]
    pub const fn resolution(&self) -> f64 {
        self.grid.resolution
    }

    /// Hits and visits of each cell, as if some scans had seen it.
    #[must_use]
    pub fn occupancy(&self) -> OccupancyMap {
        let visits = VISITS.max(self.threshold.visits);
        OccupancyMap::of_grid(&self.grid, self.first, visits)
    }

    /// The known cells with what they are: whether an obstacle is there.
    pub fn cells(&self) -> impl Iterator<Item = (Cell, bool)> {
        let rows = self.grid.cells.chunks_exact(self.grid.width.max(1));
        let rows = (self.first.iy..).zip(rows);
        let cells = rows.flat_map(|(iy, row)| {
            (self.first.ix..).zip(row).map(move |(ix, value)| (Cell::new(ix, iy), *value))
        });
        let known = cells.filter(|(_, value)| *value >= 0);
        known.map(|(cell, value)| (cell, f64::from(value) > occupied_above(self.threshold)))
    }

    /// The middles of cells with obstacles, in cells from the lower-left corner of [`Self::first`].
    pub fn obstacles(&self) -> impl Iterator<Item = [f64; 2]> {
        let Self { grid, first, .. } = self;
        let offset = |metres: f64, cell: i32| metres / grid.resolution - f64::from(cell);
        let (x, y) = (offset(grid.origin.x, first.ix), offset(grid.origin.y, first.iy));
        self.cells().filter(|(_, occupied)| *occupied).map(move |(cell, _)| {
            let middle = |at: i32, first: i32| f64::from(at - first) + 0.5;
            [x + middle(cell.ix, first.ix), y + middle(cell.iy, first.iy)]
        })
    }

    /// The cell that [`Self::obstacles`] counts from.
    #[must_use]
    pub const fn first(&self) -> Cell {
        self.first
    }

    /// Where a scan was taken; `pool` may help.
    ///
    /// # Errors
    /// When it fits nowhere, or at two places.
    pub fn find(
        &self,
        scan: &ScanOutline,
        pool: Option<&rayon::ThreadPool>,
    ) -> Result<Place, NotLocalized> {
        let hits = scan.ends.iter().filter(|end| end.kind == BeamEndKind::Hit);
        let hits: Vec<[f32; 2]> = hits.map(|end| end.point).collect();
        self.search.find(&hits, pool)
    }
}

/// Of 100.
fn occupied_above(threshold: OccupiedThreshold) -> f64 {
    100.0 * threshold.share
}
