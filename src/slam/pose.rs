//! Poses and points of the plane, and the stamp of a measurement.
//!
//! A [`Pose2`] is also a rigid transform: `map_from_odom` maps coordinates in `odom` to
//! coordinates in `map`, so adjacent names match when composing:
//! `map_from_odom * odom_from_base`.

use std::f64::consts::{PI, TAU};
use std::ops::Mul;

use serde::{Deserialize, Serialize};

/// The time of a measurement: nanoseconds of the clock that stamped it.
///
/// The core never reads a clock; every stamp comes from a message or a log.
#[derive(
    Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize,
)]
pub struct Stamp(pub i64);

impl Stamp {
    /// The stamp nearest to `seconds`; values that do not fit saturate.
    #[must_use]
    pub fn from_seconds(seconds: f64) -> Self {
        Self(libm::round(seconds * 1e9) as i64)
    }

    /// Seconds as a float, with the precision a float has left (about 0.1 microseconds today).
    #[must_use]
    pub fn as_seconds(self) -> f64 {
        self.0 as f64 * 1e-9
    }

    /// Seconds from `earlier` to this stamp; negative when this stamp is before it.
    #[must_use]
    pub fn seconds_since(self, earlier: Self) -> f64 {
        (i128::from(self.0) - i128::from(earlier.0)) as f64 * 1e-9
    }
}

/// A point of the plane, in metres, in the frame its name says.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Point2 {
    /// Metres along the frame's x axis.
    pub x: f64,
    /// Metres along the frame's y axis.
    pub y: f64,
}

impl Point2 {
    /// The point (x, y), metres.
    #[must_use]
    pub const fn new(x: f64, y: f64) -> Self {
        Self { x, y }
    }

    /// Distance from the frame's origin, metres.
    #[must_use]
    pub fn norm(self) -> f64 {
        (self.x * self.x + self.y * self.y).sqrt()
    }
}

/// A pose in SE(2): position in metres and heading in radians, counter-clockwise from x (REP-103).
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Pose2 {
    /// Metres along the frame's x axis.
    pub x: f64,
    /// Metres along the frame's y axis.
    pub y: f64,
    /// Heading, radians in (-π, π] when it comes out of an operation of this type.
    pub theta: f64,
}

impl Pose2 {
    /// The origin of a frame, and the transform that changes nothing.
    pub const IDENTITY: Self = Self::new(0.0, 0.0, 0.0);

    /// The pose (x, y, theta): metres, metres, radians.
    #[must_use]
    pub const fn new(x: f64, y: f64, theta: f64) -> Self {
        Self { x, y, theta }
    }

    /// The inverse transform: `a.inverse() * a` is the identity.
    #[must_use]
    pub fn inverse(self) -> Self {
        let (sin, cos) = libm::sincos(self.theta);
        Self::new(
            -cos * self.x - sin * self.y,
            sin * self.x - cos * self.y,
            wrap_angle(-self.theta),
        )
    }

    /// `other` seen from this pose: `self.inverse() * other`.
    ///
    /// With two poses of a robot this is its motion between them, in the earlier base frame.
    #[must_use]
    pub fn between(self, other: Self) -> Self {
        let (sin, cos) = libm::sincos(self.theta);
        let (dx, dy) = (other.x - self.x, other.y - self.y);
        Self::new(cos * dx + sin * dy, cos * dy - sin * dx, wrap_angle(other.theta - self.theta))
    }

    /// The position without the heading.
    #[must_use]
    pub const fn position(self) -> Point2 {
        Point2::new(self.x, self.y)
    }

    /// Whether every component is a finite number.
    #[must_use]
    pub fn is_finite(self) -> bool {
        self.x.is_finite() && self.y.is_finite() && self.theta.is_finite()
    }
}

impl Mul for Pose2 {
    type Output = Self;

    /// Composes transforms: `a_from_b * b_from_c` is `a_from_c`.
    fn mul(self, rhs: Self) -> Self {
        let point = self * rhs.position();
        Self::new(point.x, point.y, wrap_angle(self.theta + rhs.theta))
    }
}

impl Mul<Point2> for Pose2 {
    type Output = Point2;

    /// Transforms a point: `a_from_b * point_in_b` is the point in `a`.
    fn mul(self, point: Point2) -> Point2 {
        let (sin, cos) = libm::sincos(self.theta);
        Point2::new(self.x + cos * point.x - sin * point.y, self.y + sin * point.x + cos * point.y)
    }
}

/// The same angle in (-π, π], radians.
#[must_use]
pub fn wrap_angle(angle: f64) -> f64 {
    if angle > -PI && angle <= PI {
        return angle;
    }
    let turns = libm::ceil((angle - PI) / TAU);
    let wrapped = angle - turns * TAU;
    if wrapped > -PI { wrapped.min(PI) } else { PI }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::{Strategy, prop_assert, proptest};

    use super::*;

    fn poses() -> impl Strategy<Value = Pose2> {
        (-1e3..1e3, -1e3..1e3, -PI..PI).prop_map(|(x, y, theta)| Pose2::new(x, y, theta))
    }

    fn near(a: Pose2, b: Pose2) -> bool {
        let d = a.between(b);
        d.position().norm() < 1e-9 && d.theta.abs() < 1e-12
    }

    proptest! {
        #[test]
        fn inverse_undoes(a in poses()) {
            prop_assert!(near(a.inverse() * a, Pose2::IDENTITY));
            prop_assert!(near(a * a.inverse(), Pose2::IDENTITY));
        }

        #[test]
        fn composition_is_associative(a in poses(), b in poses(), c in poses()) {
            prop_assert!(near((a * b) * c, a * (b * c)));
        }

        #[test]
        fn between_is_inverse_times(a in poses(), b in poses()) {
            prop_assert!(near(a.between(b), a.inverse() * b));
            prop_assert!(near(a * a.between(b), b));
        }

        #[test]
        fn wrapping_keeps_the_direction(angle in -1e4..1e4_f64) {
            let wrapped = wrap_angle(angle);
            prop_assert!(wrapped > -PI && wrapped <= PI);
            prop_assert!((wrapped.sin() - angle.sin()).abs() < 1e-9);
            prop_assert!((wrapped.cos() - angle.cos()).abs() < 1e-9);
        }
    }

    #[test]
    fn a_quarter_turn_moves_x_to_y() {
        let map_from_base = Pose2::new(1.0, 2.0, PI / 2.0);
        let point_in_map = map_from_base * Point2::new(3.0, 0.0);
        assert!((point_in_map.x - 1.0).abs() < 1e-12);
        assert!((point_in_map.y - 5.0).abs() < 1e-12);
    }

    #[test]
    fn minus_pi_wraps_to_pi() {
        assert_eq!(wrap_angle(-PI), PI);
        assert_eq!(wrap_angle(PI), PI);
    }

    #[test]
    fn stamps_keep_the_microseconds_of_a_log() {
        let stamp = Stamp::from_seconds(976_052_857.337_483);
        assert!((stamp.as_seconds() - 976_052_857.337_483).abs() < 1e-6);
        assert_eq!(Stamp(5_000_000_000).seconds_since(Stamp(7_000_000_000)), -2.0);
    }
}
