//! The likelihood field: for each cell, how near the nearest hit of the map is, as one byte.
//!
//! A byte is `255 * exp(-d^2 / (2 sigma^2))` for the distance d from the cell's centre to the
//! nearest hit. It is kept up to date by stamping a small kernel around each new hit and keeping
//! the maximum, so that a beam is evaluated with one look-up where the original searched nine
//! cells and their means.

use super::tile_map::{TILE_CELLS, TILE_SIZE, Tile, TileKey, TileMap, index_in_tile};
use super::{Cell, floor};

/// Sub-cell positions a kernel is tabulated for, along each axis.
const PHASES: usize = 8;
/// A hit that would raise its cell by no more than this is taken for known.
const KNOWN_WITHIN: u8 = 8;
/// Beams whose cells are computed together before they are looked up.
const BLOCK: usize = 64;
/// Lanes of the floating-point sums; fixed, so that sums are the same on every machine.
const LANES: usize = 8;
/// Adding this to a float in (-2^22, 2^22) leaves its nearest integer in the low mantissa bits.
const ROUND: f32 = 12_582_912.0;
/// The bits of a column or row that say where in its tile it is.
const CELL: u32 = TILE_SIZE as u32 - 1;
const EMPTY: &Tile<u8> = &[0; TILE_CELLS];

/// Points of a scan in the base frame, in cells, kept apart by axis for vector instructions.
#[derive(Debug, Clone, Default)]
pub struct Points {
    x: Vec<f32>,
    y: Vec<f32>,
}

impl Points {
    /// Number of points.
    #[must_use]
    pub fn len(&self) -> usize {
        self.x.len()
    }

    /// Whether there are none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.x.is_empty()
    }

    /// Every `step`-th point.
    #[must_use]
    pub fn every(&self, step: usize) -> Self {
        self.iter().step_by(step).collect()
    }

    /// The points as (x, y).
    pub fn iter(&self) -> impl Iterator<Item = (f32, f32)> {
        self.x.iter().copied().zip(self.y.iter().copied())
    }
}

impl FromIterator<(f32, f32)> for Points {
    fn from_iter<I: IntoIterator<Item = (f32, f32)>>(points: I) -> Self {
        let (x, y) = points.into_iter().unzip();
        Self { x, y }
    }
}

/// A base pose in a window: cells from the window's lower-left corner, heading as cosine and sine.
#[derive(Debug, Clone, Copy)]
pub struct WindowPose {
    /// Columns.
    pub x: f64,
    /// Rows.
    pub y: f64,
    /// Heading, radians.
    pub theta: f64,
    rotation: [f32; 2],
}

impl WindowPose {
    /// The pose (x, y, theta): cells, cells, radians.
    #[must_use]
    pub fn new(x: f64, y: f64, theta: f64) -> Self {
        let (sin, cos) = libm::sincos(theta);
        Self { x, y, theta, rotation: [cos as f32, sin as f32] }
    }

    /// The pose moved by whole axes, heading unchanged.
    #[must_use]
    pub fn moved(self, dx: f64, dy: f64) -> Self {
        Self { x: self.x + dx, y: self.y + dy, ..self }
    }

    /// The pose turned by `dtheta` radians about itself.
    #[must_use]
    pub fn turned(self, dtheta: f64) -> Self {
        Self::new(self.x, self.y, self.theta + dtheta)
    }
}

/// A part of a field made ready for many look-ups.
///
/// It must be wide enough for the points: one outside reads some cell of the window, or unknown.
#[derive(Debug)]
pub struct Window<'a> {
    first_cell: Cell,
    /// The window is `1 << width_shift` tiles wide.
    width_shift: u32,
    tiles: Vec<&'a Tile<u8>>,
}

/// The field seen from a pose: how well the scan fits, and where it would fit better.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Linearization {
    /// Σ (1 - m)², m in 0..=1 the field at each point: what Gauss-Newton makes small.
    pub cost: f32,
    /// Σ JᵀJ, upper triangle xx, xy, xθ, yy, yθ, θθ; cells and radians.
    pub information: [f32; 6],
    /// Σ Jᵀ(1 - m); cells and radians.
    pub gradient: [f32; 3],
}

impl<'a> Window<'a> {
    /// The cells of `field` within `radius` cells of `centre`.
    #[must_use]
    pub fn around(field: &'a TileMap<u8>, centre: Cell, radius: i32) -> Self {
        let first = TileKey::containing(Cell::new(centre.ix - radius, centre.iy - radius));
        let last = TileKey::containing(Cell::new(centre.ix + radius, centre.iy + radius));
        let width = (last.tx - first.tx + 1) as usize;
        let height = (last.ty - first.ty + 1) as usize;
        let width_shift = width.next_power_of_two().trailing_zeros();
        let mut tiles = vec![EMPTY; height << width_shift];
        for (key, tile) in field.tiles_between(first, last) {
            let row = (key.ty - first.ty) as usize;
            tiles[(row << width_shift) + (key.tx - first.tx) as usize] = tile;
        }
        Self { first_cell: first.first_cell(), width_shift, tiles }
    }

