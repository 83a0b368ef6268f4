//! Trajectories in the format of the TUM benchmark, which evaluation tools read.

use std::io::{self, Write};

use crate::slam::pose::{Pose2, Stamp};

/// Writes one line `stamp x y z qx qy qz qw`: seconds, metres and a unit quaternion.
///
/// # Errors
/// When writing fails.
pub fn write_pose(out: &mut impl Write, stamp: Stamp, pose: Pose2) -> io::Result<()> {
    let (sin, cos) = libm::sincos(0.5 * pose.theta);
    writeln!(out, "{:.6} {} {} 0 0 0 {sin} {cos}", stamp.as_seconds(), pose.x, pose.y)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_has_seconds_metres_and_a_quaternion() {
        let mut out = Vec::new();
        write_pose(&mut out, Stamp(1_500_000_000), Pose2::new(1.25, -2.0, 0.0)).unwrap();
        assert_eq!(String::from_utf8(out).unwrap(), "1.500000 1.25 -2 0 0 0 0 1\n");
    }
}
