//! The filter's thread: takes what comes, and leaves snapshots and verdicts.

pub mod state;

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};
use tokio::sync::{broadcast, oneshot, watch};

use super::checkpointing::Keeper;
use super::command::{Command, Done, Request};
use super::frames::{FrameNames, Frames};
use super::input::{Inbox, Input, input_of};
use super::keys::InputKeys;
use super::ledger::{Entry, Ledger, Verdict};
use super::mailbox::{Event, Mail, Mailbox};
use super::snapshot::{Estimate, MapVersion, Snapshot};
use super::synchronizer::{
    self, Call, Channel, Need, ReadyScan, Refusal, ScanCounts, Sought, Synchronizer,
};
use crate::clock::{self, Stopwatch};
use crate::config::{Config, EngineKind, InitialPose, OdometrySource};
use crate::convert::FramedPose;
use crate::slam::engine::{Engine, Sweep};
use crate::slam::known_map::Mode;
use crate::slam::odometry::JumpGuard;
use crate::slam::pose::{Pose2, Stamp};
use crate::slam::scan::LaserMount;
use crate::slam::update::{OdometryUpdate, ScanReport, ScanUpdate};
use crate::starting::{self, StartError};
use crate::statistics::Spread;
use crate::tf::{Kind, TfCounts, Transform};
use crate::timeline::TimelineCounts;

/// Processed scans whose times are kept.
const TIMED_SCANS: usize = 1000;

/// Verdicts and matches that tell how it goes at the moment.
const RECENT: usize = 50;

/// How to tell where the robot is.
const SAY_WHERE: &str = "slam/cmd/initial_pose?x=1.5;y=-2;yaw=0.5";

/// What the filter's thread works with.
#[derive(Debug)]
pub struct Connections {
    /// What comes.
    pub mailbox: Arc<Mailbox>,
    /// Where what cannot be used is counted.
    pub inbox: Arc<Inbox>,
    /// What the filter knows.
    pub snapshots: watch::Sender<Arc<Snapshot>>,
    /// What became of each scan.
    pub verdicts: broadcast::Sender<Entry>,
    /// How it goes.
    pub gauges: Arc<Mutex<Gauges>>,
}

/// How it goes: what the status tells beside the snapshot.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Gauges {
    /// Scans that wait for odometry.
    #[serde(skip)]
    pub scans_waiting: usize,
    /// How the laser of the last scan sits.
    pub laser: Option<LaserMount>,
    /// Odometry steps that were too long to be believed.
    pub odometry_jumps: u64,
    /// Times odometry began anew after a restart.
    #[serde(skip)]
    pub odometry_restarts: u64,
    /// Where odometry comes from.
    #[serde(skip)]
    pub channel: Option<Channel>,
    /// Of the odometry.
    #[serde(skip)]
    pub odometry: TimelineCounts,
    /// Of the transforms.
    #[serde(skip)]
    pub transforms: TfCounts,
    /// Of the scans.
    #[serde(skip)]
    pub scans: ScanCounts,
    /// Verdicts of the last scans, oldest first.
    pub recent: VecDeque<Verdict>,
    /// Shares of the particles that matched the last processed scans, oldest first.
    pub matched: VecDeque<f64>,
    /// Scans that went without odometry.
    pub without_odometry: u64,
    /// Processed scans that left a direction open.
    pub weak: u64,
    /// Seconds of driving mapped, by the stamps of processed scans.
    pub mapped_s: f64,
    /// Seconds that the filter worked for it.
    pub worked_s: f64,
}

/// The filter with everything it needs to be fed.
#[derive(Debug)]
pub struct Mapper {
    connections: Connections,
    engine: Engine,
    /// As configured: where the robot is at first, and what a jump is.
    initial_pose: Option<InitialPose>,
    first_mode: Mode,
    jump: JumpGuard,
    /// Seconds between two versions of the map while scans wait.
    map_update_interval: f64,
    synchronizer: Synchronizer,
    frames: Frames,
    /// What given poses are in.
    map_frame: String,
    view: View,
    gauges: Gauges,
    /// Verdicts since the last snapshot.
    untold: Vec<Entry>,
    /// Writes the state to the disk, where that is configured.
    keeper: Option<Keeper>,
}

