//! Where a scan fits a coarse map, when nobody knows well: the best pose of a window (Olson,
//! "Real-time correlative scan matching", ICRA 2009), by branch and bound over maps of maxima
//! (Hess, Kohler, Rapp, Andor, "Real-time loop closure in 2D LIDAR SLAM", ICRA 2016).

use super::super::grid::floor;
use super::super::pose::{Pose2, wrap_angle};
use super::gauss_newton::{Level, MARGIN, Prior};

/// Hits that are looked at, at most, ...
const MOST_POINTS: usize = 180;
/// ... and how far away they are, at most, cells.
const FURTHEST_POINT: f32 = 1500.0;
/// The window reaches this many standard deviations to either side, ...
const DEVIATIONS: f64 = 3.0;
/// ... at least this far: cells, and as far as a turn moves what is seen by cells, ...
const NEAREST: [f64; 2] = [1.0, 2.0];
/// ... and at most this far: m and rad.
const FURTHEST: [f64; 2] = [2.0, 1.2];
/// A block of poses has this many blocks of the next smaller size along its side, ...
const BRANCHES: i32 = 4;
/// ... and blocks have so many sizes; the smallest is one pose.
const SIZES: usize = 3;
/// A window that reaches less far, cells, is searched pose by pose.
const FEW: i32 = 6;

/// What is searched, and how the places are judged.
#[derive(Debug)]
pub struct Search<'a> {
    /// The coarse map.
    pub level: &'a Level<'a>,
    /// What is known of the pose.
    pub prior: &'a Prior,
    /// Standard deviations of the prior: m and rad.
    pub deviations: [f64; 2],
    /// Root mean square distance of what is seen from the base, m.
    pub lever: f64,
    /// What a hit in an occupied cell is worth, nats.
    pub gain: f64,
}

/// The scan at one heading.
#[derive(Debug)]
struct Turned {
    pose: Pose2,
    /// Least cost of the heading, wherever the robot is.
    cost: f64,
    /// Cells of the window that points lie in.
    points: Vec<(i32, i32)>,
}

/// Poses of one heading: a square of offsets, in cells, from `first` on.
#[derive(Debug, Clone, Copy)]
struct Block {
    heading: usize,
    first: (i32, i32),
    /// None of them is likelier, nats.
    bound: f64,
}

/// The likeliest pose so far, and how likely it is.
type Best = (f64, Pose2);

impl Search<'_> {
    /// The likeliest pose of the window around the prior's.
    #[must_use]
    pub fn run(&self) -> Pose2 {
        let cell = self.level.resolution();
        let [reach, turn] = self.deviations.map(|deviation| DEVIATIONS * deviation);
        let cells = (reach.min(FURTHEST[0]) / cell).clamp(NEAREST[0], MARGIN) as i32;
        let angle = cell / self.lever.max(cell);
        let turns = (turn.min(FURTHEST[1]) / angle).max(NEAREST[1]) as i32;
        let headings: Vec<Turned> =
            (-turns..=turns).map(|heading| self.turned(f64::from(heading) * angle)).collect();
        if cells < FEW {
            return self.try_all(&headings, cells);
        }
        let mut maxima = vec![Maxima::of(self.level, self.prior.pose_in_map, cells)];
        for size in 1..SIZES {
            maxima.push(maxima[size - 1].pooled((BRANCHES as usize).pow(size as u32 - 1)));
        }
        let largest = BRANCHES.pow(SIZES as u32 - 1);
        let firsts = || (-cells..=cells).step_by(largest as usize);
        let squares = headings.iter().enumerate().flat_map(|(heading, turned)| {
            let maxima = &maxima[SIZES - 1];
            firsts().flat_map(move |y| firsts().map(move |x| (x, y))).map(move |first| Block {
                heading,
                first,
                bound: self.gain * maxima.sum(&turned.points, first) - turned.cost,
            })
        });
        let mut best = (f64::NEG_INFINITY, self.prior.pose_in_map);
        self.explore(squares.collect(), (&headings, &maxima, cells), &mut best);
        best.1
    }

    /// The same for a small window, where maxima would cost more than they save.
    fn try_all(&self, headings: &[Turned], cells: i32) -> Pose2 {
        let side = (2 * cells + 1) as usize;
        let offsets = |index: usize| ((index % side) as i32 - cells, (index / side) as i32 - cells);
        let mut best = (f64::NEG_INFINITY, self.prior.pose_in_map);
        let mut sums = vec![0.0; side * side];
        for turned in headings {
            sums.fill(0.0);
            for &(column, row) in &turned.points {
                for (row, sums) in (row - cells..).zip(sums.chunks_exact_mut(side)) {
                    self.level.add_probabilities(column - cells, row, sums);
                }
            }
            for (index, sum) in sums.iter().enumerate() {
                let most = self.gain * f64::from(*sum);
                if most <= best.0 {
                    continue;
                }
                let pose = self.moved(turned.pose, offsets(index));
                let likelihood = most - self.prior.cost(pose);
                if likelihood > best.0 {
                    best = (likelihood, pose);
                }
            }
        }
        best.1
    }

    /// Looks into the blocks that may hold a likelier pose than the best.
    fn explore(
        &self,
        mut blocks: Vec<Block>,
        window: (&[Turned], &[Maxima], i32),
        best: &mut Best,
    ) {
        let (headings, maxima, cells) = window;
        blocks.sort_by(|a, b| b.bound.total_cmp(&a.bound));
        let (_, smaller) = maxima.split_last().expect("there is a size");
        for block in blocks {
            if block.bound <= best.0 {
                break;
            }
            let turned = &headings[block.heading];
            let Some(sums) = smaller.last() else {
                let pose = self.moved(turned.pose, block.first);
                let likelihood = block.bound + turned.cost - self.prior.cost(pose);
                if likelihood > best.0 {
                    *best = (likelihood, pose);
                }
                continue;
            };
            let size = BRANCHES.pow(smaller.len() as u32 - 1);
            let along = |first: i32| (0..BRANCHES).map(move |i| first + i * size);
            let parts = along(block.first.1)
                .flat_map(|y| along(block.first.0).map(move |x| (x, y)))
                .filter(|(x, y)| *x <= cells && *y <= cells)
                .map(|first| Block {
                    first,
                    bound: self.gain * sums.sum(&turned.points, first) - turned.cost,
                    ..block
                });
            self.explore(parts.collect(), (headings, smaller, cells), best);
        }
    }

    fn moved(&self, pose: Pose2, (x, y): (i32, i32)) -> Pose2 {
        let cell = self.level.resolution();
        Pose2::new(pose.x + f64::from(x) * cell, pose.y + f64::from(y) * cell, pose.theta)
    }

    fn turned(&self, turn: f64) -> Turned {
        let mean = self.prior.pose_in_map;
        let pose = Pose2::new(mean.x, mean.y, wrap_angle(mean.theta + turn));
        let points = self.level.points();
        let [x, y] = self.level.in_window(pose);
        let (sin, cos) = libm::sincos(pose.theta);
        let in_cell = |&[px, py]: &[f32; 2]| {
            let (px, py) = (f64::from(px), f64::from(py));
            (floor(x + cos * px - sin * py), floor(y + sin * px + cos * py))
        };
        let step = points.len().div_ceil(MOST_POINTS).max(1);
        let points = points.iter().step_by(step).filter(|point| is_near(point));
        let points = points.map(in_cell).collect();
        let deviation = self.deviations[1];
        Turned { pose, cost: 0.5 * (turn / deviation) * (turn / deviation), points }
    }
}

