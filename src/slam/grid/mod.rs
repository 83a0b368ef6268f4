//! Grids of square cells without bounds: copy-on-write tiles, and what is kept in them.

pub mod likelihood_field;
pub mod occupancy;
pub mod tile_map;

use super::pose::Point2;

/// A square of the plane: cell (0, 0) has its lower-left corner at the frame's origin.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Cell {
    /// Column: the cell covers `ix * resolution ..= (ix + 1) * resolution` in x.
    pub ix: i32,
    /// Row, likewise in y.
    pub iy: i32,
}

impl Cell {
    /// The cell (column, row).
    #[must_use]
    pub const fn new(ix: i32, iy: i32) -> Self {
        Self { ix, iy }
    }

    /// The cell that contains `point`, for cells of `resolution` metres.
    #[must_use]
    pub fn containing(point: Point2, resolution: f64) -> Self {
        Self::new(
            libm::floor(point.x / resolution) as i32,
            libm::floor(point.y / resolution) as i32,
        )
    }
}
