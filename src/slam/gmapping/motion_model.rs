//! The odometry motion model: p(xₜ | uₜ, xₜ₋₁), sampled once for each processed scan.

use super::super::odometry::{Motion, MotionNoise};
use super::super::pose::{Pose2, wrap_angle};
use super::random::Gaussian;

/// Draws where the base is after `motion`, seen from where it was.
///
/// The original draws noise for each message with a standard deviation proportional to the step,
/// so its total shrinks as messages come faster. Here variances grow with the distance, whatever
/// the rate: a path of n reference steps has the variance the original gives n such messages.
#[must_use]
pub fn sample(motion: &Motion, noise: &MotionNoise, gaussian: &mut Gaussian) -> Pose2 {
    let [sx, sy, st] = noise.standard_deviations(motion);
    let Pose2 { x, y, theta } = motion.increment;
    Pose2::new(
        x + sx * gaussian.draw(),
        y + sy * gaussian.draw(),
        wrap_angle(theta + st * gaussian.draw()),
    )
}
