//! A simulated planar laser.

use std::f64::consts::{PI, TAU};

use rand::Rng;

use super::random::gaussian;
use super::world::{Ray, World};
use crate::slam::pose::Pose2;
use crate::slam::scan::{Beam, GeometryError, LaserMount, ScanGeometry};

/// What a laser measures and how badly.
#[derive(Debug, Clone, PartialEq)]
pub struct Lidar {
    /// Number of beams.
    pub beams: usize,
    /// Directions of the beams and the measurable ranges.
    pub geometry: ScanGeometry,
    /// Standard deviation of a range, m.
    pub range_noise_std: f64,
    /// Share of beams that report any range up to the longest.
    pub outlier_rate: f64,
    /// Share of beams that report nothing.
    pub dropout_rate: f64,
    /// Time from the first beam of a sweep to the last, s; 0 takes all at once.
    pub sweep_duration_s: f64,
    /// How the laser sits on the robot.
    pub mount: LaserMount,
}

impl Lidar {
    /// `beams` all around, the first to the rear, 0.1 m to 20 m.
    ///
    /// # Errors
    /// With fewer than two beams.
    pub fn full_circle(beams: usize) -> Result<Self, GeometryError> {
        let increment = TAU / beams as f64;
        Self::new(beams, [-PI, -PI + increment * (beams as f64 - 1.0)], increment)
    }

    /// `beams` from right (-90 degrees) to left (+90 degrees), both included, 0.1 m to 20 m.
    ///
    /// # Errors
    /// With fewer than two beams.
    pub fn half_circle(beams: usize) -> Result<Self, GeometryError> {
        Self::new(beams, [-0.5 * PI, 0.5 * PI], PI / (beams as f64 - 1.0))
    }

    fn new(beams: usize, angles: [f64; 2], increment: f64) -> Result<Self, GeometryError> {
        Ok(Self {
            beams,
            geometry: ScanGeometry::new(angles, increment, [0.1, 20.0])?,
            range_noise_std: 0.01,
            outlier_rate: 0.007,
            dropout_rate: 0.0,
            sweep_duration_s: 0.0,
            mount: LaserMount::default(),
        })
    }

    /// The ranges of a sweep that begins `time_s` seconds after the start of the run, m.
    ///
    /// `world_from_base` tells where the robot is at such a time. No return is +Inf and too close
    /// is -Inf, as in REP-117.
    pub fn sweep(
        &self,
        world: &World,
        world_from_base: impl Fn(f64) -> Pose2,
        time_s: f64,
        rng: &mut impl Rng,
    ) -> Vec<f32> {
        let between_beams = self.between_beams_s();
        let mut base = world_from_base(time_s);
        let beam = |index| {
            let time_s = time_s + index as f64 * between_beams;
            if between_beams > 0.0 {
                base = world_from_base(time_s);
            }
            let range = world.cast(self.ray(base, index), time_s);
            self.measured(range, rng)
        };
        (0..self.beams).map(beam).collect()
    }

    /// What the laser says of its beams, with the time from each to the next.
    #[must_use]
    pub fn stated_geometry(&self) -> ScanGeometry {
        self.geometry.with_time_increment(self.between_beams_s())
    }

    fn between_beams_s(&self) -> f64 {
        self.sweep_duration_s / self.beams.saturating_sub(1).max(1) as f64
    }

    fn ray(&self, world_from_base: Pose2, index: usize) -> Ray {
        let angle_in_base = self.mount.angle_in_base(self.geometry.angle(index));
        Ray {
            origin: world_from_base * self.mount.base_from_laser.position(),
            angle: world_from_base.theta + angle_in_base,
            limit: self.geometry.range_max(),
        }
    }

