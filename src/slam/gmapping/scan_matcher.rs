//! Scan matching: where in a particle's map a scan fits best, how well, and how surely.

use nalgebra::{Matrix3, Vector3};

use super::super::grid::Cell;
use super::super::grid::likelihood_field::{
    FULL, Kernel, LikelihoodField, Linearization, Points, Window, WindowPose,
};
use super::super::pose::{Pose2, wrap_angle};
use super::prepared_scan::PreparedScan;

/// Cells a match may move along an axis; the window is that much larger than the scan.
const REACH: f64 = 40.0;
/// Headings tried around the start before the climb, each way, and the angle between them, rad.
const SWEEP: (i32, f64) = (4, 0.1);
/// Step lengths of the climb, each half the one before.
const CLIMB_LEVELS: u32 = 2;
const POLISH_STEPS: u32 = 5;
/// Longest Gauss-Newton step: cells and radians.
const STEP_LIMIT: (f64, f64) = (2.0, 0.1);
/// Steps below this end the polish: cells and radians.
const CONVERGED: (f64, f64) = (0.02, 0.0004);
/// The share of beams that are expected to end on what the map knows (Thrun, Burgard, Fox:
/// Probabilistic Robotics, table 6.3, z_hit).
const HIT_SHARE: f64 = 0.9;
/// Beams with at least this level of the field take part in the estimate of the residual's variance.
const MATCHED: u8 = 3;

/// The scan matcher's settings.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MatcherParameters {
    /// Which matcher runs.
    pub kind: MatcherKind,
    /// `lstep`, m: first step of the hill climb.
    pub linear_step: f64,
    /// `astep`, rad: first step of the hill climb.
    pub angular_step: f64,
    /// `lskip`: this many beams are passed over between two that are matched.
    pub beam_skip: usize,
    /// `minimumScore`: a match counts only if its score is above this.
    pub minimum_score: f64,
    /// Standard deviation of the likelihood field around each hit, m.
    pub field_sigma: f64,
    /// `iterations`: how often the compat matcher halves its steps.
    pub iterations: u32,
    /// `sigma`: the compat matcher's score is exp(-d² / sigma), m².
    pub sigma: f64,
    /// `kernelSize`, cells: the compat matcher looks this far around an endpoint.
    pub kernel_size: u32,
    /// `lsigma`: the compat matcher's log likelihood of a beam is -d² / lsigma, m².
    pub likelihood_sigma: f64,
}

impl Default for MatcherParameters {
    fn default() -> Self {
        Self {
            kind: MatcherKind::Field,
            linear_step: 0.05,
            angular_step: 0.05,
            beam_skip: 0,
            minimum_score: 0.0,
            field_sigma: 0.04,
            iterations: 5,
            sigma: 0.05,
            kernel_size: 1,
            likelihood_sigma: 0.075,
        }
    }
}

/// Which scan matcher runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MatcherKind {
    /// A cached likelihood field, a coarse climb and a Gauss-Newton polish.
    Field,
    /// The original's objective and schedule: slow, and the reference for tests.
    Compat,
}

/// The outcome of matching one scan against one map.
#[derive(Debug, Clone, Copy)]
pub struct Match {
    /// The base in `map`.
    pub pose_in_map: Pose2,
    /// Uncertainty of the pose: m², m rad, rad²; x and y along the map's axes. Zero where the
    /// matcher knows none: the compat matcher, or a scan that fits nowhere.
    pub covariance: Matrix3<f64>,
    /// ln p(z | x, m) up to a constant.
    pub log_likelihood: f64,
    /// Sum over beams: near 1 for a beam that ends on a hit, 0 for one that ends far from any.
    pub score: f64,
}

/// Matches scans with a likelihood field: a coarse climb, then a Gauss-Newton polish.
#[derive(Debug, Clone)]
pub struct FieldMatcher {
    parameters: MatcherParameters,
    resolution: f64,
    kernel: Kernel,
    log_likelihoods: [f64; FULL as usize + 1],
}

impl FieldMatcher {
    /// A matcher for fields of cells of `resolution` metres.
    #[must_use]
    pub fn new(parameters: MatcherParameters, resolution: f64) -> Self {
        let log_likelihood = |level: usize| {
            let hit = level as f64 / f64::from(FULL);
            libm::log(HIT_SHARE * hit + (1.0 - HIT_SHARE))
        };
        Self {
            parameters,
            resolution,
            kernel: Kernel::new(parameters.field_sigma / resolution),
            log_likelihoods: std::array::from_fn(log_likelihood),
        }
    }

    /// Matches a scan against `field`, starting with the base at `start`.
    #[must_use]
    pub fn run(&self, field: &LikelihoodField, scan: &PreparedScan, start: Pose2) -> Match {
        let centre = Cell::containing(start.position(), self.resolution);
        let window = Window::around(field, centre, scan.radius + REACH as i32 + 2);
        let first = window.first_cell();
        let origin = WindowPose::new(
            start.x / self.resolution - f64::from(first.ix),
            start.y / self.resolution - f64::from(first.iy),
            start.theta,
        );
        let climbed = self.climb(&window, &scan.coarse_hits, origin);
        let (pose, fit) = polish(&window, &scan.hits, climbed, origin);
        let Evidence { log_likelihood, residual_variance } = self.evidence(&window, scan, pose);
        Match {
            pose_in_map: Pose2::new(
                start.x + (pose.x - origin.x) * self.resolution,
                start.y + (pose.y - origin.y) * self.resolution,
                wrap_angle(pose.theta),
            ),
            covariance: self.covariance(&fit, residual_variance),
            log_likelihood,
            score: scan.hits.len() as f64 - f64::from(fit.cost),
        }
    }

