//! What comes from the mesh: handed on by callbacks that never wait, and decoded by a task.

use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use tokio::sync::Notify;
use zenoh::bytes::ZBytes;
use zenoh::sample::{Sample, SampleKind};

use super::gaps::Gaps;
use super::ledger::Verdict;
use super::mailbox::{Mail, Mailbox};
use super::synchronizer::{FramedScan, Refusal};
use crate::clock;
use crate::config::{Config, Keys};
use crate::convert;
use crate::ros;
use crate::ros::graph::{LASER_SCAN, ODOMETRY, POSE_WITH_COVARIANCE_STAMPED, TF_MESSAGE, WireType};
use crate::slam::pose::Stamp;
use crate::tf::Kind;

/// Bytes of one input that may wait to be decoded.
const MOST_BYTES: usize = 32 << 20;

/// Scans that may wait to be decoded.
const MOST_SCANS: usize = 64;

/// Other samples that may wait to be decoded.
const MOST_OTHERS: usize = 4096;

/// What is listened to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Input {
    /// `sensor_msgs/LaserScan`.
    Scan,
    /// `nav_msgs/Odometry`.
    Odom,
    /// `geometry_msgs/PoseWithCovarianceStamped` or `PoseStamped`: where the base is in the map.
    Pose,
    /// `tf2_msgs/TFMessage`, of frames that move.
    Tf,
    /// `tf2_msgs/TFMessage`, of frames that do not.
    TfStatic,
}

impl Input {
    /// All inputs; a daemon listens to `Odom` or to `Pose`.
    pub const ALL: [Self; 5] = [Self::Scan, Self::Odom, Self::Pose, Self::Tf, Self::TfStatic];

    /// Where messages say how the base moves: given poses or odometry.
    #[must_use]
    pub fn of_motion(config: &Config) -> Self {
        if config.takes_pose_messages() { Self::Pose } else { Self::Odom }
    }

    /// Its name in the configuration and the status.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Scan => "scan",
            Self::Odom => "odom",
            Self::Pose => "pose",
            Self::Tf => "tf",
            Self::TfStatic => "tf_static",
        }
    }

    /// What it carries.
    #[must_use]
    pub const fn wire_type(self) -> WireType {
        match self {
            Self::Scan => LASER_SCAN,
            Self::Odom => ODOMETRY,
            Self::Pose => POSE_WITH_COVARIANCE_STAMPED,
            Self::Tf | Self::TfStatic => TF_MESSAGE,
        }
    }

    /// Its key under the prefix.
    #[must_use]
    pub fn key_in(self, keys: &Keys) -> &str {
        match self {
            Self::Scan => &keys.scan,
            Self::Odom => &keys.odom,
            Self::Pose => &keys.pose,
            Self::Tf => &keys.tf,
            Self::TfStatic => &keys.tf_static,
        }
    }

    const fn most_waiting(self) -> usize {
        match self {
            Self::Scan => MOST_SCANS,
            Self::Odom | Self::Pose | Self::Tf | Self::TfStatic => MOST_OTHERS,
        }
    }
}

/// How much came of an input, and what of it could not be used.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Tally {
    /// Samples that came.
    pub received: u64,
    /// Samples that are not what was expected.
    pub rejected: u64,
    /// Samples dropped because they came faster than they could be decoded.
    pub dropped: u64,
    /// What was wrong with the last that was rejected.
    pub last_rejection: Option<String>,
    /// When the last came.
    pub last: Option<Instant>,
    /// Outages; of transforms, which have many senders, they are not known.
    pub gaps: Gaps,
}

/// A sample as it came.
#[derive(Debug, Clone)]
struct Raw {
    /// In the order of arrival, over all inputs.
    number: u64,
    content: Content,
    encoding: String,
}

/// What a sample holds.
#[derive(Debug, Clone)]
enum Content {
    Payload(ZBytes),
    /// So many bytes that they were let go.
    TooLarge {
        bytes: usize,
        most: usize,
    },
    /// Nothing: it says that there is nothing any more.
    Deleted,
}

impl Content {
    fn of(sample: &Sample, most: usize) -> Self {
        let bytes = sample.payload().len();
        match sample.kind() {
            SampleKind::Delete => Self::Deleted,
            SampleKind::Put if bytes > most => Self::TooLarge { bytes, most },
            SampleKind::Put => Self::Payload(sample.payload().clone()),
        }
    }

