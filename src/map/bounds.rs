//! The part of a map that is known.

use crate::slam::grid::occupancy::OccupancyGrid;

/// The columns and rows that hold every known cell; empty ranges when none is known.
pub(super) fn known_bounds(grid: &OccupancyGrid) -> [std::ops::Range<usize>; 2] {
    let known = |row: &[i8]| row.iter().any(|&cell| cell >= 0);
    let mut rows = 0..0;
    let mut columns = 0..0;
    for (iy, row) in grid.cells.chunks_exact(grid.width.max(1)).enumerate() {
        if !known(row) {
            continue;
        }
        rows = if rows.is_empty() { iy..iy + 1 } else { rows.start..iy + 1 };
        let first = row.iter().position(|&cell| cell >= 0).unwrap_or(0);
        let last = row.iter().rposition(|&cell| cell >= 0).unwrap_or(0);
        columns = if columns.is_empty() {
            first..last + 1
        } else {
            columns.start.min(first)..columns.end.max(last + 1)
        };
    }
    [columns, rows]
}
