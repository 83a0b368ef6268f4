//! Questions to answers: from the snapshot, and never by waiting for the filter, except commands.

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use nalgebra::Matrix3;
use serde::Serialize;
use thiserror::Error;
use tokio::runtime::Handle;
use tokio::sync::{mpsc, oneshot, watch};
use zenoh::bytes::Encoding;

use super::command::{Command, Done, Request};
use super::formats::{EmptyMap, FormatError, MapProducts, ProductCache};
use super::limits::Reason;
use super::save::{SaveError, SaveName, Saver};
use super::selector::{
    MapFormat, MessageFormat, PathFormat, Question, RegionForm, RegionQuestion, SelectorError,
};
use super::serving::{AskStatus, Settings};
use super::snapshot::{Estimate, Snapshot};
use super::tiles::{TileSet, TileStore};
use crate::convert;
use crate::map::region::RegionError;
use crate::ros;
use crate::slam::path::Path;
use crate::slam::pose::{Pose2, Stamp};
use crate::timeline::Interpolate as _;

/// A command waits for the scan that is being processed, which takes milliseconds; whoever asked
/// waits ten seconds, as Zenoh's queries do.
const LONGEST_COMMAND: Duration = Duration::from_secs(5);

/// What a reply carries.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Answer {
    /// One after the other; mostly there is one.
    pub(super) payloads: Vec<Bytes>,
    pub(super) encoding: Encoding,
    pub(super) attachment: Option<Bytes>,
}

/// Why a question gets an error reply: one sentence for whoever asked.
#[derive(Debug, Error)]
pub(super) enum Refusal {
    #[error(transparent)]
    Selector(#[from] SelectorError),
    #[error(transparent)]
    Format(#[from] FormatError),
    #[error("the pose is not known yet: no scan and no odometry has come")]
    NoPose,
    #[error("there is no trajectory yet: no scan has been processed")]
    NoTrajectory,
    #[error(
        "at={} is outside of the trajectory, which is from {} to {}",
        seconds(*at), seconds(*from), seconds(*to)
    )]
    OutsideTrajectory { at: Stamp, from: Stamp, to: Stamp },
    #[error("the entropy is not known yet: no scan has been processed")]
    NoEntropy,
    #[error(transparent)]
    Save(#[from] SaveError),
    #[error("{0}")]
    NotDone(String),
    #[error("a command is not done by a wildcard; ask {0} itself")]
    Wildcard(&'static str),
    #[error("{0} is switched off on this robot: `commands` in its configuration does not have it")]
    SwitchedOff(&'static str),
    #[error("{0} commands were given in this second already; ask again")]
    TooManyCommands(u32),
    #[error(
        "the answer has {bytes} bytes, and max_reply_bytes allows {most}; ask for a part with \
         bbox=, or for larger cells with res="
    )]
    TooLarge { bytes: usize, most: usize },
    #[error(
        "answers of {bytes} bytes are on their way already, and max_bytes_in_flight allows {most} \
         with this one; ask again"
    )]
    TooManyBytes { bytes: usize, most: usize },
    #[error("{0} queries are being answered already; ask again")]
    TooMany(usize),
    #[error("too many commands are waiting already; ask again")]
    CommandsWaiting,
    #[error("the filter did not answer within {} s; the command may still be done", .0.as_secs())]
    NoReply(Duration),
    #[error("the daemon is stopping; the command was not done")]
    Stopping,
}

impl Refusal {
    /// The limit that it is beyond, if it is.
    pub(super) const fn reason(&self) -> Option<Reason> {
        match self {
            Self::Wildcard(_) => Some(Reason::Wildcard),
            Self::SwitchedOff(_) => Some(Reason::SwitchedOff),
            Self::TooManyCommands(_) | Self::CommandsWaiting => Some(Reason::TooManyCommands),
            Self::TooMany(_) => Some(Reason::TooManyQueries),
            Self::TooLarge { .. }
            | Self::Format(FormatError::Region(
                RegionError::TooMuch { .. } | RegionError::TooLong(_),
            )) => Some(Reason::TooLarge),
            Self::TooManyBytes { .. } => Some(Reason::TooManyBytes),
            _ => None,
        }
    }
}

/// As `at=` takes them.
fn seconds(stamp: Stamp) -> String {
    let sign = if stamp.0 < 0 { "-" } else { "" };
    let nanoseconds = stamp.0.unsigned_abs();
    format!("{sign}{}.{:09}", nanoseconds / 1_000_000_000, nanoseconds % 1_000_000_000)
}

