//! What the mesh may ask the filter to do.

use serde::Serialize;
use tokio::sync::oneshot;

use crate::slam::pose::Pose2;

/// A command that changes the filter; saving and asking need no command, for the snapshot has all.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Command {
    /// Forget map and trajectory; the next scan is the first, at this pose of the base in `map`,
    /// or where the configuration says.
    Reset(Option<Pose2>),
    /// Take no scans until [`Command::Resume`].
    Pause,
    /// Take scans again.
    Resume,
    /// Write the state to the disk, to go on from after a restart.
    Checkpoint,
    /// The robot is here: before the first scan, where the map begins; later, all particles move.
    InitialPose(Pose2),
}

/// What was done, for the reply.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Done {
    /// In a sentence.
    pub done: String,
    /// Whether anything is different now: pausing twice changes nothing the second time.
    pub changed: bool,
}

/// A command on its way to the filter's thread.
#[derive(Debug)]
pub struct Request {
    /// What to do.
    pub command: Command,
    /// Gets the answer; or an error when the daemon stops first.
    pub reply: oneshot::Sender<Done>,
}
