//! Writes what a robot sends and what gmapd makes of it to a file, as it comes.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};

use thiserror::Error;
use tokio::sync::oneshot;
use zenoh::key_expr::OwnedKeyExpr;
use zenoh::pubsub::Subscriber;
use zenoh::sample::{Sample, SampleKind};
use zenoh_ext::{AdvancedSubscriber, AdvancedSubscriberBuilderExt as _, HistoryConfig};

use super::input::Input;
use super::keys::{InputKeys, KeyError, Prefix, key_expression, plain_message};
use crate::clock;
use crate::logs::mcap_writer::{McapRecorder, RecordError, Recordable};
use crate::ros::graph::rmw_zenoh::{Graph, TypeHashes};
use crate::ros::graph::{
    DIAGNOSTIC_ARRAY, FLOAT64, MAP_META_DATA, OCCUPANCY_GRID, PATH, POSE_ARRAY,
    POSE_WITH_COVARIANCE_STAMPED, TF_MESSAGE, WireType,
};
use crate::ros::{self, Message as _};
use crate::slam::pose::Stamp;

/// Messages that may wait to be written.
const MOST_WAITING: usize = 4096;

/// Static transforms a publisher may have told before.
const STATIC_TRANSFORMS: usize = 100;

/// What the daemon publishes, beside `tf`.
const OUTPUTS: [(&str, WireType); 7] = [
    ("map", OCCUPANCY_GRID),
    ("map_metadata", MAP_META_DATA),
    ("pose", POSE_WITH_COVARIANCE_STAMPED),
    ("particlecloud", POSE_ARRAY),
    ("path", PATH),
    ("entropy", FLOAT64),
    ("diagnostics", DIAGNOSTIC_ARRAY),
];

/// Why nothing is recorded, or not to the end.
#[derive(Debug, Error)]
pub enum RecorderError {
    /// A key cannot be used.
    #[error(transparent)]
    Key(#[from] KeyError),
    /// The file is not written.
    #[error(transparent)]
    File(#[from] RecordError),
    /// The thread that writes does not start.
    #[error("cannot start the thread that records")]
    Thread(#[source] std::io::Error),
    /// Zenoh takes no subscriber.
    #[error("cannot subscribe to {key}: {reason}")]
    Subscribe {
        /// The key.
        key: String,
        /// What Zenoh says.
        reason: String,
    },
    /// A bug: the thread ended without a word.
    #[error("the thread that records ended unexpectedly")]
    Ended,
}

/// What was recorded.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Recorded {
    /// The file.
    pub path: PathBuf,
    /// Messages in it.
    pub messages: u64,
    /// Messages that came and are not in it: they came faster than they could be written, or are
    /// neither CDR nor the JSON of their type.
    pub lost: u64,
}

/// A recording that goes on.
#[derive(Debug)]
pub struct Recorder {
    unfinished: PathBuf,
    /// Dropped first at the end, so that nothing is recorded that the daemon does not map.
    inputs: Vec<Subscriber<()>>,
    tf_static: Option<AdvancedSubscriber<()>>,
    outputs: Vec<Subscriber<()>>,
    sender: SyncSender<Item>,
    ended: oneshot::Receiver<Result<Recorded, RecordError>>,
}

#[derive(Debug)]
enum Item {
    Sample(Box<Taken>),
    End,
}

#[derive(Debug)]
struct Taken {
    topic: Arc<str>,
    message_type: &'static str,
    log_time: Stamp,
    sample: Sample,
}

impl Recorder {
    /// Begins to record a robot's inputs and outputs.
    ///
    /// # Errors
    /// When the file cannot be made or a key cannot be used.
    pub async fn start(
        session: &zenoh::Session,
        prefix: &Prefix,
        keys: &InputKeys,
        path: &Path,
    ) -> Result<Self, RecorderError> {
        let file = McapRecorder::create(path)?;
        let unfinished = file.unfinished().to_owned();
        let (sender, items) = sync_channel(MOST_WAITING);
        let lost = Arc::new(AtomicU64::new(0));
        let ended = spawn(file, items, Arc::clone(&lost))?;
        let taps = Taps { session, sender: &sender, lost: &lost };
        let mut inputs = Vec::new();
        for input in [Input::Tf, keys.motion(), Input::Scan] {
            inputs.push(taps.plain(keys.of(input), input.wire_type().name).await?);
        }
        let tf_static = Some(taps.with_history(keys.of(Input::TfStatic)).await?);
        let mut outputs = Vec::new();
        // Who reads scans by ROS 2's own convention publishes by it.
        let domain = Graph::name_in(keys.of(Input::Scan)).map(|(domain, _)| domain);
        let output_key = |name: &str, wire_type: WireType| match domain {
            Some(domain) => {
                let graph = Graph { domain, hashes: TypeHashes::Known };
                key_expression(graph.subscription_key(&prefix.key(name)?, wire_type))
            }
            None => prefix.key(name),
        };
        for (name, wire_type) in OUTPUTS {
            outputs.push(taps.plain(&output_key(name, wire_type)?, wire_type.name).await?);
        }
        // What the daemon adds to the transforms, where it listens to others.
        let own_tf = output_key("tf", TF_MESSAGE)?;
        if own_tf != *keys.of(Input::Tf) {
            outputs.push(taps.plain(&own_tf, TF_MESSAGE.name).await?);
        }
        Ok(Self { unfinished, inputs, tf_static, outputs, sender, ended })
    }

    /// What the file is called until it is finished.
    #[must_use]
    pub fn unfinished(&self) -> &Path {
        &self.unfinished
    }

    /// Records no more inputs.
    pub async fn stop_inputs(&mut self) {
        for subscriber in self.inputs.drain(..) {
            subscriber.undeclare().await.ok();
        }
        if let Some(subscriber) = self.tf_static.take() {
            subscriber.undeclare().await.ok();
        }
    }

    /// Ends the recording.
    ///
    /// # Errors
    /// When the file does not take all of it.
    pub async fn finish(mut self) -> Result<Recorded, RecorderError> {
        self.stop_inputs().await;
        for subscriber in self.outputs.drain(..) {
            subscriber.undeclare().await.ok();
        }
        let sender = self.sender.clone();
        // Where the queue is full, this waits for the disk; a thread that has ended says why below.
        tokio::task::spawn_blocking(move || sender.send(Item::End)).await.ok();
        match self.ended.await {
            Ok(recorded) => Ok(recorded?),
            Err(_) => Err(RecorderError::Ended),
        }
    }
}

/// What subscribers need to hand on what they get.
struct Taps<'a> {
    session: &'a zenoh::Session,
    sender: &'a SyncSender<Item>,
    lost: &'a Arc<AtomicU64>,
}

impl Taps<'_> {
    async fn plain(
        &self,
        key: &OwnedKeyExpr,
        message_type: &'static str,
    ) -> Result<Subscriber<()>, RecorderError> {
        let hand_on = self.hand_on(key, message_type);
        let subscriber = self.session.declare_subscriber(key).callback(hand_on).await;
        subscriber.map_err(|error| failed(key, &error))
    }

