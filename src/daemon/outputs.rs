//! What the daemon publishes without being asked.
//!
//! Each output is a task that watches the snapshot. A put may block while the network is slow, so
//! large ones are encoded and put on threads for blocking work; small ones are dropped instead.

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use tokio::sync::{broadcast, watch};
use tokio::task::{JoinSet, spawn_blocking};
use tokio::time::MissedTickBehavior;
use zenoh::bytes::Encoding;
use zenoh::key_expr::OwnedKeyExpr;
use zenoh::pubsub::Publisher;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::{Session, Wait as _};
use zenoh_ext::{
    AdvancedPublisher, AdvancedPublisherBuilderExt as _, CacheConfig, MissDetectionConfig,
};

use super::answers::{particle_cloud, pose_message};
use super::diagnostics::diagnostics;
use super::formats::{MapProducts, ProductCache};
use super::ledger::Entry;
use super::map_updates::{LastPut, UpdatesOutput};
use super::message_clock::MessageClock;
use super::ros_node::{Output, RosNode, Signature};
use super::selector::Topic;
use super::serving::{AskStatus, ServingError, Settings};
use super::snapshot::Snapshot;
use super::tiles::TileStore;
use super::tiles::publishing::TilesOutput;
use crate::clock::Stopwatch;
use crate::convert;
use crate::ros;
use crate::ros::graph::{
    DIAGNOSTIC_ARRAY, FLOAT64, MAP_META_DATA, OCCUPANCY_GRID, OCCUPANCY_GRID_UPDATE, PATH,
    POSE_ARRAY, POSE_WITH_COVARIANCE_STAMPED, Qos, TF_MESSAGE, WireType,
};
use crate::slam::pose::Pose2;

/// A map that comes while another is on its way is passed over. When nothing newer has come for
/// this long, the newest is sent once more, so that the last one of a drive arrives.
const AGAIN: Duration = Duration::from_secs(5);

/// How often it is looked whether somebody takes the map, beside being told: who leaves and comes
/// back at once may not be told of.
const LOOK: Duration = Duration::from_secs(1);

/// How soon a subscriber that missed the last map hears that there is one.
const HEARTBEAT: Duration = Duration::from_millis(500);

const DIAGNOSTICS_PERIOD: Duration = Duration::from_secs(1);

type Snapshots = watch::Receiver<Arc<Snapshot>>;

/// Declares publishers and starts the tasks that use them.
pub(super) struct Declare<'a> {
    pub(super) session: &'a Session,
    /// Learns of each publisher of messages.
    pub(super) node: &'a mut RosNode,
    /// Tells those who tell what changed since.
    pub(super) last_put: LastPut,
}