/// What goes into the next snapshot.
#[derive(Debug)]
struct View {
    ledger: Ledger,
    paused: bool,
    mode: Mode,
    resamples: u64,
    times: VecDeque<f64>,
    milliseconds_per_scan: Option<Spread>,
    estimate: Estimate,
    map: Option<Arc<MapVersion>>,
    version: u64,
    /// The epoch in which the filter began.
    first_epoch: u64,
    /// The last scan in the map, if that is newer than the last version.
    unpublished: Option<Stamp>,
    /// The last processed scan.
    processed: Option<Stamp>,
    /// Odometry at the filter's last step.
    odom_from_base: Option<Pose2>,
    /// Whether anything is different from the last snapshot.
    changed: bool,
}

impl View {
    fn new() -> Self {
        Self {
            ledger: Ledger::default(),
            paused: false,
            mode: Mode::Mapping,
            resamples: 0,
            times: VecDeque::new(),
            milliseconds_per_scan: None,
            estimate: Estimate::default(),
            map: None,
            version: 0,
            first_epoch: 1,
            unpublished: None,
            processed: None,
            odom_from_base: None,
            changed: true,
        }
    }

    fn snapshot(&self) -> Snapshot {
        Snapshot {
            estimate: self.estimate.clone(),
            ledger: self.ledger.clone(),
            milliseconds_per_scan: self.milliseconds_per_scan,
            resamples: self.resamples,
            paused: self.paused,
            mode: self.mode,
            map: self.map.clone(),
        }
    }
}

impl Mapper {
    /// A filter before its first scan.
    ///
    /// # Errors
    /// When the map to start from cannot be used, or the filter's threads cannot be started.
    pub fn new(
        connections: Connections,
        config: &Config,
        keys: &InputKeys,
        threads: usize,
    ) -> Result<Self, StartError> {
        let config = &config.with_poses_as_odometry();
        let parameters = config.parameters();
        let engine = starting::engine(config, threads)?;
        let needed = config.raw.engine.needs_odometry();
        let need = if needed { Need::Required } else { Need::Optional };
        let mut mapper = Self {
            connections,
            initial_pose: config.raw.initial_pose,
            first_mode: config.raw.mode,
            jump: parameters.jump,
            map_update_interval: config.raw.map_update_interval,
            synchronizer: synchronizer(config, keys, need),
            engine,
            frames: frames(config, keys),
            map_frame: config.raw.map_frame.clone(),
            view: View::new(),
            gauges: Gauges::default(),
            untold: Vec::new(),
            keeper: None,
        };
        mapper.show_start();
        mapper.renew_estimate(None);
        mapper.publish();
        Ok(mapper)
    }

    /// A map to start from is told before any scan, so that a pose can be pointed at.
    fn show_start(&mut self) {
        self.view.mode = self.engine.mode();
        if self.knows_a_map() {
            self.view.unpublished = Some(Stamp(0));
            self.renew_map();
        }
    }

    /// Whether there is a map to localize in.
    pub(super) fn knows_a_map(&mut self) -> bool {
        self.engine.occupancy().counts().tiles().next().is_some()
    }

    /// Works until the mailbox is closed and empty, or later than it may be.
    pub fn run(mut self) {
        while self.step() == Flow::GoOn {
            self.publish();
            self.checkpoint_if_due();
        }
        self.finish();
    }

    fn step(&mut self) -> Flow {
        if let Some(event) = self.connections.mailbox.urgent(clock::now()) {
            return self.handle(event);
        }
        if let Some(call) = self.synchronizer.next_call() {
            self.make(call);
            return Flow::GoOn;
        }
        let event = self.next_event();
        self.handle(event)
    }

    fn next_event(&self) -> Event {
        let mailbox = &self.connections.mailbox;
        let event = mailbox.take(clock::now());
        event.unwrap_or_else(|| mailbox.wait(self.deadline(), clock::now))
    }

    /// When there is something to do though nothing comes.
    fn deadline(&self) -> Option<Instant> {
        let keeper = self.keeper.as_ref();
        let checkpoint = keeper.and_then(|keeper| keeper.deadline(clock::now(), self.scans()));
        self.synchronizer.deadline().into_iter().chain(checkpoint).min()
    }

    /// Has the state written from now on.
    pub(super) fn keep_state(&mut self, keeper: Keeper) {
        self.keeper = Some(keeper);
    }

    /// Scans that had their verdict.
    pub(super) fn scans(&self) -> u64 {
        self.view.ledger.total()
    }

    fn checkpoint_if_due(&mut self) {
        let scans = self.scans();
        if self.keeper.as_ref().is_some_and(|keeper| keeper.is_due(clock::now(), scans)) {
            self.checkpoint();
        }
    }