    /// Static transforms are told once, perhaps long before.
    async fn with_history(
        &self,
        key: &OwnedKeyExpr,
    ) -> Result<AdvancedSubscriber<()>, RecorderError> {
        let hand_on = self.hand_on(key, ros::TfMessage::TYPE);
        let history =
            HistoryConfig::default().detect_late_publishers().max_samples(STATIC_TRANSFORMS);
        let subscriber = self.session.declare_subscriber(key).callback(hand_on).history(history);
        subscriber.await.map_err(|error| failed(key, &error))
    }

    fn hand_on(
        &self,
        key: &OwnedKeyExpr,
        message_type: &'static str,
    ) -> impl Fn(Sample) + Send + Sync + 'static {
        let (sender, lost) = (self.sender.clone(), Arc::clone(self.lost));
        let name = Graph::name_in(key).map_or(key.as_str(), |(_, name)| name);
        let topic: Arc<str> = format!("/{name}").into();
        move |sample: Sample| {
            if sample.kind() == SampleKind::Delete {
                return;
            }
            let log_time = Stamp(clock::unix_nanoseconds());
            let taken = Taken { topic: Arc::clone(&topic), message_type, log_time, sample };
            if sender.try_send(Item::Sample(Box::new(taken))).is_err() {
                lost.fetch_add(1, Ordering::Relaxed);
            }
        }
    }
}

fn failed(key: &OwnedKeyExpr, error: &zenoh::Error) -> RecorderError {
    RecorderError::Subscribe { key: key.to_string(), reason: plain_message(error) }
}

fn spawn(
    file: McapRecorder,
    items: Receiver<Item>,
    lost: Arc<AtomicU64>,
) -> Result<oneshot::Receiver<Result<Recorded, RecordError>>, RecorderError> {
    let (sender, ended) = oneshot::channel();
    let work = move || {
        let recorded = write(file, &items, &lost);
        if let Err(error) = &recorded {
            tracing::error!("recording ended: {error}");
        }
        // Whoever waited may be gone.
        sender.send(recorded).ok();
    };
    let thread = std::thread::Builder::new().name("recorder".to_owned());
    thread.spawn(work).map_err(RecorderError::Thread)?;
    Ok(ended)
}