    fn len(&self) -> usize {
        match self {
            Self::Payload(payload) => payload.len(),
            Self::TooLarge { .. } | Self::Deleted => 0,
        }
    }
}

#[derive(Debug, Default)]
struct Queue {
    raw: VecDeque<Raw>,
    bytes: usize,
    tally: Tally,
}

#[derive(Debug, Default)]
struct State {
    queues: BTreeMap<Input, Queue>,
    arrivals: u64,
    /// Scans dropped that have had no verdict.
    lost_scans: u64,
    closed: bool,
}

/// What came and is not decoded yet, and how much came.
#[derive(Debug)]
pub struct Inbox {
    max_message_bytes: usize,
    state: Mutex<State>,
    changed: Notify,
}

enum Next {
    Sample(Input, Raw),
    /// One was dropped before it was decoded.
    LostScan,
}

impl Inbox {
    /// Messages of more bytes are counted and not kept.
    #[must_use]
    pub fn new(max_message_bytes: usize) -> Self {
        Self { max_message_bytes, state: Mutex::default(), changed: Notify::new() }
    }

    /// Takes a sample as it came. Never waits longer than it takes to move it.
    pub fn receive(&self, input: Input, sample: &Sample) {
        self.put(input, Content::of(sample, self.max_message_bytes), sample.encoding().to_string());
    }

    fn put(&self, input: Input, content: Content, encoding: String) {
        let mut state = self.lock();
        state.arrivals += 1;
        let number = state.arrivals;
        let queue = state.queues.entry(input).or_default();
        queue.tally.received += 1;
        queue.tally.last = Some(clock::now());
        queue.bytes += content.len();
        queue.raw.push_back(Raw { number, content, encoding });
        let dropped = queue.make_room(input.most_waiting());
        queue.tally.dropped += dropped;
        if input == Input::Scan {
            state.lost_scans += dropped;
        }
        drop(state);
        self.changed.notify_one();
    }

    /// Counts a sample that cannot be used.
    pub fn reject(&self, input: Input, reason: String) {
        tracing::debug!(input = input.name(), reason, "rejected a message");
        let mut state = self.lock();
        let tally = &mut state.queues.entry(input).or_default().tally;
        tally.rejected += 1;
        tally.last_rejection = Some(reason);
    }

    /// Takes the stamp of a message that was decoded.
    fn note(&self, input: Input, stamp: Stamp) {
        self.lock().queues.entry(input).or_default().tally.gaps.note(stamp);
    }

    /// How much came.
    #[must_use]
    pub fn tally(&self, input: Input) -> Tally {
        self.lock().queues.get(&input).map(|queue| queue.tally.clone()).unwrap_or_default()
    }

    /// Nothing comes any more.
    pub fn close(&self) {
        self.lock().closed = true;
        self.changed.notify_one();
    }

    /// Waits for the next sample in the order of arrival; `None` when nothing comes any more.
    async fn next(&self) -> Option<Next> {
        loop {
            {
                let mut state = self.lock();
                if let Some(next) = state.next() {
                    return Some(next);
                }
                if state.closed {
                    return None;
                }
            }
            // One permit is kept, so that nothing is missed between the look and the wait.
            self.changed.notified().await;
        }
    }

