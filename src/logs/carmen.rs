//! CARMEN's text logs: one message a line, units m, rad and s.
//!
//! `FLASER`, `ROBOTLASER1`, `ODOM` and `PARAM` lines are used; others are counted.
//! A log is read twice: [`CarmenLog::open`] surveys it, because what an `FLASER` reading without
//! return looks like is known only when all have been seen, and [`CarmenLog::readings`] streams
//! it, so that memory does not grow with its length.

use std::f64::consts::{FRAC_PI_2, PI};
use std::fmt;
use std::path::{Path, PathBuf};
use std::str::SplitAsciiWhitespace;

use super::lines::{LineError, Lines};
use super::{LogError, LogStatistics, MalformedLine, Reading};
use crate::slam::pose::{Pose2, Stamp, wrap_angle};
use crate::slam::scan::{LaserMount, MountOrientation, Scan, ScanGeometry};

/// CARMEN logs name no shortest range. No laser measures less than this, and some write a few
/// millimetres where nothing reflected.
const RANGE_MIN: f64 = 0.02;

/// How often the largest range of a log must occur to be what the sensor writes without return.
const NO_RETURN_OCCURRENCES: u64 = 3;

/// Places of the laser that differ by less, m and rad, are one place written with few decimals.
const MOUNT_ROUNDING: f64 = 0.01;

/// Malformed lines that are kept; all are counted.
const MALFORMED_KEPT: usize = 100;

/// Keywords that are counted one by one; a file that is no log has as many as lines.
const KEYWORDS_KEPT: usize = 64;

/// A CARMEN log that has been surveyed.
#[derive(Debug)]
pub struct CarmenLog {
    path: PathBuf,
    lasers: Lasers,
    statistics: LogStatistics,
}

impl CarmenLog {
    /// Reads a log, gzipped or not, once from end to end.
    ///
    /// # Errors
    /// When the file cannot be read or nothing in it is usable. Malformed lines are no error:
    /// [`CarmenLog::statistics`] has them.
    pub fn open(path: &Path) -> Result<Self, LogError> {
        let open = |source| LogError::Open { path: path.to_owned(), source };
        let mut lines = Lines::open(path).map_err(open)?;
        let mut survey = Survey::default();
        survey.read(&mut lines).map_err(|source| LogError::Read {
            path: path.to_owned(),
            line: lines.number(),
            source,
        })?;
        let (lasers, statistics) = survey.finish();
        if statistics.readings == 0 {
            return Err(LogError::NoReadings {
                path: path.to_owned(),
                lines: statistics.lines,
                malformed: statistics.malformed,
            });
        }
        Ok(Self { path: path.to_owned(), lasers, statistics })
    }

    /// What the survey found.
    #[must_use]
    pub const fn statistics(&self) -> &LogStatistics {
        &self.statistics
    }

    /// The usable readings in file order.
    ///
    /// # Errors
    /// When the file cannot be opened again.
    pub fn readings(&self) -> Result<Readings, LogError> {
        let open = |source| LogError::Open { path: self.path.clone(), source };
        let lines = Lines::open(&self.path).map_err(open)?;
        Ok(Readings { path: self.path.clone(), lines, lasers: self.lasers })
    }

    /// The usable readings in file order with the poses that their scans were corrected to:
    /// `FLASER` lines have one of the laser beside that of odometry, which in a raw log is the
    /// same; other lines with a scan have the robot's alone, and `ODOM` lines have none.
    ///
    /// # Errors
    /// When the file cannot be opened again.
    pub fn corrected_readings(
        &self,
    ) -> Result<impl Iterator<Item = Result<Reading, LogError>> + use<>, LogError> {
        let mut readings = self.readings()?;
        readings.lasers.flaser_pose = FlaserPose::OfLaser;
        Ok(readings.filter(|reading| reading.as_ref().map_or(true, |r| r.scan.is_some())))
    }

