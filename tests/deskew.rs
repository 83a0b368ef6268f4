//! Motion during a sweep: the beams of a turning robot end where they truly did.

use gmapd::sim::{Place, Reading, Scenario, Simulation};
use gmapd::slam::deskew::Velocity;
use gmapd::slam::pose::{Pose2, Stamp};
use gmapd::slam::scan::{LaserMount, MountOrientation, Scan};

const SWEEP_S: f64 = 0.1;

/// A laser that sits ahead of the axle and takes a tenth of a second for a turn.
fn simulation() -> Simulation {
    let scenario = Scenario::new(Place::Building, 3);
    let mut simulation = Simulation::new(&scenario).expect("it is valid");
    simulation.lidar.sweep_duration_s = SWEEP_S;
    simulation.lidar.range_noise_std = 0.0;
    simulation.lidar.outlier_rate = 0.0;
    simulation.lidar.mount = LaserMount {
        base_from_laser: Pose2::new(0.2, 0.0, 0.1),
        orientation: MountOrientation::Upright,
    };
    simulation
}

/// Root mean square distance of the beams' ends from where they truly were, m; `deskew` gets each
/// scan and the velocity by odometry.
fn error(
    simulation: &Simulation,
    readings: &[Reading],
    deskew: impl Fn(&mut Scan, Velocity),
) -> f64 {
    let (mut sum, mut count) = (0.0, 0_u32);
    let began = readings[0].stamp;
    for pair in readings.windows(2) {
        let [reading, next] = pair else { continue };
        let seconds = next.stamp.seconds_since(reading.stamp);
        let motion = reading.odom_from_base.between(next.odom_from_base);
        let mut scan: Scan = reading.scan.clone();
        deskew(&mut scan, Velocity::of_motion(motion, seconds));
        let between_beams = SWEEP_S / (scan.ranges.len() - 1) as f64;
        let start_s = reading.stamp.seconds_since(began);
        for (index, range) in scan.ranges.iter().enumerate().filter(|(_, r)| r.is_finite()) {
            let range = f64::from(*range);
            let truly_there = simulation.trajectory.at(start_s + index as f64 * between_beams);
            let angle = scan.geometry.angle(index);
            let truth = truly_there * simulation.lidar.mount.point_in_base(angle, range);
            let mount = &simulation.lidar.mount;
            let found = reading.world_from_base * scan.point_in_base(mount, index, range);
            sum += (found.x - truth.x).powi(2) + (found.y - truth.y).powi(2);
            count += 1;
        }
    }
    (sum / f64::from(count)).sqrt()
}

/// The root mean square errors without and with deskewing, m; odometry has `factor` times its
/// usual errors.
fn errors(factor: f64) -> [f64; 2] {
    let mut simulation = simulation();
    simulation.odometry.factor = factor;
    let readings: Vec<Reading> = simulation.readings().take(1000).collect();
    let deskew = |scan: &mut Scan, velocity| {
        scan.geometry = scan.geometry.with_velocity(velocity);
    };
    [error(&simulation, &readings, |_, _| ()), error(&simulation, &readings, deskew)]
}

#[test]
fn deskewing_takes_the_motion_out_of_a_sweep() {
    let [raw, exact] = errors(0.0);
    let [_, noisy] = errors(1.0);
    eprintln!("{raw:.4} m as taken, {exact:.4} m deskewed, {noisy:.4} m by noisy odometry");
    assert!(raw > 0.1, "{raw}");
    assert!(exact < 0.2 * raw, "{raw} {exact}");
    assert!(noisy < 0.5 * raw, "{raw} {noisy}");
}

#[test]
fn without_beam_times_or_without_motion_nothing_changes_by_a_bit() {
    let simulation = simulation();
    let scan = simulation.scan(40);
    let mount = &simulation.lidar.mount;
    let velocity = Velocity { x: 0.7, y: 0.1, turn: 1.0 };
    let at_once = Scan {
        geometry: scan.geometry.with_time_increment(0.0).with_velocity(velocity),
        stamp: Stamp(0),
        ranges: scan.ranges.clone(),
    };
    for index in 0..scan.ranges.len() {
        let plain = mount.point_in_base(scan.geometry.angle(index), 3.0);
        assert_eq!(scan.point_in_base(mount, index, 3.0), plain);
        assert_eq!(at_once.point_in_base(mount, index, 3.0), plain);
    }
}
