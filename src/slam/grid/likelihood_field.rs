//! The likelihood field: for each cell, how near the nearest hit of the map is, in four bits.
//!
//! A cell's level is `15 * exp(-d^2 / (2 sigma^2))` for the distance d from its centre to the
//! nearest hit. It is kept up to date by stamping a small kernel around each new hit and keeping
//! the maximum, so that a beam is evaluated with one look-up where the original searched nine
//! cells and their means. Sixteen levels match as well as 256 do (`docs/tuning.md`), and fields
//! are what the particles' memory goes to.

use super::Cell;
use super::tile_map::{TILE_CELLS, TILE_SIZE, Tile, TileKey, TileMap, index_in_tile};

/// The level of a cell with a hit in its centre.
pub const FULL: u8 = 15;

/// Sub-cell positions a kernel is tabulated for, along each axis.
const PHASES: usize = 8;
/// Beams whose cells are computed together before they are looked up.
const BLOCK: usize = 64;
/// Lanes of the floating-point sums; fixed, so that sums are the same on every machine.
const LANES: usize = 8;
/// Adding this to a float in (-2^22, 2^22) leaves its nearest integer in the low mantissa bits.
const ROUND: f32 = 12_582_912.0;
/// Tiles are `1 << TILE_COLUMNS` cells wide and `1 << TILE_ROWS` high.
const TILE_COLUMNS: u32 = TILE_ROWS + 1;
const TILE_ROWS: u32 = TILE_SIZE.trailing_zeros();
/// The bits of a column, of a row and of an index that say where in its tile it is.
const COLUMN: u32 = (1 << TILE_COLUMNS) - 1;
const ROW: u32 = (1 << TILE_ROWS) - 1;
const CELL: usize = (1 << (TILE_COLUMNS + TILE_ROWS)) - 1;
/// Where four levels lie in one word: left, right, left above, right above.
const CORNERS: [u32; 4] = [0, 4, 16, 20];
const EMPTY: &Tile<u8> = &[0; TILE_CELLS];

/// The likelihood field of a map. A clone shares every tile with its original until one of the
/// two writes to it.
#[derive(Debug, Clone, Default)]
pub struct LikelihoodField {
    /// Two cells a byte: that of the even column in the lower bits.
    pairs: TileMap<u8>,
}

impl LikelihoodField {
    /// A field without hits.
    #[must_use]
    pub const fn new() -> Self {
        Self { pairs: TileMap::new() }
    }

    /// The field with these tiles.
    pub(in super::super) const fn of_tiles(pairs: TileMap<u8>) -> Self {
        Self { pairs }
    }

    /// The level of one cell, from 0 to [`FULL`].
    #[must_use]
    pub fn get(&self, cell: Cell) -> u8 {
        level(self.pairs.get(pair(cell)), cell.ix as u32)
    }

    /// Its tiles, for counting them.
    #[must_use]
    pub const fn tiles(&self) -> &TileMap<u8> {
        &self.pairs
    }
}

/// Where the pair of a cell is among the pairs.
const fn pair(cell: Cell) -> Cell {
    Cell::new(cell.ix >> 1, cell.iy)
}

