//! Sends a robot's readings onto the mesh, and hears what becomes of them.

use std::collections::BTreeMap;
use std::time::Duration;

use anyhow::{anyhow, bail};
use gmapd::clock::Stopwatch;
use gmapd::daemon::keys::Prefix;
use gmapd::logs::Reading;
use gmapd::logs::recording::Kind;
use gmapd::playback::{Backlog, Frames, Messages, Room, VerdictMessage};
use gmapd::ros;
use gmapd::slam::pose::Stamp;
use gmapd::slam::scan::LaserMount;
use serde::Deserialize;
use tokio::sync::mpsc::{UnboundedReceiver, unbounded_channel};
use tokio::time::{sleep, timeout};
use zenoh::Session;
use zenoh::bytes::Encoding;
use zenoh::pubsub::{Publisher, Subscriber};
use zenoh::qos::CongestionControl;
use zenoh_ext::{
    AdvancedPublisher, AdvancedPublisherBuilderExt as _, CacheConfig, MissDetectionConfig,
};

use super::mesh;

/// After this long without a verdict the daemon is asked how far it is.
const POLL_PERIOD: Duration = Duration::from_millis(100);

/// A daemon that does nothing for so long is not coming back.
const MOST_SILENCE: Duration = Duration::from_secs(30);

/// Messages of static transforms that are kept for daemons that start later.
const STATIC_TRANSFORMS: usize = 100;

/// For a daemon to take the transforms that come before everything else.
const MOUNT_PATIENCE: Duration = Duration::from_secs(2);

/// A robot as the mesh sees it.
pub(super) struct Feed {
    session: Session,
    status_key: String,
    scan: Publisher<'static>,
    odom: Publisher<'static>,
    tf: Publisher<'static>,
    tf_static: AdvancedPublisher<'static>,
    _verdict_subscriber: Subscriber<()>,
    verdicts: UnboundedReceiver<VerdictMessage>,
    frames: Frames,
    /// Before the first reading; `None` if whoever listens is no gmapd.
    at_start: Option<Progress>,
    last_odometry: Option<ros::Odometry>,
    /// The static transforms sent last.
    last_mount: Vec<u8>,
    backlog: Backlog,
    tally: BTreeMap<String, u64>,
}

/// How far a daemon is, by its status.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Progress {
    verdicts: u64,
    odometry: u64,
    transforms: u64,
}

#[derive(Deserialize)]
struct Status {
    scans: BTreeMap<String, u64>,
    inputs: BTreeMap<String, InputStatus>,
}

#[derive(Deserialize)]
struct InputStatus {
    received: u64,
}

impl Feed {
    /// The robot's publishers; nothing is sent yet.
    pub(super) async fn open(session: &Session, robot: &Prefix) -> anyhow::Result<Self> {
        let (sender, verdicts) = unbounded_channel();
        let verdict_subscriber = session
            .declare_subscriber(robot.key("slam/verdict")?)
            .callback(move |sample| {
                if let Ok(verdict) = serde_json::from_slice(&sample.payload().to_bytes()) {
                    sender.send(verdict).ok();
                }
            })
            .await
            .map_err(|error| anyhow!(error))?;
        Ok(Self {
            session: session.clone(),
            status_key: robot.key("slam/status")?.to_string(),
            scan: publisher(session, robot, "scan").await?,
            odom: publisher(session, robot, "odom").await?,
            tf: publisher(session, robot, "tf").await?,
            tf_static: cached_publisher(session, robot, "tf_static").await?,
            _verdict_subscriber: verdict_subscriber,
            verdicts,
            frames: Frames::default(),
            at_start: None,
            last_odometry: None,
            last_mount: Vec::new(),
            backlog: Backlog::default(),
            tally: BTreeMap::new(),
        })
    }

    /// The key that whoever maps has to subscribe to.
    pub(super) fn scan_key(&self) -> &str {
        self.scan.key_expr().as_str()
    }

