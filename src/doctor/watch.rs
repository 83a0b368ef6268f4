//! Keeps what arrived.

use std::time::Duration;

use serde::Deserialize;

use crate::config::EngineKind;
use crate::convert;
use crate::ros;
use crate::slam::pose::{Pose2, Stamp};
use crate::slam::scan::Scan;
use crate::tf::{Kind, TfBuffer};

/// Messages of a kind that are kept; the rest is counted only.
const MOST_KEPT: usize = 20_000;

/// Scans that are kept, for they are large.
const MOST_SCANS: usize = 1_000;

/// Where transforms are remembered for.
const KEEP: Duration = Duration::from_secs(120);

/// Which key a message came on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Input {
    /// `sensor_msgs/LaserScan`.
    Scan,
    /// `nav_msgs/Odometry`.
    Odom,
    /// `tf2_msgs/TFMessage`.
    Tf,
    /// `tf2_msgs/TFMessage`.
    TfStatic,
}

impl Input {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::Scan, Self::Odom, Self::Tf, Self::TfStatic];

    /// Its key under a robot's prefix, unless the daemon is configured otherwise.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Scan => "scan",
            Self::Odom => "odom",
            Self::Tf => "tf",
            Self::TfStatic => "tf_static",
        }
    }
}

/// The keys that are watched, in full.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Keys {
    /// In the order of [`Input::ALL`].
    pub inputs: [String; Input::ALL.len()],
    /// Where the daemon is asked how it is.
    pub status: String,
}

/// What the frames are called.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FrameNames {
    /// Odometry's.
    pub odom: String,
    /// The robot's.
    pub base: String,
}

/// What was seen of a robot.
#[derive(Debug)]
pub struct Watch {
    pub(super) keys: Keys,
    pub(super) names: FrameNames,
    pub(super) inputs: [Counts; Input::ALL.len()],
    pub(super) scans: Vec<SeenScan>,
    /// From messages.
    pub(super) odometry: Vec<SeenPose>,
    /// From transforms.
    pub(super) tf_odometry: Vec<SeenPose>,
    pub(super) frames: TfBuffer,
    pub(super) status: Option<DaemonStatus>,
}

/// How many messages came, and how many of them were of no use.
#[derive(Debug, Clone, Default)]
pub(super) struct Counts {
    pub(super) received: usize,
    pub(super) rejected: usize,
    pub(super) reason: String,
}

/// A sweep, when it came, and what its message says about itself.
#[derive(Debug)]
pub(super) struct SeenScan {
    pub(super) arrival: Stamp,
    pub(super) frame: String,
    /// Beams that its angles tell of.
    pub(super) expected_beams: f64,
    pub(super) scan: Scan,
}

/// Where odometry says the base is, and when that came.
#[derive(Debug, Clone, Copy)]
pub(super) struct SeenPose {
    pub(super) arrival: Stamp,
    pub(super) stamp: Stamp,
    pub(super) odom_from_base: Pose2,
}

/// The part of `slam/status` that matters here.
#[derive(Debug, Deserialize)]
pub(super) struct DaemonStatus {
    pub(super) state: String,
    pub(super) detail: String,
    /// Left out by older daemons.
    pub(super) engine: Option<EngineKind>,
    #[serde(default)]
    pub(super) scans: std::collections::BTreeMap<String, u64>,
}

impl Watch {
    /// Begins to watch a robot.
    #[must_use]
    pub fn new(keys: Keys, names: FrameNames) -> Self {
        Self {
            keys,
            names,
            inputs: Default::default(),
            scans: Vec::new(),
            odometry: Vec::new(),
            tf_odometry: Vec::new(),
            frames: TfBuffer::new(KEEP),
            status: None,
        }
    }

    /// Takes a message; `arrival` is by this machine's clock, `encoding` what Zenoh says.
    pub fn add(&mut self, input: Input, arrival: Stamp, (bytes, encoding): (&[u8], &str)) {
        let taken = match input {
            Input::Scan => self.add_scan(arrival, bytes, encoding),
            Input::Odom => self.add_odometry(arrival, bytes, encoding),
            Input::Tf => self.add_transforms(arrival, Kind::Dynamic, (bytes, encoding)),
            Input::TfStatic => self.add_transforms(arrival, Kind::Static, (bytes, encoding)),
        };
        let counts = &mut self.inputs[input as usize];
        counts.received += 1;
        if let Err(reason) = taken {
            counts.rejected += 1;
            counts.reason = reason;
        }
    }

    /// Takes the daemon's answer to `slam/status`; what is no such answer counts as none.
    pub fn add_status(&mut self, json: &[u8]) {
        self.status = serde_json::from_slice(json).ok();
    }

    fn add_scan(&mut self, arrival: Stamp, bytes: &[u8], encoding: &str) -> Result<(), String> {
        let message: ros::LaserScan = ros::decode(bytes, encoding).map_err(text)?;
        let frame = message.header.frame_id.clone();
        let span = f64::from(message.angle_max) - f64::from(message.angle_min);
        let expected_beams = (span / f64::from(message.angle_increment)).abs() + 1.0;
        let scan = convert::scan(message).map_err(text)?;
        if self.scans.len() < MOST_SCANS {
            self.scans.push(SeenScan { arrival, frame, expected_beams, scan });
        }
        Ok(())
    }

    fn add_odometry(&mut self, arrival: Stamp, bytes: &[u8], encoding: &str) -> Result<(), String> {
        let message: ros::Odometry = ros::decode(bytes, encoding).map_err(text)?;
        let sample = convert::odometry(message).map_err(text)?;
        let (stamp, odom_from_base) = (sample.stamp, sample.odom_from_base);
        if self.odometry.len() < MOST_KEPT {
            self.odometry.push(SeenPose { arrival, stamp, odom_from_base });
        }
        Ok(())
    }

    fn add_transforms(
        &mut self,
        arrival: Stamp,
        kind: Kind,
        (bytes, encoding): (&[u8], &str),
    ) -> Result<(), String> {
        let message: ros::TfMessage = ros::decode(bytes, encoding).map_err(text)?;
        for transform in message.transforms {
            let transform = convert::transform(transform).map_err(text)?;
            self.frames.insert(&transform, kind).map_err(text)?;
            if kind == Kind::Dynamic {
                self.add_tf_odometry(arrival, transform.stamp);
            }
        }
        Ok(())
    }

    /// Any transform may be the one that completes the chain from `odom` to the base.
    fn add_tf_odometry(&mut self, arrival: Stamp, stamp: Stamp) {
        let FrameNames { odom, base } = &self.names;
        let Ok(place) = self.frames.target_from_source(odom, base, stamp) else { return };
        let Ok(odom_from_base) = convert::base_pose(&place) else { return };
        let is_new = self.tf_odometry.last().is_none_or(|last| last.stamp < stamp);
        if is_new && self.tf_odometry.len() < MOST_KEPT {
            self.tf_odometry.push(SeenPose { arrival, stamp, odom_from_base });
        }
    }

    /// Odometry from messages where there are any, else from transforms: as the daemon takes it.
    pub(super) fn used_odometry(&self) -> &[SeenPose] {
        if self.odometry.is_empty() { &self.tf_odometry } else { &self.odometry }
    }

    pub(super) fn key(&self, input: Input) -> String {
        self.keys.inputs[input as usize].clone()
    }
}

fn text(error: impl std::fmt::Display) -> String {
    error.to_string()
}
