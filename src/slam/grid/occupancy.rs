//! The occupancy map: how often each cell was seen, and how often with an obstacle in it.
//!
//! A scan counts each cell once, and an obstacle beats free space within a scan. Counts are sums
//! over scans, so a scan that turns out to lie elsewhere can be taken out again, exactly.

use serde::{Deserialize, Serialize};

use super::super::pose::{Point2, Pose2};
use super::Cell;
use super::footprint::Footprint;
use super::tile_map::{TILE_SIZE, Tile, TileKey, TileMap};

/// How often a cell was seen.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Count {
    /// Scans in which a beam ended in the cell.
    pub hits: u32,
    /// Scans that saw the cell, free or not.
    pub visits: u32,
}

/// When a cell is occupied.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OccupiedThreshold {
    /// Its hits / visits is above this.
    pub share: f64,
    /// A cell whose share says so after fewer visits stays unknown: it may have been one wild
    /// range. Karto decides after its `MinPassThrough` of 2, for free cells too.
    pub visits: u32,
}

impl OccupiedThreshold {
    /// The share alone decides.
    #[must_use]
    pub const fn of_share(share: f64) -> Self {
        Self { share, visits: 1 }
    }
}

/// Where a beam ends.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct BeamEnd {
    /// Metres in the base frame.
    pub point: [f32; 2],
    /// What is known of the beam.
    pub kind: BeamEndKind,
}

/// What a beam says about its end and the way there.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum BeamEndKind {
    /// Free up to an obstacle.
    Hit,
    /// Free up to the end, nothing known of the end itself.
    Free,
    /// Nothing known.
    Nothing,
}

/// A scan as the occupancy map takes it: beam ends in the order of their angles.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct ScanOutline {
    /// The sensor in the base frame.
    pub sensor: Point2,
    /// One end a beam.
    pub ends: Vec<BeamEnd>,
    /// Angle between neighbouring beams, rad, without sign.
    pub angle_increment: f64,
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
    pub origin: Point2,
    /// Row by row from the lowest y: -1 unknown, 0 free, 100 occupied.
    pub cells: Vec<i8>,
}

/// Counts of hits and visits over the plane, for cells of one size.
#[derive(Debug, Clone)]
pub struct OccupancyMap {
    resolution: f64,
    counts: TileMap<Count>,
    footprint: Footprint,
}

/// Whether a scan is entered or taken out.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Change {
    Add,
    Remove,
}

impl OccupancyMap {
    /// An empty map of cells of `resolution` metres.
    #[must_use]
    pub fn new(resolution: f64) -> Self {
        Self::of_counts(resolution, TileMap::new())
    }

    /// The map with these counts.
    pub(in super::super) fn of_counts(resolution: f64, counts: TileMap<Count>) -> Self {
        Self { resolution, counts, footprint: Footprint::default() }
    }

    /// A map whose cells count as seen `visits` times, with hits as the grid's values say; `first`
    /// is the cell that the grid's first one goes to.
    #[must_use]
    pub fn of_grid(grid: &OccupancyGrid, first: Cell, visits: u32) -> Self {
        let mut map = Self::new(grid.resolution);
        for (iy, row) in (first.iy..).zip(grid.cells.chunks_exact(grid.width.max(1))) {
            for (ix, value) in (first.ix..).zip(row).filter(|(_, value)| **value >= 0) {
                let share = f64::from(*value) / 100.0;
                let hits = libm::round(share * f64::from(visits)) as u32;
                *map.counts.get_mut(Cell::new(ix, iy)) = Count { hits, visits };
            }
        }
        map
    }

    /// Metres a cell.
    #[must_use]
    pub const fn resolution(&self) -> f64 {
        self.resolution
    }

    /// The counts.
    #[must_use]
    pub const fn counts(&self) -> &TileMap<Count> {
        &self.counts
    }

    /// A tile of the counts to write to.
    pub(in super::super) fn tile_mut(&mut self, key: TileKey) -> &mut Tile<Count> {
        self.counts.tile_mut(key)
    }

    /// Enters a scan taken with the base at `map_from_base`.
    pub fn add(&mut self, scan: &ScanOutline, map_from_base: Pose2) {
        self.count(scan, map_from_base, Change::Add);
    }

