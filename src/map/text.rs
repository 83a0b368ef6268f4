//! The map drawn with characters, for a terminal.

use std::fmt::Write as _;
use std::num::NonZeroUsize;
use std::ops::Range;

use super::bounds::shown_bounds;
use crate::slam::grid::occupancy::OccupancyGrid;
use crate::slam::pose::Pose2;

/// Nothing known.
const UNKNOWN: char = '░';
/// No obstacle.
const FREE: char = ' ';

/// Characters with obstacles in some of their quarters, by the sum of [`QUARTERS`].
const OBSTACLES: [char; 16] =
    [' ', '▘', '▝', '▀', '▖', '▌', '▞', '▛', '▗', '▚', '▐', '▜', '▄', '▙', '▟', '█'];

/// The bits of the quarters: above left and right, below left and right.
const QUARTERS: [[usize; 2]; 2] = [[1, 2], [4, 8]];

/// The robot by its heading, counter-clockwise from x in steps of an eighth turn.
const ROBOT: [char; 8] = ['→', '↗', '↑', '↖', '←', '↙', '↓', '↘'];

/// The known part of the map, at most `columns` characters wide, y upwards, and a line that tells
/// its size; with an arrow where the robot is.
///
/// A character is about twice as high as wide and shows two by two quarters. Many cells may share
/// a quarter: one obstacle among them fills it, so none is ever lost. A character without
/// obstacles is free if any of it is.
#[must_use]
pub fn text(grid: &OccupancyGrid, columns: NonZeroUsize, robot_in_map: Option<Pose2>) -> String {
    let [known_columns, known_rows] = shown_bounds(grid);
    if known_columns.is_empty() {
        return "nothing is known yet\n".to_owned();
    }
    let drawing = Drawing::new(grid, columns, [known_columns, known_rows]);
    let robot = robot_in_map.and_then(|pose| Some((drawing.character_of(grid, pose)?, pose)));
    let mut text = String::new();
    for row in 0..drawing.height.div_ceil(2) {
        let line = (0..drawing.width.div_ceil(2)).map(|column| match robot {
            Some((place, pose)) if place == [column, row] => arrow(pose.theta),
            _ => drawing.character(column, row),
        });
        text.extend(line);
        text.push('\n');
    }
    drawing.write_legend(grid.resolution, &mut text);
    text.push_str(if robot.is_some() { ", arrow: robot\n" } else { "\n" });
    text
}

fn arrow(heading: f64) -> char {
    let eighths = libm::round(heading / std::f64::consts::FRAC_PI_4);
    // A remainder by 8 fits; a heading that is no number points ahead.
    ROBOT[eighths.rem_euclid(8.0) as usize % ROBOT.len()]
}

/// What a quarter of a character shows; the greater wins.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Shade {
    Unknown,
    Free,
    Obstacle,
}

/// The known cells, merged into quarters of characters.
struct Drawing {
    columns: Range<usize>,
    rows: Range<usize>,
    /// Cells a quarter across; it is twice as high.
    cells_across: f64,
    /// Quarters a row.
    width: usize,
    /// Rows of quarters.
    height: usize,
    /// From the topmost row down.
    quarters: Vec<Shade>,
}

impl Drawing {
    fn new(grid: &OccupancyGrid, most_columns: NonZeroUsize, known: [Range<usize>; 2]) -> Self {
        let [columns, rows] = known;
        let width = columns.len().min(most_columns.get().saturating_mul(2));
        let cells_across = columns.len() as f64 / width as f64;
        let height = quarter(rows.len() - 1, 2.0 * cells_across) + 1;
        let quarters = vec![Shade::Unknown; width * height];
        let mut drawing = Self { columns, rows, cells_across, width, height, quarters };
        for iy in drawing.rows.clone() {
            for ix in drawing.columns.clone() {
                let shade = match grid.cells[iy * grid.width + ix] {
                    0 => Shade::Free,
                    100 => Shade::Obstacle,
                    _ => continue,
                };
                let [column, row] = drawing.quarter_of([ix, iy]);
                let quarter = &mut drawing.quarters[row * width + column];
                *quarter = shade.max(*quarter);
            }
        }
        drawing
    }

