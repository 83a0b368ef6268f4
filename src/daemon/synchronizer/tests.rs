use nalgebra::Isometry3;
use proptest::collection::vec;
use proptest::prelude::{any, prop_assert, prop_assert_eq, proptest};

use super::super::frames::FrameNames;
use super::*;
use crate::clock;
use crate::tf::{Kind, Transform};

const TIMEOUT: Duration = Duration::from_millis(500);

fn settings() -> Settings {
    Settings {
        odometry_timeout: TIMEOUT,
        most_waiting: 4,
        sweep_time_s: None,
        source: OdometrySource::Auto,
        sought: Sought::Odometry,
        need: Need::Required,
        odom_key: "robot01/odom".to_owned(),
        tf_path: "robot01/tf (from `odom` to `base_link`)".to_owned(),
    }
}

fn frames() -> Frames {
    let names = FrameNames { base: "base_link".to_owned(), odom: "odom".to_owned() };
    Frames::new(names, None, "robot01/tf_static".to_owned())
}

/// Milliseconds after some moment.
fn stamp(milliseconds: i64) -> Stamp {
    Stamp(1_700_000_000_000_000_000 + milliseconds * 1_000_000)
}

/// A synchronizer with its surroundings, and the times of scans.
struct Rig {
    synchronizer: Synchronizer,
    frames: Frames,
    start: Instant,
}

impl Rig {
    fn new(settings: Settings) -> Self {
        let synchronizer = Synchronizer::new(settings);
        Self { synchronizer, frames: frames(), start: clock::now() }
    }

    fn odometry(&mut self, milliseconds: i64) {
        self.odometry_on(Channel::Messages, milliseconds);
    }

    /// The pose's x is its stamp in milliseconds.
    fn odometry_on(&mut self, channel: Channel, milliseconds: i64) -> bool {
        let pose = Pose2::new(milliseconds as f64, 0.0, 0.0);
        self.synchronizer.odometry(channel, (stamp(milliseconds), pose), &self.frames)
    }

    fn scan(&mut self, milliseconds: i64) {
        self.scan_from("base_link", milliseconds, Duration::ZERO);
    }

    fn scan_from(&mut self, frame: &str, milliseconds: i64, after: Duration) {
        let geometry = ScanGeometry::new([0.0, 1.0], 0.5, [0.1, 9.0]).unwrap();
        let scan = Scan { stamp: stamp(milliseconds), geometry, ranges: vec![1.0; 3] };
        let framed = FramedScan { scan, frame: frame.to_owned() };
        self.synchronizer.scan(framed, self.start + after, &self.frames);
    }

    fn expire(&mut self, after: Duration) {
        self.synchronizer.expire(self.start + after, &self.frames);
    }

    fn calls(&mut self) -> Vec<Call> {
        std::iter::from_fn(|| self.synchronizer.next_call()).collect()
    }

    /// `o` and `s` with the pose that the filter gets, or the verdict with the scan's stamp.
    fn told(&mut self) -> Vec<String> {
        let told = |call| match call {
            Call::Odometry(_, pose) => format!("o{}", pose.x),
            Call::Scan(ReadyScan { odom_from_base: Some(pose), .. }) => format!("s{}", pose.x),
            Call::Scan(_) => "s-".to_owned(),
            Call::Refuse(refusal) => {
                let after = refusal.stamp.unwrap().seconds_since(stamp(0)) * 1e3;
                format!("{:?}{after:.0}", refusal.verdict)
            }
            Call::BeginOdometry(pose) => format!("begin{}", pose.x),
        };
        self.calls().into_iter().map(told).collect()
    }

    fn details(&mut self) -> Vec<String> {
        let detail = |call| match call {
            Call::Refuse(refusal) => Some(refusal.detail),
            Call::Odometry(..) | Call::Scan(_) | Call::BeginOdometry(_) => None,
        };
        self.calls().into_iter().filter_map(detail).collect()
    }
}

fn rig() -> Rig {
    Rig::new(settings())
}

