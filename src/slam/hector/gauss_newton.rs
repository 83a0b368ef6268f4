//! Where a scan fits a map: Gauss-Newton on bilinearly interpolated occupancy (Kohlbrecher, von
//! Stryk, Meyer, Klingauf, SSRR 2011), damped, together with what was known of the pose before.
//!
//! The original interpolates the derivatives with the wrong weights; here they are those of the
//! interpolated occupancy.

use nalgebra::{Matrix3, Vector3};
use wide::{CmpEq as _, f32x4};

use super::super::grid::Cell;
use super::super::grid::log_odds::{LogOdds, LogOddsMap, Probabilities};
use super::super::grid::tile_map::{TILE_SIZE, Window};
use super::super::pose::{Point2, Pose2, wrap_angle};
use super::weakness::Weakness;

/// Steps at most, cells: bilinear interpolation sees no further.
const LONGEST_STEP: f64 = 2.0;
/// Steps below this, cells, end the search.
const SHORTEST_STEP: f64 = 0.005;
/// Points that are looked at together.
const LANES: usize = 4;
/// A bit for each of them.
const EVERY_LANE: i32 = 0b1111;
/// Room for the pose to move within a window, cells of the coarsest map.
pub(super) const MARGIN: f64 = 24.0;

/// What is known of a pose before the scan is looked at.
#[derive(Debug, Clone, Copy)]
pub struct Prior {
    /// The base in `map`.
    pub pose_in_map: Pose2,
    /// Inverse of its covariance: m⁻², (m rad)⁻¹, rad⁻².
    pub information: Matrix3<f64>,
}

impl Prior {
    fn difference(&self, pose: Pose2) -> Vector3<f64> {
        let mean = self.pose_in_map;
        Vector3::new(pose.x - mean.x, pose.y - mean.y, wrap_angle(pose.theta - mean.theta))
    }

    /// Half the squared distance, as a negative log likelihood.
    pub(super) fn cost(&self, pose: Pose2) -> f64 {
        let difference = self.difference(pose);
        0.5 * difference.dot(&(self.information * difference))
    }
}

/// A scan in a map at one pose: Σ (1 - M)² over its points, and how that changes with the pose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fit {
    /// Σ (1 - M)².
    pub cost: f64,
    /// Half the gradient of the cost, with the sign turned: m⁻¹, m⁻¹, rad⁻¹.
    pub descent: Vector3<f64>,
    /// Σ JᵀJ with J the derivatives of M: m⁻², (m rad)⁻¹, rad⁻².
    pub hessian: Matrix3<f64>,
}

/// A map as one scan is matched with it.
#[derive(Debug)]
pub struct Level<'a> {
    window: Window<'a, LogOdds>,
    probabilities: &'a Probabilities,
    resolution: f64,
    /// Of the scan, in the base frame, cells.
    points: Vec<[f32; 2]>,
}

impl<'a> Level<'a> {
    /// The part of `map` up to `reach` metres around a pose, where the points may lie.
    #[must_use]
    pub fn new(
        map: &'a LogOddsMap,
        probabilities: &'a Probabilities,
        points: Vec<[f32; 2]>,
        (near, reach): (Pose2, f64),
    ) -> Self {
        let resolution = map.resolution();
        let corner = |sign: f64| {
            let at = near.position();
            let at = Point2::new(at.x + sign * reach, at.y + sign * reach);
            Cell::containing(at, resolution)
        };
        let window = Window::between(map.cells(), corner(-1.0), corner(1.0));
        Self { window, probabilities, resolution, points }
    }

    /// Metres a cell.
    #[must_use]
    pub const fn resolution(&self) -> f64 {
        self.resolution
    }

    /// The points, in the base frame, cells.
    #[must_use]
    pub fn points(&self) -> &[[f32; 2]] {
        &self.points
    }

    /// A position of `map` in cells of the window.
    #[must_use]
    pub fn in_window(&self, pose: Pose2) -> [f64; 2] {
        let first = self.window.first_cell();
        [
            pose.x / self.resolution - f64::from(first.ix),
            pose.y / self.resolution - f64::from(first.iy),
        ]
    }

    /// The probability of a cell of the window, 0.5 outside.
    #[inline]
    #[must_use]
    pub fn probability(&self, column: i32, row: i32) -> f32 {
        if column < 0 || row < 0 {
            return 0.5;
        }
        self.probabilities.of(self.window.get(column as usize, row as usize))
    }

