//! Where ROS messages and the types of the core meet: stamps, frames, units.

use nalgebra::{Isometry3, Matrix3, Translation3, UnitQuaternion, Vector3};
use thiserror::Error;

use crate::ros;
use crate::slam::grid::occupancy::OccupancyGrid;
use crate::slam::pose::{Pose2, Stamp, wrap_angle};
use crate::slam::scan::{GeometryError, LaserMount, MountOrientation, Scan, ScanGeometry};
use crate::tf;

const NANOSECONDS: i64 = 1_000_000_000;

/// Base poses that are tilted more than this, rad, are not of a robot on a floor: the steepest
/// ramps for wheels have a third of it, and mixed-up axes give a quarter turn.
const MOST_BASE_TILT: f64 = 20.0 * std::f64::consts::PI / 180.0;

/// How far the z component of the laser's z axis may be from 1 or -1, as in slam_gmapping: a tilt
/// of 2.56 degrees.
const MOST_LASER_TILT: f64 = 0.001;

/// Quaternions shorter than this were never filled in.
const SHORTEST_QUATERNION: f64 = 1e-6;

/// Why a message says nothing the core can use.
#[derive(Debug, Clone, Copy, PartialEq, Error)]
pub enum ConvertError {
    /// The stamp has a second and more in its nanoseconds.
    #[error("the stamp has {0} nanoseconds, which must be below 1000000000")]
    Nanoseconds(u32),
    /// The scan's geometry is unusable.
    #[error(transparent)]
    Geometry(#[from] GeometryError),
    /// A position is NaN or infinite.
    #[error("the position ({}, {}, {}) is not finite", .0[0], .0[1], .0[2])]
    Position([f64; 3]),
    /// A quaternion is zero, NaN or infinite.
    #[error(
        "the quaternion (x {}, y {}, z {}, w {}) is no rotation: its length is {length}",
        components[0], components[1], components[2], components[3]
    )]
    Quaternion {
        /// x, y, z and w.
        components: [f64; 4],
        /// Their length.
        length: f64,
    },
    /// The base does not stand on the plane.
    #[error(
        "the base is tilted by {:.1} degrees; mapping in the plane allows {:.0}",
        .0.to_degrees(),
        MOST_BASE_TILT.to_degrees()
    )]
    TiltedBase(f64),
    /// The laser does not scan parallel to the plane.
    #[error(
        "the laser is tilted by {:.2} degrees against the plane; mapping allows {:.2}",
        .0.to_degrees(),
        libm::acos(1.0 - MOST_LASER_TILT).to_degrees()
    )]
    TiltedLaser(f64),
}

/// What an odometry message says.
#[derive(Debug, Clone, PartialEq)]
pub struct OdometrySample {
    /// When.
    pub stamp: Stamp,
    /// The frame the pose is in.
    pub odom_frame: String,
    /// The frame whose pose it is.
    pub base_frame: String,
    /// The base, as odometry believes.
    pub odom_from_base: Pose2,
}

/// The stamp of a message's time.
///
/// # Errors
/// When its nanoseconds are a second or more.
pub const fn stamp(time: ros::Time) -> Result<Stamp, ConvertError> {
    if time.nanosec as i64 >= NANOSECONDS {
        return Err(ConvertError::Nanoseconds(time.nanosec));
    }
    Ok(Stamp(time.sec as i64 * NANOSECONDS + time.nanosec as i64))
}

/// A stamp as messages tell it; those before 1901 and after 2038 saturate.
#[must_use]
pub fn time(stamp: Stamp) -> ros::Time {
    let (least, most) = (i64::from(i32::MIN) * NANOSECONDS, (1 << 31) * NANOSECONDS - 1);
    let nanoseconds = stamp.0.clamp(least, most);
    ros::Time {
        sec: nanoseconds.div_euclid(NANOSECONDS) as i32,
        nanosec: nanoseconds.rem_euclid(NANOSECONDS) as u32,
    }
}

/// A message's header.
#[must_use]
pub fn header(stamp: Stamp, frame: &str) -> ros::Header {
    ros::Header { stamp: time(stamp), frame_id: frame.to_owned() }
}

/// The sweep of a laser.
///
/// # Errors
/// When its stamp or its geometry is unusable.
pub fn scan(message: ros::LaserScan) -> Result<Scan, ConvertError> {
    let geometry = ScanGeometry::new(
        [message.angle_min.into(), message.angle_max.into()],
        message.angle_increment.into(),
        [message.range_min.into(), message.range_max.into()],
    )?;
    let (field, value) = ("time_increment", f64::from(message.time_increment));
    if !value.is_finite() {
        return Err(GeometryError::NotFinite { field, value }.into());
    }
    let geometry = geometry.with_time_increment(value);
    Ok(Scan { stamp: stamp(message.header.stamp)?, geometry, ranges: message.ranges })
}