fn is_near([x, y]: &[f32; 2]) -> bool {
    x * x + y * y < FURTHEST_POINT * FURTHEST_POINT
}

/// For each cell around the scan, the highest probability in a square that begins there.
#[derive(Debug)]
struct Maxima {
    /// The lower-left cell, in the window.
    first: (i32, i32),
    width: usize,
    of: Vec<f32>,
}

/// Of cells outside.
const UNKNOWN: f32 = 0.5;

impl Maxima {
    /// In squares of one cell, for poses up to `cells` away from `pose`.
    fn of(level: &Level<'_>, pose: Pose2, cells: i32) -> Self {
        let points = level.points().iter().filter(|point| is_near(point));
        let squared = points.map(|[x, y]| x * x + y * y).fold(0.0, f32::max);
        let reach = squared.sqrt() as i32 + cells + 2;
        let [left, bottom] = level.in_window(pose).map(|at| floor(at) - reach);
        let width = 2 * reach + 1;
        let mut of = Vec::with_capacity((width * width) as usize);
        for row in bottom..bottom + width {
            of.extend((left..left + width).map(|column| level.probability(column, row)));
        }
        Self { first: (left, bottom), width: width as usize, of }
    }

    /// In squares of [`BRANCHES`] times the side, which is `size` so far.
    fn pooled(&self, size: usize) -> Self {
        let rows = most_of_four(&self.of, size);
        Self { of: most_of_four(&rows, size * self.width), ..*self }
    }

    /// Over points moved by some cells.
    fn sum(&self, points: &[(i32, i32)], (dx, dy): (i32, i32)) -> f64 {
        let (dx, dy) = (dx - self.first.0, dy - self.first.1);
        let at = |&(column, row): &(i32, i32)| {
            let index = (row + dy) as usize * self.width + (column + dx) as usize;
            self.of.get(index).copied().unwrap_or(UNKNOWN)
        };
        f64::from(points.iter().map(at).sum::<f32>())
    }
}

/// The highest of each value and the [`BRANCHES`] - 1 that follow at `step`.
fn most_of_four(of: &[f32], step: usize) -> Vec<f32> {
    let mut most = of.to_vec();
    for branch in 1..BRANCHES as usize {
        let shifted = &of[(branch * step).min(of.len())..];
        let (inside, edge) = most.split_at_mut(shifted.len());
        for (value, other) in inside.iter_mut().zip(shifted) {
            *value = if other > value { *other } else { *value };
        }
        for value in edge {
            *value = value.max(UNKNOWN);
        }
    }
    most
}
