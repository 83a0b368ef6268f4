//! Where the robot is to go, and how a differential drive gets there.

use std::f64::consts::PI;

use super::shape::{Segment, minus, plus};
use crate::slam::pose::{Point2, Pose2, wrap_angle};

/// Corners sharper than this are turned on the spot, rad.
const PIVOT_ANGLE: f64 = 2.6;

/// Waypoints in free space, joined by straight lines, in the world frame (m).
#[derive(Debug, Clone, PartialEq)]
pub struct Route {
    waypoints: Vec<Point2>,
}

impl Route {
    /// A route through `waypoints`; points that repeat their predecessor are left out.
    #[must_use]
    pub fn new(mut waypoints: Vec<Point2>) -> Self {
        waypoints.dedup_by(|next, point| minus(*next, *point).norm() < 1e-9);
        Self { waypoints }
    }

    /// `laps` times around a closed `circuit`, then `overlap_m` metres of it once more.
    #[must_use]
    pub fn around(circuit: &[Point2], laps: u32, overlap_m: f64) -> Self {
        let mut waypoints: Vec<Point2> = (0..laps).flat_map(|_| circuit).copied().collect();
        waypoints.extend(circuit.first());
        let mut left = overlap_m;
        for leg in Self::new(circuit.to_vec()).legs() {
            if left <= 0.0 {
                break;
            }
            waypoints.push(leg.point_at(left.min(leg.length())));
            left -= leg.length();
        }
        Self::new(waypoints)
    }

    /// The waypoints.
    #[must_use]
    pub fn waypoints(&self) -> &[Point2] {
        &self.waypoints
    }

    /// The straight lines between waypoints.
    pub fn legs(&self) -> impl Iterator<Item = Segment> + '_ {
        self.waypoints.windows(2).map(|ends| Segment::new(ends[0], ends[1]))
    }
}

/// How a robot drives.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Speeds {
    /// Speed on straight lines, m/s.
    pub forward: f64,
    /// Largest turn rate, rad/s.
    pub turn: f64,
    /// Radius of the arcs that round corners, m.
    pub corner_radius: f64,
}

impl Default for Speeds {
    fn default() -> Self {
        Self { forward: 0.8, turn: 1.0, corner_radius: 0.4 }
    }
}

/// The exact motion of the base over time, in the world frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Trajectory {
    pieces: Vec<Piece>,
    duration_s: f64,
    length_m: f64,
}

/// A stretch driven at constant speed and turn rate: a line, an arc or a turn on the spot.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Piece {
    start_s: f64,
    world_from_base: Pose2,
    speed: f64,
    turn_rate: f64,
}

impl Piece {
    fn at(&self, time_s: f64) -> Pose2 {
        let (way, turn) =
            (self.speed * (time_s - self.start_s), self.turn_rate * (time_s - self.start_s));
        let half = 0.5 * turn;
        let chord = if half.abs() < 1e-9 { way } else { way * libm::sin(half) / half };
        let (sin, cos) = libm::sincos(half);
        self.world_from_base * Pose2::new(chord * cos, chord * sin, turn)
    }
}

/// Drives along `route`, rounding its corners, without a stop.
#[must_use]
pub fn drive(route: &Route, speeds: &Speeds) -> Trajectory {
    let legs: Vec<Segment> = route.legs().collect();
    let Some(first) = legs.first() else {
        let start = route.waypoints.first().copied().unwrap_or_default();
        return Trajectory::standing(Pose2::new(start.x, start.y, 0.0));
    };
    let mut trajectory = Trajectory::standing(Pose2::new(first.a.x, first.a.y, heading(*first)));
    let mut driven_of_leg = 0.0;
    for (index, leg) in legs.iter().enumerate() {
        let corner = legs.get(index + 1).map(|next| Corner::new(*leg, *next, speeds));
        let cut = corner.map_or(0.0, |corner| corner.cut);
        trajectory.straight(*leg, driven_of_leg, leg.length() - cut, speeds);
        if let Some(corner) = corner {
            let start = leg.point_at(leg.length() - cut);
            trajectory.turn(Pose2::new(start.x, start.y, heading(*leg)), corner, speeds);
        }
        driven_of_leg = cut;
    }
    trajectory
}

impl Trajectory {
    /// Where the base is `time_s` seconds after the start; it stays at the end once there.
    #[must_use]
    pub fn at(&self, time_s: f64) -> Pose2 {
        let time_s = time_s.clamp(0.0, self.duration_s);
        let after = self.pieces.partition_point(|piece| piece.start_s <= time_s);
        self.pieces[after.max(1) - 1].at(time_s)
    }

    /// How long the drive takes, s.
    #[must_use]
    pub const fn duration_s(&self) -> f64 {
        self.duration_s
    }

    /// How far the robot drives, m.
    #[must_use]
    pub const fn length_m(&self) -> f64 {
        self.length_m
    }

