//! Why the map grows or does not, in a word and a sentence.

use std::collections::BTreeMap;

use super::ledger::Verdict;
use super::mapper::Gauges;
use super::snapshot::{Snapshot, State};
use super::status::InputStatus;
use crate::config::EngineKind;
use crate::slam::known_map::Mode;
use crate::slam::update::WeakDirection;

/// Scans that come less often than this, s, have stopped coming.
const SCANS_STOPPED_S: f64 = 3.0;

/// Of the last scans, the share that may be dropped before that is told.
const BEARABLE_OVERLOAD: f64 = 0.1;

/// Of the last scans, the share that has to have the same trouble for it to be told.
const MOSTLY: f64 = 0.5;

/// Processed scans that tell whether scans match.
const MATCHES: usize = 10;

/// What the judgement depends on.
#[derive(Debug)]
pub(super) struct Circumstances<'a> {
    pub(super) engine: EngineKind,
    pub(super) uptime_s: f64,
    pub(super) inputs: &'a BTreeMap<&'static str, InputStatus>,
    pub(super) snapshot: &'a Snapshot,
    pub(super) gauges: &'a Gauges,
}

/// What the daemon is doing, and what to do where something is wrong.
pub(super) fn judge(now: &Circumstances<'_>) -> (State, String) {
    if now.snapshot.paused {
        return (State::Paused, "mapping is paused; slam/cmd/resume goes on".to_owned());
    }
    waiting_for_scans(now)
        .or_else(|| waiting_for_odometry(now))
        .or_else(|| not_localized(now))
        .or_else(|| unusable_scans(now))
        .or_else(|| overload(now))
        .or_else(|| no_match(now))
        .or_else(|| weak_direction(now))
        .unwrap_or_else(|| mapping(now))
}

fn waiting_for_scans(now: &Circumstances<'_>) -> Option<(State, String)> {
    let scan = now.inputs.get("scan")?;
    let key = &scan.key;
    let detail = match scan.age_s {
        None => format!(
            "no scan has come on {key} in {:.1} s; does the laser publish there, and is it on the \
             same mesh? `gmapd doctor` looks closer",
            now.uptime_s
        ),
        Some(age_s) if age_s > SCANS_STOPPED_S => format!(
            "no scan has come on {key} for {age_s:.1} s, after {} before; does the laser still run?",
            scan.received
        ),
        Some(_) => return None,
    };
    Some((State::WaitingForScans, detail))
}

fn waiting_for_odometry(now: &Circumstances<'_>) -> Option<(State, String)> {
    if let Some(detail) = troubled(now, &[Verdict::NoOdometry], MOSTLY) {
        return Some((State::WaitingForOdometry, detail));
    }
    if now.snapshot.ledger.total() > 0 || now.gauges.scans_waiting == 0 {
        return None;
    }
    Some((State::WaitingForOdometry, "the first scan waits for its odometry".to_owned()))
}

fn not_localized(now: &Circumstances<'_>) -> Option<(State, String)> {
    if now.gauges.recent.back() != Some(&Verdict::NotLocalized) {
        return None;
    }
    let detail = &now.snapshot.ledger.last().get(&Verdict::NotLocalized)?.detail;
    Some((State::NotLocalized, detail.clone()))
}

fn unusable_scans(now: &Circumstances<'_>) -> Option<(State, String)> {
    const UNUSABLE: [Verdict; 8] = [
        Verdict::NoMount,
        Verdict::TiltedMount,
        Verdict::NotDecodable,
        Verdict::BadGeometry,
        Verdict::BadOdometry,
        Verdict::NoUsableBeams,
        Verdict::Duplicate,
        Verdict::Late,
    ];
    troubled(now, &UNUSABLE, MOSTLY).map(|detail| (State::Degraded, detail))
}

fn overload(now: &Circumstances<'_>) -> Option<(State, String)> {
    troubled(now, &[Verdict::Overload], BEARABLE_OVERLOAD).map(|detail| (State::Degraded, detail))
}

/// What is wrong with more than a share of the last scans; the most frequent trouble is told.
fn troubled(now: &Circumstances<'_>, troubles: &[Verdict], share: f64) -> Option<String> {
    let looked_at = |verdict: &&Verdict| !matches!(verdict, Verdict::Paused | Verdict::Throttled);
    let recent: Vec<&Verdict> = now.gauges.recent.iter().filter(looked_at).collect();
    let count = |verdict: &Verdict| recent.iter().filter(|other| **other == verdict).count();
    let troubled: usize = troubles.iter().map(count).sum();
    if troubled == 0 || (troubled as f64) < share * recent.len() as f64 {
        return None;
    }
    let worst = troubles.iter().max_by_key(|verdict| count(verdict))?;
    let detail = &now.snapshot.ledger.last().get(worst)?.detail;
    let (of, all) = (count(worst), recent.len());
    Some(format!("{of} of the last {all} scans could not be used; of the last of them: {detail}"))
}