fn write(
    mut file: McapRecorder,
    items: &Receiver<Item>,
    lost: &AtomicU64,
) -> Result<Recorded, RecordError> {
    while let Ok(Item::Sample(taken)) = items.recv() {
        let Taken { topic, message_type, log_time, sample } = &*taken;
        let encoding = sample.encoding().to_string();
        let Some(bytes) = cdr(&sample.payload().to_bytes(), message_type, &encoding) else {
            lost.fetch_add(1, Ordering::Relaxed);
            continue;
        };
        let stamp = own_stamp(&bytes, message_type);
        let (log_time, bytes) = (*log_time, bytes.as_slice());
        file.add(&Recordable { topic, message_type, log_time, stamp, bytes })?;
    }
    let messages = file.messages();
    let path = file.finish()?;
    Ok(Recorded { path, messages, lost: lost.load(Ordering::Relaxed) })
}

/// CDR as it came; JSON is converted, for readers of recordings expect CDR.
fn cdr(bytes: &[u8], message_type: &str, encoding: &str) -> Option<Vec<u8>> {
    if matches!(bytes, [0, 0 | 1, _, _, ..]) {
        return Some(bytes.to_vec());
    }
    fn converted<M: ros::Message>(bytes: &[u8], encoding: &str) -> Option<Vec<u8>> {
        ros::decode::<M>(bytes, encoding).ok().map(|message| ros::cdr(&message))
    }
    match message_type {
        ros::LaserScan::TYPE => converted::<ros::LaserScan>(bytes, encoding),
        ros::Odometry::TYPE => converted::<ros::Odometry>(bytes, encoding),
        ros::TfMessage::TYPE => converted::<ros::TfMessage>(bytes, encoding),
        _ => None,
    }
}

/// The stamp a message begins with; of transforms that of the first.
fn own_stamp(bytes: &[u8], message_type: &str) -> Option<Stamp> {
    let place = match message_type {
        ros::Float64::TYPE => return None,
        ros::TfMessage::TYPE => 8,
        _ => 4,
    };
    let number = |place: usize| {
        let number: [u8; 4] = bytes.get(place..place + 4)?.try_into().ok()?;
        Some(if bytes[1] == 0 { i32::from_be_bytes(number) } else { i32::from_le_bytes(number) })
    };
    let (seconds, nanoseconds) = (number(place)?, number(place + 4)?);
    let stamp = Stamp(i64::from(seconds) * 1_000_000_000 + i64::from(nanoseconds));
    (0..1_000_000_000).contains(&nanoseconds).then_some(stamp)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn json_is_recorded_as_cdr_and_cdr_as_it_came() {
        let header = ros::Header {
            stamp: ros::Time { sec: 7, nanosec: 250_000_000 },
            frame_id: "laser".to_owned(),
        };
        let scan = ros::LaserScan { header, ranges: vec![1.0, 2.0], ..ros::LaserScan::default() };
        let (json, bytes) = (ros::json(&scan), ros::cdr(&scan));
        let kind = ros::LaserScan::TYPE;
        assert_eq!(cdr(&json, kind, "application/json").as_deref(), Some(bytes.as_slice()));
        assert_eq!(cdr(&bytes, kind, "").as_deref(), Some(bytes.as_slice()));
        assert_eq!(cdr(b"hello", kind, ""), None);
        assert_eq!(own_stamp(&bytes, kind), Some(Stamp(7_250_000_000)));
        assert_eq!(own_stamp(&bytes[..9], kind), None);
    }

    #[test]
    fn the_stamp_of_transforms_is_that_of_the_first() {
        let header =
            ros::Header { stamp: ros::Time { sec: 3, nanosec: 5 }, frame_id: "odom".to_owned() };
        let transform = ros::TransformStamped { header, ..ros::TransformStamped::default() };
        let bytes = ros::cdr(&ros::TfMessage { transforms: vec![transform] });
        assert_eq!(own_stamp(&bytes, ros::TfMessage::TYPE), Some(Stamp(3_000_000_005)));
        let none = ros::cdr(&ros::TfMessage { transforms: Vec::new() });
        assert_eq!(own_stamp(&none, ros::TfMessage::TYPE), None);
        assert_eq!(own_stamp(&ros::cdr(&ros::Float64 { data: 1.0 }), ros::Float64::TYPE), None);
    }
}
