//! What a scan does not tell: the motion that leaves all that it sees where it is.
//!
//! The directions of the surfaces decide (as in Censi, "On achievable accuracy for range-finder
//! localization", ICRA 2007), not the map: the cells of a straight wall look as if they held the
//! robot along it.

use nalgebra::{Matrix3, SymmetricEigen, Vector3};

use super::super::pose::{Point2, Pose2};
use super::super::update::WeakDirection;
use super::gauss_newton::Fit;

/// A surface's direction is taken over this length to either side of a hit, m.
const REACH: f64 = 0.3;
/// Shorter pieces of surfaces have no direction, m.
const SHORTEST: f32 = 0.2;
/// Neighbouring hits further apart than this share of their distance are on two surfaces, ...
const GAP: f32 = 0.2;
/// ... unless they are nearer than this, m.
const SMALL_GAP: f32 = 0.2;
/// A direction is weak if less than this share of the surfaces stands against it.
const WEAK: f64 = 0.015;

/// What a scan does not tell; nothing where all is told.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Weakness {
    /// Unit vector in the base frame; the heading times `lever`.
    direction: Option<Vector3<f64>>,
    lever: f64,
}

impl Weakness {
    /// Looks at the surfaces that `hits` lie on: base frame, m, in the order of the beams.
    #[must_use]
    pub fn of(hits: &[[f32; 2]], lever: f64) -> Self {
        let (sum, count) = surfaces(hits, lever);
        if count < 3 {
            return Self { direction: None, lever };
        }
        let eigen = SymmetricEigen::new(sum / f64::from(count));
        let least = eigen.eigenvalues.imin();
        let weak = eigen.eigenvalues[least] < WEAK;
        let direction = weak.then(|| eigen.eigenvectors.column(least).into_owned());
        Self { direction, lever }
    }

    /// The weak direction in `map`, with the base at heading `theta` there.
    #[must_use]
    pub fn direction_in_map(&self, theta: f64) -> Option<WeakDirection> {
        let direction = self.direction?;
        let turned = Pose2::new(0.0, 0.0, theta) * Point2::new(direction.x, direction.y);
        Some(WeakDirection { x: turned.x, y: turned.y, turn: direction.z })
    }

    /// Second and first derivatives of a fit, without what they say of the weak direction.
    #[must_use]
    pub fn without(&self, fit: &Fit, theta: f64) -> (Matrix3<f64>, Vector3<f64>) {
        let Some(WeakDirection { x, y, turn }) = self.direction_in_map(theta) else {
            return (fit.hessian, fit.descent);
        };
        let weak = Vector3::new(x, y, turn);
        let keep = Matrix3::identity() - weak * weak.transpose();
        let scale = Vector3::new(1.0, 1.0, self.lever);
        // From steps to steps without their weak part, in metres and radians.
        let project =
            Matrix3::from_diagonal(&scale.map(|s| 1.0 / s)) * keep * Matrix3::from_diagonal(&scale);
        (project.transpose() * fit.hessian * project, project.transpose() * fit.descent)
    }
}

/// Σ v vᵀ over hits on surfaces, with v how the distance to the surface changes with the pose,
/// and how many there are.
fn surfaces(hits: &[[f32; 2]], lever: f64) -> (Matrix3<f64>, u32) {
    let along = lengths(hits);
    let per_lever = 1.0 / lever;
    let [mut xx, mut xy, mut xt, mut yy, mut yt, mut tt] = [0.0; 6];
    let mut count = 0;
    let (mut first, mut last) = (0, 0);
    for (&[x, y], here) in hits.iter().zip(&along) {
        while here - along[first] > REACH {
            first += 1;
        }
        while along[last + 1] - here <= REACH {
            last += 1;
        }
        let (dx, dy) = (hits[last][0] - hits[first][0], hits[last][1] - hits[first][1]);
        let squared = dx * dx + dy * dy;
        if squared < SHORTEST * SHORTEST {
            continue;
        }
        // v times the length of the piece.
        let [vx, vy, turn] = [-dy, dx, x * dx + y * dy].map(f64::from);
        let (share, vt) = (1.0 / f64::from(squared), per_lever * turn);
        let [sx, sy, st] = [vx, vy, vt].map(|value| share * value);
        (xx, xy, xt) = (xx + sx * vx, xy + sx * vy, xt + sx * vt);
        (yy, yt, tt) = (yy + sy * vy, yt + sy * vt, tt + st * vt);
        count += 1;
    }
    let sum = Matrix3::new(xx, xy, xt, xy, yy, yt, xt, yt, tt);
    (sum, count)
}

/// Distance along the surfaces to each hit; where one ends, a long way to the next, and no way leads
/// beyond the last.
fn lengths(hits: &[[f32; 2]]) -> Vec<f64> {
    let mut length = 0.0;
    let mut before: Option<[f32; 2]> = None;
    let step = |hit: &[f32; 2]| {
        if let Some([bx, by]) = before.replace(*hit) {
            let ([x, y], squared_range) = (*hit, bx * bx + by * by);
            let squared_gap = (x - bx) * (x - bx) + (y - by) * (y - by);
            let apart = squared_gap > (SMALL_GAP * SMALL_GAP).max(GAP * GAP * squared_range);
            length += if apart { 1e3 } else { f64::from(squared_gap.sqrt()).min(REACH) };
        }
        length
    };
    hits.iter().map(step).chain([f64::INFINITY]).collect()
}
