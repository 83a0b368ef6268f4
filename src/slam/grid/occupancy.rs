//! The occupancy map: how often each cell was seen, and how often with an obstacle in it.
//!
//! A scan counts each cell once, and an obstacle beats free space within a scan. Counts are sums
//! over scans, so a scan that turns out to lie elsewhere can be taken out again, exactly.

use super::super::pose::{Point2, Pose2};
use super::Cell;
use super::tile_map::{TILE_SIZE, TileKey, TileMap, index_in_tile};

/// Neighbouring beams further apart than this say nothing about what lies between them, rad.
const WIDEST_WEDGE: f64 = 0.6;

/// How often a cell was seen.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Count {
    /// Scans in which a beam ended in the cell.
    pub hits: u32,
    /// Scans that saw the cell, free or not.
    pub visits: u32,
}

/// Where a beam ends.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BeamEnd {
    /// Metres in the base frame.
    pub point: [f32; 2],
    /// What is known of the beam.
    pub kind: BeamEndKind,
}

/// What a beam says about its end and the way there.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BeamEndKind {
    /// Free up to an obstacle.
    Hit,
    /// Free up to the end, nothing known of the end itself.
    Free,
    /// Nothing known.
    Nothing,
}

/// A scan as the occupancy map takes it: beam ends in the order of their angles.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ScanOutline {
    /// The sensor in the base frame.
    pub sensor: Point2,
    /// One end a beam.
    pub ends: Vec<BeamEnd>,
    /// Angle between neighbouring beams, rad, without sign.
    pub angle_increment: f64,
}

/// Counts of hits and visits over the plane, for cells of one size.
#[derive(Debug, Clone)]
pub struct OccupancyMap {
    resolution: f64,
    counts: TileMap<Count>,
    scratch: Scratch,
}

impl OccupancyMap {
    /// The grid of -1 unknown, 0 free, 100 occupied, cropped to the seen cells.
    pub fn to_grid(&self, threshold: f64) -> Option<crate::slam::gmapping::OccupancyGrid> {
        let seen = self.counts.tiles().flat_map(|(key, tile)| {
            tile.iter().enumerate().filter(|(_, c)| c.visits > 0).map(move |(i, _)| {
                let first = key.first_cell();
                Cell::new(first.ix + (i % TILE_SIZE) as i32, first.iy + (i / TILE_SIZE) as i32)
            })
        });
        let (mut low, mut high) = (Cell::new(i32::MAX, i32::MAX), Cell::new(i32::MIN, i32::MIN));
        for c in seen {
            low = Cell::new(low.ix.min(c.ix), low.iy.min(c.iy));
            high = Cell::new(high.ix.max(c.ix), high.iy.max(c.iy));
        }
        if low.ix > high.ix {
            return None;
        }
        let (width, height) = ((high.ix - low.ix + 1) as usize, (high.iy - low.iy + 1) as usize);
        let mut cells = vec![-1; width * height];
        for (key, tile) in self.counts.tiles() {
            let first = key.first_cell();
            for (i, c) in tile.iter().enumerate().filter(|(_, c)| c.visits > 0) {
                let (x, y) = (
                    first.ix + (i % TILE_SIZE) as i32 - low.ix,
                    first.iy + (i / TILE_SIZE) as i32 - low.iy,
                );
                cells[y as usize * width + x as usize] =
                    if f64::from(c.hits) > threshold * f64::from(c.visits) { 100 } else { 0 };
            }
        }
        Some(crate::slam::gmapping::OccupancyGrid {
            resolution: self.resolution,
            width,
            height,
            origin: Point2::new(
                f64::from(low.ix) * self.resolution,
                f64::from(low.iy) * self.resolution,
            ),
            cells,
        })
    }
}

/// Buffers that keep their memory from scan to scan.
#[derive(Debug, Clone, Default)]
struct Scratch {
    corners: Vec<Point2>,
    rows: Vec<Vec<(f64, i32)>>,
    hits: Vec<Cell>,
    spans: Vec<Span>,
}

/// Cells of one row from `start` up to `end`, not included.
#[derive(Debug, Clone, Copy)]
struct Span {
    iy: i32,
    start: i32,
    end: i32,
}

impl OccupancyMap {
    /// An empty map of cells of `resolution` metres.
    #[must_use]
    pub fn new(resolution: f64) -> Self {
        Self { resolution, counts: TileMap::new(), scratch: Scratch::default() }
    }

    /// The counts.
    #[must_use]
    pub const fn counts(&self) -> &TileMap<Count> {
        &self.counts
    }

    /// Enters a scan taken with the base at `map_from_base`.
    pub fn add(&mut self, scan: &ScanOutline, map_from_base: Pose2) {
        self.count(scan, map_from_base, |count, hit| {
            count.visits += 1;
            count.hits += u32::from(hit);
        });
    }