    fn checkpoint(&mut self) {
        let (engine, state) = (self.engine.clone(), self.state());
        if let Some(keeper) = &mut self.keeper {
            keeper.write(engine, state);
        }
    }

    fn handle(&mut self, event: Event) -> Flow {
        match event {
            Event::Command(request) => self.obey(request),
            Event::Refusal(refusal) => self.refuse(refusal),
            Event::Mail(mail) => self.feed(mail),
            Event::Expired => self.synchronizer.expire(clock::now(), &self.frames),
            Event::Closed => return Flow::End,
        }
        Flow::GoOn
    }

    fn feed(&mut self, mail: Mail) {
        match mail {
            Mail::Odometry(stamp, odom_from_base) => {
                self.take_odometry(Channel::Messages, stamp, odom_from_base);
            }
            Mail::Pose(pose) => self.take_pose(pose),
            Mail::Transform(transform, kind) => self.take_transform(&transform, kind),
            Mail::Scan(framed) => self.synchronizer.scan(framed, clock::now(), &self.frames),
        }
    }

    fn take_transform(&mut self, transform: &Transform, kind: Kind) {
        if let Err(error) = self.frames.insert(transform, kind) {
            self.connections.inbox.reject(input_of(kind), error.to_string());
            return;
        }
        for (stamp, odom_from_base) in self.frames.new_odometry() {
            match odom_from_base {
                Ok(pose) => self.take_odometry(Channel::Transforms, stamp, pose),
                Err(error) => self.connections.inbox.reject(Input::Tf, error.to_string()),
            }
        }
        self.synchronizer.frames_changed(&self.frames);
    }

    /// A pose without a frame is one in the map: who has no ROS has no frames.
    fn take_pose(&mut self, pose: FramedPose) {
        let FramedPose { stamp, frame, frame_from_base } = pose;
        if !frame.is_empty() && frame.trim_start_matches('/') != self.map_frame {
            let reason = format!("it is a pose in `{frame}`, and not in `{}`", self.map_frame);
            return self.connections.inbox.reject(Input::Pose, reason);
        }
        self.take_odometry(Channel::Messages, stamp, frame_from_base);
    }

    fn take_odometry(&mut self, channel: Channel, stamp: Stamp, odom_from_base: Pose2) {
        if self.synchronizer.odometry(channel, (stamp, odom_from_base), &self.frames) {
            self.follow_odometry();
        }
    }

    /// Between scans the pose follows odometry, which the filter gets with the next scan.
    fn follow_odometry(&mut self) {
        let estimate = &mut self.view.estimate;
        let Some((stamp, odom_from_base)) = self.synchronizer.newest_odometry() else { return };
        let (Some(last), Some(before)) = (estimate.stamp, self.view.odom_from_base) else { return };
        if stamp > last && !self.jump.rejects(before.between(odom_from_base)) {
            estimate.stamp = Some(stamp);
            estimate.pose_in_map = estimate.map_from_odom * odom_from_base;
            self.view.changed = true;
        }
    }

    fn make(&mut self, call: Call) {
        match call {
            Call::Odometry(_, odom_from_base) => self.add_odometry(odom_from_base),
            Call::Scan(ready) if self.view.paused => {
                ready.odom_from_base.into_iter().for_each(|pose| self.add_odometry(pose));
                self.enter(Some(ready.scan.stamp), Verdict::Paused, String::new());
            }
            Call::Scan(ready) => self.add_scan(&ready),
            Call::Refuse(refusal) => self.refuse(refusal),
            Call::BeginOdometry(odom_from_base) => self.begin_odometry(odom_from_base),
        }
    }

    /// The robot is where it was, and odometry counts from there.
    fn begin_odometry(&mut self, odom_from_base: Pose2) {
        let place = in_words(odom_from_base);
        tracing::warn!("odometry begins anew at {place}: it is no motion of the robot");
        self.gauges.odometry_restarts += 1;
        self.engine.forget_odometry();
        self.add_odometry(odom_from_base);
        self.renew_estimate(self.view.estimate.stamp);
    }

    fn add_odometry(&mut self, odom_from_base: Pose2) {
        match self.engine.add_odometry(odom_from_base) {
            OdometryUpdate::Accepted => {}
            OdometryUpdate::JumpRejected => self.gauges.odometry_jumps += 1,
            OdometryUpdate::NotUsable => return,
        }
        self.view.odom_from_base = Some(odom_from_base);
    }

