//! What `slam/status` tells: the one answer to "why does my map not grow?".

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use serde::Serialize;
use tokio::sync::watch;

use super::LAST_CHECKPOINT;
use super::checkpointing::{CheckpointStatus, SharedStatus};
use super::input::{Inbox, Input};
use super::judgement::{self, Circumstances};
use super::keys::InputKeys;
use super::ledger::Verdict;
use super::limits::{Reason, Refusals};
use super::links::{Links, LinksStatus};
use super::mailbox::Mailbox;
use super::mapper::Gauges;
use super::snapshot::{MapVersion, Snapshot, State};
use super::synchronizer::Channel;
use crate::clock;
use crate::config::{EngineKind, RawConfig};
use crate::slam::known_map::Mode;
use crate::slam::pose::Pose2;
use crate::slam::scan::LaserMount;
use crate::slam::update::WeakDirection;
use crate::statistics::Spread;
use crate::timeline::TimelineCounts;

/// How the daemon is, at the moment of asking.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Status {
    /// Of gmapd.
    pub version: &'static str,
    /// What maps.
    pub engine: EngineKind,
    /// Seconds since the daemon started.
    pub uptime_s: f64,
    /// The session's links.
    pub links: LinksStatus,
    /// In one word.
    pub state: State,
    /// In a sentence, with what to do where something is wrong.
    pub detail: String,
    /// Whether scans enter the map.
    pub mode: Mode,
    /// The pose of the base in `map`.
    pub pose_in_map: Pose2,
    /// How the laser of the last scan sits on the base; `null` before the first.
    pub laser: Option<LaserMount>,
    /// Scans by verdict; all verdicts are there.
    pub scans: BTreeMap<Verdict, u64>,
    /// The last detail of each verdict that had one.
    pub last_details: BTreeMap<Verdict, String>,
    /// What arrived.
    pub inputs: BTreeMap<&'static str, InputStatus>,
    /// Milliseconds that the last processed scans took; `null` before the first.
    pub milliseconds_per_scan: Option<Spread>,
    /// Seconds of driving mapped in a second of work; `null` before there is something to tell.
    pub real_time_factor: Option<f64>,
    /// Scans that wait for odometry or for the filter.
    pub scans_waiting: usize,
    /// About the hypotheses.
    pub filter: FilterStatus,
    /// The map that is handed out; `null` before the first.
    pub map: Option<MapStatus>,
    /// The state on disk; `null` if it is not kept.
    pub checkpoint: Option<CheckpointStatus>,
    /// What was asked for and refused, by reason; all reasons are there.
    pub refused: BTreeMap<Reason, u64>,
    /// The most memory the process has had resident, bytes.
    pub peak_memory_bytes: Option<u64>,
    /// Seed of the random numbers.
    pub seed: u64,
}

/// About one input: `scan`, `odom`, `tf` or `tf_static`.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct InputStatus {
    /// The key it is subscribed to.
    pub key: String,
    /// Samples that came.
    pub received: u64,
    /// Samples whose bytes were not what was expected.
    pub rejected: u64,
    /// Samples dropped because they came faster than they could be taken.
    pub dropped: u64,
    /// What was wrong with the last that was rejected.
    pub last_rejection: Option<String>,
    /// Seconds since the last came; `null` when none has.
    pub age_s: Option<f64>,
    /// Messages with the stamp of an earlier one.
    pub duplicates: u64,
    /// Messages that came after a newer one.
    pub reordered: u64,
    /// Times the sender's clock was set back.
    pub clock_restarts: u64,
    /// Outages: stamps more than a second apart. Transforms are not looked at.
    pub gaps: u64,
    /// The longest outage, by the stamps.
    pub longest_gap_s: f64,
}

/// About the particles.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct FilterStatus {
    /// How many there are.
    pub particles: usize,
    /// 1 / Σ wᵢ² at the last processed scan.
    pub effective_sample_size: Option<f64>,
    /// How often particles were drawn anew.
    pub resamples: u64,
    /// Odometry steps that were too long to be believed.
    pub odometry_jumps: u64,
    /// Times odometry began anew after a restart, as after a power cut; 1 at most.
    pub odometry_restarts: u64,
    /// Scans that were not deskewed, for odometry has the robot move faster than 10 m/s or 10 rad/s
    /// during their sweeps: it was reset meanwhile, or a pose found anew.
    pub scans_not_deskewed: u64,
    /// Scans that went without odometry; only engines that can do without have such.
    pub scans_without_odometry: u64,
    /// Processed scans that left a direction open, where the engine looks for it.
    pub weak_directions: u64,
    /// What the last processed scan left open: a unit vector in `map`; `null` if nothing.
    pub weak_direction: Option<WeakDirection>,
}