    /// Takes a scan out again that was entered with the same pose.
    pub fn remove(&mut self, scan: &ScanOutline, map_from_base: Pose2) {
        self.count(scan, map_from_base, |count, hit| {
            count.visits -= 1;
            count.hits -= u32::from(hit);
        });
    }

    /// Calls `change` once for each cell the scan saw, and whether a beam ended in it.
    fn count(
        &mut self,
        scan: &ScanOutline,
        map_from_base: Pose2,
        change: impl Fn(&mut Count, bool),
    ) {
        let mut scratch = std::mem::take(&mut self.scratch);
        scratch.outline(scan, map_from_base, self.resolution);
        scratch.fill();
        for span in &scratch.spans {
            let mut start = span.start;
            while start < span.end {
                let first = Cell::new(start, span.iy);
                let tile = self.counts.tile_mut(TileKey::containing(first));
                let index = index_in_tile(first);
                let length = (TILE_SIZE - index % TILE_SIZE).min((span.end - start) as usize);
                for count in &mut tile[index..index + length] {
                    change(count, false);
                }
                start += length as i32;
            }
        }
        for cell in &scratch.hits {
            change(self.counts.get_mut(*cell), true);
        }
        self.scratch = scratch;
    }
}

impl Scratch {
    /// The free polygon's corners, in cells, and the cells that beams end in.
    fn outline(&mut self, scan: &ScanOutline, map_from_base: Pose2, resolution: f64) {
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
        let closes = (scan.ends.len() as f64 + 0.5) * scan.angle_increment >= std::f64::consts::TAU;
        let around = scan.ends.last().filter(|_| closes).into_iter();
        let mut previous: Option<(Point2, f64)> = None;
        for beam in around.chain(&scan.ends) {
            let current = (beam.kind != BeamEndKind::Nothing).then(|| {
                let arm = {
                    let p = end(beam);
                    Point2::new(p.x - sensor.x, p.y - sensor.y)
                };
                (arm, arm.norm())
            });
            if let (Some(a), Some(b)) = (previous, current) {
                let reach = a.1.min(b.1);
                for (arm, length) in [a, b] {
                    let share = reach / length;
                    self.corners
                        .push(Point2::new(sensor.x + share * arm.x, sensor.y + share * arm.y));
                }
            } else {
                self.corners.push(sensor);
            }
            previous = current;
        }
    }

    /// The spans of cells whose centres lie inside the polygon, without those that were hit.
    fn fill(&mut self) {
        self.spans.clear();
        let rows = self.corners.iter().map(|c| c.y);
        let bottom = libm::floor(rows.clone().fold(f64::INFINITY, f64::min)) as i32;
        let top = libm::ceil(rows.fold(f64::NEG_INFINITY, f64::max)) as i32;
        let height = (top - bottom) as usize;
        self.rows.iter_mut().take(height).for_each(Vec::clear);
        self.rows.resize_with(self.rows.len().max(height), Vec::new);
        let next = self.corners.iter().cycle().skip(1);
        for (a, b) in self.corners.iter().zip(next) {
            cross_rows(&mut self.rows, bottom, *a, *b);
        }
        let mut hits = self.hits.iter().peekable();
        for (row, crossings) in self.rows[..height].iter_mut().enumerate() {
            let iy = bottom + row as i32;
            crossings.sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
            let mut winding = 0;
            let mut from = 0.0;
            for (x, direction) in crossings {
                if winding == 0 {
                    from = *x;
                }
                winding += *direction;
                if winding == 0 {
                    let span = Span { iy, start: first_centre(from), end: first_centre(*x) };
                    push_without_hits(&mut self.spans, span, &mut hits);
                }
            }
        }
    }
}

/// Notes where the edge from `a` to `b` crosses the middles of rows, and which way.
fn cross_rows(rows: &mut [Vec<(f64, i32)>], bottom: i32, a: Point2, b: Point2) {
    let (low, high, direction) = if a.y < b.y { (a, b, 1) } else { (b, a, -1) };
    let (start, end) = (first_centre(low.y), first_centre(high.y));
    if start >= end {
        return;
    }
    let slope = (high.x - low.x) / (high.y - low.y);
    for iy in start..end {
        let x = low.x + slope * (f64::from(iy) + 0.5 - low.y);
        rows[(iy - bottom) as usize].push((x, direction));
    }
}

/// The first cell whose centre is not before `x`.
fn first_centre(x: f64) -> i32 {
    libm::ceil(x - 0.5) as i32
}

/// Adds the parts of `span` between the hits of its row; `hits` come in the order of the spans.
fn push_without_hits<'a>(
    spans: &mut Vec<Span>,
    mut span: Span,
    hits: &mut std::iter::Peekable<impl Iterator<Item = &'a Cell>>,
) {
    while let Some(hit) = hits.next_if(|hit| (hit.iy, hit.ix) < (span.iy, span.end)) {
        if hit.iy == span.iy && hit.ix >= span.start {
            spans.push(Span { end: hit.ix, ..span });
            span.start = hit.ix + 1;
        }
    }
    spans.push(span);
}