    /// The cell at the window's lower-left corner.
    #[must_use]
    pub const fn first_cell(&self) -> Cell {
        self.first_cell
    }

    /// Σ of the field's bytes at the points' cells.
    #[must_use]
    pub fn score(&self, points: &Points, pose: WindowPose) -> u32 {
        let mut score = 0;
        self.for_each_value(points, pose, |value| score += u32::from(value));
        score
    }

    /// Calls `take` with the field's byte at each point's cell, in order.
    pub fn for_each_value(&self, points: &Points, pose: WindowPose, mut take: impl FnMut(u8)) {
        let [cos, sin] = pose.rotation;
        // Rounding to nearest after taking half a cell away is rounding down.
        let (x0, y0) = ((pose.x - 0.5) as f32, (pose.y - 0.5) as f32);
        let mut cells = [0_u32; BLOCK];
        for (xs, ys) in points.x.chunks(BLOCK).zip(points.y.chunks(BLOCK)) {
            for ((cell, x), y) in cells.iter_mut().zip(xs).zip(ys) {
                let column = (cos * x - sin * y + x0 + ROUND).to_bits();
                let row = (sin * x + cos * y + y0 + ROUND).to_bits();
                *cell = self.index(column, row);
            }
            for &cell in &cells[..xs.len()] {
                take(self.value(cell));
            }
        }
    }

    /// Tile and cell of a column and a row, which may carry other bits above the window's.
    #[inline(always)]
    fn index(&self, column: u32, row: u32) -> u32 {
        let tile_column = (column >> 5) & ((1 << self.width_shift) - 1);
        let tile_row = (row >> 5) & 0x1_ffff;
        (((tile_row << self.width_shift) | tile_column) << 10)
            | ((row & CELL) << 5)
            | (column & CELL)
    }

    #[inline(always)]
    fn value(&self, index: u32) -> u8 {
        let tile = self.tiles.get((index >> 10) as usize).copied().unwrap_or(EMPTY);
        tile[index as usize & (TILE_CELLS - 1)]
    }

    /// The bytes of a cell and its neighbours right, above, and right above.
    #[inline(always)]
    fn values_around(&self, column: u32, row: u32) -> [u8; 4] {
        let index = self.index(column, row);
        let inner = index as usize & (TILE_CELLS - 1);
        if column & CELL < CELL && row & CELL < CELL {
            let tile = self.tiles.get((index >> 10) as usize).copied().unwrap_or(EMPTY);
            let upper = (inner + TILE_SIZE).min(TILE_CELLS - 2);
            [tile[inner], tile[inner + 1], tile[upper], tile[upper + 1]]
        } else {
            let (right, above) = (column.wrapping_add(1), row.wrapping_add(1));
            [(column, row), (right, row), (column, above), (right, above)]
                .map(|(column, row)| self.value(self.index(column, row)))
        }
    }

    /// Value and derivatives of the bilinearly interpolated field at the points, summed up.
    ///
    /// The derivatives are those of the interpolation (the original Hector weights the
    /// differences along x with the fraction along x; they belong to the fraction along y).
    #[must_use]
    pub fn linearize(&self, points: &Points, pose: WindowPose) -> Linearization {
        let [cos, sin] = pose.rotation;
        // Values belong to cell centres, half a cell from the corner, and rounding to nearest
        // after taking half a cell away is rounding down.
        let (x0, y0) = ((pose.x - 1.0) as f32, (pose.y - 1.0) as f32);
        let mut sums = Sums::default();
        let mut block = Block::default();
        for (xs, ys) in points.x.chunks(BLOCK).zip(points.y.chunks(BLOCK)) {
            block.corners.iter_mut().for_each(|corner| corner[xs.len()..].fill(0.0));
            for (i, (x, y)) in xs.iter().zip(ys).enumerate() {
                let (dx, dy) = (cos * x - sin * y, sin * x + cos * y);
                let (column, row) = (dx + x0 + ROUND, dy + y0 + ROUND);
                block.arm_x[i] = dx;
                block.arm_y[i] = dy;
                block.column[i] = column.to_bits();
                block.row[i] = row.to_bits();
                block.fraction_x[i] = (dx + x0) - (column - ROUND) + 0.5;
                block.fraction_y[i] = (dy + y0) - (row - ROUND) + 0.5;
            }
            for i in 0..xs.len() {
                let values = self.values_around(block.column[i], block.row[i]);
                for (corner, value) in block.corners.iter_mut().zip(values) {
                    corner[i] = f32::from(value) * (1.0 / 255.0);
                }
            }
            sums.add(&block);
        }
        sums.total(points.len())
    }
}

