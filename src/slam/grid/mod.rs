//! Grids of square cells without bounds: copy-on-write tiles, and what is kept in them.

pub mod footprint;
pub mod hit_map;
pub mod likelihood_field;
pub mod log_odds;
pub mod occupancy;
pub mod tile_map;

use super::pose::Point2;

/// A square of the plane: cell (0, 0) has its lower-left corner at the frame's origin.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Cell {
    /// Column: the cell covers `ix * resolution .. (ix + 1) * resolution` in x.
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
        Self::new(floor(point.x / resolution), floor(point.y / resolution))
    }
}

/// The greatest integer not above `value`, saturating; without a call into a maths library.
#[inline]
#[must_use]
pub fn floor(value: f64) -> i32 {
    let truncated = value as i32;
    truncated.saturating_sub(i32::from(f64::from(truncated) > value))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_meet_at_their_lower_left_corners() {
        let cell = |x, y| Cell::containing(Point2::new(x, y), 0.5);
        assert_eq!(cell(0.0, 0.0), Cell::new(0, 0));
        assert_eq!(cell(0.49, -0.01), Cell::new(0, -1));
        assert_eq!(cell(-0.5, 1.0), Cell::new(-1, 2));
        assert_eq!(cell(-0.51, 1e300), Cell::new(-2, i32::MAX));
    }
}
