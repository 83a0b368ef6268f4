//! One sweep of a planar laser, and what each of its beams says.

use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::deskew::Velocity;
use super::pose::{Point2, Pose2, Stamp};

/// Where the beams of a sweep point, when each is taken, and which ranges they can measure.
///
/// Beam `i` points at `angle_min + i * angle_increment`: this one table serves matching and
/// mapping alike (the original used two that differ by half an increment).
/// A clockwise laser has a negative increment.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ScanGeometry {
    angle_min: f64,
    angle_increment: f64,
    range_min: f64,
    range_max: f64,
    time_increment: f64,
    velocity: Velocity,
}

/// Why the geometry of a scan cannot be used.
#[derive(Debug, Clone, Copy, PartialEq, Error)]
pub enum GeometryError {
    /// A field is NaN or infinite.
    #[error("scan geometry field {field} is {value}, which is not a finite number")]
    NotFinite {
        /// The name of the field in `sensor_msgs/LaserScan`.
        field: &'static str,
        /// Its value.
        value: f64,
    },
    /// Neighbouring beams would coincide or turn more than half a circle.
    #[error("angle_increment {0} rad is not usable: its size must be above 0 and at most pi")]
    Increment(f64),
    /// The measurable interval is empty or negative.
    #[error("range_min {range_min} m and range_max {range_max} m leave no range to measure")]
    Ranges {
        /// Shortest measurable range, m.
        range_min: f64,
        /// Longest measurable range, m.
        range_max: f64,
    },
}

impl ScanGeometry {
    /// The geometry of a `sensor_msgs/LaserScan`: angles in radians, ranges in metres.
    ///
    /// The sign of the turn is that of `angle_max - angle_min`, as in slam_gmapping: drivers of
    /// clockwise lasers exist that swap the limits and leave the increment positive.
    /// `range_max` may be infinite.
    ///
    /// # Errors
    /// When a value is not finite, neighbouring beams coincide, or no range is measurable.
    pub fn new(
        [angle_min, angle_max]: [f64; 2],
        angle_increment: f64,
        [range_min, range_max]: [f64; 2],
    ) -> Result<Self, GeometryError> {
        let fields = [
            ("angle_min", angle_min),
            ("angle_max", angle_max),
            ("angle_increment", angle_increment),
            ("range_min", range_min),
        ];
        for (field, value) in fields {
            if !value.is_finite() {
                return Err(GeometryError::NotFinite { field, value });
            }
        }
        let size = angle_increment.abs();
        if size <= 1e-9 || size > std::f64::consts::PI {
            return Err(GeometryError::Increment(angle_increment));
        }
        if !(range_min >= 0.0 && range_max > range_min) {
            return Err(GeometryError::Ranges { range_min, range_max });
        }
        let clockwise =
            if angle_max == angle_min { angle_increment < 0.0 } else { angle_max < angle_min };
        Ok(Self {
            angle_min,
            angle_increment: if clockwise { -size } else { size },
            range_min,
            range_max,
            time_increment: 0.0,
            velocity: Velocity::default(),
        })
    }

    /// Whether it is such as [`Self::new`] makes; of one that was read, nobody knows.
    #[must_use]
    pub fn is_usable(&self) -> bool {
        let Self { angle_min, angle_increment, range_min, range_max, .. } = *self;
        let Velocity { x, y, turn } = self.velocity;
        let motion = [self.time_increment, x, y, turn];
        let new = Self::new([angle_min, angle_min], angle_increment, [range_min, range_max]);
        new.is_ok() && motion.into_iter().all(f64::is_finite)
    }

    /// The same with `seconds` from beam to beam; 0 takes all at once.
    #[must_use]
    pub const fn with_time_increment(self, seconds: f64) -> Self {
        Self { time_increment: seconds, ..self }
    }

    /// The same from a base that moves during the sweep.
    #[must_use]
    pub const fn with_velocity(self, velocity: Velocity) -> Self {
        Self { velocity, ..self }
    }

    /// Seconds from beam to beam, as the sensor says; 0 where it does not say.
    #[must_use]
    pub const fn time_increment(&self) -> f64 {
        self.time_increment
    }