/// What [`Window::linearize`] knows of each point of a block.
struct Block {
    column: [u32; BLOCK],
    row: [u32; BLOCK],
    fraction_x: [f32; BLOCK],
    fraction_y: [f32; BLOCK],
    /// From the base to the point, in the directions of the map's axes.
    arm_x: [f32; BLOCK],
    arm_y: [f32; BLOCK],
    /// Left below, right below, left above, right above; zero past the last point.
    corners: [[f32; BLOCK]; 4],
}

impl Default for Block {
    fn default() -> Self {
        let zero = [0.0; BLOCK];
        Self {
            column: [0; BLOCK],
            row: [0; BLOCK],
            fraction_x: zero,
            fraction_y: zero,
            arm_x: zero,
            arm_y: zero,
            corners: [zero; 4],
        }
    }
}

/// Lane-wise sums: Σm(2 - m), then information and gradient as in [`Linearization`].
#[derive(Default)]
struct Sums([[f32; LANES]; 10]);

impl Sums {
    #[inline(always)]
    fn add(&mut self, block: &Block) {
        for start in (0..BLOCK).step_by(LANES) {
            for lane in 0..LANES {
                let i = start + lane;
                let [m00, m10, m01, m11] = [0, 1, 2, 3].map(|corner| block.corners[corner][i]);
                let (fx, fy) = (block.fraction_x[i], block.fraction_y[i]);
                let (below, above) = (m00 + fx * (m10 - m00), m01 + fx * (m11 - m01));
                let m = below + fy * (above - below);
                let (left, right) = (m01 - m00, m11 - m10);
                let jx = (m10 - m00) + fy * (right - left);
                let jy = left + fx * (right - left);
                let jt = block.arm_x[i] * jy - block.arm_y[i] * jx;
                let e = 1.0 - m;
                let terms = [m * (2.0 - m), jx * jx, jx * jy, jx * jt, jy * jy, jy * jt, jt * jt];
                for (sum, term) in self.0.iter_mut().zip(terms) {
                    sum[lane] += term;
                }
                for (sum, j) in self.0[7..].iter_mut().zip([jx, jy, jt]) {
                    sum[lane] += j * e;
                }
            }
        }
    }

    fn total(self, points: usize) -> Linearization {
        let [fit, xx, xy, xt, yy, yt, tt, gx, gy, gt] = self.0.map(|lanes| lanes.iter().sum());
        let fit: f32 = fit;
        Linearization {
            cost: points as f32 - fit,
            information: [xx, xy, xt, yy, yt, tt],
            gradient: [gx, gy, gt],
        }
    }
}

/// The bytes around a hit, for each of its positions within a cell.
#[derive(Debug, Clone)]
pub struct Kernel {
    radius: i32,
    /// Bytes from one row of a stamp to the next.
    stride: usize,
    /// For each phase, rows of `2 * radius + 1` bytes, bottom first, each between zeros as wide
    /// as a tile: however a stamp lies over a tile, each of its rows is as long as the tile's.
    stamps: Vec<Vec<u8>>,
    /// For each phase, from which value on a cell has nothing to learn from a hit in it.
    known: Vec<u8>,
}

/// A hit to stamp: its cell, and where in the cell it lies.
#[derive(Debug, Clone, Copy)]
struct Stamp {
    hit: Cell,
    phase: usize,
}

impl Kernel {
    /// A kernel of standard deviation `sigma`, in cells.
    #[must_use]
    pub fn new(sigma: f64) -> Self {
        let radius = floor(3.0 * sigma) + 1;
        let phase = |p: usize| (p as f64 + 0.5) / PHASES as f64;
        let stamps = (0..PHASES * PHASES).map(|p| {
            let (hit_x, hit_y) = (phase(p % PHASES), phase(p / PHASES));
            let value = |dx: i32, dy: i32| {
                let (x, y) = (f64::from(dx) + 0.5 - hit_x, f64::from(dy) + 0.5 - hit_y);
                libm::round(255.0 * libm::exp(-0.5 * (x * x + y * y) / (sigma * sigma))) as u8
            };
            let row = |dy| {
                let values = (-radius..=radius).map(move |dx| value(dx, dy));
                let zeros = [0; TILE_SIZE];
                zeros.into_iter().chain(values).chain(zeros)
            };
            let stamp: Vec<u8> = (-radius..=radius).flat_map(row).collect();
            (stamp, value(0, 0).saturating_sub(KNOWN_WITHIN))
        });
        let (stamps, known) = stamps.unzip();
        let stride = 2 * TILE_SIZE + 2 * radius as usize + 1;
        Self { radius, stride, stamps, known }
    }