    fn standing(world_from_base: Pose2) -> Self {
        let piece = Piece { start_s: 0.0, world_from_base, speed: 0.0, turn_rate: 0.0 };
        Self { pieces: vec![piece], duration_s: 0.0, length_m: 0.0 }
    }

    fn straight(&mut self, leg: Segment, from: f64, to: f64, speeds: &Speeds) {
        if to - from < 1e-9 {
            return;
        }
        let start = leg.point_at(from);
        let world_from_base = Pose2::new(start.x, start.y, heading(leg));
        self.push(world_from_base, [speeds.forward, 0.0], (to - from) / speeds.forward);
    }

    fn turn(&mut self, start: Pose2, corner: Corner, speeds: &Speeds) {
        if corner.angle.abs() < 1e-9 {
            return;
        }
        let speed = speeds.forward.min(speeds.turn * corner.radius);
        let rate = if corner.radius > 0.0 { speed / corner.radius } else { speeds.turn };
        let turn_rate = rate.copysign(corner.angle);
        self.push(start, [speed, turn_rate], corner.angle / turn_rate);
    }

    fn push(&mut self, world_from_base: Pose2, [speed, turn_rate]: [f64; 2], seconds: f64) {
        self.pieces.push(Piece { start_s: self.duration_s, world_from_base, speed, turn_rate });
        self.duration_s += seconds;
        self.length_m += speed * seconds;
    }
}

/// How a corner between two legs is driven: an arc, or a turn on the spot when the radius is 0.
#[derive(Debug, Clone, Copy)]
struct Corner {
    /// Change of heading, rad.
    angle: f64,
    radius: f64,
    /// How much of either leg the arc replaces, m.
    cut: f64,
}

impl Corner {
    fn new(leg: Segment, next: Segment, speeds: &Speeds) -> Self {
        let angle = wrap_angle(heading(next) - heading(leg));
        if angle.abs() > PIVOT_ANGLE {
            return Self { angle, radius: 0.0, cut: 0.0 };
        }
        let tangent = libm::tan(0.5 * angle.abs());
        let cut = (speeds.corner_radius * tangent).min(0.5 * leg.length().min(next.length()));
        let radius = if tangent > 0.0 { cut / tangent } else { 0.0 };
        Self { angle, radius, cut }
    }
}

fn heading(leg: Segment) -> f64 {
    let along = minus(leg.b, leg.a);
    libm::atan2(along.y, along.x)
}

/// The same line moved `offset` metres to its left.
pub(super) fn shifted(leg: Segment, offset: f64) -> Segment {
    let (sin, cos) = libm::sincos(heading(leg) + 0.5 * PI);
    let left = Point2::new(cos, sin);
    Segment::new(plus(leg.a, offset, left), plus(leg.b, offset, left))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn square() -> Vec<Point2> {
        [(0.0, 0.0), (8.0, 0.0), (8.0, 6.0), (0.0, 6.0)].map(|(x, y)| Point2::new(x, y)).to_vec()
    }

    #[test]
    fn a_lap_ends_where_it_began_and_the_overlap_goes_on() {
        let lap = Route::around(&square(), 1, 0.0);
        assert_eq!(lap.waypoints().len(), 5);
        let more = Route::around(&square(), 2, 10.0);
        assert_eq!(more.legs().map(Segment::length).sum::<f64>(), 66.0);
        assert_eq!(more.waypoints().last(), Some(&Point2::new(8.0, 2.0)));
    }

    #[test]
    fn the_drive_keeps_its_limits_and_never_jumps() {
        let speeds = Speeds { forward: 0.7, turn: 0.9, corner_radius: 0.4 };
        let mut points = square();
        points.extend([Point2::new(3.0, 6.0), Point2::new(3.1, 6.05), Point2::new(2.0, 2.0)]);
        let trajectory = drive(&Route::new(points), &speeds);
        let step = 0.01;
        for k in 0..(trajectory.duration_s() / step) as usize {
            let motion =
                trajectory.at(k as f64 * step).between(trajectory.at((k + 1) as f64 * step));
            assert!(motion.position().norm() <= speeds.forward * step + 1e-9, "{k}: {motion:?}");
            assert!(motion.theta.abs() <= speeds.turn * step + 1e-9, "{k}: {motion:?}");
            assert!(motion.y.abs() < 1e-4, "sideways at {k}: {motion:?}");
        }
        assert!(trajectory.at(1e9).between(Pose2::new(2.0, 2.0, 0.0)).position().norm() < 1e-9);
    }

    #[test]
    fn arcs_stay_close_to_the_corner() {
        let route = Route::new(square());
        let trajectory = drive(&route, &Speeds::default());
        let worst = (0..4000).map(|k| {
            let point = trajectory.at(f64::from(k) * 0.01).position();
            route.legs().map(|leg| leg.distance_to(point)).fold(f64::INFINITY, f64::min)
        });
        let worst = worst.fold(0.0, f64::max);
        assert!((0.1..0.4 * (2.0_f64.sqrt() - 1.0) + 1e-6).contains(&worst), "{worst}");
    }
}