impl Declare<'_> {
    /// `map`, `map_metadata` and `path`, which change with the version of the map.
    pub(super) async fn maps(
        &mut self,
        settings: &Settings,
        snapshots: &Snapshots,
        products: &Arc<ProductCache>,
        tasks: &mut JoinSet<()>,
    ) -> Result<(), ServingError> {
        for kind in [Retained::Map, Retained::Metadata, Retained::Path] {
            let (publisher, signature) = self.retaining(kind).await?;
            let output = RetainedOutput {
                kind,
                publisher: Arc::new(publisher),
                signature,
                products: products.clone(),
                last_put: matches!(kind, Retained::Map).then(|| self.last_put.clone()),
                interval: settings.map_update_interval,
            };
            tasks.spawn(output.run(snapshots.clone()));
        }
        Ok(())
    }

    /// `slam/tiles`.
    pub(super) async fn tiles(
        &self,
        settings: &Settings,
        snapshots: &Snapshots,
        tiles: Arc<TileStore>,
        tasks: &mut JoinSet<()>,
    ) -> Result<(), ServingError> {
        let key = self.node.prefix().key(Topic::Tiles.name())?;
        let publisher = self
            .session
            .declare_publisher(key.clone())
            .encoding(Encoding::APPLICATION_OCTET_STREAM)
            // What is dropped is asked for by those who miss it. A priority of its own: behind the
            // map, which waits for its place, it would wait as well, for whoever does not read.
            .congestion_control(CongestionControl::Drop)
            .priority(Priority::Background)
            .await;
        let publisher = Arc::new(declared(key, publisher)?);
        let output = TilesOutput { publisher, tiles, interval: settings.map_update_interval };
        tasks.spawn(output.run(snapshots.clone()));
        Ok(())
    }

    /// `map_updates`.
    pub(super) async fn map_updates(
        &mut self,
        settings: &Settings,
        snapshots: &Snapshots,
        products: Arc<ProductCache>,
        tasks: &mut JoinSet<()>,
    ) -> Result<(), ServingError> {
        let output = self.node.output("map_updates", OCCUPANCY_GRID_UPDATE, Qos::reliable(10))?;
        let Output { key, encoding, signature } = output;
        let publisher = self
            .session
            .declare_publisher(key.clone())
            .encoding(encoding)
            // As the map, and in one queue with it: a rectangle goes with the map before it.
            .congestion_control(CongestionControl::BlockFirst)
            .priority(Retained::Map.priority())
            .await;
        let output = UpdatesOutput {
            publisher: Arc::new(declared(key, publisher)?),
            signature,
            products,
            last_put: self.last_put.subscribe(),
            map_frame: settings.map_frame.clone(),
            interval: settings.map_update_interval,
        };
        tasks.spawn(output.run(snapshots.clone()));
        Ok(())
    }

    /// `pose`, `entropy` and `particlecloud`.
    pub(super) async fn estimates(
        &mut self,
        settings: &Settings,
        snapshots: &Snapshots,
        tasks: &mut JoinSet<()>,
    ) -> Result<(), ServingError> {
        let outputs = EstimateOutputs {
            pose: self.prompt("pose", POSE_WITH_COVARIANCE_STAMPED, Qos::reliable(10)).await?,
            entropy: self.plain("entropy", FLOAT64).await?,
            particles: self.plain("particlecloud", POSE_ARRAY).await?,
            map_frame: settings.map_frame.clone(),
            period: settings.transform_publish_period,
        };
        tasks.spawn(outputs.run(snapshots.clone()));
        Ok(())
    }

    /// `tf`, unless it is switched off.
    pub(super) async fn transform(
        &mut self,
        settings: Settings,
        snapshots: Snapshots,
        tasks: &mut JoinSet<()>,
    ) -> Result<(), ServingError> {
        if !settings.transform_publish_period.is_zero() {
            let publisher = self.prompt("tf", TF_MESSAGE, Qos::reliable(100)).await?;
            tasks.spawn(publish_transform(publisher, settings, snapshots));
        }
        Ok(())
    }

    /// `diagnostics`.
    pub(super) async fn diagnostics(
        &mut self,
        status: AskStatus,
        tasks: &mut JoinSet<()>,
    ) -> Result<(), ServingError> {
        let publisher = self.plain("diagnostics", DIAGNOSTIC_ARRAY).await?;
        tasks.spawn(publish_diagnostics(publisher, self.node.prefix().to_string(), status));
        Ok(())
    }

    /// `slam/verdict`.
    pub(super) async fn verdicts(
        &self,
        verdicts: broadcast::Receiver<Entry>,
        tasks: &mut JoinSet<()>,
    ) -> Result<(), ServingError> {
        let key = self.node.prefix().key("slam/verdict")?;
        let publisher = self
            .session
            .declare_publisher(key.clone())
            .encoding(Encoding::APPLICATION_JSON)
            // Who feeds a log at full speed waits for the newest, so it must arrive.
            .congestion_control(CongestionControl::Block)
            .await;
        tasks.spawn(publish_verdicts(declared(key, publisher)?, verdicts));
        Ok(())
    }

    /// A publisher of small messages; of those that do not fit, the newest is dropped. No message
    /// that waits for its place has their priority: they would wait behind it for a client that
    /// does not read.
    async fn plain(
        &mut self,
        name: &'static str,
        wire_type: WireType,
    ) -> Result<MessagePublisher, ServingError> {
        let output = self.node.output(name, wire_type, Qos::reliable(10))?;
        let Output { key, encoding, signature } = output;
        let publisher = self.session.declare_publisher(key.clone()).encoding(encoding);
        let publisher = publisher.congestion_control(CongestionControl::Drop);
        let publisher = publisher.priority(Priority::InteractiveLow).await;
        Ok(MessagePublisher { name, publisher: declared(key, publisher)?, signature })
    }

    /// As [`Self::plain`], for messages that are of use at once or never.
    async fn prompt(
        &mut self,
        name: &'static str,
        wire_type: WireType,
        qos: Qos,
    ) -> Result<MessagePublisher, ServingError> {
        let Output { key, encoding, signature } = self.node.output(name, wire_type, qos)?;
        let publisher = self.session.declare_publisher(key.clone()).encoding(encoding);
        let publisher = publisher.congestion_control(CongestionControl::Drop).express(true);
        let publisher = publisher.priority(Priority::InteractiveHigh).await;
        Ok(MessagePublisher { name, publisher: declared(key, publisher)?, signature })
    }

    /// A publisher whose last sample is kept for who comes later, as ROS' transient local is.
    async fn retaining(
        &mut self,
        kind: Retained,
    ) -> Result<(AdvancedPublisher<'static>, Signature), ServingError> {
        let output = self.node.output(kind.name(), kind.wire_type(), Qos::latched(1))?;
        let Output { key, encoding, signature } = output;
        let publisher = self
            .session
            .declare_publisher(key.clone())
            .encoding(encoding)
            // A map goes out in pieces. Those that may be dropped are, and then none of it arrives;
            // this one waits for its place, and only the next is dropped meanwhile.
            .congestion_control(CongestionControl::BlockFirst)
            .priority(kind.priority())
            .cache(CacheConfig::default().max_samples(1))
            .sample_miss_detection(MissDetectionConfig::default().sporadic_heartbeat(HEARTBEAT))
            .publisher_detection()
            .await;
        Ok((declared(key, publisher)?, signature))
    }
}

