//! Engines that go on from their state: the same bytes, whatever engine, at any scan.

use gmapd::sim::lidar::Lidar;
use gmapd::slam::engine::{Engine, EngineParameters, Sweep};
use gmapd::slam::gmapping::{MatcherKind, MatcherParameters, Parameters};
use gmapd::slam::hector;
use gmapd::slam::known_map::Mode;
use gmapd::slam::known_poses::{self, MapExtent};
use gmapd::slam::outline::{BeamLimits, FURTHEST_CELL};
use gmapd::slam::pose::{Point2, Pose2, Stamp};
use gmapd::slam::state::{EngineState, StateError};
use proptest::prelude::{ProptestConfig, any, prop_assert_eq, proptest};

#[expect(dead_code, reason = "other tests use the rest")]
mod support;

use support::{SCAN_PERIOD_NS, Shot, full_circle, parameters, room, route, shots};

const CORNER: Point2 = Point2::new(0.0, 0.0);

/// Every engine, and its name.
fn engines() -> [(&'static str, EngineParameters); 6] {
    let gmapping = parameters();
    let matcher = MatcherParameters { kind: MatcherKind::Compat, ..gmapping.matcher };
    let compat = Parameters { matcher, particles: 3, ..parameters() };
    let alone = Parameters { particles: 1, ..parameters() };
    let hector = hector::Parameters { resolution: 0.05, ..hector::Parameters::default() };
    let known = |extent| {
        EngineParameters::KnownPoses(known_poses::Parameters {
            resolution: gmapping.resolution,
            limits: BeamLimits {
                max_range: None,
                max_usable_range: None,
                free_on_no_return: false,
                furthest: FURTHEST_CELL * gmapping.resolution,
            },
            extent,
            occupied_threshold: gmapping.map.occupied_threshold,
        })
    };
    [
        ("gmapping", EngineParameters::GMapping(parameters(), 1)),
        ("compat", EngineParameters::GMapping(compat, 1)),
        ("one particle", EngineParameters::GMapping(alone, 1)),
        ("hector", EngineParameters::Hector(hector)),
        ("all scans", known(MapExtent::AllScans)),
        ("newest scan", known(MapExtent::NewestScan)),
    ]
}

fn engine(parameters: &EngineParameters, threads: usize) -> Engine {
    Engine::new(parameters.clone(), threads).expect("threads can be started")
}

/// Through the room and back, twice, with odometry that drifts.
fn drive(lidar: &Lidar) -> Vec<Shot> {
    let there = route(CORNER);
    let back = there.iter().rev().copied();
    let poses: Vec<Pose2> = there.iter().copied().chain(back).cycle().take(96).collect();
    let mut shots = shots(&room(CORNER), lidar, &poses);
    for (index, shot) in shots.iter_mut().enumerate() {
        let step = index as f64;
        let drift = Pose2::new(0.002 * step, 0.03 * (1.7 * step).sin(), 0.01 * (2.3 * step).sin());
        shot.odom_from_base = shot.odom_from_base * drift;
        shot.scan.stamp = Stamp(1_000_000_000 + index as i64 * SCAN_PERIOD_NS);
    }
    shots
}

fn feed(engine: &mut Engine, lidar: &Lidar, shots: &[Shot]) {
    for Shot { scan, odom_from_base } in shots {
        engine.add_odometry(*odom_from_base);
        let sweep = Sweep { scan, mount: &lidar.mount, odom_from_base: Some(*odom_from_base) };
        engine.add_scan(&sweep, &mut |_| ());
    }
}

fn bytes(engine: &Engine) -> Vec<u8> {
    postcard::to_stdvec(&engine.state()).expect("memory takes it")
}

fn decoded(bytes: &[u8]) -> EngineState {
    postcard::from_bytes(bytes).expect("it was encoded")
}

#[test]
fn going_on_from_a_state_is_as_if_nothing_had_happened() {
    let lidar = full_circle(90);
    let shots = drive(&lidar);
    for (name, parameters) in engines() {
        let mut whole = engine(&parameters, 1);
        let mut resumed: Vec<Engine> = Vec::new();
        for (index, shot) in shots.iter().enumerate() {
            if [0, 1, 2, 9, 40, 41, 60, 95].contains(&index) {
                let mut other = engine(&parameters, 1 + index % 2);
                let state = bytes(&whole);
                other.resume(decoded(&state)).expect("it is a state of such an engine");
                assert_eq!(bytes(&other), state, "{name} at {index}");
                resumed.push(other);
            }
            // For a while the map is frozen.
            let mode = if (50..70).contains(&index) { Mode::Localization } else { Mode::Mapping };
            std::iter::once(&mut whole).chain(&mut resumed).for_each(|e| e.set_mode(mode));
            let shot = std::slice::from_ref(shot);
            feed(&mut whole, &lidar, shot);
            resumed.iter_mut().for_each(|engine| feed(engine, &lidar, shot));
        }
        for mut engine in resumed {
            assert!(bytes(&engine) == bytes(&whole), "{name}");
            assert_eq!(engine.path(), whole.path(), "{name}");
            assert_eq!(engine.occupancy_grid(), whole.occupancy_grid(), "{name}");
            assert_eq!(engine.map_from_odom(), whole.map_from_odom(), "{name}");
            assert_eq!(engine.hypotheses(), whole.hypotheses(), "{name}");
            assert_eq!(engine.tiles(), whole.tiles(), "{name}");
        }
    }
}

#[test]
fn a_pose_that_was_set_and_a_reset_are_in_the_state() {
    let lidar = full_circle(90);
    let shots = drive(&lidar);
    for (name, parameters) in engines() {
        let mut whole = engine(&parameters, 1);
        feed(&mut whole, &lidar, &shots[..20]);
        whole.reset(Some(Pose2::new(3.0, -2.0, 1.0)));
        let mut other = engine(&parameters, 1);
        other.resume(whole.state()).expect("it is a state of such an engine");
        assert!(!other.has_begun() && other.path().is_empty(), "{name}");
        for engine in [&mut whole, &mut other] {
            feed(engine, &lidar, &shots[20..30]);
            engine.set_pose(Pose2::new(1.0, 1.0, 0.5));
            feed(engine, &lidar, &shots[30..35]);
        }
        assert_eq!(whole.path(), other.path(), "{name}");
        assert!((1..=15).contains(&whole.path().len()), "{name}: only scans after the reset");
        assert_eq!(whole.occupancy_grid(), other.occupancy_grid(), "{name}");
    }
}

#[test]
fn a_state_of_another_engine_or_another_number_of_particles_is_refused() {
    let lidar = full_circle(90);
    let [(_, gmapping), _, (_, alone), (_, hector), ..] = engines();
    let mut first = engine(&gmapping, 1);
    feed(&mut first, &lidar, &drive(&lidar)[..5]);
    let refused = engine(&hector, 1).resume(first.state());
    assert_eq!(refused, Err(StateError::OtherEngine));
    let refused = engine(&alone, 1).resume(first.state()).unwrap_err().to_string();
    assert_eq!(refused, "it has 8 particles, and 1 are configured");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(300))]

    /// Whatever is wrong with its bytes, an engine takes none or works with it.
    #[test]
    fn damaged_states_do_no_harm(
        at in any::<proptest::sample::Index>(),
        bit in 0..8_u8,
        cut in any::<proptest::sample::Index>(),
    ) {
        let lidar = full_circle(30);
        let shots = drive(&lidar);
        for (_, parameters) in [0, 3, 4].map(|index| engines()[index].clone()) {
            let mut whole = engine(&parameters, 1);
            feed(&mut whole, &lidar, &shots[..6]);
            let state = bytes(&whole);
            prop_assert_eq!(&decoded(&state), &whole.state());
            let cut = cut.index(state.len());
            assert!(postcard::from_bytes::<EngineState>(&state[..cut]).is_err());
            let mut flipped = state.clone();
            flipped[at.index(state.len())] ^= 1 << bit;
            let mut other = engine(&parameters, 1);
            if let Ok(state) = postcard::from_bytes(&flipped)
                && other.resume(state).is_ok()
            {
                feed(&mut other, &lidar, &shots[6..9]);
            }
        }
    }
}
