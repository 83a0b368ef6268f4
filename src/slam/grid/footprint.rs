//! Which cells a scan saw: those that beams ended in, and those that are free, whose centres lie
//! inside the polygon that the beams have crossed.

use std::f64::consts::TAU;

use super::super::pose::{Point2, Pose2};
use super::occupancy::{BeamEnd, BeamEndKind, ScanOutline};
use super::tile_map::{TILE_SIZE, TileKey};
use super::{Cell, floor};

/// Neighbouring beams further apart than this say nothing about what lies between them, rad.
const WIDEST_WEDGE: f64 = 0.6;
/// A beam that has no neighbour is as wide as beams are apart, and at most this, rad.
const WIDEST_BEAM: f64 = 0.04;

/// What a scan saw of a tile: for each row a bit for each column, the lowest for the first. No cell
/// is both.
#[derive(Debug, Clone, Copy, Default)]
pub struct Seen {
    /// Cells that beams passed.
    pub(super) free: [u16; TILE_SIZE],
    /// Cells that beams ended in.
    pub(super) hit: [u16; TILE_SIZE],
}

impl Seen {
    /// Adds what was seen in cells of half the size, which fill one half of the columns and one of
    /// the rows: hit if one of four cells is, free if two of them that meet at the middle are.
    fn add_halved(&mut self, small: &Self, [right, upper]: [bool; 2]) {
        let (columns, rows) = (if right { 8 } else { 0 }, if upper { 8 } else { 0 });
        for row in 0..TILE_SIZE / 2 {
            let [low, high] = [2 * row, 2 * row + 1];
            let hit = small.hit[low] | small.hit[high];
            let hit = every_second(hit | hit >> 1);
            let (low, high) = (small.free[low], small.free[high]);
            let free = every_second(low & high >> 1 | low >> 1 & high);
            self.hit[rows + row] |= hit << columns;
            self.free[rows + row] |= (free & !hit) << columns;
        }
    }
}

/// The first, third, fifth, ... bit, side by side.
const fn every_second(bits: u16) -> u16 {
    let bits = bits & 0x5555;
    let bits = (bits | bits >> 1) & 0x3333;
    let bits = (bits | bits >> 2) & 0x0f0f;
    (bits | bits >> 4) & 0x00ff
}

/// What a scan saw, row by row, in cells of twice the size.
#[must_use]
pub fn halved(tiles: &[(TileKey, Seen)]) -> Vec<(TileKey, Seen)> {
    let mut halves = Vec::with_capacity(tiles.len());
    for rows in tiles.chunk_by(|(a, _), (b, _)| a.ty >> 1 == b.ty >> 1) {
        let columns = rows.iter().map(|(key, _)| key.tx >> 1);
        let (first, last) = columns.fold((i32::MAX, i32::MIN), |(a, b), tx| (a.min(tx), b.max(tx)));
        let mut row = vec![None; (last - first + 1) as usize];
        for (TileKey { ty, tx }, seen) in rows {
            let half: &mut Seen = row[((tx >> 1) - first) as usize].get_or_insert_default();
            half.add_halved(seen, [tx & 1 == 1, ty & 1 == 1]);
        }
        let ty = rows[0].0.ty >> 1;
        let tiles = (first..).zip(row).filter_map(|(tx, seen)| Some((TileKey { ty, tx }, seen?)));
        halves.extend(tiles);
    }
    halves
}

/// Finds the cells; its buffers keep their memory from scan to scan.
#[derive(Debug, Clone, Default)]
pub struct Footprint {
    /// What was seen of each tile.
    tiles: Vec<(TileKey, Seen)>,
    /// Of the free polygon, in cells.
    corners: Vec<Point2>,
    hits: Vec<Cell>,
    /// Where the polygon crosses the middle of each row of cells.
    rows: Vec<Vec<Crossing>>,
    /// The hits in each row of tiles.
    hits_by_row: Vec<Vec<Cell>>,
    /// The row of tiles that is looked at.
    columns: Vec<Column>,
}

/// Where an edge of the polygon crosses the middle of a row of cells: twice the first cell whose
/// centre is behind it (one on it may be either), counted from the first column that is used, and 1
/// more for an edge that goes up. As one number, they are sorted quickly.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Crossing(u32);

impl Crossing {
    const fn column(self) -> usize {
        (self.0 >> 1) as usize
    }

    /// 1 for an edge that goes up, -1 for one that goes down.
    const fn direction(self) -> i32 {
        (self.0 & 1) as i32 * 2 - 1
    }
}

/// A tile of the row of tiles that is looked at.
#[derive(Debug, Clone, Copy, Default)]
struct Column {
    /// Of the free, those cells that are not as their row is from this tile on.
    seen: Seen,
    /// Whether it holds anything yet.
    touched: bool,
    /// Rows that are free from this tile on to the right, up to the next where their bit is set.
    toggled: u16,
}