/// About the map.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct MapStatus {
    /// Grows with every change.
    pub version: u64,
    /// Cells a row of the map cropped to what is known.
    pub width: usize,
    /// Its rows.
    pub height: usize,
    /// Metres a cell.
    pub resolution: f64,
    /// Free and occupied area, m².
    pub known_area_m2: f64,
    /// Processed scans in it.
    pub scans: usize,
}

/// Where the status comes from.
#[derive(Debug)]
pub struct StatusSource {
    started: Instant,
    keys: InputKeys,
    engine: EngineKind,
    seed: u64,
    inbox: Arc<Inbox>,
    mailbox: Arc<Mailbox>,
    gauges: Arc<Mutex<Gauges>>,
    snapshots: watch::Receiver<Arc<Snapshot>>,
    links: Arc<Links>,
    checkpoints: Option<SharedStatus>,
    refusals: Arc<Refusals>,
    /// Of the version of the map that was asked for last.
    map: Mutex<Option<MapStatus>>,
}

/// What the daemon's parts share.
#[derive(Debug, Clone)]
pub(super) struct Shared {
    pub(super) inbox: Arc<Inbox>,
    pub(super) mailbox: Arc<Mailbox>,
    pub(super) gauges: Arc<Mutex<Gauges>>,
    pub(super) snapshots: watch::Receiver<Arc<Snapshot>>,
    pub(super) links: Arc<Links>,
    pub(super) checkpoints: Option<SharedStatus>,
}

impl StatusSource {
    pub(super) fn new(keys: InputKeys, config: &RawConfig, shared: Shared) -> Self {
        let Shared { inbox, mailbox, gauges, snapshots, links, checkpoints } = shared;
        let &RawConfig { engine, seed, .. } = config;
        let (started, map) = (clock::now(), Mutex::default());
        Self {
            started,
            keys,
            engine,
            seed,
            inbox,
            mailbox,
            gauges,
            snapshots,
            links,
            checkpoints,
            refusals: Arc::default(),
            map,
        }
    }

    /// Where what is refused is counted.
    #[must_use]
    pub fn refusals(&self) -> Arc<Refusals> {
        Arc::clone(&self.refusals)
    }

    /// What the daemon is doing now, in a word and a sentence.
    #[must_use]
    pub fn state(&self) -> (State, String) {
        let (snapshot, gauges) = self.present();
        self.judge(&self.inputs(&gauges), &snapshot, &gauges)
    }

    /// How long the last state may take to be written.
    pub(super) const fn time_to_write(&self) -> Duration {
        if self.checkpoints.is_some() { LAST_CHECKPOINT } else { Duration::ZERO }
    }

    fn present(&self) -> (Arc<Snapshot>, Gauges) {
        let gauges = self.gauges.lock().unwrap_or_else(PoisonError::into_inner).clone();
        (Arc::clone(&self.snapshots.borrow()), gauges)
    }

    fn judge(
        &self,
        inputs: &BTreeMap<&'static str, InputStatus>,
        snapshot: &Snapshot,
        gauges: &Gauges,
    ) -> (State, String) {
        let uptime_s = self.uptime_s();
        let engine = self.engine;
        judgement::judge(&Circumstances { engine, uptime_s, inputs, snapshot, gauges })
    }

    fn uptime_s(&self) -> f64 {
        clock::now().duration_since(self.started).as_secs_f64()
    }