/// A sweep as the message that [`scan`] reads; angles and range limits keep the digits of an `f32`.
#[must_use]
pub fn laser_scan(scan: &Scan, frame: &str) -> ros::LaserScan {
    let Scan { stamp, geometry, ranges } = scan;
    ros::LaserScan {
        header: header(*stamp, frame),
        angle_min: geometry.angle(0) as f32,
        angle_max: geometry.angle(ranges.len().saturating_sub(1)) as f32,
        angle_increment: geometry.angle_increment() as f32,
        time_increment: geometry.time_increment() as f32,
        range_min: geometry.range_min() as f32,
        range_max: geometry.range_max() as f32,
        ranges: ranges.clone(),
        ..ros::LaserScan::default()
    }
}

/// What odometry says.
///
/// # Errors
/// When its stamp or pose is unusable or the base is tilted.
pub fn odometry(message: ros::Odometry) -> Result<OdometrySample, ConvertError> {
    let ros::Pose { position, orientation } = message.pose.pose;
    let odom_from_base = isometry([position.x, position.y, position.z], orientation)?;
    Ok(OdometrySample {
        stamp: stamp(message.header.stamp)?,
        odom_frame: message.header.frame_id,
        base_frame: message.child_frame_id,
        odom_from_base: base_pose(&odom_from_base)?,
    })
}

/// The pose that a message of odometry brings: by way of a quaternion, its last bits may change.
/// One that no message can carry stays as it is, for the filter to refuse.
#[must_use]
pub fn odometry_as_received(stamp: Stamp, odom_from_base: Pose2) -> Pose2 {
    let (odom_frame, base_frame) = (String::new(), String::new());
    let sample = OdometrySample { stamp, odom_frame, base_frame, odom_from_base };
    odometry(odometry_message(&sample)).map_or(odom_from_base, |received| received.odom_from_base)
}

/// What odometry says as the message that [`odometry`] reads; it knows no speed.
#[must_use]
pub fn odometry_message(sample: &OdometrySample) -> ros::Odometry {
    let pose = pose(sample.odom_from_base);
    ros::Odometry {
        header: header(sample.stamp, &sample.odom_frame),
        child_frame_id: sample.base_frame.clone(),
        pose: ros::PoseWithCovariance { pose, ..ros::PoseWithCovariance::default() },
        twist: ros::TwistWithCovariance::default(),
    }
}

/// Where the base is, as somebody else has found.
#[derive(Debug, Clone, PartialEq)]
pub struct FramedPose {
    /// When.
    pub stamp: Stamp,
    /// The frame that it is in.
    pub frame: String,
    /// The base in that frame.
    pub frame_from_base: Pose2,
}

/// A given pose, flattened like odometry.
///
/// # Errors
/// When its stamp, position or rotation is unusable.
pub fn stamped_pose(message: ros::PoseStamped) -> Result<FramedPose, ConvertError> {
    let ros::Pose { position, orientation } = message.pose;
    let frame_from_base = isometry([position.x, position.y, position.z], orientation)?;
    Ok(FramedPose {
        stamp: stamp(message.header.stamp)?,
        frame: message.header.frame_id,
        frame_from_base: base_pose(&frame_from_base)?,
    })
}

/// The transform between two frames.
///
/// # Errors
/// When its stamp, translation or rotation is unusable.
pub fn transform(message: ros::TransformStamped) -> Result<tf::Transform, ConvertError> {
    let ros::Transform { translation, rotation } = message.transform;
    Ok(tf::Transform {
        parent: message.header.frame_id,
        child: message.child_frame_id,
        stamp: stamp(message.header.stamp)?,
        parent_from_child: isometry([translation.x, translation.y, translation.z], rotation)?,
    })
}

fn isometry(
    position: [f64; 3],
    quaternion: ros::Quaternion,
) -> Result<Isometry3<f64>, ConvertError> {
    if !position.iter().all(|coordinate| coordinate.is_finite()) {
        return Err(ConvertError::Position(position));
    }
    let ros::Quaternion { x, y, z, w } = quaternion;
    let rotation = nalgebra::Quaternion::new(w, x, y, z);
    let length = rotation.norm();
    if !length.is_finite() || length < SHORTEST_QUATERNION {
        return Err(ConvertError::Quaternion { components: [x, y, z, w], length });
    }
    let rotation = UnitQuaternion::new_normalize(rotation);
    Ok(Isometry3::from_parts(Translation3::from(position), rotation))
}

/// The pose in the plane of a base that stands on it, more or less.
///
/// # Errors
/// When it is tilted; the error tells by how much.
pub fn base_pose(parent_from_base: &Isometry3<f64>) -> Result<Pose2, ConvertError> {
    let tilt = angle_to_vertical(&parent_from_base.rotation);
    if tilt > MOST_BASE_TILT {
        return Err(ConvertError::TiltedBase(tilt));
    }
    Ok(in_plane(parent_from_base))
}

/// How a laser sits on its base: upright or upside down, at any height and turned any way.
///
/// # Errors
/// When its beams leave the plane; the error tells the tilt.
pub fn laser_mount(base_from_laser: &Isometry3<f64>) -> Result<LaserMount, ConvertError> {
    let upward = (base_from_laser.rotation * Vector3::z()).z;
    if upward.abs() < 1.0 - MOST_LASER_TILT {
        let angle = angle_to_vertical(&base_from_laser.rotation);
        return Err(ConvertError::TiltedLaser(angle.min(std::f64::consts::PI - angle)));
    }
    let orientation =
        if upward > 0.0 { MountOrientation::Upright } else { MountOrientation::UpsideDown };
    Ok(LaserMount { base_from_laser: in_plane(base_from_laser), orientation })
}