#[test]
fn a_scan_waits_for_odometry_at_or_after_it_and_gets_the_pose_between() {
    let mut rig = rig();
    rig.odometry(0);
    rig.scan(30);
    assert_eq!((rig.told().len(), rig.synchronizer.waiting()), (0, 1));
    rig.odometry(40);
    assert_eq!(rig.told(), ["o0", "s30"]);
    rig.scan(40);
    assert_eq!(rig.told(), ["o40", "s40"]);
    assert_eq!(rig.synchronizer.deadline(), None);
}

#[test]
fn odometry_after_a_scan_is_not_told_before_it() {
    let mut rig = rig();
    (0..=10).for_each(|step| rig.odometry(step * 10));
    rig.scan(35);
    rig.scan(60);
    assert_eq!(rig.told(), ["o0", "o10", "o20", "o30", "s35", "o40", "o50", "o60", "s60"]);
    assert_eq!(rig.synchronizer.newest_odometry().unwrap().1.x, 100.0);
}

#[test]
fn a_scan_before_all_odometry_ends_its_waiting_when_none_can_come_any_more() {
    let mut rig = rig();
    rig.scan(0);
    rig.odometry(20);
    rig.odometry(500);
    assert!(rig.told().is_empty());
    rig.odometry(540);
    assert_eq!(
        rig.details(),
        ["odometry is missing by 20.0 ms: the oldest is newer than the scan by that, of those on \
          robot01/odom; if odometry only comes late or seldom, raise odometry_timeout_s"]
    );
}

#[test]
fn a_gap_in_odometry_is_not_bridged() {
    let mut rig = rig();
    rig.odometry(0);
    rig.scan(10);
    rig.scan(750);
    rig.odometry(1000);
    assert_eq!(rig.told(), ["NoOdometry10", "o0", "s750"]);
}

#[test]
fn a_scan_that_waited_long_enough_is_told_by_how_much_odometry_is_missing() {
    let mut rig = rig();
    rig.scan_from("base_link", 7, Duration::ZERO);
    rig.scan_from("base_link", 107, Duration::from_millis(100));
    assert_eq!(rig.synchronizer.deadline(), Some(rig.start + TIMEOUT));
    rig.expire(TIMEOUT - Duration::from_millis(1));
    assert!(rig.told().is_empty());
    rig.expire(TIMEOUT);
    assert_eq!(
        rig.details(),
        ["no odometry has come on robot01/odom or in robot01/tf (from `odom` to `base_link`)"]
    );
    rig.odometry(0);
    rig.expire(TIMEOUT + Duration::from_millis(100));
    assert!(
        rig.details()[0].starts_with(
            "odometry is missing by 107.0 ms: the newest is older than the scan by that"
        )
    );
    assert_eq!(rig.synchronizer.waiting(), 0);
}

#[test]
fn clocks_that_differ_are_suspected_when_much_is_missing() {
    let mut rig = rig();
    rig.odometry(0);
    rig.scan(60_000);
    rig.expire(TIMEOUT);
    assert!(rig.details()[0].contains("missing by 60000.0 ms"));
    rig.scan(60_000);
    rig.expire(TIMEOUT);
    assert!(
        rig.details()[0]
            .ends_with("do the clocks that stamp them agree, and does odometry still come?")
    );
}

#[test]
fn scans_are_taken_in_the_order_of_their_stamps_or_not_at_all() {
    let mut rig = rig();
    rig.odometry(0);
    rig.scan(50);
    rig.scan(30);
    rig.scan(30);
    rig.odometry(100);
    rig.scan(40);
    rig.scan(50);
    rig.scan(60);
    let expected = ["Duplicate30", "o0", "s30", "s50", "Late40", "Duplicate50", "s60"];
    assert_eq!(rig.told(), expected);
    let counts = ScanCounts { duplicates: 2, reordered: 2, ..ScanCounts::default() };
    assert_eq!(rig.synchronizer.scan_counts(), counts);
}

#[test]
fn a_scan_from_long_ago_is_late_and_two_are_a_clock_that_was_set_back() {
    let mut rig = rig();
    rig.odometry(60_000);
    rig.scan(60_000);
    assert_eq!(rig.told(), ["o60000", "s60000"]);
    for milliseconds in [0, 100, 200] {
        rig.odometry(milliseconds);
        rig.scan(milliseconds);
    }
    assert_eq!(rig.told(), ["Late0", "o0", "o100", "s100", "o200", "s200"]);
    assert_eq!(rig.synchronizer.scan_counts().clock_restarts, 1);
    assert_eq!(rig.synchronizer.odometry_counts().restarts, 1);
}

