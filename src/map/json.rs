//! The map as JSON, for programs without ROS.

use serde::Serialize;

use crate::slam::grid::occupancy::OccupancyGrid;

#[derive(Serialize)]
struct Map {
    resolution: f64,
    width: usize,
    height: usize,
    origin: [f64; 2],
    runs: Vec<Run>,
}

/// A value and how many cells in succession have it.
#[derive(Serialize)]
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

#[cfg(test)]
mod tests {
    use proptest::collection::vec;
    use proptest::prelude::{prop_assert_eq, proptest};
    use proptest::sample::select;

    use super::*;
    use crate::slam::pose::Point2;

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

    proptest! {
        #[test]
        fn runs_give_the_cells_back(cells in vec(select(vec![-1_i8, 0, 100]), 1..60)) {
            let origin = Point2::new(0.0, 0.0);
            let width = cells.len();
            let grid = OccupancyGrid { resolution: 0.1, width, height: 1, origin, cells };
            let map: serde_json::Value = serde_json::from_str(&json(&grid)).unwrap();
            let runs = map["runs"].as_array().unwrap().iter();
            let back: Vec<i8> = runs
                .flat_map(|run| {
                    let count = run[1].as_u64().unwrap() as usize;
                    std::iter::repeat_n(run[0].as_i64().unwrap() as i8, count)
                })
                .collect();
            prop_assert_eq!(back, grid.cells);
        }
    }
}
