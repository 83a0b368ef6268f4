//! Live messages have stamps that increase; those of recordings may not.

use thiserror::Error;

use crate::logs::Reading;
use crate::slam::pose::{Pose2, Stamp};
use crate::slam::scan::LaserMount;

/// Between two readings of a log that has no two stamps in order, ns.
const FALLBACK_PERIOD: i64 = 100_000_000;

/// Why a log cannot be played as it is.
#[derive(Debug, Clone, Copy, PartialEq, Error)]
pub enum LogFault {
    /// A receiver could not tell the order of the readings.
    #[error(
        "line {line} has the stamp {:.6}, which is not after {:.6} of line {line_before}",
        stamp.as_seconds(), stamp_before.as_seconds()
    )]
    StampOrder {
        /// Line of the log, from 1.
        line: u64,
        /// Its stamp.
        stamp: Stamp,
        /// The line of the reading before.
        line_before: u64,
        /// Its stamp.
        stamp_before: Stamp,
    },
    /// A laser that moves on its robot has no static transform.
    #[error(
        "line {line} has the laser at ({:.3} m, {:.3} m, {:.3} rad) in the base frame, and the \
         lines before at ({:.3} m, {:.3} m, {:.3} rad); only one that does not move can be played",
        place(mount)[0], place(mount)[1], place(mount)[2],
        place(mount_before)[0], place(mount_before)[1], place(mount_before)[2]
    )]
    MovingLaser {
        /// Line of the log, from 1.
        line: u64,
        /// How the laser sits there.
        mount: LaserMount,
        /// How it sat until then.
        mount_before: LaserMount,
    },
}

const fn place(mount: &LaserMount) -> [f64; 3] {
    let place = mount.base_from_laser;
    [place.x, place.y, place.theta]
}

/// The last reading, to compare the next with.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Last {
    line: u64,
    stamp: Stamp,
    odom_from_base: Pose2,
    has_scan: bool,
}

impl Last {
    const fn new(reading: &Reading) -> Self {
        let Reading { line, stamp, odom_from_base, .. } = *reading;
        Self { line, stamp, odom_from_base, has_scan: reading.scan.is_some() }
    }

    /// Some logs have odometry on a line of its own and again with the sweep, of one stamp: they
    /// are one reading.
    fn is_one_with(&self, reading: &Reading) -> bool {
        self.stamp == reading.stamp
            && self.odom_from_base == reading.odom_from_base
            && !(self.has_scan && reading.scan.is_some())
    }
}

/// What has to be known of a log before it is played.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Survey {
    last: Option<Last>,
    /// Positive steps from stamp to stamp, ns.
    steps: Vec<i64>,
    mount: Option<LaserMount>,
    stamp_fault: Option<LogFault>,
    mount_fault: Option<LogFault>,
}

impl Survey {
    /// Takes the next reading of the log.
    pub fn add(&mut self, reading: &Reading) {
        let Reading { line, stamp, mount, .. } = *reading;
        if let Some(last) = self.last.replace(Last::new(reading)) {
            let (line_before, stamp_before) = (last.line, last.stamp);
            if stamp > stamp_before {
                self.steps.push(stamp.0.saturating_sub(stamp_before.0));
            } else if !last.is_one_with(reading) {
                let fault = LogFault::StampOrder { line, stamp, line_before, stamp_before };
                self.stamp_fault.get_or_insert(fault);
            }
        }
        if reading.scan.is_some() {
            let mount_before = *self.mount.get_or_insert(mount);
            if mount != mount_before {
                self.mount_fault.get_or_insert(LogFault::MovingLaser { line, mount, mount_before });
            }
        }
    }

    /// The first stamp that is not after the one before.
    #[must_use]
    pub const fn stamp_fault(&self) -> Option<LogFault> {
        self.stamp_fault
    }

    /// The first sweep of a laser that had been elsewhere on the robot.
    #[must_use]
    pub const fn mount_fault(&self) -> Option<LogFault> {
        self.mount_fault
    }

    /// How the laser sits on the robot; `None` for a log without sweeps.
    #[must_use]
    pub const fn mount(&self) -> Option<LaserMount> {
        self.mount
    }

    /// Gives the readings stamps that increase, with the log's usual period where they do not.
    #[must_use]
    pub fn restamper(mut self) -> Restamper {
        let middle = self.steps.len() / 2;
        let period = if self.steps.is_empty() {
            FALLBACK_PERIOD
        } else {
            *self.steps.select_nth_unstable(middle).1
        };
        Restamper { period, last: None }
    }
}

/// Changes as few stamps as it can.
#[derive(Debug, Clone, PartialEq)]
pub struct Restamper {
    /// The median of the positive steps, ns.
    period: i64,
    /// As it was, and the stamp it was given.
    last: Option<(Last, Stamp)>,
}