#[test]
fn late_scans_of_a_second_clock_restart_nothing() {
    let mut rig = rig();
    for step in 1..=5 {
        rig.odometry(step * 100);
        rig.scan(step * 100);
        rig.scan(step * 100 - 60_000);
    }
    let told = rig.told();
    assert_eq!(told.iter().filter(|call| call.starts_with('s')).count(), 5);
    assert_eq!(told.iter().filter(|call| call.starts_with("Late")).count(), 5);
    assert_eq!(rig.synchronizer.scan_counts().clock_restarts, 0);
}

#[test]
fn one_scan_of_the_far_future_does_not_stop_the_others() {
    let mut rig = rig();
    rig.odometry(0);
    rig.scan(1_000_000_000);
    rig.scan(10);
    rig.odometry(20);
    rig.scan(20);
    assert_eq!(rig.told(), ["o0", "s10", "o20", "s20"]);
    rig.expire(TIMEOUT);
    assert_eq!(rig.told(), ["NoOdometry1000000000"]);
}

#[test]
fn of_too_many_waiting_scans_the_oldest_is_dropped() {
    let mut rig = rig();
    (1..=6).for_each(|step| rig.scan(step * 10));
    assert_eq!(rig.told(), ["Overload10", "Overload20"]);
    assert_eq!(rig.synchronizer.waiting(), 4);
}

#[test]
fn odometry_without_scans_reaches_the_filter_when_it_is_old_and_never_twice() {
    let mut rig = rig();
    (0..=60).for_each(|step| rig.odometry(step * 100));
    let told = rig.told();
    assert_eq!((told.len(), told.last().unwrap().as_str()), (11, "o1000"));
    rig.scan(6_000);
    let told = rig.told();
    assert_eq!((told.len(), told[0].as_str()), (51, "o1100"));
    // A minute later, all that was not told yet comes first.
    rig.odometry(66_000);
    rig.odometry(66_100);
    rig.scan(66_100);
    assert_eq!(rig.told(), ["o66000", "o66100", "s66100"]);
}

#[test]
fn messages_take_the_place_of_transforms_until_the_filter_has_some() {
    let mut rig = rig();
    assert!(rig.odometry_on(Channel::Transforms, 0));
    assert!(rig.odometry_on(Channel::Messages, 10));
    assert!(!rig.odometry_on(Channel::Transforms, 20));
    rig.odometry(30);
    rig.scan(30);
    assert_eq!(rig.told(), ["o10", "o30", "s30"]);

    let mut rig = super::tests::rig();
    rig.odometry_on(Channel::Transforms, 0);
    rig.scan(0);
    assert!(!rig.odometry_on(Channel::Messages, 10));
    assert!(rig.odometry_on(Channel::Transforms, 10));
    rig.scan(10);
    assert_eq!(rig.told(), ["o0", "s0", "o10", "s10"]);

    let mut rig = Rig::new(Settings { source: OdometrySource::Tf, ..settings() });
    assert!(!rig.odometry_on(Channel::Messages, 0));
    assert!(rig.odometry_on(Channel::Transforms, 0));
}

fn mounted(x: f64, pitch: f64) -> Transform {
    let rotation = nalgebra::Vector3::new(0.0, pitch, 0.0);
    Transform {
        parent: "base_link".to_owned(),
        child: "laser".to_owned(),
        stamp: Stamp(0),
        parent_from_child: Isometry3::new(nalgebra::Vector3::new(x, 0.0, 0.0), rotation),
    }
}

#[test]
fn a_scan_waits_for_the_transform_of_its_laser() {
    let mut rig = rig();
    rig.odometry(0);
    rig.scan_from("laser", 0, Duration::ZERO);
    assert!(rig.told().is_empty());
    rig.frames.insert(&mounted(0.2, 0.0), Kind::Static).unwrap();
    rig.synchronizer.frames_changed(&rig.frames);
    let calls = rig.calls();
    let Some(Call::Scan(ready)) = calls.last() else { panic!("{calls:?}") };
    assert_eq!(ready.mount.base_from_laser, Pose2::new(0.2, 0.0, 0.0));

    rig.scan_from("camera", 0, Duration::ZERO);
    assert_eq!(rig.told(), ["Duplicate0"]);
    rig.odometry(10);
    rig.scan_from("camera", 10, Duration::ZERO);
    rig.expire(TIMEOUT);
    assert_eq!(rig.told(), ["NoMount10"]);
    rig.scan_from("", 10, Duration::ZERO);
    assert_eq!(rig.told(), ["NoMount10"]);
}

