//! A recorded log as live messages: their stamps, and how many may be on their way.
//!
//! What decides is here; `gmapd play` and `gmapd demo` do the sending.

mod backlog;
mod stamps;

pub use backlog::{Backlog, Room, VerdictMessage};
pub use stamps::{LogFault, Restamper, Survey};

use crate::convert::{self, OdometrySample};
use crate::logs::Reading;
use crate::ros;
use crate::slam::pose::Stamp;
use crate::slam::scan::LaserMount;

/// What the frames of a log are called on the mesh.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Frames {
    /// Odometry's.
    pub odom: &'static str,
    /// The robot's.
    pub base: &'static str,
    /// The laser's.
    pub laser: &'static str,
}

impl Default for Frames {
    /// As the configuration's defaults call them.
    fn default() -> Self {
        Self { odom: "odom", base: "base_link", laser: "laser" }
    }
}

/// The messages of a reading, which both have its stamp.
#[derive(Debug, Clone, PartialEq)]
pub struct Messages {
    /// To be sent first.
    pub odometry: ros::Odometry,
    /// Where the reading has a sweep.
    pub scan: Option<ros::LaserScan>,
}

impl Frames {
    /// The messages that carry a reading.
    #[must_use]
    pub fn messages(&self, reading: &Reading) -> Messages {
        let odometry = convert::odometry_message(&OdometrySample {
            stamp: reading.stamp,
            odom_frame: self.odom.to_owned(),
            base_frame: self.base.to_owned(),
            odom_from_base: reading.odom_from_base,
        });
        let scan = reading.scan.as_ref().map(|scan| convert::laser_scan(scan, self.laser));
        Messages { odometry, scan }
    }

    /// The message for `tf_static` that says how the laser sits.
    #[must_use]
    pub fn mount(&self, stamp: Stamp, mount: &LaserMount) -> ros::TfMessage {
        let header = convert::header(stamp, self.base);
        ros::TfMessage { transforms: vec![convert::mount_transform(header, self.laser, mount)] }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::pose::Pose2;
    use crate::slam::scan::{Scan, ScanGeometry};

    #[test]
    fn a_reading_is_odometry_and_a_scan_of_one_stamp() {
        let stamp = Stamp(5_250_000_000);
        let geometry = ScanGeometry::new([-1.0, 1.0], 1.0, [0.125, 9.0]).unwrap();
        let scan = Scan { stamp, geometry, ranges: vec![1.0, 2.0, 3.0] };
        let odom_from_base = Pose2::new(1.0, 2.0, 0.5);
        let mount = LaserMount::default();
        let reading = Reading { line: 7, stamp, odom_from_base, scan: Some(scan.clone()), mount };
        let Messages { odometry, scan: message } = Frames::default().messages(&reading);
        assert_eq!(convert::stamp(odometry.header.stamp), Ok(stamp));
        assert_eq!(odometry.child_frame_id, "base_link");
        let message = message.unwrap();
        assert_eq!(message.header.frame_id, "laser");
        assert_eq!(convert::scan(message).unwrap(), scan);
        let without = Reading { scan: None, ..reading };
        assert_eq!(Frames::default().messages(&without).scan, None);
    }
}
