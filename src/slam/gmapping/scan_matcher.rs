//! Scan matching: where in a particle's map a scan fits best, how well, and how surely.

use nalgebra::{Matrix3, Vector3};

use super::super::grid::Cell;
use super::super::grid::likelihood_field::{Linearization, Points, Window, WindowPose};
use super::super::grid::tile_map::TileMap;
use super::super::pose::{Pose2, wrap_angle};
use super::MatcherParameters;

/// Cells a match may move from where it began; the window is that much larger than the scan.
const REACH: f64 = 40.0;
const CLIMB_LEVELS: u32 = 2;

/// The outcome of matching one scan against one map.
#[derive(Debug, Clone, Copy)]
pub struct Match {
    /// The base in `map`.
    pub pose_in_map: Pose2,
    /// Inverse of the information matrix at the pose: m², m rad, rad²; x and y along map axes.
    pub covariance: Matrix3<f64>,
    /// ln p(z | x, m) up to a constant.
    pub log_likelihood: f64,
    /// How well the beams fit: 1 a beam that ends exactly on a hit, 0 one that ends far from any.
    pub score: f64,
    /// `score` is above `minimumScore`.
    pub accepted: bool,
}

/// The scan as the matcher wants it: hits in the base frame, in cells.
#[derive(Debug, Clone, Default)]
pub struct MatchPoints {
    /// Every usable hit.
    pub all: Points,
    /// The part of them that the climb looks at.
    pub coarse: Points,
    /// Distance from the base of the furthest, cells.
    pub radius: i32,
}

/// Matches scans with a likelihood field: a coarse climb, then a Gauss-Newton polish.
#[derive(Debug, Clone)]
pub struct FieldMatcher {
    parameters: MatcherParameters,
    resolution: f64,
    log_likelihoods: [f64; 256],
}

impl FieldMatcher {
    /// A matcher for fields of cells of `resolution` metres.
    #[must_use]
    pub fn new(parameters: MatcherParameters, resolution: f64) -> Self {
        let p = &parameters;
        let log_likelihoods = std::array::from_fn(|byte| {
            let closeness = byte as f64 / 255.0;
            // closeness = exp(-d²/2s²)
            let d2 = -2.0 * p.field_sigma * p.field_sigma * libm::log(closeness.max(1e-6));
            match p.likelihood {
                2 => libm::log(p.hit_fraction * closeness + 1.0 - p.hit_fraction),
                0 => {
                    if d2.sqrt() < p.cut {
                        -d2 / p.likelihood_sigma
                    } else {
                        -0.5 / p.likelihood_sigma
                    }
                }
                _ => libm::log(
                    p.hit_fraction * libm::exp(-d2 / (2.0 * p.like_sigma * p.like_sigma)) + 1.0
                        - p.hit_fraction,
                ),
            }
        });
        Self { parameters, resolution, log_likelihoods }
    }

    /// Matches `points` against `field`, starting from `start` (the base in `map`).
    #[must_use]
    pub fn run(
        &self,
        field: &TileMap<u8>,
        points: &MatchPoints,
        start: Pose2,
        prior: &Matrix3<f64>,
    ) -> Match {
        let centre = Cell::containing(start.position(), self.resolution);
        let window = Window::around(field, centre, points.radius + REACH as i32 + 2);
        let first = window.first_cell();
        let origin = WindowPose::new(
            start.x / self.resolution - f64::from(first.ix),
            start.y / self.resolution - f64::from(first.iy),
            start.theta,
        );
        let climbed = self.climb(&window, &points.coarse, origin);
        let scale = Matrix3::from_diagonal(&Vector3::new(self.resolution, self.resolution, 1.0));
        let prior = scale * prior * scale;
        let (pose, fit) = self.polish(&window, &points.all, climbed, origin, &prior);
        let mut log_likelihood = 0.0;
        let (mut rs, mut rn) = (0.0, 0.0);
        window.for_each_value(&points.all, pose, |value| {
            log_likelihood += self.log_likelihoods[usize::from(value)];
            if value > 40 { rn += 1.0; let e = 1.0 - f64::from(value) / 255.0; rs += e * e; }
        });
        let score = points.all.len() as f64 - f64::from(fit.cost);
        let residual: f64 = if self.parameters.robust { (rs / f64::max(rn, 1.0)).max(1e-3) } else { (f64::from(fit.cost) / points.all.len() as f64).max(1e-3) };
        let information = information(&fit) / residual + prior;
        let covariance = scale * information.try_inverse().unwrap_or_else(Matrix3::zeros) * scale;
        Match {
            pose_in_map: Pose2::new(
                start.x + (pose.x - origin.x) * self.resolution,
                start.y + (pose.y - origin.y) * self.resolution,
                wrap_angle(pose.theta),
            ),
            covariance,
            log_likelihood,
            score,
            accepted: score > self.parameters.minimum_score,
        }
    }