#[test]
fn a_tilted_laser_is_refused_at_once_with_its_tilt() {
    let mut rig = rig();
    rig.frames.insert(&mounted(0.2, 0.1), Kind::Static).unwrap();
    rig.scan_from("laser", 0, Duration::ZERO);
    let details = rig.details();
    assert!(details[0].contains("tilted by 5.73 degrees"), "{details:?}");
}

#[test]
fn in_the_end_what_waits_is_told_why() {
    let mut rig = rig();
    rig.odometry(0);
    rig.scan(10);
    rig.scan(20);
    rig.synchronizer.finish(&rig.frames);
    assert_eq!(rig.told(), ["NoOdometry10", "NoOdometry20"]);
}

/// Stamps in milliseconds, from steps between them.
fn stamps(steps: &[i64]) -> Vec<i64> {
    let sum = |now: &mut i64, step: &i64| {
        *now += step;
        Some(*now)
    };
    steps.iter().scan(0, sum).collect()
}

/// The calls if odometry and scans, each in order, arrive in turns that `first` says.
fn interleaved(odometry: &[i64], scans: &[i64], first: &[bool]) -> Vec<String> {
    let mut rig = Rig::new(Settings { most_waiting: 100, ..settings() });
    let (mut odometry, mut scans) = (odometry.iter().peekable(), scans.iter().peekable());
    let mut first = first.iter().cycle();
    while odometry.peek().is_some() || scans.peek().is_some() {
        if scans.peek().is_none() || odometry.peek().is_some() && *first.next().unwrap() {
            rig.odometry(*odometry.next().unwrap());
        } else {
            rig.scan(*scans.next().unwrap());
        }
    }
    rig.told()
}

proptest! {
    /// Whatever comes first, the filter gets the same, and each scan has one end.
    #[test]
    fn the_order_of_arrival_does_not_matter(
        odometry in vec(1..120_i64, 1..40),
        scans in vec(1..150_i64, 1..30),
        first in vec(any::<bool>(), 1..30),
        offset in -200..200_i64,
    ) {
        let (odometry, mut scans) = (stamps(&odometry), stamps(&scans));
        scans.iter_mut().for_each(|scan| *scan += offset);
        let expected = interleaved(&odometry, &scans, &[true]);
        prop_assert_eq!(&interleaved(&odometry, &scans, &[false]), &expected);
        prop_assert_eq!(&interleaved(&odometry, &scans, &first), &expected);
    }

    /// Any stamps at all: nothing is taken twice, order holds, and memory is bounded.
    #[test]
    fn any_stamps_are_accounted_for(arrivals in vec((any::<bool>(), any::<i64>(), 0..40_i64), 0..80)) {
        let mut rig = rig();
        let mut scans = 0;
        let mut ended = 0;
        for (is_scan, far, near) in arrivals {
            let at = if far % 5 == 0 { far / 1_000_000_000 } else { near * 100 };
            if is_scan {
                scans += 1;
                rig.scan(at);
            } else {
                rig.odometry(at);
            }
            ended += rig.told().iter().filter(|call| !call.starts_with('o')).count();
            prop_assert!(rig.synchronizer.waiting() <= 4);
        }
        rig.synchronizer.finish(&rig.frames);
        ended += rig.told().iter().filter(|call| !call.starts_with('o')).count();
        prop_assert_eq!(ended, scans);
    }
}

#[test]
fn where_odometry_is_optional_only_the_first_scan_waits_for_it() {
    let mut rig = Rig::new(Settings { need: Need::Optional, ..settings() });
    rig.scan(0);
    rig.scan_from("base_link", 100, Duration::from_millis(100));
    assert_eq!((rig.told().len(), rig.synchronizer.waiting()), (0, 2));
    rig.expire(TIMEOUT);
    assert_eq!(rig.told(), ["s-", "s-"]);
    rig.scan(200);
    assert_eq!((rig.told(), rig.synchronizer.waiting()), (vec!["s-".to_owned()], 0));
}