    /// Whether the pose of some scan was corrected: in a raw log all are those of odometry.
    ///
    /// # Errors
    /// When the file cannot be read again.
    pub fn has_corrected_poses(&self) -> Result<bool, LogError> {
        let scans = self.readings()?.filter(|r| r.as_ref().map_or(true, |r| r.scan.is_some()));
        for (raw, corrected) in scans.zip(self.corrected_readings()?) {
            if !is_close(raw?.odom_from_base, corrected?.odom_from_base) {
                return Ok(true);
            }
        }
        Ok(false)
    }
}

/// The usable readings of a log, one after the other.
pub struct Readings {
    path: PathBuf,
    lines: Lines,
    lasers: Lasers,
}

impl fmt::Debug for Readings {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.debug_struct("Readings").field("path", &self.path).finish_non_exhaustive()
    }
}

impl Iterator for Readings {
    type Item = Result<Reading, LogError>;

    fn next(&mut self) -> Option<Self::Item> {
        loop {
            let number = self.lines.number() + 1;
            match self.lines.next() {
                Ok(None) => return None,
                Ok(Some(Err(_))) => {}
                Ok(Some(Ok(line))) => {
                    if let Ok(Message::Reading(reading)) = parse(line, &self.lasers) {
                        return Some(Ok(Reading { line: number, ..reading }));
                    }
                }
                Err(source) => {
                    let path = self.path.clone();
                    return Some(Err(LogError::Read { path, line: number - 1, source }));
                }
            }
        }
    }
}

/// What one line leaves unsaid and the whole log tells.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Lasers {
    /// Of `FLASER` lines.
    range_max: f64,
    /// Of `FLASER` lines.
    base_from_front_laser: Pose2,
    /// Of `ROBOTLASER1` lines: the mean of those that are close to the first.
    base_from_robot_laser: Option<Pose2>,
    /// Which pose of `FLASER` lines is taken.
    flaser_pose: FlaserPose,
}

/// The poses of an `FLASER` line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum FlaserPose {
    /// The robot's, by its odometry.
    OfOdometry,
    /// The laser's, as some localisation corrected it.
    OfLaser,
}

impl Default for Lasers {
    fn default() -> Self {
        Self {
            range_max: f64::INFINITY,
            base_from_front_laser: Pose2::IDENTITY,
            base_from_robot_laser: None,
            flaser_pose: FlaserPose::OfOdometry,
        }
    }
}

impl Lasers {
    /// Lasers are screwed to their robots: what a line says about the place of one differs from
    /// the others only by the decimals of the poses it is taken from, or something is moving.
    fn robot_laser(&self, base_from_laser: Pose2) -> Pose2 {
        match self.base_from_robot_laser {
            Some(common) if is_close(common, base_from_laser) => common,
            _ => base_from_laser,
        }
    }
}

fn is_close(a: Pose2, b: Pose2) -> bool {
    let difference = a.between(b);
    difference.position().norm() < MOUNT_ROUNDING && difference.theta.abs() < MOUNT_ROUNDING
}

/// Gathers what must be known of the whole log.
#[derive(Debug, Default)]
struct Survey {
    statistics: LogStatistics,
    base_from_front_laser: Pose2,
    robot_laser: MeanPlace,
    range_max_parameter: Option<f64>,
    largest_range: f32,
    largest_range_count: u64,
}

impl Survey {
    fn read(&mut self, lines: &mut Lines) -> std::io::Result<()> {
        loop {
            let number = lines.number() + 1;
            let Some(line) = lines.next()? else { return Ok(()) };
            self.statistics.lines += 1;
            let message = line.and_then(|line| {
                self.count_keyword(line);
                parse(line, &Lasers::default())
            });
            match message {
                Ok(Message::Reading(reading)) => self.add_reading(&reading),
                Ok(Message::FrontLaserOffset(x)) => {
                    self.base_from_front_laser = Pose2::new(x, 0.0, 0.0);
                }
                Ok(Message::FrontLaserMax(range)) => self.range_max_parameter = Some(range),
                Ok(Message::Other) => {}
                Err(reason) => self.add_malformed(MalformedLine { line: number, reason }),
            }
        }
    }