    fn quarter_of(&self, [ix, iy]: [usize; 2]) -> [usize; 2] {
        let column = quarter(ix - self.columns.start, self.cells_across);
        let row = quarter(self.rows.end - 1 - iy, 2.0 * self.cells_across);
        [column.min(self.width - 1), row.min(self.height - 1)]
    }

    /// Where a pose is drawn, if it is on the drawing.
    fn character_of(&self, grid: &OccupancyGrid, pose_in_map: Pose2) -> Option<[usize; 2]> {
        let cell = |metres: f64, known: &Range<usize>| {
            let index = libm::floor(metres / grid.resolution);
            // The bounds are compared as floats, so whatever passes is an index.
            let inside = index >= known.start as f64 && index < known.end as f64;
            inside.then_some(index as usize)
        };
        let ix = cell(pose_in_map.x - grid.origin.x, &self.columns)?;
        let iy = cell(pose_in_map.y - grid.origin.y, &self.rows)?;
        Some(self.quarter_of([ix, iy]).map(|quarters| quarters / 2))
    }

    fn character(&self, column: usize, row: usize) -> char {
        let mut obstacles = 0;
        let mut greatest = Shade::Unknown;
        for (below, bits) in QUARTERS.iter().enumerate() {
            for (right, bit) in bits.iter().enumerate() {
                let shade = self.quarter([2 * column + right, 2 * row + below]);
                greatest = greatest.max(shade);
                if shade == Shade::Obstacle {
                    obstacles += bit;
                }
            }
        }
        match greatest {
            Shade::Unknown => UNKNOWN,
            Shade::Free => FREE,
            Shade::Obstacle => OBSTACLES[obstacles],
        }
    }

    /// Beyond the last column and row nothing is known.
    fn quarter(&self, [column, row]: [usize; 2]) -> Shade {
        if column < self.width && row < self.height {
            self.quarters[row * self.width + column]
        } else {
            Shade::Unknown
        }
    }

    fn write_legend(&self, resolution: f64, text: &mut String) {
        let metres = |cells: usize| cells as f64 * resolution;
        let character = 2.0 * self.cells_across * resolution;
        let (width, height) = (metres(self.columns.len()), metres(self.rows.len()));
        write!(text, "{width:.1} x {height:.1} m, a character is {character:.2} x ").ok();
        write!(text, "{:.2} m: █ obstacle, {UNKNOWN} unknown", 2.0 * character).ok();
    }
}

/// In which quarter the cell at `index` lies.
fn quarter(index: usize, cells: f64) -> usize {
    (index as f64 / cells) as usize
}

#[cfg(test)]
mod tests {
    use proptest::prelude::{prop_assert, prop_assert_eq, proptest};

    use super::*;
    use crate::slam::pose::Point2;

    /// A map as it is seen: `#` occupied, `.` free, blank unknown, the topmost row first.
    fn map(rows: &[&str]) -> OccupancyGrid {
        let cell = |octet| match octet {
            b'#' => 100,
            b'.' => 0,
            _ => -1,
        };
        OccupancyGrid {
            resolution: 0.5,
            width: rows[0].len(),
            height: rows.len(),
            origin: Point2::new(-1.0, -2.0),
            cells: rows.iter().rev().flat_map(|row| row.bytes().map(cell)).collect(),
        }
    }

    fn columns(count: usize) -> NonZeroUsize {
        NonZeroUsize::new(count).unwrap()
    }

    fn drawn(grid: &OccupancyGrid, count: usize, robot: Option<Pose2>) -> Vec<String> {
        let text = text(grid, columns(count), robot);
        let mut lines: Vec<String> = text.lines().map(str::to_owned).collect();
        lines.pop();
        lines
    }

    #[test]
    fn a_small_map_has_a_quarter_for_two_cells() {
        let room = map(&[
            "######", //
            "######", "#....#", "#....#", "#....#", "#....#", "######", "######",
        ]);
        assert_eq!(drawn(&room, 80, None), ["▛▀▜", "▙▄▟"]);
        let legend = "3.0 x 4.0 m, a character is 1.00 x 2.00 m: █ obstacle, ░ unknown";
        assert!(text(&room, columns(80), None).ends_with(&format!("{legend}\n")));
    }