/// Knows where answers come from.
#[derive(Debug)]
pub(super) struct Responder {
    snapshots: watch::Receiver<Arc<Snapshot>>,
    status: AskStatus,
    commands: mpsc::Sender<Request>,
    products: Arc<ProductCache>,
    tiles: Arc<TileStore>,
    saver: Saver,
    map_frame: String,
    max_reply_bytes: usize,
}

impl Responder {
    pub(super) fn new(
        settings: &Settings,
        run: u64,
        snapshots: watch::Receiver<Arc<Snapshot>>,
        status: AskStatus,
        commands: mpsc::Sender<Request>,
    ) -> Self {
        let tiles = TileSet::new(run, settings.resolution);
        let empty = EmptyMap { frame: settings.map_frame.clone(), resolution: settings.resolution };
        Self {
            tiles: Arc::new(TileStore::new(tiles, snapshots.clone())),
            snapshots,
            status,
            commands,
            products: Arc::new(ProductCache::new(empty)),
            saver: Saver::new(settings.save_directory.clone()),
            map_frame: settings.map_frame.clone(),
            max_reply_bytes: settings.limits.max_reply_bytes,
        }
    }

    /// The encoded maps, for those who publish them.
    pub(super) fn products(&self) -> Arc<ProductCache> {
        self.products.clone()
    }

    /// The tiles, for those who publish them.
    pub(super) fn tiles(&self) -> Arc<TileStore> {
        self.tiles.clone()
    }

    /// Answers; blocks while something is encoded, written, or done by the filter.
    pub(super) fn answer(&self, question: &Question) -> Result<Answer, Refusal> {
        let snapshot = self.snapshots.borrow().clone();
        match question {
            Question::Map(format) => self.map(&snapshot, *format),
            Question::DynamicMap => {
                self.products.note_asked();
                let payloads = vec![self.products_of(&snapshot).cdr()];
                let encoding = cdr_of::<ros::GetMapResponse>();
                Ok(Answer { payloads, encoding, attachment: None })
            }
            Question::Region(question) => self.region(&snapshot, question),
            Question::MapMetadata(format) => {
                let products = self.products_of(&snapshot);
                let attachment = Some(products.attachment());
                Ok(Answer { attachment, ..message(&products.metadata(), *format) })
            }
            Question::Pose { at, format } => Ok(message(&self.pose(&snapshot, *at)?, *format)),
            Question::Path(format) => Ok(Answer {
                payloads: vec![self.products_of(&snapshot).path_in(*format)],
                encoding: path_encoding(*format),
                attachment: None,
            }),
            Question::ParticleCloud(format) => {
                Ok(message(&particle_cloud(&snapshot.estimate, &self.map_frame), *format))
            }
            Question::Entropy(format) => {
                let report = snapshot.estimate.report.as_ref().ok_or(Refusal::NoEntropy)?;
                Ok(message(&ros::Float64 { data: report.entropy }, *format))
            }
            Question::Tiles(question) => Ok(Answer {
                payloads: self.tiles.newest(|tiles| tiles.answer(question)),
                encoding: Encoding::APPLICATION_OCTET_STREAM,
                attachment: None,
            }),
            Question::Status => Ok(json(&self.status.status())),
            Question::Reset(pose) => self.command(Command::Reset(*pose)),
            Question::Pause => self.command(Command::Pause),
            Question::Resume => self.command(Command::Resume),
            Question::InitialPose(pose) => self.command(Command::InitialPose(*pose)),
            Question::Checkpoint => self.checkpoint(),
            Question::Mode(mode) => self.command(Command::Mode(*mode)),
            Question::Save(name) => self.save(&snapshot, name),
        }
    }

    fn products_of(&self, snapshot: &Snapshot) -> Arc<MapProducts> {
        self.products.of(snapshot.map.as_ref())
    }

    fn map(&self, snapshot: &Snapshot, format: MapFormat) -> Result<Answer, Refusal> {
        self.products.note_asked();
        let products = self.products_of(snapshot);
        Ok(Answer {
            payloads: vec![products.map(format, snapshot.estimate.pose_in_map)?],
            encoding: map_encoding(format),
            attachment: Some(products.attachment()),
        })
    }

