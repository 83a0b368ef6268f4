//! What was seen, and what it means.

use super::finding::Finding;
use super::motion::{self, Agreement};
use super::watch::{Counts, Input, SeenPose, SeenScan, Watch};
use crate::config::EngineKind;
use crate::convert;
use crate::slam::pose::Stamp;
use crate::slam::scan::{Beam, LaserMount};
use crate::statistics::percentile;

/// Rates below are too rare, Hz.
const LEAST_SCAN_RATE: f64 = 1.0;
const LEAST_ODOMETRY_RATE: f64 = 2.0;

/// Scans are stamped when their sweep begins and arrive when it has ended; more is no sweep, s.
const MOST_SKEW_S: f64 = 0.3;

/// Between stamps and this machine's clock, s; beyond a day the stamps are of a recording or a
/// simulation, and no clock is wrong.
const MOST_CLOCK_ERROR_S: f64 = 1.0;
const A_DAY_S: f64 = 86_400.0;

/// A scan with a smaller share of hits among its beams sees nothing.
const LEAST_HITS: f64 = 0.02;

/// More ranges beyond `range_max` than this are no noise.
const MOST_BEYOND_LIMIT: f64 = 0.2;

/// Share of disordered stamps that is more than the network's doing.
const MOST_DISORDERED: f64 = 0.02;

/// What a watch comes to.
#[derive(Debug, Clone, PartialEq)]
pub struct Report {
    /// What was seen, a sentence each.
    pub facts: Vec<String>,
    /// What is wrong; empty for a healthy robot.
    pub findings: Vec<Finding>,
}

impl Watch {
    /// What it all means.
    #[must_use]
    pub fn report(&self) -> Report {
        let mut report = Report { facts: Vec::new(), findings: Vec::new() };
        report.arrivals(self);
        if !self.scans.is_empty() {
            report.scans(self);
        }
        if !self.used_odometry().is_empty() {
            report.odometry(self);
        }
        if !self.scans.is_empty() && !self.used_odometry().is_empty() {
            report.clocks(self);
            let mount = report.mount(self);
            if report.is_comparable() {
                report.motion(self, mount);
            }
        }
        report.daemon(self);
        report
    }
}

impl Report {
    fn arrivals(&mut self, watch: &Watch) {
        let received = |input: Input| watch.inputs[input as usize].received;
        if received(Input::Scan) == 0 {
            self.findings.push(Finding::NothingArrives { key: watch.key(Input::Scan) });
        }
        let without = received(Input::Odom) == 0 && watch.tf_odometry.is_empty();
        let engine = watch.status.as_ref().and_then(|status| status.engine);
        match engine.unwrap_or(EngineKind::Gmapping) {
            EngineKind::Hector if without => {
                self.facts.push("odometry: none; Hector maps from scans alone".to_owned());
            }
            EngineKind::Gmapping if without => self.findings.push(Finding::NoOdometry {
                key: watch.key(Input::Odom),
                odom: watch.names.odom.clone(),
                base: watch.names.base.clone(),
            }),
            // What known_poses lacks the daemon tells itself.
            EngineKind::Gmapping | EngineKind::Hector | EngineKind::KnownPoses => {}
        }
        for input in Input::ALL {
            let Counts { received, rejected, reason } = &watch.inputs[input as usize];
            if *rejected > 0 {
                self.findings.push(Finding::Unusable {
                    key: watch.key(input),
                    rejected: *rejected,
                    received: *received,
                    reason: reason.clone(),
                });
            }
        }
    }

    fn scans(&mut self, watch: &Watch) {
        let Some(last) = watch.scans.last() else { return };
        let arrivals: Vec<Stamp> = watch.scans.iter().map(|seen| seen.arrival).collect();
        let stamps: Vec<Stamp> = watch.scans.iter().map(|seen| seen.scan.stamp).collect();
        let beams = watch.scans.iter().map(|seen| seen.scan.ranges.len());
        let (least, most) = (beams.clone().min().unwrap_or(0), beams.max().unwrap_or(0));
        let count = if least == most { format!("{most}") } else { format!("{least} to {most}") };
        let geometry = &last.scan.geometry;
        let way = if geometry.angle_increment() < 0.0 { ", clockwise" } else { "" };
        self.facts.push(format!(
            "scans: {}, {count} beams {:.2} degrees apart{way}, {:.2} m to {:.2} m, frame {:?}",
            rate_text(&arrivals),
            geometry.angle_increment().abs().to_degrees(),
            geometry.range_min(),
            geometry.range_max(),
            last.frame
        ));
        self.rate(&arrivals, "scans", LEAST_SCAN_RATE);
        self.stamp_order(&stamps, "scans");
        self.geometry(&watch.scans);
    }

