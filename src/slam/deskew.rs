//! Motion during a sweep: where the base is when each beam is taken.
//!
//! A laser that turns once in a tenth of a second sees its last beam from elsewhere than its
//! first. The base is taken to move evenly meanwhile.

use serde::{Deserialize, Serialize};

use super::pose::Pose2;

/// Turns slower than this, rad, are straight: the difference is below a nanometre a metre.
const STRAIGHT: f64 = 1e-9;
/// No robot that maps is faster: m/s and rad/s.
const FASTEST: [f64; 2] = [10.0, 10.0];

/// How the base moves, in its own frame.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Velocity {
    /// Ahead, m/s.
    pub x: f64,
    /// To the left, m/s.
    pub y: f64,
    /// Counter-clockwise, rad/s.
    pub turn: f64,
}

impl Velocity {
    /// The even motion that takes the base through `motion` in `seconds`, which are not 0.
    #[must_use]
    pub fn of_motion(motion: Pose2, seconds: f64) -> Self {
        let Pose2 { x, y, theta } = motion;
        // Half the turn over its tangent undoes the bend of the arc (the logarithm of SE(2)).
        let half = 0.5 * theta;
        let straight = if half.abs() < STRAIGHT { 1.0 } else { half / libm::tan(half) };
        Self {
            x: (straight * x + half * y) / seconds,
            y: (straight * y - half * x) / seconds,
            turn: theta / seconds,
        }
    }

    /// Whether a robot moves like that. What has the pose jump during a sweep does not.
    #[must_use]
    pub fn is_of_a_robot(self) -> bool {
        libm::hypot(self.x, self.y) <= FASTEST[0] && self.turn.abs() <= FASTEST[1]
    }

    /// Where the base is after `seconds`, seen from where it was.
    #[must_use]
    pub fn after(self, seconds: f64) -> Pose2 {
        let (x, y, turn) = (self.x * seconds, self.y * seconds, self.turn * seconds);
        if turn.abs() < STRAIGHT {
            return Pose2::new(x, y, turn);
        }
        let (sin, cos) = libm::sincos(turn);
        let (along, across) = (sin / turn, (1.0 - cos) / turn);
        Pose2::new(along * x - across * y, across * x + along * y, turn)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::{prop_assert, proptest};

    use super::*;

    fn near(a: Pose2, b: Pose2) -> bool {
        let difference = a.between(b);
        difference.position().norm() < 1e-9 && difference.theta.abs() < 1e-9
    }

    #[test]
    fn a_quarter_of_a_circle_is_driven_evenly() {
        let velocity = Velocity::of_motion(Pose2::new(2.0, 2.0, std::f64::consts::FRAC_PI_2), 0.5);
        assert!((velocity.x - 2.0 * std::f64::consts::PI).abs() < 1e-9 && velocity.y.abs() < 1e-9);
        let half = std::f64::consts::FRAC_1_SQRT_2;
        let expected = Pose2::new(2.0 * half, 2.0 - 2.0 * half, std::f64::consts::FRAC_PI_4);
        assert!(near(velocity.after(0.25), expected));
    }

    proptest! {
        #[test]
        fn the_motion_comes_out_again(
            x in -2.0..2.0, y in -2.0..2.0, theta in -3.0..3.0, seconds in 0.01..1.0,
        ) {
            let motion = Pose2::new(x, y, theta);
            prop_assert!(near(Velocity::of_motion(motion, seconds).after(seconds), motion));
        }

        /// Two halves of an even motion are the whole.
        #[test]
        fn an_even_motion_goes_on_as_it_began(x in -2.0..2.0, y in -2.0..2.0, turn in -3.0..3.0) {
            let velocity = Velocity { x, y, turn };
            prop_assert!(near(velocity.after(0.3) * velocity.after(0.3), velocity.after(0.6)));
        }
    }
}