    /// Returns when somebody takes scans.
    pub(super) async fn somebody_listens(&self) -> anyhow::Result<()> {
        let listener = self.scan.matching_listener().await.map_err(|error| anyhow!(error))?;
        let status = self.scan.matching_status().await.map_err(|error| anyhow!(error))?;
        let mut matching = status.matching();
        while !matching {
            matching = listener.recv_async().await.map_err(|error| anyhow!(error))?.matching();
        }
        Ok(())
    }

    /// Whether a gmapd is among those who listen; it gets `patience` to start.
    pub(super) async fn finds_daemon(&mut self, patience: Duration) -> anyhow::Result<bool> {
        let watch = Stopwatch::start();
        loop {
            self.at_start = self.progress().await?;
            if self.at_start.is_some() || watch.elapsed().wall > patience {
                return Ok(self.at_start.is_some());
            }
            sleep(POLL_PERIOD).await;
        }
    }

    /// Tells how the laser sits; a daemon gets time to take it before the first scan.
    pub(super) async fn announce(&self, stamp: Stamp, mount: &LaserMount) -> anyhow::Result<()> {
        self.announce_message(ros::cdr(&self.frames.mount(stamp, mount))).await
    }

    async fn announce_message(&self, message: Vec<u8>) -> anyhow::Result<()> {
        let before = if self.at_start.is_some() { self.progress().await? } else { None };
        let put = self.tf_static.put(message).encoding(Encoding::APPLICATION_CDR).await;
        put.map_err(|error| anyhow!(error))?;
        let Some(start) = before else { return Ok(()) };
        let watch = Stopwatch::start();
        while watch.elapsed().wall < MOUNT_PATIENCE {
            if self.progress().await?.is_none_or(|now| now.transforms > start.transforms) {
                break;
            }
            sleep(POLL_PERIOD / 10).await;
        }
        Ok(())
    }

    /// Sends a reading.
    pub(super) async fn send(&mut self, reading: &Reading) -> anyhow::Result<()> {
        let Messages { odometry, scan } = self.frames.messages(reading);
        // Logs may have the odometry of a scan on a line of its own, too.
        if self.last_odometry.as_ref() != Some(&odometry) {
            self.odom.put(ros::cdr(&odometry)).await.map_err(|error| anyhow!(error))?;
            self.backlog.odometry_sent();
            self.last_odometry = Some(odometry);
        }
        if let Some(scan) = scan {
            self.scan.put(ros::cdr(&scan)).await.map_err(|error| anyhow!(error))?;
            self.backlog.scan_sent(reading.stamp);
        }
        self.take_verdicts();
        Ok(())
    }

    /// Sends a message as it was recorded, in ROS 2's bytes.
    pub(super) async fn send_recorded(
        &mut self,
        kind: Kind,
        stamp: Stamp,
        bytes: Vec<u8>,
    ) -> anyhow::Result<()> {
        match kind {
            Kind::LaserScan => {
                self.scan.put(bytes).await.map_err(|error| anyhow!(error))?;
                self.backlog.scan_sent(stamp);
            }
            Kind::Odometry => {
                self.odom.put(bytes).await.map_err(|error| anyhow!(error))?;
                self.backlog.odometry_sent();
            }
            Kind::Transforms => {
                self.tf.put(bytes).await.map_err(|error| anyhow!(error))?;
                self.backlog.odometry_sent();
            }
            // Some tell the same again and again.
            Kind::StaticTransforms if bytes == self.last_mount => {}
            Kind::StaticTransforms => {
                self.last_mount.clone_from(&bytes);
                self.announce_message(bytes).await?;
            }
        }
        self.take_verdicts();
        Ok(())
    }

    /// Returns when the daemon can take a reading with this stamp without losing anything.
    pub(super) async fn has_room(&mut self, stamp: Stamp) -> anyhow::Result<()> {
        self.wait_until(|backlog| backlog.room(stamp) == Room::Free).await
    }