    /// Takes a scan out again that was entered with the same pose.
    pub fn remove(&mut self, scan: &ScanOutline, map_from_base: Pose2) {
        self.count(scan, map_from_base, Change::Remove);
    }

    fn count(&mut self, scan: &ScanOutline, map_from_base: Pose2, change: Change) {
        // Wrapping makes taking out the same loop as entering, with -1 in place of 1.
        let one = match change {
            Change::Add => 1,
            Change::Remove => u32::MAX,
        };
        let Self { resolution, counts, footprint } = self;
        for (key, seen) in footprint.of(scan, map_from_base, *resolution) {
            let (rows, _) = counts.tile_mut(*key).as_chunks_mut::<TILE_SIZE>();
            for ((row, free), hit) in rows.iter_mut().zip(seen.free).zip(seen.hit) {
                for (column, count) in row.iter_mut().enumerate() {
                    let [free, hit] = [free, hit].map(|row| u32::from(row >> column & 1));
                    count.hits = count.hits.wrapping_add(hit * one);
                    count.visits = count.visits.wrapping_add((free | hit) * one);
                }
            }
        }
    }

    /// The map as it is handed out, cropped to the cells that were seen; `None` if there are none.
    ///
    /// [`Count::occupancy`] says what a cell is.
    #[must_use]
    pub fn to_grid(&self, occupied_threshold: OccupiedThreshold) -> Option<OccupancyGrid> {
        let (low, high) = self.bounds()?;
        let (width, height) = ((high.ix - low.ix + 1) as usize, (high.iy - low.iy + 1) as usize);
        let mut cells = vec![-1; width * height];
        for (key, tile) in self.counts.tiles() {
            let first = key.first_cell();
            let columns = first.ix.max(low.ix)..(first.ix + TILE_SIZE as i32).min(high.ix + 1);
            for (iy, counts) in (first.iy..).zip(tile.chunks_exact(TILE_SIZE)) {
                // Beyond the bounds nothing was seen.
                if columns.is_empty() || !(low.iy..=high.iy).contains(&iy) {
                    continue;
                }
                let start = (iy - low.iy) as usize * width + (columns.start - low.ix) as usize;
                let counts = &counts[(columns.start - first.ix) as usize..];
                for (cell, count) in cells[start..][..columns.len()].iter_mut().zip(counts) {
                    *cell = count.occupancy(occupied_threshold);
                }
            }
        }
        let corner = |i: i32| f64::from(i) * self.resolution;
        let origin = Point2::new(corner(low.ix), corner(low.iy));
        Some(OccupancyGrid { resolution: self.resolution, width, height, origin, cells })
    }

    /// The lower-left and the upper-right of the cells that were seen; `None` if there are none.
    #[must_use]
    pub fn bounds(&self) -> Option<(Cell, Cell)> {
        let mut bounds: Option<(Cell, Cell)> = None;
        let size = TILE_SIZE as i32;
        for (key, tile) in self.counts.tiles() {
            let first = key.first_cell();
            let inside = bounds.is_some_and(|(low, high)| {
                low.ix <= first.ix
                    && low.iy <= first.iy
                    && first.ix + size <= high.ix
                    && first.iy + size <= high.iy
            });
            if inside {
                continue;
            }
            for (i, _) in (0..).zip(tile).filter(|(_, count)| count.visits > 0) {
                let (ix, iy) = (first.ix + i % size, first.iy + i / size);
                let (low, high) = bounds.unwrap_or((Cell::new(ix, iy), Cell::new(ix, iy)));
                bounds = Some((
                    Cell::new(low.ix.min(ix), low.iy.min(iy)),
                    Cell::new(high.ix.max(ix), high.iy.max(iy)),
                ));
            }
        }
        bounds
    }
}

impl Count {
    /// -1 for a cell nobody looked at, or that too few scans call occupied; 100 if its share of
    /// hits is above the threshold, else 0.
    #[must_use]
    pub fn occupancy(self, threshold: OccupiedThreshold) -> i8 {
        if self.visits == 0 {
            -1
        } else if f64::from(self.hits) <= threshold.share * f64::from(self.visits) {
            0
        } else if self.visits < threshold.visits {
            -1
        } else {
            100
        }
    }
}
