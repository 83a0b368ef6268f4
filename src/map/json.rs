//! The map as JSON, for programs without ROS.

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::slam::grid::occupancy::OccupancyGrid;
use crate::slam::pose::Point2;

/// Cells beyond which a map is not believed: 1.6 km by 1.6 km at 5 cm.
const MOST_CELLS: usize = 1 << 30;

#[derive(Serialize, Deserialize)]
struct Map {
    resolution: f64,
    width: usize,
    height: usize,
    origin: [f64; 2],
    runs: Vec<Run>,
}

/// A value and how many cells in succession have it.
#[derive(Serialize, Deserialize)]
struct Run(i8, usize);

/// The map as JSON.
///
/// `resolution` is metres a cell, `origin` the x and y of the lower-left corner, m. The cells
/// come as `runs`: pairs of a value (-1 unknown, 0 free, 100 occupied) and how many cells in
/// succession have it, row by row from the lowest y, and across the ends of rows. In Python:
/// `cells = [value for value, count in map["runs"] for _ in range(count)]`.
#[must_use]
pub fn json(grid: &OccupancyGrid) -> String {
    let runs = grid.cells.chunk_by(|a, b| a == b);
    let map = Map {
        resolution: grid.resolution,
        width: grid.width,
        height: grid.height,
        origin: [grid.origin.x, grid.origin.y],
        runs: runs.map(|run| Run(run[0], run.len())).collect(),
    };
    serde_json::to_string(&map).expect("memory takes every write, and every key is a string")
}

/// Why text is not a map.
#[derive(Debug, Error)]
pub enum NotAMap {
    /// Not JSON, or not with these fields.
    #[error("it is not a map as JSON")]
    Json(#[from] serde_json::Error),
    /// The cells are not as many as width and height say.
    #[error("{width} by {height} cells are told, and {cells} are there")]
    Cells {
        /// Cells a row.
        width: usize,
        /// Rows.
        height: usize,
        /// Cells that the runs add up to.
        cells: usize,
    },
}

/// Reads what [`json`] writes; other fields are passed over.
///
/// # Errors
/// When it is no such map; memory grows only when all its figures agree.
pub fn parse_json(text: &[u8]) -> Result<OccupancyGrid, NotAMap> {
    let Map { resolution, width, height, origin: [x, y], runs } = serde_json::from_slice(text)?;
    let cells = runs.iter().fold(0_usize, |sum, run| sum.saturating_add(run.1));
    if width.checked_mul(height) != Some(cells) || cells > MOST_CELLS {
        return Err(NotAMap::Cells { width, height, cells });
    }
    let cells = runs.into_iter().flat_map(|Run(value, count)| std::iter::repeat_n(value, count));
    Ok(OccupancyGrid {
        resolution,
        width,
        height,
        origin: Point2::new(x, y),
        cells: cells.collect(),
    })
}

#[cfg(test)]
mod tests {
    use proptest::collection::vec;
    use proptest::prelude::{prop_assert_eq, proptest};
    use proptest::sample::select;

    use super::*;

    #[test]
    fn runs_go_on_across_rows() {
        let grid = OccupancyGrid {
            resolution: 0.05,
            width: 3,
            height: 2,
            origin: Point2::new(-1.5, 2.0),
            cells: vec![-1, 0, 0, 0, 100, -1],
        };
        assert_eq!(
            json(&grid),
            r#"{"resolution":0.05,"width":3,"height":2,"origin":[-1.5,2.0],"runs":[[-1,1],[0,3],[100,1],[-1,1]]}"#
        );
    }

    #[test]
    fn a_map_without_cells_has_no_runs() {
        let origin = Point2::new(0.0, 0.0);
        let grid = OccupancyGrid { resolution: 0.05, width: 0, height: 0, origin, cells: vec![] };
        assert!(json(&grid).ends_with(r#""runs":[]}"#));
    }

    #[test]
    fn cells_that_are_not_there_take_no_memory() {
        let map = |runs: &str| {
            format!(
                r#"{{"resolution":0.05,"width":9000000,"height":9000000,"origin":[0,0],"runs":{runs}}}"#
            )
        };
        let error = parse_json(map("[[0,5]]").as_bytes()).unwrap_err().to_string();
        assert_eq!(error, "9000000 by 9000000 cells are told, and 5 are there");
        assert!(parse_json(map("[[0,81000000000000]]").as_bytes()).is_err());
        assert!(parse_json(b"{}").is_err());
    }

    proptest! {
        #[test]
        fn maps_read_back(cells in vec(select(vec![-1_i8, 0, 100]), 1..60), x in -1e3..1e3) {
            let width = cells.len();
            let origin = Point2::new(x, 0.1);
            let grid = OccupancyGrid { resolution: 0.05, width, height: 1, origin, cells };
            prop_assert_eq!(parse_json(json(&grid).as_bytes()).unwrap(), grid);
        }
    }
}