    /// The base at beam `index`, seen from the base at the stamp; `None` where it stands still or
    /// all beams are taken at once.
    #[must_use]
    pub fn motion_until(&self, index: usize) -> Option<Pose2> {
        let moves = self.time_increment != 0.0 && self.velocity != Velocity::default();
        moves.then(|| self.velocity.after(index as f64 * self.time_increment))
    }

    /// Direction of beam `index` in the laser frame, radians; not wrapped.
    #[must_use]
    pub fn angle(&self, index: usize) -> f64 {
        self.angle_min + index as f64 * self.angle_increment
    }

    /// Signed angle between neighbouring beams, radians.
    #[must_use]
    pub const fn angle_increment(&self) -> f64 {
        self.angle_increment
    }

    /// Shortest range the sensor measures, m.
    #[must_use]
    pub const fn range_min(&self) -> f64 {
        self.range_min
    }

    /// Longest range the sensor measures, m; may be infinite.
    #[must_use]
    pub const fn range_max(&self) -> f64 {
        self.range_max
    }

    /// What a reading says, by the rules of REP-117.
    ///
    /// NaN (erroneous), -Inf (too close), zero, negative and below `range_min`: invalid.
    /// +Inf and `range_max` or more: no return.
    #[must_use]
    pub fn classify(&self, range: f32) -> Beam {
        let range = f64::from(range);
        if range.is_nan() || range <= 0.0 || range < self.range_min {
            Beam::Invalid
        } else if range >= self.range_max {
            Beam::NoReturn
        } else {
            Beam::Hit(range)
        }
    }
}

/// What one reading of a scan says.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Beam {
    /// The beam ended on an obstacle at this range, m.
    Hit(f64),
    /// Nothing reflected the beam within the sensor's range.
    NoReturn,
    /// The reading says nothing.
    Invalid,
}

/// One sweep: readings in metres, in the order the sensor took them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Scan {
    /// When the first beam was taken.
    pub stamp: Stamp,
    /// Directions and limits of the readings.
    pub geometry: ScanGeometry,
    /// One range a beam, m; any count, and it may change from scan to scan.
    pub ranges: Vec<f32>,
}

impl Scan {
    /// Where beam `index` is `range` metres from the laser, in the frame of the base at the stamp
    /// of the scan: a base that moved since is taken into account.
    #[must_use]
    pub fn point_in_base(&self, mount: &LaserMount, index: usize, range: f64) -> Point2 {
        let point = mount.point_in_base(self.geometry.angle(index), range);
        match self.geometry.motion_until(index) {
            Some(base_from_later_base) => base_from_later_base * point,
            None => point,
        }
    }

    /// Seconds from the first beam to the last, as the sensor says; negative where it counts beams
    /// backwards.
    #[must_use]
    pub fn sweep_time(&self) -> f64 {
        self.geometry.time_increment() * self.ranges.len().saturating_sub(1) as f64
    }
}

/// Which side of the laser looks up.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MountOrientation {
    /// The laser's z axis points up: positive angles turn counter-clockwise.
    #[default]
    Upright,
    /// The laser is mounted upside down: positive angles turn clockwise seen from above.
    UpsideDown,
}

/// How a laser sits on the robot.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct LaserMount {
    /// The laser's position and the direction of its x axis, in the base frame.
    pub base_from_laser: Pose2,
    /// Which side looks up.
    pub orientation: MountOrientation,
}

impl LaserMount {
    /// Direction in the base frame of a beam at `angle` in the laser frame, radians.
    #[must_use]
    pub fn angle_in_base(&self, angle: f64) -> f64 {
        let yaw = self.base_from_laser.theta;
        match self.orientation {
            MountOrientation::Upright => yaw + angle,
            MountOrientation::UpsideDown => yaw - angle,
        }
    }

    /// The point at `range` metres along a beam at `angle` in the laser frame, in the base frame.
    #[must_use]
    pub fn point_in_base(&self, angle: f64, range: f64) -> Point2 {
        let (sin, cos) = libm::sincos(self.angle_in_base(angle));
        let laser = self.base_from_laser;
        Point2::new(laser.x + range * cos, laser.y + range * sin)
    }
}