impl Restamper {
    /// The reading with its own stamp if that is after the stamp given before, else with that and
    /// the usual period.
    pub fn restamp(&mut self, reading: &mut Reading) {
        let stamp = match self.last {
            Some((last, given)) if last.is_one_with(reading) => given,
            Some((_, given)) if reading.stamp <= given => {
                Stamp(given.0.saturating_add(self.period))
            }
            Some(_) | None => reading.stamp,
        };
        self.last = Some((Last::new(reading), stamp));
        reading.stamp = stamp;
        if let Some(scan) = &mut reading.scan {
            scan.stamp = stamp;
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::collection::vec;
    use proptest::prelude::{prop_assert, proptest};

    use super::*;
    use crate::slam::pose::Pose2;
    use crate::slam::scan::{Scan, ScanGeometry};

    fn reading(line: u64, stamp: i64) -> Reading {
        let stamp = Stamp(stamp);
        let geometry = ScanGeometry::new([0.0, 1.0], 1.0, [0.1, 9.0]).unwrap();
        let scan = Some(Scan { stamp, geometry, ranges: vec![1.0, 2.0] });
        let mount = LaserMount::default();
        Reading { line, stamp, odom_from_base: Pose2::IDENTITY, scan, mount }
    }

    fn survey(stamps: &[i64]) -> Survey {
        let mut survey = Survey::default();
        for (index, &stamp) in stamps.iter().enumerate() {
            survey.add(&reading(index as u64 + 1, stamp));
        }
        survey
    }

    fn restamped(stamps: &[i64]) -> Vec<i64> {
        let mut restamper = survey(stamps).restamper();
        let restamp = |&stamp: &i64| {
            let mut reading = reading(1, stamp);
            restamper.restamp(&mut reading);
            assert_eq!(reading.scan.unwrap().stamp, reading.stamp);
            reading.stamp.0
        };
        stamps.iter().map(restamp).collect()
    }

    #[test]
    fn the_first_stamp_out_of_order_is_named() {
        assert_eq!(survey(&[1, 2, 3]).stamp_fault(), None);
        let fault = survey(&[1_000_000_000, 3_000_000_000, 2_500_000_000, 1]).stamp_fault();
        assert_eq!(
            fault.unwrap().to_string(),
            "line 3 has the stamp 2.500000, which is not after 3.000000 of line 2"
        );
        assert!(survey(&[5, 5]).stamp_fault().is_some());
    }

    /// As in a log that writes odometry on a line of its own, and with the sweep again.
    #[test]
    fn odometry_that_is_repeated_with_a_scan_is_in_order() {
        let odometry = |line, stamp| Reading { scan: None, ..reading(line, stamp) };
        let pairs = [odometry(1, 10), reading(2, 10), odometry(3, 20), reading(4, 20)];
        let mut survey = Survey::default();
        pairs.iter().for_each(|reading| survey.add(reading));
        assert_eq!(survey.stamp_fault(), None);
        let mut restamper = survey.clone().restamper();
        let stamps = pairs.map(|mut reading| {
            restamper.restamp(&mut reading);
            reading.stamp.0
        });
        assert_eq!(stamps, [10, 10, 20, 20]);
        let elsewhere = Pose2::new(1.0, 0.0, 0.0);
        survey.add(&Reading { odom_from_base: elsewhere, ..odometry(5, 20) });
        assert!(survey.stamp_fault().is_some());
    }

    #[test]
    fn a_laser_that_moves_is_named() {
        let mut survey = survey(&[1, 2]);
        assert_eq!((survey.mount(), survey.mount_fault()), (Some(LaserMount::default()), None));
        let base_from_laser = Pose2::new(0.5, 0.0, 0.25);
        let mount = LaserMount { base_from_laser, ..LaserMount::default() };
        survey.add(&Reading { mount, ..reading(9, 3) });
        let fault = survey.mount_fault().unwrap().to_string();
        assert!(
            fault.starts_with("line 9 has the laser at (0.500 m, 0.000 m, 0.250 rad)"),
            "{fault}"
        );
    }

    #[test]
    fn stamps_that_step_back_or_repeat_go_on_by_the_usual_period() {
        assert_eq!(restamped(&[0, 10, 20, 30]), [0, 10, 20, 30]);
        assert_eq!(restamped(&[0, 10, 20, 15, 25, 50, 50, 60]), [0, 10, 20, 30, 40, 50, 60, 70]);
        assert_eq!(restamped(&[7, 7]), [7, 7 + FALLBACK_PERIOD]);
    }

    proptest! {
        #[test]
        fn restamped_logs_increase(stamps in vec(0..1000_i64, 1..60)) {
            let restamped = restamped(&stamps);
            prop_assert!(restamped.is_sorted_by(|a, b| a < b), "{restamped:?}");
            prop_assert!(restamped.iter().zip(&stamps).all(|(new, old)| new >= old));
        }
    }
}
