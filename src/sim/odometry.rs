//! Simulated wheel odometry: the truth with errors that grow along the way.

use rand::Rng;

use super::random::gaussian;
use crate::slam::odometry::MotionNoise;
use crate::slam::pose::Pose2;

/// The step for which `MotionNoise` gives the spread, m.
const REFERENCE_STEP_M: f64 = 0.1;
/// The turn for which `MotionNoise` gives the spread, rad.
const REFERENCE_TURN_RAD: f64 = 0.05;
/// slam_gmapping's share of `srr` that acts across the direction of travel.
const ACROSS: f64 = 0.3;

/// How wrong the wheels are.
///
/// slam_gmapping draws noise at every reading with a standard deviation linear in the step, so
/// its spread over a way depends on how often readings come. Here it does not: the *variance* is
/// linear in the way, and equals the original's when readings come every 0.1 m and every 0.05 rad.
/// For a coefficient `k` the variance is `k² · 0.1 m` a metre and `k² · 0.05 rad` a radian, so
/// with the default noise
///
/// - a metre of travel spreads the translation by `srr · √0.1` = 0.032 m
///   and the heading by `srt · √0.1` = 0.063 rad;
/// - a radian of turning spreads the translation by `str · √0.05` = 0.022 m
///   and the heading by `stt · √0.05` = 0.045 rad.
///
/// As in the original, 0.3 of the travel noise acts across the direction of travel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OdometryModel {
    /// Coefficients of the random errors.
    pub noise: MotionNoise,
    /// Multiplies the standard deviations; 0 gives perfect odometry.
    pub factor: f64,
    /// Metres reported a metre travelled; 1.01 reports 1 % too much.
    pub translation_scale: f64,
    /// Radians reported a radian turned.
    pub rotation_scale: f64,
}

impl Default for OdometryModel {
    fn default() -> Self {
        Self {
            noise: MotionNoise::default(),
            factor: 1.0,
            translation_scale: 1.0,
            rotation_scale: 1.0,
        }
    }
}

impl OdometryModel {
    /// What the wheels report for a true `motion` of the base, in the earlier base frame.
    pub fn measured(&self, motion: Pose2, rng: &mut impl Rng) -> Pose2 {
        let noise = &self.noise;
        let (dx, dy) = (motion.x.abs(), motion.y.abs());
        let (way, turn) = (motion.position().norm(), motion.theta.abs());
        let along = noise.translation_from_translation;
        let turning = variance(noise.translation_from_rotation, REFERENCE_TURN_RAD, turn);
        let mut draw = |variance: f64| self.factor * variance.sqrt() * gaussian(rng);
        let travel = |own: f64, other: f64| {
            variance(along, REFERENCE_STEP_M, own)
                + variance(ACROSS * along, REFERENCE_STEP_M, other)
        };
        let x = draw(travel(dx, dy) + turning);
        let y = draw(travel(dy, dx) + turning);
        let theta = draw(
            variance(noise.rotation_from_translation, REFERENCE_STEP_M, way)
                + variance(noise.rotation_from_rotation, REFERENCE_TURN_RAD, turn),
        );
        Pose2::new(
            self.translation_scale * motion.x + x,
            self.translation_scale * motion.y + y,
            self.rotation_scale * motion.theta + theta,
        )
    }
}

/// Variance over `amount` of motion when the standard deviation over `reference` of it is
/// `coefficient * reference`.
fn variance(coefficient: f64, reference: f64, amount: f64) -> f64 {
    coefficient * coefficient * reference * amount
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sim::random::{Purpose, generator};

    /// Sums of the errors over `steps` equal steps that make up `motion`, for many runs:
    /// mean and standard deviation of x, y and theta.
    fn spread(model: &OdometryModel, motion: Pose2, steps: u32) -> [[f64; 2]; 3] {
        const RUNS: u64 = 4000;
        let share = 1.0 / f64::from(steps);
        let step = Pose2::new(share * motion.x, share * motion.y, share * motion.theta);
        let (mut sums, mut squares) = ([0.0; 3], [0.0; 3]);
        for run in 0..RUNS {
            let mut rng = generator(5, Purpose::Odometry, run);
            let mut total = [-motion.x, -motion.y, -motion.theta];
            for _ in 0..steps {
                let d = model.measured(step, &mut rng);
                total = [total[0] + d.x, total[1] + d.y, total[2] + d.theta];
            }
            for axis in 0..3 {
                sums[axis] += total[axis];
                squares[axis] += total[axis] * total[axis];
            }
        }
        [0, 1, 2].map(|axis| {
            let mean = sums[axis] / RUNS as f64;
            [mean, (squares[axis] / RUNS as f64 - mean * mean).sqrt()]
        })
    }

    fn assert_spread(found: [[f64; 2]; 3], expected_std: [f64; 3]) {
        for ([mean, std], expected) in found.into_iter().zip(expected_std) {
            assert!(mean.abs() < 0.06 * expected, "mean {mean} of {found:?}");
            assert!((std / expected - 1.0).abs() < 0.05, "std {std}, not {expected}");
        }
    }

    #[test]
    fn a_metre_spreads_as_documented_at_any_reading_rate() {
        let metre = Pose2::new(1.0, 0.0, 0.0);
        for steps in [1, 10, 50] {
            let found = spread(&OdometryModel::default(), metre, steps);
            assert_spread(found, [0.0316, 0.3 * 0.0316, 0.0632]);
        }
    }

    #[test]
    fn a_radian_spreads_as_documented_at_any_reading_rate() {
        for steps in [1, 20] {
            let found = spread(&OdometryModel::default(), Pose2::new(0.0, 0.0, 1.0), steps);
            assert_spread(found, [0.0224, 0.0224, 0.0447]);
        }
    }

    #[test]
    fn scales_are_systematic_and_a_factor_of_0_takes_the_noise_away() {
        let model = OdometryModel {
            factor: 0.0,
            translation_scale: 1.01,
            rotation_scale: 0.98,
            ..OdometryModel::default()
        };
        let mut rng = generator(1, Purpose::Odometry, 0);
        let reported = model.measured(Pose2::new(2.0, 0.0, 0.5), &mut rng);
        assert_eq!(reported, Pose2::new(2.02, 0.0, 0.49));
    }
}