    fn geometry(&mut self, scans: &[SeenScan]) {
        let without_hits = scans.iter().filter(|seen| hit_share(seen) < LEAST_HITS);
        let (without_hits, example) =
            without_hits.fold((0, None), |(n, _), seen| (n + 1, Some(seen)));
        if let Some(example) = example.filter(|_| 2 * without_hits > scans.len()) {
            let (scans, example) = (scans.len(), ranges_text(example));
            self.findings.push(Finding::NoHits { without_hits, scans, example });
        }
        let Some(SeenScan { scan, expected_beams, .. }) = scans.last() else { return };
        let beams = scan.ranges.len();
        // A driver may count the last beam or not, and lose one now and then.
        if (beams as f64 - expected_beams).abs() > 2.5 {
            let expected = expected_beams.round() as usize;
            self.findings.push(Finding::Angles { beams, expected });
        }
        let range_max = scan.geometry.range_max();
        let finite = scans.iter().flat_map(|seen| &seen.scan.ranges).filter(|r| r.is_finite());
        let (beyond, all) = finite.fold((0_usize, 0_usize), |(beyond, all), &range| {
            (beyond + usize::from(f64::from(range) > 1.01 * range_max), all + 1)
        });
        let share = beyond as f64 / all.max(1) as f64;
        if share > MOST_BEYOND_LIMIT {
            self.findings.push(Finding::RangeLimit { share, range_max });
        }
    }

    fn odometry(&mut self, watch: &Watch) {
        let samples = watch.used_odometry();
        let arrivals: Vec<Stamp> = samples.iter().map(|sample| sample.arrival).collect();
        let stamps: Vec<Stamp> = samples.iter().map(|sample| sample.stamp).collect();
        let source = if watch.odometry.is_empty() { "from tf" } else { "messages" };
        self.facts.push(format!("odometry: {}, {source}", rate_text(&arrivals)));
        self.rate(&arrivals, "odometry", LEAST_ODOMETRY_RATE);
        self.stamp_order(&stamps, "odometry");
    }

    fn rate(&mut self, arrivals: &[Stamp], what: &'static str, least: f64) {
        if let Some(rate_hz) = rate_hz(arrivals).filter(|&rate| rate < least) {
            self.findings.push(Finding::Rare { what, rate_hz });
        }
    }

    fn stamp_order(&mut self, stamps: &[Stamp], what: &'static str) {
        let disordered = stamps.windows(2).filter(|pair| pair[1] <= pair[0]).count();
        if disordered as f64 > MOST_DISORDERED * stamps.len() as f64 {
            let received = stamps.len();
            self.findings.push(Finding::StampOrder { what, disordered, received });
        }
    }

    fn clocks(&mut self, watch: &Watch) {
        let scans = watch.scans.iter().map(|seen| seen.arrival.seconds_since(seen.scan.stamp));
        let odometry = |sample: &SeenPose| sample.arrival.seconds_since(sample.stamp);
        let odometry = watch.used_odometry().iter().map(odometry);
        let (Some(behind_s), Some(odometry_s)) = (median(scans), median(odometry)) else { return };
        let skew_s = behind_s - odometry_s;
        self.facts.push(format!("stamps: odometry {skew_s:+.3} s against scans"));
        if skew_s.abs() > MOST_SKEW_S {
            self.findings.push(Finding::StampSkew { skew_s });
        }
        if behind_s.abs() > A_DAY_S {
            self.facts.push(format!(
                "stamps are {:.0} days from this machine's clock: a recording or a simulation",
                behind_s.abs() / A_DAY_S
            ));
        } else if behind_s.abs() > MOST_CLOCK_ERROR_S {
            self.findings.push(Finding::MachineClock { behind_s });
        } else {
            self.facts.push(format!("scans arrive {behind_s:.3} s after their stamp"));
        }
    }

