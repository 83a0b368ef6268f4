//! Logs in CARMEN's text format: one message a line, in metres, radians and seconds.

use std::f64::consts::PI;
use std::io::{self, Write};

use crate::slam::pose::{Pose2, Stamp};
use crate::slam::scan::{Beam, LaserMount, MountOrientation, Scan};

/// What `FLASER` lines say for no return, m: a SICK laser's value, known to every reader.
const FLASER_NO_RETURN: f64 = 81.83;
/// What stands for an unlimited range, m.
const LONGEST: f64 = 1e4;

/// Writes a CARMEN log.
///
/// Ranges and poses are written with all their digits, so reading the log gives the same numbers;
/// stamps have six decimals. The format knows neither clockwise nor upside-down lasers: their
/// scans are written as those of the upright, counter-clockwise laser that sees the same.
#[derive(Debug)]
pub struct CarmenWriter<W> {
    out: W,
    mount: LaserMount,
    front_laser_described: bool,
}

impl<W: Write> CarmenWriter<W> {
    /// A log of a robot that carries its laser like this.
    pub const fn new(out: W, mount: LaserMount) -> Self {
        Self { out, mount, front_laser_described: false }
    }

    /// Writes an `ODOM` line; velocities are not known and written as 0.
    ///
    /// # Errors
    /// When writing fails.
    pub fn write_odometry(&mut self, stamp: Stamp, odom_from_base: Pose2) -> io::Result<()> {
        let pose = fields(odom_from_base);
        writeln!(self.out, "ODOM {pose} 0 0 0 {}", end_of_line(stamp))
    }

    /// Writes a scan with the odometry at its stamp: as `FLASER` when it is one of the sweeps of
    /// a half circle straight ahead that the format implies, else as `ROBOTLASER1`.
    ///
    /// # Errors
    /// When writing fails.
    pub fn write_scan(&mut self, scan: &Scan, odom_from_base: Pose2) -> io::Result<()> {
        let sweep = Sweep::new(scan, self.mount.orientation);
        let laser = fields(odom_from_base * self.mount.base_from_laser);
        let base = fields(odom_from_base);
        if sweep.is_front_laser() && self.looks_ahead() {
            self.describe_front_laser(sweep.range_max)?;
            write!(self.out, "FLASER {}", sweep.ranges.len())?;
            self.write_ranges(scan, &sweep, FLASER_NO_RETURN.max(sweep.range_max))?;
            writeln!(self.out, " {laser} {base} {}", end_of_line(scan.stamp))
        } else {
            let Sweep { start, increment, range_max, .. } = sweep;
            let count = sweep.ranges.len();
            let span = increment * count.saturating_sub(1) as f64;
            write!(
                self.out,
                "ROBOTLASER1 0 {start} {span} {increment} {range_max} 0.01 0 {count}"
            )?;
            self.write_ranges(scan, &sweep, sweep.range_max)?;
            writeln!(self.out, " 0 {laser} {base} 0 0 0 0 0 {}", end_of_line(scan.stamp))
        }
    }

    /// Hands the output back, with everything written to it.
    ///
    /// # Errors
    /// When writing fails.
    pub fn finish(mut self) -> io::Result<W> {
        self.out.flush()?;
        Ok(self.out)
    }

    /// Whether the laser sits on the robot's x axis and looks along it.
    fn looks_ahead(&self) -> bool {
        let laser = self.mount.base_from_laser;
        laser.y == 0.0 && laser.theta == 0.0
    }

    /// States once what `FLASER` lines leave unsaid.
    fn describe_front_laser(&mut self, range_max: f64) -> io::Result<()> {
        if std::mem::replace(&mut self.front_laser_described, true) {
            return Ok(());
        }
        writeln!(self.out, "PARAM robot_frontlaser_offset {}", self.mount.base_from_laser.x)?;
        writeln!(self.out, "PARAM robot_front_laser_max {range_max}")
    }

    fn write_ranges(&mut self, scan: &Scan, sweep: &Sweep, no_return: f64) -> io::Result<()> {
        for range in &sweep.ranges {
            match scan.geometry.classify(*range) {
                Beam::Hit(_) => write!(self.out, " {range}")?,
                Beam::NoReturn => write!(self.out, " {no_return}")?,
                Beam::Invalid => write!(self.out, " 0")?,
            }
        }
        Ok(())
    }
}

/// A scan as an upright, counter-clockwise laser takes it.
struct Sweep {
    start: f64,
    increment: f64,
    range_max: f64,
    ranges: Vec<f32>,
}

impl Sweep {
    fn new(scan: &Scan, orientation: MountOrientation) -> Self {
        let upright = match orientation {
            MountOrientation::Upright => 1.0,
            MountOrientation::UpsideDown => -1.0,
        };
        let increment = upright * scan.geometry.angle_increment();
        let mut ranges = scan.ranges.clone();
        let rightmost = if increment < 0.0 {
            ranges.reverse();
            ranges.len().saturating_sub(1)
        } else {
            0
        };
        Self {
            start: upright * scan.geometry.angle(rightmost),
            increment: increment.abs(),
            range_max: scan.geometry.range_max().min(LONGEST),
            ranges,
        }
    }