fn declared<P>(key: OwnedKeyExpr, publisher: Result<P, zenoh::Error>) -> Result<P, ServingError> {
    publisher.map_err(|source| ServingError::Declare { key, source })
}

/// Publishes messages of one type.
struct MessagePublisher {
    name: &'static str,
    publisher: Publisher<'static>,
    signature: Signature,
}

impl MessagePublisher {
    async fn put<M: ros::Message>(&self, message: &M) {
        let put = self.publisher.put(ros::cdr(message)).attachment(self.signature.next());
        tell(self.name, put.await);
    }

    async fn is_wanted(&self) -> bool {
        self.publisher.matching_status().await.is_ok_and(|status| status.matching())
    }
}

/// What is kept for subscribers that come later.
#[derive(Debug, Clone, Copy)]
enum Retained {
    Map,
    Metadata,
    Path,
}

impl Retained {
    const fn name(self) -> &'static str {
        match self {
            Self::Map => "map",
            Self::Metadata => "map_metadata",
            Self::Path => "path",
        }
    }

    const fn wire_type(self) -> WireType {
        match self {
            Self::Map => OCCUPANCY_GRID,
            Self::Metadata => MAP_META_DATA,
            Self::Path => PATH,
        }
    }

    /// One message of a priority can wait for its place, so each kind has its own: with a new
    /// version all go out at once, and the smaller ones would be dropped behind the map.
    const fn priority(self) -> Priority {
        match self {
            Self::Map => Priority::DataLow,
            Self::Path => Priority::Data,
            Self::Metadata => Priority::DataHigh,
        }
    }

    fn encode(self, products: &MapProducts) -> Bytes {
        match self {
            Self::Map => products.cdr(),
            Self::Metadata => ros::cdr(&products.metadata()).into(),
            Self::Path => products.path_excerpt(),
        }
    }

    /// What is the same as long as nothing new is to be told.
    fn content(self, products: &MapProducts) -> String {
        match self {
            Self::Map | Self::Metadata => products.label().sha256.clone(),
            Self::Path => products.version().to_string(),
        }
    }
}