    #[test]
    fn every_combination_of_quarters_has_its_character() {
        for (bits, &character) in OBSTACLES.iter().enumerate() {
            let octet = |bit| if bits & bit == 0 { '.' } else { '#' };
            let row = |[left, right]: [usize; 2]| format!("{}{}", octet(left), octet(right));
            let [above, below] = QUARTERS.map(row);
            let grid = map(&[&above, &above, &below, &below]);
            assert_eq!(drawn(&grid, 80, None), [character.to_string()], "{bits}");
        }
    }

    #[test]
    fn unknown_is_not_free() {
        let grid = map(&[". ..", "    ", ".   ", "...."]);
        assert_eq!(drawn(&grid, 80, None), ["  "]);
        let hole = map(&["..  ..", "..  ..", "..  ..", "..  .."]);
        assert_eq!(drawn(&hole, 80, None), [" ░ "]);
    }

    #[test]
    fn what_is_not_known_around_the_map_is_left_out() {
        let grid = map(&["     ", "  #  ", "     "]);
        assert_eq!(drawn(&grid, 80, None), ["▘"]);
        assert_eq!(text(&map(&["  "]), columns(80), None), "nothing is known yet\n");
        let origin = Point2::new(0.0, 0.0);
        let none = OccupancyGrid { resolution: 0.5, width: 0, height: 0, origin, cells: vec![] };
        assert_eq!(text(&none, columns(80), None), "nothing is known yet\n");
    }

    #[test]
    fn the_robot_is_an_arrow_where_it_stands() {
        let grid =
            map(&["......", "......", "......", "......", "......", "......", "......", "......"]);
        // The fifth column, the second row from below.
        let robot = Pose2::new(-1.0 + 4.5 * 0.5, -2.0 + 1.5 * 0.5, 1.6);
        assert_eq!(drawn(&grid, 80, Some(robot)), ["   ", "  ↑"]);
        assert!(text(&grid, columns(80), Some(robot)).ends_with(", arrow: robot\n"));
        for (x, y) in [(-1.1, 0.0), (2.1, 0.0), (0.0, -2.1), (0.0, 2.1), (f64::NAN, 0.0)] {
            let outside = Some(Pose2::new(x, y, 0.0));
            assert_eq!(drawn(&grid, 80, outside), ["   ", "   "], "{x} {y}");
        }
    }

    #[test]
    fn arrows_point_along_the_heading() {
        let arrows: String = (-4..=4)
            .map(|eighths| arrow(f64::from(eighths) * std::f64::consts::FRAC_PI_4))
            .collect();
        assert_eq!(arrows, "←↙↓↘→↗↑↖←");
        assert_eq!([arrow(-0.1), arrow(f64::NAN)], ['→', '→']);
    }

    #[test]
    fn a_wide_map_fills_the_columns_it_may_have() {
        let origin = Point2::new(0.0, 0.0);
        let cells = vec![0; 1003 * 17];
        let grid = OccupancyGrid { resolution: 0.05, width: 1003, height: 17, origin, cells };
        let lines = drawn(&grid, 100, None);
        assert!(lines.iter().all(|line| line.chars().count() == 100));
        assert_eq!(lines.len(), 1);
    }

    proptest! {
        /// One obstacle anywhere in a free map is seen, at any width.
        #[test]
        fn obstacles_never_vanish(
            width in 1..90_usize, height in 1..90_usize, count in 1..50_usize, at in 0..8100_usize,
        ) {
            let mut cells = vec![0; width * height];
            let at = at % cells.len();
            cells[at] = 100;
            let origin = Point2::new(0.0, 0.0);
            let grid = OccupancyGrid { resolution: 0.05, width, height, origin, cells };
            let lines = drawn(&grid, count, None);
            let obstacles = lines.iter().flat_map(|line| line.chars()).filter(|&c| c != FREE);
            prop_assert_eq!(obstacles.count(), 1);
            prop_assert!(lines.iter().all(|line| line.chars().count() <= count));
        }
    }
}