fn no_match(now: &Circumstances<'_>) -> Option<(State, String)> {
    let shares: Vec<f64> = now.gauges.matched.iter().rev().take(MATCHES).copied().collect();
    let mean = shares.iter().sum::<f64>() / shares.len().max(1) as f64;
    if shares.len() < MATCHES || mean >= MOSTLY {
        return None;
    }
    let percent = mean * 100.0;
    let detail = match now.engine {
        EngineKind::Hector => format!(
            "of the last {MATCHES} scans {percent:.0} % fit the map, and the others do not enter \
             it; was the robot carried away (slam/cmd/initial_pose says where to), or is the laser \
             mounted otherwise?"
        ),
        EngineKind::Gmapping | EngineKind::KnownPoses => format!(
            "the last {MATCHES} scans matched the maps of {percent:.0} % of the particles, and the \
             others went by odometry; is minimumScore too high, or the laser mounted otherwise?"
        ),
    };
    Some((State::Degraded, detail))
}

fn weak_direction(now: &Circumstances<'_>) -> Option<(State, String)> {
    let report = now.snapshot.estimate.report.as_ref()?;
    let WeakDirection { x, y, turn } = report.weak_direction?;
    let what = if turn.abs() > x.abs().max(y.abs()) {
        "how far the robot turns".to_owned()
    } else {
        format!("how far it moves along the direction ({x:.2}, {y:.2}) of the map")
    };
    let has_odometry = now.snapshot.estimate.has_odometry;
    let who = if has_odometry {
        "there odometry alone decides"
    } else {
        "and without odometry the map may shrink there"
    };
    let state = if has_odometry { working(now) } else { State::Degraded };
    Some((state, format!("the scans do not tell {what}, as in a plain corridor: {who}")))
}

/// What goes on where nothing is wrong.
const fn working(now: &Circumstances<'_>) -> State {
    match now.snapshot.mode {
        Mode::Mapping => State::Mapping,
        Mode::Localization => State::Localizing,
    }
}

