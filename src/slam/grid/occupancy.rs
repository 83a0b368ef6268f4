//! The occupancy map: how often each cell was seen, and how often with an obstacle in it.
//!
//! A scan counts each cell once, and an obstacle beats free space within a scan. Counts are sums
//! over scans, so a scan that turns out to lie elsewhere can be taken out again, exactly.

use std::f64::consts::TAU;
use std::iter::Peekable;

use serde::{Deserialize, Serialize};

use super::super::pose::{Point2, Pose2};
use super::tile_map::{TILE_SIZE, Tile, TileKey, TileMap, index_in_tile};
use super::{Cell, floor};

/// Neighbouring beams further apart than this say nothing about what lies between them, rad.
const WIDEST_WEDGE: f64 = 0.6;

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
    scratch: Scratch,
}

/// Buffers that keep their memory from scan to scan.
#[derive(Debug, Clone, Default)]
pub(super) struct Scratch {
    corners: Vec<Point2>,
    rows: Vec<Vec<Crossing>>,
    pub(super) hits: Vec<Cell>,
    /// Free cells of a row of tiles, by column of tiles.
    columns: Vec<Vec<Span>>,
}

/// Where an edge of the free polygon crosses the middle of a row of cells.
#[derive(Debug, Clone, Copy)]
struct Crossing {
    /// In cells.
    x: f64,
    /// 1 for an edge that goes up, -1 for one that goes down.
    direction: i32,
}