    /// A panic of another thread leaves the queues as they were between two operations.
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Queue {
    /// Drops the oldest until few enough are left, and tells how many that were.
    fn make_room(&mut self, most: usize) -> u64 {
        let mut dropped = 0;
        while self.raw.len() > most || self.bytes > MOST_BYTES {
            let Some(oldest) = self.raw.pop_front() else { break };
            self.bytes -= oldest.content.len();
            dropped += 1;
        }
        dropped
    }
}

impl State {
    fn next(&mut self) -> Option<Next> {
        if self.lost_scans > 0 {
            self.lost_scans -= 1;
            return Some(Next::LostScan);
        }
        let first = |queue: &Queue| queue.raw.front().map(|raw| raw.number);
        let waiting = self.queues.iter().filter_map(|(input, queue)| Some((first(queue)?, *input)));
        let (_, input) = waiting.min()?;
        let queue = self.queues.get_mut(&input)?;
        let raw = queue.raw.pop_front()?;
        queue.bytes -= raw.content.len();
        Some(Next::Sample(input, raw))
    }
}

/// Decodes what comes until nothing comes any more.
pub async fn decode(inbox: Arc<Inbox>, mailbox: Arc<Mailbox>) {
    while let Some(next) = inbox.next().await {
        match next {
            Next::LostScan => {
                let detail = "scans came faster than they could be decoded".to_owned();
                mailbox.refuse(Refusal { stamp: None, verdict: Verdict::Overload, detail });
            }
            Next::Sample(input, raw) => {
                let decoder = Decoder { inbox: &inbox, mailbox: &mailbox, encoding: &raw.encoding };
                decoder.take(input, &raw.content);
            }
        }
    }
}

/// Puts what a payload says in the mailbox, or counts that it says nothing.
struct Decoder<'a> {
    inbox: &'a Inbox,
    mailbox: &'a Mailbox,
    encoding: &'a str,
}

impl Decoder<'_> {
    fn take(&self, input: Input, content: &Content) {
        let reason = match content {
            Content::Payload(payload) => return self.decode(input, &payload.to_bytes()),
            Content::TooLarge { bytes, most } => {
                format!("the payload has {bytes} bytes; max_message_bytes allows {most}")
            }
            Content::Deleted => "it is a delete, which is no message".to_owned(),
        };
        match input {
            Input::Scan => self.refuse(None, Verdict::NotDecodable, reason),
            Input::Odom | Input::Pose | Input::Tf | Input::TfStatic => {
                self.inbox.reject(input, reason);
            }
        }
    }

    fn decode(&self, input: Input, bytes: &[u8]) {
        match input {
            Input::Scan => self.scan(bytes),
            Input::Odom => self.odometry(bytes),
            Input::Pose => self.pose(bytes),
            Input::Tf => self.transforms(bytes, Kind::Dynamic),
            Input::TfStatic => self.transforms(bytes, Kind::Static),
        }
    }

    fn scan(&self, bytes: &[u8]) {
        let message = match ros::decode::<ros::LaserScan>(bytes, self.encoding) {
            Ok(message) => message,
            Err(error) => return self.refuse(None, Verdict::NotDecodable, error.to_string()),
        };
        let frame = message.header.frame_id.clone();
        let stamp = convert::stamp(message.header.stamp).ok();
        match convert::scan(message) {
            Ok(scan) => {
                self.inbox.note(Input::Scan, scan.stamp);
                self.mailbox.put(Mail::Scan(FramedScan { scan, frame }));
            }
            Err(error) => self.refuse(stamp, Verdict::BadGeometry, error.to_string()),
        }
    }

    fn refuse(&self, stamp: Option<Stamp>, verdict: Verdict, detail: String) {
        self.inbox.reject(Input::Scan, detail.clone());
        self.mailbox.refuse(Refusal { stamp, verdict, detail });
    }

    fn odometry(&self, bytes: &[u8]) {
        let decoded = ros::decode::<ros::Odometry>(bytes, self.encoding);
        let sample = decoded
            .map_err(|error| error.to_string())
            .and_then(|message| convert::odometry(message).map_err(|error| error.to_string()));
        match sample {
            Ok(sample) => {
                self.inbox.note(Input::Odom, sample.stamp);
                self.mailbox.put(Mail::Odometry(sample.stamp, sample.odom_from_base));
            }
            Err(reason) => self.inbox.reject(Input::Odom, reason),
        }
    }

    fn pose(&self, bytes: &[u8]) {
        let message = match ros::decode_pose(bytes, self.encoding) {
            Ok(message) => message,
            Err(error) => return self.inbox.reject(Input::Pose, error.to_string()),
        };
        match convert::stamped_pose(message) {
            Ok(pose) => {
                self.inbox.note(Input::Pose, pose.stamp);
                self.mailbox.put(Mail::Pose(pose));
            }
            Err(error) => self.inbox.reject(Input::Pose, error.to_string()),
        }
    }

    fn transforms(&self, bytes: &[u8], kind: Kind) {
        let input = input_of(kind);
        let message = match ros::decode::<ros::TfMessage>(bytes, self.encoding) {
            Ok(message) => message,
            Err(error) => return self.inbox.reject(input, error.to_string()),
        };
        for transform in message.transforms {
            match convert::transform(transform) {
                Ok(transform) => self.mailbox.put(Mail::Transform(transform, kind)),
                Err(error) => self.inbox.reject(input, error.to_string()),
            }
        }
    }
}

