//! Where a scan fits a coarse map, when nobody knows well: every pose of a window is tried
//! (Olson, "Real-time correlative scan matching", ICRA 2009).

use super::super::pose::{Pose2, wrap_angle};
use super::gauss_newton::{Level, Prior};

/// Hits that are looked at, at most.
const MOST_POINTS: usize = 180;
/// The window reaches this many standard deviations to either side, ...
const DEVIATIONS: f64 = 3.0;
/// ... at least this far, cells, ...
const NEAREST: f64 = 2.0;
/// ... and at most this far: m and rad.
const FURTHEST: [f64; 2] = [2.0, 1.2];

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

impl Search<'_> {
    /// The likeliest pose of the window around the prior's.
    #[must_use]
    pub fn run(&self) -> Pose2 {
        let cell = self.level.resolution();
        let [reach, turn] = self.deviations.map(|deviation| DEVIATIONS * deviation);
        let cells = (reach.min(FURTHEST[0]) / cell).max(NEAREST);
        let angle = cell / self.lever.max(cell);
        let turns = (turn.min(FURTHEST[1]) / angle).max(NEAREST);
        let mean = self.prior.pose_in_map;
        let mut best = (f64::NEG_INFINITY, mean);
        for heading in from_the_middle(turns as i32) {
            let theta = wrap_angle(mean.theta + f64::from(heading) * angle);
            let turned = Pose2::new(mean.x, mean.y, theta);
            let points = self.cells(turned);
            for row in from_the_middle(cells as i32) {
                for column in from_the_middle(cells as i32) {
                    let moved = [f64::from(column) * cell, f64::from(row) * cell];
                    let pose = Pose2::new(mean.x + moved[0], mean.y + moved[1], theta);
                    let score = self.score(&points, (column, row)) - self.prior.cost(pose);
                    if score > best.0 {
                        best = (score, pose);
                    }
                }
            }
        }
        best.1
    }

    /// The cells of the window that some of the points lie in.
    fn cells(&self, pose: Pose2) -> Vec<(i32, i32)> {
        let points = self.level.points();
        let [x, y] = self.level.in_window(pose);
        let (sin, cos) = libm::sincos(pose.theta);
        let in_cell = |&[px, py]: &[f32; 2]| {
            let (px, py) = (f64::from(px), f64::from(py));
            let floor = super::super::grid::floor;
            (floor(x + cos * px - sin * py), floor(y + sin * px + cos * py))
        };
        let step = points.len().div_ceil(MOST_POINTS).max(1);
        points.iter().step_by(step).map(in_cell).collect()
    }

    fn score(&self, points: &[(i32, i32)], (dx, dy): (i32, i32)) -> f64 {
        let hit = |&(column, row): &(i32, i32)| self.level.probability(column + dx, row + dy);
        let sum: f32 = points.iter().map(hit).sum();
        self.gain * f64::from(sum)
    }
}

/// 0, 1, -1, 2, -2 and so on: of equals, the first and nearest is taken.
fn from_the_middle(most: i32) -> impl Iterator<Item = i32> {
    (0..=2 * most).map(|i| if i % 2 == 1 { i.div_euclid(2) + 1 } else { -i.div_euclid(2) })
}