#[test]
fn where_odometry_is_optional_it_is_used_as_soon_as_it_comes_and_missed_when_it_ends() {
    let mut rig = Rig::new(Settings { need: Need::Optional, ..settings() });
    rig.scan(0);
    rig.expire(TIMEOUT);
    rig.odometry(90);
    rig.scan(100);
    rig.odometry(110);
    assert_eq!(rig.told(), ["s-", "o90", "s100"]);
    rig.scan_from("base_link", 300, Duration::from_secs(1));
    rig.expire(Duration::from_secs(1));
    assert_eq!(rig.synchronizer.waiting(), 1);
    rig.expire(Duration::from_secs(2));
    assert_eq!(rig.told(), ["o110", "s-"]);
}

#[test]
fn without_a_source_no_odometry_is_taken_and_no_scan_waits() {
    let source = OdometrySource::None;
    let mut rig = Rig::new(Settings { need: Need::Optional, source, ..settings() });
    assert!(!rig.odometry_on(Channel::Messages, 0));
    rig.scan(0);
    assert_eq!(rig.told(), ["s-"]);
}

/// The scan that is ready, taken at 30 ms by a laser that sweeps for 20 ms, if the robot moves by
/// `speed` m/s.
fn swept(rig: &mut Rig, speed: f64) -> ReadyScan {
    let odometry = |rig: &mut Rig, milliseconds: i64| {
        let pose = Pose2::new(speed * milliseconds as f64 * 1e-3, 0.0, 0.0);
        rig.synchronizer.odometry(Channel::Messages, (stamp(milliseconds), pose), &rig.frames);
    };
    odometry(rig, 0);
    odometry(rig, 40);
    rig.scan(30);
    assert_eq!((rig.told().len(), rig.synchronizer.waiting()), (0, 1));
    odometry(rig, 60);
    let mut calls = rig.calls();
    let Some(Call::Scan(ready)) = calls.pop() else { panic!("{calls:?}") };
    assert!((ready.odom_from_base.unwrap().x - 0.03 * speed).abs() < 1e-9);
    ready
}

#[test]
fn a_sweep_waits_for_the_odometry_of_its_end_and_has_the_speed_between() {
    let mut rig = Rig::new(Settings { sweep_time_s: Some(0.02), ..settings() });
    let last = swept(&mut rig, 5.0).scan.geometry.motion_until(2).expect("the base moves");
    assert!((last.x - 0.1).abs() < 1e-9 && last.y == 0.0 && last.theta == 0.0, "{last:?}");
    assert_eq!(rig.synchronizer.scan_counts().not_deskewed, 0);
}

/// Odometry was reset during the sweep, or another robot's came between.
#[test]
fn a_sweep_is_not_smeared_by_a_motion_that_no_robot_makes() {
    let mut rig = Rig::new(Settings { sweep_time_s: Some(0.02), ..settings() });
    assert_eq!(swept(&mut rig, 11.0).scan.geometry.motion_until(2), None);
    assert_eq!(rig.synchronizer.scan_counts().not_deskewed, 1);
}

#[test]
fn what_no_laser_takes_for_a_sweep_is_told() {
    let without = Settings { source: OdometrySource::None, need: Need::Optional, ..settings() };
    for mut rig in [rig(), Rig::new(without)] {
        rig.odometry(0);
        rig.odometry(40);
        let geometry = ScanGeometry::new([0.0, 1.0], 0.5, [0.1, 9.0]).unwrap();
        for (number, seconds) in (1..).zip([f64::NAN, 20.0, -1e30]) {
            let geometry = geometry.with_time_increment(seconds);
            let scan = Scan { stamp: stamp(number), geometry, ranges: vec![1.0; 3] };
            let framed = FramedScan { scan, frame: "base_link".to_owned() };
            rig.synchronizer.scan(framed, rig.start, &rig.frames);
        }
        let details = rig.details();
        assert_eq!(details.len(), 3);
        assert!(
            details[1].contains("takes 40 s") && details[1].contains("sweep_time_s"),
            "{details:?}"
        );
    }
}