fn mapping(now: &Circumstances<'_>) -> (State, String) {
    let processed = now.snapshot.ledger.count(Verdict::Processed);
    if now.snapshot.mode == Mode::Localization {
        let detail = format!(
            "the map stays as it is; {processed} scans are processed; slam/cmd/mode?mode=mapping \
             lets them enter it again"
        );
        return (State::Localizing, detail);
    }
    let detail = match now.gauges.recent.back() {
        Some(Verdict::NotMovedEnough) => format!(
            "{processed} scans are mapped; the robot has not moved by linearUpdate or \
             angularUpdate since the last"
        ),
        _ => format!("{processed} scans are mapped"),
    };
    (State::Mapping, detail)
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::super::ledger::Ledger;
    use super::*;
    use crate::slam::update::ScanReport;

    /// What is judged of a daemon that runs for five seconds and heard a scan so long ago.
    fn judged(
        age_s: Option<f64>,
        verdicts: &[(Verdict, usize)],
        change: impl Fn(&mut Gauges),
    ) -> (State, String) {
        judged_of(EngineKind::Gmapping, age_s, verdicts, |_, gauges| change(gauges))
    }

    /// The same of an engine, and of what it left in the snapshot.
    fn judged_of(
        engine: EngineKind,
        age_s: Option<f64>,
        verdicts: &[(Verdict, usize)],
        change: impl Fn(&mut Snapshot, &mut Gauges),
    ) -> (State, String) {
        let key = "robot01/scan".to_owned();
        let scan = InputStatus { key, received: 7, age_s, ..InputStatus::default() };
        let mut snapshot = Snapshot::default();
        let mut gauges = Gauges::default();
        let mut ledger = Ledger::default();
        for &(verdict, count) in verdicts {
            for _ in 0..count {
                ledger.enter(None, verdict, format!("{verdict:?} it is"));
                gauges.recent.push_back(verdict);
            }
        }
        snapshot.ledger = ledger;
        change(&mut snapshot, &mut gauges);
        let inputs = BTreeMap::from([("scan", scan)]);
        let snapshot = Arc::new(snapshot);
        judge(&Circumstances {
            engine,
            uptime_s: 5.0,
            inputs: &inputs,
            snapshot: &snapshot,
            gauges: &gauges,
        })
    }

    #[test]
    fn without_scans_the_key_and_the_time_are_told() {
        let (state, detail) = judged(None, &[], |_| ());
        assert_eq!(state, State::WaitingForScans);
        assert!(detail.starts_with("no scan has come on robot01/scan in 5.0 s"), "{detail}");
        let (state, detail) = judged(Some(4.0), &[(Verdict::Processed, 9)], |_| ());
        assert_eq!(state, State::WaitingForScans);
        assert!(detail.contains("for 4.0 s, after 7 before"), "{detail}");
    }

    #[test]
    fn without_odometry_the_last_detail_is_told() {
        let verdicts = [(Verdict::Processed, 3), (Verdict::NoOdometry, 4)];
        let (state, detail) = judged(Some(0.1), &verdicts, |_| ());
        assert_eq!(state, State::WaitingForOdometry);
        assert!(
            detail.starts_with("4 of the last 7 scans") && detail.ends_with("NoOdometry it is")
        );
        let (state, _) = judged(Some(0.1), &[], |gauges| gauges.scans_waiting = 1);
        assert_eq!(state, State::WaitingForOdometry);
    }

    #[test]
    fn the_most_frequent_trouble_is_told() {
        let verdicts = [(Verdict::NoMount, 2), (Verdict::BadGeometry, 5), (Verdict::Processed, 1)];
        let (state, detail) = judged(Some(0.1), &verdicts, |_| ());
        assert_eq!(state, State::Degraded);
        assert!(detail.ends_with("BadGeometry it is"), "{detail}");
    }

    #[test]
    fn a_little_overload_is_borne_and_more_is_told() {
        let state = |overloaded| {
            let verdicts = [(Verdict::Overload, overloaded), (Verdict::Processed, 40)];
            judged(Some(0.1), &verdicts, |_| ()).0
        };
        assert_eq!((state(2), state(8)), (State::Mapping, State::Degraded));
    }

    #[test]
    fn scans_that_do_not_match_are_told() {
        let state = |share: f64| {
            let matched = |gauges: &mut Gauges| gauges.matched = [share; MATCHES].into();
            judged(Some(0.1), &[(Verdict::Processed, 10)], matched).0
        };
        assert_eq!((state(0.3), state(0.9)), (State::Degraded, State::Mapping));
    }

    #[test]
    fn hectors_scans_that_do_not_match_are_told_in_its_words() {
        let (state, detail) =
            judged_of(EngineKind::Hector, Some(0.1), &[(Verdict::Processed, 10)], |_, gauges| {
                gauges.matched = [1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0].into();
            });
        assert_eq!(state, State::Degraded);
        assert!(detail.starts_with("of the last 10 scans 20 % fit the map"), "{detail}");
        assert!(!detail.contains("particles") && !detail.contains("minimumScore"), "{detail}");
    }

    /// What is said of Hector if its last scan left this direction open.
    fn weakly(direction: [f64; 3], change: impl Fn(&mut Snapshot)) -> (State, String) {
        let [x, y, turn] = direction;
        let report = ScanReport {
            hits: 90,
            matched: 1,
            best_score: 80.0,
            effective_sample_size: 1.0,
            entropy: 0.0,
            resampled: false,
            registered: true,
            weak_direction: Some(WeakDirection { x, y, turn }),
        };
        judged_of(EngineKind::Hector, Some(0.1), &[(Verdict::Processed, 9)], |snapshot, _| {
            snapshot.estimate.report = Some(report.clone());
            change(snapshot);
        })
    }

    #[test]
    fn a_direction_that_the_scans_leave_open_is_told() {
        let expected = "the scans do not tell how far it moves along the direction (0.80, -0.60) of \
                        the map, as in a plain corridor: there odometry alone decides";
        assert_eq!(weakly([0.8, -0.6, 0.0], |_| ()), (State::Mapping, expected.to_owned()));
        let (_, detail) = weakly([0.1, 0.1, 0.99], |_| ());
        assert!(detail.starts_with("the scans do not tell how far the robot turns"), "{detail}");
        let alone = |snapshot: &mut Snapshot| snapshot.estimate.has_odometry = false;
        let (state, detail) = weakly([0.8, -0.6, 0.0], alone);
        assert_eq!(state, State::Degraded);
        assert!(detail.ends_with("and without odometry the map may shrink there"), "{detail}");
    }

    #[test]
    fn pauses_and_throttled_scans_are_no_trouble_and_hide_none() {
        let verdicts = [(Verdict::Paused, 40), (Verdict::Processed, 1)];
        assert_eq!(judged(Some(0.1), &verdicts, |_| ()).0, State::Mapping);
        let verdicts = [(Verdict::Throttled, 40), (Verdict::NoOdometry, 5)];
        assert_eq!(judged(Some(0.1), &verdicts, |_| ()).0, State::WaitingForOdometry);
    }

    #[test]
    fn a_robot_that_stands_is_no_trouble() {
        let verdicts = [(Verdict::Processed, 2), (Verdict::NotMovedEnough, 40)];
        let (state, detail) = judged(Some(0.1), &verdicts, |_| ());
        assert_eq!(state, State::Mapping);
        assert!(detail.starts_with("2 scans are mapped; the robot has not moved"), "{detail}");
    }
}