impl Footprint {
    /// What the scan saw of each tile, taken with the base at `map_from_base`, for cells of
    /// `resolution` metres.
    pub fn of(
        &mut self,
        scan: &ScanOutline,
        map_from_base: Pose2,
        resolution: f64,
    ) -> &[(TileKey, Seen)] {
        self.tiles.clear();
        self.outline(scan, map_from_base, resolution);
        let (low, high) = self.bounds();
        self.fill_rows(low, high);
        let (rows, _) = self.rows.as_chunks_mut::<TILE_SIZE>();
        for ((ty, rows), hits) in (low.ty..=high.ty).zip(rows).zip(&mut self.hits_by_row) {
            for (row, crossings) in rows.iter_mut().enumerate() {
                crossings.sort_unstable();
                mark_edges(&mut self.columns, row, crossings);
                crossings.clear();
            }
            for hit in hits.drain(..) {
                let (tile, column) = place(hit.ix);
                self.columns[(tile - low.tx) as usize].push_hit(place(hit.iy).1, column);
            }
            let mut whole = 0;
            for (tx, column) in (low.tx..).zip(&mut self.columns) {
                whole ^= column.toggled;
                if (whole != 0 || column.touched)
                    && let Some(seen) = column.finish(whole)
                {
                    self.tiles.push((TileKey { ty, tx }, seen));
                }
            }
        }
        &self.tiles
    }

    /// Finds the free polygon's corners, and the cells that beams end in.
    fn outline(&mut self, scan: &ScanOutline, map_from_base: Pose2, resolution: f64) {
        let (sin, cos) = libm::sincos(map_from_base.theta);
        let per_metre = 1.0 / resolution;
        let to_cells = |x: f64, y: f64| {
            Point2::new(
                (map_from_base.x + cos * x - sin * y) * per_metre,
                (map_from_base.y + sin * x + cos * y) * per_metre,
            )
        };
        let sensor = to_cells(scan.sensor.x, scan.sensor.y);
        let end = |end: &BeamEnd| to_cells(f64::from(end.point[0]), f64::from(end.point[1]));
        self.corners.clear();
        self.corners.push(sensor);
        self.hits.clear();
        let closes = (scan.ends.len() as f64 + 0.5) * scan.angle_increment >= TAU;
        let around = scan.ends.last().filter(|_| closes);
        let mut previous = around.and_then(|beam| Arm::of(beam, sensor, end(beam)));
        let after = scan.ends.iter().skip(1).chain(scan.ends.first().filter(|_| closes));
        let mut after = after.map(|beam| beam.kind != BeamEndKind::Nothing);
        for beam in &scan.ends {
            let end = end(beam);
            if beam.kind == BeamEndKind::Hit {
                self.hits.push(Cell::containing(end, 1.0));
            }
            let current = Arm::of(beam, sensor, end);
            let has_next = after.next().unwrap_or(false);
            let near = scan.angle_increment <= WIDEST_WEDGE;
            match (previous.filter(|_| near), current) {
                (Some(a), Some(b)) => self.corners.extend(Arm::wedge(sensor, a, b)),
                (None, Some(alone)) if !(has_next && near) => {
                    let half_width = 0.5 * scan.angle_increment.min(WIDEST_BEAM);
                    self.corners.push(sensor);
                    self.corners.extend(alone.beam(sensor, half_width));
                }
                _ => self.corners.push(sensor),
            }
            previous = current;
        }
        self.hits.dedup();
    }

    /// The first and the last tile that anything lies in, or past it.
    fn bounds(&self) -> (TileKey, TileKey) {
        let first = (self.corners[0], self.corners[0]);
        let (low, high) = self.corners.iter().fold(first, |(low, high), p| {
            (
                Point2::new(low.x.min(p.x), low.y.min(p.y)),
                Point2::new(high.x.max(p.x), high.y.max(p.y)),
            )
        });
        let cells = (Cell::containing(low, 1.0), Cell::containing(high, 1.0));
        let (low, high) = self.hits.iter().fold(cells, |(low, high), hit| {
            (
                Cell::new(low.ix.min(hit.ix), low.iy.min(hit.iy)),
                Cell::new(high.ix.max(hit.ix), high.iy.max(hit.iy)),
            )
        });
        // Rows that are free up to the last column end in the next.
        (TileKey::containing(low), TileKey::containing(Cell::new(high.ix + 1, high.iy)))
    }

    /// Sorts crossings by rows, and hits by rows of tiles.
    fn fill_rows(&mut self, low: TileKey, high: TileKey) {
        let height = (high.ty - low.ty + 1) as usize;
        let width = (high.tx - low.tx + 1) as usize;
        grow(&mut self.rows, height * TILE_SIZE);
        grow(&mut self.hits_by_row, height);
        self.columns.resize(width, Column::default());
        let first = low.first_cell();
        let corner = |at: &Point2| Corner { at: *at, row: first_centre(at.y) };
        let mut before = corner(&self.corners[self.corners.len() - 1]);
        for here in self.corners.iter().map(corner) {
            cross_rows(&mut self.rows, first, before, here);
            before = here;
        }
        for hit in &self.hits {
            self.hits_by_row[(place(hit.iy).0 - low.ty) as usize].push(*hit);
        }
    }
}