    fn count_keyword(&mut self, line: &str) {
        let keyword = match line.split_ascii_whitespace().next() {
            None => "(empty)",
            Some(word) if word.starts_with('#') => "#",
            Some(word) => word,
        };
        let counts = &mut self.statistics.lines_by_keyword;
        let known = counts.contains_key(keyword) || counts.len() < KEYWORDS_KEPT;
        let keyword = if known && keyword.len() <= 32 { keyword } else { "(other)" };
        *counts.entry(keyword.to_owned()).or_default() += 1;
    }

    fn add_reading(&mut self, reading: &Reading) {
        let statistics = &mut self.statistics;
        statistics.readings += 1;
        let (first, last) = statistics.stamps.unwrap_or((reading.stamp, reading.stamp));
        statistics.stamps = Some((first.min(reading.stamp), last.max(reading.stamp)));
        let Some(scan) = &reading.scan else { return };
        statistics.scans += 1;
        if scan.geometry.range_max().is_finite() {
            // A ROBOTLASER1 line says its own.
            self.robot_laser.add(reading.mount.base_from_laser);
            return;
        }
        for &range in scan.ranges.iter().filter(|range| range.is_finite()) {
            if range > self.largest_range {
                (self.largest_range, self.largest_range_count) = (range, 0);
            }
            self.largest_range_count += u64::from(range == self.largest_range);
        }
    }

    fn add_malformed(&mut self, line: MalformedLine) {
        self.statistics.malformed += 1;
        if self.statistics.first_malformed.len() < MALFORMED_KEPT {
            self.statistics.first_malformed.push(line);
        }
    }

    fn finish(self) -> (Lasers, LogStatistics) {
        let largest = f64::from(self.largest_range);
        let observed = if self.largest_range_count >= NO_RETURN_OCCURRENCES {
            largest
        } else {
            largest + 1.0 // Every reading is a hit.
        };
        // A configured maximum may lie above what the sensor writes without return.
        let range_max = self.range_max_parameter.map_or(observed, |range| range.min(observed));
        let range_max = if range_max > RANGE_MIN { range_max } else { f64::INFINITY };
        let lasers = Lasers {
            range_max,
            base_from_front_laser: self.base_from_front_laser,
            base_from_robot_laser: self.robot_laser.mean(),
            flaser_pose: FlaserPose::OfOdometry,
        };
        (lasers, self.statistics)
    }
}

/// The mean of the places close to the first.
#[derive(Debug, Default)]
struct MeanPlace {
    first: Option<Pose2>,
    /// Of the differences from the first.
    sum: [f64; 3],
    count: u64,
}

impl MeanPlace {
    fn add(&mut self, place: Pose2) {
        let first = *self.first.get_or_insert(place);
        if is_close(first, place) {
            let turn = wrap_angle(place.theta - first.theta);
            for (sum, difference) in
                self.sum.iter_mut().zip([place.x - first.x, place.y - first.y, turn])
            {
                *sum += difference;
            }
            self.count += 1;
        }
    }

    fn mean(&self) -> Option<Pose2> {
        let Pose2 { x, y, theta } = self.first.filter(|_| self.count > 0)?;
        let [dx, dy, turn] = self.sum.map(|sum| sum / self.count as f64);
        Some(Pose2::new(x + dx, y + dy, wrap_angle(theta + turn)))
    }
}

/// What one line says.
#[derive(Debug, PartialEq)]
enum Message {
    Reading(Reading),
    FrontLaserOffset(f64),
    FrontLaserMax(f64),
    Other,
}

fn parse(line: &str, lasers: &Lasers) -> Result<Message, LineError> {
    let mut fields = Fields::new(line);
    match fields.next() {
        "FLASER" => parse_flaser(fields, lasers).map(Message::Reading),
        "ROBOTLASER1" => parse_robotlaser(fields, lasers).map(Message::Reading),
        "ODOM" => parse_odom(fields).map(Message::Reading),
        "PARAM" => parse_param(fields),
        _ => Ok(Message::Other),
    }
}

