//! What can be wrong, and what to do about it.

use thiserror::Error;

/// There are four ways to get left and right wrong.
const UNMIRROR: &str = "if the laser hangs upside down, say so: roll of 180 degrees in its \
     transform, or laser: {upside_down: true}; if the transform says so and it stands upright, \
     take that out; else turn off the driver's inversion, or turn the sign of odometry's yaw \
     (counter-clockwise is positive)";

/// Something that keeps maps from being good; it tells itself in a sentence.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum Finding {
    /// Not one message of a kind that is needed.
    #[error("nothing arrived on {key}")]
    NothingArrives {
        /// The key that was watched.
        key: String,
    },
    /// Odometry has two ways to come.
    #[error("no odometry arrived: nothing on {key}, and no transform from {odom} to {base}")]
    NoOdometry {
        /// The key of odometry messages.
        key: String,
        /// Odometry's frame.
        odom: String,
        /// The robot's frame.
        base: String,
    },
    /// Bytes that are no message of the type.
    #[error("{rejected} of {received} messages on {key} could not be used: {reason}")]
    Unusable {
        /// The key.
        key: String,
        /// How many.
        rejected: usize,
        /// Of how many.
        received: usize,
        /// What is wrong with the last of them.
        reason: String,
    },
    /// Less often than mapping needs.
    #[error("{what} arrives {rate_hz:.1} times a second, which is too rare for mapping")]
    Rare {
        /// Scans or odometry.
        what: &'static str,
        /// How often, Hz.
        rate_hz: f64,
    },
    /// Not every message has a stamp of its own.
    #[error("{disordered} of {received} stamps of {what} are not after the one before")]
    StampOrder {
        /// Scans or odometry.
        what: &'static str,
        /// How many.
        disordered: usize,
        /// Of how many.
        received: usize,
    },
    /// Scans and odometry are stamped by clocks that differ.
    #[error("odometry is stamped {skew_s:+.3} s against the scans that arrive with it")]
    StampSkew {
        /// Seconds; positive: odometry's clock is ahead.
        skew_s: f64,
    },
    /// The robot's clock is not that of this machine.
    #[error("scans are stamped {behind_s:.1} s before this machine's clock")]
    MachineClock {
        /// Seconds; negative: the stamps are from the future.
        behind_s: f64,
    },
    /// Beams that end nowhere.
    #[error("{without_hits} of {scans} scans have next to no range that can be used: {example}")]
    NoHits {
        /// How many.
        without_hits: usize,
        /// Of how many.
        scans: usize,
        /// What a scan has instead.
        example: String,
    },
    /// Ranges beyond the limit that the scan itself states.
    #[error(
        "{:.0} % of the ranges are beyond range_max, {range_max} m, and count as no return",
        100.0 * share
    )]
    RangeLimit {
        /// Of all finite ranges.
        share: f64,
        /// As the scans state it, m.
        range_max: f64,
    },
    /// Count and angles do not fit together.
    #[error(
        "scans have {beams} beams, but angle_min, angle_max and angle_increment tell of {expected}"
    )]
    Angles {
        /// Ranges in a scan.
        beams: usize,
        /// Beams that the angles tell of.
        expected: usize,
    },
    /// Where the laser sits is not known.
    #[error("where the laser ({laser}) sits on the robot ({base}) is not known: {reason}")]
    NoMount {
        /// Frame of the scans.
        laser: String,
        /// The robot's frame.
        base: String,
        /// What is missing.
        reason: String,
    },
    /// The laser sits in a way that cannot be mapped with.
    #[error("{0}")]
    Tilted(String),
    /// Left is right.
    #[error(
        "scans turn the other way than odometry ({turns} turns compared, {ratio:+.2} times its \
         angle): the laser looks mirrored"
    )]
    Mirrored {
        /// How many turns were compared.
        turns: usize,
        /// The scans' turn over odometry's, in the middle.
        ratio: f64,
    },
    /// Odometry's turns are wrong, and not by their sign.
    #[error("scans turn {ratio:+.2} times the angle that odometry tells ({turns} turns compared)")]
    TurnScale {
        /// How many turns were compared.
        turns: usize,
        /// The scans' turn over odometry's, in the middle.
        ratio: f64,
    },
    /// Odometry stays where it is.
    #[error("the scans change as those of a robot that moves, and odometry does not move")]
    OdometryStuck,
    /// Scans stay as they are.
    #[error("odometry moves ({moved_m:.2} m), and all scans are the same")]
    ScansFrozen {
        /// How far, m.
        moved_m: f64,
    },
    /// Nobody maps.
    #[error("no gmapd answers on {key}")]
    NoDaemon {
        /// The key that was asked.
        key: String,
    },
    /// The daemon itself says that something is wrong.
    #[error("the daemon is in state {state}: {detail}")]
    Daemon {
        /// In one word.
        state: String,
        /// In a sentence.
        detail: String,
    },
}

impl Finding {
    /// What to do about it.
    #[must_use]
    pub fn remedy(&self) -> String {
        match self {
            Self::NothingArrives { key } => format!(
                "start the driver or the bridge, and check that it publishes {key}: prefix, \
                 domain and router must be the same here and there"
            ),
            Self::NoOdometry { key, odom, base } => format!(
                "publish nav_msgs/Odometry on {key}, or the transform from {odom} to {base} on tf"
            ),
            Self::Unusable { .. } => {
                "the sender must use the ROS 2 type of this key, as CDR or JSON, with all its \
                 fields filled in"
                    .to_owned()
            }
            Self::Rare { what, .. } => format!(
                "raise the rate of {what} in its driver, or look for a slow or lossy network \
                 between here and there"
            ),
            Self::StampOrder { what, .. } => format!(
                "the driver must stamp each of the {what} with the time it was measured; two \
                 publishers on one key give this too"
            ),
            Self::StampSkew { .. } => "stamp scans and odometry by one clock: let chrony or PTP \
                 keep the clocks of the robot's computers together"
                .to_owned(),
            Self::MachineClock { .. } => "set the clocks (NTP, chrony): mapping goes on, but who \
                 looks up transforms by time will not find them"
                .to_owned(),
            Self::NoHits { .. } => "look at the laser: cap, dirt, motor, or a driver that writes \
                 ranges in another unit than metres"
                .to_owned(),
            Self::RangeLimit { .. } => {
                "set range_max in the driver to what the laser can measure".to_owned()
            }
            Self::Angles { .. } => {
                "correct angle_increment in the driver: gmapd goes by angle_min \
                 and angle_increment, and a wrong one bends walls"
                    .to_owned()
            }
            Self::NoMount { laser, base, .. } => format!(
                "publish the transform from {base} to {laser} on tf_static, or set laser: {{x, y, \
                 yaw, upside_down}} in the daemon's configuration"
            ),
            Self::Tilted(_) => "mount it level, or correct the transform".to_owned(),
            Self::Mirrored { .. } => UNMIRROR.to_owned(),
            Self::TurnScale { .. } => "calibrate odometry's yaw: wheel base, encoder ticks, \
                 degrees for radians; or use the IMU's"
                .to_owned(),
            Self::OdometryStuck => "look at the wheel encoders and the driver: it publishes, but \
                 its pose stands still"
                .to_owned(),
            Self::ScansFrozen { .. } => {
                "restart the laser's driver: it repeats its last scan".to_owned()
            }
            Self::NoDaemon { .. } => {
                "start one: gmapd run with the same prefix and the same way onto the mesh"
                    .to_owned()
            }
            Self::Daemon { .. } => "gmapd get ROBOT status tells more".to_owned(),
        }
    }
}