/// The level in a pair of the cell in `column`.
#[inline(always)]
const fn level(pair: u8, column: u32) -> u8 {
    (pair >> ((column & 1) * 4)) & FULL
}

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
    pub fn around(field: &'a LikelihoodField, centre: Cell, radius: i32) -> Self {
        let first = tile_of(Cell::new(centre.ix - radius, centre.iy - radius));
        let last = tile_of(Cell::new(centre.ix + radius, centre.iy + radius));
        let width = (last.tx - first.tx + 1) as usize;
        let height = (last.ty - first.ty + 1) as usize;
        let width_shift = width.next_power_of_two().trailing_zeros();
        let mut tiles = vec![EMPTY; height << width_shift];
        for (key, tile) in field.pairs.tiles_between(first, last) {
            let row = (key.ty - first.ty) as usize;
            tiles[(row << width_shift) + (key.tx - first.tx) as usize] = tile;
        }
        Self { first_cell: first_cell(first), width_shift, tiles }
    }

    /// The cell at the window's lower-left corner.
    #[must_use]
    pub const fn first_cell(&self) -> Cell {
        self.first_cell
    }

    /// Σ of the field's levels at the points' cells.
    #[must_use]
    pub fn score(&self, points: &Points, pose: WindowPose) -> u32 {
        let mut score = 0;
        self.for_each_value(points, pose, |value| score += u32::from(value));
        score
    }

    /// Calls `take` with the field's level at each point's cell, in order.
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
        let tile_column = (column >> TILE_COLUMNS) & ((1 << self.width_shift) - 1);
        let tile_row = (row >> TILE_ROWS) & (0x3f_ffff >> TILE_ROWS);
        let tile = (tile_row << self.width_shift) | tile_column;
        (((tile << TILE_ROWS) | (row & ROW)) << TILE_COLUMNS) | (column & COLUMN)
    }

    #[inline(always)]
    fn tile(&self, index: u32) -> &Tile<u8> {
        self.tiles.get((index >> (TILE_COLUMNS + TILE_ROWS)) as usize).copied().unwrap_or(EMPTY)
    }

    #[inline(always)]
    fn value(&self, index: u32) -> u8 {
        level(self.tile(index)[(index as usize & CELL) / 2], index)
    }

    /// The levels of a cell and its neighbours right, above, and right above, at the bits of
    /// [`CORNERS`].
    #[inline(always)]
    fn levels_around(&self, column: u32, row: u32) -> u32 {
        if column & COLUMN < COLUMN && row & ROW < ROW {
            let index = self.index(column, row);
            let tile = self.tile(index);
            let pair = (index as usize & CELL) / 2;
            let pairs = [pair, pair + 1, pair + TILE_SIZE, pair + TILE_SIZE + 1];
            u32::from_le_bytes(pairs.map(|pair| tile[pair % TILE_CELLS])) >> ((column & 1) * 4)
        } else {
            let (right, above) = (column.wrapping_add(1), row.wrapping_add(1));
            [(column, row), (right, row), (column, above), (right, above)]
                .map(|(column, row)| u32::from(self.value(self.index(column, row))))
                .into_iter()
                .zip(CORNERS)
                .fold(0, |levels, (level, bit)| levels | (level << bit))
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
            block.levels[xs.len()..].fill(0);
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
                block.levels[i] = self.levels_around(block.column[i], block.row[i]);
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
    /// As [`Window::levels_around`] packs them; zero past the last point.
    levels: [u32; BLOCK],
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
            levels: [0; BLOCK],
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
                let [m00, m10, m01, m11] = CORNERS.map(|bit| {
                    ((block.levels[i] >> bit) & u32::from(FULL)) as i32 as f32 * (1.0 / FULL as f32)
                });
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

/// The tile that holds a cell.
const fn tile_of(cell: Cell) -> TileKey {
    TileKey::containing(pair(cell))
}

/// The lower-left cell of a tile.
const fn first_cell(tile: TileKey) -> Cell {
    let pair = tile.first_cell();
    Cell::new(pair.ix << 1, pair.iy)
}

/// The levels around a hit, for each of its positions within a cell.
#[derive(Debug, Clone)]
pub struct Kernel {
    radius: i32,
    /// Bytes from one row of a stamp to the next.
    stride: usize,
    /// For each phase, a stamp that begins in an even column and one that begins in an odd one:
    /// rows of pairs, bottom first, each between zeros as wide as a tile. However a stamp lies
    /// over a tile, each of its rows is as long as the tile's.
    stamps: Vec<[Vec<u8>; 2]>,
    /// For each phase, the level of the hit's own cell: one that has it learns nothing from the
    /// hit.
    centres: Vec<u8>,
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
        // A cell further away than this has a level below a half.
        let reach = sigma * libm::sqrt(2.0 * libm::log(2.0 * f64::from(FULL)));
        let radius = libm::ceil(reach - 0.5).max(1.0) as i32;
        let position = |p: usize| (p as f64 + 0.5) / PHASES as f64;
        let (mut stamps, mut centres) = (Vec::new(), Vec::new());
        for phase in 0..PHASES * PHASES {
            let hit = [position(phase % PHASES), position(phase / PHASES)];
            let level = |dx: i32, dy: i32| {
                if dx.abs() > radius {
                    return 0;
                }
                let (x, y) = (f64::from(dx) + 0.5 - hit[0], f64::from(dy) + 0.5 - hit[1]);
                let share = libm::exp(-0.5 * (x * x + y * y) / (sigma * sigma));
                libm::round(f64::from(FULL) * share) as u8
            };
            centres.push(level(0, 0));
            stamps.push([0, 1].map(|parity| {
                let row = |dy| {
                    let first = -radius - parity;
                    let pairs = (0..=radius).map(move |i| first + 2 * i);
                    let pairs = pairs.map(move |dx| level(dx, dy) | (level(dx + 1, dy) << 4));
                    let zeros = [0; TILE_SIZE];
                    zeros.into_iter().chain(pairs).chain(zeros)
                };
                (-radius..=radius).flat_map(row).collect()
            }));
        }
        Self { radius, stride: 2 * TILE_SIZE + radius as usize + 1, stamps, centres }
    }

    /// Enters hits seen from `pose`, which is relative to the lower-left corner of `origin`.
    ///
    /// Hits in cells that already are near a hit change nothing, and copy no tile.
    pub fn insert(
        &self,
        field: &mut LikelihoodField,
        origin: Cell,
        hits: &Points,
        pose: WindowPose,
    ) {
        let stamps = self.unknown(field, origin, hits, pose);
        let mut by_tile = Vec::with_capacity(2 * stamps.len());
        for stamp in &stamps {
            let corner = |sign| {
                let reach = sign * self.radius;
                tile_of(Cell::new(stamp.hit.ix + reach, stamp.hit.iy + reach))
            };
            let (first, last) = (corner(-1), corner(1));
            for ty in first.ty..=last.ty {
                by_tile.extend((first.tx..=last.tx).map(|tx| (TileKey { ty, tx }, *stamp)));
            }
        }
        by_tile.sort_unstable_by_key(|(key, _)| *key);
        for group in by_tile.chunk_by(|a, b| a.0 == b.0) {
            let key = group[0].0;
            let tile = field.pairs.tile_mut(key);
            for (_, stamp) in group {
                self.stamp(tile, first_cell(key), *stamp);
            }
        }
    }

    /// The hits that the field has something to learn from.
    fn unknown(
        &self,
        field: &LikelihoodField,
        origin: Cell,
        hits: &Points,
        pose: WindowPose,
    ) -> Vec<Stamp> {
        let [cos, sin] = pose.rotation;
        let (x0, y0) = ((pose.x - 0.5) as f32, (pose.y - 0.5) as f32);
        let mut tile = (tile_of(origin), field.pairs.tile(tile_of(origin)));
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
                let key = tile_of(hit);
                if tile.0 != key {
                    tile = (key, field.pairs.tile(key));
                }
                let column = phase(x_in_cells[i] - cell.ix as f32 + 0.5);
                let row = phase(y_in_cells[i] - cell.iy as f32 + 0.5);
                let phase = row * PHASES + column;
                let pair = tile.1.map_or(0, |tile| tile[index_in_tile(pair(hit))]);
                if level(pair, hit.ix as u32) < self.centres[phase] {
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
        let stamp = &self.stamps[phase][(left & 1) as usize];
        let stamp = &stamp[(start - bottom) as usize * self.stride..];
        let from = (size - (left >> 1)) as usize;
        let (rows, _) = rows.as_chunks_mut::<TILE_SIZE>();
        for (pairs, levels) in rows.iter_mut().zip(stamp.chunks_exact(self.stride)) {
            if let Some(levels) = levels[from..].first_chunk::<TILE_SIZE>() {
                raise(pairs, levels);
            }
        }
    }
}

/// Raises each cell to its new level. A call of its own, so that it becomes vector instructions.
#[inline(never)]
fn raise(pairs: &mut [u8; TILE_SIZE], levels: &[u8; TILE_SIZE]) {
    const ODD: u8 = FULL << 4;
    for (pair, level) in pairs.iter_mut().zip(levels) {
        *pair = (*pair & FULL).max(level & FULL) | (*pair & ODD).max(level & ODD);
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