    /// Returns when every scan has its verdict.
    pub(super) async fn settle(&mut self) -> anyhow::Result<()> {
        if self.at_start.is_none() {
            return Ok(());
        }
        self.wait_until(|backlog| backlog.open_scans() == 0).await
    }

    async fn wait_until(&mut self, is_done: impl Fn(&Backlog) -> bool) -> anyhow::Result<()> {
        self.take_verdicts();
        let mut silence = Stopwatch::start();
        while !is_done(&self.backlog) {
            let before = self.backlog.clone();
            match timeout(POLL_PERIOD, self.verdicts.recv()).await {
                Ok(Some(verdict)) => self.take(verdict),
                // Verdicts can be lost on the way, and odometry has none.
                Ok(None) | Err(_) => self.catch_up().await?,
            }
            self.take_verdicts();
            if self.backlog != before {
                silence = Stopwatch::start();
            } else if silence.elapsed().wall > MOST_SILENCE {
                bail!(
                    "{} scans have no verdict for {} s; ask {} what the daemon does",
                    self.backlog.open_scans(),
                    MOST_SILENCE.as_secs(),
                    self.status_key
                );
            }
        }
        Ok(())
    }

    /// Asks the daemon for what its verdicts did not tell.
    async fn catch_up(&mut self) -> anyhow::Result<()> {
        if let (Some(start), Some(now)) = (self.at_start, self.progress().await?) {
            self.backlog.verdicts_given(now.verdicts.saturating_sub(start.verdicts));
            self.backlog.odometry_received(now.odometry.saturating_sub(start.odometry));
        }
        Ok(())
    }

    async fn progress(&self) -> anyhow::Result<Option<Progress>> {
        let Some(answer) = mesh::ask(&self.session, &self.status_key).await? else {
            return Ok(None);
        };
        let Ok(status) = serde_json::from_slice::<Status>(&answer.bytes) else {
            bail!("what answers on {} is no gmapd", self.status_key);
        };
        let received = |input: &str| status.inputs.get(input).map_or(0, |input| input.received);
        Ok(Some(Progress {
            verdicts: status.scans.values().sum(),
            // Transforms may tell odometry, too.
            odometry: received("odom") + received("tf"),
            transforms: received("tf_static"),
        }))
    }

    fn take_verdicts(&mut self) {
        while let Ok(verdict) = self.verdicts.try_recv() {
            self.take(verdict);
        }
    }

    fn take(&mut self, VerdictMessage { stamp, verdict }: VerdictMessage) {
        *self.tally.entry(verdict).or_default() += 1;
        if let Some(stamp) = stamp {
            self.backlog.settled(stamp);
        }
    }

    /// Scans that were sent, and how many of them have had which verdict.
    pub(super) fn tally(&self) -> (u64, &BTreeMap<String, u64>) {
        (self.backlog.scans_sent(), &self.tally)
    }
}

async fn publisher(
    session: &Session,
    robot: &Prefix,
    name: &str,
) -> anyhow::Result<Publisher<'static>> {
    session
        .declare_publisher(robot.key(name)?)
        .encoding(Encoding::APPLICATION_CDR)
        .congestion_control(CongestionControl::Block)
        .await
        .map_err(|error| anyhow!(error))
}

/// Keeps the last samples for daemons that start later.
async fn cached_publisher(
    session: &Session,
    robot: &Prefix,
    name: &str,
) -> anyhow::Result<AdvancedPublisher<'static>> {
    session
        .declare_publisher(robot.key(name)?)
        .congestion_control(CongestionControl::Block)
        .cache(CacheConfig::default().max_samples(STATIC_TRANSFORMS))
        .sample_miss_detection(MissDetectionConfig::default())
        .publisher_detection()
        .await
        .map_err(|error| anyhow!(error))
}