    /// Hill climbing along the map's axes and the heading, as the original does it.
    fn climb(&self, window: &Window<'_>, points: &Points, origin: WindowPose) -> WindowPose {
        let mut step = self.parameters.linear_step / self.resolution;
        let mut turn = self.parameters.angular_step;
        let mut best = origin;
        let mut best_score = window.score(points, best);
        let mut level = 0;
        let start = best;
        for i in 1..=self.parameters.sweep {
            for sign in [-1.0, 1.0] {
                let pose = start.turned(sign * f64::from(i) * self.parameters.sweep_step);
                let score = window.score(points, pose);
                if f64::from(score) > self.parameters.sweep_bias * f64::from(best_score) {
                    (best, best_score) = (pose, score);
                }
            }
        }
        while level < self.parameters.climb_levels {
            let moves = [
                best.moved(step, 0.0),
                best.moved(-step, 0.0),
                best.moved(0.0, step),
                best.moved(0.0, -step),
                best.turned(turn),
                best.turned(-turn),
            ];
            let before = best_score;
            for pose in moves {
                let score = window.score(points, pose);
                if score > best_score && within_reach(pose, origin) {
                    (best, best_score) = (pose, score);
                }
            }
            if best_score == before {
                step *= 0.5;
                turn *= 0.5;
                level += 1;
            }
        }
        best
    }

    /// Damped Gauss-Newton on the interpolated field; a step counts only if the fit improves.
    fn polish(
        &self,
        window: &Window<'_>,
        points: &Points,
        start: WindowPose,
        origin: WindowPose,
        prior: &Matrix3<f64>,
    ) -> (WindowPose, Linearization) {
        let mut pose = start;
        let mut fit = window.linearize(points, pose);
        let offset =
            |p: WindowPose| Vector3::new(p.x - origin.x, p.y - origin.y, p.theta - origin.theta);
        let residual = 0.2;
        let total = |p: WindowPose, f: &Linearization| {
            let d = offset(p);
            f64::from(f.cost) / residual + (d.transpose() * prior * d)[0]
        };
        let mut cost = total(pose, &fit);
        for _ in 0..self.parameters.polish_steps {
            let mut information = information(&fit) / residual + prior;
            for i in 0..3 {
                information[(i, i)] *= 1.0 + self.parameters.damping;
                information[(i, i)] += 1e-6;
            }
            let gradient =
                Vector3::from(fit.gradient.map(f64::from)) / residual - prior * offset(pose);
            let Some(inverse) = information.try_inverse() else { break };
            let step = inverse * gradient;
            let limit = 2.0_f64;
            let shrink = (limit / step.xy().norm()).min(0.1 / step[2].abs()).min(1.0);
            let step = step * shrink;
            let next = WindowPose::new(pose.x + step[0], pose.y + step[1], pose.theta + step[2]);
            if !within_reach(next, origin) {
                break;
            }
            let next_fit = window.linearize(points, next);
            let next_cost = total(next, &next_fit);
            if next_cost >= cost {
                break;
            }
            (pose, fit, cost) = (next, next_fit, next_cost);
            if step.xy().norm() < 0.01 && step[2].abs() < 0.0002 {
                break;
            }
        }
        (pose, fit)
    }
}

fn within_reach(pose: WindowPose, origin: WindowPose) -> bool {
    (pose.x - origin.x).abs() <= REACH && (pose.y - origin.y).abs() <= REACH
}

fn information(fit: &Linearization) -> Matrix3<f64> {
    let [xx, xy, xt, yy, yt, tt] = fit.information.map(f64::from);
    Matrix3::new(xx, xy, xt, xy, yy, yt, xt, yt, tt)
}