    /// What the sensor reports for a true range. Every beam takes the same number of draws.
    fn measured(&self, range: Option<f64>, rng: &mut impl Rng) -> f32 {
        let (event, anywhere) = (rng.random::<f64>(), rng.random::<f64>());
        let noise = self.range_noise_std * gaussian(rng);
        let range = if event < self.dropout_rate {
            f64::INFINITY
        } else if event < self.dropout_rate + self.outlier_rate {
            anywhere * self.geometry.range_max()
        } else {
            range.map_or(f64::INFINITY, |range| range + noise)
        };
        match self.geometry.classify(range as f32) {
            Beam::Hit(_) => range as f32,
            Beam::NoReturn => f32::INFINITY,
            Beam::Invalid => f32::NEG_INFINITY,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sim::random::{Purpose, generator};
    use crate::sim::shape::{Circle, Segment, rectangle};
    use crate::slam::pose::Point2;
    use crate::slam::scan::MountOrientation;

    fn exact(beams: usize) -> Lidar {
        let lidar = Lidar::full_circle(beams).unwrap();
        Lidar { range_noise_std: 0.0, outlier_rate: 0.0, ..lidar }
    }

    /// A room of 8 m by 6 m around the origin with a pillar ahead on the left.
    fn room() -> World {
        let walls = rectangle(Point2::new(-4.0, -3.0), Point2::new(4.0, 3.0));
        let pillar = Circle { center: Point2::new(2.0, 1.0), radius: 0.3 };
        World::new(walls.to_vec(), vec![pillar])
    }

    fn sweep(lidar: &Lidar, world_from_base: Pose2) -> Vec<f32> {
        lidar.sweep(&room(), |_| world_from_base, 0.0, &mut generator(1, Purpose::Lidar, 0))
    }

    #[test]
    fn an_exact_laser_measures_the_walls() {
        let ranges = sweep(&exact(4), Pose2::new(1.0, 0.5, 0.0));
        assert_eq!(ranges, [5.0, 3.5, 3.0, 2.5]);
    }

    #[test]
    fn errors_have_their_rates() {
        let lidar = Lidar {
            range_noise_std: 0.02,
            outlier_rate: 0.01,
            dropout_rate: 0.03,
            ..exact(100_000)
        };
        let truth = sweep(&exact(100_000), Pose2::IDENTITY);
        let ranges = sweep(&lidar, Pose2::IDENTITY);
        let share = |count: usize| count as f64 / 100_000.0;
        let dropouts = ranges.iter().filter(|r| r.is_infinite()).count();
        assert!((share(dropouts) - 0.03).abs() < 0.003, "{dropouts} dropouts");
        let errors = ranges.iter().zip(&truth).map(|(r, t)| f64::from(r - t));
        let (near, far): (Vec<f64>, Vec<f64>) =
            errors.filter(|e| e.is_finite()).partition(|e| e.abs() < 0.12);
        assert!((share(far.len()) - 0.01).abs() < 0.002, "{} outliers", far.len());
        let mean = near.iter().sum::<f64>() / near.len() as f64;
        let std = (near.iter().map(|e| e * e).sum::<f64>() / near.len() as f64).sqrt();
        assert!(mean.abs() < 3e-4 && (std - 0.02).abs() < 5e-4, "mean {mean}, std {std}");
    }

    #[test]
    fn nothing_in_range_is_infinite_and_too_close_is_minus_infinite() {
        let lidar = exact(4);
        let far =
            World::new(vec![Segment::new(Point2::new(25.0, -9.0), Point2::new(25.0, 9.0))], vec![]);
        let at = |x| {
            lidar.sweep(
                &far,
                |_| Pose2::new(x, 0.0, 0.0),
                0.0,
                &mut generator(1, Purpose::Lidar, 0),
            )
        };
        assert_eq!(at(0.0)[2], f32::INFINITY);
        assert_eq!(at(6.0)[2], 19.0);
        assert_eq!(at(24.95)[2], f32::NEG_INFINITY);
    }

    #[test]
    fn upside_down_mirrors_the_sweep() {
        let upright = exact(361);
        let mount = LaserMount { orientation: MountOrientation::UpsideDown, ..upright.mount };
        let flipped = Lidar { mount, ..upright.clone() };
        let there = Pose2::new(0.3, -0.2, 0.4);
        let mut mirrored = sweep(&flipped, there);
        // Beam 0 points straight back either way; the others swap sides.
        mirrored[1..].reverse();
        for (a, b) in sweep(&upright, there).iter().zip(&mirrored) {
            assert!((a - b).abs() < 1e-4, "{a} {b}");
        }
    }

    #[test]
    fn a_slow_sweep_sees_each_beam_from_where_the_robot_then_is() {
        let lidar = Lidar { sweep_duration_s: 0.3, ..exact(4) };
        let driving = |time_s: f64| Pose2::new(2.0 * time_s - 1.0, 0.0, 0.0);
        let ranges = lidar.sweep(&room(), driving, 0.5, &mut generator(1, Purpose::Lidar, 0));
        for (range, expected) in ranges.iter().zip([4.0, 3.0, 3.6, 3.0]) {
            assert!((range - expected).abs() < 1e-5, "{ranges:?}");
        }
    }
}