/// Publishes one product of the map when it has changed and somebody takes it.
///
/// Nothing is encoded for nobody. A subscriber that comes when there was none, late or first ever,
/// makes the publisher match, and then the newest is put: it receives that, or finds it in the
/// cache. From then on the cache is up to date for those that come after it.
struct RetainedOutput {
    kind: Retained,
    publisher: Arc<AdvancedPublisher<'static>>,
    signature: Signature,
    products: Arc<ProductCache>,
    /// For the whole map.
    last_put: Option<LastPut>,
    interval: Duration,
}

impl RetainedOutput {
    async fn run(self, mut snapshots: Snapshots) {
        let Ok(matching) = self.publisher.matching_listener().await else { return };
        let mut content = None;
        let mut version = 0;
        let mut resting = false;
        let rest = tokio::time::sleep(Duration::ZERO);
        let again = tokio::time::sleep(Duration::ZERO);
        tokio::pin!(rest, again);
        let mut waits_for_again = false;
        loop {
            let mut repeats = false;
            tokio::select! {
                changed = snapshots.changed() => if changed.is_err() { return },
                matched = matching.recv_async() => match matched {
                    // Who has just come does not wait for the next map.
                    Ok(_) => resting = false,
                    Err(_) => return,
                },
                () = &mut rest, if resting => resting = false,
                () = &mut again, if waits_for_again => (waits_for_again, repeats) = (false, true),
            }
            let snapshot = snapshots.borrow_and_update().clone();
            let Some(newest) = &snapshot.map else { continue };
            if resting || (newest.version == version && !repeats) {
                continue;
            }
            resting = true;
            if self.is_wanted().await {
                version = newest.version;
                let last = content.take().filter(|_| !repeats);
                let products = self.products.of(Some(newest));
                content = self.put(products.clone(), last).await;
                self.tell_put(Some(products));
                rest.set(tokio::time::sleep(self.interval));
                again.set(tokio::time::sleep(self.interval + AGAIN));
                waits_for_again = !repeats;
            } else {
                self.tell_put(None);
                rest.set(tokio::time::sleep(LOOK));
            }
        }
    }

    fn tell_put(&self, products: Option<Arc<MapProducts>>) {
        if let Some(last_put) = &self.last_put {
            last_put.send_replace(products);
        }
    }

    async fn is_wanted(&self) -> bool {
        self.publisher.matching_status().await.is_ok_and(|status| status.matching())
    }

    /// Puts a version whose content is not `last`; returns the content that was put last.
    async fn put(&self, products: Arc<MapProducts>, last: Option<String>) -> Option<String> {
        let (kind, publisher) = (self.kind, self.publisher.clone());
        let signature = self.signature.clone();
        let put = move || {
            let content = kind.content(&products);
            if last.as_ref() != Some(&content) {
                let put = publisher.put(kind.encode(&products)).attachment(signature.next());
                tell(kind.name(), put.wait());
            }
            Some(content)
        };
        spawn_blocking(put).await.ok().flatten()
    }
}

/// Publishes where the robot is, and what the particles think.
struct EstimateOutputs {
    pose: MessagePublisher,
    entropy: MessagePublisher,
    particles: MessagePublisher,
    map_frame: String,
    /// Between two publications at least.
    period: Duration,
}