    /// Adds the probabilities of neighbouring cells of a row, from `column` on.
    #[inline]
    pub fn add_probabilities(&self, column: i32, row: i32, mut sums: &mut [f32]) {
        let (Ok(mut column), Ok(row)) = (usize::try_from(column), usize::try_from(row)) else {
            return (column..)
                .zip(sums)
                .for_each(|(column, sum)| *sum += self.probability(column, row));
        };
        while !sums.is_empty() {
            let in_tile = (TILE_SIZE - column % TILE_SIZE).min(sums.len());
            let (part, rest) = sums.split_at_mut(in_tile);
            match self.window.rest_of_row(column, row) {
                Some(cells) => {
                    let known = part.iter_mut().zip(cells);
                    known.for_each(|(sum, cell)| *sum += self.probabilities.of(*cell));
                }
                None => part.iter_mut().for_each(|sum| *sum += 0.5),
            }
            (column, sums) = (column + in_tile, rest);
        }
    }

    /// The share of the points that lie in cells of which nothing is known.
    #[must_use]
    pub fn unknown_share(&self, pose: Pose2) -> f64 {
        let [x, y] = self.in_window(pose).map(|cells| cells as f32);
        let (sin, cos) = libm::sincos(pose.theta);
        let (sin, cos) = (sin as f32, cos as f32);
        let unknown = |&&[px, py]: &&[f32; 2]| {
            let (column, row) = (x + cos * px - sin * py, y + sin * px + cos * py);
            self.probability(column as i32, row as i32) == 0.5
        };
        self.points.iter().filter(unknown).count() as f64 / self.points.len().max(1) as f64
    }

    /// How the scan fits with the base at `pose`.
    #[must_use]
    pub fn fit(&self, pose: Pose2) -> Fit {
        self.fit_again(pose, &mut self.fours())
    }

    /// The points, before any cell is looked up.
    fn fours(&self) -> Vec<Four> {
        self.points.chunks(LANES).map(Four::new).collect()
    }

    /// The same, with the cells that were looked up for a pose before.
    fn fit_again(&self, pose: Pose2, fours: &mut [Four]) -> Fit {
        let [x, y] = self.in_window(pose).map(|cells| f32x4::splat(cells as f32));
        let (sin, cos) = libm::sincos(pose.theta);
        let [sin, cos] = [sin, cos].map(|value| f32x4::splat(value as f32));
        let mut sums = [f32x4::ZERO; 10];
        for four in fours {
            let [px, py] = four.points;
            let turned = [cos * px - sin * py, sin * px + cos * py];
            let (columns, fx) = split(x + turned[0]);
            let (rows, fy) = split(y + turned[1]);
            self.look_up(four, [columns, rows]);
            add(&mut sums, turned, four.squares.map(f32x4::from), [fx, fy]);
        }
        self.in_metres(sums.map(|sum| sum.to_array().into_iter().map(f64::from).sum()))
    }

    /// Looks up the squares of points that have left theirs.
    #[inline]
    fn look_up(&self, four: &mut Four, cells: [f32x4; 2]) {
        let [columns, rows] = [0, 1].map(|axis| four.cells[axis].cmp_eq(cells[axis]));
        let stayed = (columns & rows).move_mask();
        if stayed == EVERY_LANE {
            return;
        }
        four.cells = cells;
        let [columns, rows] = cells.map(indices);
        let mut left = four.lanes & !stayed;
        while left != 0 {
            let lane = left.trailing_zeros() as usize % LANES;
            left &= left - 1;
            let square = self.window.square(columns[lane] as usize, rows[lane] as usize);
            for (corner, cell) in four.squares.iter_mut().zip(square) {
                corner[lane] = self.probabilities.of(cell);
            }
        }
    }

    /// 1 - (1 - M)² on average over the points.
    #[must_use]
    pub fn explains(&self, pose: Pose2) -> f64 {
        1.0 - self.fit(pose).cost / self.points.len().max(1) as f64
    }

    fn in_metres(&self, [cost, bx, by, bt, xx, xy, xt, yy, yt, tt]: [f64; 10]) -> Fit {
        let per_metre = 1.0 / self.resolution;
        let unit = Matrix3::from_diagonal(&Vector3::new(per_metre, per_metre, 1.0));
        let hessian = Matrix3::new(xx, xy, xt, xy, yy, yt, xt, yt, tt);
        Fit { cost, descent: unit * Vector3::new(bx, by, bt), hessian: unit * hessian * unit }
    }

    /// The pose of at most `steps` damped steps from `start` that fits scan and prior best.
    #[must_use]
    pub fn descend(&self, problem: &Problem<'_>, start: Pose2, steps: usize) -> (Pose2, Fit) {
        let mut fours = self.fours();
        let mut pose = start;
        let mut fit = self.fit_again(pose, &mut fours);
        let mut cost = problem.cost(&fit, pose);
        let mut damping = 1e-3;
        for _ in 0..steps {
            let Some(step) = problem.step(&fit, pose, damping) else { break };
            let step = self.limited(step, problem.lever);
            if self.length(step, problem.lever) < SHORTEST_STEP {
                break;
            }
            let next = moved(pose, step);
            let next_fit = self.fit_again(next, &mut fours);
            let next_cost = problem.cost(&next_fit, next);
            if next_cost <= cost {
                (pose, fit, cost) = (next, next_fit, next_cost);
                damping *= 0.1;
            } else {
                damping = (damping * 100.0).max(0.1);
            }
        }
        (pose, fit)
    }

