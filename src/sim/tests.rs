use super::*;
use crate::sim::shape::Segment;

const PLACES: [Place; 3] = [Place::Building, Place::Ring, Place::Corridor];

fn simulation(scenario: &Scenario) -> Simulation {
    Simulation::new(scenario).unwrap()
}

/// FNV-1a over everything a run records.
fn fingerprint(readings: impl Iterator<Item = Reading>) -> u64 {
    let mut hash = 0xcbf2_9ce4_8422_2325;
    let mut add = |bits: u64| hash = (hash ^ bits).wrapping_mul(0x0000_0100_0000_01b3);
    for reading in readings {
        for pose in [reading.world_from_base, reading.odom_from_base] {
            [pose.x, pose.y, pose.theta].iter().for_each(|v| add(v.to_bits()));
        }
        reading.scan.ranges.iter().for_each(|r| add(u64::from(r.to_bits())));
        add(reading.stamp.0 as u64);
    }
    hash
}

#[test]
fn the_same_seed_gives_the_same_bytes_and_another_seed_others() {
    for place in PLACES {
        let scenario = Scenario { people: 3, beams: 60, ..Scenario::new(place, 4) };
        let run = |scenario| fingerprint(simulation(&scenario).readings().take(300));
        assert_eq!(run(scenario), run(scenario));
        assert_ne!(run(scenario), run(Scenario { seed: 5, ..scenario }));
    }
}

#[test]
fn routes_stay_clear_of_walls() {
    for seed in 0..20 {
        for place in PLACES {
            let run = simulation(&Scenario { beams: 2, ..Scenario::new(place, seed) });
            for k in 0..(run.trajectory.duration_s() / 0.25) as usize {
                let pose = run.trajectory.at(k as f64 * 0.25);
                let clearance = run.world.clearance(pose.position());
                assert!(clearance >= 0.2, "{place:?} {seed}: {clearance} m at {pose:?}");
            }
        }
    }
}

#[test]
fn routes_never_cross_a_wall() {
    for seed in 0..20 {
        for site in [building::building(seed, 40.0), corridor::ring_corridor(seed, 260.0)] {
            let route = site.route(1);
            let gap = |leg: Segment| {
                let walls = site.world.segments().iter();
                walls.map(|wall| wall.distance_between(leg)).fold(f64::INFINITY, f64::min)
            };
            let narrowest = route.legs().map(gap).fold(f64::INFINITY, f64::min);
            assert!(narrowest > 0.3, "seed {seed}: {narrowest} m");
        }
    }
}

#[test]
fn worlds_are_closed() {
    for seed in 0..5 {
        for place in PLACES {
            let run = simulation(&Scenario { beams: 2, ..Scenario::new(place, seed) });
            let origin = run.trajectory.at(0.5 * run.trajectory.duration_s()).position();
            for k in 0..3600 {
                let ray = world::Ray { origin, angle: f64::from(k) * 1e-3 + 0.3, limit: 1e4 };
                assert!(run.world.cast(ray, 0.0).is_some(), "{place:?} {seed}: {ray:?}");
            }
        }
    }
}

#[test]
fn laps_have_their_documented_length() {
    let length = |place, laps| {
        simulation(&Scenario { laps, beams: 2, ..Scenario::new(place, 1) }).trajectory.length_m()
    };
    assert!((370.0..450.0).contains(&length(Place::Building, 1)), "{}", length(Place::Building, 1));
    assert!((length(Place::Ring, 1) - 271.3).abs() < 0.5, "{}", length(Place::Ring, 1));
    assert!((length(Place::Ring, 10) - length(Place::Ring, 1) - 9.0 * 259.31).abs() < 0.1);
    assert!((length(Place::Corridor, 2) - 224.0).abs() < 1e-6);
}

#[test]
fn perfect_odometry_is_the_truth() {
    let mut run = simulation(&Scenario { beams: 2, ..Scenario::new(Place::Building, 3) });
    run.odometry.factor = 0.0;
    run.odometry_per_scan = 3;
    for reading in run.readings() {
        let error = reading.world_from_base.between(reading.odom_from_base);
        assert!(error.position().norm() < 1e-6 && error.theta.abs() < 1e-9, "{error:?}");
    }
}

#[test]
fn odometry_between_scans_is_evenly_spaced() {
    let mut run = simulation(&Scenario { beams: 2, ..Scenario::new(Place::Corridor, 3) });
    run.odometry_per_scan = 4;
    let readings: Vec<Reading> = run.readings().take(3).collect();
    assert!(readings[0].odometry_between.is_empty());
    let stamps =
        readings[1].odometry_between.iter().map(|(stamp, _)| stamp.0 - readings[0].stamp.0);
    assert_eq!(stamps.collect::<Vec<_>>(), [25_000_000, 50_000_000, 75_000_000]);
    assert_eq!(readings[2].stamp.0 - readings[0].stamp.0, 200_000_000);
}

#[test]
fn any_scan_can_be_had_by_itself() {
    let run = simulation(&Scenario { people: 4, ..Scenario::new(Place::Ring, 2) });
    let fifth = run.readings().nth(5).unwrap();
    assert_eq!(fifth.scan, run.scan(5));
}
