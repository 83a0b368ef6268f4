//! A seeded simulator of a robot with a laser, with exact truth.
//!
//! One [`Scenario`] gives the same bytes on every machine: all randomness comes from its seed, and
//! no function whose last digit depends on the platform is used. [`Simulation::readings`] yields
//! what a robot would record together with where it truly was.
//!
//! The odometry frame coincides with the world frame at the first reading. A filter whose map
//! frame coincides with the odometry frame there maps the world in world coordinates, and its
//! poses compare with the truth directly.

mod bins;
pub mod building;
pub mod corridor;
pub mod lidar;
pub mod odometry;
mod random;
pub mod route;
pub mod shape;
pub mod site;
mod tour;
pub mod world;

use rand_chacha::ChaCha8Rng;

use self::lidar::Lidar;
use self::odometry::OdometryModel;
use self::random::{Purpose, generator};
use self::route::{Speeds, Trajectory};
use self::site::Site;
use self::world::World;
use crate::slam::pose::{Pose2, Stamp};
use crate::slam::scan::{GeometryError, Scan};

/// The stamp of the first reading: not 0, which many programs take for "unset".
const FIRST_STAMP: Stamp = Stamp(1_000_000_000_000);

/// A world to drive in, and how.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Scenario {
    /// The surroundings.
    pub place: Place,
    /// Where all randomness comes from.
    pub seed: u64,
    /// How often the robot drives its lap.
    pub laps: u32,
    /// Number of people walking about.
    pub people: usize,
    /// Beams of a laser that sees all around.
    pub beams: usize,
}

/// The surroundings of a [`Scenario`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Place {
    /// Offices of 40 m by 40 m; a lap is a tour of about 400 m with many revisits.
    Building,
    /// A ring corridor of 260 m with little to see.
    Ring,
    /// A straight corridor of 60 m with nothing to see.
    Corridor,
}

impl Scenario {
    /// One lap of `place` without people, with 360 beams.
    #[must_use]
    pub const fn new(place: Place, seed: u64) -> Self {
        Self { place, seed, laps: 1, people: 0, beams: 360 }
    }

    fn site(&self) -> Site {
        let site = match self.place {
            Place::Building => building::building(self.seed, 40.0),
            Place::Ring => corridor::ring_corridor(self.seed, 260.0),
            Place::Corridor => corridor::straight_corridor(60.0),
        };
        site.with_people(self.people, self.seed)
    }
}

/// A run of a robot through a world.
///
/// The fields may be changed before readings are taken.
#[derive(Debug, Clone)]
pub struct Simulation {
    /// The surroundings.
    pub world: World,
    /// The true motion of the base.
    pub trajectory: Trajectory,
    /// The laser.
    pub lidar: Lidar,
    /// The wheels.
    pub odometry: OdometryModel,
    /// Nanoseconds from scan to scan.
    pub scan_period_ns: i64,
    /// Odometry readings a scan; the last comes with the scan. At least 1.
    pub odometry_per_scan: u32,
    /// Where the errors of the sensors come from.
    pub seed: u64,
}

/// What the robot records at a scan, and the truth.
#[derive(Debug, Clone, PartialEq)]
pub struct Reading {
    /// When the sweep began.
    pub stamp: Stamp,
    /// Where the base truly was then.
    pub world_from_base: Pose2,
    /// Where odometry says it was.
    pub odom_from_base: Pose2,
    /// Odometry readings since the scan before, oldest first, without that of this scan.
    pub odometry_between: Vec<(Stamp, Pose2)>,
    /// The sweep.
    pub scan: Scan,
}

impl Simulation {
    /// A run through a scenario: 10 scans a second at 0.8 m/s, one odometry reading a scan.
    ///
    /// # Errors
    /// When the scenario has fewer than two beams.
    pub fn new(scenario: &Scenario) -> Result<Self, GeometryError> {
        let site = scenario.site();
        let lidar = Lidar::full_circle(scenario.beams)?;
        Ok(Self::through(&site, scenario.laps, lidar, scenario.seed))
    }