/// Where transforms of a kind come from.
#[must_use]
pub const fn input_of(kind: Kind) -> Input {
    match kind {
        Kind::Static => Input::TfStatic,
        Kind::Dynamic => Input::Tf,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::daemon::mailbox::Event;

    fn payload(length: usize) -> Content {
        Content::Payload(vec![7; length].into())
    }

    fn put(inbox: &Inbox, input: Input, length: usize) {
        inbox.put(input, payload(length), String::new());
    }

    /// What is in the mailbox after all has been decoded.
    async fn decoded(inbox: Inbox) -> Vec<Verdict> {
        let mailbox = Arc::new(Mailbox::new(4));
        inbox.close();
        decode(Arc::new(inbox), Arc::clone(&mailbox)).await;
        let verdict = |event| match event {
            Event::Refusal(refusal) => refusal.verdict,
            other => panic!("{other:?}"),
        };
        std::iter::from_fn(|| mailbox.take(clock::now()).map(verdict)).collect()
    }

    #[tokio::test]
    async fn scans_that_come_too_fast_are_counted_and_have_a_verdict() {
        let inbox = Inbox::new(4 << 20);
        (0..MOST_SCANS + 3).for_each(|_| put(&inbox, Input::Scan, 10));
        (0..=MOST_OTHERS).for_each(|_| put(&inbox, Input::Odom, 10));
        let tallies = [Input::Scan, Input::Odom].map(|input| inbox.tally(input));
        assert_eq!(tallies.map(|tally| tally.dropped), [3, 1]);
        let verdicts = decoded(inbox).await;
        let count = |verdict| verdicts.iter().filter(|other| **other == verdict).count();
        assert_eq!((count(Verdict::Overload), count(Verdict::NotDecodable)), (3, MOST_SCANS));
    }

    #[tokio::test]
    async fn memory_is_bounded_by_bytes_as_well() {
        let inbox = Inbox::new(4 << 20);
        (0..9).for_each(|_| put(&inbox, Input::Odom, 4 << 20));
        assert_eq!(inbox.tally(Input::Odom).dropped, 1);
        inbox.put(Input::Scan, Content::TooLarge { bytes: 5 << 20, most: 4 << 20 }, String::new());
        inbox.put(Input::Scan, Content::Deleted, String::new());
        assert_eq!(inbox.lock().queues[&Input::Scan].bytes, 0);
        inbox.lock().queues.remove(&Input::Odom);
        assert_eq!(decoded(inbox).await, [Verdict::NotDecodable; 2]);
    }

    #[tokio::test]
    async fn samples_are_decoded_in_the_order_of_arrival() {
        let inbox = Inbox::new(4 << 20);
        let order = [Input::Scan, Input::TfStatic, Input::Odom, Input::Scan, Input::Tf];
        order.iter().for_each(|input| put(&inbox, *input, 1));
        inbox.close();
        let mut decoded = Vec::new();
        while let Some(Next::Sample(input, _)) = inbox.next().await {
            decoded.push(input);
        }
        assert_eq!(decoded, order);
    }

    #[tokio::test]
    async fn any_bytes_are_a_rejection_and_no_panic() {
        let inbox = Inbox::new(4 << 20);
        for input in Input::ALL {
            for length in [0, 1, 3, 4, 5, 100] {
                put(&inbox, input, length);
                inbox.put(input, payload(length), "application/json".to_owned());
            }
        }
        let inbox = Arc::new(inbox);
        inbox.close();
        decode(Arc::clone(&inbox), Arc::new(Mailbox::new(4))).await;
        for input in Input::ALL {
            let tally = inbox.tally(input);
            assert_eq!((tally.received, tally.rejected), (12, 12), "{input:?}");
            assert!(tally.last_rejection.is_some() && tally.last.is_some());
        }
    }
}