    /// Enters a scan taken with the base at `pose` into `field`.
    pub fn register(&self, field: &mut LikelihoodField, scan: &PreparedScan, pose: Pose2) {
        let origin = Cell::containing(pose.position(), self.resolution);
        let x = pose.x / self.resolution - f64::from(origin.ix);
        let y = pose.y / self.resolution - f64::from(origin.iy);
        let pose = WindowPose::new(x, y, pose.theta);
        self.kernel.insert(field, origin, &scan.surfaces, pose);
    }

    /// Enters points, in cells from the lower-left corner of `origin`, into `field`.
    pub fn enter(&self, field: &mut LikelihoodField, origin: Cell, points: &Points) {
        self.kernel.insert(field, origin, points, WindowPose::new(0.0, 0.0, 0.0));
    }

    /// A sweep of headings, then hill climbing along the map's axes and the heading.
    fn climb(&self, window: &Window<'_>, points: &Points, origin: WindowPose) -> WindowPose {
        let mut best = (window.score(points, origin), origin);
        let (each_way, angle) = SWEEP;
        let headings = (-each_way..=each_way).filter(|i| *i != 0);
        let sweep = headings.map(|i| origin.turned(f64::from(i) * angle));
        best = better(window, points, best, sweep);
        let mut step = self.parameters.linear_step / self.resolution;
        let mut turn = self.parameters.angular_step;
        for _ in 0..CLIMB_LEVELS {
            loop {
                let from = best.1;
                let moves = [
                    from.moved(step, 0.0),
                    from.moved(-step, 0.0),
                    from.moved(0.0, step),
                    from.moved(0.0, -step),
                    from.turned(turn),
                    from.turned(-turn),
                ];
                let within = moves.into_iter().filter(|pose| within_reach(*pose, origin));
                let found = better(window, points, best, within);
                if found.0 == best.0 {
                    break;
                }
                best = found;
            }
            step *= 0.5;
            turn *= 0.5;
        }
        best.1
    }

    fn evidence(&self, window: &Window<'_>, scan: &PreparedScan, pose: WindowPose) -> Evidence {
        let mut log_likelihood = 0.0;
        let (mut squares, mut matched) = (0.0, 0.0);
        window.for_each_value(&scan.hits, pose, |level| {
            log_likelihood += self.log_likelihoods[usize::from(level & FULL)];
            if level >= MATCHED {
                let residual = 1.0 - f64::from(level) / f64::from(FULL);
                squares += residual * residual;
                matched += 1.0;
            }
        });
        Evidence { log_likelihood, residual_variance: squares / f64::max(matched, 1.0) }
    }

    /// The residuals' variance times the inverse of the information, in metres and radians.
    fn covariance(&self, fit: &Linearization, residual_variance: f64) -> Matrix3<f64> {
        let scale = Matrix3::from_diagonal(&Vector3::new(self.resolution, self.resolution, 1.0));
        let inverse = information(fit).try_inverse().unwrap_or_else(Matrix3::zeros);
        scale * inverse * scale * residual_variance
    }
}

/// What a scan says at the pose it was matched to.
struct Evidence {
    log_likelihood: f64,
    /// Mean square of 1 - m over the beams that end near something known.
    residual_variance: f64,
}

/// The best of a scored pose and some others; the first of equals.
fn better(
    window: &Window<'_>,
    points: &Points,
    best: (u32, WindowPose),
    poses: impl Iterator<Item = WindowPose>,
) -> (u32, WindowPose) {
    poses
        .map(|pose| (window.score(points, pose), pose))
        .fold(best, |best, other| if other.0 > best.0 { other } else { best })
}

/// Gauss-Newton on the interpolated field; a step counts only if the fit improves.
fn polish(
    window: &Window<'_>,
    points: &Points,
    start: WindowPose,
    origin: WindowPose,
) -> (WindowPose, Linearization) {
    let (mut pose, mut fit) = (start, window.linearize(points, start));
    for _ in 0..POLISH_STEPS {
        let Some(step) = gauss_newton_step(&fit) else { break };
        let next = WindowPose::new(pose.x + step[0], pose.y + step[1], pose.theta + step[2]);
        if !within_reach(next, origin) {
            break;
        }
        let next_fit = window.linearize(points, next);
        if next_fit.cost >= fit.cost {
            break;
        }
        (pose, fit) = (next, next_fit);
        if step.xy().norm() < CONVERGED.0 && step[2].abs() < CONVERGED.1 {
            break;
        }
    }
    (pose, fit)
}

/// H⁻¹ Jᵀe, shortened to the step limit; `None` where the field is flat in some direction.
fn gauss_newton_step(fit: &Linearization) -> Option<Vector3<f64>> {
    let step = information(fit).try_inverse()? * Vector3::from(fit.gradient.map(f64::from));
    let excess = (step.xy().norm() / STEP_LIMIT.0).max(step[2].abs() / STEP_LIMIT.1).max(1.0);
    excess.is_finite().then(|| step / excess)
}

fn information(fit: &Linearization) -> Matrix3<f64> {
    let [xx, xy, xt, yy, yt, tt] = fit.information.map(f64::from);
    Matrix3::new(xx, xy, xt, xy, yy, yt, xt, yt, tt)
}

fn within_reach(pose: WindowPose, origin: WindowPose) -> bool {
    (pose.x - origin.x).abs() <= REACH && (pose.y - origin.y).abs() <= REACH
}