    /// Enters hits seen from `pose`, which is relative to the lower-left corner of `origin`.
    ///
    /// Hits in cells that already are near a hit change nothing, and copy no tile.
    pub fn insert(&self, field: &mut TileMap<u8>, origin: Cell, hits: &Points, pose: WindowPose) {
        let stamps = self.unknown(field, origin, hits, pose);
        let mut by_tile = Vec::with_capacity(2 * stamps.len());
        for stamp in &stamps {
            let corner = |sign| {
                let reach = sign * self.radius;
                TileKey::containing(Cell::new(stamp.hit.ix + reach, stamp.hit.iy + reach))
            };
            let (first, last) = (corner(-1), corner(1));
            for ty in first.ty..=last.ty {
                by_tile.extend((first.tx..=last.tx).map(|tx| (TileKey { ty, tx }, *stamp)));
            }
        }
        by_tile.sort_unstable_by_key(|(key, _)| *key);
        for group in by_tile.chunk_by(|a, b| a.0 == b.0) {
            let key = group[0].0;
            let tile = field.tile_mut(key);
            for (_, stamp) in group {
                self.stamp(tile, key.first_cell(), *stamp);
            }
        }
    }

    /// The hits that the field has something to learn from.
    fn unknown(
        &self,
        field: &TileMap<u8>,
        origin: Cell,
        hits: &Points,
        pose: WindowPose,
    ) -> Vec<Stamp> {
        let [cos, sin] = pose.rotation;
        let (x0, y0) = ((pose.x - 0.5) as f32, (pose.y - 0.5) as f32);
        let mut tile = (TileKey::containing(origin), field.tile(TileKey::containing(origin)));
        let mut stamps = Vec::new();
        let (mut x_in_cells, mut y_in_cells) = ([0.0; BLOCK], [0.0; BLOCK]);
        let mut cells = [Cell::new(0, 0); BLOCK];
        for (xs, ys) in hits.x.chunks(BLOCK).zip(hits.y.chunks(BLOCK)) {
            for (i, (x, y)) in xs.iter().zip(ys).enumerate() {
                x_in_cells[i] = cos * x - sin * y + x0;
                y_in_cells[i] = sin * x + cos * y + y0;
                cells[i].ix = nearest_integer(x_in_cells[i]);
                cells[i].iy = nearest_integer(y_in_cells[i]);
            }
            for (i, cell) in cells[..xs.len()].iter().enumerate() {
                let hit = Cell::new(origin.ix + cell.ix, origin.iy + cell.iy);
                let key = TileKey::containing(hit);
                if tile.0 != key {
                    tile = (key, field.tile(key));
                }
                let column = phase(x_in_cells[i] - cell.ix as f32 + 0.5);
                let row = phase(y_in_cells[i] - cell.iy as f32 + 0.5);
                let phase = row * PHASES + column;
                let value = tile.1.map_or(0, |tile| tile[index_in_tile(hit)]);
                if value < self.known[phase] {
                    stamps.push(Stamp { hit, phase });
                }
            }
        }
        stamps
    }

    /// Raises the cells of one tile to the stamp's values.
    fn stamp(&self, tile: &mut Tile<u8>, first: Cell, Stamp { hit, phase }: Stamp) {
        let (size, side) = (TILE_SIZE as i32, 2 * self.radius + 1);
        let (left, bottom) = (hit.ix - self.radius - first.ix, hit.iy - self.radius - first.iy);
        let (start, end) = (bottom.max(0), (bottom + side).min(size));
        let rows = &mut tile[start as usize * TILE_SIZE..end as usize * TILE_SIZE];
        let stamp = &self.stamps[phase][(start - bottom) as usize * self.stride..];
        let from = (size - left) as usize;
        let (rows, _) = rows.as_chunks_mut::<TILE_SIZE>();
        for (cells, values) in rows.iter_mut().zip(stamp.chunks_exact(self.stride)) {
            if let Some(values) = values[from..].first_chunk::<TILE_SIZE>() {
                raise(cells, values);
            }
        }
    }
}

/// Raises each cell to its new value. A call of its own, so that it becomes vector instructions.
#[inline(never)]
fn raise(cells: &mut [u8; TILE_SIZE], values: &[u8; TILE_SIZE]) {
    for (cell, value) in cells.iter_mut().zip(values) {
        *cell = (*cell).max(*value);
    }
}

/// The nearest integer to a float in (-2^22, 2^22), by instructions that every machine has.
#[inline(always)]
fn nearest_integer(value: f32) -> i32 {
    (value + ROUND).to_bits().wrapping_sub(ROUND.to_bits()) as i32
}

/// Which of the tabulated positions within a cell a fraction of it is nearest to.
fn phase(fraction: f32) -> usize {
    ((fraction * PHASES as f32) as usize).min(PHASES - 1)
}