/// `FLASER n r1..rn x y theta odom_x odom_y odom_theta ipc_time host logger_time`
fn parse_flaser(mut fields: Fields<'_>, lasers: &Lasers) -> Result<Reading, LineError> {
    let beams = fields.beams()?;
    fields.expect(beams.saturating_add(11))?;
    let ranges = fields.ranges(beams)?;
    let corrected_laser = fields.pose()?;
    let odometry = fields.pose()?;
    let base_from_laser = lasers.base_from_front_laser;
    let parent_from_base = match lasers.flaser_pose {
        FlaserPose::OfOdometry => odometry,
        FlaserPose::OfLaser => corrected_laser * base_from_laser.inverse(),
    };
    let stamp = fields.stamp()?;
    let increment = sick_increment(beams);
    let geometry = geometry(-FRAC_PI_2, increment, beams, lasers.range_max)?;
    let scan = Scan { stamp, geometry, ranges };
    Ok(scan_reading(scan, parent_from_base, base_from_laser))
}

/// `ROBOTLASER1 type start_angle fov resolution max_range accuracy remission_mode n r1..rn
/// n_rem rem.. laser_x laser_y laser_theta robot_x robot_y robot_theta tv rv forward_safety
/// side_safety turn_axis ipc_time host logger_time`
fn parse_robotlaser(mut fields: Fields<'_>, lasers: &Lasers) -> Result<Reading, LineError> {
    fields.number("laser type")?;
    let start_angle = fields.number("start angle")?;
    let field_of_view = fields.number("field of view")?;
    let resolution = fields.number("angular resolution")?;
    let range_max = fields.number("maximum range")?;
    fields.number("accuracy")?;
    fields.number("remission mode")?;
    let beams = fields.beams()?;
    fields.expect_at_least(beams.saturating_add(24))?;
    let ranges = fields.ranges(beams)?;
    let remissions = fields.count("number of remissions")?;
    fields.expect(beams.saturating_add(remissions).saturating_add(24))?;
    fields.ranges(remissions)?;
    let odom_from_laser = fields.pose()?;
    let odom_from_base = fields.pose()?;
    for field in ["tv", "rv", "forward safety", "side safety", "turn axis"] {
        fields.number(field)?;
    }
    let stamp = fields.stamp()?;
    let increment = stated_increment(field_of_view, resolution, beams);
    let geometry = geometry(start_angle, increment, beams, range_max)?;
    let scan = Scan { stamp, geometry, ranges };
    let base_from_laser = lasers.robot_laser(odom_from_base.between(odom_from_laser));
    Ok(scan_reading(scan, odom_from_base, base_from_laser))
}

/// `ODOM x y theta tv rv accel ipc_time host logger_time`
fn parse_odom(mut fields: Fields<'_>) -> Result<Reading, LineError> {
    fields.expect(10)?;
    let odom_from_base = fields.pose()?;
    for field in ["tv", "rv", "acceleration"] {
        fields.number(field)?;
    }
    let stamp = fields.stamp()?;
    let mount = LaserMount::default();
    Ok(Reading { line: 0, stamp, odom_from_base, scan: None, mount })
}

/// `PARAM name value ...`
fn parse_param(mut fields: Fields<'_>) -> Result<Message, LineError> {
    fields.expect_at_least(2)?;
    match fields.next() {
        "robot_frontlaser_offset" => {
            fields.number("robot_frontlaser_offset").map(Message::FrontLaserOffset)
        }
        "robot_front_laser_max" => {
            fields.number("robot_front_laser_max").map(Message::FrontLaserMax)
        }
        _ => Ok(Message::Other),
    }
}

