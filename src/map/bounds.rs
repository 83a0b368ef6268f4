//! The part of a map that is worth showing.

use std::ops::Range;

use crate::slam::grid::occupancy::OccupancyGrid;

/// Cells shown around free space: the walls.
const WALL: usize = 4;

/// The columns and rows of the free cells and of the walls around them; of all known cells if none
/// is free, and empty ranges when none is known.
///
/// Single far readings leave hits with nothing free around them; shown whole, such a map is mostly
/// empty.
pub(super) fn shown_bounds(grid: &OccupancyGrid) -> [Range<usize>; 2] {
    let [columns, rows] = bounds_where(grid, |cell| cell >= 0);
    let [free_columns, free_rows] = bounds_where(grid, |cell| cell == 0);
    if free_rows.is_empty() {
        return [columns, rows];
    }
    let with_walls = |free: Range<usize>, known: Range<usize>| {
        free.start.saturating_sub(WALL).max(known.start)..(free.end + WALL).min(known.end)
    };
    [with_walls(free_columns, columns), with_walls(free_rows, rows)]
}

fn bounds_where(grid: &OccupancyGrid, wanted: impl Fn(i8) -> bool) -> [Range<usize>; 2] {
    let (mut rows, mut columns) = (0..0, 0..0);
    for (iy, row) in grid.cells.chunks_exact(grid.width.max(1)).enumerate() {
        let Some(first) = row.iter().position(|&cell| wanted(cell)) else { continue };
        let last = row.iter().rposition(|&cell| wanted(cell)).unwrap_or(first);
        if rows.is_empty() {
            (rows, columns) = (iy..iy + 1, first..last + 1);
        } else {
            rows.end = iy + 1;
            columns = columns.start.min(first)..columns.end.max(last + 1);
        }
    }
    [columns, rows]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::pose::Point2;

    fn grid(rows: [[i8; 12]; 8]) -> OccupancyGrid {
        let cells = rows.into_iter().flatten().collect();
        let origin = Point2::new(0.0, 0.0);
        OccupancyGrid { resolution: 0.05, width: 12, height: 8, origin, cells }
    }

    #[test]
    fn a_lone_far_hit_does_not_widen_the_picture() {
        let mut rows = [[-1; 12]; 8];
        rows[1][1] = 0;
        rows[2][2] = 0;
        rows[7][11] = 100;
        assert_eq!(shown_bounds(&grid(rows)), [1..7, 1..7]);
    }

    #[test]
    fn without_free_space_all_that_is_known_is_shown() {
        let mut rows = [[-1; 12]; 8];
        assert_eq!(shown_bounds(&grid(rows)), [0..0, 0..0]);
        rows[3][4] = 100;
        rows[5][2] = 100;
        assert_eq!(shown_bounds(&grid(rows)), [2..5, 3..6]);
    }
}
