//! What the wheels say, gathered between processed scans, and how far to trust it.

use serde::{Deserialize, Serialize};

use super::pose::Pose2;

/// Metres of travel and radians of turn over which the noise parameters hold as given.
///
/// The original applies them to each message. This is the step of a robot at a quarter of a metre
/// a second that reports at 10 Hz; in the Intel log of the original's authors it is 0.037 m.
const REFERENCE_STEP: f64 = 0.025;
/// Odometry further from its origin than this is not a robot's, m.
const FURTHEST: f64 = 1e7;
/// Share of the noise along an axis that travel along the other axis adds, as in the original.
const CROSS_AXIS: f64 = 0.3;

/// Standard deviations of the odometry, per metre and per radian of motion.
///
/// The four names are slam_gmapping's; `srt` and `str` mean what its code does with them, which
/// its documentation describes the other way round.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct MotionNoise {
    /// `srr`: metres of translation noise per metre travelled.
    pub translation_from_translation: f64,
    /// `str`: metres of translation noise per radian turned.
    pub translation_from_rotation: f64,
    /// `srt`: radians of rotation noise per metre travelled.
    pub rotation_from_translation: f64,
    /// `stt`: radians of rotation noise per radian turned.
    pub rotation_from_rotation: f64,
}

impl Default for MotionNoise {
    fn default() -> Self {
        Self {
            translation_from_translation: 0.1,
            translation_from_rotation: 0.1,
            rotation_from_translation: 0.2,
            rotation_from_rotation: 0.2,
        }
    }
}

impl MotionNoise {
    /// Standard deviations of `motion` along x and y (m) and of its turn (rad).
    #[must_use]
    pub fn standard_deviations(&self, motion: &Motion) -> [f64; 3] {
        let deviation = |terms: [(f64, f64); 3]| {
            let variance: f64 =
                terms.iter().map(|(noise, amount)| noise * noise * amount * REFERENCE_STEP).sum();
            variance.sqrt()
        };
        let along = self.translation_from_translation;
        let across = CROSS_AXIS * along;
        let turned = (self.translation_from_rotation, motion.turned);
        [
            deviation([(along, motion.forward), (across, motion.sideways), turned]),
            deviation([(along, motion.sideways), (across, motion.forward), turned]),
            deviation([
                (self.rotation_from_translation, motion.forward + motion.sideways),
                (self.rotation_from_rotation, motion.turned),
                (0.0, 0.0),
            ]),
        ]
    }
}

/// What happens when odometry moves further between two readings than a robot can.
///
/// The original prints a banner and believes the jump.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct JumpGuard {
    /// Metres between two successive odometry readings that count as a jump.
    pub max_step: f64,
    /// What then happens.
    pub policy: JumpPolicy,
}

impl Default for JumpGuard {
    fn default() -> Self {
        Self { max_step: 20.0, policy: JumpPolicy::Reject }
    }
}

impl JumpGuard {
    /// Whether a step is to be taken out.
    #[must_use]
    pub fn rejects(&self, step: Pose2) -> bool {
        self.policy == JumpPolicy::Reject && step.position().norm() > self.max_step
    }

    /// Whether a pose can be a robot's at all.
    pub(super) fn is_usable(&self, odom_from_base: Pose2) -> bool {
        odom_from_base.is_finite() && odom_from_base.position().norm() <= FURTHEST
    }
}

/// What to do with a reading that jumped.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum JumpPolicy {
    /// The jump is taken out: the robot is believed not to have moved meanwhile.
    Reject,
    /// The jump is believed.
    Continue,
}

/// The motion of the base between two moments, as odometry tells it.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Motion {
    /// The later base seen from the earlier one.
    pub increment: Pose2,
    /// Length of the path between them, m.
    pub path_length: f64,
    /// The part of the path along the base's x axis, either way, m.
    pub forward: f64,
    /// The part along its y axis, either way, m.
    pub sideways: f64,
    /// Radians turned, either way.
    pub turned: f64,
}

impl Motion {
    /// All its figures as poses, to look whether they are numbers.
    pub(super) fn poses(&self) -> [Pose2; 2] {
        let [along, across] = [self.forward, self.sideways];
        [self.increment, Pose2::new(self.path_length + self.turned, along, across)]
    }

    /// Goes on by `step`, the base after it seen from the base before it.
    pub fn extend(&mut self, step: Pose2) {
        self.increment = self.increment * step;
        self.path_length += step.position().norm();
        self.forward += step.x.abs();
        self.sideways += step.y.abs();
        self.turned += step.theta.abs();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn motion(steps: u32) -> Motion {
        let mut motion = Motion::default();
        let share = 1.0 / f64::from(steps);
        (0..steps).for_each(|_| motion.extend(Pose2::new(2.0 * share, 0.0, 0.6 * share)));
        motion
    }

    #[test]
    fn noise_does_not_depend_on_the_message_rate() {
        let noise = MotionNoise::default();
        let [slow, fast] = [4, 400].map(|steps| noise.standard_deviations(&motion(steps)));
        for (slow, fast) in slow.iter().zip(fast) {
            assert!((slow / fast - 1.0).abs() < 1e-9, "{slow} {fast}");
        }
    }

    #[test]
    fn a_reference_step_has_the_noise_that_the_original_gives_it() {
        let mut motion = Motion::default();
        motion.extend(Pose2::new(REFERENCE_STEP, 0.0, 0.0));
        let [along, across, turn] = MotionNoise::default().standard_deviations(&motion);
        assert!((along - 0.1 * REFERENCE_STEP).abs() < 1e-12);
        assert!((across - 0.03 * REFERENCE_STEP).abs() < 1e-12);
        assert!((turn - 0.2 * REFERENCE_STEP).abs() < 1e-12);
    }

    #[test]
    fn motion_counts_both_ways() {
        let mut motion = Motion::default();
        motion.extend(Pose2::new(1.0, 0.0, 0.5));
        motion.extend(Pose2::new(0.0, 0.0, -0.5));
        motion.extend(Pose2::new(-1.0, 0.0, 0.0));
        assert_eq!((motion.path_length, motion.forward, motion.turned), (2.0, 2.0, 1.0));
        assert!(motion.increment.position().norm() < 1e-12);
    }
}