/// Another synchronizer that goes on from what this one leaves, as after a restart.
fn restarted(rig: &Rig) -> Rig {
    let bytes = postcard::to_stdvec(&rig.synchronizer.state()).unwrap();
    let state: state::SynchronizerState = postcard::from_bytes(&bytes).unwrap();
    assert_eq!(state, rig.synchronizer.state());
    state.check().unwrap();
    let mut next = Rig::new(settings());
    next.synchronizer.resume(state, next.start);
    next
}

/// A message of odometry, or a scan, and its stamp in milliseconds.
fn message(index: i64) -> (bool, i64) {
    (index % 4 == 3, index * 40)
}

fn give(rig: &mut Rig, (is_scan, milliseconds): (bool, i64)) {
    if is_scan {
        rig.scan(milliseconds - 10);
    } else {
        rig.odometry(milliseconds);
    }
}

proptest! {
    /// Wherever it was killed, and from wherever on it is fed again.
    #[test]
    fn what_is_fed_again_after_a_restart_changes_nothing(killed in 1..700_i64, again in 0.0..1.0) {
        let mut whole = Rig::new(settings());
        let mut rig = Rig::new(settings());
        let mut told = Vec::new();
        for index in 0..killed {
            give(&mut whole, message(index));
            give(&mut rig, message(index));
            // What was ready and not called yet is in the state.
            if index % 7 == 0 {
                told.extend(rig.told());
            }
        }
        let mut rig = restarted(&rig);
        for index in (killed as f64 * again) as i64..killed {
            give(&mut rig, message(index));
        }
        for index in killed..killed + 40 {
            give(&mut whole, message(index));
            give(&mut rig, message(index));
        }
        told.extend(rig.told().into_iter().filter(|told| !told.starts_with("Duplicate")));
        prop_assert_eq!(told, whole.told());
        prop_assert_eq!(rig.synchronizer.scan_counts().clock_restarts, 0);
        prop_assert_eq!(rig.synchronizer.odometry_counts().restarts, 0);
    }
}

#[test]
fn a_clock_that_was_set_back_at_the_restart_is_none_that_feeds_again() {
    let mut rig = Rig::new(settings());
    (0..400).for_each(|index| give(&mut rig, message(index)));
    rig.told();
    let mut rig = restarted(&rig);
    // Like the old stamps, but none of them is the same.
    for milliseconds in (3003..5000).step_by(40) {
        rig.odometry(milliseconds);
        if milliseconds % 80 == 3 {
            rig.scan(milliseconds - 11);
        }
    }
    assert_eq!(rig.synchronizer.scan_counts().clock_restarts, 1);
    assert_eq!(rig.synchronizer.odometry_counts().restarts, 1);
    let told = rig.told();
    assert!(told.iter().filter(|told| told.starts_with('s')).count() > 15, "{told:?}");
}

#[test]
fn odometry_begins_anew_only_near_its_origin_after_a_pause_away_from_it() {
    // When it comes after the restart, in ms, and where it has the base then and before, m.
    let begins = |pause: i64, before: f64, after: f64| {
        let mut rig = Rig::new(settings());
        let give = |rig: &mut Rig, milliseconds: i64, x: f64| {
            let sample = (stamp(milliseconds), Pose2::new(x, 0.0, 0.0));
            rig.synchronizer.odometry(Channel::Messages, sample, &rig.frames);
        };
        give(&mut rig, 0, before);
        let mut rig = restarted(&rig);
        give(&mut rig, pause, after);
        let begins = rig.synchronizer.newest_odometry().is_none();
        rig.scan(pause);
        let told = rig.told();
        assert_eq!(told.last(), Some(&format!("s{after}")), "{told:?}");
        assert_eq!(begins, told.contains(&format!("begin{after}")), "{told:?}");
        give(&mut rig, pause + 20_000, 0.0);
        assert!(!rig.told().contains(&"begin0".to_owned()), "only the first may");
        begins
    };
    assert!(begins(5_100, 9.0, 0.3));
    assert!(!begins(4_900, 9.0, 0.3), "no robot starts so soon");
    assert!(!begins(5_100, 9.0, 0.7), "it is not near its origin");
    assert!(!begins(5_100, 0.3, 0.1), "it was near its origin");
}
