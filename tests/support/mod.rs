//! What the tests of the mapping core share: a small world, and drives through it.

use gmapd::sim::lidar::Lidar;
use gmapd::sim::shape::{Circle, Segment};
use gmapd::sim::world::World;
use gmapd::slam::gmapping::{GMapping, Parameters, ScanReading, ScanUpdate};
use gmapd::slam::motion_gate::MotionGate;
use gmapd::slam::pose::{Point2, Pose2, Stamp};
use gmapd::slam::scan::Scan;
use rand::SeedableRng as _;
use rand_chacha::ChaCha8Rng;

/// Nanoseconds between two scans of a drive.
pub(crate) const SCAN_PERIOD_NS: i64 = 500_000_000;

/// A scan with the odometry it was taken at.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Shot {
    pub(crate) scan: Scan,
    pub(crate) odom_from_base: Pose2,
}

/// A room of 9 m by 7 m with a niche, two boxes and a pillar; its lower-left corner is `corner`.
pub(crate) fn room(corner: Point2) -> World {
    let outline = [
        (0.0, 0.0),
        (9.03, 0.0),
        (9.03, 4.01),
        (10.52, 4.01),
        (10.52, 5.53),
        (9.03, 5.53),
        (9.03, 7.02),
        (0.0, 7.02),
    ];
    let boxes = [[(3.11, 0.62), (4.03, 1.34)], [(6.22, 5.41), (7.53, 6.13)]]
        .map(|[(x0, y0), (x1, y1)]| [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]);
    let point = |(x, y): (f64, f64)| Point2::new(corner.x + x, corner.y + y);
    let closed = |corners: &[(f64, f64)]| -> Vec<Segment> {
        let next = corners.iter().cycle().skip(1);
        corners.iter().zip(next).map(|(a, b)| Segment::new(point(*a), point(*b))).collect()
    };
    let mut segments = closed(&outline);
    boxes.iter().for_each(|corners| segments.extend(closed(corners)));
    let pillar = Circle { center: point((1.52, 5.23)), radius: 0.2 };
    World::new(segments, vec![pillar])
}

/// Where a robot is that drives an S through the room with this lower-left corner.
pub(crate) fn route(corner: Point2) -> Vec<Pose2> {
    (0..24)
        .map(|i| {
            let along = f64::from(i) * 0.25;
            let (sin, cos) = libm::sincos(along * 0.9);
            Pose2::new(corner.x + 1.5 + along, corner.y + 3.2 + 0.9 * sin, libm::atan(0.81 * cos))
        })
        .collect()
}

/// A laser without errors that sees all around.
pub(crate) fn full_circle(beams: usize) -> Lidar {
    let lidar = Lidar::full_circle(beams).expect("two beams or more");
    Lidar { range_noise_std: 0.0, outlier_rate: 0.0, ..lidar }
}

/// What `lidar` sees from each pose; odometry is the truth.
pub(crate) fn shots(world: &World, lidar: &Lidar, poses: &[Pose2]) -> Vec<Shot> {
    let shot = |(index, pose): (usize, &Pose2)| {
        let mut rng = ChaCha8Rng::seed_from_u64(index as u64);
        let stamp = Stamp(1_000_000_000 + index as i64 * SCAN_PERIOD_NS);
        let ranges = lidar.sweep(world, |_| *pose, 0.0, &mut rng);
        let scan = Scan { stamp, geometry: lidar.geometry, ranges };
        Shot { scan, odom_from_base: *pose }
    };
    poses.iter().enumerate().map(shot).collect()
}

/// Few particles, and every scan of a drive through the room processed.
pub(crate) fn parameters() -> Parameters {
    let gate = MotionGate { linear_update: 0.1, ..MotionGate::default() };
    Parameters { particles: 8, gate, ..Parameters::default() }
}

/// A filter on the caller's thread.
pub(crate) fn filter(parameters: &Parameters) -> GMapping {
    GMapping::new(parameters.clone(), 1, 1).expect("it needs no thread")
}

/// Gives a filter a scan.
pub(crate) fn add(filter: &mut GMapping, lidar: &Lidar, shot: &Shot) -> ScanUpdate {
    let reading =
        ScanReading { scan: &shot.scan, mount: &lidar.mount, odom_from_base: shot.odom_from_base };
    filter.add_scan(&reading, &mut |_| ())
}
