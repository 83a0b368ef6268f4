//! The absolute trajectory error against a truth that is known at every pose.

use super::{ErrorStatistics, EvaluationError, StampedPose};
use crate::slam::pose::{Point2, Pose2, wrap_angle};

/// How the frames of two trajectories are brought together before they are compared.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Alignment {
    /// They are the same frame.
    None,
    /// By the rigid motion with the least squared distance between positions (Umeyama 1991
    /// without scale).
    Rigid,
}

/// The distances, m, and angles, degrees, between poses of the same index.
///
/// # Errors
/// When the trajectories differ in length or are empty.
pub fn absolute_errors(
    estimate: &[StampedPose],
    truth: &[StampedPose],
    alignment: Alignment,
) -> Result<[ErrorStatistics; 2], EvaluationError> {
    if estimate.len() != truth.len() {
        return Err(EvaluationError::Lengths { estimate: estimate.len(), truth: truth.len() });
    }
    let truth_from_estimate = match alignment {
        Alignment::None => Pose2::IDENTITY,
        Alignment::Rigid => rigid_alignment(estimate, truth),
    };
    let errors: Vec<Pose2> = estimate
        .iter()
        .zip(truth)
        .map(|(estimate, truth)| truth.pose.between(truth_from_estimate * estimate.pose))
        .collect();
    let distances = errors.iter().map(|error| error.position().norm()).collect();
    let angles = errors.iter().map(|error| error.theta.abs().to_degrees()).collect();
    let statistics = |values| ErrorStatistics::of(values).ok_or(EvaluationError::Empty);
    Ok([statistics(distances)?, statistics(angles)?])
}

/// In the plane the best rotation has a closed form: the angle of the summed products.
fn rigid_alignment(estimate: &[StampedPose], truth: &[StampedPose]) -> Pose2 {
    let (centre, truth_centre) = (centroid(estimate), centroid(truth));
    let (mut cos, mut sin) = (0.0, 0.0);
    for (a, b) in estimate.iter().zip(truth) {
        let (ax, ay) = (a.pose.x - centre.x, a.pose.y - centre.y);
        let (bx, by) = (b.pose.x - truth_centre.x, b.pose.y - truth_centre.y);
        cos += ax * bx + ay * by;
        sin += ax * by - ay * bx;
    }
    let rotation = Pose2::new(0.0, 0.0, wrap_angle(libm::atan2(sin, cos)));
    let turned = rotation * centre;
    Pose2::new(truth_centre.x - turned.x, truth_centre.y - turned.y, rotation.theta)
}

fn centroid(trajectory: &[StampedPose]) -> Point2 {
    let count = trajectory.len().max(1) as f64;
    let sum = |of: fn(&StampedPose) -> f64| trajectory.iter().map(of).sum::<f64>() / count;
    Point2::new(sum(|p| p.pose.x), sum(|p| p.pose.y))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::{prop_assert, proptest};

    use super::*;
    use crate::slam::pose::Stamp;

    fn trajectory(poses: &[(f64, f64, f64)]) -> Vec<StampedPose> {
        poses
            .iter()
            .map(|&(x, y, theta)| StampedPose { stamp: Stamp(0), pose: Pose2::new(x, y, theta) })
            .collect()
    }

    #[test]
    fn without_alignment_an_offset_is_an_error() {
        let truth = trajectory(&[(0.0, 0.0, 0.0), (1.0, 0.0, 0.0)]);
        let estimate = trajectory(&[(0.0, 0.5, 0.0), (1.0, 0.5, 0.0)]);
        let [distance, angle] = absolute_errors(&estimate, &truth, Alignment::None).unwrap();
        assert_eq!((distance.mean, distance.max, angle.max), (0.5, 0.5, 0.0));
        let [distance, _] = absolute_errors(&estimate, &truth, Alignment::Rigid).unwrap();
        assert!(distance.max < 1e-12);
    }

    #[test]
    fn trajectories_of_different_length_are_not_compared() {
        let truth = trajectory(&[(0.0, 0.0, 0.0)]);
        assert_eq!(
            absolute_errors(&[], &truth, Alignment::None),
            Err(EvaluationError::Lengths { estimate: 0, truth: 1 })
        );
        assert_eq!(absolute_errors(&[], &[], Alignment::Rigid), Err(EvaluationError::Empty));
    }

    proptest! {
        #[test]
        fn a_rigid_motion_is_aligned_away(x in -50.0..50.0, y in -50.0..50.0, theta in -3.1..3.1) {
            let truth = trajectory(&[(0.0, 0.0, 0.1), (3.0, 1.0, 0.2), (4.0, -2.0, 3.0)]);
            let moved = Pose2::new(x, y, theta);
            let estimate: Vec<StampedPose> = truth
                .iter()
                .map(|p| StampedPose { stamp: p.stamp, pose: moved * p.pose })
                .collect();
            let [distance, angle] = absolute_errors(&estimate, &truth, Alignment::Rigid).unwrap();
            prop_assert!(distance.max < 1e-9 && angle.max < 1e-9);
        }
    }
}
