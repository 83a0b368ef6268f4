//! ROS 1 messages: little-endian, one field after the other without gaps; a header counts itself.

use super::cursor::Cursor;
use crate::ros;

/// `sensor_msgs/LaserScan`; `None` when the bytes are not exactly one.
pub(super) fn laser_scan(bytes: &[u8]) -> Option<ros::LaserScan> {
    let mut body = Cursor::new(bytes);
    let message = ros::LaserScan {
        header: header(&mut body)?,
        angle_min: body.f32()?,
        angle_max: body.f32()?,
        angle_increment: body.f32()?,
        time_increment: body.f32()?,
        scan_time: body.f32()?,
        range_min: body.f32()?,
        range_max: body.f32()?,
        ranges: floats(&mut body)?,
        intensities: floats(&mut body)?,
    };
    body.rest().is_empty().then_some(message)
}

/// `nav_msgs/Odometry`; `None` when the bytes are not exactly one.
pub(super) fn odometry(bytes: &[u8]) -> Option<ros::Odometry> {
    let mut body = Cursor::new(bytes);
    let message = ros::Odometry {
        header: header(&mut body)?,
        child_frame_id: body.text()?.to_owned(),
        pose: ros::PoseWithCovariance {
            pose: ros::Pose { position: point(&mut body)?, orientation: quaternion(&mut body)? },
            covariance: covariance(&mut body)?,
        },
        twist: ros::TwistWithCovariance {
            twist: ros::Twist { linear: vector(&mut body)?, angular: vector(&mut body)? },
            covariance: covariance(&mut body)?,
        },
    };
    body.rest().is_empty().then_some(message)
}

/// `tf2_msgs/TFMessage`; `None` when the bytes are not exactly one.
pub(super) fn transforms(bytes: &[u8]) -> Option<ros::TfMessage> {
    let mut body = Cursor::new(bytes);
    let count = body.u32()?;
    let mut transforms = Vec::new();
    for _ in 0..count {
        transforms.push(ros::TransformStamped {
            header: header(&mut body)?,
            child_frame_id: body.text()?.to_owned(),
            transform: ros::Transform {
                translation: vector(&mut body)?,
                rotation: quaternion(&mut body)?,
            },
        });
    }
    body.rest().is_empty().then_some(ros::TfMessage { transforms })
}

fn header(body: &mut Cursor<'_>) -> Option<ros::Header> {
    body.u32()?; // The number of the message.
    let stamp = ros::Time { sec: i32::try_from(body.u32()?).ok()?, nanosec: body.u32()? };
    Some(ros::Header { stamp, frame_id: body.text()?.to_owned() })
}

fn floats(body: &mut Cursor<'_>) -> Option<Vec<f32>> {
    let count = body.u32()? as usize;
    let mut floats = Cursor::new(body.bytes(count.checked_mul(4)?)?);
    (0..count).map(|_| floats.f32()).collect()
}

fn vector(body: &mut Cursor<'_>) -> Option<ros::Vector3> {
    Some(ros::Vector3 { x: body.f64()?, y: body.f64()?, z: body.f64()? })
}

fn point(body: &mut Cursor<'_>) -> Option<ros::Point> {
    Some(ros::Point { x: body.f64()?, y: body.f64()?, z: body.f64()? })
}

fn quaternion(body: &mut Cursor<'_>) -> Option<ros::Quaternion> {
    Some(ros::Quaternion { x: body.f64()?, y: body.f64()?, z: body.f64()?, w: body.f64()? })
}

fn covariance(body: &mut Cursor<'_>) -> Option<ros::Covariance> {
    let mut covariance = ros::Covariance::default();
    for element in &mut covariance.0 {
        *element = body.f64()?;
    }
    Some(covariance)
}