    /// A run of `laps` laps through any site; the seed is that of the sensors' errors.
    #[must_use]
    pub fn through(site: &Site, laps: u32, lidar: Lidar, seed: u64) -> Self {
        Self {
            world: site.world.clone(),
            trajectory: route::drive(&site.route(laps), &Speeds::default()),
            lidar,
            odometry: OdometryModel::default(),
            scan_period_ns: 100_000_000,
            odometry_per_scan: 1,
            seed,
        }
    }

    /// Number of scans of the run.
    #[must_use]
    pub fn scan_count(&self) -> usize {
        let duration_ns = self.trajectory.duration_s() * 1e9;
        (duration_ns / self.scan_period_ns as f64) as usize + 1
    }

    /// Everything the robot records, scan by scan.
    #[must_use]
    pub fn readings(&self) -> Readings<'_> {
        Readings {
            simulation: self,
            rng: generator(self.seed, Purpose::Odometry, 0),
            next: 0,
            odom_from_base: self.trajectory.at(0.0),
        }
    }

    /// The scan with this number; each can be had without those before it.
    #[must_use]
    pub fn scan(&self, index: usize) -> Scan {
        let stamp = self.stamp(index, self.odometry_per_scan);
        let mut rng = generator(self.seed, Purpose::Lidar, index as u64);
        let world_from_base = |time_s| self.trajectory.at(time_s);
        let ranges = self.lidar.sweep(&self.world, world_from_base, time_s(stamp), &mut rng);
        Scan { stamp, geometry: self.lidar.stated_geometry(), ranges }
    }

    /// Stamp of an odometry reading of a scan, counted from 1; the last is that of the scan.
    fn stamp(&self, scan: usize, reading: u32) -> Stamp {
        let before = i64::from(self.odometry_per_scan - reading) * self.scan_period_ns;
        let before = before / i64::from(self.odometry_per_scan);
        Stamp(FIRST_STAMP.0 + scan as i64 * self.scan_period_ns - before)
    }
}

/// Iterator over the readings of a [`Simulation`].
#[derive(Debug, Clone)]
pub struct Readings<'a> {
    simulation: &'a Simulation,
    rng: ChaCha8Rng,
    next: usize,
    odom_from_base: Pose2,
}

impl Readings<'_> {
    /// Moves the odometry on from one stamp to another.
    fn advance(&mut self, from: Stamp, to: Stamp) {
        let at = |stamp| self.simulation.trajectory.at(time_s(stamp));
        let motion = at(from).between(at(to));
        let measured = self.simulation.odometry.measured(motion, &mut self.rng);
        self.odom_from_base = self.odom_from_base * measured;
    }
}

impl Iterator for Readings<'_> {
    type Item = Reading;

    fn next(&mut self) -> Option<Reading> {
        let simulation = self.simulation;
        let index = self.next;
        if index >= simulation.scan_count() {
            return None;
        }
        self.next += 1;
        let mut odometry_between = Vec::new();
        if index > 0 {
            let last = simulation.odometry_per_scan;
            let mut before = simulation.stamp(index - 1, last);
            for reading in 1..=last {
                let stamp = simulation.stamp(index, reading);
                self.advance(before, stamp);
                before = stamp;
                odometry_between.push((stamp, self.odom_from_base));
            }
            odometry_between.pop();
        }
        let scan = simulation.scan(index);
        Some(Reading {
            stamp: scan.stamp,
            world_from_base: simulation.trajectory.at(time_s(scan.stamp)),
            odom_from_base: self.odom_from_base,
            odometry_between,
            scan,
        })
    }
}

/// Seconds since the start of the run.
fn time_s(stamp: Stamp) -> f64 {
    stamp.seconds_since(FIRST_STAMP)
}

#[cfg(test)]
mod tests;