    /// How the daemon is now.
    #[must_use]
    pub fn status(&self) -> Status {
        let (snapshot, gauges) = self.present();
        let inputs = self.inputs(&gauges);
        let (state, detail) = self.judge(&inputs, &snapshot, &gauges);
        let ledger = &snapshot.ledger;
        let details = ledger.last().iter().filter(|(_, entry)| !entry.detail.is_empty());
        Status {
            version: env!("CARGO_PKG_VERSION"),
            uptime_s: self.uptime_s(),
            state,
            mode: snapshot.mode,
            detail,
            pose_in_map: snapshot.estimate.pose_in_map,
            laser: gauges.laser,
            scans: Verdict::ALL.into_iter().map(|v| (v, ledger.count(v))).collect(),
            last_details: details.map(|(v, entry)| (*v, entry.detail.clone())).collect(),
            inputs,
            milliseconds_per_scan: snapshot.milliseconds_per_scan,
            real_time_factor: (gauges.worked_s > 0.0).then(|| gauges.mapped_s / gauges.worked_s),
            scans_waiting: self.mailbox.scans() + gauges.scans_waiting,
            filter: filter_status(&snapshot, &gauges),
            map: snapshot.map.as_deref().map(|map| self.map_status(map)),
            checkpoint: self.checkpoints.as_ref().map(told),
            refused: self.refusals.counts(),
            peak_memory_bytes: clock::peak_resident_memory(),
            engine: self.engine,
            links: self.links.status(),
            seed: self.seed,
        }
    }

    fn inputs(&self, gauges: &Gauges) -> BTreeMap<&'static str, InputStatus> {
        let status = |input| (Input::name(input), self.input(input, gauges));
        self.keys.inputs().into_iter().map(status).collect()
    }

    fn input(&self, input: Input, gauges: &Gauges) -> InputStatus {
        let tally = self.inbox.tally(input);
        let now = clock::now();
        let lost = if input == self.keys.motion() { self.mailbox.lost_motions() } else { 0 };
        let status = InputStatus {
            key: self.keys.of(input).to_string(),
            received: tally.received,
            rejected: tally.rejected,
            dropped: tally.dropped + lost,
            last_rejection: tally.last_rejection,
            age_s: tally.last.map(|last| now.saturating_duration_since(last).as_secs_f64()),
            gaps: tally.gaps.count,
            longest_gap_s: tally.gaps.longest_s,
            ..InputStatus::default()
        };
        match input {
            Input::Scan => InputStatus {
                duplicates: gauges.scans.duplicates,
                reordered: gauges.scans.reordered,
                clock_restarts: gauges.scans.clock_restarts,
                ..status
            },
            Input::Odom | Input::Pose if gauges.channel == Some(Channel::Messages) => {
                with_counts(status, gauges.odometry)
            }
            Input::Tf => with_counts(status, gauges.transforms.samples),
            Input::Odom | Input::Pose | Input::TfStatic => status,
        }
    }

    /// Cropping the map costs milliseconds, so it is done once a version.
    fn map_status(&self, map: &MapVersion) -> MapStatus {
        let mut known = self.map.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(status) = known.as_ref().filter(|status| status.version == map.version) {
            return status.clone();
        }
        known.insert(MapStatus::of(map)).clone()
    }
}

impl MapStatus {
    fn of(map: &MapVersion) -> Self {
        let (version, scans) = (map.version, map.path.len());
        let Some(grid) = map.occupancy.to_grid(map.occupied_threshold) else {
            return Self { version, scans, ..Self::default() };
        };
        let known = grid.cells.iter().filter(|cell| **cell >= 0).count();
        Self {
            version,
            width: grid.width,
            height: grid.height,
            resolution: grid.resolution,
            known_area_m2: known as f64 * grid.resolution * grid.resolution,
            scans,
        }
    }
}

fn told(checkpoints: &SharedStatus) -> CheckpointStatus {
    checkpoints.lock().unwrap_or_else(PoisonError::into_inner).clone()
}

fn with_counts(status: InputStatus, counts: TimelineCounts) -> InputStatus {
    InputStatus {
        duplicates: counts.duplicates,
        reordered: counts.reordered + counts.stale,
        clock_restarts: counts.restarts,
        ..status
    }
}

fn filter_status(snapshot: &Snapshot, gauges: &Gauges) -> FilterStatus {
    let report = snapshot.estimate.report.as_ref();
    FilterStatus {
        particles: snapshot.estimate.particles.len(),
        effective_sample_size: report.map(|report| report.effective_sample_size),
        resamples: snapshot.resamples,
        odometry_jumps: gauges.odometry_jumps,
        odometry_restarts: gauges.odometry_restarts,
        scans_not_deskewed: gauges.scans.not_deskewed,
        scans_without_odometry: gauges.without_odometry,
        weak_directions: gauges.weak,
        weak_direction: report.and_then(|report| report.weak_direction),
    }
}
