//! Where the robot is before the scan is looked at: by odometry, or by going on as before.

use nalgebra::{Matrix3, Vector3};

use super::super::odometry::{Motion, MotionNoise};
use super::super::pose::{Pose2, wrap_angle};
use super::gauss_newton::Prior;

/// Odometry that bends or slips errs by this many of the standard deviations that `srr` and its
/// like give a step: along the way and in the heading.
const DISTRUST: [f64; 2] = [3.0, 5.0];
/// Odometry is never surer than this: m and rad.
const ODOMETRY_FLOOR: [f64; 2] = [0.005, 0.003];
/// Without odometry, robots are believed to change their speed like this: m/s² and rad/s².
const ACCELERATION: [f64; 2] = [8.0, 16.0];
/// Without odometry, a motion that no scan confirms dies away with this time constant, s.
const PERSISTENCE: f64 = 0.3;
/// Without odometry, the next scan is never surer than this: m and rad.
const VELOCITY_FLOOR: [f64; 2] = [0.01, 0.01];
/// Without odometry, a robot does not get further between two scans: m and rad.
const FURTHEST: [f64; 2] = [0.7, 0.4];
/// Velocities are taken over a time between these, s: stamps of real logs repeat and jump.
const STEADY: [f64; 2] = [0.01, 0.5];
/// Faster robots are not believed in: m/s and rad/s.
const FASTEST: [f64; 2] = [5.0, 4.0];

/// A pose and how sure it is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Prediction {
    /// The base in `map`.
    pub pose_in_map: Pose2,
    /// m², m rad, rad².
    pub covariance: Matrix3<f64>,
}

impl Prediction {
    /// The motion of the wheels since the pose `from` with its covariance.
    #[must_use]
    pub fn by_odometry(from: (Pose2, Matrix3<f64>), motion: &Motion, noise: MotionNoise) -> Self {
        let [along, across, turn] = noise.standard_deviations(motion);
        let [distance, angle] = ODOMETRY_FLOOR;
        let [moved, turned] = DISTRUST;
        let deviations =
            [moved * along + distance, moved * across + distance, turned * turn + angle];
        Self::after(from, motion.increment, deviations)
    }

    /// Going on as before for `seconds`, if it is known how.
    #[must_use]
    pub fn by_velocity(from: (Pose2, Matrix3<f64>), velocity: Option<Pose2>, seconds: f64) -> Self {
        let known = velocity.filter(|_| seconds > 0.0 && seconds <= STEADY[1]);
        let coasting = PERSISTENCE * (1.0 - libm::exp(-seconds / PERSISTENCE));
        let increment = known.map_or(Pose2::IDENTITY, |velocity| scaled(velocity, coasting));
        let [distance, angle] = [0, 1].map(|axis| {
            let changed = 0.5 * ACCELERATION[axis] * seconds * seconds;
            let reach = if known.is_some() { changed } else { FURTHEST[axis] };
            (VELOCITY_FLOOR[axis] + reach).min(FURTHEST[axis])
        });
        Self::after(from, increment, [distance, distance, angle])
    }

    /// Somewhere around a pose: standard deviations, m and rad.
    #[must_use]
    pub fn within(pose_in_map: Pose2, [distance, angle]: [f64; 2]) -> Self {
        let variances = Vector3::new(distance * distance, distance * distance, angle * angle);
        Self { pose_in_map, covariance: Matrix3::from_diagonal(&variances) }
    }

    /// Somewhere around there: what is left when the scan contradicts what it was.
    #[must_use]
    pub fn lost(&self) -> Self {
        let [distance, angle] = FURTHEST;
        Self::after(
            (self.pose_in_map, self.covariance),
            Pose2::IDENTITY,
            [distance, distance, angle],
        )
    }

    fn after((pose, covariance): (Pose2, Matrix3<f64>), step: Pose2, deviations: [f64; 3]) -> Self {
        let pose_in_map = pose * step;
        let (dx, dy) = (pose_in_map.x - pose.x, pose_in_map.y - pose.y);
        let carried = Matrix3::new(1.0, 0.0, -dy, 0.0, 1.0, dx, 0.0, 0.0, 1.0);
        let (sin, cos) = libm::sincos(wrap_angle(pose.theta + 0.5 * step.theta));
        let turned = Matrix3::new(cos, -sin, 0.0, sin, cos, 0.0, 0.0, 0.0, 1.0);
        let variances = Vector3::from(deviations.map(|deviation| deviation * deviation));
        let noise = turned * Matrix3::from_diagonal(&variances) * turned.transpose();
        Self { pose_in_map, covariance: carried * covariance * carried.transpose() + noise }
    }

    /// Standard deviations: of the worst direction, m, and of the heading, rad.
    #[must_use]
    pub fn deviations(&self) -> [f64; 2] {
        let c = &self.covariance;
        let (mean, half) = (0.5 * (c[(0, 0)] + c[(1, 1)]), 0.5 * (c[(0, 0)] - c[(1, 1)]));
        let worst = mean + (half * half + c[(0, 1)] * c[(0, 1)]).sqrt();
        [worst.sqrt(), c[(2, 2)].sqrt()]
    }

    /// What it says to the matcher; `None` if it is not a number.
    #[must_use]
    pub fn prior(&self) -> Option<Prior> {
        let information = self.covariance.try_inverse()?;
        Some(Prior { pose_in_map: self.pose_in_map, information })
    }
}

/// The motion a second, if `seconds` is a time in which a robot moves steadily, and it is not too
/// fast for one; it is the mean of that in this step and of what was known `before`.
///
/// Without the mean, sweeps that are deskewed by it would begin to swing: a pose that is ahead by
/// some error makes the next one fall behind by half of that, twice.
#[must_use]
pub fn velocity(step: Pose2, seconds: f64, before: Option<Pose2>) -> Option<Pose2> {
    let steady = (STEADY[0]..=STEADY[1]).contains(&seconds);
    let velocity = scaled(step, 1.0 / seconds);
    let slow = velocity.position().norm() <= FASTEST[0] && velocity.theta.abs() <= FASTEST[1];
    let Pose2 { x, y, theta } = before.unwrap_or(velocity);
    let mean = Pose2::new(velocity.x + x, velocity.y + y, velocity.theta + theta);
    (steady && slow).then_some(scaled(mean, 0.5))
}

fn scaled(motion: Pose2, factor: f64) -> Pose2 {
    Pose2::new(motion.x * factor, motion.y * factor, motion.theta * factor)
}