fn scan_reading(scan: Scan, odom_from_base: Pose2, base_from_laser: Pose2) -> Reading {
    let mount = LaserMount { base_from_laser, orientation: MountOrientation::Upright };
    Reading { line: 0, stamp: scan.stamp, odom_from_base, scan: Some(scan), mount }
}

/// Angle between the beams of a SICK over half a circle: 180 and 181 beams are one degree apart,
/// 360 and 361 half a degree; an odd count has a beam on either end, an even one lacks the last.
fn sick_increment(beams: usize) -> f64 {
    let intervals = if beams % 2 == 1 { (beams - 1).max(1) } else { beams };
    PI / intervals as f64
}

/// Angle between beams by their stated resolution, or by the field of view where the two agree:
/// written with six decimals, the resolution of a thousand beams is off by a milliradian at the
/// end.
fn stated_increment(field_of_view: f64, resolution: f64, beams: usize) -> f64 {
    let spans = |intervals: f64| {
        intervals >= 1.0 && (resolution * intervals - field_of_view).abs() <= resolution / 2.0
    };
    let beams = beams as f64;
    if spans(beams - 1.0) {
        field_of_view / (beams - 1.0)
    } else if spans(beams) {
        field_of_view / beams
    } else {
        resolution
    }
}

fn geometry(
    start_angle: f64,
    increment: f64,
    beams: usize,
    range_max: f64,
) -> Result<ScanGeometry, LineError> {
    let end_angle = start_angle + increment * (beams - 1) as f64;
    Ok(ScanGeometry::new([start_angle, end_angle], increment, [RANGE_MIN, range_max])?)
}

/// The fields of a line, from left to right. Past its end they are empty.
struct Fields<'a> {
    rest: SplitAsciiWhitespace<'a>,
    total: usize,
}

impl<'a> Fields<'a> {
    fn new(line: &'a str) -> Self {
        let rest = line.split_ascii_whitespace();
        Self { total: rest.clone().count(), rest }
    }

    fn next(&mut self) -> &'a str {
        self.rest.next().unwrap_or("")
    }

    fn expect(&self, expected: usize) -> Result<(), LineError> {
        if self.total == expected {
            return Ok(());
        }
        Err(LineError::FieldCount { expected, found: self.total })
    }

    fn expect_at_least(&self, expected: usize) -> Result<(), LineError> {
        if self.total >= expected { Ok(()) } else { self.expect(expected) }
    }

    fn number(&mut self, field: &'static str) -> Result<f64, LineError> {
        let text = self.next();
        let not_a_number = || LineError::NotANumber { field, text: shortened(text) };
        let value: f64 = text.parse().ok().ok_or_else(not_a_number)?;
        if value.is_finite() { Ok(value) } else { Err(LineError::NotFinite { field, value }) }
    }

    fn count(&mut self, field: &'static str) -> Result<usize, LineError> {
        let text = self.next();
        let not_a_number = || LineError::NotANumber { field, text: shortened(text) };
        text.parse().ok().ok_or_else(not_a_number)
    }

    fn beams(&mut self) -> Result<usize, LineError> {
        match self.count("number of beams")? {
            0 => Err(LineError::NoBeams),
            beams => Ok(beams),
        }
    }

    /// Ranges may be anything a float can be: the core classifies them.
    fn ranges(&mut self, beams: usize) -> Result<Vec<f32>, LineError> {
        let parse = |text: &str| {
            let not_a_number = || LineError::NotANumber { field: "range", text: shortened(text) };
            text.parse().ok().ok_or_else(not_a_number)
        };
        (0..beams).map(|_| parse(self.next())).collect()
    }

    fn pose(&mut self) -> Result<Pose2, LineError> {
        Ok(Pose2::new(self.number("x")?, self.number("y")?, self.number("theta")?))
    }

    fn stamp(&mut self) -> Result<Stamp, LineError> {
        self.number("ipc_time").map(Stamp::from_seconds)
    }
}

fn shortened(text: &str) -> String {
    text.chars().take(32).collect()
}

#[cfg(test)]
mod tests;
