//! The status as ROS' diagnostics show it.

use serde::Serialize;

use super::snapshot::State;
use super::status::Status;
use crate::ros;
use crate::slam::update::WeakDirection;

/// The status of the robot as a message; its stamp is zero, for no sensor took it.
pub(super) fn diagnostics(status: &Status, robot: &str) -> ros::DiagnosticArray {
    let level = match status.state {
        State::Mapping | State::Localizing => ros::DiagnosticStatus::OK,
        State::Degraded | State::Paused => ros::DiagnosticStatus::WARN,
        State::WaitingForOdometry | State::NotLocalized => ros::DiagnosticStatus::ERROR,
        State::WaitingForScans => ros::DiagnosticStatus::STALE,
    };
    let status = ros::DiagnosticStatus {
        level,
        name: "gmapd: mapping".to_owned(),
        message: status.detail.clone(),
        hardware_id: robot.to_owned(),
        values: values(status),
    };
    ros::DiagnosticArray { header: ros::Header::default(), status: vec![status] }
}

fn values(status: &Status) -> Vec<ros::KeyValue> {
    let value = |key: &str, value: String| ros::KeyValue { key: key.to_owned(), value };
    let known = |number: Option<f64>| number.map_or("not known".to_owned(), |n| format!("{n:.2}"));
    let milliseconds = status.milliseconds_per_scan;
    let mut values = vec![
        value("state", word(&status.state)),
        value("ms per scan, median", known(milliseconds.map(|spread| spread.p50))),
        value("ms per scan, 99 of 100", known(milliseconds.map(|spread| spread.p99))),
        value("particles", status.filter.particles.to_string()),
        value("effective sample size", known(status.filter.effective_sample_size)),
        value("weak direction", weak_direction(status.filter.weak_direction)),
        value("scans with a weak direction", status.filter.weak_directions.to_string()),
    ];
    let counts = status.scans.iter();
    values.extend(
        counts
            .map(|(verdict, count)| value(&format!("scans {}", word(verdict)), count.to_string())),
    );
    values
}

/// What the last processed scan left open, in words.
fn weak_direction(weak: Option<WeakDirection>) -> String {
    weak.map_or("none".to_owned(), |WeakDirection { x, y, turn }| {
        format!("x {x:.2}, y {y:.2}, turn {turn:.2}")
    })
}

/// The word that `slam/status` has for it.
fn word(value: &impl Serialize) -> String {
    let word = serde_json::to_value(value).unwrap_or_default();
    word.as_str().unwrap_or_default().to_owned()
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;
    use crate::config::EngineKind;
    use crate::daemon::ledger::Verdict;
    use crate::daemon::links::LinksStatus;
    use crate::daemon::status::FilterStatus;
    use crate::slam::known_map::Mode;
    use crate::slam::pose::Pose2;
    use crate::statistics::Spread;

    fn status(state: State) -> Status {
        Status {
            engine: EngineKind::Gmapping,
            links: LinksStatus::default(),
            mode: Mode::Mapping,
            version: "0.0.0",
            uptime_s: 1.0,
            state,
            detail: "no scan has come".to_owned(),
            pose_in_map: Pose2::IDENTITY,
            laser: None,
            scans: BTreeMap::from([(Verdict::Processed, 3), (Verdict::NoOdometry, 2)]),
            last_details: BTreeMap::new(),
            inputs: BTreeMap::new(),
            milliseconds_per_scan: Spread::of(&[1.25]),
            real_time_factor: None,
            scans_waiting: 0,
            filter: FilterStatus { particles: 30, ..FilterStatus::default() },
            map: None,
            checkpoint: None,
            refused: BTreeMap::new(),
            peak_memory_bytes: None,
            seed: 1,
        }
    }

    #[test]
    fn the_level_follows_the_state() {
        let level = |state| diagnostics(&status(state), "robot01").status[0].level;
        assert_eq!(level(State::Mapping), ros::DiagnosticStatus::OK);
        assert_eq!(level(State::Degraded), ros::DiagnosticStatus::WARN);
        assert_eq!(level(State::Paused), ros::DiagnosticStatus::WARN);
        assert_eq!(level(State::WaitingForOdometry), ros::DiagnosticStatus::ERROR);
        assert_eq!(level(State::WaitingForScans), ros::DiagnosticStatus::STALE);
    }

    #[test]
    fn a_weak_direction_is_a_value() {
        let weak = WeakDirection { x: 0.6, y: -0.8, turn: 0.0 };
        assert_eq!(weak_direction(Some(weak)), "x 0.60, y -0.80, turn 0.00");
    }

    #[test]
    fn figures_and_counts_are_values() {
        let message = diagnostics(&status(State::Mapping), "robot01");
        let status = &message.status[0];
        assert_eq!(
            (status.hardware_id.as_str(), status.message.as_str()),
            ("robot01", "no scan has come")
        );
        let value = |key: &str| {
            status.values.iter().find(|value| value.key == key).map(|value| value.value.as_str())
        };
        assert_eq!(value("state"), Some("mapping"));
        assert_eq!(value("ms per scan, median"), Some("1.25"));
        assert_eq!(value("effective sample size"), Some("not known"));
        assert_eq!(value("weak direction"), Some("none"));
        assert_eq!(value("scans processed"), Some("3"));
        assert_eq!(value("scans no_odometry"), Some("2"));
    }
}