    fn add_scan(&mut self, ready: &ReadyScan) {
        let &ReadyScan { ref scan, ref mount, odom_from_base } = ready;
        // Interpolated odometry passes the jump guard too; the scan's own counts no second time.
        odom_from_base.into_iter().for_each(|pose| self.add_odometry(pose));
        self.view.estimate.has_odometry = odom_from_base.is_some();
        if odom_from_base.is_none() {
            self.view.odom_from_base = None;
            self.gauges.without_odometry += 1;
        }
        self.gauges.laser = Some(*mount);
        let sweep = Sweep { scan, mount, odom_from_base };
        let watch = Stopwatch::start();
        match self.engine.add_scan(&sweep, &mut |_| ()) {
            ScanUpdate::Processed(report) => {
                self.count_time(watch.elapsed().wall, scan.stamp);
                let weak_direction = report.weak_direction;
                self.processed(scan.stamp, report);
                self.view.ledger.enter_processed(scan.stamp, weak_direction);
                self.tell(Verdict::Processed);
            }
            ScanUpdate::Skipped(reason) => {
                let verdict = Verdict::from(reason);
                self.renew_estimate(Some(scan.stamp));
                let detail = match self.engine.obstacle() {
                    Some(obstacle) if verdict == Verdict::NotLocalized => {
                        format!(
                            "{obstacle}; the next scan tries again, or say where the robot is: {SAY_WHERE}"
                        )
                    }
                    _ => detail(verdict, ready),
                };
                self.enter(Some(scan.stamp), verdict, detail);
            }
        }
    }

    fn count_time(&mut self, spent: Duration, stamp: Stamp) {
        push_bounded(&mut self.view.times, spent.as_secs_f64() * 1e3, TIMED_SCANS);
        self.view.milliseconds_per_scan = Spread::of(self.view.times.make_contiguous());
        let driven = self.view.processed.map_or(0.0, |before| stamp.seconds_since(before));
        if driven > 0.0 {
            self.gauges.mapped_s += driven;
            self.gauges.worked_s += spent.as_secs_f64();
        }
        self.view.processed = Some(stamp);
    }

    fn processed(&mut self, stamp: Stamp, report: ScanReport) {
        self.view.resamples += u64::from(report.resampled);
        let hypotheses = self.engine.hypotheses();
        let share = report.matched as f64 / hypotheses.len().max(1) as f64;
        push_bounded(&mut self.gauges.matched, share, RECENT);
        self.view.estimate.particles = hypotheses.into();
        self.view.estimate.covariance = self.engine.covariance();
        let registered = report.registered;
        self.gauges.weak += u64::from(report.weak_direction.is_some());
        self.view.estimate.report = Some(report);
        self.renew_estimate(Some(stamp));
        // A map that stays as it is has a longer path.
        if registered || self.view.mode == Mode::Localization {
            self.view.unpublished = Some(stamp);
        }
        let last = self.view.map.as_ref().map(|map| stamp.seconds_since(map.stamp));
        // A clock that was set back does not stop the map.
        if last.is_none_or(|passed| passed >= self.map_update_interval || passed < 0.0) {
            self.renew_map();
        }
    }

    /// The pose as the filter has it, and odometry that it has not got yet.
    fn renew_estimate(&mut self, stamp: Option<Stamp>) {
        let estimate = &mut self.view.estimate;
        estimate.pose_in_map = self.engine.pose_in_map();
        estimate.map_from_odom = self.engine.map_from_odom();
        let known = self.engine.has_begun() && !self.engine.is_searching();
        estimate.stamp = stamp.filter(|_| known);
        self.view.changed = true;
        self.follow_odometry();
    }

    fn renew_map(&mut self) {
        let Some(stamp) = self.view.unpublished.take() else { return };
        self.view.version += 1;
        self.view.changed = true;
        self.view.map = Some(Arc::new(MapVersion {
            version: self.view.version,
            epoch: self.epoch(),
            stamp,
            occupancy: self.engine.occupancy().clone(),
            occupied_threshold: self.engine.occupied_threshold(),
            path: self.engine.path(),
        }));
    }

    fn epoch(&self) -> u64 {
        self.view.first_epoch + self.engine.map_corrections()
    }

    fn refuse(&mut self, refusal: Refusal) {
        self.enter(refusal.stamp, refusal.verdict, refusal.detail);
    }

    fn enter(&mut self, stamp: Option<Stamp>, verdict: Verdict, detail: String) {
        self.view.ledger.enter(stamp, verdict, detail);
        self.tell(verdict);
    }