    /// How far a step moves what is seen, cells.
    fn length(&self, step: Vector3<f64>, lever: f64) -> f64 {
        let turn = lever * step.z;
        (step.x * step.x + step.y * step.y + turn * turn).sqrt() / self.resolution
    }

    fn limited(&self, step: Vector3<f64>, lever: f64) -> Vector3<f64> {
        let length = self.length(step, lever);
        if length > LONGEST_STEP { step * (LONGEST_STEP / length) } else { step }
    }
}

/// What is to be fitted beside the map.
#[derive(Debug)]
pub struct Problem<'a> {
    /// What is known of the pose.
    pub prior: &'a Prior,
    /// What the scan does not tell.
    pub weakness: &'a Weakness,
    /// Root mean square distance of what is seen from the base, m.
    pub lever: f64,
    /// What the scan's information is worth: 1 / variance of a residual.
    pub gain: f64,
}

impl Problem<'_> {
    /// The negative log likelihood of a pose, but for a constant.
    #[must_use]
    pub fn cost(&self, fit: &Fit, pose: Pose2) -> f64 {
        0.5 * self.gain * fit.cost + self.prior.cost(pose)
    }

    fn step(&self, fit: &Fit, pose: Pose2, damping: f64) -> Option<Vector3<f64>> {
        let (hessian, descent) = self.weakness.without(fit, pose.theta);
        let mut information = self.gain * hessian + self.prior.information;
        let pull = self.prior.information * self.prior.difference(pose);
        let rhs = self.gain * descent - pull;
        for axis in 0..3 {
            information[(axis, axis)] *= 1.0 + damping;
        }
        Some(information.cholesky()?.solve(&rhs))
    }
}

fn moved(pose: Pose2, step: Vector3<f64>) -> Pose2 {
    Pose2::new(pose.x + step.x, pose.y + step.y, wrap_angle(pose.theta + step.z))
}

/// Up to four points, and what is around them: everything but the looking up of cells is done for
/// all four at once, and a small step leaves most of them in the cells where they were.
#[derive(Debug)]
struct Four {
    /// A bit for each.
    lanes: i32,
    /// In the base frame, cells.
    points: [f32x4; 2],
    /// Of the squares, as [`split`] makes them.
    cells: [f32x4; 2],
    /// Probabilities of the cells around: lower left, lower right, upper left and upper right.
    /// Points that are not there lie in occupied cells, and so say nothing.
    squares: [[f32; LANES]; 4],
}

impl Four {
    fn new(points: &[[f32; 2]]) -> Self {
        let point = |lane: usize| points.get(lane).copied().unwrap_or_default();
        Self {
            lanes: EVERY_LANE >> (LANES - points.len()),
            points: [0, 1].map(|axis| f32x4::from([0, 1, 2, 3].map(|lane| point(lane)[axis]))),
            cells: [f32x4::ZERO; 2],
            squares: [[1.0; LANES]; 4],
        }
    }
}

/// Adds what four points say: turned with the base, in squares at these fractions of their sides.
#[inline]
fn add(sums: &mut [f32x4; 10], [rx, ry]: [f32x4; 2], square: [f32x4; 4], [fx, fy]: [f32x4; 2]) {
    let [m00, m10, m01, m11] = square;
    let (bottom, left) = (m10 - m00, m01 - m00);
    let dx = bottom + fy * ((m11 - m01) - bottom);
    let dy = left + fx * ((m11 - m10) - left);
    let residual = 1.0 - (m00 + fx * bottom + fy * dy);
    let turn = rx * dy - ry * dx;
    let products = [
        residual * residual,
        dx * residual,
        dy * residual,
        turn * residual,
        dx * dx,
        dx * dy,
        dx * turn,
        dy * dy,
        dy * turn,
        turn * turn,
    ];
    for (sum, product) in sums.iter_mut().zip(products) {
        *sum += product;
    }
}

/// The cells whose centres are the last before positions in cells, shifted by 2^23, and how far
/// behind them those are, 0 to 1. Positions below 0.5 have a cell beyond all windows.
///
/// As `floor`, but without its branches: adding 2^23 leaves no room for digits behind the point.
#[inline]
fn split(positions: f32x4) -> (f32x4, f32x4) {
    let shift = f32x4::splat(8_388_608.0);
    let cells = positions + (shift - 1.0);
    (cells, positions - (cells - (shift - 0.5)))
}

/// Cells that [`split`] made, to look up.
#[inline]
fn indices(cells: f32x4) -> [u32; LANES] {
    cells.to_array().map(|cell| cell.to_bits() & 0x007f_ffff)
}