    /// Where the laser sits, if that is known.
    fn mount(&mut self, watch: &Watch) -> Option<LaserMount> {
        let seen = watch.scans.last()?;
        let (base, laser) = (&watch.names.base, &seen.frame);
        if laser == base {
            return Some(LaserMount::default());
        }
        // A daemon that maps knows the mount, by its configuration if not by a transform.
        let mapped = watch.status.as_ref().and_then(|status| status.scans.get("processed"));
        let place = watch.frames.target_from_source(base, laser, seen.scan.stamp);
        match place.map(|place| convert::laser_mount(&place)) {
            Ok(Ok(mount)) => {
                let place = mount.base_from_laser;
                self.facts.push(format!(
                    "laser: ({:.3} m, {:.3} m), {:.1} degrees in {base:?}, {:?}",
                    place.x,
                    place.y,
                    place.theta.to_degrees(),
                    mount.orientation
                ));
                Some(mount)
            }
            Ok(Err(tilted)) => {
                self.findings.push(Finding::Tilted(tilted.to_string()));
                None
            }
            Err(_) if mapped.is_some_and(|&scans| scans > 0) => None,
            Err(reason) => {
                let (laser, base, reason) = (laser.clone(), base.clone(), reason.to_string());
                self.findings.push(Finding::NoMount { laser, base, reason });
                None
            }
        }
    }

    /// Blind scans and poses of other times say nothing about motion.
    fn is_comparable(&self) -> bool {
        let prevents = |finding: &Finding| {
            matches!(finding, Finding::NoHits { .. } | Finding::StampSkew { .. })
        };
        !self.findings.iter().any(prevents)
    }

    fn motion(&mut self, watch: &Watch, mount: Option<LaserMount>) {
        match motion::compare(watch, mount) {
            Agreement::Alike { turns, ratio } => self.facts.push(format!(
                "turns: scans and odometry agree ({turns} compared, ratio {ratio:.2})"
            )),
            Agreement::Contradiction(finding) => self.findings.push(finding),
            Agreement::Unknown => self.facts.push(
                "turns: too few to compare scans with odometry; turn the robot by half a circle \
                 while the doctor watches"
                    .to_owned(),
            ),
        }
    }

    fn daemon(&mut self, watch: &Watch) {
        match &watch.status {
            None => self.findings.push(Finding::NoDaemon { key: watch.keys.status.clone() }),
            Some(status) if status.state == "mapping" => {
                self.facts.push(format!("daemon: mapping. {}", status.detail));
            }
            Some(status) => self.findings.push(Finding::Daemon {
                state: status.state.clone(),
                detail: status.detail.clone(),
            }),
        }
    }
}

fn rate_hz(arrivals: &[Stamp]) -> Option<f64> {
    let [first, .., last] = arrivals else { return None };
    let span = last.seconds_since(*first);
    (span > 0.0).then(|| (arrivals.len() - 1) as f64 / span)
}

fn rate_text(arrivals: &[Stamp]) -> String {
    rate_hz(arrivals).map_or_else(|| "one message".to_owned(), |rate| format!("{rate:.1} Hz"))
}

fn median(values: impl Iterator<Item = f64>) -> Option<f64> {
    let mut sorted: Vec<f64> = values.collect();
    sorted.sort_by(f64::total_cmp);
    percentile(&sorted, 50)
}

fn hit_share(seen: &SeenScan) -> f64 {
    let scan = &seen.scan;
    let hits = scan.ranges.iter();
    let hits = hits.filter(|&&range| matches!(scan.geometry.classify(range), Beam::Hit(_))).count();
    hits as f64 / scan.ranges.len().max(1) as f64
}

/// How many ranges of a scan are of which kind.
fn ranges_text(seen: &SeenScan) -> String {
    let count =
        |kind: fn(&f32) -> bool| seen.scan.ranges.iter().filter(|range| kind(range)).count();
    format!(
        "of {} ranges {} are NaN, {} infinite, {} zero or less",
        seen.scan.ranges.len(),
        count(|range| range.is_nan()),
        count(|range| range.is_infinite()),
        count(|range| *range <= 0.0 && range.is_finite())
    )
}