    /// Has the last entry of a verdict told.
    fn tell(&mut self, verdict: Verdict) {
        self.view.changed = true;
        if let Some(entry) = self.view.ledger.last().get(&verdict) {
            tracing::trace!(number = entry.number, ?verdict, detail = entry.detail, "scan");
            self.untold.push(entry.clone());
        }
        push_bounded(&mut self.gauges.recent, verdict, RECENT);
    }

    /// Whoever gets the answer finds it in the snapshot, too.
    fn obey(&mut self, request: Request) {
        if let (Command::Checkpoint, Some(keeper)) = (request.command, &mut self.keeper) {
            return keeper.ask(request.reply);
        }
        let (done, changed) = match request.command {
            Command::Checkpoint => {
                ("the state is not kept: neither --state nor state_directory is set".into(), false)
            }
            Command::Pause => self.pause(),
            Command::Resume => self.resume(),
            Command::Reset(pose_in_map) => self.reset(pose_in_map),
            Command::InitialPose(pose_in_map) => self.set_pose(pose_in_map),
            Command::Mode(mode) => self.set_mode(mode),
        };
        tracing::info!(command = ?request.command, done, "command");
        self.view.changed = true;
        self.publish();
        if let Some(keeper) = self.keeper.as_mut().filter(|_| changed) {
            keeper.note_command();
        }
        // Whoever asked may be gone.
        request.reply.send(Done { done, changed }).ok();
    }

    fn pause(&mut self) -> (String, bool) {
        self.renew_map();
        let changed = !std::mem::replace(&mut self.view.paused, true);
        let done = if changed { "mapping is paused" } else { "mapping was paused already" };
        (format!("{done}; slam/cmd/resume goes on"), changed)
    }

    fn resume(&mut self) -> (String, bool) {
        let changed = std::mem::replace(&mut self.view.paused, false);
        let done = if changed { "mapping goes on" } else { "mapping was not paused" };
        (done.to_owned(), changed)
    }

    fn set_mode(&mut self, mode: Mode) -> (String, bool) {
        if matches!(self.engine, Engine::KnownPoses(_)) {
            return ("poses are given to this engine, and it always maps".to_owned(), false);
        }
        if mode == Mode::Localization && self.view.map.is_none() && !self.engine.has_begun() {
            return ("there is no map yet to localize in; mapping goes on".to_owned(), false);
        }
        // The scans so far belong to the map that is handed out from now on.
        self.renew_map();
        let changed = self.engine.mode() != mode;
        self.engine.set_mode(mode);
        self.view.mode = self.engine.mode();
        let done = match mode {
            Mode::Mapping => "scans enter the map",
            Mode::Localization => "the map stays as it is, and poses in it are estimated",
        };
        (if changed { done.to_owned() } else { format!("{done} already") }, changed)
    }

    fn reset(&mut self, pose_in_map: Option<Pose2>) -> (String, bool) {
        let epoch = self.epoch() + 1;
        let pose_in_map = pose_in_map.or(self.initial_pose.and_then(InitialPose::pose));
        self.engine.reset(pose_in_map);
        // Without a map to start from, there is none to localize in.
        let mode = if self.knows_a_map() { self.first_mode } else { Mode::Mapping };
        self.engine.set_mode(mode);
        let before = std::mem::replace(&mut self.view, View::new());
        self.view.ledger = before.ledger;
        self.view.paused = before.paused;
        // To have no map is a version, too.
        self.view.version = before.version + 1;
        self.view.first_epoch = epoch;
        self.gauges.matched.clear();
        self.show_start();
        self.renew_estimate(None);
        let at = match pose_in_map {
            Some(pose) => format!("at {}", in_words(pose)),
            None if self.view.map.is_some() => "where it fits".to_owned(),
            None => "where odometry says".to_owned(),
        };
        let begins = if self.view.map.is_some() { "in the map to start from" } else { "a new map" };
        (format!("map and path are forgotten; the next scan begins {begins} {at}"), true)
    }

    fn set_pose(&mut self, pose_in_map: Pose2) -> (String, bool) {
        if matches!(self.engine, Engine::KnownPoses(_)) {
            return ("poses are given to this engine, and it takes no other".to_owned(), false);
        }
        let mapping = self.engine.has_begun();
        self.engine.set_pose(pose_in_map);
        let stamp = self.view.estimate.stamp;
        self.view.estimate.particles = self.engine.hypotheses().into();
        self.renew_estimate(stamp);
        let place = in_words(pose_in_map);
        if mapping {
            (format!("all hypotheses are moved, so that the robot is at {place}"), true)
        } else {
            let begins = if self.view.map.is_some() { "path" } else { "map" };
            (format!("the {begins} will begin with the robot at {place}"), true)
        }
    }

