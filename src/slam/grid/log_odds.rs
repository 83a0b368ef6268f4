//! A map of log-odds: ln(p / (1 - p)) of each cell being occupied, by Bayes' rule.
//!
//! A scan counts each cell once, and an obstacle beats free space within a scan. The log-odds are
//! clamped on both sides, so that a cell turns as quickly from free to occupied as back; the
//! original of Hector has no lower clamp.

use serde::{Deserialize, Serialize};

use super::super::pose::Point2;
use super::Cell;
use super::footprint::Seen;
use super::tile_map::{TILE_SIZE, TileKey, TileMap};

/// Steps of the fixed-point log-odds in a nat.
const STEPS: f64 = 4096.0;
/// Log-odds stay within this, nats: p from 0.018 to 0.982.
pub const CLAMP: f64 = 4.0;
/// Of a cell that is known from a map: 3 nats, p = 0.95 or 0.05.
const KNOWN: i16 = (3.0 * STEPS) as i16;
const LIMIT: i16 = (CLAMP * STEPS) as i16;

/// ln(p / (1 - p)) in steps of 1/4096; 0 is unknown.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "i16")]
pub struct LogOdds(i16);

impl From<i16> for LogOdds {
    /// So many steps, clamped.
    fn from(steps: i16) -> Self {
        Self(steps.clamp(-LIMIT, LIMIT))
    }
}

impl LogOdds {
    /// The log-odds of the probability `p`, above 0 and below 1, clamped.
    #[must_use]
    pub fn of_probability(p: f64) -> Self {
        let steps = libm::round(libm::log(p / (1.0 - p)) * STEPS);
        Self(steps.clamp(f64::from(-LIMIT), f64::from(LIMIT)) as i16)
    }

    /// Nats.
    #[must_use]
    pub fn nats(self) -> f64 {
        f64::from(self.0) / STEPS
    }

    /// What both know together, clamped.
    #[inline]
    #[must_use]
    pub fn and(self, other: Self) -> Self {
        Self(self.0.saturating_add(other.0).clamp(-LIMIT, LIMIT))
    }

    /// -1 unknown, 0 free, 1 occupied, as the original publishes it.
    #[must_use]
    pub const fn sign(self) -> i16 {
        self.0.signum()
    }

    /// Where [`Probabilities`] has it.
    #[inline]
    const fn index(self) -> usize {
        ((self.0 as u16 ^ 0x8000) >> 4) as usize
    }
}

/// The probability that each value of the log-odds stands for, to look up.
#[derive(Debug, Clone)]
pub struct Probabilities(Box<[f32; 4096]>);

impl Default for Probabilities {
    fn default() -> Self {
        let mut table = Box::new([0.5; 4096]);
        for (index, p) in table.iter_mut().enumerate() {
            // The middle of the sixteen values that share an entry; exact for unknown cells.
            let nats = (index as f64 - 2048.0) * 16.0 / STEPS;
            *p = (1.0 / (1.0 + libm::exp(-nats))) as f32;
        }
        Self(table)
    }
}

impl Probabilities {
    /// The probability of being occupied, to 0.001.
    #[inline]
    #[must_use]
    pub fn of(&self, log_odds: LogOdds) -> f32 {
        self.0[log_odds.index()]
    }
}

/// What a scan says of a cell.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Evidence {
    /// Of a cell that a beam passed.
    pub free: LogOdds,
    /// Of a cell that a beam ended in.
    pub occupied: LogOdds,
}

impl Evidence {
    /// Enters a row of a tile that a scan saw, as bits of its columns.
    ///
    /// Evidence of 0 leaves a cell as it is; so all cells of the row are treated alike, at once.
    fn enter(self, row: &mut [LogOdds; TILE_SIZE], free: u16, hit: u16) {
        if free | hit == 0 {
            return;
        }
        if free == u16::MAX {
            return row.iter_mut().for_each(|value| *value = value.and(self.free));
        }
        for (column, value) in row.iter_mut().enumerate() {
            let bit = 1_u16 << column;
            let free = if free & bit == 0 { 0 } else { self.free.0 };
            let hit = if hit & bit == 0 { 0 } else { self.occupied.0 };
            *value = value.and(LogOdds(free | hit));
        }
    }
}

/// Log-odds over the plane, for cells of one size.
#[derive(Debug, Clone)]
pub struct LogOddsMap {
    resolution: f64,
    cells: TileMap<LogOdds>,
}

impl LogOddsMap {
    /// An unknown world in cells of `resolution` metres.
    #[must_use]
    pub fn new(resolution: f64) -> Self {
        Self::of_cells(resolution, TileMap::new())
    }

    /// The map with these cells.
    pub(in super::super) fn of_cells(resolution: f64, cells: TileMap<LogOdds>) -> Self {
        Self { resolution, cells }
    }

    /// Metres a cell.
    #[must_use]
    pub const fn resolution(&self) -> f64 {
        self.resolution
    }

    /// The cells.
    #[must_use]
    pub const fn cells(&self) -> &TileMap<LogOdds> {
        &self.cells
    }

    /// Enters what a scan saw of each tile.
    pub fn add(&mut self, tiles: &[(TileKey, Seen)], evidence: Evidence) {
        for (key, seen) in tiles {
            let tile = self.cells.tile_mut(*key);
            if seen.free == [u16::MAX; TILE_SIZE] {
                tile.iter_mut().for_each(|value| *value = value.and(evidence.free));
                continue;
            }
            let (rows, _) = tile.as_chunks_mut::<TILE_SIZE>();
            for ((row, free), hit) in rows.iter_mut().zip(&seen.free).zip(&seen.hit) {
                evidence.enter(row, *free, *hit);
            }
        }
    }

    /// Takes a cell as occupied, at least in part.
    pub fn know_occupied(&mut self, cell: Cell) {
        *self.cells.get_mut(cell) = LogOdds(KNOWN);
    }

    /// Takes a cell as free, if no part of it is occupied.
    pub fn know_free(&mut self, cell: Cell) {
        let value = self.cells.get_mut(cell);
        if value.sign() <= 0 {
            *value = LogOdds(-KNOWN);
        }
    }

    /// The log-odds at a point of the map.
    #[must_use]
    pub fn at(&self, point_in_map: Point2) -> LogOdds {
        self.cells.get(Cell::containing(point_in_map, self.resolution))
    }
}