/// Cells of one row from `start` up to `end`, not included.
#[derive(Debug, Clone, Copy)]
pub(super) struct Span {
    pub(super) iy: i32,
    pub(super) start: i32,
    pub(super) end: i32,
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
        Self { resolution, counts, scratch: Scratch::default() }
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
        self.scratch.outline(scan, map_from_base, self.resolution);
        for cell in &self.scratch.hits {
            let count = self.counts.get_mut(*cell);
            count.hits = count.hits.wrapping_add(one);
            count.visits = count.visits.wrapping_add(one);
        }
        let counts = &mut self.counts;
        self.scratch.fill(|key, spans| {
            let tile = counts.tile_mut(key);
            for span in spans {
                let index = index_in_tile(Cell::new(span.start, span.iy));
                for count in &mut tile[index..index + (span.end - span.start) as usize] {
                    count.visits = count.visits.wrapping_add(one);
                }
            }
        });
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
    fn bounds(&self) -> Option<(Cell, Cell)> {
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

impl Scratch {
    /// The free polygon's corners, in cells, and the cells that beams end in.
    pub(super) fn outline(&mut self, scan: &ScanOutline, map_from_base: Pose2, resolution: f64) {
        let (sin, cos) = libm::sincos(map_from_base.theta);
        let to_cells = |x: f64, y: f64| {
            Point2::new(
                (map_from_base.x + cos * x - sin * y) / resolution,
                (map_from_base.y + sin * x + cos * y) / resolution,
            )
        };
        let sensor = to_cells(scan.sensor.x, scan.sensor.y);
        let end = |end: &BeamEnd| to_cells(f64::from(end.point[0]), f64::from(end.point[1]));

        self.hits.clear();
        let hits = scan.ends.iter().filter(|beam| beam.kind == BeamEndKind::Hit);
        self.hits.extend(hits.map(|beam| Cell::containing(end(beam), 1.0)));
        self.hits.sort_unstable_by_key(|cell| (cell.iy, cell.ix));
        self.hits.dedup();

        self.corners.clear();
        self.corners.push(sensor);
        if scan.angle_increment > WIDEST_WEDGE {
            return;
        }
        let closes = (scan.ends.len() as f64 + 0.5) * scan.angle_increment >= TAU;
        let around = scan.ends.last().filter(|_| closes).into_iter();
        let mut previous = None;
        for beam in around.chain(&scan.ends) {
            let current = (beam.kind != BeamEndKind::Nothing).then(|| Arm::new(sensor, end(beam)));
            match previous.zip(current) {
                Some((a, b)) => self.corners.extend(Arm::wedge(sensor, a, b)),
                None => self.corners.push(sensor),
            }
            previous = current;
        }
    }

    /// Calls `take` with the free cells of each tile: those whose centres lie inside the polygon
    /// and in which no beam ends.
    pub(super) fn fill(&mut self, mut take: impl FnMut(TileKey, &[Span])) {
        let (low, high) = bounds(&self.corners);
        let (bottom, top) = (floor(low.y), floor(high.y) + 1);
        let height = (top - bottom) as usize;
        self.rows.resize_with(self.rows.len().max(height), Vec::new);
        let next = self.corners.iter().cycle().skip(1);
        for (a, b) in self.corners.iter().zip(next) {
            cross_rows(&mut self.rows, bottom, *a, *b);
        }
        let tile_of = |x: f64| TileKey::containing(Cell::new(floor(x), 0)).tx;
        let (left, right) = (tile_of(low.x), tile_of(high.x));
        self.columns.resize_with(self.columns.len().max((right - left + 1) as usize), Vec::new);
        let mut hits = self.hits.iter().copied().peekable();
        for (iy, crossings) in (bottom..top).zip(&mut self.rows) {
            crossings.sort_unstable_by(|a, b| a.x.total_cmp(&b.x));
            for_each_inside(crossings, |start, end| {
                push_without_hits(&mut self.columns, left, Span { iy, start, end }, &mut hits);
            });
            crossings.clear();
            if iy + 1 == top || index_in_tile(Cell::new(0, iy + 1)) == 0 {
                let ty = TileKey::containing(Cell::new(0, iy)).ty;
                for (tx, spans) in (left..=right).zip(&mut self.columns) {
                    if !spans.is_empty() {
                        take(TileKey { ty, tx }, spans);
                        spans.clear();
                    }
                }
            }
        }
    }
}

/// From the sensor to the end of a beam, in cells.
#[derive(Debug, Clone, Copy)]
struct Arm {
    direction: Point2,
    length: f64,
}

impl Arm {
    fn new(sensor: Point2, end: Point2) -> Self {
        let direction = Point2::new(end.x - sensor.x, end.y - sensor.y);
        Self { direction, length: direction.norm() }
    }

    /// The outer corners of the triangle that two neighbouring beams know to be free: as long as
    /// the shorter of them, since nothing is known behind an edge that only one has passed.
    fn wedge(sensor: Point2, a: Self, b: Self) -> [Point2; 2] {
        let reach = a.length.min(b.length);
        [a, b].map(|arm| {
            let share = if arm.length > 0.0 { reach / arm.length } else { 0.0 };
            Point2::new(sensor.x + share * arm.direction.x, sensor.y + share * arm.direction.y)
        })
    }
}

fn bounds(points: &[Point2]) -> (Point2, Point2) {
    let first = (points[0], points[0]);
    points.iter().fold(first, |(low, high), p| {
        (Point2::new(low.x.min(p.x), low.y.min(p.y)), Point2::new(high.x.max(p.x), high.y.max(p.y)))
    })
}

/// Notes where the edge from `a` to `b` crosses the middles of rows, and which way.
fn cross_rows(rows: &mut [Vec<Crossing>], bottom: i32, a: Point2, b: Point2) {
    let (low, high, direction) = if a.y < b.y { (a, b, 1) } else { (b, a, -1) };
    let (start, end) = (first_centre(low.y), first_centre(high.y));
    if start >= end {
        return;
    }
    let slope = (high.x - low.x) / (high.y - low.y);
    for iy in start..end {
        let x = low.x + slope * (f64::from(iy) + 0.5 - low.y);
        rows[(iy - bottom) as usize].push(Crossing { x, direction });
    }
}

/// The first cell whose centre is not before `x`.
fn first_centre(x: f64) -> i32 {
    -floor(0.5 - x)
}

/// Calls `take` with the first and one past the last cell of each stretch inside the polygon, by
/// the non-zero winding rule: beams that overlap after a full turn do not cancel each other.
fn for_each_inside(crossings: &[Crossing], mut take: impl FnMut(i32, i32)) {
    let mut winding = 0;
    let mut from = 0.0;
    for crossing in crossings {
        if winding == 0 {
            from = crossing.x;
        }
        winding += crossing.direction;
        if winding == 0 {
            take(first_centre(from), first_centre(crossing.x));
        }
    }
}

/// Adds the parts of `span` between the hits of its row, tile by tile; hits come in the order of
/// the spans.
fn push_without_hits(
    columns: &mut [Vec<Span>],
    left: i32,
    mut span: Span,
    hits: &mut Peekable<impl Iterator<Item = Cell>>,
) {
    while let Some(hit) = hits.next_if(|hit| (hit.iy, hit.ix) < (span.iy, span.end)) {
        if hit.iy == span.iy && hit.ix >= span.start {
            push_by_tile(columns, left, Span { end: hit.ix, ..span });
            span.start = hit.ix + 1;
        }
    }
    push_by_tile(columns, left, span);
}

fn push_by_tile(columns: &mut [Vec<Span>], left: i32, span: Span) {
    let size = TILE_SIZE as i32;
    let mut start = span.start;
    while start < span.end {
        let tx = TileKey::containing(Cell::new(start, span.iy)).tx;
        let end = span.end.min((tx + 1) * size);
        columns[(tx - left) as usize].push(Span { iy: span.iy, start, end });
        start = end;
    }
}