fn grow<T: Clone + Default>(buffer: &mut Vec<T>, length: usize) {
    buffer.resize(buffer.len().max(length), T::default());
}

/// The tile that a row or column lies in, and where there.
const fn place(index: i32) -> (i32, usize) {
    (index.div_euclid(TILE_SIZE as i32), index.rem_euclid(TILE_SIZE as i32) as usize)
}

impl Column {
    /// From this column on to the right, the row is the other way round.
    fn flip(&mut self, row: usize, column: usize) {
        self.seen.free[row] ^= !(u16::MAX << column);
        self.toggled ^= 1 << row;
        self.touched = true;
    }

    fn push_hit(&mut self, row: usize, column: usize) {
        self.seen.hit[row] |= 1 << column;
        self.touched = true;
    }

    /// What was seen, if anything, with the rows that are free from here on; begins anew.
    fn finish(&mut self, whole_rows: u16) -> Option<Seen> {
        let Self { mut seen, .. } = std::mem::take(self);
        let mut any = 0;
        for row in 0..TILE_SIZE {
            let whole = if whole_rows & 1 << row == 0 { 0 } else { u16::MAX };
            // An obstacle beats free space within a scan.
            seen.free[row] = (seen.free[row] ^ whole) & !seen.hit[row];
            any |= seen.free[row] | seen.hit[row];
        }
        (any != 0).then_some(seen)
    }
}

/// Turns the row round at each edge of the polygon, by the non-zero winding rule: beams that overlap
/// after a full turn do not cancel each other.
fn mark_edges(columns: &mut [Column], row: usize, crossings: &[Crossing]) {
    let mut winding = 0;
    for crossing in crossings {
        let outside = winding == 0;
        winding += crossing.direction();
        if outside || winding == 0 {
            let column = crossing.column();
            columns[column / TILE_SIZE].flip(row, column % TILE_SIZE);
        }
    }
}

/// From the sensor to the end of a beam, in cells.
#[derive(Debug, Clone, Copy)]
struct Arm {
    direction: Point2,
    squared: f64,
}

impl Arm {
    /// `None` if the beam says nothing.
    fn of(beam: &BeamEnd, sensor: Point2, end: Point2) -> Option<Self> {
        let (x, y) = (end.x - sensor.x, end.y - sensor.y);
        (beam.kind != BeamEndKind::Nothing)
            .then(|| Self { direction: Point2::new(x, y), squared: x * x + y * y })
    }

    /// The outer corners of the triangle that two neighbouring beams know to be free: as long as
    /// the shorter of them, since nothing is known behind an edge that only one has passed.
    fn wedge(sensor: Point2, a: Self, b: Self) -> [Point2; 2] {
        let (shorter, longer) = (a.squared.min(b.squared), a.squared.max(b.squared));
        let share = if longer > 0.0 { (shorter / longer).sqrt() } else { 0.0 };
        [a, b].map(|Self { direction, squared }| {
            let share = if squared > shorter { share } else { 1.0 };
            Point2::new(sensor.x + share * direction.x, sensor.y + share * direction.y)
        })
    }

    /// The outer corners of a beam to both sides of the arm, for small angles.
    fn beam(self, sensor: Point2, half_width: f64) -> [Point2; 2] {
        let Point2 { x, y } = self.direction;
        [-half_width, half_width]
            .map(|turn| Point2::new(sensor.x + x - turn * y, sensor.y + y + turn * x))
    }
}

/// A corner of the polygon.
#[derive(Debug, Clone, Copy)]
struct Corner {
    /// In cells.
    at: Point2,
    /// The first row whose middle is not below it.
    row: i32,
}

/// Notes where the edge from `a` to `b` crosses the middles of rows, and which way.
fn cross_rows(rows: &mut [Vec<Crossing>], first: Cell, a: Corner, b: Corner) {
    if a.row == b.row {
        return;
    }
    let goes_up = a.row < b.row;
    let (low, high) = if goes_up { (a, b) } else { (b, a) };
    let slope = (high.at.x - low.at.x) / (high.at.y - low.at.y);
    let rows = &mut rows[(low.row - first.iy) as usize..(high.row - first.iy) as usize];
    let start = low.at.x - f64::from(first.ix);
    let mut height = f64::from(low.row) + 0.5 - low.at.y;
    for row in rows {
        let column = nearest(start + slope * height);
        row.push(Crossing(column << 1 | u32::from(goes_up)));
        height += 1.0;
    }
}

/// The first cell whose centre is not before `x`.
fn first_centre(x: f64) -> i32 {
    -floor(0.5 - x)
}

/// The nearest whole number to one that is hardly negative: adding 1.5 times 2^52 leaves no room for
/// digits behind the point.
const fn nearest(value: f64) -> u32 {
    (value + 6_755_399_441_055_744.0).to_bits() as u32
}