/// How a laser sits as the transform that [`laser_mount`] reads; the header's frame is the base.
#[must_use]
pub fn mount_transform(
    header: ros::Header,
    laser_frame: &str,
    mount: &LaserMount,
) -> ros::TransformStamped {
    let mut message = transform_stamped(header, laser_frame, mount.base_from_laser);
    let ros::Quaternion { z, w, .. } = message.transform.rotation;
    match mount.orientation {
        MountOrientation::Upright => {}
        // Half a turn about the laser's own x axis, before the turn about z.
        MountOrientation::UpsideDown => {
            message.transform.rotation = ros::Quaternion { x: w, y: z, z: 0.0, w: 0.0 };
        }
    }
    message
}

/// Between the z axes before and after a rotation, rad.
fn angle_to_vertical(rotation: &UnitQuaternion<f64>) -> f64 {
    let axis = rotation * Vector3::z();
    libm::atan2(libm::hypot(axis.x, axis.y), axis.z)
}

/// Seen from above: the origin and the direction of the x axis.
fn in_plane(parent_from_child: &Isometry3<f64>) -> Pose2 {
    let position = parent_from_child.translation.vector;
    let forward = parent_from_child.rotation * Vector3::x();
    Pose2::new(position.x, position.y, wrap_angle(libm::atan2(forward.y, forward.x)))
}

/// A pose in the plane.
#[must_use]
pub fn pose(pose: Pose2) -> ros::Pose {
    ros::Pose {
        position: ros::Point { x: pose.x, y: pose.y, z: 0.0 },
        orientation: quaternion(pose.theta),
    }
}

/// A turn about z.
fn quaternion(yaw: f64) -> ros::Quaternion {
    let (z, w) = libm::sincos(yaw / 2.0);
    ros::Quaternion { x: 0.0, y: 0.0, z, w }
}

/// The message that says where `child` is in the header's frame.
#[must_use]
pub fn transform_stamped(
    header: ros::Header,
    child: &str,
    parent_from_child: Pose2,
) -> ros::TransformStamped {
    let Pose2 { x, y, theta } = parent_from_child;
    ros::TransformStamped {
        header,
        child_frame_id: child.to_owned(),
        transform: ros::Transform {
            translation: ros::Vector3 { x, y, z: 0.0 },
            rotation: quaternion(theta),
        },
    }
}

/// A pose and how sure it is; `covariance` is that of x, y and theta, in m and rad.
#[must_use]
pub fn pose_with_covariance(
    pose_in_map: Pose2,
    covariance: &Matrix3<f64>,
) -> ros::PoseWithCovariance {
    ros::PoseWithCovariance { pose: pose(pose_in_map), covariance: planar_covariance(covariance) }
}

/// Among the six of ROS, x, y and theta are the first two and the last.
fn planar_covariance(covariance: &Matrix3<f64>) -> ros::Covariance {
    const PLACES: [usize; 3] = [0, 1, 5];
    let mut all = ros::Covariance::default();
    for (row, row_place) in PLACES.into_iter().enumerate() {
        for (column, column_place) in PLACES.into_iter().enumerate() {
            all.0[6 * row_place + column_place] = covariance[(row, column)];
        }
    }
    all
}

/// The way of the robot; each pose has its own stamp and the header's frame.
#[must_use]
pub fn path(header: ros::Header, stamped_poses: &[(Stamp, Pose2)]) -> ros::Path {
    let poses = stamped_poses
        .iter()
        .map(|&(stamp, pose_in_map)| ros::PoseStamped {
            header: self::header(stamp, &header.frame_id),
            pose: pose(pose_in_map),
        })
        .collect();
    ros::Path { header, poses }
}

/// The poses of the particles.
#[must_use]
pub fn pose_array(
    header: ros::Header,
    poses_in_map: impl IntoIterator<Item = Pose2>,
) -> ros::PoseArray {
    ros::PoseArray { header, poses: poses_in_map.into_iter().map(pose).collect() }
}

/// The map.
#[must_use]
pub fn occupancy_grid(header: ros::Header, grid: &OccupancyGrid) -> ros::OccupancyGrid {
    ros::OccupancyGrid {
        info: map_meta_data(header.stamp, grid),
        data: ros::Int8Array::from(grid.cells.as_slice()),
        header,
    }
}

/// The map's size and place.
#[must_use]
pub fn map_meta_data(map_load_time: ros::Time, grid: &OccupancyGrid) -> ros::MapMetaData {
    let cells = |count| u32::try_from(count).unwrap_or(u32::MAX);
    ros::MapMetaData {
        map_load_time,
        resolution: grid.resolution as f32,
        width: cells(grid.width),
        height: cells(grid.height),
        origin: pose(Pose2::new(grid.origin.x, grid.origin.y, 0.0)),
    }
}

#[cfg(test)]
mod tests;