impl EstimateOutputs {
    async fn run(self, mut snapshots: Snapshots) {
        let mut last = None;
        let mut particles: Arc<[Pose2]> = Arc::new([]);
        snapshots.mark_changed();
        while snapshots.changed().await.is_ok() {
            let snapshot = snapshots.borrow_and_update().clone();
            let estimate = &snapshot.estimate;
            let now = (estimate.stamp, estimate.pose_in_map);
            let is_new = last.replace(now) != Some(now);
            if is_new && let Some(pose) = pose_message(estimate, &self.map_frame) {
                self.pose.put(&pose).await;
            }
            // With every processed scan the particles are other ones.
            if !Arc::ptr_eq(&particles, &estimate.particles) && !estimate.particles.is_empty() {
                particles = estimate.particles.clone();
                self.put_particles(&snapshot).await;
            }
            if is_new {
                tokio::time::sleep(self.period).await;
            }
        }
    }

    async fn put_particles(&self, snapshot: &Snapshot) {
        let estimate = &snapshot.estimate;
        if let Some(report) = &estimate.report {
            self.entropy.put(&ros::Float64 { data: report.entropy }).await;
        }
        if self.particles.is_wanted().await {
            self.particles.put(&particle_cloud(estimate, &self.map_frame)).await;
        }
    }
}

/// Sends map to odom in steady steps, whether or not scans come: odometry goes on without them.
async fn publish_transform(
    publisher: MessagePublisher,
    settings: Settings,
    mut snapshots: Snapshots,
) {
    let ahead_ns = (settings.tf_delay_s * 1e9) as i64;
    let running = Stopwatch::start();
    let mut clock = MessageClock::default();
    let mut ticks = tokio::time::interval(settings.transform_publish_period);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Skip);
    snapshots.mark_changed();
    loop {
        tokio::select! {
            changed = snapshots.changed() => {
                if changed.is_err() {
                    return;
                }
                if let Some(stamp) = snapshots.borrow_and_update().estimate.stamp {
                    clock.hear(stamp, running.elapsed().wall);
                }
            }
            _ = ticks.tick() => {
                let Some(stamp) = clock.tell(running.elapsed().wall, ahead_ns) else { continue };
                let header = convert::header(stamp, &settings.map_frame);
                let estimate = snapshots.borrow().estimate.clone();
                let transform = if estimate.has_odometry {
                    convert::transform_stamped(header, &settings.odom_frame, estimate.map_from_odom)
                } else {
                    convert::transform_stamped(header, &settings.base_frame, estimate.pose_in_map)
                };
                let message = ros::TfMessage { transforms: vec![transform] };
                publisher.put(&message).await;
            }
        }
    }
}

async fn publish_diagnostics(publisher: MessagePublisher, robot: String, status: AskStatus) {
    let mut ticks = tokio::time::interval(DIAGNOSTICS_PERIOD);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Skip);
    loop {
        ticks.tick().await;
        let message = diagnostics(&status.status(), &robot);
        publisher.put(&message).await;
    }
}

/// Zenoh drops what nobody subscribes to, before it is sent.
async fn publish_verdicts(publisher: Publisher<'static>, mut verdicts: broadcast::Receiver<Entry>) {
    let publisher = Arc::new(publisher);
    loop {
        let entry = match verdicts.recv().await {
            Ok(entry) => entry,
            // The oldest were overwritten; those that are left, up to the newest, are sent.
            Err(broadcast::error::RecvError::Lagged(_)) => continue,
            Err(broadcast::error::RecvError::Closed) => return,
        };
        let json = serde_json::to_vec(&entry).expect("memory takes every write");
        let publisher = publisher.clone();
        let put = spawn_blocking(move || tell("slam/verdict", publisher.put(json).wait()));
        put.await.ok();
    }
}

/// What is lost here is lost with the session, which says so itself.
fn tell(output: &str, put: Result<(), zenoh::Error>) {
    if let Err(error) = put {
        tracing::debug!(output, %error, "not published");
    }
}