    fn region(&self, snapshot: &Snapshot, question: &RegionQuestion) -> Result<Answer, Refusal> {
        let products = self.products_of(snapshot);
        let (payload, encoding) = match &question.form {
            RegionForm::Layers(layers) => {
                let text = products.layers(question, layers, self.max_reply_bytes)?;
                (text, Encoding::APPLICATION_JSON)
            }
            RegionForm::Map(format) => {
                let region = products.region(question, self.max_reply_bytes)?;
                let robot_in_map = snapshot.estimate.pose_in_map;
                (region.map(*format, robot_in_map)?, map_encoding(*format))
            }
        };
        Ok(Answer { payloads: vec![payload], encoding, attachment: Some(products.attachment()) })
    }

    fn pose(
        &self,
        snapshot: &Snapshot,
        at: Option<Stamp>,
    ) -> Result<ros::PoseWithCovarianceStamped, Refusal> {
        let estimate = &snapshot.estimate;
        let Some(at) = at else {
            return pose_message(estimate, &self.map_frame).ok_or(Refusal::NoPose);
        };
        let path = snapshot.map.as_ref().map(|version| version.path.clone()).unwrap_or_default();
        let pose_in_map = pose_at(&path, estimate, at)?;
        // How sure the past is, is not known: the covariance stays zero.
        let pose = convert::pose_with_covariance(pose_in_map, &Matrix3::zeros());
        Ok(ros::PoseWithCovarianceStamped { header: convert::header(at, &self.map_frame), pose })
    }

    fn checkpoint(&self) -> Result<Answer, Refusal> {
        match self.done(Command::Checkpoint)? {
            done if done.changed => Ok(json(&done)),
            done => Err(Refusal::NotDone(done.done)),
        }
    }

    fn command(&self, command: Command) -> Result<Answer, Refusal> {
        Ok(json(&self.done(command)?))
    }

    fn done(&self, command: Command) -> Result<Done, Refusal> {
        let (reply, answer) = oneshot::channel();
        self.commands.try_send(Request { command, reply }).map_err(|error| match error {
            mpsc::error::TrySendError::Full(_) => Refusal::CommandsWaiting,
            mpsc::error::TrySendError::Closed(_) => Refusal::Stopping,
        })?;
        let answer = Handle::current()
            .block_on(async { tokio::time::timeout(LONGEST_COMMAND, answer).await });
        match answer {
            Ok(Ok(done)) => Ok(done),
            Ok(Err(_)) => Err(Refusal::Stopping),
            Err(_) => Err(Refusal::NoReply(LONGEST_COMMAND)),
        }
    }

    fn save(&self, snapshot: &Snapshot, name: &SaveName) -> Result<Answer, Refusal> {
        let products = self.products_of(snapshot);
        Ok(json(&self.saver.save(name, &products)?))
    }
}

/// The pose on the corrected trajectory, which ends where the robot is now.
fn pose_at(path: &Path, estimate: &Estimate, at: Stamp) -> Result<Pose2, Refusal> {
    let now = estimate.stamp.map(|stamp| (stamp, estimate.pose_in_map));
    let mut points = path.iter().chain(now).rev();
    let Some((to, pose)) = points.next() else { return Err(Refusal::NoTrajectory) };
    let mut later = (to, pose);
    // From the newest back: after a clock was set back, stamps occur twice.
    loop {
        if later.0 == at {
            return Ok(later.1);
        }
        let Some(earlier) = points.next() else {
            return Err(Refusal::OutsideTrajectory { at, from: later.0, to });
        };
        if earlier.0 < at && at < later.0 {
            let fraction = at.seconds_since(earlier.0) / later.0.seconds_since(earlier.0);
            return Ok(earlier.1.interpolate(&later.1, fraction));
        }
        later = earlier;
    }
}

/// Where the robot is; `None` before anything came.
pub(super) fn pose_message(
    estimate: &Estimate,
    map_frame: &str,
) -> Option<ros::PoseWithCovarianceStamped> {
    let header = convert::header(estimate.stamp?, map_frame);
    let pose = convert::pose_with_covariance(estimate.pose_in_map, &estimate.covariance);
    Some(ros::PoseWithCovarianceStamped { header, pose })
}

/// The poses of the particles; without poses before the first scan.
pub(super) fn particle_cloud(estimate: &Estimate, map_frame: &str) -> ros::PoseArray {
    let header = convert::header(estimate.stamp.unwrap_or_default(), map_frame);
    convert::pose_array(header, estimate.particles.iter().copied())
}