    fn finish(mut self) {
        if self.keeper.is_none() {
            self.synchronizer.finish(&self.frames);
        }
        while let Some(call) = self.synchronizer.next_call() {
            if self.connections.mailbox.is_over(clock::now()) {
                break;
            }
            self.make(call);
        }
        self.renew_map();
        self.publish();
        self.checkpoint_last();
    }

    /// Scans that wait for their odometry are in the state, and wait on after the restart.
    fn checkpoint_last(&mut self) {
        if let Some(keeper) = &mut self.keeper {
            let (done, written) = oneshot::channel();
            keeper.ask(done);
            self.checkpoint();
            // The thread tells of what goes wrong.
            written.blocking_recv().ok();
        }
    }

    /// Whoever hears of a verdict finds it in the snapshot.
    fn publish(&mut self) {
        if self.connections.mailbox.scans() == 0 && self.synchronizer.ready() == 0 {
            self.renew_map();
        }
        self.publish_gauges();
        if std::mem::take(&mut self.view.changed) {
            self.connections.snapshots.send_replace(Arc::new(self.view.snapshot()));
        }
        for entry in self.untold.drain(..) {
            // Nobody may be listening.
            self.connections.verdicts.send(entry).ok();
        }
    }

    fn publish_gauges(&mut self) {
        let gauges = &mut self.gauges;
        gauges.scans_waiting = self.synchronizer.waiting() + self.synchronizer.ready();
        gauges.channel = self.synchronizer.channel();
        gauges.odometry = self.synchronizer.odometry_counts();
        gauges.scans = self.synchronizer.scan_counts();
        gauges.transforms = self.frames.counts();
        let shared = &self.connections.gauges;
        shared.lock().unwrap_or_else(PoisonError::into_inner).clone_from(gauges);
    }
}

fn synchronizer(config: &Config, keys: &InputKeys, need: Need) -> Synchronizer {
    let raw = &config.raw;
    let (source, sought) = match keys.motion() {
        Input::Pose => (OdometrySource::Auto, Sought::Pose),
        _ if raw.engine == EngineKind::KnownPoses => (raw.odometry_source, Sought::Pose),
        _ => (raw.odometry_source, Sought::Odometry),
    };
    Synchronizer::new(synchronizer::Settings {
        odometry_timeout: Duration::from_secs_f64(raw.odometry_timeout_s),
        most_waiting: raw.scan_queue,
        sweep_time_s: raw.sweep_time_s,
        source,
        sought,
        need,
        odom_key: keys.of(keys.motion()).to_string(),
        tf_path: format!(
            "{} (from `{}` to `{}`)",
            keys.of(Input::Tf),
            raw.odom_frame,
            raw.base_frame
        ),
    })
}

fn frames(config: &Config, keys: &InputKeys) -> Frames {
    let raw = &config.raw;
    let names = FrameNames { base: raw.base_frame.clone(), odom: raw.odom_frame.clone() };
    Frames::new(names, config.laser_mount(), keys.of(Input::TfStatic).to_string())
}

/// Whether the thread goes on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Flow {
    GoOn,
    End,
}

/// What there is to say about a scan that the filter skipped.
fn detail(verdict: Verdict, ready: &ReadyScan) -> String {
    match verdict {
        Verdict::NoUsableBeams => format!(
            "none of its {} beams ends between range_min and range_max and within maxUrange, or \
             with Hector between laser_min_dist and laser_max_dist",
            ready.scan.ranges.len()
        ),
        Verdict::BadOdometry => {
            let Pose2 { x, y, theta } = ready.odom_from_base.unwrap_or_default();
            format!("odometry has the base at x {x} m, y {y} m, yaw {theta} rad")
        }
        _ => String::new(),
    }
}

fn in_words(pose: Pose2) -> String {
    format!("x {:.3} m, y {:.3} m, yaw {:.4} rad", pose.x, pose.y, pose.theta)
}

fn push_bounded<T>(values: &mut VecDeque<T>, value: T, most: usize) {
    if values.len() >= most {
        values.pop_front();
    }
    values.push_back(value);
}
