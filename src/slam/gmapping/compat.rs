//! The original's scan matcher, with its exact objective and schedule: the slow reference.

use nalgebra::Matrix3;

use super::super::grid::Cell;
use super::super::grid::hit_map::{HitMap, add_hit, nearest_hit};
use super::super::grid::occupancy::BeamEndKind;
use super::super::pose::{Pose2, wrap_angle};
use super::prepared_scan::PreparedScan;
use super::scan_matcher::{Match, MatcherParameters};

/// Hill climbing on the distance of each beam's end to the nearest mean hit.
#[derive(Debug, Clone)]
pub struct CompatMatcher {
    parameters: MatcherParameters,
    resolution: f64,
}

impl CompatMatcher {
    /// A matcher for maps of cells of `resolution` metres.
    #[must_use]
    pub const fn new(parameters: MatcherParameters, resolution: f64) -> Self {
        Self { parameters, resolution }
    }

    /// Matches a scan against `map`, starting with the base at `start`.
    #[must_use]
    pub fn run(&self, map: &HitMap, scan: &PreparedScan, start: Pose2) -> Match {
        let (pose_in_map, score) = self.climb(map, scan, start);
        let p = &self.parameters;
        let unmatched = -0.5 / p.likelihood_sigma;
        let log_likelihood = self
            .squared_distances(map, scan, pose_in_map)
            .map(|distance| distance.map_or(unmatched, |d2| -d2 / p.likelihood_sigma))
            .sum();
        Match { pose_in_map, covariance: Matrix3::zeros(), log_likelihood, score }
    }

    /// Enters a scan taken with the base at `pose` into `map`.
    pub fn register(&self, map: &mut HitMap, scan: &PreparedScan, pose: Pose2) {
        let to_cells = self.to_cells(pose);
        for end in scan.outline.ends.iter().filter(|end| end.kind == BeamEndKind::Hit) {
            let point = end.point.map(|metres| f64::from(metres) / self.resolution);
            add_hit(map, to_cells.0, to_cells.1(point));
        }
    }

    /// Takes the best of six moves until none improves, then halves the steps, `iterations` times.
    fn climb(&self, map: &HitMap, scan: &PreparedScan, start: Pose2) -> (Pose2, f64) {
        let mut best = (start, self.score(map, scan, start));
        let (mut step, mut turn) = (self.parameters.linear_step, self.parameters.angular_step);
        let mut refinements = 0;
        while refinements < self.parameters.iterations {
            let Pose2 { x, y, theta } = best.0;
            let moves = [
                Pose2::new(x + step, y, theta),
                Pose2::new(x - step, y, theta),
                Pose2::new(x, y + step, theta),
                Pose2::new(x, y - step, theta),
                Pose2::new(x, y, wrap_angle(theta + turn)),
                Pose2::new(x, y, wrap_angle(theta - turn)),
            ];
            let scored = moves.map(|pose| (pose, self.score(map, scan, pose)));
            let found = scored.into_iter().fold(best, |a, b| if b.1 > a.1 { b } else { a });
            if found.1 == best.1 {
                refinements += 1;
                step *= 0.5;
                turn *= 0.5;
            }
            best = found;
        }
        best
    }

    fn score(&self, map: &HitMap, scan: &PreparedScan, pose: Pose2) -> f64 {
        let distances = self.squared_distances(map, scan, pose).flatten();
        distances.map(|d2| libm::exp(-d2 / self.parameters.sigma)).sum()
    }

    /// For each beam, the squared distance of its end to the nearest mean hit, m².
    fn squared_distances<'a>(
        &self,
        map: &'a HitMap,
        scan: &'a PreparedScan,
        pose: Pose2,
    ) -> impl Iterator<Item = Option<f64>> + 'a {
        let (origin, to_cells) = self.to_cells(pose);
        let reach = self.parameters.kernel_size as i32;
        let square_metres = self.resolution * self.resolution;
        scan.hits.iter().map(move |(x, y)| {
            let point = to_cells([f64::from(x), f64::from(y)]);
            nearest_hit(map, origin, point, reach).map(|d2| d2 * square_metres)
        })
    }

    /// The base's cell, and the transform from the base frame in cells to cells from its corner.
    fn to_cells(&self, pose: Pose2) -> (Cell, impl Fn([f64; 2]) -> [f64; 2] + use<>) {
        let origin = Cell::containing(pose.position(), self.resolution);
        let base_x = pose.x / self.resolution - f64::from(origin.ix);
        let base_y = pose.y / self.resolution - f64::from(origin.iy);
        let (sin, cos) = libm::sincos(pose.theta);
        let transform =
            move |[x, y]: [f64; 2]| [base_x + cos * x - sin * y, base_y + sin * x + cos * y];
        (origin, transform)
    }
}