/// The encoding of a message as CDR; its schema is the type.
pub(super) fn cdr_of<M: ros::Message>() -> Encoding {
    Encoding::APPLICATION_CDR.with_schema(M::TYPE)
}

fn message<M: ros::Message>(message: &M, format: MessageFormat) -> Answer {
    let (payload, encoding) = match format {
        MessageFormat::Cdr => (ros::cdr(message), cdr_of::<M>()),
        MessageFormat::Json => {
            (ros::json(message), Encoding::APPLICATION_JSON.with_schema(M::TYPE))
        }
    };
    Answer { payloads: vec![payload.into()], encoding, attachment: None }
}

fn json(value: &impl Serialize) -> Answer {
    let bytes = serde_json::to_vec(value).expect("memory takes it, and every key is a string");
    Answer { payloads: vec![bytes.into()], encoding: Encoding::APPLICATION_JSON, attachment: None }
}

fn map_encoding(format: MapFormat) -> Encoding {
    match format {
        MapFormat::Cdr => cdr_of::<ros::OccupancyGrid>(),
        MapFormat::Json => Encoding::APPLICATION_JSON,
        MapFormat::Png => Encoding::IMAGE_PNG,
        // Zenoh has no constant for it.
        MapFormat::Pgm => Encoding::from("image/x-portable-graymap"),
        MapFormat::Yaml => Encoding::APPLICATION_YAML,
        MapFormat::Text { .. } => Encoding::TEXT_PLAIN,
    }
}

fn path_encoding(format: PathFormat) -> Encoding {
    match format {
        PathFormat::Message(MessageFormat::Cdr) => cdr_of::<ros::Path>(),
        PathFormat::Message(MessageFormat::Json) => {
            Encoding::APPLICATION_JSON.with_schema(<ros::Path as ros::Message>::TYPE)
        }
        PathFormat::Tum => Encoding::TEXT_PLAIN,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn estimate(stamp: Option<i64>, x: f64) -> Estimate {
        Estimate {
            stamp: stamp.map(Stamp),
            pose_in_map: Pose2::new(x, 0.0, 0.0),
            covariance: Matrix3::zeros(),
            has_odometry: true,
            map_from_odom: Pose2::IDENTITY,
            particles: Arc::new([]),
            report: None,
        }
    }

    fn path(points: &[(i64, f64)]) -> Path {
        points.iter().map(|&(stamp, x)| (Stamp(stamp), Pose2::new(x, 0.0, 0.0))).collect()
    }

    fn x_at(path: &Path, estimate: &Estimate, at: i64) -> Result<f64, String> {
        pose_at(path, estimate, Stamp(at)).map(|pose| pose.x).map_err(|error| error.to_string())
    }

    #[test]
    fn the_past_is_between_the_processed_scans_and_now() {
        let (path, now) = (path(&[(100, 1.0), (200, 2.0)]), estimate(Some(300), 4.0));
        let x = |at| x_at(&path, &now, at);
        assert_eq!(x(100), Ok(1.0));
        assert_eq!(x(150), Ok(1.5));
        assert_eq!(x(200), Ok(2.0));
        assert_eq!(x(250), Ok(3.0));
        assert_eq!(x(300), Ok(4.0));
        let outside = "at=0.000000301 is outside of the trajectory, which is from 0.000000100 to \
                       0.000000300";
        assert_eq!(x(301), Err(outside.to_owned()));
        assert!(x(99).unwrap_err().starts_with("at=0.000000099 is outside"));
    }

    #[test]
    fn of_two_times_with_one_stamp_the_later_is_meant() {
        let path = path(&[(100, 1.0), (200, 2.0), (100, 7.0), (300, 9.0)]);
        assert_eq!(x_at(&path, &estimate(None, 0.0), 200), Ok(8.0));
        assert_eq!(x_at(&path, &estimate(None, 0.0), 100), Ok(7.0));
    }

    #[test]
    fn without_a_trajectory_there_is_no_past() {
        let error = x_at(&Path::default(), &estimate(None, 0.0), 5).unwrap_err();
        assert_eq!(error, "there is no trajectory yet: no scan has been processed");
        assert_eq!(x_at(&Path::default(), &estimate(Some(5), 3.0), 5), Ok(3.0));
        let error = x_at(&Path::default(), &estimate(Some(-5), 3.0), 5).unwrap_err();
        assert!(error.ends_with("from -0.000000005 to -0.000000005"), "{error}");
    }
}