    /// Whether this is a front laser with a beam every degree or half degree from the right.
    fn is_front_laser(&self) -> bool {
        let spacing = match self.ranges.len() {
            180 | 181 => PI / 180.0,
            360 | 361 => PI / 360.0,
            _ => return false,
        };
        (self.increment - spacing).abs() < 1e-5 && (self.start + 0.5 * PI).abs() < 1e-3
    }
}

fn fields(pose: Pose2) -> String {
    format!("{} {} {}", pose.x, pose.y, pose.theta)
}

fn end_of_line(stamp: Stamp) -> String {
    let seconds = stamp.as_seconds();
    format!("{seconds:.6} gmapd {seconds:.6}")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::scan::ScanGeometry;

    const STAMP: Stamp = Stamp(976_052_857_337_483_000);

    fn scan(angles: [f64; 2], ranges: Vec<f32>) -> Scan {
        let increment = (angles[1] - angles[0]) / (ranges.len() as f64 - 1.0);
        let geometry = ScanGeometry::new(angles, increment, [0.1, 8.0]).unwrap();
        Scan { stamp: STAMP, geometry, ranges }
    }

    fn written(mount: LaserMount, scan: &Scan) -> String {
        let mut writer = CarmenWriter::new(Vec::new(), mount);
        writer.write_scan(scan, Pose2::new(1.0, 2.0, 0.0)).unwrap();
        String::from_utf8(writer.finish().unwrap()).unwrap()
    }

    #[test]
    fn odometry_has_its_stamp_to_the_microsecond() {
        let mut writer = CarmenWriter::new(Vec::new(), LaserMount::default());
        writer.write_odometry(STAMP, Pose2::new(0.5, -1.25, 0.1)).unwrap();
        let line = String::from_utf8(writer.finish().unwrap()).unwrap();
        assert_eq!(line, "ODOM 0.5 -1.25 0.1 0 0 0 976052857.337483 gmapd 976052857.337483\n");
    }

    #[test]
    fn a_general_scan_states_its_geometry_and_both_poses() {
        let base_from_laser = Pose2::new(0.25, 0.0, 0.0);
        let mount = LaserMount { base_from_laser, ..LaserMount::default() };
        let ranges = vec![1.5, f32::INFINITY, f32::NEG_INFINITY, 0.3, f32::NAN];
        assert_eq!(
            written(mount, &scan([-1.0, 1.0], ranges)),
            "ROBOTLASER1 0 -1 2 0.5 8 0.01 0 5 1.5 8 0 0.3 0 0 1.25 2 0 1 2 0 0 0 0 0 0 \
             976052857.337483 gmapd 976052857.337483\n"
        );
    }

    #[test]
    fn a_half_circle_is_a_front_laser() {
        for beams in [181, 361] {
            let mut ranges = vec![2.0; beams];
            ranges[1] = f32::INFINITY;
            let base_from_laser = Pose2::new(0.25, 0.0, 0.0);
            let mount = LaserMount { base_from_laser, ..LaserMount::default() };
            let text = written(mount, &scan([-0.5 * PI, 0.5 * PI], ranges));
            let lines: Vec<&str> = text.lines().collect();
            assert_eq!(lines[0], "PARAM robot_frontlaser_offset 0.25");
            assert_eq!(lines[1], "PARAM robot_front_laser_max 8");
            assert!(lines[2].starts_with(&format!("FLASER {beams} 2 81.83 2 ")), "{text}");
            assert!(
                lines[2].ends_with(" 2 1.25 2 0 1 2 0 976052857.337483 gmapd 976052857.337483")
            );
        }
        let whole_circle = scan([-PI, PI], vec![2.0; 361]);
        assert!(written(LaserMount::default(), &whole_circle).starts_with("ROBOTLASER1 "));
        let to_the_left =
            LaserMount { base_from_laser: Pose2::new(0.0, 0.0, 0.5 * PI), ..LaserMount::default() };
        let half_circle = scan([-0.5 * PI, 0.5 * PI], vec![2.0; 181]);
        assert!(written(to_the_left, &half_circle).starts_with("ROBOTLASER1 "));
    }

    #[test]
    fn clockwise_and_upside_down_lasers_are_turned_around() {
        let orientation = MountOrientation::UpsideDown;
        let upside_down = LaserMount { orientation, ..LaserMount::default() };
        let expected = "ROBOTLASER1 0 -1 1.5 0.5 8 0.01 0 4 4 3 2 1 ";
        let from_right = scan([-0.5, 1.0], vec![1.0, 2.0, 3.0, 4.0]);
        let from_left = scan([0.5, -1.0], vec![1.0, 2.0, 3.0, 4.0]);
        for line in [written(upside_down, &from_right), written(LaserMount::default(), &from_left)]
        {
            assert!(line.starts_with(expected), "{line}");
        }
    }
}
